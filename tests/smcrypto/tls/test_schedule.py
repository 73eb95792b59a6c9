"""The key schedules against the definitions of RFC 5869, RFC 8446, 7.1 and RFC 5246, 5, written out over `hmac`."""

from __future__ import annotations

import hashlib
import hmac
import struct

import pytest

from smcrypto import sm3
from smcrypto.kdf import hkdf
from smcrypto.tls import Alert, schedule
from smcrypto.tls.messages import Extension, Kind
from smcrypto.tls.record import AEAD13
from smcrypto.tls.tls13 import TLS13


def mac(key: bytes, data: bytes) -> bytes:
    return hmac.new(key, data, sm3.SM3).digest()


def hkdf_label(label: str, context: bytes, length: int) -> bytes:
    """struct HkdfLabel: uint16 length; opaque label<7..255> = "tls13 " + Label; opaque context<0..255>."""
    full = b"tls13 " + label.encode()
    return struct.pack(">H", length) + struct.pack("B", len(full)) + full + struct.pack("B", len(context)) + context


@pytest.mark.parametrize(
    ("label", "context", "length"),
    [("key", b"", 16), ("iv", b"", 12), ("finished", b"", 32), ("derived", bytes(32), 32)],
)
def test_expand_label(label: str, context: bytes, length: int) -> None:
    secret = bytes(range(32))
    info = hkdf_label(label, context, length)
    assert schedule.expand_label(secret, label.encode(), context, length) == mac(secret, info + b"\x01")[:length]


def test_extract_and_expand_are_the_hkdf_of_kdf() -> None:
    info = hkdf_label("key", b"", 16)
    whole = hkdf(b"secret", 16, salt=b"salt", info=info)
    assert schedule.expand_label(schedule.extract(b"salt", b"secret"), b"key", b"", 16) == whole


def test_the_stages_of_tls_13() -> None:
    """RFC 8446, 7.1, the figure, with (EC)DHE and transcript hashes that are given."""
    dhe, hashes = b"\x17" * 32, (b"\x01" * 32, b"\x02" * 32)
    zero, empty = bytes(32), sm3.digest(b"")
    early = mac(zero, zero)
    handshake = mac(mac(early, hkdf_label("derived", empty, 32) + b"\x01"), dhe)
    client = mac(handshake, hkdf_label("c hs traffic", hashes[0], 32) + b"\x01")
    master = mac(mac(handshake, hkdf_label("derived", empty, 32) + b"\x01"), zero)
    server = mac(master, hkdf_label("s ap traffic", hashes[1], 32) + b"\x01")

    assert schedule.extract(zero, zero) == early
    assert schedule.next_stage(early, dhe) == handshake
    assert schedule.derive_secret(handshake, b"c hs traffic", hashes[0]) == client
    assert schedule.next_stage(handshake, zero) == master
    assert schedule.derive_secret(master, b"s ap traffic", hashes[1]) == server
    assert schedule.updated(server) == mac(server, hkdf_label("traffic upd", b"", 32) + b"\x01")
    finished = mac(client, hkdf_label("finished", b"", 32) + b"\x01")
    assert schedule.finished_mac(client, hashes[1]) == mac(finished, hashes[1])


@pytest.mark.parametrize("length", [0, 12, 32, 33, 48, 128])
def test_the_prf_of_tlcp(length: int) -> None:
    """P_hash of RFC 5246, 5: A(0) = seed, A(i) = HMAC(secret, A(i-1))."""
    secret, seed = b"s" * 48, b"label" + b"seed"
    a, wanted = seed, b""
    for _ in range(4):
        a = mac(secret, a)
        wanted += mac(secret, a + seed)
    assert schedule.prf(secret, b"label", b"seed", length) == wanted[:length]


def test_a_record_of_tls_13_is_what_rfc_8446_says() -> None:
    """5.2 and 5.3: the header as associated data, the type behind the fragment, iv xor sequence number as nonce."""
    from smcrypto.sm4 import SM4GCM

    secret = bytes(range(32))
    key = mac(secret, hkdf_label("key", b"", 16) + b"\x01")[:16]
    iv = int.from_bytes(mac(secret, hkdf_label("iv", b"", 12) + b"\x01")[:12], "big")
    writer = AEAD13("TLS_SM4_GCM_SM3", secret)
    for sequence in range(3):
        sealed = writer.seal(23, b"text")
        nonce = (iv ^ sequence).to_bytes(12, "big")
        assert sealed[:5] == b"\x17\x03\x03" + struct.pack(">H", len(sealed) - 5)
        assert SM4GCM(key).decrypt(nonce, sealed[5:], sealed[:5]) == b"text\x17"


def test_with_sha_256_in_sm3s_place_it_is_the_schedule_of_rfc_8448(monkeypatch: pytest.MonkeyPatch) -> None:
    """Section 3, "Simple 1-RTT Handshake": secrets, keys, Finished and the ticket's key from the trace's own hashes."""

    def sha256(key: bytes, data: bytes) -> bytes:
        return hmac.digest(key, data, "sha256")

    monkeypatch.setattr("smcrypto.tls.schedule.sm3.hmac", sha256)
    monkeypatch.setattr(schedule, "EMPTY_HASH", hashlib.sha256(b"").digest())
    of = bytes.fromhex
    hello = of("860c06edc07858ee8e78f0e7428c58edd6b43f2ca3e6e95f02ed063cf0e1cad8")
    server_finished = of("9608102a0f1ccc6db6250b7b7e417b1a000eaada3daae4777a7686c9ff83df13")
    client_finished = of("209145a96ee8e2a122ff810047cc952684658d6049e86429426db87c54ad143d")
    zero = bytes(32)

    early = schedule.extract(zero, zero)
    handshake = schedule.next_stage(early, of("8bd4054fb55b9d63fdfbacf9f04b9f0d35e6d63f537563efd46272900f89492d"))
    master = schedule.next_stage(handshake, zero)
    assert early == of("33ad0a1c607ec03b09e6cd9893680ce210adf300aa1f2660e1b22e10f170f92a")
    assert handshake == of("1dc826e93606aa6fdc0aadc12f741b01046aa6b99f691ed221a9f0ca043fbeac")
    assert master == of("18df06843d13a08bf2a449844c5f8a478001bc4d4c627984d5a41da8d0402919")
    secrets = {
        (handshake, b"c hs traffic", hello): "b3eddb126e067f35a780b3abf45e2d8f3b1a950738f52e9600746a0e27a55a21",
        (handshake, b"s hs traffic", hello): "b67b7d690cc16c4e75e54213cb2d37b4e9c912bcded9105d42befd59d391ad38",
        (master, b"c ap traffic", server_finished): "9e40646ce79a7f9dc05af8889bce6552875afa0b06df0087f792ebb7c17504a5",
        (master, b"s ap traffic", server_finished): "a11af9f05531f856ad47116b45a950328204b4f44bfb6b3a4b4f1f3fcb631643",
        (master, b"res master", client_finished): "7df235f2031d2a051287d02b0241b0bfdaf86cc856231f2d5aba46c434ec196c",
    }
    for arguments, secret in secrets.items():
        assert schedule.derive_secret(*arguments) == of(secret)
    server = schedule.derive_secret(handshake, b"s hs traffic", hello)
    assert schedule.expand_label(server, b"key", b"", 16) == of("3fce516009c21727d0f2e4e86ee403bc")
    assert schedule.expand_label(server, b"iv", b"", 12) == of("5d313eb2671276ee13000b30")
    client = schedule.derive_secret(handshake, b"c hs traffic", hello)
    finished = of("a8ec436d677634ae525ac1fcebe11a039ec17694fac6e98527b642f2edd5ce61")
    assert schedule.finished_mac(client, server_finished) == finished
    resumption = schedule.derive_secret(master, b"res master", client_finished)
    ticket = of("4ecd0eb6ec3b4d87f5d6028f922ca4c5851a277fd41311c9e62d2c9492e1c4f3")
    assert schedule.expand_label(resumption, b"resumption", b"\0\0", 32) == ticket


def test_a_tickets_key_is_what_rfc_8446_says() -> None:
    """4.6.1: HKDF-Expand-Label(resumption_master_secret, "resumption", ticket_nonce, Hash.length)."""
    handshake = TLS13.__new__(TLS13)
    handshake._resumption = b"\x55" * 32
    assert handshake._psk(b"nonce") == mac(b"\x55" * 32, hkdf_label("resumption", b"nonce", 32) + b"\x01")


def test_numbers_are_those_of_the_standards() -> None:
    """RFC 8446, appendix B.2 (alerts), B.3 (messages), 4.2 (extensions)."""
    assert {alert.name: alert.value for alert in Alert} == {
        "close_notify": 0, "unexpected_message": 10, "bad_record_mac": 20, "record_overflow": 22,
        "handshake_failure": 40, "bad_certificate": 42, "unsupported_certificate": 43, "certificate_revoked": 44,
        "certificate_expired": 45, "certificate_unknown": 46, "illegal_parameter": 47, "unknown_ca": 48,
        "access_denied": 49, "decode_error": 50, "decrypt_error": 51, "protocol_version": 70,
        "insufficient_security": 71, "internal_error": 80, "user_canceled": 90, "no_renegotiation": 100,
        "missing_extension": 109, "unsupported_extension": 110, "unrecognized_name": 112, "unknown_psk_identity": 115,
        "certificate_required": 116, "no_application_protocol": 120,
    }  # fmt: skip
    assert {kind.name: kind.value for kind in Kind} == {
        "client_hello": 1, "server_hello": 2, "new_session_ticket": 4, "encrypted_extensions": 8, "certificate": 11,
        "server_key_exchange": 12, "certificate_request": 13, "server_hello_done": 14, "certificate_verify": 15,
        "client_key_exchange": 16, "finished": 20, "key_update": 24, "message_hash": 254, "change_cipher_spec": 256,
    }  # fmt: skip
    assert {extension.name: extension.value for extension in Extension} == {
        "server_name": 0, "supported_groups": 10, "signature_algorithms": 13, "alpn": 16, "pre_shared_key": 41,
        "supported_versions": 43, "cookie": 44, "psk_key_exchange_modes": 45, "key_share": 51,
    }  # fmt: skip

"""Records: what is sealed opens, what was changed does not, and for CBC one failure stands for all of them."""

from __future__ import annotations

import hmac
import secrets
from collections.abc import Callable

import pytest

from smcrypto import sm3, sm4
from smcrypto.tls import Alert, TLSError
from smcrypto.tls.record import (
    AEAD13,
    ALERT,
    APPLICATION_DATA,
    CBC,
    CHANGE_CIPHER_SPEC,
    GCM,
    HANDSHAKE,
    MAX_FRAGMENT,
    TLCP_VERSION,
    TLS12_VERSION,
    Plain,
    Protection,
    Records,
)

KEY, MAC_KEY, SECRET = bytes(range(16)), bytes(range(32)), bytes(range(50, 82))

PROTECTIONS: dict[str, Callable[[], Protection]] = {
    "TLS_SM4_GCM_SM3": lambda: AEAD13("TLS_SM4_GCM_SM3", SECRET),
    "TLS_SM4_CCM_SM3": lambda: AEAD13("TLS_SM4_CCM_SM3", SECRET),
    "GCM": lambda: GCM(KEY, b"salt"),
    "CBC": lambda: CBC(KEY, MAC_KEY, secrets.token_bytes),
}


@pytest.fixture(params=list(PROTECTIONS))
def made(request: pytest.FixtureRequest) -> Callable[[], Protection]:
    return PROTECTIONS[request.param]


def reading(protection: Protection, data: bytes) -> Records:
    records = Records(protection.version)
    records.reader = protection
    records.incoming += data
    return records


def refusal(call: Callable[[], object]) -> tuple[Alert, str]:
    with pytest.raises(TLSError) as caught:
        call()
    return caught.value.alert, str(caught.value)


BAD_MAC = (Alert.bad_record_mac, "a record is refused: the message is not authentic (bad_record_mac)")


@pytest.mark.parametrize("length", [0, 1, 15, 16, 17, 47, 48, 255, 256, 1000, MAX_FRAGMENT])
def test_what_is_sealed_opens(made: Callable[[], Protection], length: int) -> None:
    writer, reader = made(), made()
    for kind in (APPLICATION_DATA, HANDSHAKE, ALERT):
        fragment = bytes(i % 251 for i in range(length))
        assert reading(reader, writer.seal(kind, fragment)).next() == (kind, fragment)
    assert writer.sequence == reader.sequence == 3


def test_every_changed_bit_is_refused_alike(made: Callable[[], Protection]) -> None:
    record = made().seal(APPLICATION_DATA, b"attack at dawn")
    for i in range(5, len(record)):
        for bit in range(8):
            changed = record[:i] + bytes([record[i] ^ 1 << bit]) + record[i + 1 :]
            assert refusal(reading(made(), changed).next) == BAD_MAC


def test_a_record_that_is_replayed_left_out_or_of_another_type_is_refused(made: Callable[[], Protection]) -> None:
    writer, reader = made(), made()
    first, second = writer.seal(APPLICATION_DATA, b"first"), writer.seal(APPLICATION_DATA, b"second")
    assert refusal(reading(made(), second).next) == BAD_MAC
    assert reading(reader, first).next() == (APPLICATION_DATA, b"first")
    assert refusal(reading(reader, first).next) == BAD_MAC
    other = bytes([HANDSHAKE]) + first[1:]
    assert refusal(reading(made(), other).next)[0] in (Alert.bad_record_mac, Alert.unexpected_message)


@pytest.mark.parametrize("length", [0, 1, 15, 16, 17, 23, 24, 32, 48, 63, 64, 80])
def test_a_body_of_any_length_is_refused(made: Callable[[], Protection], length: int) -> None:
    reader = made()
    header = bytes([APPLICATION_DATA]) + reader.version.to_bytes(2, "big") + length.to_bytes(2, "big")
    assert refusal(reading(reader, header + bytes(length)).next) == BAD_MAC


def test_the_record_of_cbc_is_what_the_standard_says() -> None:
    """GB/T 38636-2020, 6.3.3.4.3: IV, then fragment, MAC over number, type, version, length and fragment, padding."""
    record = CBC(KEY, MAC_KEY, secrets.token_bytes).seal(APPLICATION_DATA, b"text")
    text = sm4.decrypt(KEY, sm4.CBC(record[5:21]), record[21:])
    covered = bytes(8) + b"\x17\x01\x01\x00\x04" + b"text"
    assert record[:3] == b"\x17\x01\x01"
    assert text == b"text" + hmac.new(MAC_KEY, covered, sm3.SM3).digest() + b"\x0b" * 12


def cbc_record(text: bytes) -> bytes:
    sealed = bytes(16) + sm4.encrypt(KEY, sm4.CBC(bytes(16)), text)
    return b"\x17\x01\x01" + len(sealed).to_bytes(2, "big") + sealed


def test_cbc_refuses_wrong_padding_and_wrong_macs_alike_and_computes_the_mac_for_both(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    mac = hmac.new(MAC_KEY, bytes(8) + b"\x17\x01\x01\x00\x04" + b"text", sm3.SM3).digest()
    computed = []
    honest = sm3.hmac

    def counted(key: bytes, data: bytes) -> bytes:
        computed.append(len(data))
        return honest(key, data)

    monkeypatch.setattr(sm3, "hmac", counted)
    texts = {
        "padding longer than the text": b"text" + mac + b"\xff" * 12,
        "padding longer than what leaves a MAC": b"\x2f" * 48,
        "one byte of it": b"text" + mac + b"\x0b" * 5 + b"\x0a" + b"\x0b" * 6,
        "its first byte": b"text" + mac + b"\x0a" + b"\x0b" * 11,
        "the MAC": b"text" + bytes(32) + b"\x0b" * 12,
        "both": b"text" + bytes(32) + b"\x0a" + b"\x0b" * 11,
    }
    for text in texts.values():
        assert refusal(reading(CBC(KEY, MAC_KEY, secrets.token_bytes), cbc_record(text)).next) == BAD_MAC
    assert len(computed) == len(texts)
    right = cbc_record(b"text" + mac + b"\x0b" * 12)
    assert reading(CBC(KEY, MAC_KEY, secrets.token_bytes), right).next() == (APPLICATION_DATA, b"text")
    longest = b"text" + mac + bytes([0xFB]) * 0xFC  # padding may be up to 256 bytes
    assert reading(CBC(KEY, MAC_KEY, secrets.token_bytes), cbc_record(longest)).next() == (APPLICATION_DATA, b"text")


def test_records_that_are_too_long_are_refused_by_their_header(made: Callable[[], Protection]) -> None:
    """RFC 8446, 5.1 and 5.2: 2^14, and 256 for what protects; GB/T 38636-2020, 6.3.3.4: 2048."""
    expansion = 256 if made().version == TLS12_VERSION else 2048
    for reader, limit in ((made(), 16384 + expansion), (Plain(made().version), 16384)):
        header = b"\x17" + reader.version.to_bytes(2, "big")
        assert reading(reader, header + limit.to_bytes(2, "big")).next() is None
        records = reading(reader, header + (limit + 1).to_bytes(2, "big"))
        assert refusal(records.next)[0] == Alert.record_overflow


def test_too_much_content_is_refused(made: Callable[[], Protection]) -> None:
    record = made().seal(APPLICATION_DATA, bytes(MAX_FRAGMENT + 1))
    assert refusal(reading(made(), record).next)[0] == Alert.record_overflow


def test_an_answer_in_plain_text_is_told_apart() -> None:
    alert, text = refusal(reading(Plain(TLS12_VERSION), b"HTTP/1.1 400 Bad Request").next)
    assert alert == Alert.unexpected_message and "not a TLS record" in text


def test_tlcp_takes_no_other_version_and_tls_13_any() -> None:
    record = Plain(TLS12_VERSION).seal(HANDSHAKE, b"x")
    assert refusal(reading(Plain(TLCP_VERSION), record).next)[0] == Alert.protocol_version
    old = record[:1] + b"\x03\x01" + record[3:]
    assert reading(Plain(TLS12_VERSION), old).next() == (HANDSHAKE, b"x")


def test_in_tls_13_a_record_is_protected_and_has_a_type() -> None:
    reader = PROTECTIONS["TLS_SM4_GCM_SM3"]
    plain = Plain(TLS12_VERSION).seal(HANDSHAKE, b"x")
    assert refusal(reading(reader(), plain).next)[0] == Alert.unexpected_message
    untyped = reader().seal(0, bytes(20))
    assert refusal(reading(reader(), untyped).next)[0] == Alert.unexpected_message
    for kind in (CHANGE_CIPHER_SPEC, 19, 24, 99):
        assert refusal(reading(reader(), reader().seal(kind, b"\1")).next)[0] == Alert.unexpected_message
    padded = reader().seal(0, b"text\x17" + bytes(99))  # 5.4: zeros hide the length
    assert reading(reader(), padded).next() == (APPLICATION_DATA, b"text")

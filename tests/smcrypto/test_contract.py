"""The public interface as its users write it: every name, signature and error class that callers may rely on.

What the algorithms compute is tested elsewhere against the standards; here it is
how they are called: options by keyword, any bytes-like object where bytes are due,
TypeError for all else, and the named error for a value that does not fit.
"""

from __future__ import annotations

import copy
import hmac
import inspect
import pickle
from array import array
from collections.abc import Callable
from datetime import datetime, timedelta, timezone
from typing import Any, NamedTuple

import pytest

import smcrypto
from smcrypto import kdf, sm2, sm3, sm4, x509

UTC = timezone.utc

KEY16, KEY32, IV = bytes(range(16)), bytes(range(32)), bytes(range(100, 116))
NOW = datetime(2026, 6, 1, tzinfo=UTC)
key = sm2.PrivateKey.from_int(0x1234567)
public = key.public_key
peer = sm2.PrivateKey.from_int(0x89ABCDEF)
root_key = sm2.PrivateKey.from_int(0x13579)
root = x509.self_signed(
    root_key, subject={"CN": "root"}, not_before=NOW, not_after=NOW + timedelta(days=9), ca=True
)  # fmt: skip
csr = x509.CertificateSigningRequest.create(key, subject={"CN": "robot_1", "O": "Example"}, uid=b"robot")
leaf = x509.issue(
    csr, root, root_key, not_before=NOW, not_after=NOW + timedelta(days=1), request_uid=b"robot"
)
crl = x509.CertificateRevocationList.create(
    root, root_key, revoked=[], this_update=NOW, next_update=NOW + timedelta(days=1), number=1
)


# --- as it is written ---


def test_sm3_speaks_the_protocol_of_hashlib() -> None:
    state = sm3.SM3(b"a")
    state.update(b"b")
    other = state.copy()
    state.update(b"c")
    abc = bytes.fromhex("66c7f0f462eeedd9d1f2d46bdc10e4e24167c4875cf2f7a2297da02b8f4ba8e0")  # GB/T 32905, A.1
    assert state.digest() == abc == sm3.digest(b"abc") and state.hexdigest() == abc.hex()
    assert other.digest() == sm3.digest(b"ab") and sm3.new(b"abc").digest() == sm3.SM3(data=b"abc").digest() == abc
    assert (state.name, state.digest_size, state.block_size) == ("sm3", 32, 64)
    assert sm3.SM3().digest() == sm3.new().digest() == sm3.digest(b"")
    assert sm3.ENGINE in ("openssl", "python")


def test_sm3_updates_after_a_digest() -> None:
    state = sm3.SM3(b"a")
    state.digest()
    state.update(b"bc")
    assert state.digest() == sm3.digest(b"abc")


@pytest.mark.parametrize("digestmod", [sm3, sm3.SM3, sm3.new], ids=["module", "class", "function"])
def test_the_standard_librarys_hmac_takes_sm3(digestmod: Any) -> None:
    assert hmac.new(b"key", b"message", digestmod).digest() == sm3.hmac(b"key", b"message")


def test_key_derivation() -> None:
    assert len(kdf.sm2_kdf(b"z", 33)) == 33
    assert len(kdf.hkdf(b"key", 33, salt=b"salt", info=b"info")) == 33
    assert kdf.hkdf(b"key", 8) == kdf.hkdf(b"key", 8, salt=b"", info=b"")
    assert len(kdf.pbkdf2_hmac(b"password", b"salt", 2, 33)) == 33


MODES = [sm4.ECB(), sm4.CBC(IV), sm4.CFB(IV), sm4.OFB(IV), sm4.CTR(IV), sm4.XTS(IV), sm4.XTS(IV, variant="ieee")]


def key_for(mode: sm4.Mode) -> bytes:
    return KEY32 if isinstance(mode, sm4.XTS) else KEY16


@pytest.mark.parametrize("mode", MODES, ids=repr)
def test_modes_stream_and_do_it_in_one_call(mode: sm4.Mode) -> None:
    data = bytes(range(48))
    cipher = sm4.Cipher(key_for(mode), mode)
    streamed = []
    for stream, text in ((cipher.encryptor(), data), (cipher.decryptor(), sm4.encrypt(key_for(mode), mode, data))):
        streamed.append(stream.update(text[:5]) + stream.update(text[5:]) + stream.finalize())
        with pytest.raises(smcrypto.AlreadyFinalized):
            stream.update(b"")
        with pytest.raises(smcrypto.AlreadyFinalized):
            stream.finalize()
    assert streamed == [sm4.encrypt(key_for(mode), mode, data), data]
    assert sm4.decrypt(key_for(mode), mode, streamed[0]) == data


@pytest.mark.parametrize("mode", MODES, ids=repr)
def test_modes_are_immutable_values(mode: sm4.Mode) -> None:
    assert mode == copy.deepcopy(mode) and hash(mode) == hash(copy.copy(mode))
    for name in ("iv", "nonce", "tweak", "anything"):
        with pytest.raises((AttributeError, TypeError)):
            setattr(mode, name, bytes(16))


def test_block_padding_and_aead() -> None:
    block = sm4.SM4(KEY16)
    assert block.decrypt_block(block.encrypt_block(IV)) == IV
    for mode in (sm4.ECB(), sm4.CBC(IV)):
        for data in (b"", b"12345", IV):
            sealed = sm4.encrypt(KEY16, mode, data, padding="pkcs7")
            assert sm4.decrypt(KEY16, mode, sealed, padding="pkcs7") == data
    for aead in (sm4.SM4GCM(KEY16), sm4.SM4CCM(KEY16), sm4.SM4CCM(KEY16, tag_length=4)):
        nonce = bytes(12)
        sealed = aead.encrypt(nonce, b"data", b"header")
        assert aead.decrypt(nonce, sealed, b"header") == b"data"
        assert aead.decrypt(nonce, aead.encrypt(nonce, b"data"), b"") == b"data"
        assert aead.encrypt(nonce=nonce, data=b"data", associated_data=b"header") == sealed
        with pytest.raises(smcrypto.InvalidTag):
            aead.decrypt(nonce, sealed, b"another header")


def test_private_keys_come_and_go_in_every_form() -> None:
    d = key.to_bytes()
    assert len(d) == 32 and sm2.PrivateKey.from_bytes(d) == key == sm2.PrivateKey.from_int(0x1234567)
    assert sm2.PrivateKey.generate() != key
    for password in (None, b"password"):
        assert sm2.PrivateKey.from_pem(key.to_pem(password=password), password=password) == key
        assert sm2.PrivateKey.from_der(key.to_der(password=password), password=password) == key
    assert sm2.PrivateKey.from_pem(key.to_pem(format="sec1")) == key
    assert sm2.PrivateKey.from_der(key.to_der(format="sec1")) == key
    assert all(isinstance(form, bytes) for form in (key.to_pem(), key.to_der(), public.to_pem(), public.to_der()))


def test_public_keys_come_and_go_in_every_form() -> None:
    assert len(public.to_bytes()) == 65 and len(public.to_bytes(compressed=True)) == 33
    assert sm2.PublicKey.from_bytes(public.to_bytes()) == public
    assert sm2.PublicKey.from_bytes(public.to_bytes(compressed=True)) == public
    assert sm2.PublicKey.from_pem(public.to_pem()) == public == sm2.PublicKey.from_der(public.to_der())


@pytest.mark.parametrize("encoding", ["der", "raw"])
@pytest.mark.parametrize("uid", [sm2.DEFAULT_UID, b"", b"u" * 8191], ids=["default", "empty", "longest"])
@pytest.mark.parametrize("message", [b"", b"message"])
def test_signatures(encoding: Any, uid: bytes, message: bytes) -> None:
    signature = key.sign(message, uid=uid, encoding=encoding)
    assert public.verify(signature, message, uid=uid, encoding=encoding) is None
    with pytest.raises(smcrypto.InvalidSignature):
        public.verify(signature, message + b"!", uid=uid, encoding=encoding)
    with pytest.raises(smcrypto.InvalidSignature):
        public.verify(signature, message, uid=uid[:-1] + b"?", encoding=encoding)
    signature = key.sign_digest(KEY32, encoding=encoding)
    assert public.verify_digest(signature, KEY32, encoding=encoding) is None
    with pytest.raises(smcrypto.InvalidSignature):
        public.verify_digest(signature, bytes(32), encoding=encoding)


def test_hasher_signs_what_does_not_fit_in_memory() -> None:
    state = public.hasher(uid=b"robot")
    for piece in (b"a long ", b"message"):
        state.update(piece)
    public.verify(key.sign_digest(state.digest()), b"a long message", uid=b"robot")
    assert public.hasher().digest() == public.hasher(uid=sm2.DEFAULT_UID).digest() != state.digest()


@pytest.mark.parametrize("encoding", ["der", "c1c3c2", "c1c2c3"])
def test_encryption(encoding: Any) -> None:
    for message in (b"", b"m", bytes(1000)):
        sealed = public.encrypt(message, encoding=encoding)
        assert key.decrypt(sealed, encoding=encoding) == message
        with pytest.raises(smcrypto.InvalidCiphertext):
            peer.decrypt(sealed, encoding=encoding)


def test_key_exchange() -> None:
    a = sm2.KeyExchange(key, b"alice", peer.public_key, b"bob", initiator=True)
    b = sm2.KeyExchange(peer, b"bob", public, b"alice", initiator=False, ephemeral_key=sm2.PrivateKey.from_int(77))
    assert len(a.ephemeral) == len(b.ephemeral) == 65 and a.ephemeral[0] == 4
    assert b.ephemeral == sm2.PrivateKey.from_int(77).public_key.to_bytes()
    with pytest.raises(smcrypto.OutOfOrder):
        a.confirm(bytes(32))
    key_a, confirmation_a = a.agree(b.ephemeral, 48)
    key_b, confirmation_b = b.agree(a.ephemeral, 48)
    assert key_a == key_b and len(key_a) == 48 and confirmation_a != confirmation_b
    assert a.confirm(confirmation_b) == key_a
    with pytest.raises(smcrypto.ConfirmationError):
        b.confirm(confirmation_b)
    with pytest.raises(smcrypto.OutOfOrder):
        a.agree(b.ephemeral, 48)


def test_certificates() -> None:
    assert x509.Certificate.from_pem(leaf.to_pem()) == leaf == x509.Certificate.from_der(leaf.to_der())
    assert str(leaf.subject) == "O=Example,CN=robot_1" or str(leaf.subject) == "CN=robot_1,O=Example"
    assert leaf.issuer == root.subject and leaf.public_key == public
    assert leaf.not_before == NOW and leaf.not_after.tzinfo is UTC
    assert leaf.serial_number > 0 and len(leaf.fingerprint()) == 32 and leaf.extensions
    assert leaf.fingerprint() == sm3.digest(leaf.to_der())
    x509.verify_chain(leaf, intermediates=(), roots=[root], at=NOW, uid=sm2.DEFAULT_UID)
    x509.verify_chain(leaf, roots=[root], at=NOW)
    with pytest.raises(smcrypto.CertificateError):
        x509.verify_chain(leaf, roots=[root], at=NOW + timedelta(days=2))
    with pytest.raises(smcrypto.CertificateError):
        x509.verify_chain(leaf, roots=[root], at=NOW, uid=b"another")


def test_requests() -> None:
    again = x509.CertificateSigningRequest.from_pem(csr.to_pem())
    assert again == csr == x509.CertificateSigningRequest.from_der(csr.to_der())
    assert again.public_key == public and again.verify(uid=b"robot") is None
    with pytest.raises(smcrypto.CertificateError):
        again.verify()


def test_a_name_prints_as_rfc_4514() -> None:
    assert str(x509.Name.build({"C": "CN", "O": "A, B", "CN": "robot"})) == "CN=robot,O=A\\, B,C=CN"


# --- options are keywords ---

KEYWORDS = [
    (kdf.hkdf, ["salt", "info"]),
    (sm4.encrypt, ["padding"]), (sm4.decrypt, ["padding"]),
    (sm2.PrivateKey.sign, ["uid", "encoding"]), (sm2.PrivateKey.sign_digest, ["encoding"]),
    (sm2.PublicKey.verify, ["uid", "encoding"]), (sm2.PublicKey.verify_digest, ["encoding"]),
    (sm2.PublicKey.encrypt, ["encoding"]), (sm2.PrivateKey.decrypt, ["encoding"]),
    (sm2.KeyExchange.__init__, ["initiator"]),
    (x509.verify_chain, ["intermediates", "roots", "at", "uid"]),
    (x509.CertificateSigningRequest.create, ["subject", "uid"]), (x509.CertificateSigningRequest.verify, ["uid"]),
    (x509.issue, ["not_before", "not_after", "uid"]),
    (x509.self_signed, ["subject", "not_before", "not_after", "ca", "uid"]),
]  # fmt: skip


@pytest.mark.parametrize("function, names", KEYWORDS, ids=lambda value: getattr(value, "__qualname__", ""))
def test_options_are_keyword_only(function: Callable[..., Any], names: list[str]) -> None:
    parameters = inspect.signature(function).parameters
    for name in names:
        assert parameters[name].kind is inspect.Parameter.KEYWORD_ONLY, name


# --- bytes, and nothing else, are bytes ---


class Entry(NamedTuple):
    """A function of keyword arguments that are bytes; its result must depend on nothing else."""

    name: str
    call: Callable[..., Any]
    arguments: dict[str, bytes]
    optional: frozenset[str] = frozenset()  # where None has a meaning


def streamed(mode: sm4.Mode, data: Any, *, decrypt: bool = False) -> bytes:
    cipher = sm4.Cipher(key_for(mode), mode)
    stream = cipher.decryptor() if decrypt else cipher.encryptor()
    return stream.update(data) + stream.finalize()


def updated(data: Any) -> bytes:
    state = sm3.SM3()
    state.update(data)
    return state.digest()


def hashed(uid: Any) -> bytes:
    return public.hasher(uid=uid).digest()


def exchange(own_uid: Any = b"alice", peer_uid: Any = b"bob", peer_ephemeral: Any = None, length: Any = 16) -> Any:
    ephemeral = sm2.PrivateKey.from_int(99)
    side = sm2.KeyExchange(key, own_uid, peer.public_key, peer_uid, initiator=True, ephemeral_key=ephemeral)
    return side.agree(peer_ephemeral, length)


def confirm(peer_confirmation: Any) -> None:
    a, b = (
        sm2.KeyExchange(*arguments, ephemeral_key=sm2.PrivateKey.from_int(99), initiator=initiator)
        for arguments, initiator in (((key, b"a", peer.public_key, b"b"), True), ((peer, b"b", public, b"a"), False))
    )
    a.agree(b.ephemeral, 16)
    b.agree(a.ephemeral, 16)
    a.confirm(peer_confirmation)


def right_confirmation() -> bytes:
    b = sm2.KeyExchange(
        peer, b"b", public, b"a", initiator=False, ephemeral_key=sm2.PrivateKey.from_int(99)
    )
    return b.agree(sm2.PrivateKey.from_int(99).public_key.to_bytes(), 16)[1]


EPHEMERAL = sm2.PrivateKey.from_int(88).public_key.to_bytes()
VALID = {"not_before": NOW, "not_after": NOW + timedelta(days=1)}
GCM, CCM = sm4.SM4GCM(KEY16), sm4.SM4CCM(KEY16)
EAST = timezone(timedelta(hours=14))
LATEST = datetime.max.replace(tzinfo=timezone(timedelta(hours=-12)))
LOCKED = {"pem": key.to_pem(b"password"), "der": key.to_der(b"password")}

ENTRIES = [
    Entry("sm3.SM3", lambda data: sm3.SM3(data).digest(), {"data": b"abc"}),
    Entry("sm3.new", lambda data: sm3.new(data).digest(), {"data": b"abc"}),
    Entry("SM3.update", updated, {"data": b"abc"}),
    Entry("sm3.digest", sm3.digest, {"data": b"abc"}),
    Entry("sm3.hmac", sm3.hmac, {"key": b"key", "data": b"abc"}),
    Entry("kdf.sm2_kdf", lambda z: kdf.sm2_kdf(z, 40), {"z": b"secret"}),
    Entry("kdf.hkdf", lambda key, salt, info: kdf.hkdf(key, 40, salt=salt, info=info),
          {"key": b"key", "salt": b"salt", "info": b"info"}),
    Entry("kdf.pbkdf2_hmac", lambda password, salt: kdf.pbkdf2_hmac(password, salt, 2, 40),
          {"password": b"password", "salt": b"salt"}),
    Entry("SM4", lambda key: sm4.SM4(key).encrypt_block(IV), {"key": KEY16}),
    Entry("SM4.encrypt_block", lambda block: sm4.SM4(KEY16).encrypt_block(block), {"block": IV}),
    Entry("SM4.decrypt_block", lambda block: sm4.SM4(KEY16).decrypt_block(block), {"block": IV}),
    Entry("CBC", sm4.CBC, {"iv": IV}), Entry("CFB", sm4.CFB, {"iv": IV}), Entry("OFB", sm4.OFB, {"iv": IV}),
    Entry("CTR", sm4.CTR, {"nonce": IV}), Entry("XTS", sm4.XTS, {"tweak": IV}),
    Entry("Cipher", lambda key: sm4.Cipher(key, sm4.CTR(IV)).encryptor().update(IV), {"key": KEY16}),
    *(Entry(f"update of {mode}", lambda data, mode=mode: streamed(mode, data), {"data": KEY32}) for mode in MODES),
    *(Entry(f"update of {mode}, decrypting", lambda data, mode=mode: streamed(mode, data, decrypt=True),
            {"data": KEY32}) for mode in MODES),
    Entry("sm4.encrypt", lambda key, data: sm4.encrypt(key, sm4.CBC(IV), data), {"key": KEY16, "data": KEY32}),
    Entry("sm4.decrypt", lambda key, data: sm4.decrypt(key, sm4.CBC(IV), data), {"key": KEY16, "data": KEY32}),
    Entry("SM4GCM", lambda key: sm4.SM4GCM(key).encrypt(b"n", b"data"), {"key": KEY16}),
    Entry("SM4CCM", lambda key: sm4.SM4CCM(key).encrypt(b"1234567", b"data"), {"key": KEY16}),
    Entry("SM4GCM.encrypt", GCM.encrypt, {"nonce": b"nonce", "data": b"data", "associated_data": b"header"}),
    Entry("SM4GCM.decrypt", GCM.decrypt, {"nonce": b"nonce", "data": GCM.encrypt(b"nonce", b"data", b"header"),
                                          "associated_data": b"header"}),
    Entry("SM4CCM.encrypt", CCM.encrypt, {"nonce": b"0" * 12, "data": b"data", "associated_data": b"header"}),
    Entry("SM4CCM.decrypt", CCM.decrypt, {"nonce": b"0" * 12, "data": CCM.encrypt(b"0" * 12, b"data", b"header"),
                                          "associated_data": b"header"}),
    Entry("PrivateKey.from_bytes", sm2.PrivateKey.from_bytes, {"data": key.to_bytes()}),
    Entry("PrivateKey.from_pem", sm2.PrivateKey.from_pem, {"data": LOCKED["pem"], "password": b"password"},
          frozenset({"password"})),
    Entry("PrivateKey.from_der", sm2.PrivateKey.from_der, {"data": LOCKED["der"], "password": b"password"},
          frozenset({"password"})),
    Entry("PrivateKey.to_pem", lambda password: sm2.PrivateKey.from_pem(key.to_pem(password), b"password"),
          {"password": b"password"}, frozenset({"password"})),
    Entry("PrivateKey.to_der", lambda password: sm2.PrivateKey.from_der(key.to_der(password), b"password"),
          {"password": b"password"}, frozenset({"password"})),
    Entry("PublicKey.from_bytes", sm2.PublicKey.from_bytes, {"data": public.to_bytes()}),
    Entry("PublicKey.from_pem", sm2.PublicKey.from_pem, {"data": public.to_pem()}),
    Entry("PublicKey.from_der", sm2.PublicKey.from_der, {"data": public.to_der()}),
    Entry("PublicKey.hasher", hashed, {"uid": b"robot"}),
    Entry("PrivateKey.sign", lambda message, uid: public.verify(key.sign(message, uid=uid), b"m", uid=b"u"),
          {"message": b"m", "uid": b"u"}),
    Entry("PrivateKey.sign_digest", lambda e: public.verify_digest(key.sign_digest(e), KEY32), {"e": KEY32}),
    Entry("PublicKey.verify", lambda signature, message, uid: public.verify(signature, message, uid=uid),
          {"signature": key.sign(b"m", uid=b"u"), "message": b"m", "uid": b"u"}),
    Entry("PublicKey.verify_digest", public.verify_digest, {"signature": key.sign_digest(KEY32), "e": KEY32}),
    Entry("PublicKey.encrypt", lambda message: key.decrypt(public.encrypt(message)), {"message": b"m"}),
    Entry("PrivateKey.decrypt", key.decrypt, {"ciphertext": public.encrypt(b"m")}),
    Entry("KeyExchange", lambda own_uid, peer_uid, peer_ephemeral: exchange(own_uid, peer_uid, peer_ephemeral),
          {"own_uid": b"alice", "peer_uid": b"bob", "peer_ephemeral": EPHEMERAL}),
    Entry("KeyExchange.confirm", confirm, {"peer_confirmation": right_confirmation()}),
    Entry("Certificate.from_pem", x509.Certificate.from_pem, {"data": leaf.to_pem()}),
    Entry("Certificate.from_der", x509.Certificate.from_der, {"data": leaf.to_der()}),
    Entry("load_pem_certificates", x509.load_pem_certificates, {"data": leaf.to_pem() + root.to_pem()}),
    Entry("CSR.from_pem", x509.CertificateSigningRequest.from_pem, {"data": csr.to_pem()}),
    Entry("CSR.from_der", x509.CertificateSigningRequest.from_der, {"data": csr.to_der()}),
    Entry("CSR.verify", lambda uid: csr.verify(uid=uid), {"uid": b"robot"}),
    Entry("CSR.create", lambda uid: x509.CertificateSigningRequest.create(key, subject={}, uid=uid).verify(uid=b"u"),
          {"uid": b"u"}),
    Entry("self_signed", lambda uid: x509.self_signed(key, subject={"CN": "x"}, uid=uid, **VALID).subject,
          {"uid": b"u"}),
    Entry("issue", lambda uid, request_uid: x509.issue(
        x509.CertificateSigningRequest.from_der(csr.to_der()), root, root_key, uid=uid, request_uid=request_uid,
        **VALID).subject, {"uid": b"u", "request_uid": b"robot"}, frozenset({"request_uid"})),
    Entry("verify_chain", lambda uid: x509.verify_chain(leaf, roots=[root], at=NOW, uid=uid),
          {"uid": sm2.DEFAULT_UID}),
    Entry("Certificate.verify_signature", lambda uid: leaf.verify_signature(root, uid=uid),
          {"uid": sm2.DEFAULT_UID}),
    Entry("CRL.from_pem", x509.CertificateRevocationList.from_pem, {"data": crl.to_pem()}),
    Entry("CRL.from_der", x509.CertificateRevocationList.from_der, {"data": crl.to_der()}),
    Entry("CRL.verify", lambda uid: crl.verify(root, uid=uid), {"uid": sm2.DEFAULT_UID}),
    Entry("CRL.create", lambda uid: x509.CertificateRevocationList.create(
        root, root_key, revoked=[], this_update=NOW, next_update=NOW, number=1, uid=uid).verify(root, uid=b"u"),
        {"uid": b"u"}),
]  # fmt: skip

PLACES = [
    pytest.param(entry, name, id=f"{entry.name}-{name}") for entry in ENTRIES for name in entry.arguments
]


def strided(data: bytes) -> memoryview:
    """A view of every second byte of a larger buffer: bytes-like, and not contiguous."""
    return memoryview(b"".join(bytes([byte, 0xEE]) for byte in data))[::2]


@pytest.mark.parametrize("entry, name", PLACES)
def test_any_bytes_like_object_does_where_bytes_do(entry: Entry, name: str) -> None:
    expected = entry.call(**entry.arguments)
    for convert in (bytearray, memoryview, lambda data: array("B", data), strided):
        assert entry.call(**entry.arguments | {name: convert(entry.arguments[name])}) == expected


def test_a_bytes_like_object_counts_in_bytes_not_in_items() -> None:
    assert sm3.digest(array("I", [1, 2])) == sm3.digest(array("I", [1, 2]).tobytes())
    assert sm4.CBC(array("I", [1, 2, 3, 4])).iv == array("I", [1, 2, 3, 4]).tobytes()


@pytest.mark.parametrize("wrong", ["text", 5, True, None, [1, 2], object()], ids=lambda value: type(value).__name__)
@pytest.mark.parametrize("entry, name", PLACES)
def test_anything_else_is_a_type_error_that_names_the_argument(entry: Entry, name: str, wrong: Any) -> None:
    if wrong is None and name in entry.optional:
        return
    with pytest.raises(TypeError) as error:
        entry.call(**entry.arguments | {name: wrong})
    assert name in str(error.value) and type(wrong).__name__ in str(error.value)


def test_a_mode_keeps_its_own_copy() -> None:
    iv = bytearray(IV)
    mode = sm4.CBC(iv)  # type: ignore[arg-type]
    iv[0] ^= 1
    assert mode.iv == IV and type(mode.iv) is bytes


# --- other types ---

WRONG_TYPES = [
    ("from_int", sm2.PrivateKey.from_int, ["5", b"5", 5.0, True, None]),
    ("sm2_kdf length", lambda v: kdf.sm2_kdf(b"z", v), ["5", b"5", 5.0, True, None]),
    ("hkdf length", lambda v: kdf.hkdf(b"z", v), ["5", b"5", 5.0, True, None]),
    ("pbkdf2 iterations", lambda v: kdf.pbkdf2_hmac(b"p", b"s", v, 16), ["5", b"5", 5.0, True, None]),
    ("pbkdf2 length", lambda v: kdf.pbkdf2_hmac(b"p", b"s", 1, v), ["5", b"5", 5.0, True, None]),
    ("agree length", lambda v: exchange(peer_ephemeral=EPHEMERAL, length=v), ["5", b"5", 5.0, True, None]),
    ("ccm tag_length", lambda v: sm4.SM4CCM(KEY16, tag_length=v), ["8", 8.0, True, None]),
    ("gcm tag_length", lambda v: sm4.SM4GCM(KEY16, tag_length=v), ["8", 12.0, True, None]),
    ("mode", lambda v: sm4.encrypt(KEY16, v, IV), ["ecb", sm4.ECB, None, 1]),
    ("Cipher mode", lambda v: sm4.Cipher(KEY16, v), ["ecb", sm4.ECB, None, 1]),
    ("own_key", lambda v: sm2.KeyExchange(v, b"", public, b"", initiator=True), [b"", 5, None, public]),
    ("peer_public", lambda v: sm2.KeyExchange(key, b"", v, b"", initiator=True), [b"", 5, None, key]),
    ("initiator", lambda v: sm2.KeyExchange(key, b"", public, b"", initiator=v), [1, 0, None, "yes"]),
    ("ephemeral_key", lambda v: sm2.KeyExchange(key, b"", public, b"", initiator=True, ephemeral_key=v),
     [b"", 5, public]),
    ("request key", lambda v: x509.CertificateSigningRequest.create(v, subject={}), [b"", 5, None, public]),
    ("self_signed key", lambda v: x509.self_signed(v, subject={"CN": "x"}, **VALID), [b"", 5, None, public]),
    ("subject", x509.Name.build, [5, None, [5], ["CN=x"], [("CN",)], {"CN": b"x"}, {5: "x"}]),
    ("issue csr", lambda v: x509.issue(v, root, root_key, **VALID), [b"", None, leaf]),
    ("issue ca_certificate", lambda v: x509.issue(csr, v, root_key, **VALID), [b"", None, csr]),
    ("issue ca_key", lambda v: x509.issue(csr, root, v, **VALID), [b"", 5, None, public]),
    ("verify_chain leaf", lambda v: x509.verify_chain(v, roots=[root], at=NOW), [b"", None, csr, leaf.to_pem()]),
    ("verify_chain roots", lambda v: x509.verify_chain(leaf, roots=[v], at=NOW), [b"", None, csr]),
    ("verify_chain intermediates", lambda v: x509.verify_chain(leaf, intermediates=[v], roots=[root], at=NOW),
     [b"", None, csr]),
    ("verify_chain crls", lambda v: x509.verify_chain(leaf, roots=[root], at=NOW, crls=[v]), [b"", None, root]),
    ("verify_chain at", lambda v: x509.verify_chain(leaf, roots=[root], at=v), [0, "2026-06-01", None, NOW.date()]),
    ("verify_signature issuer", lambda v: leaf.verify_signature(v), [b"", None, csr]),
    ("crl issuer", lambda v: crl.verify(v), [b"", None, csr]),
    ("crl ca_certificate", lambda v: x509.CertificateRevocationList.create(
        v, root_key, revoked=[], this_update=NOW, next_update=NOW, number=1), [b"", None, csr]),
    ("crl ca_key", lambda v: x509.CertificateRevocationList.create(
        root, v, revoked=[], this_update=NOW, next_update=NOW, number=1), [b"", None, public]),
    ("crl revoked", lambda v: x509.CertificateRevocationList.create(
        root, root_key, revoked=[v], this_update=NOW, next_update=NOW, number=1), [b"", None, 5]),
    ("crl find", crl.find, ["1", b"1", 1.0, True, None, leaf]),
    ("name get", leaf.subject.get, [b"CN", 5, None, ["CN"]]),
    ("crl number", lambda v: x509.CertificateRevocationList.create(
        root, root_key, revoked=[], this_update=NOW, next_update=NOW, number=v), ["1", True, None]),
]  # fmt: skip


@pytest.mark.parametrize("call, wrong", [
    # By place and type: a value's own text would differ between the processes of a parallel run.
    pytest.param(call, value, id=f"{name}-{index}-{type(value).__name__}")
    for name, call, values in WRONG_TYPES
    for index, value in enumerate(values)
])  # fmt: skip
def test_arguments_of_another_type_are_type_errors(call: Callable[[Any], Any], wrong: Any) -> None:
    with pytest.raises(TypeError):
        call(wrong)


# --- values that do not fit ---

REFUSED = [
    # keys
    (smcrypto.InvalidKey, lambda: sm4.SM4(bytes(15))),
    (smcrypto.InvalidKey, lambda: sm4.SM4(bytes(17))),
    (smcrypto.InvalidKey, lambda: sm4.SM4(b"")),
    (smcrypto.InvalidKey, lambda: sm4.encrypt(bytes(24), sm4.ECB(), IV)),
    (smcrypto.InvalidKey, lambda: sm4.Cipher(bytes(32), sm4.CBC(IV))),
    (smcrypto.InvalidKey, lambda: sm4.Cipher(bytes(16), sm4.XTS(IV))),
    (smcrypto.InvalidKey, lambda: sm4.SM4GCM(bytes(32))),
    (smcrypto.InvalidKey, lambda: sm4.SM4CCM(bytes(15))),
    (smcrypto.InvalidKey, lambda: sm2.PrivateKey.from_int(0)),
    (smcrypto.InvalidKey, lambda: sm2.PrivateKey.from_int(-1)),
    (smcrypto.InvalidKey, lambda: sm2.PrivateKey.from_int(sm2.SM2P256V1.n - 1)),
    (smcrypto.InvalidKey, lambda: sm2.PrivateKey.from_bytes(bytes(32))),
    (smcrypto.InvalidKey, lambda: sm2.PrivateKey.from_bytes(bytes(31))),
    (smcrypto.InvalidKey, lambda: sm2.PrivateKey.from_bytes(b"\xff" * 32)),
    (smcrypto.InvalidKey, lambda: sm2.PublicKey.from_bytes(b"\0")),
    (smcrypto.InvalidKey, lambda: sm2.PublicKey.from_bytes(public.to_bytes()[1:])),
    (smcrypto.InvalidKey, lambda: sm2.PublicKey.from_bytes(b"\4" + bytes(64))),
    (smcrypto.InvalidKey, lambda: sm2.PublicKey.from_bytes(b"\4" + b"\xff" * 64)),
    (smcrypto.InvalidKey, lambda: sm2.PrivateKey.from_pem(b"nothing")),
    (smcrypto.InvalidKey, lambda: sm2.PrivateKey.from_der(b"")),
    (smcrypto.InvalidKey, lambda: sm2.PublicKey.from_pem(b"")),
    (smcrypto.InvalidKey, lambda: sm2.PublicKey.from_pem(key.to_pem())),
    (smcrypto.InvalidKey, lambda: sm2.PrivateKey.from_pem(public.to_pem())),
    (smcrypto.InvalidKey, lambda: sm2.PrivateKey.from_pem(LOCKED["pem"])),
    (smcrypto.InvalidKey, lambda: sm2.PrivateKey.from_pem(LOCKED["pem"], b"wrong")),
    (smcrypto.InvalidKey, lambda: sm2.PrivateKey.from_pem(key.to_pem(), b"superfluous")),
    (smcrypto.InvalidKey, lambda: exchange(peer_ephemeral=b"\4" + bytes(64))),
    (smcrypto.InvalidKey, lambda: x509.issue(csr, root, key, **VALID)),
    # lengths
    *((smcrypto.InvalidLength, lambda mode=mode, n=n: mode(bytes(n)))
      for mode in (sm4.CBC, sm4.CFB, sm4.OFB, sm4.CTR, sm4.XTS) for n in (0, 12, 15, 17)),
    (smcrypto.InvalidLength, lambda: sm4.SM4(KEY16).encrypt_block(bytes(15))),
    (smcrypto.InvalidLength, lambda: sm4.SM4(KEY16).decrypt_block(bytes(17))),
    (smcrypto.InvalidLength, lambda: sm4.encrypt(KEY16, sm4.ECB(), bytes(15))),
    (smcrypto.InvalidLength, lambda: sm4.decrypt(KEY16, sm4.CBC(IV), bytes(33))),
    (smcrypto.InvalidLength, lambda: sm4.encrypt(KEY32, sm4.XTS(IV), bytes(15))),
    (smcrypto.InvalidLength, lambda: GCM.encrypt(b"", b"data")),
    (smcrypto.InvalidLength, lambda: GCM.decrypt(b"", bytes(16))),
    (smcrypto.InvalidLength, lambda: CCM.encrypt(bytes(6), b"data")),
    (smcrypto.InvalidLength, lambda: CCM.encrypt(bytes(14), b"data")),
    (smcrypto.InvalidLength, lambda: CCM.encrypt(bytes(13), bytes(65536))),
    (smcrypto.InvalidLength, lambda: sm4.SM4CCM(KEY16, tag_length=5)),
    (smcrypto.InvalidLength, lambda: sm4.SM4CCM(KEY16, tag_length=18)),
    (smcrypto.InvalidLength, lambda: key.sign(b"m", uid=bytes(8192))),
    (smcrypto.InvalidLength, lambda: public.verify(key.sign(b"m"), b"m", uid=bytes(8192))),
    (smcrypto.InvalidLength, lambda: public.hasher(uid=bytes(8192))),
    (smcrypto.InvalidLength, lambda: exchange(own_uid=bytes(8192), peer_ephemeral=EPHEMERAL)),
    (smcrypto.InvalidLength, lambda: key.sign_digest(bytes(31))),
    (smcrypto.InvalidLength, lambda: public.verify_digest(key.sign_digest(KEY32), bytes(33))),
    (smcrypto.InvalidLength, lambda: exchange(peer_ephemeral=EPHEMERAL, length=0)),
    (smcrypto.InvalidLength, lambda: exchange(peer_ephemeral=EPHEMERAL, length=-1)),
    (smcrypto.InvalidLength, lambda: kdf.sm2_kdf(b"z", -1)),
    (smcrypto.InvalidLength, lambda: kdf.sm2_kdf(b"z", 32 * (2**32 - 1))),
    (smcrypto.InvalidLength, lambda: kdf.hkdf(b"k", 8161)),
    (smcrypto.InvalidLength, lambda: kdf.pbkdf2_hmac(b"p", b"s", 1, 0)),
    # options
    (smcrypto.InvalidOption, lambda: sm4.XTS(IV, variant="nist")),
    (smcrypto.InvalidOption, lambda: sm4.XTS(IV, variant=None)),
    (smcrypto.InvalidOption, lambda: sm4.encrypt(KEY16, sm4.ECB(), IV, padding="zero")),
    (smcrypto.InvalidOption, lambda: sm4.encrypt(KEY16, sm4.CTR(IV), IV, padding="pkcs7")),
    (smcrypto.InvalidOption, lambda: key.sign(b"m", encoding="hex")),
    (smcrypto.InvalidOption, lambda: key.sign_digest(KEY32, encoding=None)),
    (smcrypto.InvalidOption, lambda: public.verify(key.sign(b"m"), b"m", encoding="DER")),
    (smcrypto.InvalidOption, lambda: public.encrypt(b"m", encoding="raw")),
    (smcrypto.InvalidOption, lambda: key.decrypt(b"m", encoding="c1c3")),
    (smcrypto.InvalidOption, lambda: key.to_pem(format="pkcs1")),
    (smcrypto.InvalidOption, lambda: key.to_pem(password=b"p", format="sec1")),
    (smcrypto.InvalidOption, lambda: key.to_der(password=b"p", format="sec1")),
    (smcrypto.InvalidOption, lambda: kdf.pbkdf2_hmac(b"p", b"s", 0, 16)),
    (smcrypto.InvalidOption, lambda: x509.verify_chain(leaf, roots=[root], at=NOW.replace(tzinfo=None))),
    (smcrypto.InvalidOption, lambda: x509.verify_chain(leaf, roots=[root], at=datetime.min.replace(tzinfo=EAST))),
    (smcrypto.InvalidOption, lambda: x509.self_signed(key, subject={"CN": "x"}, not_before=NOW, not_after=LATEST)),
    (smcrypto.InvalidOption, lambda: x509.self_signed(key, subject={"CN": "x"}, not_before=LATEST, not_after=NOW)),
    (smcrypto.InvalidOption, lambda: x509.self_signed(
        key, subject={"CN": "x"}, **VALID, extensions=[x509.Extension("1.x", False, b"")])),
    # what the peer sent
    *((smcrypto.InvalidSignature, lambda s=s, e=e: public.verify(s, b"m", encoding=e))
      for s in (b"", b"0", bytes(64), bytes(72), b"\xff" * 64) for e in ("der", "raw")),
    *((smcrypto.InvalidCiphertext, lambda c=c, e=e: key.decrypt(c, encoding=e))
      for c in (b"", b"0", b"\4" + bytes(96), bytes(200)) for e in ("der", "c1c3c2", "c1c2c3")),
    *((smcrypto.InvalidTag, lambda aead=aead, n=n: aead.decrypt(bytes(12), bytes(n)))
      for aead in (GCM, CCM) for n in (0, 15, 16, 40)),
    *((smcrypto.InvalidPadding, lambda n=n, mode=mode: sm4.decrypt(KEY16, mode, bytes(n), padding="pkcs7"))
      for n in (0, 1, 15, 17) for mode in (sm4.ECB(), sm4.CBC(IV))),
    *((smcrypto.CertificateError, lambda kind=kind, data=data: kind.from_pem(data))
      for kind in (x509.Certificate, x509.CertificateSigningRequest, x509.CertificateRevocationList)
      for data in (b"", b"text", key.to_pem())),
    *((smcrypto.CertificateError, lambda kind=kind, data=data: kind.from_der(data))
      for kind in (x509.Certificate, x509.CertificateSigningRequest, x509.CertificateRevocationList)
      for data in (b"", b"text", public.to_der(), leaf.to_der() + b"\0")),
]  # fmt: skip


@pytest.mark.parametrize("error, call", [
    pytest.param(error, call, id=f"{index}-{error.__name__}") for index, (error, call) in enumerate(REFUSED)
])  # fmt: skip
def test_what_does_not_fit_has_its_named_error(error: type[Exception], call: Callable[[], Any]) -> None:
    with pytest.raises(smcrypto.SMCryptoError) as raised:
        call()
    assert type(raised.value) is error, raised.value
    assert isinstance(raised.value, ValueError) and str(raised.value)


# --- what must not show ---


def test_no_secret_shows_where_objects_are_printed() -> None:
    secret = sm2.PrivateKey.generate()
    shown = repr([
        secret, sm4.SM4(KEY16), sm4.Cipher(KEY16, sm4.ECB()), sm4.SM4GCM(KEY16), sm4.SM4CCM(KEY16), sm3.SM3(KEY16),
        sm2.KeyExchange(secret, b"", public, b"", initiator=True), sm4.Cipher(KEY16, sm4.CTR(IV)).encryptor(),
    ])
    for value in (secret.to_bytes(), KEY16):
        assert value.hex() not in shown.lower() and repr(value)[2:-1] not in shown
    assert str(secret.to_int()) not in shown


def test_a_key_cannot_be_changed() -> None:
    for thing in (key, public):
        with pytest.raises(AttributeError):
            thing.curve = None  # type: ignore[misc, assignment]


@pytest.mark.parametrize("holder", [
    key, sm4.SM4(KEY16), sm4.SM4GCM(KEY16), sm4.SM4CCM(KEY16), sm4.Cipher(KEY16, sm4.CBC(IV)),
    sm2.KeyExchange(key, b"", public, b"", initiator=True).agree(public.to_bytes(), 16)[0],
], ids=lambda holder: type(holder).__name__)  # fmt: skip
def test_no_object_writes_its_key_into_a_pickle(holder: Any) -> None:
    for protocol in range(pickle.HIGHEST_PROTOCOL + 1):
        with pytest.raises(TypeError, match="is not pickled"):
            pickle.dumps([holder], protocol)
    assert copy.copy(holder) is holder and copy.deepcopy([holder])[0] is holder


def test_public_values_can_be_pickled() -> None:
    for value in (public, leaf, *MODES):
        assert pickle.loads(pickle.dumps(value)) == value


def test_copies_of_a_hash_are_independent() -> None:
    for duplicate in (sm3.SM3.copy, copy.copy, copy.deepcopy):
        state = sm3.SM3(b"a")
        other = duplicate(state)
        other.update(b"b")
        assert state.digest() == sm3.digest(b"a") and other.digest() == sm3.digest(b"ab")


@pytest.mark.parametrize("duplicate", [copy.copy, copy.deepcopy, pickle.dumps])
def test_what_must_be_used_once_is_not_duplicated(duplicate: Callable[[Any], Any]) -> None:
    stream = sm4.Cipher(KEY16, sm4.CTR(IV)).encryptor()
    exchange = sm2.KeyExchange(key, b"", public, b"", initiator=True)
    for thing in (stream, exchange):
        with pytest.raises(TypeError, match="copied"):
            duplicate(thing)

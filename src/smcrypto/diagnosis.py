"""What is this, does it fit my key, and how is it read: keys, points, signatures and ciphertexts of SM2, in any form.

`diagnose` takes what somebody was given (hex, base64, PEM, DER or bytes), names every form of SM2 that it can be,
tries a key and a message on it, and gives the call that reads it. The calls of other libraries for each form are in
docs/migration.md.

For one's own desk. It tells one failure from another, with a private key in hand; `decrypt` and `verify` do not, on
purpose. A service that shows its answers to others is an oracle (Bleichenbacher, CRYPTO 1998).

Sources: encodings GM/T 0009-2012, GB/T 32918.2 and .4.
"""

from __future__ import annotations

import base64
import binascii
import hashlib
import re
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Final, Literal, NamedTuple, TypeAlias

from smcrypto import pem, sm2, sm3, x509
from smcrypto.errors import InvalidEncoding, InvalidKey, InvalidLength, InvalidSignature, SMCryptoError
from smcrypto.inputs import BytesLike, as_bytes
from smcrypto.sm2.curve import SM2P256V1
from smcrypto.sm2.encryption import decode_ciphertext
from smcrypto.sm2.keyfiles import ForeignKey, NotOpened
from smcrypto.sm2.signature import decode_signature, encode_signature, message_digest

__all__ = ["MAX_SIZE", "Diagnosis", "Reading", "diagnose", "key_of"]

MAX_SIZE = 1 << 20
"""The most bytes or characters that are looked at."""

Key: TypeAlias = "sm2.PrivateKey | sm2.PublicKey"


@dataclass(frozen=True, slots=True)
class Reading:
    """One thing that the data can be.

    what: "signature", "ciphertext", "public key", "private key" or another noun. form: how it is written.
    verdict: what the given key and message say to it; "" without them. call: the Python that reads it, in which
    `octets` stands for the attribute of that name: the bytes that were written in hex, base64 or PEM, with the first
    byte that was missing, r and s in their order.
    """

    what: str
    form: str
    verdict: str
    call: str
    octets: bytes = field(repr=False)

    def __str__(self) -> str:
        return "\n  ".join([f"{self.what}: {self.form}", *filter(None, [self.verdict, self.call])])


@dataclass(frozen=True, slots=True)
class Diagnosis:
    """Every reading, the likeliest first, and remarks on what stood in the way of others. Printed, it is a report."""

    readings: tuple[Reading, ...]
    remarks: tuple[str, ...] = ()

    def __str__(self) -> str:
        found = [str(reading) for reading in self.readings] or ["nothing of SM2 that is known here"]
        return "\n\n".join(found + [f"note: {remark}" for remark in self.remarks])


class _Given(NamedTuple):
    """What there is to try on the data."""

    public: sm2.PublicKey | None
    private: sm2.PrivateKey | None
    message: bytes | None
    uids: tuple[bytes, ...]
    password: bytes | None


def diagnose(
    data: BytesLike | str, *, key: Key | None = None, message: BytesLike | None = None, uid: BytesLike | None = None,
    password: BytesLike | None = None,
) -> Diagnosis:  # fmt: skip
    """What `data` is, whether it fits `key`, and the calls that read it.

    data: text (hex, base64, PEM) or bytes (the same, DER, or raw), at most 1 MiB, otherwise InvalidLength.
    key: whose it should be; a private key also opens ciphertexts. message: what a signature should be of. uid: a
    distinguishing identifier to try beside the usual ones, at most 8,191 bytes, otherwise InvalidLength. password: of
    an encrypted key. Decrypted texts and private keys are not shown. It raises nothing else: what fits nothing has no
    readings.

    >>> key = sm2.PrivateKey.generate()
    >>> signature = key.sign(b"message", encoding="raw").hex()
    >>> print(diagnose(signature, key=key, message=b"message").readings[0].verdict)
    holds for the key, with uid b'1234567812345678'
    """
    octets = data.encode("utf-8", "replace") if isinstance(data, str) else as_bytes(data, "data")
    if len(octets) > MAX_SIZE:
        raise InvalidLength(f"what is to be diagnosed is at most {MAX_SIZE} bytes")
    if not (key is None or isinstance(key, sm2.PrivateKey | sm2.PublicKey)):
        raise TypeError(f"key must be a PrivateKey or a PublicKey, not {type(key).__name__}")
    uids = (sm2.DEFAULT_UID, b"") if uid is None else (as_bytes(uid, "uid"), sm2.DEFAULT_UID, b"")
    given = _Given(
        key.public_key if isinstance(key, sm2.PrivateKey) else key,
        key if isinstance(key, sm2.PrivateKey) else None,
        None if message is None else as_bytes(message, "message"),
        uids,
        None if password is None else as_bytes(password, "password"),
    )
    readings: list[Reading] = []
    remarks: list[str] = []
    for how, content in _unwrapped(octets, remarks):
        readings += _readings(content, how, given, remarks)
    return Diagnosis(tuple(dict.fromkeys(readings)), tuple(dict.fromkeys(remarks)))


def key_of(data: BytesLike, password: BytesLike | None = None) -> Key:
    """The first key that `data` holds in any form that `diagnose` knows; InvalidKey if there is none."""
    octets, remarks = as_bytes(data, "data"), list[str]()
    secret = None if password is None else as_bytes(password, "password")
    for _, content in _unwrapped(octets[: MAX_SIZE + 1], remarks):
        for key, *_ in _keys(content, secret, remarks):
            return key
    raise InvalidKey("; ".join(["no SM2 key in any known form", *dict.fromkeys(remarks)]))


# --- text to bytes ---

_HEX = re.compile(rb"(?:0[xX])?([0-9a-fA-F]+)")
_BASE64 = re.compile(rb"[A-Za-z0-9+/_-]+={0,2}")


def _unwrapped(data: bytes, remarks: list[str], inside: str = "") -> Iterator[tuple[str, bytes]]:
    """(how it was written, the bytes) for each way in which `data` can be read; hex in base64 and the like too."""
    if b"-----BEGIN " in data:
        try:
            blocks = pem.decode(data)
        except InvalidEncoding as error:
            remarks.append(str(error))
            return
        if not blocks:
            remarks.append("-----BEGIN stands there, but no line is a PEM boundary: is it indented, or one line?")
        for label, content in blocks:
            yield f"PEM, label {label}{inside}", content
        return
    text = re.sub(rb"[\s:]", b"", data)
    if match := _HEX.fullmatch(text):
        digits = match[1]
        if len(digits) % 2:
            remarks.append(f"{len(digits)} hex digits, an odd number: a leading zero was lost, or a digit")
        how, other, content = "hex", _BASE64, binascii.unhexlify(b"0" * (len(digits) % 2) + digits)
    elif _BASE64.fullmatch(text) and len(text.rstrip(b"=")) % 4 != 1:
        digits = text.rstrip(b"=").translate(bytes.maketrans(b"-_", b"+/"))
        how, other, content = "base64", _HEX, base64.b64decode(digits + b"=" * (-len(digits) % 4))
    else:
        yield f"bytes{inside}", data
        return
    text = content.strip()
    if b"-----BEGIN " in text or (len(text) >= 32 and other.fullmatch(text)):
        yield from _unwrapped(content, remarks, f" in {how}{inside}")
    else:
        yield how + inside, content


# --- bytes to things ---


def _readings(data: bytes, how: str, given: _Given, remarks: list[str]) -> Iterator[Reading]:
    keys = list(_keys(data, given.password, remarks))
    for key, form, call, octets in keys:
        if isinstance(key, sm2.PrivateKey):
            form = f"{form}, in {how}; its public key is {key.public_key.to_bytes().hex()}"
            verdict = _verdict(key.public_key, given, "it is the given key's", "it is another key than the one given")
            yield Reading("private key", form, verdict, call, octets)
        else:
            verdict = _verdict(key, given, "it belongs to the given key", "it is of another key than the one given")
            yield Reading("public key", f"{form}, in {how}", verdict, call, octets)
    if not (keys and len(data) == 64):
        yield from _signatures(data, how, given)
    yield from _ciphertexts(data, how, given)
    yield from _documents(data, how, given)
    if len(data) == 16 and how != "bytes":
        yield Reading("16 bytes", f"in {how}: an SM4 key, IV or block", "", "sm4.SM4(octets)", data)


def _verdict(found: sm2.PublicKey | None, given: _Given, fits: str, differs: str) -> str:
    return "" if found is None or given.public is None else fits if found == given.public else differs


_POINTS = {33: "33 bytes, compressed", 64: "64 bytes, x ‖ y without the leading 04", 65: "65 bytes, 04 ‖ x ‖ y"}


def _keys(data: bytes, password: bytes | None, remarks: list[str]) -> Iterator[tuple[Key, str, str, bytes]]:
    """(a key, its form, the call that reads it, the bytes for that), a private key first.

    By chance 64 bytes are a point in one of 2^256 cases, 32 after 02 or 03 in every second.
    """
    if data[:1] == b"\x30":
        form, secret = ("DER", "") if password is None else ("DER, encrypted", ", password")
        try:
            yield sm2.PrivateKey.from_der(data, password), form, f"sm2.PrivateKey.from_der(octets{secret})", data
        except SMCryptoError as error:  # InvalidKey, or a package is missing
            if not isinstance(error, InvalidKey) or isinstance(error.__cause__, ForeignKey | NotOpened):
                remarks.append(str(error))
    zero = len(data) == 33 and data[0] == 0
    form, octets = ("33 bytes: a leading zero and d", data[1:]) if zero else ("32 bytes, d", data)
    with suppress(InvalidKey):
        yield sm2.PrivateKey.from_bytes(octets), form, "sm2.PrivateKey.from_bytes(octets)", octets
    with suppress(InvalidKey):
        if point := _POINTS.get(len(data)):
            octets = b"\4" + data if len(data) == 64 else data
            yield sm2.PublicKey.from_bytes(octets), point, "sm2.PublicKey.from_bytes(octets)", octets
        else:  # 91 bytes, 59 where compressed
            yield sm2.PublicKey.from_der(data), "DER, SubjectPublicKeyInfo", "sm2.PublicKey.from_der(octets)", data


# --- signatures ---


def _signatures(data: bytes, how: str, given: _Given) -> Iterator[Reading]:
    for encoding in ("der", "raw"):
        try:
            r, s = decode_signature(data, SM2P256V1, encoding)
        except InvalidSignature:
            continue
        if not (0 < r < SM2P256V1.n and 0 < s < SM2P256V1.n):
            continue
        verdict, uid, order = _tried(r, s, given)
        form = f"{'DER, SEQUENCE { r, s }' if encoding == 'der' else '64 bytes, r ‖ s'}, in {how}"
        named = "" if encoding == "der" else ', encoding="raw"'
        call = (f"key.verify_digest(octets, e{named})   # e: 32 bytes, made as said above" if uid is None
                else f"key.verify(octets, message, uid={uid!r}{named})")  # fmt: skip
        yield Reading("signature", form, verdict, call, encode_signature(*order, SM2P256V1, encoding))


def _messages(message: bytes) -> Iterator[tuple[str, bytes]]:
    yield "", message
    stripped = message.rstrip(b"\r\n")
    if stripped != message:
        yield "of the message without its last line end", stripped
    if (match := _HEX.fullmatch(message.strip())) and len(match[1]) % 2 == 0:
        yield "of the bytes that the message spells in hex", binascii.unhexlify(match[1])
    yield "of the message's hex digits as text", message.hex().encode()


def _candidates(given: _Given, public: sm2.PublicKey) -> Iterator[tuple[bytes, bytes | None, str]]:
    """Digests that somebody may have signed; the uid, where Z_A is in it; and how it came about."""
    for how, message in _messages(given.message or b""):
        of = f" {how}" if how else ""
        for uid in given.uids:
            yield message_digest(SM2P256V1, public.point, uid, message), uid, f"with uid {uid!r}{of}"
        for name, digest in (("SM3", sm3.digest(message)), ("SHA-256", hashlib.sha256(message).digest())):
            yield digest, None, f"with e = {name} of the message alone, no Z_A{of}"
        if 0 < len(message) <= 4096:
            number = int.from_bytes(message, "big") % SM2P256V1.n
            yield number.to_bytes(32, "big"), None, f"with the message itself in the hash's place{of}"


def _tried(r: int, s: int, given: _Given) -> tuple[str, bytes | None, tuple[int, int]]:
    """(verdict, the uid that the call takes, r and s in their order)."""
    if given.public is None:
        return "", given.uids[0], (r, s)
    if given.message is None:
        return "give the message as well, to have it tried on the key", given.uids[0], (r, s)
    for order, said in (((r, s), ""), ((s, r), "; r and s are exchanged")):
        encoded = encode_signature(*order, SM2P256V1, "raw")
        for e, uid, story in _candidates(given, given.public):
            with suppress(InvalidSignature):
                given.public.verify_digest(encoded, e, encoding="raw")
                return f"holds for the key, {story}{said}", uid, order
    tried = f"tried uid {', '.join(map(repr, given.uids))}, hashes without Z_A, r and s exchanged"
    return f"does not hold for the key and the message: {tried}", given.uids[0], (r, s)


# --- ciphertexts ---

_FORMS: Final[tuple[tuple[Literal["der", "c1c3c2", "c1c2c3"], bytes, str], ...]] = (
    ("der", b"", "DER, SEQUENCE { x, y, C3, C2 } (GM/T 0009)"),
    ("c1c3c2", b"", "C1 ‖ C3 ‖ C2"),
    ("c1c3c2", b"\4", "C1 ‖ C3 ‖ C2 without the leading 04"),
    ("c1c2c3", b"", "C1 ‖ C2 ‖ C3"),
    ("c1c2c3", b"\4", "C1 ‖ C2 ‖ C3 without the leading 04"),
)


def _ciphertexts(data: bytes, how: str, given: _Given) -> Iterator[Reading]:
    """With the private key only what opens; without it both orders, for nothing but the key tells them apart."""
    found: list[Reading] = []
    for encoding, start, form in _FORMS:
        octets, verdict = start + data, ""
        try:
            *_, C2 = decode_ciphertext(octets, SM2P256V1, encoding)
        except SMCryptoError:
            continue
        call = "key.decrypt(octets)" if encoding == "der" else f"key.decrypt(octets, encoding={encoding!r})"
        form = f"{form}, of {len(C2)} bytes, in {how}"
        if given.private is not None:
            try:
                size = len(given.private.decrypt(octets, encoding=encoding))
            except SMCryptoError:
                verdict = "does not open with the key"
            else:
                yield Reading("ciphertext", form, f"opens with the key: {size} bytes", call, octets)
                return
        found.append(Reading("ciphertext", form, verdict, call, octets))
    yield from found


# --- what holds keys and signatures ---


def _documents(data: bytes, how: str, given: _Given) -> Iterator[Reading]:
    if data[:1] != b"\x30":
        return
    for what, kind in (
        ("certificate", x509.Certificate),
        ("certificate signing request", x509.CertificateSigningRequest),
        ("revocation list", x509.CertificateRevocationList),
    ):
        try:
            found = kind.from_der(data)
        except SMCryptoError:
            continue
        holder = getattr(found, "public_key", None)  # which a revocation list has not
        verdict = _verdict(holder, given, "it holds the given key", "it holds another key than the one given")
        yield Reading(what, f"DER, in {how}: {found!r}", verdict, f"x509.{kind.__name__}.from_der(octets)", data)

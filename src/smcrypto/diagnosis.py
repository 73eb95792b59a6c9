"""What is this, does it fit my key, and how is it read: keys, points, signatures and ciphertexts of SM2, in any form.

`diagnose` takes what somebody was given (hex, base64, PEM, DER or bytes), names every form of SM2 that it can be,
tries a key and a message on it, and gives the calls that read it: here, in gmssl (Python, 3.2.2), sm-crypto
(JavaScript, 0.5.8), Bouncy Castle (Java, 1.78) and openssl (3.0).

For one's own desk. It tells one failure from another, with a private key in hand; `decrypt` and `verify` do not, on
purpose. A service that shows its answers to others is an oracle (Bleichenbacher, CRYPTO 1998).

Sources: encodings GM/T 0009-2012, GB/T 32918.2 and .4; the other libraries' own sources and manuals.
"""

from __future__ import annotations

import base64
import binascii
import hashlib
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple, TypeAlias

from smcrypto import pem, sm2, sm3, x509
from smcrypto.errors import (
    InvalidEncoding,
    InvalidKey,
    InvalidLength,
    InvalidSignature,
    MissingDependency,
    SMCryptoError,
)
from smcrypto.inputs import BytesLike, as_bytes
from smcrypto.sm2.curve import SM2P256V1
from smcrypto.sm2.encryption import decode_ciphertext, encode_ciphertext
from smcrypto.sm2.signature import decode_signature, encode_signature, message_digest

__all__ = ["MAX_SIZE", "Diagnosis", "Reading", "diagnose", "key_of"]

MAX_SIZE = 1 << 20
"""The most bytes or characters that are looked at."""

Key: TypeAlias = "sm2.PrivateKey | sm2.PublicKey"


@dataclass(frozen=True, slots=True)
class Reading:
    """One thing that the data can be.

    what: "signature", "ciphertext", "public key", "private key" or another noun. form: how it is written.
    verdict: what the given key and message say to it; "" without them. calls: (tool, the call that reads it).
    """

    what: str
    form: str
    verdict: str = ""
    calls: tuple[tuple[str, str], ...] = ()

    def __str__(self) -> str:
        lines = [f"{self.what}: {self.form}"]
        if self.verdict:
            lines.append(f"  {self.verdict}")
        width = max((len(tool) for tool, _ in self.calls), default=0)
        lines += [f"  {tool:{width}}  {call}" for tool, call in self.calls]
        return "\n".join(lines)


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
    data: BytesLike | str,
    *,
    key: Key | None = None,
    message: BytesLike | None = None,
    uid: BytesLike | None = None,
    password: BytesLike | None = None,
) -> Diagnosis:
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
        for found in (_private_key(content, secret, remarks), _public_key(content)):
            if found is not None:
                return found[0]
    raise InvalidKey("; ".join(["no SM2 key in any known form", *dict.fromkeys(remarks)]))


# --- text to bytes ---

_HEX = re.compile(rb"(?:0[xX])?([0-9a-fA-F]+)")
_BASE64 = re.compile(rb"[A-Za-z0-9+/_-]+={0,2}")


class _Written(NamedTuple):
    """How the bytes were written, in words, and the Python that makes them of `data`."""

    words: str
    python: str

    def __str__(self) -> str:
        return self.words

    @property
    def form(self) -> Literal["pem", "der"]:
        return "pem" if self.words.startswith("PEM") else "der"


def _unwrapped(data: bytes, remarks: list[str], python: str = "data") -> Iterator[tuple[_Written, bytes]]:
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
            yield _Written(f"PEM, label {label}", python), content
        return
    text = re.sub(rb"[\s:]", b"", data)
    string = python if python == "data" else f"{python}.decode()"
    if match := _HEX.fullmatch(text):
        digits = match[1]
        for mark in ("0x", "0X", ":"):
            string += f".replace({mark!r}, '')" if mark.encode() in data else ""
        if len(digits) % 2:
            remarks.append(f"{len(digits)} hex digits, an odd number: a leading zero was lost, or a digit")
            digits, string = b"0" + digits, f"'0' + {string}"
        yield from _inner(_Written("hex", f"bytes.fromhex({string})"), binascii.unhexlify(digits), remarks)
    elif _BASE64.fullmatch(text) and len(text.rstrip(b"=")) % 4 != 1:
        usual = len(text) % 4 == 0 and b"-" not in text and b"_" not in text
        python = f"base64.b64decode({python})" if usual else f"base64.urlsafe_b64decode({string} + '===')"
        digits = text.rstrip(b"=").translate(bytes.maketrans(b"-_", b"+/"))
        yield from _inner(_Written("base64", python), base64.b64decode(digits + b"=" * (-len(digits) % 4)), remarks)
    else:
        yield _Written("bytes", python), data


def _inner(how: _Written, content: bytes, remarks: list[str]) -> Iterator[tuple[_Written, bytes]]:
    text = content.strip()
    if b"-----BEGIN " in text or (len(text) >= 32 and (_HEX if how.words == "base64" else _BASE64).fullmatch(text)):
        for deeper, inside in _unwrapped(content, remarks, how.python):
            yield deeper._replace(words=f"{deeper} in {how}"), inside
    else:
        yield how, content


# --- bytes to things ---


def _readings(data: bytes, how: _Written, given: _Given, remarks: list[str]) -> Iterator[Reading]:
    private, public = _private_key(data, given.password, remarks), _public_key(data)
    if private:
        yield _of_private_key(*private, how, given)
    if public:
        yield _of_public_key(*public, how, given)
    if not (public and len(data) == 64):
        yield from _signatures(data, how, given)
    yield from _ciphertexts(data, how, given)
    yield from _documents(data, how, given)
    if len(data) == 16 and how.words != "bytes":
        yield Reading("16 bytes", f"in {how}: an SM4 key, IV or block", calls=(("smcrypto", "sm4.SM4(key)"),))


def _private_key(data: bytes, password: bytes | None, remarks: list[str]) -> tuple[sm2.PrivateKey, str] | None:
    forms = {32: ("32 bytes, d", data), 33: ("33 bytes: a leading zero and d", data[1:])}
    if data[:1] == b"\x30":
        try:
            return sm2.PrivateKey.from_der(data, password), "DER" if password is None else "DER, encrypted"
        except MissingDependency as error:
            remarks.append(str(error))
        except InvalidKey as error:
            if "password" in str(error) or "curve" in str(error) or "algorithm" in str(error):
                remarks.append(str(error))
    if len(data) in forms and (len(data) == 32 or data[0] == 0):
        form, d = forms[len(data)]
        try:
            return sm2.PrivateKey.from_bytes(d), form
        except InvalidKey:
            return None
    return None


def _public_key(data: bytes) -> tuple[sm2.PublicKey, str] | None:
    """A point of the curve: by chance 64 bytes are one in 2^256 cases, 32 after 02 or 03 in every second."""
    try:
        if len(data) == 64:
            return sm2.PublicKey.from_bytes(b"\4" + data), "64 bytes, x ‖ y without the leading 04"
        if len(data) in (33, 65):
            form = "33 bytes, compressed" if len(data) == 33 else "65 bytes, 04 ‖ x ‖ y"
            return sm2.PublicKey.from_bytes(data), form
        return sm2.PublicKey.from_der(data), "DER, SubjectPublicKeyInfo"  # 91 bytes, 59 where compressed
    except InvalidKey:
        return None


def _of_private_key(key: sm2.PrivateKey, form: str, how: _Written, given: _Given) -> Reading:
    verdict = ""
    if given.public is not None:
        fits = key.public_key == given.public
        verdict = "it is the given key's" if fits else "it is another key than the one given"
    d, xy = "D", key.public_key.to_bytes()[1:].hex()
    if how.form == "pem" or form.startswith("DER"):
        option = "" if how.form == "pem" else " -inform DER"
        secret = ", password" if form.endswith("encrypted") else ""
        calls = (
            ("smcrypto", f"sm2.PrivateKey.from_{how.form}({how.python}{secret})"),
            ("gmssl", f'takes hex: CryptSM2(private_key=key.to_bytes().hex(), public_key="{xy}")'),
            ("sm-crypto", "takes hex: key.to_bytes().hex()"),
            ("Bouncy Castle", "(ECPrivateKey) KeyFactory.getInstance(\"EC\", \"BC\")"
             ".generatePrivate(new PKCS8EncodedKeySpec(pkcs8))"),
            ("openssl", f"openssl pkey -in FILE{option} -noout -text"),
        )
    else:
        calls = (
            ("smcrypto", f"sm2.PrivateKey.from_bytes({how.python}{'[1:]' if form[:2] == '33' else ''})"),
            ("gmssl", f'CryptSM2(private_key={d}, public_key="{xy}")   # D: the 64 hex digits of d'),
            ("sm-crypto", f'sm2.doDecrypt(c, {d}), sm2.doSignature(m, {d}, {{hash: true}})   // D: the 64 hex digits'),
            ("Bouncy Castle", f"new ECPrivateKeyParameters(new BigInteger({d}, 16), domain)   // domain of sm2p256v1"),
            ("openssl", "reads PEM and DER: write it with key.to_pem()"),
        )
    return Reading("private key", f"{form}, in {how}; its public key is 04{xy}", verdict, calls)


def _of_public_key(key: sm2.PublicKey, form: str, how: _Written, given: _Given) -> Reading:
    verdict = ""
    if given.public is not None:
        verdict = "it belongs to the given key" if key == given.public else "it is of another key than the one given"
    xy = key.to_bytes()[1:].hex()
    if form.startswith("DER"):
        ours = f"sm2.PublicKey.from_{how.form}({how.python})"
        theirs = f"openssl pkey -pubin -in FILE{'' if how.form == 'pem' else ' -inform DER'} -noout -text"
    else:
        start = r"b'\x04' + " if form.startswith("64") else ""
        ours = f"sm2.PublicKey.from_bytes({start}{how.python})"
        theirs = "reads PEM and DER: write it with key.to_pem()"
    calls = (
        ("smcrypto", ours),
        ("gmssl", f'CryptSM2(private_key="", public_key="{xy}")   # without 04: it strips every leading 0 and 4'),
        ("sm-crypto", f'"04{xy}" as the public key'),
        ("Bouncy Castle", f'new ECPublicKeyParameters(curve.decodePoint(Hex.decode("04{xy}")), domain)'),
        ("openssl", theirs),
    )
    return Reading("public key", f"{form}, in {how}", verdict, calls)


# --- signatures ---


def _signatures(data: bytes, how: _Written, given: _Given) -> Iterator[Reading]:
    for encoding in ("der", "raw"):
        try:
            r, s = decode_signature(data, SM2P256V1, encoding)
        except InvalidSignature:
            continue
        if not (0 < r < SM2P256V1.n and 0 < s < SM2P256V1.n):
            continue
        verdict, found = _signature_verdict(r, s, given)
        form = f"{'DER, SEQUENCE { r, s }' if encoding == 'der' else '64 bytes, r ‖ s'}, in {how}"
        if verdict.endswith(_EXCHANGED):  # the calls take them in order
            r, s = s, r
            how = how._replace(python=f"bytes.fromhex('{encode_signature(r, s, SM2P256V1, encoding).hex()}')")
        yield Reading("signature", form, verdict, _signature_calls(r, s, encoding, how, given, found))


_EXCHANGED = "; r and s are exchanged"


class _Candidate(NamedTuple):
    """A digest that somebody may have signed, and how it came about."""

    e: int
    uid: bytes | None
    story: str


def _messages(message: bytes) -> Iterator[tuple[str, bytes]]:
    yield "", message
    stripped = message.rstrip(b"\r\n")
    if stripped != message:
        yield "of the message without its last line end", stripped
    if (match := _HEX.fullmatch(message.strip())) and len(match[1]) % 2 == 0:
        yield "of the bytes that the message spells in hex", binascii.unhexlify(match[1])
    yield "of the message's hex digits as text", message.hex().encode()


def _candidates(given: _Given, public: sm2.PublicKey) -> Iterator[_Candidate]:
    for how, message in _messages(given.message or b""):
        of = f" {how}" if how else ""
        for uid in given.uids:
            e = message_digest(SM2P256V1, public.point, uid, message)
            yield _Candidate(int.from_bytes(e, "big"), uid, f"with uid {uid!r}{of}")
        for name, digest in (("SM3", sm3.digest(message)), ("SHA-256", hashlib.sha256(message).digest())):
            story = f"with e = {name} of the message alone, no Z_A{of}"
            yield _Candidate(int.from_bytes(digest, "big"), None, story)
        if 0 < len(message) <= 4096:
            number = int.from_bytes(message, "big") % SM2P256V1.n
            yield _Candidate(number, None, f"with the message itself in the hash's place{of}")


def _signature_verdict(r: int, s: int, given: _Given) -> tuple[str, _Candidate | None]:
    """What holds. e is known without the message: e = r - x of sG + tP, up to the one point in 2^32 with x >= n."""
    if given.public is None:
        return "", None
    if given.message is None:
        return "give the message as well, to have it tried on the key", None
    for first, second, order in ((r, s, ""), (s, r, _EXCHANGED)):
        for candidate in _candidates(given, given.public):
            digest = (candidate.e % (1 << 256)).to_bytes(32, "big")
            try:
                encoded = encode_signature(first, second, SM2P256V1, "raw")
                given.public.verify_digest(encoded, digest, encoding="raw")
            except InvalidSignature:
                continue
            return f"holds for the key, {candidate.story}{order}", candidate
    tried = ", ".join(repr(uid) for uid in given.uids)
    return f"does not hold for the key and the message: tried uid {tried}, hashes without Z_A, r and s exchanged", None


def _signature_calls(
    r: int, s: int, encoding: str, how: _Written, given: _Given, found: _Candidate | None
) -> tuple[tuple[str, str], ...]:
    raw, whole = (encode_signature(r, s, SM2P256V1, form).hex() for form in ("raw", "der"))
    uid = given.uids[0] if found is None else found.uid
    octets = how.python
    named = "" if encoding == "der" else ', encoding="raw"'
    if uid is None:
        ours = f"key.verify_digest({octets}, e{named})   # e: 32 bytes, made as said above"
        theirs = f'CryptSM2(private_key="", public_key=XY).verify("{raw}", e)'
        java = "SM2Signer cannot leave out Z_A"
        script = f'sm2.doVerifySignature(e, "{raw}", publicKey, {{hash: false}})   // e as an array of bytes'
        shell = "cannot: it signs and verifies with Z_A"
    else:
        ours = f"key.verify({octets}, message, uid={uid!r}{named})"
        theirs = (f'CryptSM2(private_key="", public_key=XY).verify_with_sm3("{raw}", message)'
                  if uid == sm2.DEFAULT_UID else "cannot: its uid is fixed to 1234567812345678")  # fmt: skip
        text = uid.decode("utf-8", "replace")
        script = f"sm2.doVerifySignature(message, \"{raw}\", publicKey, {{hash: true, userId: '{text}'}})"
        coding = "" if encoding == "der" else "PlainDSAEncoding.INSTANCE"
        java = (f'SM2Signer v = new SM2Signer({coding}); v.init(false, new ParametersWithID(publicKey, "{text}"'
                ".getBytes())); v.update(message, 0, message.length); v.verifySignature(signature)")  # fmt: skip
        form = "" if encoding == "der" else f"   (in DER: {whole})"
        shell = (f"openssl pkeyutl -verify -pubin -inkey PUB -rawin -digest sm3 -pkeyopt distid:'{text}' "
                 f"-in MESSAGE -sigfile SIGNATURE{form}")  # fmt: skip
    return (("smcrypto", ours), ("gmssl", theirs), ("sm-crypto", script), ("Bouncy Castle", java), ("openssl", shell))


# --- ciphertexts ---

_FORMS: Sequence[tuple[str, str]] = (
    ("der", "DER, SEQUENCE { x, y, C3, C2 } (GM/T 0009)"), ("c1c3c2", "C1 ‖ C3 ‖ C2"), ("c1c2c3", "C1 ‖ C2 ‖ C3"),
)  # fmt: skip


def _ciphertexts(data: bytes, how: _Written, given: _Given) -> Iterator[Reading]:
    """With the private key only what opens; without it both orders, for nothing but the key tells them apart."""
    found: list[Reading] = []
    for encoding, form in _FORMS:
        for start, said in ((b"", ""), (b"\4", " without the leading 04")):
            if encoding == "der" and start:
                continue
            try:
                C1, C3, C2 = decode_ciphertext(start + data, SM2P256V1, encoding)
            except SMCryptoError:
                continue
            verdict, opens = "", True
            if given.private is not None:
                try:
                    size = len(given.private.decrypt(start + data, encoding=encoding))  # type: ignore[arg-type]
                    verdict = f"opens with the key: {size} bytes"
                except SMCryptoError:
                    verdict, opens = "does not open with the key", False
            order = f"{form}{said}, of {len(C2)} bytes, in {how}"
            reading = Reading("ciphertext", order, verdict, _ciphertext_calls(C1, C3, C2, encoding, how, bool(start)))
            if opens and given.private is not None:
                yield reading
                return
            found.append(reading)
    yield from found


def _ciphertext_calls(
    C1: tuple[int, int], C3: bytes, C2: bytes, encoding: str, how: _Written, bare: bool
) -> tuple[tuple[str, str], ...]:
    order = "c1c3c2" if encoding == "der" else encoding
    mode = int(order == "c1c3c2")
    octets = ("b'\\x04' + " if bare else "") + how.python
    plain = encode_ciphertext(C1, C3, C2, SM2P256V1, order)
    whole = encode_ciphertext(C1, C3, C2, SM2P256V1, "der")

    def shown(octets: bytes) -> str:
        return octets.hex() if len(octets) <= 200 else octets[:64].hex() + "..."

    same = "" if encoding != "der" else "   (C1 ‖ C3 ‖ C2)"
    return (
        ("smcrypto", f"key.decrypt({octets}{'' if encoding == 'der' else f', encoding={encoding!r}'})"),
        ("gmssl", f'CryptSM2(private_key=D, public_key=XY, mode={mode})'
         f'.decrypt(bytes.fromhex("{shown(plain[1:])}")){same}'),
        ("sm-crypto", f'sm2.doDecrypt("{shown(plain[1:])}", privateKey, {mode}){same}'),
        ("Bouncy Castle", f"SM2Engine e = new SM2Engine(SM2Engine.Mode.{order.upper()}); e.init(false, privateKey); "
         f'byte[] c = Hex.decode("{shown(plain)}"); e.processBlock(c, 0, c.length)'),
        ("openssl", f"openssl pkeyutl -decrypt -inkey KEY -in CIPHERTEXT   (in DER: {shown(whole)})"),
    )  # fmt: skip


# --- what holds keys and signatures ---


def _documents(data: bytes, how: _Written, given: _Given) -> Iterator[Reading]:
    if data[:1] != b"\x30":
        return
    option = "" if how.form == "pem" else " -inform DER"
    for what, kind, command in (
        ("certificate", x509.Certificate, "x509"),
        ("certificate signing request", x509.CertificateSigningRequest, "req"),
        ("revocation list", x509.CertificateRevocationList, "crl"),
    ):
        try:
            found = kind.from_der(data)
        except SMCryptoError:
            continue
        verdict = ""
        if given.public is not None and isinstance(found, x509.Certificate | x509.CertificateSigningRequest):
            fits = found.public_key == given.public
            verdict = "it holds the given key" if fits else "it holds another key than the one given"
        calls = (
            ("smcrypto", f"x509.{kind.__name__}.from_{how.form}({how.python})"),
            ("openssl", f"openssl {command} -in FILE{option} -noout -text"),
        )
        yield Reading(what, f"DER, in {how}: {found!r}", verdict, calls)

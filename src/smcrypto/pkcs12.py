"""PKCS#12 files with SM2 keys, SM4 and SM3: RFC 7292; PBES2 inside, RFC 8018.

What is written: certificates and keys encrypted by SM4-CBC under PBKDF2, the whole under HMAC-SM3 with the key
derivation of RFC 7292, B.2. What is read: everything that key files may be encrypted with (see `sm2.keyfiles`), and
the MAC with SM3, SHA-1 or SHA-2. `openssl pkcs12` reads and writes the same (OpenSSL 3.0 wants `prf="sha256"`).

The MAC comes first: nothing inside is parsed before it holds. Who makes a file knows its password, so the work that all
its parts together ask for is bounded. Not here: files without a MAC, signed ones, the old encryptions by RC2 and 3DES
of PKCS#12 itself, secret and revocation list bags.
"""

from __future__ import annotations

import hashlib
import secrets
from collections.abc import Callable, Iterable, Iterator
from hmac import compare_digest
from hmac import new as hmac_new
from typing import Final, NamedTuple

from smcrypto import der, sm2, sm3
from smcrypto.errors import InvalidEncoding, InvalidKey, InvalidOption, InvalidPadding
from smcrypto.inputs import BytesLike, as_bytes, require_int, require_type
from smcrypto.sm2.keyfiles import ITERATIONS, MAX_ITERATIONS, MAX_PURE_ITERATIONS, Prf, read_pbes2, write_pbes2
from smcrypto.x509 import Certificate

__all__ = ["Contents", "Entry", "dump", "load"]

_DATA: Final = "1.2.840.113549.1.7.1"  # RFC 2315, 14
_ENCRYPTED_DATA: Final = "1.2.840.113549.1.7.6"
_KEY_BAG: Final = "1.2.840.113549.1.12.10.1.1"  # RFC 7292, 4.2
_SHROUDED_KEY_BAG: Final = "1.2.840.113549.1.12.10.1.2"
_CERT_BAG: Final = "1.2.840.113549.1.12.10.1.3"
_X509_CERTIFICATE: Final = "1.2.840.113549.1.9.22.1"  # RFC 2985, 5.6
_FRIENDLY_NAME: Final = "1.2.840.113549.1.9.20"  # RFC 2985, 5.5
_LOCAL_KEY_ID: Final = "1.2.840.113549.1.9.21"
_SM3: Final = "1.2.156.10197.1.401"
# Hashes of the MAC: name, size of a block in bytes (v of RFC 7292, B.2).
_HASHES: Final = {
    _SM3: ("sm3", 64),
    "1.3.14.3.2.26": ("sha1", 64),
    "2.16.840.1.101.3.4.2.4": ("sha224", 64),
    "2.16.840.1.101.3.4.2.1": ("sha256", 64),
    "2.16.840.1.101.3.4.2.2": ("sha384", 128),
    "2.16.840.1.101.3.4.2.3": ("sha512", 128),
}
_MAC_KEY: Final = 3  # the ID of RFC 7292, B.3
_WRONG: Final = "the password is wrong, or the file is damaged"


class Entry(NamedTuple):
    """A private key, its certificate if that is in the file, and the name that the file gives to the key."""

    key: sm2.PrivateKey
    certificate: Certificate | None = None
    name: str | None = None


class Contents(NamedTuple):
    """What a file holds: keys with their certificates, and all other certificates, in the order of the file."""

    entries: tuple[Entry, ...]
    others: tuple[Certificate, ...]


def dump(
    entries: Iterable[Entry],
    password: BytesLike,
    *,
    others: Iterable[Certificate] = (),
    prf: Prf = "sm3",
    iterations: int = ITERATIONS,
) -> bytes:
    """A PKCS#12 file in DER.

    entries: keys with certificates; two for the signing and the encryption pair of TLCP. others: the chain.
    password: UTF-8, not empty. prf: of PBKDF2, "sm3", or "sha256" for OpenSSL 3.0. iterations: of PBKDF2 and of the
    MAC. InvalidOption: a password that is empty or not UTF-8, no entry, an unknown prf, iterations out of range
    (1,000,000; 10,000,000 for all keys together). InvalidKey: a certificate that is not of the key beside it.

    >>> key = sm2.PrivateKey.generate()
    >>> load(dump([Entry(key, name="robot")], b"password", iterations=1000), b"password").entries[0].name
    'robot'
    """
    secret, listed, chain = as_bytes(password, "password"), tuple(entries), tuple(others)
    if not listed:
        raise InvalidOption("there is no key to write")
    if not 1 <= require_int(iterations, "iterations") <= MAX_PURE_ITERATIONS:
        raise InvalidOption(f"iterations must be between 1 and {MAX_PURE_ITERATIONS}, not {iterations}")
    if iterations * (len(listed) + 1) > MAX_ITERATIONS:
        raise InvalidOption(f"{iterations} iterations for each of {len(listed)} keys are too many for `load`")
    try:
        wide = _bmp(secret)
    except UnicodeDecodeError:
        raise InvalidOption("the password must be UTF-8") from None
    key_bags: list[bytes] = []
    certificate_bags: list[bytes] = []
    for number, entry in enumerate(listed):
        require_type(entry, Entry, "each entry")
        require_type(entry.key, sm2.PrivateKey, "the key of an entry")
        attributes = [_attribute(_LOCAL_KEY_ID, der.octet_string(number.to_bytes(4, "big")))]
        if entry.name is not None:
            attributes.append(_attribute(_FRIENDLY_NAME, der.element(der.BMP_STRING, _name(entry.name))))
        algorithm, ciphertext = write_pbes2(entry.key.to_der(), secret, prf, iterations)
        sealed = der.sequence(algorithm, der.octet_string(ciphertext))
        key_bags.append(_bag(_SHROUDED_KEY_BAG, sealed, attributes))
        if entry.certificate is not None:
            require_type(entry.certificate, Certificate, "the certificate of an entry")
            if entry.certificate.public_key != entry.key.public_key:
                raise InvalidKey("the certificate of an entry is not of its key")
            certificate_bags.append(_certificate_bag(entry.certificate, attributes))
    for certificate in chain:
        require_type(certificate, Certificate, "each of others")
        certificate_bags.append(_certificate_bag(certificate, []))
    parts = [_content(_DATA, der.octet_string(der.sequence(*key_bags)))]
    if certificate_bags:
        algorithm, ciphertext = write_pbes2(der.sequence(*certificate_bags), secret, prf, iterations)
        inner = der.sequence(der.oid(_DATA), algorithm, der.implicit(0, ciphertext))
        parts.insert(0, _content(_ENCRYPTED_DATA, der.sequence(der.integer(0), inner)))
    safe, salt = der.sequence(*parts), secrets.token_bytes(16)
    tag = _mac(_SM3, wide, salt, iterations, safe)
    mac = der.sequence(
        der.sequence(der.sequence(der.oid(_SM3), der.null()), der.octet_string(tag)),
        der.octet_string(salt),
        *([der.integer(iterations)] if iterations != 1 else []),  # a default is left out
    )
    return der.sequence(der.integer(3), _content(_DATA, der.octet_string(safe)), mac)


def load(data: BytesLike, password: BytesLike) -> Contents:
    """What a PKCS#12 file in DER holds.

    InvalidKey: not such a file, the wrong password, an encryption that is not supported, more work than 10,000,000
    iterations in all, a key that is not SM2's. MissingDependency: its cipher needs a package.
    CertificateError: a certificate in it that is not well formed, or not with an SM2 key.
    """
    octets, secret = as_bytes(data, "data"), as_bytes(password, "password")
    certificates: list[Certificate] = []
    keys: list[tuple[sm2.PrivateKey, str | None]] = []
    try:
        contents = [_read_content(content) for content in _members(_authenticated(octets, secret))]
        _require_bounded(contents)
        bags = [_read_bag(bag) for content in contents for bag in _members(content.opened(secret))]
        _require_bounded([*contents, *(bag.value for bag in bags)])
        for bag in bags:
            value = bag.value.opened(secret)
            if bag.kind == _CERT_BAG:
                certificates.append(Certificate.from_der(value))
            else:
                keys.append((sm2.PrivateKey.from_der(value), bag.name))
    except InvalidPadding:
        raise InvalidKey(_WRONG) from None
    except InvalidEncoding as error:
        raise InvalidKey(f"not a PKCS#12 file: {error}") from None
    of_key: dict[sm2.PublicKey, list[Certificate]] = {}
    for certificate in reversed(certificates):
        of_key.setdefault(certificate.public_key, []).append(certificate)
    entries = tuple(Entry(key, own.pop() if (own := of_key.get(key.public_key)) else None, name) for key, name in keys)
    used = {id(entry.certificate) for entry in entries}
    return Contents(entries, tuple(c for c in certificates if id(c) not in used))


# --- the integrity of the whole ---


def _authenticated(data: bytes, password: bytes) -> bytes:
    """The AuthenticatedSafe of a PFX, RFC 7292, 4, after its MAC was found right."""
    pfx = der.only_sequence(data)
    if pfx.integer() != 3:
        raise InvalidEncoding("the version is not 3")
    content = pfx.sequence()
    if content.oid() != _DATA:
        raise InvalidEncoding("the file is signed, not authenticated by a password")
    wrapped = content.explicit(0)
    content.finish()
    safe = wrapped.octet_string()
    wrapped.finish()
    if pfx.at_end():
        raise InvalidEncoding("the file has no MAC, so nothing shows that it is whole")
    mac = pfx.sequence()
    pfx.finish()
    digest = mac.sequence()
    algorithm = digest.sequence()
    name = algorithm.oid()
    if not algorithm.at_end():
        algorithm.null()
    algorithm.finish()
    expected = digest.octet_string()
    digest.finish()
    salt = mac.octet_string()
    iterations = 1 if mac.at_end() else mac.integer()
    mac.finish()
    if name not in _HASHES:
        raise InvalidEncoding(f"the MAC's hash {name} is not supported")
    if not 1 <= iterations <= MAX_PURE_ITERATIONS:
        raise InvalidKey(f"the file asks for {iterations} iterations; the limit is {MAX_PURE_ITERATIONS}")
    try:
        found = _mac(name, _bmp(password), salt, iterations, safe)
    except UnicodeDecodeError:
        raise InvalidKey("the password must be UTF-8") from None
    if not compare_digest(found, expected):
        raise InvalidKey(_WRONG)
    return safe


def _bmp(password: bytes) -> bytes:
    """The password as B.1 wants it: a BMPString with two zero bytes after it."""
    return password.decode("utf-8").encode("utf-16-be") + b"\0\0"


def _mac(algorithm: str, password: bytes, salt: bytes, iterations: int, data: bytes) -> bytes:
    name, block = _HASHES[algorithm]
    digest = sm3.digest if name == "sm3" else _hashlib(name)
    key = _derive(digest, block, password, salt, iterations)
    return sm3.hmac(key, data) if name == "sm3" else hmac_new(key, data, name).digest()


def _hashlib(name: str) -> Callable[[bytes], bytes]:
    return lambda data: hashlib.new(name, data).digest()


def _derive(digest: Callable[[bytes], bytes], v: int, P: bytes, S: bytes, r: int) -> bytes:
    """The key of the MAC, as long as a hash: RFC 7292, B.2, steps 1 to 5 and 6 for i = 1, n = u."""

    def filled(text: bytes) -> bytes:
        size = v * -(-len(text) // v)
        return (text * (size // max(len(text), 1) + 1))[:size]

    A = digest(bytes([_MAC_KEY]) * v + filled(S) + filled(P))
    for _ in range(r - 1):
        A = digest(A)
    return A


# --- reading what is inside ---


class _Value(NamedTuple):
    """Bytes of the file; what makes plaintext of them, where they are encrypted, and its work in iterations."""

    octets: bytes
    decrypt: Callable[[bytes, bytes], bytes] | None = None
    work: int = 0

    def opened(self, password: bytes) -> bytes:
        return self.octets if self.decrypt is None else self.decrypt(password, self.octets)


class _Bag(NamedTuple):
    kind: str
    value: _Value
    name: str | None


def _members(data: bytes) -> Iterator[der.Reader]:
    """The sequences in a SEQUENCE OF."""
    outer = der.only_sequence(data)
    while not outer.at_end():
        yield outer.sequence()


def _require_bounded(values: Iterable[_Value]) -> None:
    if (work := sum(value.work for value in values)) > MAX_ITERATIONS:
        raise InvalidKey(f"the file asks for {work} iterations in all; the limit is {MAX_ITERATIONS}")


def _read_content(content: der.Reader) -> _Value:
    """One ContentInfo of the AuthenticatedSafe: SafeContents, plain or encrypted."""
    name = content.oid()
    wrapped = content.explicit(0)
    content.finish()
    if name == _DATA:
        value = _Value(wrapped.octet_string())
    elif name == _ENCRYPTED_DATA:
        encrypted = wrapped.sequence()
        if encrypted.integer() != 0:
            raise InvalidEncoding("the version of encrypted contents is not 0")
        info = encrypted.sequence()
        encrypted.finish()
        if info.oid() != _DATA:
            raise InvalidEncoding("what is encrypted is not data")
        decryption = read_pbes2(info.sequence(), "the content")
        value = _Value(info.implicit(0), *decryption)
        info.finish()
    else:
        raise InvalidEncoding(f"contents of the kind {name}")
    wrapped.finish()
    return value


def _read_bag(bag: der.Reader) -> _Bag:
    kind = bag.oid()
    wrapped = bag.explicit(0)
    value = wrapped.raw()
    wrapped.finish()
    name = None if bag.at_end() else _read_name(bag.set_of())
    bag.finish()
    if kind == _CERT_BAG:
        members = der.only_sequence(value)
        if members.oid() != _X509_CERTIFICATE:
            raise InvalidEncoding("a certificate that is not X.509")
        inner = members.explicit(0)
        members.finish()
        value = inner.octet_string()
        inner.finish()
    elif kind == _SHROUDED_KEY_BAG:
        members = der.only_sequence(value)
        decryption = read_pbes2(members.sequence(), "the key")
        sealed = members.octet_string()
        members.finish()
        return _Bag(kind, _Value(sealed, *decryption), name)
    elif kind != _KEY_BAG:
        raise InvalidEncoding(f"a bag of the kind {kind}")
    return _Bag(kind, _Value(value), name)


def _read_name(attributes: der.Reader) -> str | None:
    """The friendlyName, if there is one; the other attributes say nothing that we use."""
    name = None
    while not attributes.at_end():
        attribute = attributes.sequence()
        kind = attribute.oid()
        values = attribute.set_of()
        attribute.finish()
        if kind == _FRIENDLY_NAME:
            try:
                name = values.value(der.BMP_STRING).decode("utf-16-be")
            except UnicodeDecodeError:
                raise InvalidEncoding("a name is not a BMPString") from None
            values.finish()
        while not values.at_end():
            values.checked()
    return name


# --- writing ---


def _content(kind: str, value: bytes) -> bytes:
    return der.sequence(der.oid(kind), der.explicit(0, value))


def _attribute(kind: str, value: bytes) -> bytes:
    return der.sequence(der.oid(kind), der.set_of(value))


def _name(text: str) -> bytes:
    require_type(text, str, "the name of an entry")
    try:
        return text.encode("utf-16-be")
    except UnicodeEncodeError:
        raise InvalidOption("the name of an entry has a character that is none (a lone surrogate)") from None


def _bag(kind: str, value: bytes, attributes: list[bytes]) -> bytes:
    return der.sequence(der.oid(kind), der.explicit(0, value), *([der.set_of(*attributes)] if attributes else []))


def _certificate_bag(certificate: Certificate, attributes: list[bytes]) -> bytes:
    value = der.sequence(der.oid(_X509_CERTIFICATE), der.explicit(0, der.octet_string(certificate.to_der())))
    return _bag(_CERT_BAG, value, attributes)

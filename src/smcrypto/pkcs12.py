"""PKCS#12 files with SM2 keys: RFC 7292; PBES2 inside, RFC 8018.

What is written: certificates and keys encrypted by SM4-CBC or AES-256-CBC under PBKDF2, the whole under HMAC-SM3 or
HMAC-SHA-256 with the key derivation of RFC 7292, B.2. What is read: everything that key files may be encrypted with
(see `sm2.keyfiles`), 3DES under the key derivation of PKCS#12 itself (RFC 7292, C), and the MAC with SM3, SHA-1 or
SHA-2; the frame in DER or BER (see `ber`). Certificates of other algorithms are kept, keys of others passed over.

The MAC comes first: nothing inside is parsed before it holds. Who makes a file knows its password, so the work that all
its parts together ask for is bounded. Not here: files without a MAC, signed ones, encryption by RC2 and RC4, secret and
revocation list bags.
"""

from __future__ import annotations

import hashlib
import secrets
from collections.abc import Callable, Iterable, Sequence
from hmac import compare_digest
from hmac import new as hmac_new
from typing import Final, Literal, NamedTuple, TypeAlias

from smcrypto import ber, cbc, der, sm2, sm3
from smcrypto.errors import InvalidEncoding, InvalidKey, InvalidOption, InvalidPadding
from smcrypto.inputs import BytesLike, as_bytes, require_int, require_type
from smcrypto.sm2 import keyfiles
from smcrypto.x509 import AnyCertificate, Certificate, load_der_certificate

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
_CIPHERS: Final = {"sm4": cbc.SM4, "aes256": cbc.AES256}
_MACS: Final = {"sm3": _SM3, "sha256": "2.16.840.1.101.3.4.2.1"}
_WEAK: Final = {f"1.2.840.113549.1.12.1.{i}": name for i, name in ((1, "RC4"), (2, "RC4"), (5, "RC2"), (6, "RC2"))}
# RFC 7292, C: 3DES with three keys and with two, by the bytes of their keys.
_PBE: Final = {"1.2.840.113549.1.12.1.3": 24, "1.2.840.113549.1.12.1.4": 16}
_KEY, _IV, _MAC_KEY = 1, 2, 3  # the IDs of RFC 7292, B.3
_WRONG: Final = "the password is wrong, or the file is damaged"


_Hash: TypeAlias = Callable[[bytes], bytes]


class Entry(NamedTuple):
    """A private key, its certificate if that is in the file, and the name that the file gives to the key."""

    key: sm2.PrivateKey
    certificate: Certificate | None = None
    name: str | None = None


class Contents(NamedTuple):
    """What a file holds: keys with their certificates, and all other certificates, in the order of the file."""

    entries: tuple[Entry, ...]
    others: tuple[AnyCertificate, ...]


def dump(
    entries: Iterable[Entry],
    password: BytesLike,
    *,
    others: Iterable[AnyCertificate] = (),
    cipher: Literal["sm4", "aes256"] = "sm4",
    prf: keyfiles.Prf = "sm3",
    mac: keyfiles.Prf = "sm3",
    iterations: int = keyfiles.ITERATIONS,
) -> bytes:
    """A PKCS#12 file in DER.

    entries: keys with certificates; two for the signing and the encryption pair of TLCP. others: the chain.
    password: UTF-8, not empty. cipher: SM4-CBC or AES-256-CBC. prf, mac: the hash of PBKDF2 and of the MAC. OpenSSL 3.0
    wants prf="sha256", Java cipher="aes256", prf="sha256", mac="sha256". iterations: of PBKDF2 and of the MAC.
    InvalidOption: a password that is empty or not UTF-8, no entry, an unknown cipher, prf or mac, iterations out of
    range (1,000,000; 10,000,000 for all keys together). InvalidKey: a certificate that is not of the key beside it.
    MissingDependency: AES, without the package `cryptography`.

    >>> key = sm2.PrivateKey.generate()
    >>> load(dump([Entry(key, name="robot")], b"password", iterations=1000), b"password").entries[0].name
    'robot'
    """
    secret, listed, chain = as_bytes(password, "password"), tuple(entries), tuple(others)
    if not listed:
        raise InvalidOption("there is no key to write")
    if cipher not in _CIPHERS or mac not in _MACS:
        raise InvalidOption(f"cipher must be 'sm4' or 'aes256', mac 'sm3' or 'sha256', not {cipher!r} and {mac!r}")
    if not 1 <= require_int(iterations, "iterations") <= keyfiles.MAX_PURE_ITERATIONS:
        raise InvalidOption(f"iterations must be between 1 and {keyfiles.MAX_PURE_ITERATIONS}, not {iterations}")
    if iterations * (len(listed) + 1) > keyfiles.MAX_ITERATIONS:
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
        algorithm, ciphertext = keyfiles.write_pbes2(entry.key.to_der(), secret, prf, iterations, _CIPHERS[cipher])
        sealed = der.sequence(algorithm, der.octet_string(ciphertext))
        key_bags.append(_tagged(_SHROUDED_KEY_BAG, sealed, attributes))
        if entry.certificate is not None:
            require_type(entry.certificate, Certificate, "the certificate of an entry")
            if entry.certificate.public_key != entry.key.public_key:
                raise InvalidKey("the certificate of an entry is not of its key")
            certificate_bags.append(_certificate_bag(entry.certificate, attributes))
    for certificate in chain:
        require_type(certificate, AnyCertificate, "each of others")
        certificate_bags.append(_certificate_bag(certificate, []))
    parts = [_tagged(_DATA, der.octet_string(der.sequence(*key_bags)))]
    if certificate_bags:
        listing = der.sequence(*certificate_bags)
        algorithm, ciphertext = keyfiles.write_pbes2(listing, secret, prf, iterations, _CIPHERS[cipher])
        inner = der.sequence(der.oid(_DATA), algorithm, der.implicit(0, ciphertext))
        parts.insert(0, _tagged(_ENCRYPTED_DATA, der.sequence(der.integer(0), inner)))
    safe, salt = der.sequence(*parts), secrets.token_bytes(16)
    tag = _mac(_MACS[mac], wide, salt, iterations, safe)
    integrity = der.sequence(
        der.sequence(der.algorithm(_MACS[mac]), der.octet_string(tag)),
        der.octet_string(salt),
        der.integer(iterations) if iterations != 1 else b"",  # a default is left out
    )
    return der.sequence(der.integer(3), _tagged(_DATA, der.octet_string(safe)), integrity)


def load(data: BytesLike, password: BytesLike) -> Contents:
    """What a PKCS#12 file holds. Keys of other algorithms are passed over, their certificates are among the others.

    InvalidKey: not such a file, the wrong password, an encryption that is not supported, more work than 10,000,000
    iterations in all, no key of SM2 among keys of others. MissingDependency: its cipher needs a package.
    CertificateError: a certificate in it that is not well formed.
    """
    octets, secret = as_bytes(data, "data"), as_bytes(password, "password")
    certificates: list[AnyCertificate] = []
    keys: list[tuple[sm2.PrivateKey, str | None]] = []
    foreign: InvalidKey | None = None
    try:
        contents = _members(_authenticated(octets, secret), _read_content)
        _require_bounded(contents)
        # Levels 0 to 2 are the frame; keys and certificates, below them, are DER.
        bags = [bag for content in contents for bag in _members(content.opened(secret), _read_bag, below=3)]
        _require_bounded([*contents, *bags])
        for bag in bags:
            value = bag.opened(secret)
            if bag.kind == _CERT_BAG:
                certificates.append(load_der_certificate(value))
                continue
            try:
                keys.append((sm2.PrivateKey.from_der(value), bag.name))
            except InvalidKey as error:
                if not isinstance(error.__cause__, keyfiles.ForeignKey):
                    raise
                foreign = error
    except InvalidPadding:
        raise InvalidKey(_WRONG) from None
    except InvalidEncoding as error:
        raise InvalidKey(f"not a PKCS#12 file: {error}") from None
    if foreign is not None and not keys:
        raise foreign
    of_key: dict[sm2.PublicKey, list[Certificate]] = {}
    for certificate in reversed(certificates):
        if isinstance(certificate, Certificate):
            of_key.setdefault(certificate.public_key, []).append(certificate)
    entries = tuple(Entry(key, own.pop() if (own := of_key.get(key.public_key)) else None, name) for key, name in keys)
    used = {id(entry.certificate) for entry in entries}
    return Contents(entries, tuple(c for c in certificates if id(c) not in used))


# --- the integrity of the whole ---


def _authenticated(data: bytes, password: bytes) -> bytes:
    """The AuthenticatedSafe of a PFX, RFC 7292, 4, after its MAC was found right."""
    with der.reading_sequence(ber.to_der(data)) as pfx:
        if pfx.integer() != 3:
            raise InvalidEncoding("the version is not 3")
        content = pfx.sequence()
        if content.oid() != _DATA:
            raise InvalidEncoding("the file is signed, not authenticated by a password")
        safe = content.explicit(0).octet_string()
        if pfx.at_end():
            raise InvalidEncoding("the file has no MAC, so nothing shows that it is whole")
        mac = pfx.sequence()
        digest = mac.sequence()
        name = digest.algorithm(_HASHES, "MAC")
        expected = digest.octet_string()
        salt = mac.octet_string()
        iterations = 1 if mac.at_end() else mac.integer()
    if not 1 <= iterations <= keyfiles.MAX_PURE_ITERATIONS:
        raise InvalidKey(f"the file asks for {iterations} iterations; the limit is {keyfiles.MAX_PURE_ITERATIONS}")
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
    key = _derive(digest, block, password, salt, iterations, _MAC_KEY, len(digest(b"")))
    return sm3.hmac(key, data) if name == "sm3" else hmac_new(key, data, name).digest()


def _hashlib(name: str) -> _Hash:
    return lambda data: hashlib.new(name, data).digest()


def _derive(digest: _Hash, v: int, P: bytes, S: bytes, r: int, ID: int, n: int) -> bytes:
    """`n` bytes for the purpose `ID`: RFC 7292, B.2."""

    def filled(text: bytes) -> bytes:
        size = v * -(-len(text) // v)
        return (text * (size // max(len(text), 1) + 1))[:size]

    D, I, derived = bytes([ID]) * v, filled(S) + filled(P), b""
    while True:
        A = digest(D + I)
        for _ in range(r - 1):
            A = digest(A)
        derived += A
        if len(derived) >= n:
            return derived[:n]
        B = int.from_bytes((A * v)[:v], "big") + 1
        I = b"".join(((int.from_bytes(I[j : j + v], "big") + B) % (1 << 8 * v)).to_bytes(v, "big")
                     for j in range(0, len(I), v))  # fmt: skip


# --- reading what is inside ---


class _Value(NamedTuple):
    """ContentInfo or SafeBag; what makes plaintext of its bytes, where they are encrypted; that work in iterations."""

    kind: str
    octets: bytes
    decrypt: Callable[[bytes, bytes], bytes] | None = None
    work: int = 0
    name: str | None = None

    def opened(self, password: bytes) -> bytes:
        return self.octets if self.decrypt is None else self.decrypt(password, self.octets)


def _members(data: bytes, read: Callable[[der.Reader], _Value], below: int = ber.MAX_DEPTH) -> list[_Value]:
    """What `read` makes of each sequence in a SEQUENCE OF; DER `below` that level."""
    with der.reading_sequence(ber.to_der(data, below)) as outer:
        return outer.each(lambda one: read(one.sequence()))


def _require_bounded(values: Iterable[_Value]) -> None:
    if (work := sum(value.work for value in values)) > keyfiles.MAX_ITERATIONS:
        raise InvalidKey(f"the file asks for {work} iterations in all; the limit is {keyfiles.MAX_ITERATIONS}")


def _read_content(content: der.Reader) -> _Value:
    """One ContentInfo of the AuthenticatedSafe: SafeContents, plain or encrypted."""
    name = content.oid()
    wrapped = content.explicit(0)
    if name == _DATA:
        return _Value(name, wrapped.octet_string())
    if name == _ENCRYPTED_DATA:
        encrypted = wrapped.sequence()
        if encrypted.integer() != 0:
            raise InvalidEncoding("the version of encrypted contents is not 0")
        info = encrypted.sequence()
        if info.oid() != _DATA:
            raise InvalidEncoding("what is encrypted is not data")
        decryption = _read_encryption(info.raw(), "the content")
        return _Value(name, ber.octets(info.explicit(0)) if info.has_explicit(0) else info.implicit(0), *decryption)
    raise InvalidEncoding(f"contents of the kind {name}")


def _read_encryption(scheme: bytes, what: str) -> tuple[Callable[[bytes, bytes], bytes], int]:
    """As `read_pbes2`, and RFC 7292, C: the decryption of (password, ciphertext), and its work in iterations."""
    with der.reading_sequence(scheme) as algorithm:
        name = algorithm.oid()
        if name in _WEAK:
            raise InvalidEncoding(f"{what} is encrypted by {_WEAK[name]}; `openssl pkcs12 -legacy` reads that")
        if name not in _PBE:
            algorithm.rest()
            return der.parse(scheme, lambda whole: keyfiles.read_pbes2(whole.sequence(), what))
        parameters = algorithm.sequence()
        salt, iterations = parameters.octet_string(), parameters.integer()
    if iterations < 1:
        raise InvalidEncoding("a key is derived in no iteration")

    def decrypt(password: bytes, ciphertext: bytes) -> bytes:
        def derive(ID: int, n: int) -> bytes:
            return _derive(_hashlib("sha1"), 64, _bmp(password), salt, iterations, ID, n)

        key, cipher = derive(_KEY, _PBE[name]), cbc.TRIPLE_DES
        return cipher.unpadded(cipher.decrypt((key + key)[:24], derive(_IV, 8), ciphertext))

    return decrypt, 3 * iterations


def _read_bag(bag: der.Reader) -> _Value:
    kind = bag.oid()
    value = bag.explicit(0).raw()
    name = None if bag.at_end() else _read_name(bag.set_of())
    if kind == _CERT_BAG:
        with der.reading_sequence(value) as members:
            if members.oid() != _X509_CERTIFICATE:
                raise InvalidEncoding("a certificate that is not X.509")
            value = members.explicit(0).octet_string()
    elif kind == _SHROUDED_KEY_BAG:
        with der.reading_sequence(value) as members:
            decryption = _read_encryption(members.raw(), "the key")
            return _Value(kind, members.octet_string(), *decryption, name)
    elif kind != _KEY_BAG:
        raise InvalidEncoding(f"a bag of the kind {kind}")
    return _Value(kind, value, name=name)


def _read_name(attributes: der.Reader) -> str | None:
    """The friendlyName, if there is one; the other attributes say nothing that we use."""
    name = None
    while not attributes.at_end():
        attribute = attributes.sequence()
        kind = attribute.oid()
        values = attribute.set_of()
        if kind != _FRIENDLY_NAME:
            values.rest()
            continue
        try:
            name = values.value(der.BMP_STRING).decode("utf-16-be")
        except UnicodeDecodeError:
            raise InvalidEncoding("a name is not a BMPString") from None
    return name


# --- writing ---


def _attribute(kind: str, value: bytes) -> bytes:
    return der.sequence(der.oid(kind), der.set_of(value))


def _name(text: str) -> bytes:
    require_type(text, str, "the name of an entry")
    try:
        return text.encode("utf-16-be")
    except UnicodeEncodeError:
        raise InvalidOption("the name of an entry has a character that is none (a lone surrogate)") from None


def _tagged(kind: str, value: bytes, attributes: Sequence[bytes] = ()) -> bytes:
    """A ContentInfo, or a SafeBag with its attributes."""
    return der.sequence(der.oid(kind), der.explicit(0, value), der.set_of(*attributes) if attributes else b"")


def _certificate_bag(certificate: AnyCertificate, attributes: list[bytes]) -> bytes:
    value = der.sequence(der.oid(_X509_CERTIFICATE), der.explicit(0, der.octet_string(certificate.to_der())))
    return _tagged(_CERT_BAG, value, attributes)

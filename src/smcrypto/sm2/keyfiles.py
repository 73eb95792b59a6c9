"""SM2 keys as files: PKCS#8 (RFC 5958), SEC1 (RFC 5915), SubjectPublicKeyInfo (RFC 5480), PBES2 (RFC 8018).

An algorithm identifier names SM2 in one of three ways, all in use: id-ecPublicKey
with the named curve sm2p256v1, id-ecPublicKey with explicit parameters that
equal that curve's, or the curve's own identifier in the algorithm's place.
Whatever else is found is refused, as is a public key that does not belong to
the private key beside it.

Encrypted keys are written as GmSSL writes them, SM4-CBC under
PBKDF2-HMAC-SM3; read are also AES and 3DES, under PBKDF2 with the other common
hashes and under scrypt. How much work a file can ask for is bounded.

Not here: PBES1, PKCS#12 (pkcs12), OpenSSL's "Proc-Type" encryption, curves other than sm2p256v1.
"""

from __future__ import annotations

import contextlib
import hashlib
import hmac
import secrets
from collections.abc import Callable
from typing import Final, Literal, TypeAlias

from smcrypto import cbc, der, kdf, pem, sm3
from smcrypto.errors import InvalidEncoding, InvalidKey, InvalidOption, InvalidPadding, MissingDependency
from smcrypto.inputs import BytesLike, as_bytes
from smcrypto.sm2.curve import SM2P256V1, encode_point
from smcrypto.sm2.keys import Format, Prf, PrivateKey, PublicKey

__all__ = [
    "ITERATIONS", "MAX_ITERATIONS", "MAX_PURE_ITERATIONS", "MAX_SCRYPT_BLOCKS", "MAX_SCRYPT_MEMORY", "ForeignKey",
    "NotOpened", "Prf", "dump_private", "dump_public", "load_private", "load_public", "read_pbes2", "standard_point",
    "write_pbes2",
]  # fmt: skip

Form = Literal["pem", "der"]

ITERATIONS: Final = 100_000
"""PBKDF2 iterations of the keys we write (OpenSSL 3.0 writes 2,048, GmSSL 65,536)."""
MAX_ITERATIONS: Final = 10_000_000
"""The most PBKDF2 iterations a key file may ask for: seconds with OpenSSL's hashes."""
MAX_PURE_ITERATIONS: Final = 1_000_000
"""The most where they are of SM3 and `sm3.ENGINE` is "python", 0.11 ms each: two minutes."""
MAX_SCRYPT_MEMORY: Final = 256 << 20
"""The most memory, 128 * N * r bytes and 128 * p * r beside them, that scrypt may ask for."""
MAX_SCRYPT_BLOCKS: Final = 1 << 23
"""The most work, N * r * p blocks, that scrypt may ask for."""

_EC_PUBLIC_KEY: Final = "1.2.840.10045.2.1"  # RFC 5480, 2.1.1
_PRIME_FIELD: Final = "1.2.840.10045.1.1"  # RFC 3279, 2.3.5
_SM2: Final = "1.2.156.10197.1.301"  # GM/T 0006: sm2p256v1, also SM2 as an algorithm
_PBES2: Final = "1.2.840.113549.1.5.13"  # RFC 8018, A.4
_PBKDF2: Final = "1.2.840.113549.1.5.12"  # RFC 8018, A.2
_SCRYPT: Final = "1.3.6.1.4.1.11591.4.11"  # RFC 7914, 7
_HMAC_SHA256: Final = "1.2.840.113549.2.9"
_HMAC_SM3: Final = "1.2.156.10197.1.401.2"

# Pseudorandom functions of PBKDF2, RFC 8018, B.1.2, but for the default, HMAC-SHA-1, which is never spelt out in DER.
# GM/T 0091 gives HMAC-SM3 two identifiers: annex C the one above, which GmSSL uses, annex A the one ending in 401.3.1,
# which OpenSSL has used since it has one.
_PRFS: Final = {
    "1.2.840.113549.2.8": "sha224",
    _HMAC_SHA256: "sha256",
    "1.2.840.113549.2.10": "sha384",
    "1.2.840.113549.2.11": "sha512",
    _HMAC_SM3: "sm3",
    "1.2.156.10197.1.401.3.1": "sm3",
}
_ALGORITHM: Final = der.sequence(der.oid(_EC_PUBLIC_KEY), der.oid(_SM2))  # as it is written
_PKCS8_LABEL: Final = "PRIVATE KEY"
_ENCRYPTED_LABEL: Final = "ENCRYPTED PRIVATE KEY"
_SEC1_LABELS: Final = ("EC PRIVATE KEY", "SM2 PRIVATE KEY")
_PRIVATE_LABELS: Final = (_PKCS8_LABEL, _ENCRYPTED_LABEL, *_SEC1_LABELS)
_PARAMETERS_LABEL: Final = "EC PARAMETERS"
_PUBLIC_LABEL: Final = "PUBLIC KEY"


# --- reading ---


class ForeignKey(InvalidEncoding):
    """The key is of another algorithm or curve than SM2's."""


class NotOpened(InvalidEncoding):
    """The password is missing, wrong or superfluous, or the encryption is one that is not read here."""


def load_private(data: BytesLike, password: BytesLike | None, *, form: Form) -> PrivateKey:
    """The private key in `data`: in a PEM file the first one of SM2 that can be read with this password.

    Keys of other algorithms are passed over there, and encrypted ones that the password does not open.
    InvalidKey: malformed, of another curve, contradicting its public key,
    encrypted and no or the wrong password given, or not encrypted and one given. Its cause, if that is a ForeignKey
    or NotOpened, tells those from what is malformed.
    """
    octets, secret = as_bytes(data, "data"), None if password is None else as_bytes(password, "password")
    try:
        return _private_from_pem(octets, secret) if form == "pem" else _private_from_der(octets, secret)
    except NotOpened as error:
        raise InvalidKey(str(error)) from error
    except InvalidEncoding as error:
        raise InvalidKey(f"not an SM2 private key: {error}") from error


def load_public(data: BytesLike, *, form: Form) -> PublicKey:
    """The key of a SubjectPublicKeyInfo: in a PEM file the first one of SM2. InvalidKey for anything else."""
    octets = as_bytes(data, "data")
    try:
        if form == "der":
            return _read_public(octets)
        passed_over = InvalidEncoding(f"no PEM block labelled {_PUBLIC_LABEL}")
        for block in pem.decode(octets, [_PUBLIC_LABEL]):
            try:
                return _read_public(block.der)
            except ForeignKey as error:
                passed_over = error
        raise passed_over
    except InvalidEncoding as error:
        raise InvalidKey(f"not an SM2 public key: {error}") from error


def _read_public(data: bytes) -> PublicKey:
    with der.reading_sequence(data) as info:
        _read_algorithm(info)
        return PublicKey.from_bytes(info.bit_string())


def _private_from_pem(data: bytes, password: bytes | None) -> PrivateKey:
    parameters: bytes | None = None
    passed_over: Exception = InvalidEncoding(f"no PEM block labelled {' or '.join(_PRIVATE_LABELS)}")
    work = 0
    for label, lines in tuple(pem.armoured(data, [_PARAMETERS_LABEL, *_PRIVATE_LABELS])):  # to the end of the file
        try:
            content = pem.unarmoured(lines)
            if label == _PARAMETERS_LABEL:
                parameters = content
            elif label == _ENCRYPTED_LABEL:
                opened, cost = _read_encrypted(content)
                if (work := work + cost) > MAX_ITERATIONS:
                    raise InvalidKey(f"the keys ask for {work} iterations in all; the limit is {MAX_ITERATIONS}")
                return opened(password)
            elif label == _PKCS8_LABEL:
                return _unencrypted(_read_pkcs8(content), password)
            else:
                before, parameters = parameters, None
                if before is not None:
                    der.parse(before, _read_curve)
                curve_known = before is not None or label != "EC PRIVATE KEY"
                return _unencrypted(_read_sec1(content, curve_known=curve_known), password)
        except (ForeignKey, NotOpened, pem.EncryptedBlock, MissingDependency) as error:
            if not isinstance(passed_over, NotOpened):
                passed_over = error
    raise passed_over


def _private_from_der(data: bytes, password: bytes | None) -> PrivateKey:
    """The three structures differ in the tags of their first two members."""
    with der.reading_sequence(data) as members:
        tags = [value[0] for value in members.rest()]
    if tags[:1] == [der.SEQUENCE]:
        return _read_encrypted(data)[0](password)
    key = _read_pkcs8(data) if tags[1:2] == [der.SEQUENCE] else _read_sec1(data, curve_known=False)
    return _unencrypted(key, password)


def _unencrypted(key: PrivateKey, password: bytes | None) -> PrivateKey:
    if password is not None:
        raise NotOpened("a password was given, but the private key is not encrypted")
    return key


def _read_pkcs8(data: bytes) -> PrivateKey:
    """OneAsymmetricKey, RFC 5958, 2; version 0 is the PrivateKeyInfo of RFC 5208."""
    with der.reading_sequence(data) as info:
        version = info.integer()
        if version not in (0, 1):
            raise InvalidEncoding(f"PKCS#8 version {version}")
        _read_algorithm(info)
        key = _read_sec1(info.octet_string(), curve_known=True)
        if info.has_explicit(0):
            # They say nothing about the key, but must be attributes: a type and a set of values.
            attributes = info.implicit_set_of(0)
            while not attributes.at_end():
                attribute = attributes.sequence()
                attribute.oid()
                attribute.set_of().rest()
        if info.has_implicit(1):
            if version == 0:
                raise InvalidEncoding("a public key needs PKCS#8 version 1")
            point = info.implicit(1)
            if point[:1] != b"\0":
                raise InvalidEncoding("public key is not a whole number of bytes")
            _require_pair(key, point[1:])
    return key


def _read_sec1(data: bytes, *, curve_known: bool) -> PrivateKey:
    """ECPrivateKey, RFC 5915, 3.

    The parameters may be missing where something else says that the curve is
    SM2's: what surrounds the key, or its public key, which fits one curve only.
    """
    with der.reading_sequence(data) as members:
        version = members.integer()
        if version != 1:
            raise InvalidEncoding(f"ECPrivateKey version {version}")
        octets = members.octet_string()
        if members.has_explicit(0):
            _read_curve(members.explicit(0))
            curve_known = True
        key = PrivateKey.from_bytes(octets)
        if members.has_explicit(1):
            _require_pair(key, members.explicit(1).bit_string())
            curve_known = True
    if not curve_known:
        raise InvalidEncoding("nothing says which curve the private key is of")
    return key


def _require_pair(key: PrivateKey, point: bytes) -> None:
    """Does the public key, compressed or not, belong to `key`?"""
    if key.public_key.to_bytes(compressed=len(point) == 33) != point:
        raise InvalidEncoding("the public key inside is of another key, or its point does not begin with 04, 02 or 03")


def _read_algorithm(reader: der.Reader) -> None:
    """AlgorithmIdentifier of an SM2 key, in one of the three ways of the module's docstring."""
    algorithm = reader.sequence()
    name = algorithm.oid()
    if name == _EC_PUBLIC_KEY:
        _read_curve(algorithm)
    elif name != _SM2:
        raise ForeignKey(f"the key's algorithm is {name}, not SM2")
    elif algorithm.peek_tag() == der.NULL:
        algorithm.null()
    elif not algorithm.at_end():
        _read_curve(algorithm)


def _read_curve(reader: der.Reader) -> None:
    """ECParameters, RFC 3279, 2.3.5: the name of sm2p256v1, or its parameters in full."""
    if reader.peek_tag() == der.OID:
        name = reader.oid()
        if name != _SM2:
            raise ForeignKey(f"the key's curve is {name}, not sm2p256v1")
    elif reader.checked() not in _explicit_parameters():
        raise ForeignKey("the key's explicit curve parameters are not those of sm2p256v1")


def _explicit_parameters() -> frozenset[bytes]:
    """Every DER form of sm2p256v1's parameters: G compressed or not, the cofactor there or not, no seed."""
    curve = SM2P256V1
    fixed = (
        der.integer(1),
        der.sequence(der.oid(_PRIME_FIELD), der.integer(curve.p)),
        der.sequence(*(der.octet_string(x.to_bytes(32, "big")) for x in (curve.a, curve.b))),
    )
    return frozenset(
        der.sequence(*fixed, der.octet_string(encode_point(curve.G, curve, compressed=compressed)),
                     der.integer(curve.n), *cofactor)
        for compressed in (False, True)
        for cofactor in ((), (der.integer(1),))
    )  # fmt: skip


# --- reading encrypted keys: PBES2, RFC 8018, 6.2 ---


def _read_encrypted(data: bytes) -> tuple[Callable[[bytes | None], PrivateKey], int]:
    """What makes a key of an EncryptedPrivateKeyInfo (RFC 5958, 3) and a password, and its work."""
    with der.reading_sequence(data) as info:
        decrypt, work = read_pbes2(info.sequence(), "the key")
        ciphertext = info.octet_string()

    def opened(password: bytes | None) -> PrivateKey:
        if password is None:
            raise NotOpened("the private key is encrypted; a password is needed")
        try:
            return _read_pkcs8(decrypt(password, ciphertext))
        except (InvalidEncoding, InvalidKey, InvalidPadding):
            # One undetailed failure: how a decryption went wrong says something about the plaintext.
            raise NotOpened("the password is wrong, or the key file is damaged") from None

    return opened, work


def read_pbes2(scheme: der.Reader, what: str) -> tuple[Callable[[bytes, bytes], bytes], int]:
    """The decryption, of (password, ciphertext), of a PBES2 AlgorithmIdentifier (RFC 8018, A.4), and its work.

    The work is PBKDF2's iterations or scrypt's N * r * p, which take about as long. The decryption raises
    InvalidPadding where the password is wrong, most of the time. InvalidEncoding: an algorithm that is not supported;
    InvalidKey: one that asks for too much work.
    """
    name = scheme.oid()
    if name != _PBES2:
        raise NotOpened(f"{what} is encrypted by {name}; PBES2 is what is supported")
    parameters = scheme.sequence()
    derivation = parameters.sequence()
    name = derivation.oid()
    if name not in (_PBKDF2, _SCRYPT):
        raise NotOpened(f"the key derivation {name} is not supported")
    read = _read_pbkdf2 if name == _PBKDF2 else _read_scrypt
    derive, work, declared = read(derivation.sequence())
    try:
        cipher, iv = cbc.read_algorithm(parameters.sequence(), what)
    except cbc.UnknownCipher as error:
        raise NotOpened(str(error)) from None
    key_length = cipher.key_length
    if declared not in (None, key_length):
        raise InvalidEncoding(f"a key of {declared} bytes is derived for a cipher that takes {key_length}")
    return lambda password, ciphertext: cipher.unpadded(
        cipher.decrypt(derive(password, key_length), iv, ciphertext)
    ), work


# What derives a key from (password, its length), the work, and the key's length where the file says it.
_Derivation: TypeAlias = "tuple[Callable[[bytes, int], bytes], int, int | None]"


def _read_key_length(parameters: der.Reader) -> int | None:
    return parameters.integer() if parameters.peek_tag() == der.INTEGER else None


def _read_pbkdf2(parameters: der.Reader) -> _Derivation:
    """PBKDF2-params, RFC 8018, A.2."""
    salt, iterations = parameters.octet_string(), parameters.integer()
    if not 1 <= iterations <= MAX_ITERATIONS:
        raise InvalidKey(f"the key file asks for {iterations} PBKDF2 iterations; the limit is {MAX_ITERATIONS}")
    declared = _read_key_length(parameters)
    hash_name = "sha1"
    if not parameters.at_end():
        function = parameters.sequence()
        name = function.oid()
        if name not in _PRFS:
            raise NotOpened(f"the pseudorandom function {name} is not supported")
        hash_name = _PRFS[name]
        if not function.at_end():
            function.null()
    if hash_name == "sm3" and sm3.ENGINE == "python" and iterations > MAX_PURE_ITERATIONS:
        raise InvalidKey(
            f"the key file asks for {iterations} PBKDF2 iterations of SM3; without OpenSSL's SM3 the limit is"
            f" {MAX_PURE_ITERATIONS}"
        )
    return lambda password, length: _pbkdf2(hash_name, password, salt, iterations, length), iterations, declared


def _pbkdf2(hash_name: str, P: bytes, S: bytes, c: int, dkLen: int) -> bytes:
    """PBKDF2 (names: RFC 8018, 5.2); hashlib has it, for other hashes than ours, only where Python has OpenSSL."""
    if hash_name == "sm3":
        return kdf.pbkdf2_hmac(P, S, c, dkLen)
    with contextlib.suppress(AttributeError):
        return hashlib.pbkdf2_hmac(hash_name, P, S, c, dkLen)
    keyed = hmac.new(P, digestmod=hash_name)
    output = b""
    for i in range(1, -(-dkLen // keyed.digest_size) + 1):
        U, T = S + i.to_bytes(4, "big"), 0
        for _ in range(c):
            mac = keyed.copy()
            mac.update(U)
            U = mac.digest()
            T ^= int.from_bytes(U, "big")
        output += T.to_bytes(keyed.digest_size, "big")
    return output[:dkLen]


def _read_scrypt(parameters: der.Reader) -> _Derivation:
    """scrypt-params, RFC 7914, 7: the salt, N, r, p."""
    salt, N, r, p = parameters.octet_string(), parameters.integer(), parameters.integer(), parameters.integer()
    declared = _read_key_length(parameters)
    if N < 2 or N & (N - 1) or r < 1 or p < 1 or N >> 16 * r:
        raise InvalidEncoding("scrypt's N must be a power of two above 1 and below 2^(16*r), its r and p positive")
    if 128 * max(N, p) * r > MAX_SCRYPT_MEMORY or N * r * p > MAX_SCRYPT_BLOCKS:
        raise InvalidKey(
            f"the key file asks for scrypt with N*r = {N * r}, p = {p}; the limits are {MAX_SCRYPT_MEMORY} bytes"
            f" of memory (128*N*r, 128*p*r) and N*r*p = {MAX_SCRYPT_BLOCKS}"
        )
    if not hasattr(hashlib, "scrypt"):
        raise MissingDependency("the private key is encrypted under scrypt; reading it needs a Python with OpenSSL")
    # OpenSSL counts 32 * (N + p + 2) * 4 * r bytes and small change against maxmem.
    memory = 128 * r * (N + p + 2) + (1 << 16)

    def derive(password: bytes, length: int) -> bytes:
        return hashlib.scrypt(password, salt=salt, n=N, r=r, p=p, maxmem=memory, dklen=length)

    return derive, N * r * p, declared


# --- writing ---


def dump_private(
    key: PrivateKey, password: BytesLike | None, format: Format, *, form: Form, prf: Prf = "sm3",
    iterations: int = ITERATIONS,
) -> bytes:  # fmt: skip
    """The key pair as PKCS#8, encrypted if a password is given, or as SEC1.

    prf, iterations: of PBKDF2. `"sha256"` is for OpenSSL 3.0 and 3.1, which know no HMAC-SM3 here.
    InvalidOption for an unknown format, and a password with "sec1".
    """
    point = standard_point(key.public_key)
    secret = None if password is None else as_bytes(password, "password")
    if format not in ("pkcs8", "sec1"):
        raise InvalidOption(f"format must be 'pkcs8' or 'sec1', not {format!r}")
    if prf not in ("sm3", "sha256"):
        raise InvalidOption(f"prf must be 'sm3' or 'sha256', not {prf!r}")
    # RFC 5915, 3 wants both optional fields always there, inside PKCS#8 too; GmSSL refuses a key without them.
    sec1 = der.sequence(
        der.integer(1),
        der.octet_string(key.to_bytes()),
        der.explicit(0, der.oid(_SM2)),
        der.explicit(1, der.bit_string(point)),
    )
    if format == "sec1":
        if secret is not None:
            raise InvalidOption("SEC1 private keys are not encrypted; use format='pkcs8' with a password")
        label, data = _SEC1_LABELS[0], sec1
    else:
        label, data = _PKCS8_LABEL, der.sequence(der.integer(0), _ALGORITHM, der.octet_string(sec1))
        if secret is not None:
            algorithm, ciphertext = write_pbes2(data, secret, prf, iterations)
            label, data = _ENCRYPTED_LABEL, der.sequence(algorithm, der.octet_string(ciphertext))
    return pem.encode(label, data) if form == "pem" else data


def dump_public(key: PublicKey, *, form: Form) -> bytes:
    """SubjectPublicKeyInfo with the named curve."""
    data = der.sequence(_ALGORITHM, der.bit_string(standard_point(key)))
    return pem.encode(_PUBLIC_LABEL, data) if form == "pem" else data


def standard_point(key: PublicKey) -> bytes:
    """The point in 65 bytes; InvalidKey for one of another curve, which no structure here can say."""
    if key.curve != SM2P256V1:
        raise InvalidKey("key files hold keys of sm2p256v1 only")
    return key.to_bytes()


def write_pbes2(
    data: bytes, password: bytes, prf: Prf, iterations: int, cipher: cbc.CBC = cbc.SM4
) -> tuple[bytes, bytes]:
    """(AlgorithmIdentifier, ciphertext): PBES2, fresh salt and IV. InvalidOption as of `dump_private`."""
    if not password:
        raise InvalidOption("an empty password protects nothing; leave it out to write the key unencrypted")
    if prf not in ("sm3", "sha256"):
        raise InvalidOption(f"prf must be 'sm3' or 'sha256', not {prf!r}")
    if not 1 <= iterations <= MAX_ITERATIONS:
        raise InvalidOption(f"iterations must be between 1 and {MAX_ITERATIONS}, not {iterations}")
    salt, iv = secrets.token_bytes(16), secrets.token_bytes(16)
    # No NULL after the name of HMAC-SM3: GmSSL refuses one.
    function = der.sequence(der.oid(_HMAC_SM3)) if prf == "sm3" else der.sequence(der.oid(_HMAC_SHA256), der.null())
    derivation = der.sequence(der.oid(_PBKDF2), der.sequence(der.octet_string(salt), der.integer(iterations), function))
    algorithm = der.sequence(der.oid(_PBES2), der.sequence(derivation, cipher.algorithm(iv)))
    return algorithm, cipher.encrypt(_pbkdf2(prf, password, salt, iterations, cipher.key_length), iv, data)

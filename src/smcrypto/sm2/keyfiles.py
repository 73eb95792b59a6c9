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
from functools import partial
from typing import Final, Literal

from smcrypto import der, pem
from smcrypto.errors import InvalidEncoding, InvalidKey, InvalidOption, InvalidPadding, MissingDependency
from smcrypto.sm2.curve import SM2P256V1, encode_point
from smcrypto.sm2.points import base_comb, secret_sum, to_affine_all

__all__ = [
    "ITERATIONS",
    "MAX_ITERATIONS",
    "MAX_PURE_ITERATIONS",
    "MAX_SCRYPT_BLOCKS",
    "MAX_SCRYPT_MEMORY",
    "dump_private",
    "dump_public",
    "load_private",
    "load_public",
    "read_pbes2",
    "write_pbes2",
]

Form = Literal["pem", "der"]
Format = Literal["pkcs8", "sec1"]
Prf = Literal["sm3", "sha256"]

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
_HMAC_SHA1: Final = "1.2.840.113549.2.7"
_HMAC_SM3: Final = "1.2.156.10197.1.401.2"
_SM4_CBC: Final = "1.2.156.10197.1.104.2"

# Pseudorandom functions of PBKDF2, RFC 8018, B.1.2. GM/T 0091 gives HMAC-SM3 two identifiers: annex C the one
# above, which GmSSL uses, annex A the one ending in 401.3.1, which OpenSSL has used since it has one.
_PRFS: Final = {
    _HMAC_SHA1: "sha1",
    "1.2.840.113549.2.8": "sha224",
    "1.2.840.113549.2.9": "sha256",
    "1.2.840.113549.2.10": "sha384",
    "1.2.840.113549.2.11": "sha512",
    _HMAC_SM3: "sm3",
    "1.2.156.10197.1.401.3.1": "sm3",
}
# Block ciphers in CBC mode: name, key bytes, block bytes.
_CIPHERS: Final = {
    _SM4_CBC: ("SM4", 16, 16),
    "2.16.840.1.101.3.4.1.2": ("AES", 16, 16),
    "2.16.840.1.101.3.4.1.22": ("AES", 24, 16),
    "2.16.840.1.101.3.4.1.42": ("AES", 32, 16),
    "1.2.840.113549.3.7": ("TripleDES", 24, 8),
}

_PKCS8_LABEL: Final = "PRIVATE KEY"
_ENCRYPTED_LABEL: Final = "ENCRYPTED PRIVATE KEY"
_SEC1_LABELS: Final = ("EC PRIVATE KEY", "SM2 PRIVATE KEY")
_PRIVATE_LABELS: Final = (_PKCS8_LABEL, _ENCRYPTED_LABEL, *_SEC1_LABELS)
_PARAMETERS_LABEL: Final = "EC PARAMETERS"
_PUBLIC_LABEL: Final = "PUBLIC KEY"


# --- reading ---


def load_private(data: bytes, password: bytes | None, *, form: Form) -> int:
    """d of the first private key in `data`; it is in [0, 2**256), the caller judges its range.

    InvalidKey: malformed, of another curve, contradicting its public key,
    encrypted and no or the wrong password given, or not encrypted and one given.
    """
    try:
        if form == "pem":
            return _private_from_pem(data, password)
        _require_form(form)
        return _private_from_der(data, password)
    except InvalidEncoding as error:
        raise InvalidKey(f"not an SM2 private key: {error}") from None


def load_public(data: bytes, *, form: Form) -> bytes:
    """The SEC1 point of a SubjectPublicKeyInfo, as it stands there; the caller checks that it is on the curve."""
    try:
        if form == "pem":
            data = pem.first(data, [_PUBLIC_LABEL]).der
        else:
            _require_form(form)
        info = der.only_sequence(data)
        _read_algorithm(info)
        point = info.bit_string()
        info.finish()
    except InvalidEncoding as error:
        raise InvalidKey(f"not an SM2 public key: {error}") from None
    return point


def _require_form(form: str) -> None:
    if form not in ("pem", "der"):
        raise InvalidOption(f"form must be 'pem' or 'der', not {form!r}")


def _private_from_pem(data: bytes, password: bytes | None) -> int:
    curve_known = False
    for label, content in pem.decode(data):
        if label == _PARAMETERS_LABEL:
            parameters = der.Reader(content)
            _read_curve(parameters)
            parameters.finish()
            curve_known = True
        elif label == _ENCRYPTED_LABEL:
            return _decrypted(content, password)
        elif label == _PKCS8_LABEL:
            _require_no_password(password)
            return _read_pkcs8(content)
        elif label in _SEC1_LABELS:
            _require_no_password(password)
            return _read_sec1(content, curve_known=curve_known or label != "EC PRIVATE KEY")
    raise InvalidEncoding(f"no PEM block labelled {' or '.join(_PRIVATE_LABELS)}")


def _private_from_der(data: bytes, password: bytes | None) -> int:
    """The three structures differ in the tags of their first two members."""
    members = der.only_sequence(data)
    if members.peek_tag() == der.SEQUENCE:
        return _decrypted(data, password)
    _require_no_password(password)
    members.integer()
    if members.peek_tag() == der.SEQUENCE:
        return _read_pkcs8(data)
    return _read_sec1(data, curve_known=False)


def _require_no_password(password: bytes | None) -> None:
    if password is not None:
        raise InvalidKey("a password was given, but the private key is not encrypted")


def _read_pkcs8(data: bytes) -> int:
    """OneAsymmetricKey, RFC 5958, 2; version 0 is the PrivateKeyInfo of RFC 5208."""
    info = der.only_sequence(data)
    version = info.integer()
    if version not in (0, 1):
        raise InvalidEncoding(f"PKCS#8 version {version}")
    _read_algorithm(info)
    key = info.octet_string()
    if info.has_explicit(0):
        _skip_attributes(info.implicit_set_of(0))
    d = _read_sec1(key, curve_known=True)
    if info.has_implicit(1):
        if version == 0:
            raise InvalidEncoding("a public key needs PKCS#8 version 1")
        point = info.implicit(1)
        if point[:1] != b"\0":
            raise InvalidEncoding("public key is not a whole number of bytes")
        _require_pair(d, point[1:])
    info.finish()
    return d


def _skip_attributes(attributes: der.Reader) -> None:
    """They say nothing about the key (RFC 5958, 2), but must be attributes: a type and a set of values."""
    while not attributes.at_end():
        attribute = attributes.sequence()
        attribute.oid()
        values = attribute.set_of()
        attribute.finish()
        while not values.at_end():
            values.checked()


def _read_sec1(data: bytes, *, curve_known: bool) -> int:
    """ECPrivateKey, RFC 5915, 3.

    The parameters may be missing where something else says that the curve is
    SM2's: what surrounds the key, or its public key, which fits one curve only.
    """
    key = der.only_sequence(data)
    version = key.integer()
    if version != 1:
        raise InvalidEncoding(f"ECPrivateKey version {version}")
    octets = key.octet_string()
    if len(octets) != 32:
        raise InvalidEncoding(f"the private key has {len(octets)} bytes, not 32")
    d = int.from_bytes(octets, "big")
    if key.has_explicit(0):
        parameters = key.explicit(0)
        _read_curve(parameters)
        parameters.finish()
        curve_known = True
    if key.has_explicit(1):
        wrapped = key.explicit(1)
        point = wrapped.bit_string()
        wrapped.finish()
        _require_pair(d, point)
        curve_known = True
    key.finish()
    if not curve_known:
        raise InvalidEncoding("nothing says which curve the private key is of")
    return d


def _require_pair(d: int, point: bytes) -> None:
    """Does the public key, compressed or not, belong to d? Compared in constant time, as d is secret."""
    if not 1 <= d <= SM2P256V1.n - 2:
        raise InvalidEncoding("the private key is out of range")
    [P] = to_affine_all([secret_sum(SM2P256V1, (d, base_comb(SM2P256V1)))], SM2P256V1)
    expected = encode_point(P, SM2P256V1, compressed=len(point) == 33)
    if not hmac.compare_digest(expected, point):
        raise InvalidEncoding("the public key inside is of another key, or its point does not begin with 04, 02 or 03")


def _read_algorithm(reader: der.Reader) -> None:
    """AlgorithmIdentifier of an SM2 key, in one of the three ways of the module's docstring."""
    algorithm = reader.sequence()
    name = algorithm.oid()
    if name == _EC_PUBLIC_KEY:
        _read_curve(algorithm)
    elif name != _SM2:
        raise InvalidEncoding(f"the key's algorithm is {name}, not SM2")
    elif algorithm.peek_tag() == der.NULL:
        algorithm.null()
    elif not algorithm.at_end():
        _read_curve(algorithm)
    algorithm.finish()


def _read_curve(reader: der.Reader) -> None:
    """ECParameters, RFC 3279, 2.3.5: the name of sm2p256v1, or its parameters in full."""
    if reader.peek_tag() == der.OID:
        name = reader.oid()
        if name != _SM2:
            raise InvalidEncoding(f"the key's curve is {name}, not sm2p256v1")
    elif reader.checked() not in _explicit_parameters():
        raise InvalidEncoding("the key's explicit curve parameters are not those of sm2p256v1")


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
        for cofactor in ((), (der.integer(curve.h),))
    )  # fmt: skip


# --- reading encrypted keys: PBES2, RFC 8018, 6.2 ---


def _decrypted(data: bytes, password: bytes | None) -> int:
    """d of an EncryptedPrivateKeyInfo, RFC 5958, 3."""
    info = der.only_sequence(data)
    scheme = info.sequence()
    ciphertext = info.octet_string()
    info.finish()
    decrypt, _ = read_pbes2(scheme, "the key")
    if password is None:
        raise InvalidKey("the private key is encrypted; a password is needed")
    try:
        return _read_pkcs8(decrypt(password, ciphertext))
    except (InvalidEncoding, InvalidPadding):
        # One undetailed failure: how a decryption went wrong says something about the plaintext.
        raise InvalidKey("the password is wrong, or the key file is damaged") from None


def read_pbes2(scheme: der.Reader, what: str) -> tuple[Callable[[bytes, bytes], bytes], int]:
    """The decryption, of (password, ciphertext), of a PBES2 AlgorithmIdentifier (RFC 8018, A.4), and its work.

    The work is PBKDF2's iterations or scrypt's N * r * p, which take about as long. The decryption raises
    InvalidPadding where the password is wrong, most of the time. InvalidEncoding: an algorithm that is not supported;
    InvalidKey: one that asks for too much work.
    """
    name = scheme.oid()
    if name != _PBES2:
        raise InvalidEncoding(f"{what} is encrypted by {name}; PBES2 is what is supported")
    parameters = scheme.sequence()
    scheme.finish()
    derivation = parameters.sequence()
    cipher = parameters.sequence()
    parameters.finish()
    cipher_name = cipher.oid()
    if cipher_name not in _CIPHERS:
        raise InvalidEncoding(f"{what} is encrypted with cipher {cipher_name}, which is not supported")
    algorithm, key_length, block = _CIPHERS[cipher_name]
    iv = cipher.octet_string()
    cipher.finish()
    if len(iv) != block:
        raise InvalidEncoding(f"the IV has {len(iv)} bytes, not {block}")
    derive, work = _read_derivation(derivation, key_length)
    return lambda password, ciphertext: _cbc_decrypt(algorithm, derive(password), iv, ciphertext), work


def _read_derivation(algorithm: der.Reader, key_length: int) -> tuple[Callable[[bytes], bytes], int]:
    name = algorithm.oid()
    if name not in (_PBKDF2, _SCRYPT):
        raise InvalidEncoding(f"the key derivation {name} is not supported")
    parameters = algorithm.sequence()
    algorithm.finish()
    salt = parameters.octet_string()
    read = _read_pbkdf2 if name == _PBKDF2 else _read_scrypt
    found = read(parameters, salt, key_length)
    parameters.finish()
    return found


def _read_key_length(parameters: der.Reader, key_length: int) -> None:
    if parameters.peek_tag() == der.INTEGER and (found := parameters.integer()) != key_length:
        raise InvalidEncoding(f"a key of {found} bytes is derived for a cipher that takes {key_length}")


def _read_pbkdf2(parameters: der.Reader, salt: bytes, key_length: int) -> tuple[Callable[[bytes], bytes], int]:
    """PBKDF2-params after the salt, RFC 8018, A.2. The default function, HMAC-SHA-1, is never spelt out in DER."""
    iterations = parameters.integer()
    if not 1 <= iterations <= MAX_ITERATIONS:
        raise InvalidKey(f"the key file asks for {iterations} PBKDF2 iterations; the limit is {MAX_ITERATIONS}")
    _read_key_length(parameters, key_length)
    name = _HMAC_SHA1
    if not parameters.at_end():
        function = parameters.sequence()
        name = function.oid()
        if name == _HMAC_SHA1 or name not in _PRFS:
            raise InvalidEncoding(f"the pseudorandom function {name} is not supported")
        if not function.at_end():
            function.null()
        function.finish()
    hash_name = _PRFS[name]
    if hash_name == "sm3":
        from smcrypto import kdf, sm3

        if sm3.ENGINE == "python" and iterations > MAX_PURE_ITERATIONS:
            raise InvalidKey(
                f"the key file asks for {iterations} PBKDF2 iterations of SM3; without OpenSSL's SM3 the limit is"
                f" {MAX_PURE_ITERATIONS}"
            )
        return lambda password: kdf.pbkdf2_hmac(password, salt, iterations, key_length), iterations
    return lambda password: _pbkdf2(hash_name, password, salt, iterations, key_length), iterations


def _pbkdf2(hash_name: str, P: bytes, S: bytes, c: int, dkLen: int) -> bytes:
    """PBKDF2 with a hash that is not ours (names: RFC 8018, 5.2); hashlib has it only where Python has OpenSSL."""
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


def _read_scrypt(parameters: der.Reader, salt: bytes, key_length: int) -> tuple[Callable[[bytes], bytes], int]:
    """scrypt-params after the salt, RFC 7914, 7: N, r, p."""
    N, r, p = parameters.integer(), parameters.integer(), parameters.integer()
    _read_key_length(parameters, key_length)
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
    return partial(hashlib.scrypt, salt=salt, n=N, r=r, p=p, maxmem=memory, dklen=key_length), N * r * p


def _cbc_decrypt(algorithm: str, key: bytes, iv: bytes, ciphertext: bytes) -> bytes:
    """CBC and PKCS#7 padding; InvalidPadding where that is not well formed."""
    block = len(iv)
    if not ciphertext or len(ciphertext) % block:
        raise InvalidPadding("the ciphertext is not a whole number of blocks")
    if algorithm == "SM4":
        from smcrypto import sm4

        return sm4.decrypt(key, sm4.CBC(iv), ciphertext, padding="pkcs7")
    plain = _foreign_cbc_decrypt(algorithm, key, iv, ciphertext)
    count = plain[-1]
    if not 1 <= count <= block or plain[-count:] != bytes((count,)) * count:
        raise InvalidPadding("not well-formed PKCS#7 padding")
    return plain[:-count]


def _foreign_cbc_decrypt(algorithm: str, key: bytes, iv: bytes, ciphertext: bytes) -> bytes:
    """AES or 3DES, which this library does not contain, by the `cryptography` package."""
    try:
        from cryptography.hazmat.primitives.ciphers import Cipher, CipherAlgorithm, modes

        cipher: CipherAlgorithm
        if algorithm == "AES":
            from cryptography.hazmat.primitives.ciphers.algorithms import AES

            cipher = AES(key)
        else:  # by this name since version 43: an older one still reads AES
            from cryptography.hazmat.decrepit.ciphers.algorithms import TripleDES

            cipher = TripleDES(key)
    except ImportError:
        raise MissingDependency(
            f"the private key is encrypted with {algorithm}; reading it needs the package 'cryptography'"
        ) from None
    decryptor = Cipher(cipher, modes.CBC(iv)).decryptor()
    return bytes(decryptor.update(ciphertext) + decryptor.finalize())


# --- writing ---


def dump_private(
    d: int,
    public_point: bytes,
    password: bytes | None,
    format: Format,
    *,
    form: Form,
    prf: Prf = "sm3",
    iterations: int = ITERATIONS,
) -> bytes:
    """The key pair as PKCS#8, encrypted if a password is given, or as SEC1.

    public_point: 65 bytes, uncompressed. prf, iterations: of PBKDF2.
    `"sha256"` is for OpenSSL 3.0 and 3.1, which know no HMAC-SM3 here.
    InvalidOption for an unknown format or form, and a password with "sec1".
    """
    _require_form(form)
    if format not in ("pkcs8", "sec1"):
        raise InvalidOption(f"format must be 'pkcs8' or 'sec1', not {format!r}")
    if prf not in ("sm3", "sha256"):
        raise InvalidOption(f"prf must be 'sm3' or 'sha256', not {prf!r}")
    # RFC 5915, 3 wants both optional fields always there, inside PKCS#8 too; GmSSL refuses a key without them.
    sec1 = der.sequence(
        der.integer(1),
        der.octet_string(d.to_bytes(32, "big")),
        der.explicit(0, der.oid(_SM2)),
        der.explicit(1, der.bit_string(public_point)),
    )
    if format == "sec1":
        if password is not None:
            raise InvalidOption("SEC1 private keys are not encrypted; use format='pkcs8' with a password")
        label, data = _SEC1_LABELS[0], sec1
    else:
        label, data = _PKCS8_LABEL, der.sequence(der.integer(0), _algorithm(), der.octet_string(sec1))
        if password is not None:
            label, data = _ENCRYPTED_LABEL, _encrypted(data, password, prf, iterations)
    return pem.encode(label, data) if form == "pem" else data


def dump_public(point65: bytes, *, form: Form) -> bytes:
    """SubjectPublicKeyInfo with the named curve."""
    _require_form(form)
    data = der.sequence(_algorithm(), der.bit_string(point65))
    return pem.encode(_PUBLIC_LABEL, data) if form == "pem" else data


def _algorithm() -> bytes:
    return der.sequence(der.oid(_EC_PUBLIC_KEY), der.oid(_SM2))


def _encrypted(data: bytes, password: bytes, prf: Prf, iterations: int) -> bytes:
    algorithm, ciphertext = write_pbes2(data, password, prf, iterations)
    return der.sequence(algorithm, der.octet_string(ciphertext))


def write_pbes2(data: bytes, password: bytes, prf: Prf, iterations: int) -> tuple[bytes, bytes]:
    """(AlgorithmIdentifier, ciphertext): PBES2 with SM4-CBC, fresh salt and IV. InvalidOption as of `dump_private`."""
    from smcrypto import kdf, sm4

    if not password:
        raise InvalidOption("an empty password protects nothing; leave it out to write the key unencrypted")
    if prf not in ("sm3", "sha256"):
        raise InvalidOption(f"prf must be 'sm3' or 'sha256', not {prf!r}")
    if not 1 <= iterations <= MAX_ITERATIONS:
        raise InvalidOption(f"iterations must be between 1 and {MAX_ITERATIONS}, not {iterations}")
    salt, iv = secrets.token_bytes(16), secrets.token_bytes(16)
    if prf == "sm3":
        # No NULL after the name: GmSSL refuses one.
        function = der.sequence(der.oid(_HMAC_SM3))
        key = kdf.pbkdf2_hmac(password, salt, iterations, 16)
    else:
        function = der.sequence(der.oid("1.2.840.113549.2.9"), der.null())
        key = _pbkdf2("sha256", password, salt, iterations, 16)
    derivation = der.sequence(der.oid(_PBKDF2), der.sequence(der.octet_string(salt), der.integer(iterations), function))
    cipher = der.sequence(der.oid(_SM4_CBC), der.octet_string(iv))
    algorithm = der.sequence(der.oid(_PBES2), der.sequence(derivation, cipher))
    return algorithm, sm4.encrypt(key, sm4.CBC(iv), data, padding="pkcs7")

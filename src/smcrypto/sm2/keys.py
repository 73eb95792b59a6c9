"""SM2 keys, GB/T 32918.1-2016, clause 6, and what is done with one key: sign, verify, encrypt, decrypt.

Here input is checked and made bytes, encodings are chosen, nonces are drawn; the
arithmetic is in signature and encryption. Both kinds of key are immutable.

Which curve: sm2p256v1 always, unless the constructor is given another one, as
tests do with the standards' sample curve.
"""

from __future__ import annotations

import secrets
from collections.abc import Sequence
from hmac import compare_digest
from typing import Literal, NoReturn

from smcrypto import sm3
from smcrypto.errors import InvalidKey
from smcrypto.inputs import BytesLike, KeyHolder, as_bytes, as_exact_bytes, require_int, require_type
from smcrypto.sm2 import encryption
from smcrypto.sm2 import signature as signatures
from smcrypto.sm2.curve import SM2P256V1, Curve, Point, decode_point, encode_point, require_point
from smcrypto.sm2.nonces import hedged_nonces
from smcrypto.sm2.points import base_comb, secret_sum, to_affine_all
from smcrypto.sm2.signature import DEFAULT_UID

__all__ = ["PrivateKey", "PublicKey"]

SignatureEncoding = Literal["der", "raw"]
CiphertextEncoding = Literal["der", "c1c3c2", "c1c2c3"]
Format = Literal["pkcs8", "sec1"]
Prf = Literal["sm3", "sha256"]


class PublicKey:
    """A public key P_A: verifies signatures, encrypts.

    Made by `from_bytes`, `from_pem`, `from_der`, or found as `PrivateKey.public_key`. The constructor
    takes the point (x, y); InvalidKey unless it is a point of `curve`. Two keys are equal if their points are.

    >>> PublicKey.from_bytes(PrivateKey.from_int(1).public_key.to_bytes()).point == SM2P256V1.G
    True
    """

    __slots__ = ("_curve", "_point")
    _curve: Curve
    _point: Point

    def __init__(self, point: Point, curve: Curve = SM2P256V1) -> None:
        require_type(point, Sequence, "point")
        require_type(curve, Curve, "curve")
        if len(point) != 2:
            raise InvalidKey(f"a point has two coordinates, not {len(point)}")
        x, y = (require_int(value, "a coordinate") for value in point)
        object.__setattr__(self, "_point", require_point((x, y), curve))
        object.__setattr__(self, "_curve", curve)

    def __setattr__(self, name: str, value: object) -> NoReturn:
        raise AttributeError("keys do not change")

    @classmethod
    def from_bytes(cls, data: BytesLike) -> PublicKey:
        """The key that is encoded as a point (SEC 1, 2.3.4; GB/T 32918.1, 4.2.10).

        data: 65 bytes 04 || x || y, or 33 bytes 02 or 03 || x. InvalidKey for anything else: another
        length, the hybrid forms 06 and 07, infinity, x or y not below p, a point off the curve.

        >>> key = PrivateKey.generate().public_key
        >>> PublicKey.from_bytes(key.to_bytes(compressed=True)) == key
        True
        """
        return cls(decode_point(as_bytes(data, "data"), SM2P256V1))

    @classmethod
    def from_pem(cls, data: BytesLike) -> PublicKey:
        """The key of a PEM file, label PUBLIC KEY (SubjectPublicKeyInfo, RFC 5480); the first one of SM2.

        InvalidKey: there is none, or it is malformed.

        >>> key = PrivateKey.generate().public_key
        >>> PublicKey.from_pem(key.to_pem()) == key
        True
        """
        from smcrypto.sm2 import keyfiles

        return keyfiles.load_public(data, form="pem")

    @classmethod
    def from_der(cls, data: BytesLike) -> PublicKey:
        """The key of a SubjectPublicKeyInfo in DER. InvalidKey if it is not one.

        >>> key = PrivateKey.generate().public_key
        >>> PublicKey.from_der(key.to_der()) == key
        True
        """
        from smcrypto.sm2 import keyfiles

        return keyfiles.load_public(data, form="der")

    @property
    def point(self) -> Point:
        """(x, y), the affine coordinates."""
        return self._point

    @property
    def curve(self) -> Curve:
        """The curve the key is on."""
        return self._curve

    def to_bytes(self, compressed: bool = False) -> bytes:
        """The point, 04 || x || y in 65 bytes, or compressed, 02 or 03 || x in 33 (GB/T 32918.1, 4.2.9).

        >>> key = PrivateKey.from_int(1).public_key
        >>> len(key.to_bytes()), key.to_bytes(compressed=True).hex()[:16]
        (65, '0232c4ae2c1f1981')
        """
        return encode_point(self._point, self._curve, compressed=compressed)

    def to_pem(self) -> bytes:
        """SubjectPublicKeyInfo as PEM, label PUBLIC KEY.

        >>> PrivateKey.generate().public_key.to_pem().splitlines()[0]
        b'-----BEGIN PUBLIC KEY-----'
        """
        from smcrypto.sm2 import keyfiles

        return keyfiles.dump_public(self, form="pem")

    def to_der(self) -> bytes:
        """SubjectPublicKeyInfo as DER: 91 bytes.

        >>> len(PrivateKey.generate().public_key.to_der())
        91
        """
        from smcrypto.sm2 import keyfiles

        return keyfiles.dump_public(self, form="der")

    def verify(
        self, signature: BytesLike, message: BytesLike, *, uid: BytesLike = DEFAULT_UID,
        encoding: SignatureEncoding = "der",
    ) -> None:  # fmt: skip
        """Return if `signature` is this key's for `message` and `uid`; else InvalidSignature (GB/T 32918.2, 7).

        uid: the signer's distinguishing identifier, at most 8191 bytes (InvalidLength); may be empty.
        encoding: "der", SEQUENCE { r, s } in strict DER, or "raw", r || s in 64 bytes; else InvalidOption.
        A malformed signature fails as a wrong one does.

        >>> key = PrivateKey.generate()
        >>> key.public_key.verify(key.sign(b"message"), b"message")
        >>> key.public_key.verify(key.sign(b"message"), b"massage")
        Traceback (most recent call last):
        ...
        smcrypto.errors.InvalidSignature: the signature does not hold (smcrypto.diagnose tells why it may not)
        """
        data = as_bytes(message, "message")
        e = signatures.message_digest(self._curve, self._point, as_bytes(uid, "uid"), data)
        self.verify_digest(signature, e, encoding=encoding)

    def hasher(self, *, uid: BytesLike = DEFAULT_UID) -> sm3.SM3:
        """SM3 that has taken in Z_A: what comes of the message in pieces, too large for memory (GB/T 32918.2, 5.5).

        Give it the message by `update`; its `digest` is the e of `sign_digest` and `verify_digest`.
        uid: the signer's distinguishing identifier, at most 8191 bytes (InvalidLength); may be empty.

        >>> key = PrivateKey.generate()
        >>> state = key.public_key.hasher(uid=b"robot_1")
        >>> for piece in (b"a long ", b"message"):
        ...     state.update(piece)
        >>> key.public_key.verify(key.sign_digest(state.digest()), b"a long message", uid=b"robot_1")
        """
        return sm3.SM3(signatures.z_value(self._curve, self._point, as_bytes(uid, "uid")))

    def verify_digest(self, signature: BytesLike, e: BytesLike, *, encoding: SignatureEncoding = "der") -> None:
        """As `verify`, for a caller who has e = SM3(Z_A || M) already (GB/T 32918.2, 7.1 from B5 on).

        e: 32 bytes, else InvalidLength. It must be the hash with Z_A in it, not of the message alone.

        >>> key, e = PrivateKey.generate(), bytes(32)
        >>> key.public_key.verify_digest(key.sign_digest(e, encoding="raw"), e, encoding="raw")
        """
        signatures.require_encoding(encoding)
        encoded = as_bytes(signature, "signature")
        digest = as_exact_bytes(e, "e", 32)
        r, s = signatures.decode_signature(encoded, self._curve, encoding)
        signatures.verify(self._curve, self._point, int.from_bytes(digest, "big"), r, s)

    def encrypt(self, message: BytesLike, *, encoding: CiphertextEncoding = "der") -> bytes:
        """`message` for the holder of the private key (GB/T 32918.4, 6).

        message: any length, empty too; kept in memory. For more than a few KiB encrypt a key, and the data with it.
        encoding: "der" (GM/T 0009: SEQUENCE { x1, y1, C3, C2 }), "c1c3c2" (GB/T 32918.4-2016: 97 bytes longer
        than the message, starting with 04), or "c1c2c3" (the order of 2010); else InvalidOption.

        >>> key = PrivateKey.generate()
        >>> key.decrypt(key.public_key.encrypt(b"secret"))
        b'secret'
        """
        encryption.require_encoding(encoding)
        data = as_bytes(message, "message")
        nonces = hedged_nonces(self._curve.n, b"SM2 encryption", self.to_bytes(compressed=True), sm3.digest(data))
        parts = encryption.encrypt(self._curve, self._point, data, nonces)
        return encryption.encode_ciphertext(*parts, self._curve, encoding)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, PublicKey):
            return NotImplemented
        return self._point == other._point and self._curve == other._curve

    def __hash__(self) -> int:
        return hash((self._curve, self._point))

    def __repr__(self) -> str:
        return f"<PublicKey {self.to_bytes(compressed=True).hex()} on {self._curve.name}>"

    def __reduce__(self) -> tuple[type[PublicKey], tuple[Point, Curve]]:
        return PublicKey, (self._point, self._curve)


class PrivateKey(KeyHolder):
    """A private key d_A: signs, decrypts, takes part in a key exchange.

    Made by `generate`, `from_int`, `from_bytes`, `from_pem` or `from_der`. The constructor takes d;
    InvalidKey unless 1 <= d <= n-2 (GB/T 32918.1, 6.1). It shows no secret in its repr, is compared in
    constant time, and is not pickled: that would write the key where nobody looks for one.
    """

    __slots__ = ("_curve", "_d", "_inverse", "_public_key")
    _curve: Curve
    _d: int
    _inverse: int | None
    _public_key: PublicKey | None

    def __init__(self, d: int, curve: Curve = SM2P256V1) -> None:
        require_type(curve, Curve, "curve")
        if not 1 <= require_int(d, "d") <= curve.n - 2:
            raise InvalidKey("a private key must be in [1, n-2]")
        object.__setattr__(self, "_d", d)
        object.__setattr__(self, "_curve", curve)
        object.__setattr__(self, "_public_key", None)  # found at first use
        object.__setattr__(self, "_inverse", None)

    def __setattr__(self, name: str, value: object) -> NoReturn:
        raise AttributeError("keys do not change")

    @classmethod
    def generate(cls, curve: Curve = SM2P256V1) -> PrivateKey:
        """A new key from the operating system's random source (GB/T 32918.1, 6.1).

        >>> PrivateKey.generate() == PrivateKey.generate()
        False
        """
        require_type(curve, Curve, "curve")
        return cls(secrets.randbelow(curve.n - 2) + 1, curve)

    @classmethod
    def from_int(cls, d: int) -> PrivateKey:
        """The key d, 1 <= d <= n-2, else InvalidKey.

        >>> PrivateKey.from_int(0)
        Traceback (most recent call last):
        ...
        smcrypto.errors.InvalidKey: a private key must be in [1, n-2]
        """
        return cls(d)

    @classmethod
    def from_bytes(cls, data: BytesLike) -> PrivateKey:
        """The key d in 32 bytes, most significant first; InvalidKey for another length or range.

        >>> PrivateKey.from_bytes(bytes(31) + b"\\x05").to_int()
        5
        """
        raw = as_bytes(data, "data")
        if len(raw) != SM2P256V1.scalar_bytes:
            raise InvalidKey(f"a private key has {SM2P256V1.scalar_bytes} bytes, not {len(raw)}")
        return cls(int.from_bytes(raw, "big"))

    @classmethod
    def from_pem(cls, data: BytesLike, password: BytesLike | None = None) -> PrivateKey:
        """The key of a PEM file: PKCS#8 (RFC 5958), encrypted or not, or SEC1 (RFC 5915).

        Of several keys it is the first of SM2 that can be read; keys of other algorithms and encrypted ones that
        the password does not open are passed over.
        password: bytes, for an encrypted key and only for one. InvalidKey if the file is no SM2 key, the
        password is wrong, missing or superfluous; MissingDependency if its cipher needs a package.

        >>> key = PrivateKey.generate()
        >>> PrivateKey.from_pem(key.to_pem(b"password"), b"password") == key
        True
        """
        from smcrypto.sm2 import keyfiles

        return keyfiles.load_private(data, password, form="pem")

    @classmethod
    def from_der(cls, data: BytesLike, password: BytesLike | None = None) -> PrivateKey:
        """As `from_pem`, from DER.

        >>> key = PrivateKey.generate()
        >>> PrivateKey.from_der(key.to_der(format="sec1")) == key
        True
        """
        from smcrypto.sm2 import keyfiles

        return keyfiles.load_private(data, password, form="der")

    @property
    def curve(self) -> Curve:
        """The curve the key is for."""
        return self._curve

    @property
    def public_key(self) -> PublicKey:
        """P_A = [d_A]G, computed once."""
        known = self._public_key
        if known is None:
            [point] = to_affine_all([secret_sum(self._curve, (self._d, base_comb(self._curve)))], self._curve)
            known = PublicKey(point, self._curve)
            object.__setattr__(self, "_public_key", known)
        return known

    def _d_plus_1_inverse(self) -> int:
        """1/(1 + d) mod n, computed once, behind a random factor."""
        known = self._inverse
        if known is None:
            n = self._curve.n
            blind = secrets.randbelow(n - 1) + 1
            known = blind * pow((1 + self._d) * blind % n, -1, n) % n
            object.__setattr__(self, "_inverse", known)
        return known

    def to_int(self) -> int:
        """d itself: secret.

        >>> PrivateKey.from_int(5).to_int()
        5
        """
        return self._d

    def to_bytes(self) -> bytes:
        """d in 32 bytes, most significant first: secret.

        >>> PrivateKey.from_int(5).to_bytes().hex()[-4:]
        '0005'
        """
        return self._d.to_bytes(self._curve.scalar_bytes, "big")

    def to_pem(self, password: BytesLike | None = None, format: Format = "pkcs8", *, prf: Prf = "sm3") -> bytes:
        """The key as PEM: secret unless a password encrypts it.

        format: "pkcs8" (RFC 5958; label PRIVATE KEY, or ENCRYPTED PRIVATE KEY with a password: PBES2 with
        SM4-CBC and PBKDF2), or "sec1" (RFC 5915, EC PRIVATE KEY), which takes no password (InvalidOption).
        prf: of PBKDF2; "sm3" as GmSSL has it, "sha256" for OpenSSL 3.0 and 3.1, which cannot read the former.

        >>> PrivateKey.generate().to_pem(b"password").splitlines()[0]
        b'-----BEGIN ENCRYPTED PRIVATE KEY-----'
        """
        from smcrypto.sm2 import keyfiles

        return keyfiles.dump_private(self, password, format, form="pem", prf=prf)

    def to_der(self, password: BytesLike | None = None, format: Format = "pkcs8", *, prf: Prf = "sm3") -> bytes:
        """As `to_pem`, as DER.

        >>> key = PrivateKey.generate()
        >>> PrivateKey.from_der(key.to_der()) == key
        True
        """
        from smcrypto.sm2 import keyfiles

        return keyfiles.dump_private(self, password, format, form="der", prf=prf)

    def to_enveloped(self, recipient: PublicKey) -> bytes:
        """The key sealed for `recipient`: SM2EnvelopedKey in DER (GM/T 0009, 7.4), as a CA hands out encryption keys.

        >>> key, ours = PrivateKey.generate(), PrivateKey.generate()
        >>> PrivateKey.from_enveloped(key.to_enveloped(ours.public_key), ours) == key
        True
        """
        from smcrypto.sm2.envelope import seal_key

        require_type(recipient, PublicKey, "recipient")
        return seal_key(self, recipient)

    @classmethod
    def from_enveloped(cls, data: BytesLike, key: PrivateKey) -> PrivateKey:
        """The key that was sealed for `key`: SM2EnvelopedKey in DER (GM/T 0009, 7.4).

        InvalidKey: malformed, or not the key of the public key beside it. InvalidCiphertext: sealed for another key.
        """
        from smcrypto.sm2.envelope import open_key

        require_type(key, PrivateKey, "key")
        return open_key(as_bytes(data, "data"), key)

    def sign(self, message: BytesLike, *, uid: BytesLike = DEFAULT_UID, encoding: SignatureEncoding = "der") -> bytes:
        """This key's signature of `message` (GB/T 32918.2, 6).

        uid: the signer's distinguishing identifier, at most 8191 bytes (InvalidLength); may be empty.
        encoding: "der", SEQUENCE { r, s }, 8 to 72 bytes, or "raw", r || s, 64 bytes; else InvalidOption.

        >>> key = PrivateKey.generate()
        >>> len(key.sign(b"message", uid=b"robot_1", encoding="raw"))
        64
        """
        data = as_bytes(message, "message")
        e = signatures.message_digest(self._curve, self.public_key.point, as_bytes(uid, "uid"), data)
        return self.sign_digest(e, encoding=encoding)

    def sign_digest(self, e: BytesLike, *, encoding: SignatureEncoding = "der") -> bytes:
        """As `sign`, for a caller who has e = SM3(Z_A || M) already (GB/T 32918.2, 6.1 from A3 on).

        e: 32 bytes, else InvalidLength. It must be the hash with Z_A in it, not of the message alone.

        >>> len(PrivateKey.generate().sign_digest(bytes(32), encoding="raw"))
        64
        """
        signatures.require_encoding(encoding)
        digest = as_exact_bytes(e, "e", 32)
        nonces = hedged_nonces(self._curve.n, b"SM2 signature", self.to_bytes(), digest)
        r, s = signatures.sign(self._curve, self._d_plus_1_inverse(), int.from_bytes(digest, "big"), nonces)
        return signatures.encode_signature(r, s, self._curve, encoding)

    def decrypt(self, ciphertext: BytesLike, *, encoding: CiphertextEncoding = "der") -> bytes:
        """The message in `ciphertext`, or InvalidCiphertext, whatever is wrong with it (GB/T 32918.4, 7).

        encoding: "der", "c1c3c2" or "c1c2c3" as in `PublicKey.encrypt`; else InvalidOption. C1 must be uncompressed.

        >>> key = PrivateKey.generate()
        >>> key.decrypt(key.public_key.encrypt(b"", encoding="c1c3c2"), encoding="c1c3c2")
        b''
        """
        encryption.require_encoding(encoding)
        parts = encryption.decode_ciphertext(as_bytes(ciphertext, "ciphertext"), self._curve, encoding)
        return encryption.decrypt(self._curve, self._d, *parts)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, PrivateKey):
            return NotImplemented
        return self._curve == other._curve and compare_digest(self.to_bytes(), other.to_bytes())

    def __hash__(self) -> int:
        return hash(self.public_key)

    def __repr__(self) -> str:
        return f"<PrivateKey of {self.public_key!r}>"

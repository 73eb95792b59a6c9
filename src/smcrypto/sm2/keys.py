"""SM2 keys, and what they do: sign, verify, encrypt, decrypt (GB/T 32918.1, 6)."""

from __future__ import annotations

import secrets
from hmac import compare_digest
from typing import Any, Literal, NoReturn

from smcrypto import sm3
from smcrypto.errors import InvalidKey
from smcrypto.inputs import BytesLike, as_bytes, as_exact_bytes
from smcrypto.sm2 import encryption, signature
from smcrypto.sm2.curve import SM2P256V1, Curve, Point, decode_point, encode_point, require_point
from smcrypto.sm2.nonces import hedged_nonces
from smcrypto.sm2.points import base_comb, secret_sum, to_affine_all

__all__ = ["PrivateKey", "PublicKey"]

SignatureEncoding = Literal["der", "raw"]
CiphertextEncoding = Literal["der", "c1c3c2", "c1c2c3"]


class PublicKey:
    """A point P_A of the curve: verifies and encrypts."""

    __slots__ = ("_curve", "_point")
    _curve: Curve
    _point: Point

    def __init__(self, point: Point, curve: Curve = SM2P256V1) -> None:
        x, y = point
        for value in point:
            if not isinstance(value, int) or isinstance(value, bool):
                raise TypeError(f"coordinates must be int, not {type(value).__name__}")
        object.__setattr__(self, "_point", require_point((x, y), curve))
        object.__setattr__(self, "_curve", curve)

    def __setattr__(self, name: str, value: object) -> NoReturn:
        raise AttributeError("keys do not change")

    @classmethod
    def from_bytes(cls, data: BytesLike) -> PublicKey:
        return cls(decode_point(as_bytes(data, "data"), SM2P256V1))

    @classmethod
    def from_pem(cls, data: BytesLike) -> PublicKey:
        from smcrypto.sm2 import keyfiles

        return cls.from_bytes(keyfiles.load_public(as_bytes(data, "data"), form="pem"))

    @classmethod
    def from_der(cls, data: BytesLike) -> PublicKey:
        from smcrypto.sm2 import keyfiles

        return cls.from_bytes(keyfiles.load_public(as_bytes(data, "data"), form="der"))

    @property
    def point(self) -> Point:
        """(x, y)."""
        return self._point

    @property
    def curve(self) -> Curve:
        return self._curve

    def to_bytes(self, compressed: bool = False) -> bytes:
        return encode_point(self._point, self._curve, compressed=compressed)

    def to_pem(self) -> bytes:
        from smcrypto.sm2 import keyfiles

        return keyfiles.dump_public(self._standard_bytes(), form="pem")

    def to_der(self) -> bytes:
        from smcrypto.sm2 import keyfiles

        return keyfiles.dump_public(self._standard_bytes(), form="der")

    def _standard_bytes(self) -> bytes:
        if self._curve != SM2P256V1:
            raise InvalidKey("key files hold keys of sm2p256v1 only")
        return self.to_bytes()

    def verify(
        self,
        signature_: BytesLike,
        message: BytesLike,
        *,
        uid: BytesLike = signature.DEFAULT_UID,
        encoding: SignatureEncoding = "der",
    ) -> None:
        data = as_bytes(message, "message")
        e = signature.message_digest(self._curve, self._point, as_bytes(uid, "uid"), data)
        self.verify_digest(signature_, e, encoding=encoding)

    def verify_digest(self, signature_: BytesLike, e: BytesLike, *, encoding: SignatureEncoding = "der") -> None:
        signature.require_encoding(encoding)
        r, s = signature.decode_signature(as_bytes(signature_, "signature"), self._curve, encoding)
        digest = as_exact_bytes(e, "e", 32)
        signature.verify(self._curve, self._point, int.from_bytes(digest, "big"), r, s)

    def encrypt(self, message: BytesLike, *, encoding: CiphertextEncoding = "der") -> bytes:
        encryption.require_encoding(encoding)
        data = as_bytes(message, "message")
        nonces = hedged_nonces(self._curve.n, b"SM2 encryption", self.to_bytes(), sm3.digest(data))
        return encryption.encode_ciphertext(
            *encryption.encrypt(self._curve, self._point, data, nonces), self._curve, encoding
        )

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


class PrivateKey:
    """A number d_A in [1, n-2]: signs and decrypts."""

    __slots__ = ("_curve", "_d", "_inverse", "_public_key")
    _curve: Curve
    _d: int
    _inverse: int | None
    _public_key: PublicKey | None

    def __init__(self, d: int, curve: Curve = SM2P256V1) -> None:
        if not isinstance(d, int) or isinstance(d, bool):
            raise TypeError(f"d must be an int, not {type(d).__name__}")
        if not 1 <= d <= curve.n - 2:
            raise InvalidKey("a private key must be in [1, n-2]")
        object.__setattr__(self, "_d", d)
        object.__setattr__(self, "_curve", curve)
        object.__setattr__(self, "_public_key", None)  # found at first use
        object.__setattr__(self, "_inverse", None)

    def __setattr__(self, name: str, value: object) -> NoReturn:
        raise AttributeError("keys do not change")

    @classmethod
    def generate(cls, curve: Curve = SM2P256V1) -> PrivateKey:
        return cls(secrets.randbelow(curve.n - 2) + 1, curve)

    @classmethod
    def from_int(cls, d: int) -> PrivateKey:
        return cls(d)

    @classmethod
    def from_bytes(cls, data: BytesLike) -> PrivateKey:
        raw = as_bytes(data, "data")
        if len(raw) != SM2P256V1.scalar_bytes:
            raise InvalidKey(f"a private key has {SM2P256V1.scalar_bytes} bytes, not {len(raw)}")
        return cls(int.from_bytes(raw, "big"))

    @classmethod
    def from_pem(cls, data: BytesLike, password: BytesLike | None = None) -> PrivateKey:
        from smcrypto.sm2 import keyfiles

        return cls(keyfiles.load_private(as_bytes(data, "data"), _password(password), form="pem"))

    @classmethod
    def from_der(cls, data: BytesLike, password: BytesLike | None = None) -> PrivateKey:
        from smcrypto.sm2 import keyfiles

        return cls(keyfiles.load_private(as_bytes(data, "data"), _password(password), form="der"))

    @property
    def curve(self) -> Curve:
        return self._curve

    @property
    def public_key(self) -> PublicKey:
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
        return self._d

    def to_bytes(self) -> bytes:
        return self._d.to_bytes(self._curve.scalar_bytes, "big")

    def to_pem(self, password: BytesLike | None = None, format: Literal["pkcs8", "sec1"] = "pkcs8") -> bytes:
        from smcrypto.sm2 import keyfiles

        return keyfiles.dump_private(
            self._d, self.public_key._standard_bytes(), _password(password), format, form="pem"
        )

    def to_der(self, password: BytesLike | None = None, format: Literal["pkcs8", "sec1"] = "pkcs8") -> bytes:
        from smcrypto.sm2 import keyfiles

        return keyfiles.dump_private(
            self._d, self.public_key._standard_bytes(), _password(password), format, form="der"
        )

    def sign(
        self, message: BytesLike, *, uid: BytesLike = signature.DEFAULT_UID, encoding: SignatureEncoding = "der"
    ) -> bytes:
        data = as_bytes(message, "message")
        e = signature.message_digest(self._curve, self.public_key.point, as_bytes(uid, "uid"), data)
        return self.sign_digest(e, encoding=encoding)

    def sign_digest(self, e: BytesLike, *, encoding: SignatureEncoding = "der") -> bytes:
        signature.require_encoding(encoding)
        digest = as_exact_bytes(e, "e", 32)
        nonces = hedged_nonces(self._curve.n, b"SM2 signature", self.to_bytes(), digest)
        r, s = signature.sign(self._curve, self._d_plus_1_inverse(), int.from_bytes(digest, "big"), nonces)
        return signature.encode_signature(r, s, self._curve, encoding)

    def decrypt(self, ciphertext: BytesLike, *, encoding: CiphertextEncoding = "der") -> bytes:
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

    def __copy__(self) -> PrivateKey:
        return self

    def __deepcopy__(self, memo: dict[int, Any]) -> PrivateKey:
        return self

    def __reduce__(self) -> NoReturn:
        raise TypeError("private keys are not pickled; to_pem(password) writes one on purpose")


def _password(password: BytesLike | None) -> bytes | None:
    return None if password is None else as_bytes(password, "password")

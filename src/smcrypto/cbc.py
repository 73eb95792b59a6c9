"""Block ciphers in CBC mode under the identifiers by which key files, PKCS#12 and CMS name them; RFC 5652, 6.3 padding.

SM4 is this library's own. AES and 3DES, with which others encrypt, are computed by the package `cryptography`.
"""

from __future__ import annotations

from typing import Any, Final, NamedTuple

from smcrypto import der
from smcrypto.errors import InvalidEncoding, InvalidPadding, MissingDependency

__all__ = ["AES128", "AES256", "CBC", "SM4", "TRIPLE_DES", "UnknownCipher", "read_algorithm"]


class UnknownCipher(InvalidEncoding):
    """The identifier is of none of these ciphers."""


class CBC(NamedTuple):
    """One cipher: its name, the sizes of its key and its block in bytes, its identifier in CBC mode."""

    name: str
    key_length: int
    block: int
    oid: str

    def algorithm(self, iv: bytes) -> bytes:
        """AlgorithmIdentifier with the IV as parameter."""
        return der.sequence(der.oid(self.oid), der.octet_string(iv))

    def encrypt(self, key: bytes, iv: bytes, plaintext: bytes) -> bytes:
        """Padded and encrypted. MissingDependency: a cipher that needs a package."""
        count = self.block - len(plaintext) % self.block
        context = self._cipher(key, iv).encryptor()
        return bytes(context.update(plaintext + bytes((count,)) * count) + context.finalize())

    def decrypt(self, key: bytes, iv: bytes, ciphertext: bytes) -> bytes:
        """The plaintext with its padding. InvalidPadding: not a whole number of blocks. MissingDependency."""
        if not ciphertext or len(ciphertext) % self.block:
            raise InvalidPadding("the ciphertext is not a whole number of blocks")
        context = self._cipher(key, iv).decryptor()
        return bytes(context.update(ciphertext) + context.finalize())

    def unpadded(self, plaintext: bytes) -> bytes:
        """`plaintext` without its padding; InvalidPadding where that is not well formed."""
        count = plaintext[-1]
        if not 1 <= count <= self.block or plaintext[-count:] != bytes((count,)) * count:
            raise InvalidPadding("not well-formed PKCS#7 padding")
        return plaintext[:-count]

    def _cipher(self, key: bytes, iv: bytes) -> Any:
        if self.name == "SM4":
            from smcrypto import sm4

            return sm4.Cipher(key, sm4.CBC(iv))
        try:
            from cryptography.hazmat.primitives.ciphers import Cipher, modes

            if self.name == "AES":
                from cryptography.hazmat.primitives.ciphers import algorithms
            else:  # here since version 43: an older one still has AES
                from cryptography.hazmat.decrepit.ciphers import algorithms  # type: ignore[no-redef]
        except ImportError:
            raise MissingDependency(f"encryption with {self.name} needs the package 'cryptography'") from None
        return Cipher(getattr(algorithms, self.name)(key), modes.CBC(iv))


SM4: Final = CBC("SM4", 16, 16, "1.2.156.10197.1.104.2")  # GM/T 0006
AES128: Final = CBC("AES", 16, 16, "2.16.840.1.101.3.4.1.2")  # RFC 3565, 4.1
AES256: Final = CBC("AES", 32, 16, "2.16.840.1.101.3.4.1.42")
TRIPLE_DES: Final = CBC("TripleDES", 24, 8, "1.2.840.113549.3.7")  # RFC 8018, B.2.2
_ALL: Final = {
    cipher.oid: cipher
    for cipher in (SM4, AES128, CBC("AES", 24, 16, "2.16.840.1.101.3.4.1.22"), AES256, TRIPLE_DES)
} | {"1.2.156.10197.1.104": SM4}  # SM4 without its mode, with an IV: as CFCA's software writes it


def read_algorithm(algorithm: der.Reader, what: str) -> tuple[CBC, bytes]:
    """(cipher, IV) by which `what` is encrypted; UnknownCipher for another one."""
    name = algorithm.oid()
    if name not in _ALL:
        raise UnknownCipher(f"{what} is encrypted with cipher {name}, which is not supported")
    cipher, iv = _ALL[name], algorithm.octet_string()
    if len(iv) != cipher.block:
        raise InvalidEncoding(f"the IV has {len(iv)} bytes, not {cipher.block}")
    return cipher, iv

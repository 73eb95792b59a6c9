"""A file of any size under a password: SM4-GCM in pieces, the key from PBKDF2-HMAC-SM3.

The format: 16 bytes of salt, 12 of nonce, the ciphertext, the tag. What was altered leaves no plaintext behind.

Run it: python examples/file_encryption.py
"""

import os
import secrets
import tempfile
from pathlib import Path

from smcrypto import InvalidTag, kdf, sm4

PIECE = 1 << 20
ITERATIONS = 100_000


def cipher(password: bytes, salt: bytes, nonce: bytes) -> sm4.Cipher:
    return sm4.Cipher(kdf.pbkdf2_hmac(password, salt, ITERATIONS, 16), sm4.GCM(nonce))


def encrypt(source: Path, target: Path, password: bytes) -> None:
    salt, nonce = secrets.token_bytes(16), secrets.token_bytes(12)
    stream = cipher(password, salt, nonce).encryptor()
    with source.open("rb") as plain, target.open("wb") as sealed:
        sealed.write(salt + nonce)
        while piece := plain.read(PIECE):
            sealed.write(stream.update(piece))
        sealed.write(stream.finalize())


def decrypt(source: Path, target: Path, password: bytes) -> None:
    """Plaintext goes to a file without a name that anybody uses, and gets its name once the tag was right."""
    with source.open("rb") as sealed, tempfile.NamedTemporaryFile(dir=target.parent, delete=False) as plain:
        try:
            stream = cipher(password, sealed.read(16), sealed.read(12)).decryptor(release_unverified=True)
            while piece := sealed.read(PIECE):
                plain.write(stream.update(piece))
            plain.write(stream.finalize())
        except BaseException:
            os.unlink(plain.name)
            raise
    os.replace(plain.name, target)


with tempfile.TemporaryDirectory() as folder:
    plain, sealed, opened = (Path(folder) / name for name in ("plain", "sealed", "opened"))
    plain.write_bytes(secrets.token_bytes(3 * PIECE + 5))
    encrypt(plain, sealed, b"open sesame")
    decrypt(sealed, opened, b"open sesame")
    assert opened.read_bytes() == plain.read_bytes()
    print(f"{plain.stat().st_size} bytes there and back")
    opened.unlink()
    data = bytearray(sealed.read_bytes())
    data[1000] ^= 1
    sealed.write_bytes(data)
    try:
        decrypt(sealed, opened, b"open sesame")
    except InvalidTag as error:
        print(f"refused: {error}")
    assert sorted(path.name for path in Path(folder).iterdir()) == ["plain", "sealed"], "nothing is left behind"

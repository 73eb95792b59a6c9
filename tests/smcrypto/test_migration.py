"""The calls of other tools and ours, as docs/migration.md has them beside each other: both run, and are compared."""

from __future__ import annotations

import hmac
import importlib
import importlib.util
import os
import random
import secrets
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

import smcrypto
from conftest import unavailable
from smcrypto import InvalidCiphertext, InvalidKey, InvalidPadding, kdf, sm2, sm3, sm4

OPENSSL = """
echo "the message" > message
openssl genpkey -algorithm SM2 -out key.pem
openssl pkey -in key.pem -pubout -out pub.pem
python -m smcrypto pubkey --key key.pem | cmp - pub.pem

python -m smcrypto sign --key key.pem -o ours.sig message
openssl pkeyutl -verify -pubin -inkey pub.pem -sigfile ours.sig -rawin -digest sm3 \
    -pkeyopt distid:1234567812345678 -in message
openssl pkeyutl -sign -inkey key.pem -rawin -digest sm3 -pkeyopt distid:1234567812345678 -in message -out their.sig
python -m smcrypto verify --public pub.pem --signature their.sig message

python -m smcrypto encrypt --to pub.pem -o sealed message
openssl pkeyutl -decrypt -inkey key.pem -in sealed | cmp - message

echo "open sesame" > password
openssl enc -sm4-cbc -pbkdf2 -md sm3 -iter 100000 -pass file:password -in message -out sealed
python -m smcrypto decrypt --password-file password sealed | cmp - message
python -m smcrypto keygen --prf sha256 --password-file password -o locked.pem
openssl pkey -in locked.pem -passin file:password -noout
python -m smcrypto hash message | cut -d ' ' -f 1 > ours
openssl dgst -sm3 -r message | cut -d ' ' -f 1 | cmp - ours
"""


def peer(module: str) -> Any:
    package = module.partition(".")[0]
    if importlib.util.find_spec(package) is None:
        unavailable(f"the package {package!r} is not installed")
    return importlib.import_module(module)


def test_gmssl() -> None:
    gmssl_sm2, gmssl_sm3, gmssl_sm4 = (peer(f"gmssl.{name}") for name in ("sm2", "sm3", "sm4"))
    message = b"the message"
    assert gmssl_sm3.sm3_hash(list(message)) == sm3.digest(message).hex()
    assert gmssl_sm3.sm3_kdf(message.hex().encode(), 40) == kdf.sm2_kdf(message, 40).hex()

    key, iv = secrets.token_bytes(16), secrets.token_bytes(16)
    theirs = gmssl_sm4.CryptSM4()
    theirs.set_key(key, gmssl_sm4.SM4_ENCRYPT)
    assert theirs.crypt_ecb(message) == sm4.encrypt(key, sm4.ECB(), message, padding="pkcs7")
    assert theirs.crypt_cbc(iv, message) == sm4.encrypt(key, sm4.CBC(iv), message, padding="pkcs7")
    theirs.set_key(key, gmssl_sm4.SM4_DECRYPT)
    assert theirs.crypt_cbc(iv, sm4.encrypt(key, sm4.CBC(iv), message, padding="pkcs7")) == message

    # The key of its own documentation. Not every key will do: gmssl takes leading digits 0 and 4 off some.
    d = "00B9AB0B828FF68872F21A837FC303668428DEA11DCD1B24429D0C99E24EED83D5"[2:]
    xy = ("B9C9A6E04E9C91F7BA880429273747D7EF5DDEB0BB2FF6317EB00BEF331A8308"
          "1A6994B8993F3F5D6EADDDB81872266C87C018FB4162F5AF347B483E24620207")
    private = sm2.PrivateKey.from_bytes(bytes.fromhex(d))
    public = sm2.PublicKey.from_bytes(b"\x04" + bytes.fromhex(xy))
    assert private.public_key == public
    crypt = gmssl_sm2.CryptSM2(private_key=d, public_key=xy)

    signature = crypt.sign_with_sm3(message)
    public.verify(bytes.fromhex(signature), message, encoding="raw")
    assert crypt.verify_with_sm3(private.sign(message, encoding="raw").hex(), message)

    assert private.decrypt(b"\x04" + crypt.encrypt(message), encoding="c1c2c3") == message
    assert crypt.decrypt(public.encrypt(message, encoding="c1c2c3")[1:]) == message
    newer = gmssl_sm2.CryptSM2(private_key=d, public_key=xy, mode=1)
    assert private.decrypt(b"\x04" + newer.encrypt(message), encoding="c1c3c2") == message


def test_what_gmssl_does_and_we_do_not() -> None:
    gmssl_sm2, gmssl_sm3, gmssl_sm4, func = (peer(f"gmssl.{name}") for name in ("sm2", "sm3", "sm4", "func"))
    assert gmssl_sm2.CryptSM2(private_key="", public_key="04" + "4" * 128).public_key == ""

    random.seed(1)
    first = func.random_hex(64)
    random.seed(1)
    assert func.random_hex(64) == first

    key = sm2.PrivateKey.from_int(7)
    xy = key.public_key.to_bytes()[1:].hex()
    crypt = gmssl_sm2.CryptSM2(private_key=key.to_bytes().hex(), public_key=xy)
    sealed = key.public_key.encrypt(b"pay 10", encoding="c1c2c3")
    altered = sealed[:69] + bytes([sealed[69] ^ ord("1") ^ ord("9")]) + sealed[70:]
    assert crypt.decrypt(altered[1:]) == b"pay 90"
    with pytest.raises(InvalidCiphertext):
        key.decrypt(altered, encoding="c1c2c3")

    data = list(b"abc")
    gmssl_sm3.sm3_hash(data)
    assert len(data) == 64

    cipher = gmssl_sm4.CryptSM4()
    cipher.set_key(bytes(16) + b"is ignored", gmssl_sm4.SM4_ENCRYPT)
    assert cipher.crypt_ecb(b"m") == sm4.encrypt(bytes(16), sm4.ECB(), b"m", padding="pkcs7")
    with pytest.raises(InvalidKey):
        sm4.SM4(bytes(16) + b"is not ignored")

    cipher.set_key(bytes(16), gmssl_sm4.SM4_DECRYPT)
    no_padding = sm4.encrypt(bytes(16), sm4.ECB(), bytes(15) + b"\xff")
    assert cipher.crypt_ecb(no_padding) == b""
    with pytest.raises(InvalidPadding):
        sm4.decrypt(bytes(16), sm4.ECB(), no_padding, padding="pkcs7")

    zeroed = gmssl_sm4.CryptSM4(padding_mode=gmssl_sm4.ZERO)
    zeroed.set_key(bytes(16), gmssl_sm4.SM4_ENCRYPT)
    for text in (b"m", bytes(range(1, 17))):
        padded = text + bytes(16 - len(text) % 16)
        sealed = zeroed.crypt_ecb(text)
        assert sealed == sm4.encrypt(bytes(16), sm4.ECB(), padded)
        assert sm4.decrypt(bytes(16), sm4.ECB(), sealed, padding="zeros").rstrip(b"\0") == text
    zeroed.set_key(bytes(16), gmssl_sm4.SM4_DECRYPT)
    assert zeroed.crypt_ecb(sm4.encrypt(bytes(16), sm4.ECB(), b"m" + bytes(15))) == b"m" + bytes(14)

    with pytest.raises(ValueError):
        crypt.encrypt(b"")
    assert key.decrypt(key.public_key.encrypt(b"")) == b""


def test_gmssl_pyx() -> None:
    gmssl_pyx = peer("gmssl_pyx")
    xy, d = gmssl_pyx.sm2_key_generate()
    key, public = sm2.PrivateKey.from_bytes(d), sm2.PublicKey.from_bytes(b"\x04" + xy)
    assert key.public_key == public
    message, block, iv = b"the message", bytes(range(16)), bytes(range(16, 32))
    public.verify(gmssl_pyx.sm2_sign(d, xy, message), message)
    public.verify(gmssl_pyx.sm2_sign(d, xy, message, signer_id=b"me"), message, uid=b"me")
    public.verify_digest(gmssl_pyx.sm2_sign(d, xy, message, signer_id=None), sm3.digest(message))
    assert gmssl_pyx.sm2_verify(xy, message, key.sign(message))
    assert key.decrypt(gmssl_pyx.sm2_encrypt(xy, message)) == message
    assert gmssl_pyx.sm2_decrypt(d, public.encrypt(message)) == message
    assert gmssl_pyx.sm3_hash(message) == sm3.digest(message)
    assert gmssl_pyx.sm3_hmac(block, message) == sm3.hmac(block, message)
    assert gmssl_pyx.sm3_kdf(message, 40) == kdf.sm2_kdf(message, 40)
    theirs = gmssl_pyx.sm4_cbc_padding_encrypt(block, iv, message)
    assert theirs == sm4.encrypt(block, sm4.CBC(iv), message, padding="pkcs7")
    assert gmssl_pyx.sm4_ctr_encrypt(block, iv, message) == sm4.encrypt(block, sm4.CTR(iv), message)
    ciphertext, tag = gmssl_pyx.sm4_gcm_encrypt(block, iv, b"header", plaintext=message)
    assert ciphertext + tag == sm4.SM4GCM(block).encrypt(iv, message, b"header")


def test_cryptography() -> None:
    peer("cryptography")
    from cryptography.hazmat.primitives import hashes, padding
    from cryptography.hazmat.primitives import hmac as their_hmac
    from cryptography.hazmat.primitives.ciphers import Cipher, algorithms, modes
    from cryptography.hazmat.primitives.kdf.hkdf import HKDF
    from cryptography.hazmat.primitives.kdf.pbkdf2 import PBKDF2HMAC

    key, iv, message = bytes(range(16)), bytes(16), b"the message"

    digest = hashes.Hash(hashes.SM3())
    digest.update(message)
    assert digest.finalize() == sm3.digest(message)

    mac = their_hmac.HMAC(key, hashes.SM3())
    mac.update(message)
    assert mac.finalize() == hmac.new(key, message, sm3.SM3).digest()

    assert HKDF(hashes.SM3(), 40, b"salt", b"info").derive(key) == kdf.hkdf(key, 40, salt=b"salt", info=b"info")
    assert PBKDF2HMAC(hashes.SM3(), 40, b"salt", 10).derive(b"pw") == kdf.pbkdf2_hmac(b"pw", b"salt", 10, 40)

    padder, encryptor = padding.PKCS7(128).padder(), Cipher(algorithms.SM4(key), modes.CBC(iv)).encryptor()
    theirs = encryptor.update(padder.update(message) + padder.finalize()) + encryptor.finalize()
    assert theirs == sm4.encrypt(key, sm4.CBC(iv), message, padding="pkcs7")

    encryptor = Cipher(algorithms.SM4(key), modes.GCM(iv[:12])).encryptor()
    encryptor.authenticate_additional_data(b"header")
    theirs = encryptor.update(message) + encryptor.finalize() + encryptor.tag
    assert theirs == sm4.SM4GCM(key).encrypt(iv[:12], message, b"header")


def test_openssl(tmp_path: Path) -> None:
    if shutil.which("openssl") is None:
        unavailable("the program 'openssl' is not installed")
    environment = os.environ | {
        "PYTHONPATH": str(Path(smcrypto.__file__).parents[1]),
        "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}",
    }
    done = subprocess.run(["bash", "-euo", "pipefail", "-c", OPENSSL], env=environment, cwd=tmp_path,
                          capture_output=True, text=True, check=False)  # fmt: skip
    assert done.returncode == 0, f"{done.stdout}{done.stderr}"

"""SM4 and its modes beside gmssl (pure Python) and cryptography (OpenSSL's C).

Calls are what a user writes. "new key" includes the key set-up, everywhere
else the key is set up once, outside. gmssl has ECB and CBC only: in "SM4-CTR"
groups it runs ECB, its fastest, on as many bytes and the block of padding
that it always adds.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from smcrypto import sm4
from smcrypto.sm4.engine import Engine

KEY = bytes.fromhex("0123456789abcdeffedcba9876543210")
XTS_KEY = KEY + KEY[::-1]
IV = bytes(range(16))
SIZES = {"64 B": 64, "256 B": 256, "1 KiB": 1 << 10, "4 KiB": 1 << 12, "16 KiB": 1 << 14, "64 KiB": 1 << 16,
         "1 MiB": 1 << 20}


def run(benchmark: Any, implementation: str, size: int, function: Callable[..., Any], *arguments: Any) -> None:
    """Repeated by pytest-benchmark's calibration; what takes seconds runs three times."""
    benchmark.extra_info.update(implementation=implementation, bytes=size)
    if implementation == "gmssl" and size >= 1 << 16:
        benchmark.pedantic(function, arguments, rounds=3)
    else:
        benchmark(function, *arguments)


def by_size(group: str, *names: str) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """The benchmark at the sizes named, each in a group of its own."""
    return pytest.mark.parametrize(
        "size",
        [pytest.param(SIZES[name], id=name, marks=pytest.mark.benchmark(group=f"{group} {name}")) for name in names],
    )


def gmssl_cipher(mode: int) -> Any:
    peer = pytest.importorskip("gmssl.sm4")
    cipher = peer.CryptSM4()
    cipher.set_key(KEY, mode)
    return cipher


def openssl(make_mode: Callable[[Any], Any], data: bytes, *, decrypting: bool = False) -> Callable[[], bytes]:
    ciphers = pytest.importorskip("cryptography.hazmat.primitives.ciphers")
    mode, algorithm = make_mode(ciphers.modes), ciphers.algorithms.SM4

    def call() -> bytes:
        cipher = ciphers.Cipher(algorithm(KEY), mode)
        stream = cipher.decryptor() if decrypting else cipher.encryptor()
        return bytes(stream.update(data) + stream.finalize())

    return call


# ---------------------------------------------------------------- one block


@pytest.mark.benchmark(group="SM4 one block")
def test_block_smcrypto(benchmark: Any) -> None:
    cipher = sm4.SM4(KEY)
    # As a user calls it, the method looked up each time: the object changes to wide tables on its way.
    run(benchmark, "smcrypto", 16, lambda: cipher.encrypt_block(IV))


@pytest.mark.benchmark(group="SM4 one block")
def test_block_gmssl(benchmark: Any) -> None:
    """gmssl's block function itself, without the padding block that crypt_ecb adds."""
    cipher = gmssl_cipher(0)
    block = list(IV)
    run(benchmark, "gmssl", 16, lambda: cipher.one_round(cipher.sk, block))


@pytest.mark.benchmark(group="SM4 one block")
def test_block_cryptography(benchmark: Any) -> None:
    ciphers = pytest.importorskip("cryptography.hazmat.primitives.ciphers")
    stream = ciphers.Cipher(ciphers.algorithms.SM4(KEY), ciphers.modes.ECB()).encryptor()
    run(benchmark, "cryptography", 16, stream.update, IV)


@pytest.mark.benchmark(group="SM4 one block, new key")
def test_block_new_key_smcrypto(benchmark: Any) -> None:
    run(benchmark, "smcrypto", 16, lambda: sm4.SM4(KEY).encrypt_block(IV))


@pytest.mark.benchmark(group="SM4 one block, new key")
def test_block_new_key_gmssl(benchmark: Any) -> None:
    cipher = gmssl_cipher(0)

    def call() -> list[int]:
        cipher.set_key(KEY, 0)
        block: list[int] = cipher.one_round(cipher.sk, list(IV))
        return block

    run(benchmark, "gmssl", 16, call)


# ---------------------------------------------------------------- CTR

CTR_SIZES = ("64 B", "256 B", "1 KiB", "4 KiB", "16 KiB", "64 KiB", "1 MiB")


@by_size("SM4-CTR", *CTR_SIZES)
def test_ctr_smcrypto(benchmark: Any, size: int) -> None:
    engine = Engine(KEY)
    run(benchmark, "smcrypto", size, engine.ctr_xor, IV, bytes(size))


@by_size("SM4-CTR", *CTR_SIZES)
def test_ctr_gmssl(benchmark: Any, size: int) -> None:
    run(benchmark, "gmssl", size, gmssl_cipher(0).crypt_ecb, bytes(size))


@by_size("SM4-CTR", *CTR_SIZES)
def test_ctr_cryptography(benchmark: Any, size: int) -> None:
    run(benchmark, "cryptography", size, openssl(lambda modes: modes.CTR(IV), bytes(size)))


@by_size("SM4-CTR, new key,", "64 B", "256 B", "1 KiB", "1 MiB")
def test_ctr_new_key_smcrypto(benchmark: Any, size: int) -> None:
    run(benchmark, "smcrypto", size, sm4.encrypt, KEY, sm4.CTR(IV), bytes(size))


@by_size("SM4-CTR, new key,", "64 B", "256 B", "1 KiB", "1 MiB")
def test_ctr_new_key_gmssl(benchmark: Any, size: int) -> None:
    cipher = gmssl_cipher(0)

    def call(data: bytes) -> bytes:
        cipher.set_key(KEY, 0)
        sealed: bytes = cipher.crypt_ecb(data)
        return sealed

    run(benchmark, "gmssl", size, call, bytes(size))


# ---------------------------------------------------------------- CBC


@by_size("SM4-CBC encryption", "1 KiB", "64 KiB")
def test_cbc_encryption_smcrypto(benchmark: Any, size: int) -> None:
    run(benchmark, "smcrypto", size, sm4.encrypt, KEY, sm4.CBC(IV), bytes(size))


@by_size("SM4-CBC encryption", "1 KiB", "64 KiB")
def test_cbc_encryption_gmssl(benchmark: Any, size: int) -> None:
    run(benchmark, "gmssl", size, gmssl_cipher(0).crypt_cbc, IV, bytes(size))


@by_size("SM4-CBC encryption", "1 KiB", "64 KiB")
def test_cbc_encryption_cryptography(benchmark: Any, size: int) -> None:
    run(benchmark, "cryptography", size, openssl(lambda modes: modes.CBC(IV), bytes(size)))


@by_size("SM4-CBC decryption", "1 KiB", "64 KiB", "1 MiB")
def test_cbc_decryption_smcrypto(benchmark: Any, size: int) -> None:
    run(benchmark, "smcrypto", size, sm4.decrypt, KEY, sm4.CBC(IV), bytes(size))


@by_size("SM4-CBC decryption", "1 KiB", "64 KiB", "1 MiB")
def test_cbc_decryption_gmssl(benchmark: Any, size: int) -> None:
    run(benchmark, "gmssl", size, gmssl_cipher(1).crypt_cbc, IV, sm4.encrypt(KEY, sm4.CBC(IV), bytes(size)))


@by_size("SM4-CBC decryption", "1 KiB", "64 KiB", "1 MiB")
def test_cbc_decryption_cryptography(benchmark: Any, size: int) -> None:
    run(benchmark, "cryptography", size, openssl(lambda modes: modes.CBC(IV), bytes(size), decrypting=True))


# ---------------------------------------------------------------- ECB, XTS


@by_size("SM4-ECB", "1 MiB")
def test_ecb_smcrypto(benchmark: Any, size: int) -> None:
    run(benchmark, "smcrypto", size, sm4.encrypt, KEY, sm4.ECB(), bytes(size))


@by_size("SM4-ECB", "1 MiB")
def test_ecb_cryptography(benchmark: Any, size: int) -> None:
    run(benchmark, "cryptography", size, openssl(lambda modes: modes.ECB(), bytes(size)))


@by_size("SM4-XTS", "4 KiB", "1 MiB")
def test_xts_smcrypto(benchmark: Any, size: int) -> None:
    run(benchmark, "smcrypto", size, sm4.encrypt, XTS_KEY, sm4.XTS(IV), bytes(size))

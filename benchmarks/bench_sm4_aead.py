"""SM4-GCM and SM4-CCM beside OpenSSL's C (through cryptography); GHASH's forms beside each other.

No pure Python peer offers SM4-GCM; gmssl's SM4-CBC of as many bytes, which
protects nothing, stands in its place where messages are short. "Fresh key":
every round sets up a key and seals one message. "Known key": the key has
served a while, as a session's key has.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import count
from typing import Any

import pytest

from smcrypto.sm4 import SM4CCM, SM4GCM, ghash

KEY = bytes(range(16))
NONCE = bytes(12)
HEADER = bytes(32)
SIZES = {"256 B": 256, "512 B": 512, "1200 B": 1200, "4 KiB": 4096, "32 KiB": 32768, "1 MiB": 1 << 20}
SHORT = {name: SIZES[name] for name in ("256 B", "1200 B")}


def run(benchmark: Any, implementation: str, size: int, function: Callable[..., Any], *arguments: Any) -> None:
    benchmark.extra_info.update(implementation=implementation, bytes=size)
    benchmark(function, *arguments)


def by_size(group: str, sizes: dict[str, int] = SIZES) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """The benchmark at every size, each size in a group of its own."""
    return pytest.mark.parametrize(
        "size", [pytest.param(n, id=name, marks=pytest.mark.benchmark(group=f"{group} {name}"))
                 for name, n in sizes.items()]
    )


def known(kind: type[SM4GCM] | type[SM4CCM], size: int) -> SM4GCM | SM4CCM:
    cipher = kind(KEY)
    for _ in range(5):
        cipher.encrypt(NONCE, bytes(size), HEADER)
    return cipher


def openssl_seal(mode: Callable[..., Any], key: bytes, data: bytes) -> bytes:
    ciphers = pytest.importorskip("cryptography.hazmat.primitives.ciphers")
    stream = ciphers.Cipher(ciphers.algorithms.SM4(key), mode(NONCE)).encryptor()
    stream.authenticate_additional_data(HEADER)
    sealed: bytes = stream.update(data) + stream.finalize() + stream.tag
    return sealed


def openssl_gcm() -> Callable[..., Any]:
    gcm: Callable[..., Any] = pytest.importorskip("cryptography.hazmat.primitives.ciphers.modes").GCM
    return gcm


def gmssl_cbc(key: bytes, data: bytes) -> bytes:
    peer = pytest.importorskip("gmssl.sm4")
    cipher = peer.CryptSM4()
    cipher.set_key(key, peer.SM4_ENCRYPT)
    sealed: bytes = cipher.crypt_cbc(bytes(16), data)
    return sealed


@by_size("SM4-GCM, known key,")
def test_gcm_smcrypto(benchmark: Any, size: int) -> None:
    run(benchmark, "smcrypto", size, known(SM4GCM, size).encrypt, NONCE, bytes(size), HEADER)


@by_size("SM4-GCM, known key,")
def test_gcm_openssl(benchmark: Any, size: int) -> None:
    run(benchmark, "cryptography", size, openssl_seal, openssl_gcm(), KEY, bytes(size))


@by_size("SM4-GCM, known key,", SHORT)
def test_gcm_beside_gmssl_cbc(benchmark: Any, size: int) -> None:
    run(benchmark, "gmssl", size, gmssl_cbc, KEY, bytes(size))


@by_size("SM4-GCM decryption, known key,")
def test_gcm_decryption_smcrypto(benchmark: Any, size: int) -> None:
    cipher = known(SM4GCM, size)
    run(benchmark, "smcrypto", size, cipher.decrypt, NONCE, cipher.encrypt(NONCE, bytes(size), HEADER), HEADER)


@by_size("SM4-GCM decryption, known key,")
def test_gcm_decryption_openssl(benchmark: Any, size: int) -> None:
    ciphers = pytest.importorskip("cryptography.hazmat.primitives.ciphers")
    mode = openssl_gcm()
    sealed = openssl_seal(mode, KEY, bytes(size))

    def open_() -> bytes:
        stream = ciphers.Cipher(ciphers.algorithms.SM4(KEY), mode(NONCE, sealed[-16:])).decryptor()
        stream.authenticate_additional_data(HEADER)
        data: bytes = stream.update(sealed[:-16]) + stream.finalize()
        return data

    run(benchmark, "cryptography", size, open_)


@by_size("SM4-GCM, fresh key,", SHORT)
def test_fresh_gcm_smcrypto(benchmark: Any, size: int) -> None:
    number = count()
    run(benchmark, "smcrypto", size,
        lambda data: SM4GCM(next(number).to_bytes(16, "big")).encrypt(NONCE, data, HEADER), bytes(size))


@by_size("SM4-GCM, fresh key,", SHORT)
def test_fresh_gcm_openssl(benchmark: Any, size: int) -> None:
    number = count()
    mode = openssl_gcm()
    run(benchmark, "cryptography", size,
        lambda data: openssl_seal(mode, next(number).to_bytes(16, "big"), data), bytes(size))


@by_size("SM4-GCM, fresh key,", SHORT)
def test_fresh_gcm_beside_gmssl_cbc(benchmark: Any, size: int) -> None:
    number = count()
    run(benchmark, "gmssl", size, lambda data: gmssl_cbc(next(number).to_bytes(16, "big"), data), bytes(size))


CCM_SIZES = {name: SIZES[name] for name in ("256 B", "4 KiB")}


@by_size("SM4-CCM, known key,", CCM_SIZES)
def test_ccm_smcrypto(benchmark: Any, size: int) -> None:
    run(benchmark, "smcrypto", size, known(SM4CCM, size).encrypt, NONCE, bytes(size), HEADER)


@by_size("SM4-CCM, known key,", CCM_SIZES)
def test_ccm_beside_gmssl_cbc(benchmark: Any, size: int) -> None:
    run(benchmark, "gmssl", size, gmssl_cbc, KEY, bytes(size))


# --- what the switch-overs of ghash rest on -----------------------------------------------------------------------

H = 0x66E94BD4EF8A2C3B884CFA59CA342B2E


@pytest.mark.parametrize("form", ["serial", "in pairs", "8", "16, then 8", "32, then 8", "128, 32, then 8"])
@pytest.mark.parametrize(
    "blocks", [pytest.param(n, marks=pytest.mark.benchmark(group=f"GHASH of {n} blocks"))
               for n in (19, 24, 32, 40, 48, 77, 258, 514, 768, 1026, 2050, 8194, 12288, 16386, 65536)]
)
def test_ghash(benchmark: Any, blocks: int, form: str) -> None:
    folds = [int(n) for n in form.replace("then", "").split(",")] if form[0].isdigit() else []
    if blocks > 3000 if not folds else not folds[0] < blocks < 1000 * folds[0]:
        pytest.skip("far from any switch-over")
    T, T2 = ghash._multiples(H), ghash._multiples(ghash._square(H))
    chain = [ghash._Fold(H, n, early=n <= ghash._EARLY) for n in folds]

    def hashed(data: bytes) -> int:
        for fold in chain:
            data = fold.fold(data)
        return ghash._serial(T, data) if form == "serial" else ghash._in_pairs(T, T2, data)

    run(benchmark, form, 16 * blocks, hashed, bytes(range(256)) * (blocks // 16) + bytes(blocks % 16 * 16))

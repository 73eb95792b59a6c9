"""SM3 on both engines: our own beside the pure Python peers, hashlib's beside hashlib itself.

"Pure" groups run our compression function whatever `sm3.ENGINE` says. The
others run the public functions on the engine in use, which the JSON names.
"""

from __future__ import annotations

import hashlib
import hmac
from collections.abc import Callable
from typing import Any

import pytest

from smcrypto import _sm3_compression, kdf, sm3
from smcrypto._sm3_python import PythonSM3

SIZES = {"64 B": 64, "1 KiB": 1024, "64 KiB": 65536}
KEY = bytes(range(32))


def run(benchmark: Any, implementation: str, size: int, function: Callable[..., Any], *arguments: Any) -> None:
    benchmark.extra_info.update(implementation=implementation, bytes=size)
    benchmark(function, *arguments)


def python_digest(data: bytes) -> bytes:
    state = PythonSM3()
    state.update(data)
    return state.digest()


def needs_hashlib() -> None:
    if "sm3" not in hashlib.algorithms_available:
        pytest.skip("this Python's hashlib offers no SM3")


def by_size(group: str) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """The benchmark at every size, each size in a group of its own."""
    return pytest.mark.parametrize(
        "size", [pytest.param(n, id=name, marks=pytest.mark.benchmark(group=f"{group} {name}"))
                 for name, n in SIZES.items()]
    )


@by_size("SM3 pure")
def test_pure_smcrypto(benchmark: Any, size: int) -> None:
    run(benchmark, "smcrypto", size, python_digest, bytes(size))


@by_size("SM3 pure")
def test_pure_gmssl(benchmark: Any, size: int) -> None:
    peer = pytest.importorskip("gmssl.sm3")
    # A new list each time: sm3_hash pads the one it is given, in place.
    run(benchmark, "gmssl", size, lambda: peer.sm3_hash([0] * size))


@by_size("SM3 pure")
def test_pure_snowland(benchmark: Any, size: int) -> None:
    peer = pytest.importorskip("pysmx.SM3._SM3")
    run(benchmark, "snowland-smx", size, peer.digest, bytes(size))


@by_size("SM3 pure")
def test_pure_gmalg(benchmark: Any, size: int) -> None:
    peer = pytest.importorskip("gmalg")

    def digest(data: bytes) -> bytes:
        state = peer.SM3()
        state.update(data)
        value: bytes = state.value()
        return value

    run(benchmark, "gmalg", size, digest, bytes(size))


@by_size("SM3")
def test_digest_smcrypto(benchmark: Any, size: int) -> None:
    run(benchmark, "smcrypto", size, sm3.digest, bytes(size))


@by_size("SM3")
def test_digest_hashlib(benchmark: Any, size: int) -> None:
    needs_hashlib()
    run(benchmark, "hashlib", size, lambda data: hashlib.new("sm3", data).digest(), bytes(size))


@by_size("SM3 object")
def test_object_smcrypto(benchmark: Any, size: int) -> None:
    run(benchmark, "smcrypto", size, lambda data: sm3.SM3(data).digest(), bytes(size))


@by_size("SM3 object")
def test_object_hashlib(benchmark: Any, size: int) -> None:
    needs_hashlib()
    run(benchmark, "hashlib", size, lambda data: hashlib.new("sm3", data).digest(), bytes(size))


@by_size("HMAC-SM3")
def test_hmac_smcrypto(benchmark: Any, size: int) -> None:
    run(benchmark, "smcrypto", size, sm3.hmac, KEY, bytes(size))


@by_size("HMAC-SM3")
def test_hmac_hashlib(benchmark: Any, size: int) -> None:
    needs_hashlib()
    run(benchmark, "hashlib", size, lambda key, data: hmac.new(key, data, "sm3").digest(), KEY, bytes(size))


@pytest.mark.benchmark(group="SM2 KDF 1 KiB")
def test_sm2_kdf_smcrypto(benchmark: Any) -> None:
    run(benchmark, "smcrypto", 1024, kdf.sm2_kdf, bytes(64), 1024)


@pytest.mark.benchmark(group="SM2 KDF 1 KiB")
def test_sm2_kdf_gmssl(benchmark: Any) -> None:
    peer = pytest.importorskip("gmssl.sm3")
    run(benchmark, "gmssl", 1024, peer.sm3_kdf, bytes(64).hex().encode(), 1024)


@pytest.mark.benchmark(group="PBKDF2-HMAC-SM3, 1000 iterations")
def test_pbkdf2_smcrypto(benchmark: Any) -> None:
    run(benchmark, "smcrypto", 0, kdf.pbkdf2_hmac, b"password", b"salt", 1000, 32)


@pytest.mark.benchmark(group="PBKDF2-HMAC-SM3, 1000 iterations")
def test_pbkdf2_hashlib(benchmark: Any) -> None:
    needs_hashlib()
    run(benchmark, "hashlib", 0, hashlib.pbkdf2_hmac, "sm3", b"password", b"salt", 1000, 32)


@pytest.mark.benchmark(group="PBKDF2-HMAC-SM3 pure, 1000 iterations")
def test_pbkdf2_pure_smcrypto(benchmark: Any) -> None:
    run(benchmark, "smcrypto", 0, kdf._pbkdf2_python, b"password", b"salt", 1000, 32)


@pytest.mark.parametrize("way", ["together", "alone"])
@pytest.mark.parametrize(
    "blocks",
    [pytest.param(n, marks=pytest.mark.benchmark(group=f"SM3 expansion of {n} blocks")) for n in (2, 3, 4, 5, 8)],
)
def test_expansion(benchmark: Any, blocks: int, way: str) -> None:
    """What `_sm3_compression.MANY` rests on."""
    words = tuple(range(16 * blocks))

    def together() -> None:
        list(_sm3_compression.expand_many(words))

    def alone() -> None:
        for i in range(0, 16 * blocks, 16):
            _sm3_compression.expand_one(words[i : i + 16])

    run(benchmark, way, 64 * blocks, together if way == "together" else alone)

"""`python benchmarks/engines.py`: what the extra `fast` changes, each engine beside Python's in one process.

The two take turns, so that whatever else the machine does meets both, and the time is the processor's, which others
on a busy machine do not lengthen (but for the caches). Printed are medians, of the ratios too.
"""

from __future__ import annotations

import secrets
import time
from collections.abc import Callable, Iterator
from statistics import median
from typing import Any

from render import duration
from smcrypto import sm2, sm4
from smcrypto.optional import OptionalEngine
from smcrypto.sm2 import encryption, signature
from smcrypto.sm2.known_keys import KnownKeys
from smcrypto.sm2.points import ENGINE as SM2_ENGINE
from smcrypto.sm2.points import base_comb
from smcrypto.sm4.foreign import ENGINE as SM4_ENGINE

TURNS = 31
SIZES = {"64 B": 64, "1 KiB": 1024, "4 KiB": 4096, "64 KiB": 1 << 16, "1 MiB": 1 << 20}
KEY, IV = secrets.token_bytes(16), secrets.token_bytes(16)


def sm2_operations() -> Iterator[tuple[str, Callable[[], object]]]:
    """Signing, and with no key known: verifying, encrypting and decrypting."""
    for module in (signature, encryption):
        setattr(module, "known_keys", KnownKeys(stages=()))  # noqa: B010 - a name that is not meant to be replaced
    key = sm2.PrivateKey.generate()
    signed, sealed = key.sign(b"message"), key.public_key.encrypt(bytes(16))
    yield "SM2 sign", lambda: key.sign(b"message")
    yield "SM2 verify (new key)", lambda: key.public_key.verify(signed, b"message")
    yield "SM2 encrypt 16 B (new key)", lambda: key.public_key.encrypt(bytes(16))
    yield "SM2 decrypt 16 B", lambda: key.decrypt(sealed)


def sm4_operations() -> Iterator[tuple[str, Callable[[], object]]]:
    """One call with a key that is new to it, and AEAD with a key that stays."""
    modes: dict[str, sm4.Mode] = {"CTR": sm4.CTR(IV), "CBC": sm4.CBC(IV), "ECB": sm4.ECB(), "XTS": sm4.XTS(IV)}
    ways = {"encryption": sm4.encrypt, "decryption": sm4.decrypt}
    for name, way in (("CTR", "encryption"), ("ECB", "encryption"), ("CBC", "decryption"), ("CBC", "encryption"),
                      ("XTS", "encryption")):  # fmt: skip
        for size, length in SIZES.items():
            data, key = bytes(length), KEY * (2 if name == "XTS" else 1)
            yield f"SM4-{name} {way} {size}", lambda f=ways[way], k=key, m=modes[name], d=data: f(k, m, d)  # type: ignore[misc]
    for aead in (sm4.SM4GCM(KEY), sm4.SM4CCM(KEY)):
        for size, length in SIZES.items():
            yield f"{type(aead).__name__} {size}", lambda a=aead, d=bytes(length): a.encrypt(IV[:12], d)  # type: ignore[misc]


def seconds(operation: Callable[[], object], calls: int) -> float:
    began = time.process_time()
    for _ in range(calls):
        operation()
    return (time.process_time() - began) / calls


def compare(engine: OptionalEngine[Any], operations: Iterator[tuple[str, Callable[[], object]]]) -> None:
    loaded = engine._load()
    if loaded is None:
        print(f"| {engine._package} is not installed | | | |")
        return
    for name, operation in operations:
        times: dict[str, list[float]] = {"python": [], engine._package: []}
        for _ in range(TURNS):
            for engine.name, found in times.items():
                engine._loaded = None if engine.name == "python" else loaded
                base_comb.cache_clear()  # whose points are integers of the engine that computed them
                operation()
                found.append(seconds(operation, max(1, int(0.003 / seconds(operation, 1)))))
        pure, fast = times.values()
        ratio = median(p / f for p, f in zip(pure, fast, strict=True))
        print(f"| {name} | {duration(median(pure))} | {duration(median(fast))} | {ratio:.3g}× |")


def main() -> None:
    print("| what | Python | with `fast` | ratio |\n| --- | ---: | ---: | ---: |")
    compare(SM2_ENGINE, sm2_operations())
    compare(SM4_ENGINE, sm4_operations())


if __name__ == "__main__":
    main()

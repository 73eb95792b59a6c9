"""SM2 beside gmssl, gmalg and snowland-smx in pure Python, and gmssl-pyx around GmSSL's C (cryptography has no SM2).

What is timed is what a user calls: signing and verifying take the message (32
bytes) and hash it with Z, as sign_with_sm3 and verify_with_sm3 of gmssl do.
"New key": each round verifies or agrees with a key that was never used. "Key
seen before": the library has met the key several times.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import cycle
from typing import Any

import pytest

from smcrypto import sm2

D = 0x3945208F_7B2144B1_3F36E38A_C6D39F95_88939369_2860B51A_42FB81EF_4DF7C5B8
KEY = sm2.PrivateKey.from_int(D)
MESSAGE = bytes(range(32))
SESSION_KEY = bytes(range(16))
TEXT = bytes(range(256))
NEW_KEYS = 30  # rounds of the benchmarks that need a fresh key each time


def gmssl_key(mode: int = 1) -> Any:
    gmssl_sm2 = pytest.importorskip("gmssl.sm2")
    # Without its 04, since gmssl strips every leading 0 and 4.
    return gmssl_sm2.CryptSM2(f"{D:064x}", KEY.public_key.to_bytes()[1:].hex(), mode=mode)


def gmalg_key(uid: bytes = sm2.DEFAULT_UID) -> Any:
    gmalg = pytest.importorskip("gmalg")
    return gmalg.SM2(D.to_bytes(32, "big"), uid, KEY.public_key.to_bytes())


def gmssl_pyx() -> Any:
    return pytest.importorskip("gmssl_pyx")


def run(benchmark: Any, implementation: str, function: Callable[..., Any], *args: Any) -> None:
    benchmark.extra_info["implementation"] = implementation
    benchmark(function, *args)


def run_with_new_key(benchmark: Any, function: Callable[[sm2.PrivateKey], Callable[[], Any]]) -> None:
    """One round for each of many keys; `function` prepares the round."""
    benchmark.extra_info["implementation"] = "smcrypto"
    rounds = iter([function(sm2.PrivateKey.generate()) for _ in range(NEW_KEYS)])
    benchmark.pedantic(lambda call: call(), setup=lambda: ((next(rounds),), {}), rounds=NEW_KEYS)


def meet(public_key: sm2.PublicKey) -> None:
    """Use the key until the library knows it."""
    signature = KEY.sign(MESSAGE)
    for _ in range(80):
        public_key.verify(signature, MESSAGE)


@pytest.mark.benchmark(group="SM2 key generation")
def test_keygen_smcrypto(benchmark: Any) -> None:
    run(benchmark, "smcrypto", lambda: sm2.PrivateKey.generate().public_key)


@pytest.mark.benchmark(group="SM2 key generation")
def test_keygen_gmalg(benchmark: Any) -> None:
    run(benchmark, "gmalg", gmalg_key().generate_keypair)


@pytest.mark.benchmark(group="SM2 sign")
def test_sign_smcrypto(benchmark: Any) -> None:
    run(benchmark, "smcrypto", KEY.sign, MESSAGE)


@pytest.mark.benchmark(group="SM2 sign")
def test_sign_gmssl(benchmark: Any) -> None:
    run(benchmark, "gmssl", gmssl_key().sign_with_sm3, MESSAGE)


@pytest.mark.benchmark(group="SM2 sign")
def test_sign_gmssl_pyx(benchmark: Any) -> None:
    run(benchmark, "gmssl-pyx", gmssl_pyx().sm2_sign, KEY.to_bytes(), KEY.public_key.to_bytes()[1:], MESSAGE)


@pytest.mark.benchmark(group="SM2 sign")
def test_sign_snowland(benchmark: Any) -> None:
    """Of a digest: it has no Z, which costs one hash."""
    snowland = pytest.importorskip("pysmx.SM2")
    run(benchmark, "snowland-smx", snowland.Sign, MESSAGE, f"{D:064x}", "12345678901234567890", 64)


@pytest.mark.benchmark(group="SM2 verify (key seen before)")
def test_verify_gmssl_pyx(benchmark: Any) -> None:
    point = KEY.public_key.to_bytes()[1:]
    run(benchmark, "gmssl-pyx", gmssl_pyx().sm2_verify, point, MESSAGE, KEY.sign(MESSAGE))


@pytest.mark.benchmark(group="SM2 sign")
def test_sign_gmalg(benchmark: Any) -> None:
    run(benchmark, "gmalg", gmalg_key().sign, MESSAGE)


@pytest.mark.benchmark(group="SM2 verify (new key)")
def test_verify_new_key_smcrypto(benchmark: Any) -> None:
    def round_with(key: sm2.PrivateKey) -> Callable[[], None]:
        signature, public_key = key.sign(MESSAGE), key.public_key
        return lambda: public_key.verify(signature, MESSAGE)

    run_with_new_key(benchmark, round_with)


@pytest.mark.benchmark(group="SM2 verify (key seen before)")
def test_verify_seen_key_smcrypto(benchmark: Any) -> None:
    meet(KEY.public_key)
    run(benchmark, "smcrypto", KEY.public_key.verify, KEY.sign(MESSAGE), MESSAGE)


@pytest.mark.benchmark(group="SM2 verify (new key)")
def test_verify_new_key_gmssl(benchmark: Any) -> None:
    run_gmssl_verify(benchmark)


@pytest.mark.benchmark(group="SM2 verify (key seen before)")
def test_verify_seen_key_gmssl(benchmark: Any) -> None:
    run_gmssl_verify(benchmark)


def run_gmssl_verify(benchmark: Any) -> None:
    key = gmssl_key()
    signature = KEY.sign(MESSAGE, encoding="raw").hex()
    assert key.verify_with_sm3(signature, MESSAGE)
    run(benchmark, "gmssl", key.verify_with_sm3, signature, MESSAGE)


@pytest.mark.benchmark(group="SM2 encrypt 16 B (key seen before)")
def test_encrypt_seen_key_smcrypto(benchmark: Any) -> None:
    meet(KEY.public_key)
    run(benchmark, "smcrypto", KEY.public_key.encrypt, SESSION_KEY)


@pytest.mark.benchmark(group="SM2 encrypt 16 B (key seen before)")
def test_encrypt_seen_key_gmssl(benchmark: Any) -> None:
    run(benchmark, "gmssl", gmssl_key().encrypt, SESSION_KEY)


@pytest.mark.benchmark(group="SM2 decrypt 256 B")
def test_decrypt_smcrypto(benchmark: Any) -> None:
    run(benchmark, "smcrypto", KEY.decrypt, KEY.public_key.encrypt(TEXT))


@pytest.mark.benchmark(group="SM2 decrypt 256 B")
def test_decrypt_gmssl(benchmark: Any) -> None:
    ciphertext = KEY.public_key.encrypt(TEXT, encoding="c1c3c2")[1:]
    assert gmssl_key().decrypt(ciphertext) == TEXT
    run(benchmark, "gmssl", gmssl_key().decrypt, ciphertext)


@pytest.mark.benchmark(group="SM2 key exchange, one side (new peer)")
def test_exchange_new_peer_smcrypto(benchmark: Any) -> None:
    peer_ephemeral = sm2.PrivateKey.generate().public_key.to_bytes()

    def round_with(key: sm2.PrivateKey) -> Callable[[], None]:
        public_key = key.public_key
        return lambda: exchange(public_key, peer_ephemeral)

    run_with_new_key(benchmark, round_with)


@pytest.mark.benchmark(group="SM2 key exchange, one side (peer seen before)")
def test_exchange_seen_peer_smcrypto(benchmark: Any) -> None:
    meet(KEY.public_key)
    ephemerals = cycle([sm2.PrivateKey.generate().public_key.to_bytes() for _ in range(20)])
    run(benchmark, "smcrypto", lambda: exchange(KEY.public_key, next(ephemerals)))


def exchange(peer: sm2.PublicKey, peer_ephemeral: bytes) -> None:
    side = sm2.KeyExchange(KEY, b"A", peer, b"B", initiator=True)
    assert side.ephemeral
    side.agree(peer_ephemeral, 16)


@pytest.mark.benchmark(group="SM2 key exchange, one side (new peer)")
def test_exchange_new_peer_gmalg(benchmark: Any) -> None:
    run_gmalg_exchange(benchmark)


@pytest.mark.benchmark(group="SM2 key exchange, one side (peer seen before)")
def test_exchange_seen_peer_gmalg(benchmark: Any) -> None:
    run_gmalg_exchange(benchmark)


def run_gmalg_exchange(benchmark: Any) -> None:
    gmalg = pytest.importorskip("gmalg")
    own = gmalg_key(b"A")
    peer = sm2.PrivateKey.generate().public_key.to_bytes()
    peer_ephemeral = sm2.PrivateKey.generate().public_key.to_bytes()

    def once() -> bytes:
        _, t = own.begin_key_exchange()
        return bytes(own.end_key_exchange(16, t, peer_ephemeral, b"B", peer, gmalg.KEYXCHG_MODE.INITIATOR))

    run(benchmark, "gmalg", once)

"""The memory of public keys: bounded, earned by success, correct for any order of use."""

from __future__ import annotations

import os
import random
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import pytest

import sm2_reference as reference
from sm2_reference import TINY_61, TINY_1009
from smcrypto import InvalidSignature, sm2
from smcrypto.sm2 import SM2P256V1, encryption, exchange, signature
from smcrypto.sm2 import known_keys as module
from smcrypto.sm2.known_keys import KnownKeys, known_keys
from smcrypto.sm2.points import Comb

WIDTH_3 = 4 * 8  # points of a comb of that width: rows, and both signs of four odd multiples
POINTS = [reference.multiple(k, TINY_1009.G, TINY_1009) for k in range(1, 40)]


def with_combs(memory: KnownKeys) -> list[tuple[int, int]]:
    return [P for (_, P), record in memory._records.items() if record.comb]


def use(memory: KnownKeys, P, times: int, curve=TINY_1009) -> None:
    for _ in range(times):
        memory.used(curve, P)


def test_a_key_earns_a_comb_by_being_used():
    memory = KnownKeys(stages=((2, 3),))
    P = POINTS[0]
    assert memory.comb(TINY_1009, P) is None
    use(memory, P, 1)
    assert memory.comb(TINY_1009, P) is None
    use(memory, P, 1)
    comb = memory.comb(TINY_1009, P)
    assert comb is not None
    assert comb.curve is TINY_1009
    assert comb is memory.comb(TINY_1009, P)
    use(memory, P, 5)
    assert comb is memory.comb(TINY_1009, P)
    assert len(with_combs(memory)) == 1


def test_a_key_used_much_earns_a_wider_comb():
    memory = KnownKeys(stages=((2, 3), (5, 6)))
    P = POINTS[3]
    widths = []
    for _ in range(8):
        comb = memory.comb(TINY_1009, P)
        widths.append(comb and comb.width)
        use(memory, P, 1)
    assert widths == [None, None, 3, 3, 3, 6, 6, 6]
    assert len(with_combs(memory)) == 1


def test_while_one_thread_builds_a_comb_the_others_go_on(monkeypatch):
    memory = KnownKeys(stages=((1, 3), (2, 5)))
    P = POINTS[0]
    seen = []

    def slow_comb(*arguments):
        seen.append(memory.comb(TINY_1009, P))  # another thread asks while this one builds
        return Comb(*arguments)

    monkeypatch.setattr(module, "Comb", slow_comb)
    use(memory, P, 1)
    first = memory.comb(TINY_1009, P)
    use(memory, P, 1)
    second = memory.comb(TINY_1009, P)
    assert (first.width, second.width) == (3, 5)
    assert seen == [None, first]


def test_the_same_point_of_another_curve_is_another_key():
    memory = KnownKeys(stages=((1, 3),))
    use(memory, TINY_1009.G, 1)
    assert memory.comb(TINY_61, TINY_1009.G) is None


def test_the_number_of_combs_is_bounded_and_the_least_recently_used_goes():
    memory = KnownKeys(stages=((1, 3),), points=3 * WIDTH_3)
    for P in POINTS[:3]:
        use(memory, P, 1)
        memory.comb(TINY_1009, P)
    use(memory, POINTS[0], 1)
    use(memory, POINTS[3], 1)
    assert memory.comb(TINY_1009, POINTS[3]) is not None
    assert with_combs(memory) == [POINTS[2], POINTS[0], POINTS[3]]
    assert memory.comb(TINY_1009, POINTS[1]) is None
    for P in POINTS:
        use(memory, P, 1)
        memory.comb(TINY_1009, P)
        assert len(with_combs(memory)) == 3
    assert memory._points == 3 * WIDTH_3


@pytest.mark.parametrize("order", ["in turn", "at random"])
def test_where_keys_are_many_building_never_costs_more_than_their_uses_without_a_comb(order, monkeypatch):
    memory = KnownKeys(stages=((5, 3),), points=3 * WIDTH_3)
    built = []
    monkeypatch.setattr(module, "Comb", lambda *arguments: built.append(arguments) or Comb(*arguments))
    met = POINTS[:20] * 100 if order == "in turn" else random.Random(1).choices(POINTS[:20], k=2000)
    without = 0
    for P in met:
        without += memory.comb(TINY_1009, P) is None
        use(memory, P, 1)
    assert 3 <= len(built) <= without / 5
    for _ in range(20):  # the others stay away, and these three need their places
        for P in POINTS[30:33]:
            memory.comb(TINY_1009, P)
            use(memory, P, 1)
    assert with_combs(memory) == POINTS[30:33]


def test_a_wider_comb_takes_nobodys_place():
    memory = KnownKeys(stages=((1, 3), (4, 5)), points=3 * WIDTH_3)
    for P in POINTS[:3]:
        use(memory, P, 1)
        memory.comb(TINY_1009, P)
    use(memory, POINTS[0], 9)
    assert memory.comb(TINY_1009, POINTS[0]).width == 3
    assert with_combs(memory) == [*POINTS[1:3], POINTS[0]]
    memory = KnownKeys(stages=((1, 3), (4, 5)), points=3 * WIDTH_3)
    for P in POINTS[:2]:
        use(memory, P, 1)
        memory.comb(TINY_1009, P)
    use(memory, POINTS[0], 9)
    assert memory.comb(TINY_1009, POINTS[0]).width == 5


def test_a_comb_that_no_room_is_left_for_serves_once():
    memory = KnownKeys(stages=((1, 3),), points=WIDTH_3 - 1)
    use(memory, POINTS[0], 1)
    assert memory.comb(TINY_1009, POINTS[0]) is not None
    assert memory._points == 0 and not memory._records


def test_the_number_of_keys_is_bounded():
    memory = KnownKeys(stages=((2, 3),), keys=5)
    for _ in range(3):
        for P in POINTS[:10]:  # each forgotten before it comes round again
            use(memory, P, 1)
            assert memory.comb(TINY_1009, P) is None
    assert len(memory._records) == 5


def test_only_signatures_that_hold_count(monkeypatch):
    memory = KnownKeys(stages=((1, 3),))
    monkeypatch.setattr(signature, "known_keys", memory)
    key = sm2.PrivateKey.generate()
    signed = key.sign(b"message")
    for _ in range(3):
        with pytest.raises(InvalidSignature):
            key.public_key.verify(signed, b"massage")
    assert memory.comb(SM2P256V1, key.public_key.point) is None
    key.public_key.verify(signed, b"message")
    assert memory.comb(SM2P256V1, key.public_key.point) is not None


def test_results_are_the_same_before_and_after_a_key_is_known(monkeypatch):
    memory = KnownKeys(stages=((3, 4), (8, 6)))
    for user in (signature, encryption, exchange):
        monkeypatch.setattr(user, "known_keys", memory)
    key, peer = sm2.PrivateKey.generate(), sm2.PrivateKey.generate()
    signed = key.sign(b"message")
    r = sm2.PrivateKey.from_int(77)
    outcomes = set()
    for _ in range(10):
        key.public_key.verify(signed, b"message")
        with pytest.raises(InvalidSignature):
            key.public_key.verify(signed, b"massage")
        side = sm2.KeyExchange(peer, b"", key.public_key, b"", initiator=True, ephemeral_key=r)
        outcomes.add(side.agree(sm2.PrivateKey.from_int(99).public_key.to_bytes(), 16, unconfirmed=True))
        outcomes.add(repr(encryption.encrypt(SM2P256V1, key.public_key.point, b"message", iter([1234567]))))
    assert len(outcomes) == 2
    assert len(with_combs(memory)) == 1


def test_several_threads_share_the_memory():
    memory = KnownKeys(stages=((2, 3), (20, 5)), points=4 * WIDTH_3)

    def work(i: int) -> None:
        P = POINTS[i % 6]
        comb = memory.comb(TINY_1009, P)
        if comb is not None:
            assert comb.rows[0][len(comb.rows[0]) // 2] == P
        memory.used(TINY_1009, P)

    with ThreadPoolExecutor(8) as pool:
        list(pool.map(work, range(2000)))
    assert 1 <= len(with_combs(memory)) <= 4
    assert memory._points == sum(record.points() for record in memory._records.values())


def test_a_key_that_went_and_came_back_while_its_comb_was_built_counts_once(monkeypatch):
    memory = KnownKeys(stages=((1, 3), (20, 5)), points=3 * WIDTH_3)
    P, *others = POINTS[:4]

    def slow_comb(point, width, curve):
        if width == 5:  # meanwhile, in other threads, the others take all places, and P then one of theirs
            for Q in (*others, P):
                use(memory, Q, 1)
                memory.comb(curve, Q)
        return Comb(point, width, curve)

    monkeypatch.setattr(module, "Comb", slow_comb)
    use(memory, P, 1)
    memory.comb(TINY_1009, P)
    use(memory, P, 19)
    assert memory.comb(TINY_1009, P).width == 5
    assert memory._points == sum(record.points() for record in memory._records.values()) == 3 * WIDTH_3
    assert memory.comb(TINY_1009, P).width == 3


FORK = """
import os, signal, threading
from smcrypto.sm2.curve import SM2P256V1
from smcrypto.sm2.known_keys import known_keys

known_keys._lock.acquire()  # as another thread would hold it
threading.Timer(0.1, known_keys._lock.release).start()
child = os.fork()
if not child:
    signal.alarm(10)
    known_keys.used(SM2P256V1, SM2P256V1.G)
    os._exit(0)
assert os.waitpid(child, 0)[1] == 0
known_keys.used(SM2P256V1, SM2P256V1.G)
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="forks")
def test_a_child_does_not_wait_for_a_thread_that_it_has_not():
    subprocess.run([sys.executable, "-W", "ignore", "-c", FORK], check=True, timeout=60)


def test_the_shared_memory_is_bounded():
    assert known_keys._limits == (262_144, 1024)

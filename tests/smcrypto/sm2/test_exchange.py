"""Key exchange, GB/T 32918.3: vectors with both confirmations, order of calls, hostile points."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

import sm2_reference as reference
from sm2_reference import CURVES, SAMPLE, TINY_17, TINY_61, TINY_79, number
from smcrypto import ConfirmationError, InvalidKey, InvalidLength, OutOfOrder, sm2, sm3, sm4
from smcrypto.sm2 import SM2P256V1, KeyExchange, PrivateKey
from smcrypto.sm2.curve import encode_point
from smcrypto.sm2.exchange import reduced_x, shared_point
from vectors_json import load

pytestmark = pytest.mark.usefixtures("sm2_engine")

A, B = PrivateKey.from_int(0xA11CE), PrivateKey.from_int(0xB0B)
SCALARS = st.integers(1, SM2P256V1.n - 2)


def pair(a=A, b=B, **ephemeral):
    return (
        KeyExchange(a, b"Alice", b.public_key, b"Bob", initiator=True, ephemeral_key=ephemeral.get("r_a")),
        KeyExchange(b, b"Bob", a.public_key, b"Alice", initiator=False, ephemeral_key=ephemeral.get("r_b")),
    )


@pytest.mark.parametrize("v", load("standards/sm2_key_exchange.json"))
def test_vectors(v):
    curve = CURVES[v.curve]
    a, b, r_a, r_b = (PrivateKey(number(d), curve) for d in (v.dA, v.dB, v.rA, v.rB))
    assert (a.public_key.to_bytes(), b.public_key.to_bytes()) == (v.PA, v.PB)
    for _ in range(4):  # with and without combs of the long-term keys
        alice = KeyExchange(a, v.ida, b.public_key, v.idb, initiator=True, ephemeral_key=r_a)
        bob = KeyExchange(b, v.idb, a.public_key, v.ida, initiator=False, ephemeral_key=r_b)
        assert (alice.ephemeral, bob.ephemeral) == (v.RA, v.RB)
        assert bob.agree(alice.ephemeral, v.klen) == (v.K, v.S1_SB)
        assert alice.agree(bob.ephemeral, v.klen) == (v.K, v.S2_SA)
        assert alice.confirm(v.S1_SB) == bob.confirm(v.S2_SA) == v.K
    U = shared_point(curve, a.to_int(), r_a.to_int(), r_a.public_key.point, b.public_key.point, r_b.public_key.point)
    assert encode_point(U, curve) == v.U


@given(d_a=SCALARS, d_b=SCALARS, r_a=SCALARS, r_b=SCALARS, length=st.integers(1, 200))
def test_both_sides_agree(d_a, d_b, r_a, r_b, length):
    alice, bob = pair(*map(PrivateKey.from_int, (d_a, d_b)), r_a=PrivateKey.from_int(r_a), r_b=PrivateKey.from_int(r_b))
    key, s_a = alice.agree(bob.ephemeral, length)
    same, s_b = bob.agree(alice.ephemeral, length)
    assert key == same
    assert len(key) == length
    assert len(s_a) == len(s_b) == 32
    assert s_a != s_b
    alice.confirm(s_b)
    bob.confirm(s_a)


@pytest.mark.parametrize("curve", [TINY_17, TINY_61, TINY_79], ids=lambda c: c.name)
def test_the_shared_point_is_that_of_the_definition(curve):
    n = curve.n
    group = [reference.multiple(k, curve.G, curve) for k in range(n)]
    infinite = 0
    for d_b in range(1, n - 1, 5):
        for r_b in range(1, n, 3):
            for d_a, r_a in ((1, 1), (2, n - 1), (n // 2, 5), (n - 2, n // 3)):
                R_A, R_B = group[r_a], group[r_b]
                t_a = (d_a + reduced_x(R_A, curve) * r_a) % n
                expected = group[t_a * (d_b + reduced_x(R_B, curve) * r_b) % n]
                assert shared_point(curve, d_a, r_a, R_A, group[d_b], R_B) == expected
                infinite += expected is None
    assert infinite or curve.n < 20


def test_reduced_x_keeps_half_of_the_bits():
    # w = ceil(ceil(log2 n)/2) - 1 = 127 for 256 bits.
    x = (1 << 256) - 1
    assert reduced_x((x, 0), SM2P256V1) == (1 << 128) - 1
    assert reduced_x((1 << 127, 0), SM2P256V1) == 1 << 127
    assert reduced_x((0b1010111, 0), TINY_61) == 0b111  # log2 61 < 6, w = 2


def test_an_infinite_shared_point_is_refused_and_changes_nothing():
    # t = d + x~ r = 0 modulo n for one's own key, found on a tiny curve.
    curve = TINY_61
    r, d = next(
        (r, d)
        for r in range(1, 60)
        for d in [-reduced_x(reference.multiple(r, curve.G, curve), curve) * r % curve.n]
        if 1 <= d <= curve.n - 2
    )
    own, peer = PrivateKey(d, curve), PrivateKey(7, curve)
    side = KeyExchange(own, b"", peer.public_key, b"", initiator=True, ephemeral_key=PrivateKey(r, curve))
    for _ in range(2):
        with pytest.raises(InvalidKey, match="infinity"):
            side.agree(PrivateKey(9, curve).public_key.to_bytes(), 16)


def test_a_changed_confirmation_is_refused_and_ends_the_exchange():
    alice, bob = pair()
    _, s_b = bob.agree(alice.ephemeral, 16)
    alice.agree(bob.ephemeral, 16)
    with pytest.raises(ConfirmationError):
        alice.confirm(bytes([s_b[0] ^ 1]) + s_b[1:])
    with pytest.raises(OutOfOrder):
        alice.confirm(s_b)


def test_the_key_is_handed_out_by_confirm_or_when_asked_for_unconfirmed():
    alice, bob = pair()
    unconfirmed, s_b = bob.agree(alice.ephemeral, 16)
    key, _ = alice.agree(bob.ephemeral, 16, unconfirmed=True)
    for use in (bytes, memoryview, sm4.SM4, lambda k: sm3.hmac(k, b"")):
        with pytest.raises(TypeError):
            use(unconfirmed)
    assert key.hex() not in repr(unconfirmed) and not isinstance(unconfirmed, bytes)
    assert unconfirmed == key and unconfirmed != bytes(16) and unconfirmed != key.hex() and len(unconfirmed) == 16
    confirmed = alice.confirm(s_b)
    assert type(confirmed) is bytes and confirmed == key
    with pytest.raises(TypeError, match="unconfirmed must be"):
        pair()[0].agree(bob.ephemeral, 16, unconfirmed=1)


def test_each_side_expects_the_others_confirmation():
    for wrong in (lambda s_a, s_b: s_a, lambda s_a, s_b: b"", lambda s_a, s_b: s_b + b"\0", lambda s_a, s_b: s_b[:31]):
        alice, bob = pair()
        _, s_b = bob.agree(alice.ephemeral, 16)
        _, s_a = alice.agree(bob.ephemeral, 16)
        with pytest.raises(ConfirmationError):
            alice.confirm(wrong(s_a, s_b))
        bob.confirm(s_a)


@pytest.mark.parametrize("difference", ["uid", "key", "role", "ephemeral"])
def test_sides_that_differ_in_anything_do_not_confirm(difference):
    alice, bob = pair()
    sent = alice.ephemeral
    if difference == "uid":
        bob = KeyExchange(B, b"Bob", A.public_key, b"Eve", initiator=False)
    elif difference == "key":
        bob = KeyExchange(PrivateKey.from_int(0xE7E), b"Bob", A.public_key, b"Alice", initiator=False)
    elif difference == "role":
        bob = KeyExchange(B, b"Bob", A.public_key, b"Alice", initiator=True)
    else:
        sent = PrivateKey.generate().public_key.to_bytes()
    key, s_b = bob.agree(sent, 16)
    other, s_a = alice.agree(bob.ephemeral, 16)
    assert key != other
    with pytest.raises(ConfirmationError):
        alice.confirm(s_b)
    with pytest.raises(ConfirmationError):
        bob.confirm(s_a)


def test_the_order_of_calls():
    alice, bob = pair()
    with pytest.raises(OutOfOrder):
        alice.confirm(bytes(32))
    _, s_b = bob.agree(alice.ephemeral, 16)
    alice.agree(bob.ephemeral, 16)
    with pytest.raises(OutOfOrder):
        alice.agree(bob.ephemeral, 16)
    assert len(alice.ephemeral) == 65
    alice.confirm(s_b)
    with pytest.raises(OutOfOrder):
        alice.confirm(s_b)


@pytest.mark.parametrize(
    "point",
    [
        b"",
        b"\0",
        bytes(65),
        B.public_key.to_bytes(compressed=True),
        B.public_key.to_bytes()[:-1],
        B.public_key.to_bytes() + b"\0",
        B.public_key.to_bytes()[:-1] + bytes([B.public_key.to_bytes()[-1] ^ 1]),
        b"\x06" + B.public_key.to_bytes()[1:],
    ],
    ids=["empty", "infinity", "zeros", "compressed", "short", "long", "off the curve", "hybrid"],
)
def test_a_bad_ephemeral_point_is_refused_and_the_exchange_goes_on(point):
    alice, bob = pair()
    with pytest.raises(InvalidKey):
        alice.agree(point, 16)
    assert alice.agree(bob.ephemeral, 16)[0] == bob.agree(alice.ephemeral, 16)[0]


@pytest.mark.parametrize("length", [0, -1, 32 * (2**32 - 1)])
def test_lengths_of_the_key(length):
    alice, bob = pair()
    with pytest.raises(InvalidLength):
        alice.agree(bob.ephemeral, length)


def test_arguments_of_the_wrong_kind():
    for build in (
        lambda: KeyExchange(A.public_key, b"", B.public_key, b"", initiator=True),
        lambda: KeyExchange(A, b"", B, b"", initiator=True),
        lambda: KeyExchange(A, "", B.public_key, b"", initiator=True),
        lambda: KeyExchange(A, b"", B.public_key, None, initiator=True),
        lambda: KeyExchange(A, b"", B.public_key, b"", initiator=1),
        lambda: KeyExchange(A, b"", B.public_key, b"", initiator=True, ephemeral_key=5),
        lambda: KeyExchange(A, b"", B.public_key, b"", initiator=True, ephemeral_key=0),
        lambda: KeyExchange(A, b"", B.public_key, b"", True),
        lambda: pair()[0].agree("04", 16),
        lambda: pair()[0].agree(B.public_key.to_bytes(), 16.0),
        lambda: pair()[0].agree(B.public_key.to_bytes(), True),
        lambda: pair()[0].confirm(None),
    ):
        with pytest.raises(TypeError):
            build()
    with pytest.raises(InvalidLength):
        KeyExchange(A, bytes(8192), B.public_key, b"", initiator=True)
    with pytest.raises(InvalidLength):
        KeyExchange(A, b"", B.public_key, bytes(8192), initiator=True)


def test_the_keys_are_of_one_curve():
    other = PrivateKey(5, SAMPLE)
    with pytest.raises(InvalidKey, match="same curve"):
        KeyExchange(A, b"", other.public_key, b"", initiator=True)
    with pytest.raises(InvalidKey, match="same curve"):
        KeyExchange(A, b"", B.public_key, b"", initiator=True, ephemeral_key=other)


def test_ephemeral_keys_are_fresh_and_do_not_outlive_the_agreement():
    exchanges = [KeyExchange(A, b"", B.public_key, b"", initiator=True) for _ in range(5)]
    assert len({side.ephemeral for side in exchanges}) == 5
    exchanges[0].agree(exchanges[1].ephemeral, 16)
    held = [getattr(exchanges[0], name) for name in KeyExchange.__slots__]
    assert [value for value in held if isinstance(value, sm2.PrivateKey)] == [A]

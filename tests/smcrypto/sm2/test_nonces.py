"""Nonces: in range, fresh, and harmless when the random source fails."""

from __future__ import annotations

from itertools import islice

import pytest
from hypothesis import given
from hypothesis import strategies as st

from smcrypto import sm2
from smcrypto.sm2 import SM2P256V1, signature
from smcrypto.sm2.nonces import hedged_nonces

N = SM2P256V1.n
KEY = sm2.PrivateKey.from_int(0x3945208F_7B2144B1_3F36E38A_C6D39F95_88939369_2860B51A_42FB81EF_4DF7C5B8)


def broken(length: int) -> bytes:
    return bytes(length)


def first(secret=b"s" * 32, digest=bytes(32), label=b"SM2 signature", n=N, entropy=broken) -> int:
    return next(hedged_nonces(n, label, secret, digest, entropy=entropy))


@given(n=st.integers(3, 2**256), digest=st.binary(min_size=32, max_size=32))
def test_candidates_are_in_range(n, digest):
    for k in islice(hedged_nonces(n, b"", b"", digest), 5):
        assert 1 <= k <= n - 1


def test_every_number_of_a_small_range_is_drawn():
    assert set(islice(hedged_nonces(8, b"", b"", b""), 500)) == set(range(1, 8))


def test_with_a_constant_source_nonces_depend_on_key_message_purpose_and_attempt():
    nonces = {
        first(),
        first(secret=b"t" * 32),
        first(digest=b"\1" + bytes(31)),
        first(label=b"SM2 encryption"),
        *islice(hedged_nonces(N, b"SM2 signature", b"s" * 32, bytes(32), entropy=broken), 1, 4),
    }
    assert len(nonces) == 7
    assert first() == first()


def test_with_a_good_source_nonces_never_repeat():
    draws = [next(hedged_nonces(N, b"", b"s", b"d")) for _ in range(50)]
    assert len(set(draws)) == 50


def leaked_key(e1, r1, s1, e2, r2, s2):
    """d, if both signatures had the same k: s (1 + d) = k - r d gives s1 - s2 = -d (s1 - s2 + r1 - r2)."""
    return -(s1 - s2) * pow(s1 - s2 + r1 - r2, -1, N) % N


def test_a_repeated_nonce_gives_the_key_away():
    """What the hedging prevents, so that the next test can fail."""
    inverse = pow(1 + KEY.to_int(), -1, N)
    (r1, s1), (r2, s2) = (signature.sign(SM2P256V1, inverse, e, iter([12345])) for e in (1, 2))
    assert leaked_key(1, r1, s1, 2, r2, s2) == KEY.to_int()


def test_a_constant_random_source_does_not_give_the_key_away(monkeypatch):
    monkeypatch.setattr(hedged_nonces, "__kwdefaults__", {"entropy": broken})
    digests = [bytes(31) + bytes([i]) for i in range(2)]
    signed = [signature.decode_signature(KEY.sign_digest(e), SM2P256V1, "der") for e in digests]
    (r1, s1), (r2, s2) = signed
    # x1 = r - e is the x of [k]G: equal k would show.
    assert (r1 - 0) % N != (r2 - 1) % N
    assert leaked_key(0, r1, s1, 1, r2, s2) != KEY.to_int()
    # Now signing is deterministic, and the signatures are good.
    assert KEY.sign_digest(digests[0]) == KEY.sign_digest(digests[0])
    KEY.public_key.verify_digest(KEY.sign_digest(digests[0]), digests[0])


def test_a_constant_random_source_does_not_repeat_the_key_stream_of_other_messages(monkeypatch):
    monkeypatch.setattr(hedged_nonces, "__kwdefaults__", {"entropy": broken})
    one, two = (KEY.public_key.encrypt(m, encoding="c1c3c2") for m in (b"attack at dawn", b"attack at noon"))
    assert one[:65] != two[:65]


def test_the_random_source_is_the_operating_systems(monkeypatch):
    import secrets

    assert hedged_nonces.__kwdefaults__["entropy"] is secrets.token_bytes
    asked = []
    monkeypatch.setattr(
        hedged_nonces, "__kwdefaults__", {"entropy": lambda length: asked.append(length) or secrets.token_bytes(length)}
    )
    KEY.sign(b"message")
    KEY.public_key.encrypt(b"message")
    assert asked == [32, 32]


@pytest.mark.parametrize("length", [0, 1, 32])
def test_signing_works_whatever_is_signed(length):
    KEY.public_key.verify(KEY.sign(bytes(length)), bytes(length))

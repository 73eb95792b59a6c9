"""SM3 (GB/T 32905-2016) and HMAC-SM3 against the standards, peers, and the transcribed definition."""

from __future__ import annotations

import hashlib
import hmac
import os
import random
import struct
import subprocess
import sys

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sm3_reference import compress_by_definition, expand_by_definition
from smcrypto import _sm3_compression as compression
from smcrypto import sm3
from smcrypto._sm3_python import PythonSM3
from vectors_json import load

# Around one block, two, and the four from which blocks are expanded together; and past one batch of 256.
LENGTHS = [
    *range(131), 183, 184, 191, 192, 247, 248, 255, 256, 257, 319, 320, 321, 64 * 256, 64 * 257 + 1, 64 * 259 - 9,
]


def by_definition(message: bytes) -> bytes:
    """SM3 of GB/T 32905-2016, 5, on the transcribed expansion and compression."""
    padded = message + b"\x80" + bytes((55 - len(message)) % 64) + (8 * len(message)).to_bytes(8, "big")
    V = compression.IV
    for block in struct.iter_unpack(">16I", padded):
        V = compress_by_definition(V, expand_by_definition(block))
    return struct.pack(">8I", *V)


@pytest.mark.parametrize("v", load("standards/sm3.json") + load("third_party/sm3.json"))
def test_vectors(v, sm3_engine):
    assert sm3.digest(v.msg) == v.digest


@pytest.mark.parametrize("v", [case for case in load("standards/sm3.json") if len(case.values[0].msg) < 1000])
def test_the_transcribed_definition_gives_the_standards_values(v):
    assert by_definition(v.msg) == v.digest


@pytest.mark.parametrize("v", load("standards/hmac_sm3.json") + load("third_party/hmac_sm3.json"))
def test_hmac_vectors(v, sm3_engine):
    length = v.tag_size // 8
    tags = {
        sm3.hmac(v.key, v.msg)[:length],
        hmac.new(v.key, v.msg, sm3.SM3).digest()[:length],
        hmac.new(v.key, v.msg, sm3).digest()[:length],
    }
    assert (tags == {v.tag}) is (v.result == "valid")


def test_the_engines_and_the_definition_agree_at_every_switch_over():
    stream = random.Random(1).randbytes(max(LENGTHS))
    for length in LENGTHS:
        python = PythonSM3()
        python.update(stream[:length])
        assert python.digest() == by_definition(stream[:length]), length


@given(st.lists(st.binary(max_size=300), max_size=6))
def test_any_cut_of_the_message_gives_one_digest(pieces):
    whole = by_definition(b"".join(pieces))
    python, public = PythonSM3(), sm3.SM3()
    for piece in pieces:
        python.update(piece)
        public.update(piece)
    assert python.digest() == public.digest() == whole


@given(st.integers(1, 12), st.integers(0, 2**32))
def test_blocks_expanded_together_are_the_blocks_expanded_alone(n, seed):
    source = random.Random(seed)
    words = tuple(source.getrandbits(32) for _ in range(16 * n))
    alone = [expand_by_definition(words[i : i + 16]) for i in range(0, 16 * n, 16)]
    assert list(compression.expand_many(words)) == alone
    assert [compression.expand_one(words[i : i + 16]) for i in range(0, 16 * n, 16)] == alone


@pytest.mark.parametrize("word", [0, 0xFFFFFFFF, 0x80000000, 1])
def test_compression_at_the_extremes_of_its_words(word):
    """All ones carry furthest: nothing of the unmasked upper bits may reach a word."""
    V, block = (word,) * 8, (word,) * 16
    expanded = expand_by_definition(block)
    assert compression.expand_one(block) == expanded
    assert compression.compress(V, [expanded]) == compress_by_definition(V, expanded)


@given(st.tuples(*[st.integers(0, 2**32 - 1)] * 8), st.tuples(*[st.integers(0, 2**32 - 1)] * 16))
def test_unrolled_compression_is_the_definition(V, block):
    expanded = expand_by_definition(block)
    assert compression.compress(V, [expanded]) == compress_by_definition(V, expanded)


@given(st.binary(max_size=200), st.binary(max_size=200))
def test_hmac_is_rfc_2104_written_out(key, message):
    block = (sm3.digest(key) if len(key) > 64 else key).ljust(64, b"\0")
    inner = sm3.digest(bytes(b ^ 0x36 for b in block) + message)
    assert sm3.hmac(key, message) == sm3.digest(bytes(b ^ 0x5C for b in block) + inner)


def test_digest_may_be_asked_for_at_any_time(sm3_engine):
    h = sm3.SM3(b"a")
    assert h.digest() == h.digest() == sm3.digest(b"a")
    h.update(b"bc")
    assert h.hexdigest() == "66c7f0f462eeedd9d1f2d46bdc10e4e24167c4875cf2f7a2297da02b8f4ba8e0"


def test_copies_go_their_own_ways(sm3_engine):
    shared = b"longer than a block of sixty-four bytes, to be quite sure that a state is copied "
    first = sm3.SM3(shared)
    second = first.copy()
    first.update(b"one")
    second.update(b"two")
    assert type(second) is sm3.SM3
    assert first.digest() != second.digest()
    assert second.digest() == sm3.digest(shared + b"two")


def test_the_protocol_of_hashlib(sm3_engine):
    h, known = sm3.new(b"abc"), hashlib.sha256()
    assert (h.name, h.digest_size, h.block_size) == ("sm3", 32, 64)
    assert sm3.SM3.digest_size == 32 and sm3.SM3.block_size == 64
    for name in ("name", "digest_size", "block_size", "update", "digest", "hexdigest", "copy"):
        assert hasattr(known, name) and hasattr(h, name)
    assert h.update(b"d") is None
    assert isinstance(h.digest(), bytes) and isinstance(h.hexdigest(), str)
    assert sm3_engine in repr(h) and "abc" not in repr(h)


def test_streaming_hmac_of_the_standard_library(sm3_engine):
    mac = hmac.new(b"key" * 30, digestmod=sm3.SM3)
    mac.update(b"in ")
    mac.update(b"pieces")
    assert mac.digest() == sm3.hmac(b"key" * 30, b"in pieces")


def test_hmac_of_more_than_openssl_takes_at_once(monkeypatch):
    def digest(key, data, name):
        raise OverflowError("msg is too long.")

    monkeypatch.setattr(hmac, "digest", digest)
    monkeypatch.setattr(sm3, "_INT_MAX", 99)
    for key, data in ((b"key", bytes(100)), (bytes(100), b"data")):
        assert sm3.hmac(key, data) == hmac.new(key, data, sm3.SM3).digest()


def every_second_byte(b: bytes) -> memoryview:
    return memoryview(b"x".join(bytes([c]) for c in b))[::2]


@pytest.mark.parametrize("kind", [bytes, bytearray, memoryview, every_second_byte])
def test_any_bytes_like_object(kind, sm3_engine):
    data = bytes(range(200))
    assert sm3.digest(kind(data)) == sm3.SM3(kind(data)).digest() == sm3.digest(data)
    assert sm3.hmac(kind(data), kind(data)) == sm3.hmac(data, data)


@pytest.mark.parametrize("bad", ["abc", 3, None, [1, 2], 1.5])
def test_anything_else_is_a_type_error(bad, sm3_engine):
    h = sm3.SM3()
    for call in (sm3.SM3, sm3.new, sm3.digest, h.update, lambda x: sm3.hmac(x, b""), lambda x: sm3.hmac(b"", x)):
        with pytest.raises(TypeError):
            call(bad)


def test_openssl_and_python_agree_on_random_lengths():
    try:
        hashlib.new("sm3")
    except ValueError:
        pytest.skip("this Python's hashlib offers no SM3")
    source = random.Random(2)
    for _ in range(60):
        data = source.randbytes(source.randrange(5000))
        python = PythonSM3()
        python.update(data)
        assert python.digest() == hashlib.new("sm3", data).digest()


def test_gmssl_agrees():
    peer = pytest.importorskip("gmssl.sm3")
    data = random.Random(3).randbytes(777)
    assert sm3.digest(data).hex() == peer.sm3_hash(list(data))


# --- choosing the engine ---------------------------------------------------------------------------------------


def _in_a_new_process(code: str, **environment: str) -> str:
    run = subprocess.run(
        [sys.executable, "-c", code],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), **environment},
        capture_output=True, text=True, check=True, timeout=60,
    )
    return run.stdout.strip()


def test_the_environment_selects_pure_python():
    code = "from smcrypto import sm3; print(sm3.ENGINE, sm3.digest(b'abc').hex()[:8])"
    assert _in_a_new_process(code, SMCRYPTO_PURE="1") == "python 66c7f0f4"


def test_where_hashlib_offers_sm3_its_engine_is_used_and_ours_is_not_even_loaded():
    code = ("import sys; from smcrypto import sm3; sm3.hmac(b'', b''); "
            "print(sm3.ENGINE, 'smcrypto._sm3_compression' in sys.modules)")
    expected = "openssl False" if "sm3" in hashlib.algorithms_available else "python True"
    assert _in_a_new_process(code, SMCRYPTO_PURE="0") == expected


def test_where_hashlib_refuses_sm3_ours_is_used():
    """As an OpenSSL built or configured without SM3 does."""
    code = """
import hashlib
offered = hashlib.new
def refusing(name, *rest, **options):
    if name == "sm3":
        raise ValueError("unsupported hash type sm3")
    return offered(name, *rest, **options)
hashlib.new = refusing
from smcrypto import sm3
print(sm3.ENGINE, sm3.digest(b"abc").hex()[:8])
"""
    assert _in_a_new_process(code, SMCRYPTO_PURE="") == "python 66c7f0f4"


def test_a_refusal_by_hashlib_is_seen_in_this_process_too(monkeypatch):
    def refuse(name: str) -> None:
        raise ValueError(f"unsupported hash type {name}")

    monkeypatch.setattr(hashlib, "new", refuse)
    name, empty = sm3._choose(pure=False)
    assert name == "python" and empty.digest() == by_definition(b"")

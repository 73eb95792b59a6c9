"""Every engine against the standard's text, on every number of blocks where something changes."""

from __future__ import annotations

import random
from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sm4_reference import reference_crypt, reference_expand_key
from smcrypto.errors import InvalidKey
from smcrypto.sm4 import bitslice, byteplanes, tables
from smcrypto.sm4.block import SBOX, L
from smcrypto.sm4.engine import BULK_BLOCKS, FEW_BLOCKS, Engine, counter_blocks, xor_bytes

pytestmark = pytest.mark.usefixtures("sm4_engine")

KEY = bytes.fromhex("0123456789abcdeffedcba9876543210")
RK = reference_expand_key(KEY)
RANDOM = random.Random(32907)
DATA = RANDOM.randbytes(16 * (BULK_BLOCKS + 140))
EXPECTED = b"".join(reference_crypt(RK, DATA[i : i + 16]) for i in range(0, len(DATA), 16))

AROUND = sorted({0, 1, 2, FEW_BLOCKS - 1, FEW_BLOCKS, FEW_BLOCKS + 1, 16, 23, 24, 25, 64, 127, 128, 129, 255, 256,
                 BULK_BLOCKS - 1, BULK_BLOCKS, BULK_BLOCKS + 1, BULK_BLOCKS + 127, BULK_BLOCKS + 129})


def counters(first: int, n: int, counter_bits: int) -> list[bytes]:
    """SP 800-38D, 6.2, inc_s, by its definition."""
    high, low = divmod(first, 1 << counter_bits)
    return [(high << counter_bits | (low + i) % (1 << counter_bits)).to_bytes(16, "big") for i in range(n)]


@pytest.mark.parametrize("n", AROUND)
def test_engine_equals_the_standard(n: int) -> None:
    engine, mask = Engine(KEY), RANDOM.randbytes(16 * n)
    data, expected = DATA[: 16 * n], EXPECTED[: 16 * n]
    assert engine.encrypt(data) == expected
    assert engine.decrypt(expected) == data
    assert engine.encrypt(data, mask) == xor_bytes(expected, mask)
    assert engine.decrypt(expected, mask) == xor_bytes(data, mask)


@pytest.mark.parametrize("n", [1, 2, 3, 5, 24, 25, 100])
def test_byte_planes_equal_the_standard(n: int) -> None:
    keys = byteplanes.key_words(RK, n)
    assert byteplanes.crypt(keys, DATA[: 16 * n]) == EXPECTED[: 16 * n]


@pytest.mark.parametrize("width", [1, 2, 3])
def test_bit_slices_equal_the_standard(width: int) -> None:
    keys, n = bitslice.key_planes(RK, width), 128 * width
    for blocks in (n, n - 1, n - 127):
        assert bitslice.crypt_xor(keys, DATA[: 16 * blocks], None, width) == EXPECTED[: 16 * blocks]


@pytest.mark.parametrize("n", [0, 1, 2, 30, tables.WIDE_BLOCKS])
def test_the_chain_equals_its_definition(n: int) -> None:
    engine, previous, expected = Engine(KEY), DATA[:16], []
    for i in range(16, 16 * n + 16, 16):
        previous = reference_crypt(RK, xor_bytes(DATA[i : i + 16], previous))
        expected.append(previous)
    assert engine.cbc_encrypt(DATA[:16], DATA[16 : 16 * n + 16]) == b"".join(expected)


def test_sbox_circuit_is_the_sbox_on_all_256_inputs() -> None:
    """Lane v of the planes holds the byte v; input and output constants are those the module documents."""
    planes = [sum((v >> bit & 1) << v for v in range(256)) for bit in range(8)]
    out = bitslice.compiled_sbox()(*planes)
    circuit = [sum((plane >> v & 1) << bit for bit, plane in enumerate(out)) for v in range(256)]
    assert bytes(circuit[v ^ 0x75] ^ 0xD3 for v in range(256)) == SBOX
    assert L(0xD3D3D3D3) == 0x4F4F4F4F


def test_sbox_circuit_has_the_gates_it_claims() -> None:
    gates = [gate for line in bitslice.SBOX_CIRCUIT.strip().splitlines() for gate in line.split("; ")]
    assert len(gates) == 105
    assert {gate.split()[3] for gate in gates} == {"^", "&", "|"}


def test_sbox_circuit_keeps_few_planes_alive() -> None:
    """Reusing variables is what keeps a chunk in the cache: 105 values in about 30 places."""
    assert bitslice.compiled_sbox().__code__.co_nlocals <= 32


@pytest.mark.parametrize("width", [1, 2, 5])
def test_transposition_puts_every_bit_where_the_layout_says(width: int) -> None:
    data = RANDOM.randbytes(2048 * width)
    planes = bitslice.rows_from_bytes(data, width)
    bitslice.transpose(planes, width)
    for i in range(128):
        for r in range(0, 128, 5):
            for m in range(width):
                block = data[16 * (r * width + m) :][:16]
                assert planes[i] >> (128 * m + r) & 1 == block[i // 8] >> (i % 8) & 1
    bitslice.transpose(planes, width)
    assert b"".join(row.to_bytes(16 * width, "little") for row in planes) == data


def test_key_planes_take_the_same_space_for_zeros_and_ones() -> None:
    planes = [plane for word in bitslice.key_planes(RK, 3) for plane in word]
    assert len({plane.bit_length() for plane in planes}) == 1
    assert len(set(planes)) == 2


COUNTER_STARTS = [0, 1, 255, 2**32 - 1, 2**32 - 130, 2**32 - 300, 2**64 - 5, 2**96 + 2**32 - 7,
                  2**128 - 1, 2**128 - 257, int.from_bytes(KEY, "big")]


@pytest.mark.parametrize("counter_bits", [32, 128])
@pytest.mark.parametrize("first", COUNTER_STARTS)
def test_counters_wrap_where_they_should(first: int, counter_bits: int) -> None:
    for n in (1, 5, 300):
        expected = b"".join(counters(first, n, counter_bits))
        assert counter_blocks(first.to_bytes(16, "big"), n, counter_bits) == expected
    for width in (1, 2, 3):
        rows = bitslice.counter_planes(first, width, counter_bits)
        bitslice.transpose(rows, width)
        expected = b"".join(counters(first, 128 * width, counter_bits))
        assert b"".join(row.to_bytes(16 * width, "little") for row in rows) == expected


@pytest.mark.parametrize("counter_bits", [16, 24])
def test_short_counters_of_ccm(counter_bits: int) -> None:
    first = counters(2**128 - 3, 1, 128)[0]
    assert counter_blocks(first, 9, counter_bits) == b"".join(counters(2**128 - 3, 9, counter_bits))


@pytest.mark.parametrize("counter_bits", [32, 128])
@pytest.mark.parametrize("n", AROUND)
def test_ctr_equals_its_definition(n: int, counter_bits: int) -> None:
    first = 2**128 - n // 2 - 1
    engine = Engine(KEY)
    stream = engine.encrypt(b"".join(counters(first, n, counter_bits)))
    start = first.to_bytes(16, "big")
    for length in {16 * n, max(0, 16 * n - 1), max(0, 16 * n - 15)}:
        expected = xor_bytes(DATA[:length], stream[:length])
        assert engine.ctr_xor(start, DATA[:length], counter_bits) == expected
        assert engine.encrypt_and_ctr_xor(DATA[:32], start, DATA[:length], counter_bits) == (EXPECTED[:32], expected)


def test_several_chunks_of_bit_slices_join_without_a_seam(monkeypatch: pytest.MonkeyPatch) -> None:
    engine = Engine(KEY)
    whole = engine.ctr_xor(DATA[:16], DATA)
    assert engine.encrypt(DATA) == EXPECTED
    monkeypatch.setattr(bitslice, "MAX_WIDTH", 8)  # 1024 blocks a chunk
    assert engine.ctr_xor(DATA[:16], DATA) == whole
    assert engine.encrypt(DATA) == EXPECTED
    assert engine.decrypt(EXPECTED, DATA) == bytes(len(DATA))


@pytest.mark.parametrize("length", [0, 15, 17, 32])
def test_an_engine_refuses_keys_of_other_lengths(length: int) -> None:
    with pytest.raises(InvalidKey):
        Engine(bytes(length))


@given(st.integers(1, 40_000_000))
def test_chunks_cover_all_blocks_and_stay_within_the_limit(blocks: int) -> None:
    width = bitslice.chunk_width(blocks)
    assert 1 <= width <= bitslice.MAX_WIDTH
    chunks = -(-blocks // (128 * bitslice.MAX_WIDTH))
    assert chunks * 128 * width >= blocks > chunks * 128 * (width - 1)


@pytest.mark.parametrize("n", [1, 40, BULK_BLOCKS])
def test_one_engine_serves_threads(n: int) -> None:
    from concurrent.futures import ThreadPoolExecutor

    engine = Engine(KEY)
    sizes = [n, n + 1, n + 7, n] * 3
    jobs: list[Callable[[int], bytes]] = [lambda size: engine.encrypt(DATA[: 16 * size])]
    with ThreadPoolExecutor(4) as pool:
        for size, out in zip(sizes, pool.map(jobs[0], sizes), strict=True):
            assert out == EXPECTED[: 16 * size]

"""Chunks: what is sealed comes back, what was changed is found, and a robot that lies harms nobody."""

from __future__ import annotations

import contextlib
import struct

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from bridge.log.making import (
    LINES,
    LOG,
    READER,
    ROBOT,
    SECOND,
    STRANGER,
    STREAM,
    header_bytes,
    lying,
    repeating,
    root_of,
    sealed,
    signed,
)
from rosbridge_eth.errors import BridgeError, ExitCode
from rosbridge_eth.log import chunk as chunks
from rosbridge_eth.log.chunk import (
    MAX_BODY,
    MAX_CHUNK,
    MAX_LINE,
    MAX_PLAINTEXT,
    MAX_RECORDS,
    Altered,
    Chunk,
    ChunkError,
    Forged,
    Header,
    Log,
    Malformed,
    NoGrant,
    TooLarge,
    Unopenable,
    content_key,
    content_secret,
    drop,
    ledger_id,
    open_lines,
    robot_id,
    unwrap,
    verify,
    zstd,
)
from smcrypto import sm2, sm3

lines_strategy = st.lists(
    st.binary(min_size=1, max_size=200).map(lambda b: b.replace(b"\n", b" ")), min_size=0, max_size=20
)
CHUNK = sealed()
EMPTY = sealed([], goodbye=True)


def opened(chunk: Chunk, reader: sm2.PrivateKey = READER, log: Log = LOG) -> tuple[bytes, ...]:
    return open_lines(log, chunk, content_key(chunk.header, reader))


# What is sealed comes back


@given(lines_strategy, st.booleans(), st.booleans(), st.integers(0, 2**64 - 1), st.integers(1, 4))
@settings(max_examples=40)
def test_what_is_sealed_is_read_by_every_reader_and_by_nobody_else(lines, compress, goodbye, number, count):
    readers = [sm2.PrivateKey.from_int(50 + i) for i in range(count)]
    made = sealed(
        lines, number=number, compress=compress, goodbye=goodbye, readers=[reader.public_key for reader in readers]
    )
    chunk = Chunk.parse(memoryview(made.encoded))
    assert chunk == made and chunk.encoded == made.encoded
    assert (chunk.header.number, chunk.header.records, chunk.header.goodbye) == (number, len(lines), goodbye)
    assert chunk.header.digest == sm3.digest(chunk.header.encoded)
    assert not chunk.bare
    verify(LOG, ROBOT.public_key, chunk)
    if not lines:
        assert chunk.body == b"" and chunk.header.grants == () and open_lines(LOG, chunk, bytes(16)) == ()
        return
    for reader in readers:
        assert opened(chunk, reader) == tuple(lines)
    with pytest.raises(NoGrant):
        content_key(chunk.header, STRANGER)


@pytest.mark.parametrize("level", [1, 3, 15])
def test_every_level_makes_frames_that_open(level):
    assert opened(sealed(level=level)) == LINES


def test_nothing_of_the_lines_is_in_the_open_part_and_sizes_are_multiples_of_64():
    lines = [b'{"topic":"/secret"}' * 10]
    chunk = sealed(lines, compress=False)
    assert b"secret" not in chunk.encoded
    assert (len(chunk.body) - 16) % 64 == 0
    longer = sealed([lines[0] + b" "], compress=False)
    assert len(longer.encoded) == len(chunk.encoded)


def test_without_compression_the_size_tells_nothing_but_the_length():
    same, different = [b"a" * 5000], [bytes(range(33, 83)) * 100]
    assert len(sealed(same, compress=False).body) == len(sealed(different, compress=False).body)
    assert len(sealed(same).body) < len(sealed(different).body) < 5000


def test_the_longest_line_fits_whatever_it_holds_and_the_longest_chunk_is_no_longer_than_it_says():
    noise = repeating()(MAX_LINE).replace(b"\n", b" ")
    for compress in (True, False):
        assert opened(sealed([noise], compress=compress)) == (noise,)
    noise += repeating(2)(MAX_BODY - 16 - 12 - 1 - MAX_LINE).replace(b"\n", b" ")
    full = sealed([noise], compress=False, readers=[sm2.PrivateKey.from_int(9 + i).public_key for i in range(16)])
    assert len(full.body) == MAX_BODY and len(full.encoded) == MAX_CHUNK
    assert Chunk.parse(full.encoded) == full


@pytest.mark.parametrize("compress", [True, False])
def test_lines_that_do_not_fit_are_too_large(compress):
    noise = repeating()(2 * MAX_BODY).replace(b"\n", b" ")
    for lines in ([noise], [noise[:40_000], noise[40_000:80_000]], [b"x"] * (MAX_RECORDS + 1), [b"x" * MAX_PLAINTEXT]):
        with pytest.raises(TooLarge):
            sealed(lines, compress=compress)
    assert len(opened(sealed([b"x"] * MAX_RECORDS, compress=compress))) == MAX_RECORDS


def test_a_robot_cannot_seal_what_readers_would_not_take():
    for lines in ([b""], [b"a", b""], [b"a\nb"]):
        with pytest.raises(ValueError, match="line"):
            sealed(lines)
    for count in (0, 17):
        with pytest.raises(Malformed):
            sealed(readers=[READER.public_key] * count)


def test_errors_are_of_the_bridge_and_end_a_command_as_a_verification():
    for kind in (Malformed, Altered, Forged, Unopenable, NoGrant, TooLarge):
        assert issubclass(kind, ChunkError) and issubclass(kind, BridgeError)
        assert kind.exit_code is ExitCode.VERIFICATION


def test_ids():
    # keccak256 of the empty text is known from Ethereum: the code hash of an account without code.
    assert robot_id("").hex() == "c5d2460186f7233c927e7db2dcc703c0e500b653ca82273b7bfad8045d85a470"
    assert ledger_id(5, b"g" * 32, b"c" * 20) == sm3.digest(bytes(31) + b"\5" + b"g" * 32 + b"c" * 20)
    for genesis, contract in ((b"g" * 31, b"c" * 20), (b"g" * 32, b"c" * 21)):
        with pytest.raises(ValueError, match="bytes"):
            ledger_id(5, genesis, contract)


# What was changed is found


@pytest.mark.parametrize("chunk", [CHUNK, drop(LOG, ROBOT, CHUNK), EMPTY], ids=["whole", "dropped", "empty"])
def test_a_flipped_bit_anywhere_is_found_without_a_key(chunk):
    source = repeating()
    for place in range(len(chunk.encoded)):
        data = bytearray(chunk.encoded)
        data[place] ^= 1 << source(1)[0] % 8
        with pytest.raises((Malformed, Altered, Forged)):
            verify(LOG, ROBOT.public_key, Chunk.parse(bytes(data)))


@given(st.integers(0, len(CHUNK.body) * 8 - 1))
def test_a_flipped_bit_of_a_body_does_not_open(bit):
    body = bytearray(CHUNK.body)
    body[bit // 8] ^= 1 << bit % 8
    with pytest.raises(Unopenable):
        opened(Chunk(CHUNK.header, CHUNK.signature, bytes(body)))


@pytest.mark.parametrize("chunk", [CHUNK, drop(LOG, ROBOT, CHUNK), EMPTY], ids=["whole", "dropped", "empty"])
def test_a_chunk_that_is_cut_or_longer_is_found(chunk):
    for size in range(len(chunk.encoded)):
        with pytest.raises((Malformed, Forged)):
            verify(LOG, ROBOT.public_key, Chunk.parse(chunk.encoded[:size]))
    for more in (b"\0", b"x" * 64, bytes(MAX_CHUNK)):
        with pytest.raises(Malformed):
            Chunk.parse(chunk.encoded + more)


@given(st.binary(max_size=400))
def test_any_bytes_are_a_chunk_or_malformed(data):
    for parse in (Header.parse, Chunk.parse):
        with contextlib.suppress(Malformed):
            assert parse(data).encoded == data


def test_only_the_robot_takes_a_body_away():
    stripped = Chunk.parse(CHUNK.encoded[: -len(CHUNK.body)])
    assert stripped.bare
    with pytest.raises(Forged):
        verify(LOG, ROBOT.public_key, stripped)
    dropped = Chunk.parse(drop(LOG, ROBOT, CHUNK).encoded)
    verify(LOG, ROBOT.public_key, dropped)
    assert dropped.bare and dropped.header == CHUNK.header
    with pytest.raises(Forged):  # the signature of the dropped form is none for the whole one
        verify(LOG, ROBOT.public_key, Chunk(CHUNK.header, dropped.signature, CHUNK.body))
    with pytest.raises(ValueError, match="is not here"):
        opened(dropped)
    assert drop(LOG, ROBOT, dropped) == dropped and drop(LOG, ROBOT, EMPTY) == EMPTY and not EMPTY.bare


def test_a_chunk_means_nothing_for_another_chain_contract_robot_or_key():
    for log in (Log(ledger_id(1, b"g" * 32, b"c" * 20), LOG.tk), Log(LOG.ledger, robot_id("robot_2"))):
        with pytest.raises(Forged):
            verify(log, ROBOT.public_key, CHUNK)
        with pytest.raises(Unopenable):
            opened(CHUNK, log=log)
    with pytest.raises(Forged):
        verify(LOG, STRANGER.public_key, CHUNK)


def test_a_body_of_another_chunk_is_altered():
    other = sealed(number=4)
    with pytest.raises(Altered):
        verify(LOG, ROBOT.public_key, Chunk(CHUNK.header, CHUNK.signature, other.body))


@pytest.mark.parametrize(
    "changes",
    [
        {"version": 2}, {"version": 4}, {"flags": 4}, {"flags": 0x81}, {"n": 0}, {"n": 2}, {"n": 17},
        {"records": 0}, {"records": MAX_RECORDS + 1}, {"records": 2**32 - 1}, {"sealed_ms": chunks.MAX_TIME_MS},
        {"body_length": 0}, {"body_length": 16}, {"body_length": 64}, {"body_length": 81},
        {"body_length": MAX_BODY + 16}, {"body_length": MAX_BODY + 64}, {"body_length": 2**32 - 1},
    ],
    ids=str,
)  # fmt: skip
def test_a_header_that_cannot_be_is_malformed(changes):
    data = header_bytes(CHUNK.header, **changes)
    with pytest.raises(Malformed):
        Header.parse(data)
    with pytest.raises(Malformed):
        Chunk.parse(data + CHUNK.signature + CHUNK.body)


@pytest.mark.parametrize(
    "changes", [{"records": 1}, {"body_length": 80}, {"root": bytes(32)}, {"body_digest": bytes(32)}], ids=str
)
def test_a_chunk_without_records_has_nothing_else(changes):
    with pytest.raises(Malformed):
        Header.parse(header_bytes(EMPTY.header, **changes))
    grant = CHUNK.header.encoded[-113:]
    with pytest.raises(Malformed):
        Header.parse(header_bytes(EMPTY.header, n=1) + grant)


def test_one_to_sixteen_grants_are_a_header_and_others_are_not():
    grant = CHUNK.header.encoded[-113:]
    assert len(Header.parse(header_bytes(CHUNK.header, n=16) + 15 * grant).grants) == 16
    with pytest.raises(Malformed):
        Header.parse(header_bytes(CHUNK.header, n=17) + 16 * grant)
    with pytest.raises(Malformed):
        Header.parse(header_bytes(CHUNK.header, n=0)[:139])


# A robot that lies: the signature holds, the content does not

FRAME = chunks._compressed(b"a\n", 9)
SKIPPABLE = struct.pack("<II", 0x184D2A50, 4) + b"skip"


def framed(content: bytes, level: int = 3) -> bytes:
    """A frame of this content with the header of ours."""
    return chunks._framed(zstd.compress(content, level), content)


def streamed(content: bytes, window_log: int) -> bytes:
    """A frame that does not say its content's size, with this window."""
    packing = zstd.ZstdCompressor(options={int(zstd.CompressionParameter.window_log): window_log})
    return packing.compress(content) + packing.flush()


def unended(content: bytes) -> bytes:
    """All blocks of a frame but the last; the zeros behind it are empty blocks."""
    packing = zstd.ZstdCompressor()
    return chunks._framed(packing.compress(content, packing.FLUSH_BLOCK), content)


@pytest.mark.parametrize(
    ("why", "what"),
    [
        ("no zstd frame", {"frame": b"a\n"}), ("no zstd frame", {"frame": b"", "pad": 64}),
        ("no zstd frame", {"frame": SKIPPABLE + FRAME}), ("no zstd frame", {"frame": SKIPPABLE}),
        ("no zstd frame", {"frame": b"\x27\xb5\x2f\xfd" + FRAME[4:]}),
        ("no zstd frame", {"frame": zstd.compress(b"a\n")}), ("no zstd frame", {"frame": streamed(b"a\n", 22)}),
        ("cannot be unpacked", {"frame": FRAME[:9] + b"\xff" * 20}),
        ("cannot be unpacked", {"frame": FRAME[:5] + b"\3\0\0\0" + FRAME[9:]}),
        ("no end", {"frame": unended(b"a\n")}),
        ("more than one frame", {"frame": FRAME + FRAME}), ("more than one frame", {"frame": FRAME + SKIPPABLE}),
        ("more than one frame", {"frame": FRAME + b"\0\0\1"}),
        ("more than one frame", {"frame": FRAME, "pad": 128 - len(FRAME)}),
        ("empty or has no end", {"frame": framed(b""), "records": 1}),
        ("empty or has no end", {"frame": framed(b"a")}),
        ("empty or has no end", {"frame": framed(b"\n"), "root": root_of([b""])}),
        ("empty or has no end", {"frame": framed(b"\na\n"), "root": root_of([b"", b"a"]), "records": 2}),
        ("empty or has no end", {"frame": framed(b"a\n\n"), "root": root_of([b"a", b""]), "records": 2}),
        ("holds 1001 records", {"frame": framed(b"a\n" * (MAX_RECORDS + 1)), "records": MAX_RECORDS}),
        ("holds 2 records", {"frame": framed(b"a\nb\n")}), ("holds 1 records", {"frame": FRAME, "records": 2}),
        ("root", {"frame": FRAME, "root": root_of([b"b"])}),
        ("root", {"frame": FRAME, "root": root_of([b"a"], b"j" * 16)}),
        ("does not open", {"frame": FRAME, "sealed_under": b"j" * 16}),
    ],
    ids=str,
)  # fmt: skip
def test_what_the_robot_signed_and_cannot_be_opened_is_unopenable(why, what):
    chunk = lying(**{"root": root_of([b"a"])} | what)
    verify(LOG, ROBOT.public_key, chunk)
    with pytest.raises(Unopenable, match=why):
        opened(chunk)


def test_blocks_made_otherwise_are_taken_as_long_as_the_header_is_the_one():
    for frame in (framed(b"a\n", 1), framed(b"a\n", 19), chunks._framed(streamed(b"a\n", 22), b"a\n"),
                  chunks._framed(streamed(b"a\n", 10), b"a\n"), chunks._stored(b"a\n")):  # fmt: skip
        assert opened(lying(frame, root=root_of([b"a"]))) == (b"a",)


@pytest.mark.parametrize("size", [1, 255, 256, 65_791, 65_792, 262_144, MAX_PLAINTEXT])
def test_every_size_has_the_one_header(size):
    content = (b"a" * (size - 1)) + b"\n"
    frame = chunks._compressed(content, 9)
    assert frame[:9] == bytes.fromhex("28b52ffda0") + size.to_bytes(4, "little") and zstd.decompress(frame) == content


def test_a_zip_bomb_is_unopenable_and_costs_no_memory():
    bomb = chunks._framed(streamed(b"a\n" * 2**26, 22), b"a" * 1000)
    assert len(bomb) < MAX_BODY
    claims = b"\x28\xb5\x2f\xfd\xa0" + (2**32 - 1).to_bytes(4, "little") + b"\x11\0\0a\n"  # 4 GiB, and has two
    for frame in (bomb, framed(b"a" * (MAX_PLAINTEXT + 1)), framed(b"a\n" * 2**21), claims):
        with pytest.raises(Unopenable):
            opened(lying(frame, records=MAX_RECORDS))
    fits = framed(b"a" * (MAX_PLAINTEXT - 1) + b"\n")
    assert len(opened(lying(fits, root=root_of([b"a" * (MAX_PLAINTEXT - 1)])))[0]) == MAX_PLAINTEXT - 1


def test_the_grant_that_fits_is_found_wherever_it_stands_and_the_likely_one_is_tried_first(monkeypatch):
    junk, good = b"\4" + bytes(112), CHUNK.header.encoded[-113:]
    fixed = header_bytes(CHUNK.header)[:138]
    key = content_key(CHUNK.header, READER)
    tried = []
    decrypt = sm2.PrivateKey.decrypt

    def trying(self, grant, *, encoding):
        tried.append(grant)
        return decrypt(self, grant, encoding=encoding)

    monkeypatch.setattr(sm2.PrivateKey, "decrypt", trying)
    for place in range(3):
        grants = [junk] * place + [good] + [junk] * (2 - place)
        header = Header.parse(fixed + b"\3" + b"".join(grants))
        for likely in range(4):
            tried.clear()
            assert unwrap(header, READER, likely) == (key, place)
            assert len(tried) == 1 if likely == place else len(tried) <= place + 2
    with pytest.raises(NoGrant):
        content_key(Header.parse(fixed + b"\1" + junk), READER)
    with pytest.raises(NoGrant):
        content_key(sealed(number=9, readers=[SECOND.public_key]).header, READER)


def test_grants_say_nothing_of_whom_they_are_for():
    points = {sealed(number=n).header.grants[0][:65] for n in (0, 0, 1, 1)}
    assert len(points) == 4


def test_a_wrapped_key_that_was_copied_to_another_chunk_opens_nothing_there():
    """The wrap names no place; the associated data of the body does."""
    other = sealed(number=4)
    copied = header_bytes(other)[:138] + b"\1" + CHUNK.header.grants[0]
    for header in (copied, header_bytes(CHUNK.header, number=4)):
        chunk = signed(header, CHUNK.body if header != copied else other.body)
        with pytest.raises(Unopenable):
            opened(chunk)


def test_a_key_handed_over_opens_this_chunk_and_no_other():
    first, second = sealed(number=1), sealed(number=2)
    key = content_key(first.header, READER)
    assert open_lines(LOG, first, key) == LINES
    with pytest.raises(Unopenable):
        open_lines(LOG, second, key)


def test_the_signature_binds_what_it_was_made_for():
    other = signed(CHUNK.header.encoded, CHUNK.body, purpose="finished")
    with pytest.raises(Forged):
        verify(LOG, ROBOT.public_key, other)


# Keys


def test_two_forks_with_the_same_random_bytes_never_encrypt_two_contents_under_one_key():
    keys = {
        content_key(sealed(lines, number=number, randomness=lambda size: bytes(size), **more).header, READER)
        for lines in ([b"one"], [b"two"], [b"one", b"two"])
        for number in (0, 1)
        for more in ({}, {"stream": b"s" * 16})
    }
    assert len(keys) == 12


def test_another_robot_log_or_randomness_is_another_key():
    def key(log: Log, random: bytes, secret: bytes | None = b"s" * 32) -> bytes:
        chunk = chunks.seal(
            log, ROBOT, LINES, stream=STREAM, number=0, previous=bytes(32), sealed_ms=0,
            readers=[READER.public_key], secret=secret, randomness=lambda size: random,
        )  # fmt: skip
        return content_key(chunk.header, READER)

    usual = key(LOG, bytes(32))
    assert usual == key(LOG, bytes(32))
    others = {
        key(Log(b"x" * 32, LOG.tk), bytes(32)), key(Log(LOG.ledger, b"x" * 32), bytes(32)),
        key(LOG, bytes(32), b"t" * 32), key(LOG, bytes(32), None), key(LOG, b"\1" * 32), usual,
    }  # fmt: skip
    assert len(others) == 6


def test_the_secret_of_a_run_needs_no_more_of_the_key_than_a_signature(monkeypatch):
    class Token:
        """A key that only signs."""

        def sign(self, message: bytes, *, encoding: str) -> bytes:
            return ROBOT.sign(message, encoding=encoding)

    made = chunks.seal(LOG, Token(), LINES, stream=STREAM, number=0, previous=bytes(32), sealed_ms=0,
                       readers=[READER.public_key])  # fmt: skip
    assert opened(made) == LINES
    monkeypatch.setattr("smcrypto.sm2.nonces.hedged_nonces.__kwdefaults__", {"entropy": bytes})
    assert content_secret(ROBOT) == content_secret(ROBOT)  # without any randomness, it is the key's alone
    assert len({content_secret(ROBOT), content_secret(STRANGER)}) == 2


def test_reprs_show_neither_content_nor_keys():
    text = repr(CHUNK)
    assert CHUNK.body.hex() not in text and "body=" not in text and "encoded=" not in text and "grants=" not in text
    assert str(CHUNK.header) == "chunk 3 of stream 00010203"


@given(st.integers(0, 2**32 - 1), st.sampled_from([0, 1, 2, 3, 128]), st.integers(0, 1001), st.integers(0, 1),
       st.booleans())  # fmt: skip
@example(MAX_BODY, 0, 1, 1, True)
@example(MAX_BODY + 64, 0, 1, 1, True)
@example(MAX_BODY, 2, 1, 1, True)
@example(MAX_BODY, 3, 1, 1, True)
def test_a_body_has_its_bound_and_no_flag_but_goodbye_is_known(size, flags, records, grants, fitting):
    size = size // 64 * 64 + 16 if fitting and records else size
    data = header_bytes(CHUNK.header, flags=flags, records=records, body_length=size, n=grants)
    data = data if grants else data[:139]
    if flags < 2 and grants and 1 <= records <= 1000 and 16 < size <= MAX_BODY and size % 64 == 16:
        header = Header.parse(data)
        assert (header.goodbye, header.body_length) == (bool(flags), size)
    else:
        with pytest.raises(Malformed):
            Header.parse(data)

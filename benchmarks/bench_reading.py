"""Reading and proving a history: records a second, and what of it takes the time.

    python benchmarks/bench_reading.py [--chunks 1000] [--records 100]
    python benchmarks/bench_reading.py --kept 150000        chunks of 10 records, as a robot at 10 Hz has in 42 hours

The records are the sample's Odometry, pose and twist (as in bridge_costs.py) and then whole messages; the chunks are
sealed as a robot seals them, and read as the chain gives them, from memory: nodes and networks are not measured here.
With --kept the chunks are taken for proven, kept, and asked for again; their numbers change from record to record.
"""

from __future__ import annotations

import argparse
import platform
import random
import re
import resource
import tempfile
import time
import tracemalloc
from collections.abc import Sequence
from datetime import UTC, datetime
from itertools import cycle, islice
from pathlib import Path
from typing import Any

from eth_hash.auto import keccak

from bridge_costs import POSE_AND_TWIST
from rosbridge_eth.capture import Capture, MessageLine, TopicRule, parse_line, stream_line
from rosbridge_eth.chunk import Log, content_key, open_lines, robot_id, seal
from rosbridge_eth.identity import Role, Trust, create_ca, enrol
from rosbridge_eth.ledger.contract import DataEvent, RegistrationEvent, Standing
from rosbridge_eth.reading.cache import Cache, open_cache
from rosbridge_eth.reading.verdict import Progress
from rosbridge_eth.reading.verify import Choice, Place, ProvenChunk, ProvenRecord, Verifier, is_signed
from rosbridge_eth.sources import BagSource, Selection, sample_bag
from smcrypto import sm2, sm3

START = datetime(2026, 1, 1, tzinfo=UTC)
T0_MS = round(START.timestamp() * 1000) + 3_600_000
LEDGER, NAME, ACCOUNT = b"L" * 32, "robot_1", "0x" + "00" * 20
TYPE = "nav_msgs/msg/Odometry"


def sample_lines(fields: Sequence[str] = ()) -> tuple[list[bytes], list[bytes]]:
    """The lines that open a stream, and those of the sample's Odometry with these fields, or all."""
    source = BagSource(sample_bag(), Selection(["/robot_1/odom"]))
    capture = Capture([TopicRule("/robot_1/odom", fields=tuple(fields))], source_kind="bag")
    captured = [found for raw in source.messages() if (found := capture.process(raw, T0_MS * 10**6, True))]
    opening = [stream_line("bag", "rosbridge_eth 2.0"), *(one.definition[1] for one in captured[:1] if one.definition)]
    return opening, [one.line for one in captured]


def kept(chunks: int, folder: Path) -> None:
    """What it costs to keep proven records, and to ask for them again."""
    reader, trust, log = sm2.PrivateKey.generate(), Trust([]), Log(LEDGER, robot_id(NAME))
    parts = re.split(rb"(?<=\d\.\d)(\d+)", sample_lines()[1][0])
    number = random.Random(1)

    def opened() -> Cache:
        cache = open_cache(folder, NAME, log, reader, trust, {})
        if cache is None:
            raise SystemExit(f"nothing can be kept in {folder}")
        return cache

    chunk: Any = None  # of which nothing is kept
    cache = opened()
    took = -time.process_time()
    for index in range(chunks):
        place = Place(index, b"s" * 16, index, number.randbytes(32), index + 1, T0_MS // 1000 + index, b"t" * 32)
        records = []
        for n in range(10):
            parts[1::2] = [b"%03d" % number.randrange(1000) + part[3:] for part in parts[1::2]]
            message = MessageLine("/robot_1/odom", TYPE, "ros1", (T0_MS + 1000 * index + 100 * n) * 10**6, 0, True, {})
            records.append(ProvenRecord(place, n, b"".join(parts), message, None))
        cache.add(ProvenChunk(place, chunk, b"", (), tuple(records)))
        cache.links.add(place.digest, index)
        if cache.full or index == chunks - 1:
            cache.commit(Progress(index + 1, records=10 * index + 10), index + 2, index + 1, b"")
    cache.close()
    took += time.process_time()
    size = sum(path.stat().st_size for path in folder.iterdir())
    print(f"{took / chunks * 1e5:8.1f} us a record kept; {size / chunks / 10:.1f} bytes a record on the disk")
    t0 = T0_MS * 10**6
    for name, choice in (
        ("opened, and nothing asked for", Choice("/none")),
        ("the last record", Choice(at_ns=2**62)),
        ("ten minutes", Choice(from_ns=t0 + 3600 * 10**9, to_ns=t0 + 4200 * 10**9)),
        ("all of the topic", Choice("/robot_1/odom")),
    ):
        took = -time.process_time()
        cache = opened()
        found = sum(1 for _ in cache.records(choice, set()))
        cache.close()
        took += time.process_time()
        print(f"{took:8.2f} s: {name}, {found:,} records of {cache.progress.records:,}")
    print(f"{resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024:8.0f} MiB at most, all of the process")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--chunks", type=int, default=1000)
    parser.add_argument("--records", type=int, default=100)
    parser.add_argument("--kept", type=int)
    arguments = parser.parse_args()
    if arguments.kept:
        with tempfile.TemporaryDirectory() as folder:
            kept(arguments.kept, Path(folder, "proven"))
        return
    for what, fields in (("pose and twist", POSE_AND_TWIST), ("whole messages", ())):
        proven(what, fields, arguments.chunks, arguments.records)


def proven(what: str, fields: Sequence[str], count: int, per_chunk: int) -> None:
    """What it costs to read and prove so many chunks of so many records."""
    authority = create_ca("CA", at=START)
    robot = enrol(authority, Role.ROBOT, NAME, at=START)
    reader = enrol(authority, Role.READER, "owner", at=START).encryption_key
    log, opening, lines = Log(LEDGER, robot_id(NAME)), *sample_lines(fields)
    endless, previous, chunks = cycle(lines), bytes(32), []
    for number in range(count):
        content = (opening if number == 0 else []) + list(islice(endless, per_chunk))
        chunk = seal(
            log, robot.signing_key, content, stream=b"s" * 16, number=number, previous=previous,
            sealed_ms=T0_MS + 1000 * number, readers=[reader.public_key], goodbye=number == count - 1,
        )  # fmt: skip
        previous = chunk.header.digest
        chunks.append(chunk)
    encoded = [chunk.encoded for chunk in chunks]
    certificates = robot.public.certificates
    standing = Standing(ACCOUNT, keccak(certificates), False, len(encoded), keccak(encoded[-1]), 0, 9, 1)
    registered = [RegistrationEvent(ACCOUNT, certificates, 0, 0, 1, False)]

    def read() -> int:
        verifier = Verifier(
            NAME, LEDGER, standing, registered, trust=Trust([authority.certificate]), reader=reader, block=9,
            block_time=lambda block: T0_MS // 1000 + count, now=T0_MS / 1000,
        )  # fmt: skip
        events = (DataEvent(at, 0, tuple(encoded[at : at + 8]), 9, b"", ACCOUNT) for at in range(0, len(encoded), 8))
        records = sum(len(read_chunk.records) for read_chunk in verifier.read(events))
        verdict = verifier.verdict()
        if not verdict.sound or records != count * per_chunk:
            raise SystemExit("\n".join(verdict.lines()))
        return records

    size = sum(map(len, encoded))
    machine = f"{platform.machine()}, Python {platform.python_version()}"
    print(f"{machine}: {len(encoded)} chunks of {per_chunk} records, {what}")
    print(f"{size / count / per_chunk:8.1f} bytes a record on the chain")
    for name in ("cold", "warm"):
        begin = time.process_time()
        records = read()
        took = time.process_time() - begin
        print(f"{records / took:8,.0f} records a second, {name}: {took / records * 1e6:.1f} us each, {took:.2f} s")
    for name, step in (
        ("SM3 of 1 KiB, for comparison", lambda chunk: sm3.digest(bytes(1024))),
        ("signature", lambda chunk: is_signed(log, robot.signing_key.public_key, chunk)),
        ("content key", lambda chunk: content_key(chunk.header, reader)),
        ("content key, and opening", lambda chunk: open_lines(log, chunk, content_key(chunk.header, reader))),
        ("parsing", lambda chunk: [parse_line(line) for line in lines[: per_chunk]]),
    ):
        begin = time.process_time()
        for chunk in chunks[:200]:
            step(chunk)
        took = (time.process_time() - begin) / len(chunks[:200])
        print(f"{took * 1e6:8,.0f} us a chunk: {name}")
    tracemalloc.start()
    read()
    print(f"{tracemalloc.get_traced_memory()[1] / 2**20:8.1f} MiB at most while it reads")
    tracemalloc.stop()


if __name__ == "__main__":
    main()

"""Reading and proving a history: records a second, and what of it takes the time.

    python benchmarks/bench_reading.py [--chunks 1000] [--records 100]
    python benchmarks/bench_reading.py --records 10         as a robot at 10 Hz has

The records are the sample's Odometry, pose and twist (as in bridge_costs.py) and then whole messages; the chunks are
sealed as a robot seals them, and read as the chain gives them, from memory: nodes and networks are not measured here.
With facts: as a reading that finds what an earlier one has proven in the reader's home.
"""

from __future__ import annotations

import argparse
import platform
import tempfile
import time
import tracemalloc
from collections.abc import Sequence
from datetime import UTC, datetime
from itertools import cycle, islice
from pathlib import Path

from eth_hash.auto import keccak

from bridge_costs import POSE_AND_TWIST
from rosbridge_eth.capture import Capture, TopicRule, parse_line, stream_line
from rosbridge_eth.identity import Role, Trust, create_ca, enrol
from rosbridge_eth.ledger.contract import DataEvent, RegistrationEvent, Standing
from rosbridge_eth.log.chunk import Chunk, Log, content_key, open_lines, robot_id, seal, verify_signature
from rosbridge_eth.reading.memo import Memo
from rosbridge_eth.reading.verify import Facts, Verifier
from rosbridge_eth.robot.sources import BagSource, Selection, sample_bag
from smcrypto import sm3

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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--chunks", type=int, default=1000)
    parser.add_argument("--records", type=int, default=100)
    arguments = parser.parse_args()
    for what, fields in (("pose and twist", POSE_AND_TWIST), ("whole messages", ())):
        proven(what, fields, arguments.chunks, arguments.records)


class History:
    """A robot's log of so many chunks of so many records, and its reader."""

    def __init__(self, fields: Sequence[str], count: int, per_chunk: int) -> None:
        self._authority = create_ca("CA", at=START)
        self.robot = enrol(self._authority, Role.ROBOT, NAME, at=START)
        self.reader = enrol(self._authority, Role.READER, "owner", at=START).encryption_key
        self.log, self.records = Log(LEDGER, robot_id(NAME)), count * per_chunk
        opening, self.lines = sample_lines(fields)
        endless, previous, self.chunks = cycle(self.lines), bytes(32), list[Chunk]()
        for number in range(count):
            content = (opening if number == 0 else []) + list(islice(endless, per_chunk))
            chunk = seal(
                self.log, self.robot.signing_key, content, stream=b"s" * 16, number=number, previous=previous,
                sealed_ms=T0_MS + 1000 * number, readers=[self.reader.public_key], goodbye=number == count - 1,
            )  # fmt: skip
            previous = chunk.header.digest
            self.chunks.append(chunk)

    def read(self, facts: Facts | None = None) -> float:
        """Read and prove all of it, eight chunks to a transaction; seconds of the processor."""
        begin = time.process_time()
        encoded, certificates = [chunk.encoded for chunk in self.chunks], self.robot.public.certificates
        standing = Standing(ACCOUNT, keccak(certificates), False, len(encoded), keccak(encoded[-1]), 0, 9, 1)
        verifier = Verifier(
            NAME, LEDGER, standing, [RegistrationEvent(ACCOUNT, certificates, 0, 0, 1, False)],
            trust=Trust([self._authority.certificate]), reader=self.reader, block=9,
            block_time=lambda block: T0_MS // 1000 + len(encoded), now=T0_MS / 1000, facts=facts,
        )  # fmt: skip
        events = (DataEvent(at, 0, tuple(encoded[at : at + 8]), 9, b"", ACCOUNT) for at in range(0, len(encoded), 8))
        records = sum(1 for _ in verifier.read(events))
        verdict = verifier.verdict()
        if not verdict.sound or records != self.records:
            raise SystemExit("\n".join(verdict.lines()))
        return time.process_time() - begin


def proven(what: str, fields: Sequence[str], count: int, per_chunk: int) -> None:
    """What it costs to read and prove so many chunks of so many records."""
    history = History(fields, count, per_chunk)
    log, robot, reader, chunks, records = history.log, history.robot, history.reader, history.chunks, history.records
    encoded = [chunk.encoded for chunk in chunks]
    size = sum(map(len, encoded))
    machine = f"{platform.machine()}, Python {platform.python_version()}"
    print(f"{machine}: {len(encoded)} chunks of {per_chunk} records, {what}")
    print(f"{size / count / per_chunk:8.1f} bytes a record on the chain")
    for name in ("cold", "warm"):
        took = history.read()
        print(f"{records / took:8,.0f} records a second, {name}: {took / records * 1e6:.1f} us each, {took:.2f} s")
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder, "facts.sqlite")
        for name in ("facts written", "facts read"):
            facts = Memo(file, reader)
            took = history.read(facts)
            facts.close()
            print(f"{records / took:8,.0f} records a second, {name}: {took / records * 1e6:.1f} us each, {took:.2f} s")
        print(f"{file.stat().st_size / count:8.0f} bytes a chunk on the disk")
    for name, step in (
        ("SM3 of 1 KiB, for comparison", lambda chunk: sm3.digest(bytes(1024))),
        ("signature", lambda chunk: verify_signature(log, robot.signing_key.public_key, chunk)),
        ("content key", lambda chunk: content_key(chunk.header, reader)),
        ("content key, and opening", lambda chunk: open_lines(log, chunk, content_key(chunk.header, reader))),
        ("parsing", lambda chunk: [parse_line(line) for line in history.lines[: per_chunk]]),
    ):
        begin = time.process_time()
        for chunk in chunks[:200]:
            step(chunk)
        took = (time.process_time() - begin) / len(chunks[:200])
        print(f"{took * 1e6:8,.0f} us a chunk: {name}")
    tracemalloc.start()
    history.read()
    print(f"{tracemalloc.get_traced_memory()[1] / 2**20:8.1f} MiB at most while it reads")
    tracemalloc.stop()


if __name__ == "__main__":
    main()

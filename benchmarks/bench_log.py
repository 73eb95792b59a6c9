"""What a record of the log costs: leaves, zstd, SM4-GCM, signature and key wraps, in microseconds and bytes.

    python benchmarks/bench_log.py [--seconds 0.3]

The records are the sample bag's Odometry with the fields of pose and twist. The bag has 300 of them; further ones
are the same with other digits in every number, since zstd would find copies. A chunk of 1,000 does not come about:
it is closed at 256 KiB of JSON, which are 475 of these. Each time is the best of several runs; chunks are taken
from many places of the bag. Gas is 40 a byte, the floor of calldata since Prague (EIP-7623); the contract adds its
share.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from backports import zstd
from rosbags.highlevel import AnyReader

from rosbridge_eth.log import chunk as chunks
from rosbridge_eth.log.chunk import Log, content_key, open_lines, robot_id, seal, verify
from smcrypto import sm2, sm3, sm4

BAG = Path(__file__).resolve().parents[1] / "samples" / "robot_1.bag"
SIZES = (1, 10, 100, 475)
RECORDS = 1900
LEVELS = (1, 3, 9, 15)
GAS_PER_BYTE = 40

LOG = Log(b"l" * 32, robot_id("robot_1"))
ROBOT = sm2.PrivateKey.generate()
READERS = [sm2.PrivateKey.generate() for _ in range(chunks.MAX_READERS)]
PUBLIC = [reader.public_key for reader in READERS]
SECRET = chunks.content_secret(ROBOT)


def messages() -> list[tuple[int, Any]]:
    """(received_ns, message) of every Odometry of the sample."""
    with AnyReader([BAG]) as reader:
        connections = [connection for connection in reader.connections if connection.topic == "/robot_1/odom"]
        return [(stamp, reader.deserialize(raw, c.msgtype)) for c, stamp, raw in reader.messages(connections)]


def line(index: int, received: int, message: Any, stretch: float) -> bytes:
    """A message line; `stretch` makes other digits of the same numbers."""

    def numbers(value: Any, names: str) -> dict[str, float]:
        return {name: float(getattr(value, name)) * stretch for name in names}

    stamp = message.header.stamp
    data = {
        "header": {"stamp": stamp.sec * 10**9 + stamp.nanosec, "frame_id": message.header.frame_id},
        "child_frame_id": message.child_frame_id,
        "pose": {"pose": {
            "position": numbers(message.pose.pose.position, "xyz"),
            "orientation": numbers(message.pose.pose.orientation, "xyzw"),
        }},
        "twist": {"twist": {
            "linear": numbers(message.twist.twist.linear, "xyz"),
            "angular": numbers(message.twist.twist.angular, "xyz"),
        }},
    }  # fmt: skip
    whole = {
        "topic": "/robot_1/odom", "type": "nav_msgs/msg/Odometry", "source": "ros1", "received_ns": received,
        "captured_ns": received + 50_000 + index * 7919 % 1_900_000, "clock": True, "data": data,
    }  # fmt: skip
    return json.dumps(whole, separators=(",", ":")).encode()


def lines() -> list[bytes]:
    odometry = messages()
    return [
        line(i, received + 10**11 * (i // len(odometry)), message, 1 + 0.0137 * (i // len(odometry)))
        for i, (received, message) in ((i, odometry[i % len(odometry)]) for i in range(RECORDS))
    ]


def groups(records: list[bytes], size: int) -> list[list[bytes]]:
    """Chunks of `size` records, of one place of the bag or many."""
    return [records[at : at + size] for at in range(0, RECORDS - size + 1, max(size, 50))]


def microseconds(functions: list[Callable[[], object]], seconds: float) -> float:
    """The least time of a call, where each call of a run is another function of the list."""
    best, end = float("inf"), time.perf_counter() + seconds
    while time.perf_counter() < end:
        start = time.perf_counter()
        for function in functions:
            function()
        best = min(best, time.perf_counter() - start)
    return best / len(functions) * 1e6


def seal_to(group: list[bytes], readers: int, level: int = chunks.LEVEL) -> chunks.Chunk:
    return seal(LOG, ROBOT, group, stream=bytes(16), number=0, previous=bytes(32), sealed_ms=0,
                readers=PUBLIC[:readers], level=level, secret=SECRET)  # fmt: skip


def rows(records: list[bytes], size: int, seconds: float) -> Iterator[tuple[str, float, float | None]]:
    """(what, microseconds a record, bytes a record) of a chunk of `size` records."""
    some = groups(records, size)
    contents = [b"".join(line + b"\n" for line in group) for group in some]

    def cost(function: Callable[[int], object]) -> float:
        return microseconds([lambda i=i: function(i) for i in range(len(some))], seconds) / size  # type: ignore[misc]

    def length(parts: list[bytes]) -> float:
        return sum(map(len, parts)) / len(parts) / size

    yield "JSON", 0.0, length(contents)
    key = bytes(16)
    yield "salts, leaves, tree", cost(lambda i: chunks._levels(chunks._leaves(some[i], key))), None
    for level in LEVELS:
        yield (
            f"zstd {level}", cost(lambda i, level=level: chunks._compressed(contents[i], level)),  # type: ignore[misc]
            length([chunks._compressed(content, level) for content in contents]),
        )  # fmt: skip
    for level in LEVELS:
        yield (
            f"zstd {level} with its own parameters",
            cost(lambda i, level=level: zstd.compress(contents[i], level)),  # type: ignore[misc]
            length([zstd.compress(content, level) for content in contents]),
        )
    plaintexts = [chunks._pack(group, True, chunks.LEVEL) for group in some]
    yield "SM4-GCM", cost(lambda i: sm4.SM4GCM(key).encrypt(bytes(12), plaintexts[i], bytes(88))), length(plaintexts)
    yield "signature", cost(lambda i: ROBOT.sign(bytes(400), encoding="raw")), 64 / size
    for readers in (1, 2, 16):
        yield (
            f"wraps for {readers}",
            cost(lambda i, n=readers: [reader.encrypt(key, encoding="c1c3c2") for reader in PUBLIC[:n]]),  # type: ignore[misc]
            113 * readers / size,
        )
    for level in LEVELS:
        sealed = [seal_to(group, 1, level).encoded for group in some]
        yield f"whole chunk, level {level}", cost(lambda i, n=level: seal_to(some[i], 1, n)), length(sealed)  # type: ignore[misc]
    made = [seal_to(group, 1) for group in some]
    yield "verify", cost(lambda i: verify(LOG, ROBOT.public_key, made[i])), None
    yield "open", cost(lambda i: open_lines(LOG, made[i], content_key(made[i].header, READERS[0]))), None


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=0.3, help="to spend on each figure")
    seconds = parser.parse_args().seconds
    records = lines()
    print(f"{platform.processor() or platform.machine()}, {os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}; "
          f"Python {platform.python_version()}, zstd {zstd.zstd_version}, SM3 by {sm3.ENGINE}")  # fmt: skip
    mean = sum(map(len, records)) / len(records)
    print(f"a line has {mean:.0f} bytes; zstd's default level here is {chunks.LEVEL}\n")
    columns = {size: list(rows(records, size, seconds)) for size in SIZES}
    head = "".join(f"{f'{size:,} a chunk':>20}" for size in SIZES)
    print(f"{'each record: us and bytes':36}{head}")
    for index, (what, _, _) in enumerate(columns[SIZES[0]]):
        cells = [columns[size][index] for size in SIZES]
        text = "".join(f"{cost:>11.1f}{'' if size is None else f'{size:.1f}':>9}" for _, cost, size in cells)
        print(f"{what:36}{text}")
    for level in LEVELS:
        what = f"whole chunk, level {level}"
        whole = [next(cell for cell in columns[size] if cell[0] == what) for size in SIZES]
        gas = "".join(f"{'':>11}{GAS_PER_BYTE * (cell[2] or 0):>9,.0f}" for cell in whole)
        print(f"{f'gas of the bytes, level {level}':36}{gas}")


if __name__ == "__main__":
    main()

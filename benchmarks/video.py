"""Video through robot, channel, server and archive: megabytes a second of processor time, and gas a minute.

    S3RVER=.s3rver/node_modules/.bin/s3rver python benchmarks/video.py [--seconds N] [--kind jpeg raw ...]

jpeg: images of 50 kB of noise, as compressed images look; raw: 640 x 480 rgb8, a moving pattern with noise. 30 Hz each.
First in one process, what a robot does with an image, step by step. Then for real: anvil, a server with one worker, a
folder or an S3 server, and a robot that replays the bag as fast as it goes; processor time is that of their processes.
Times are processor time, since other work may share the machine; megabytes are of images as they were published.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy
from rosbags.rosbag1 import Writer
from rosbags.typesys import Stores, get_typestore

import faults
from rosbridge_eth.capture import Capture, RawMessage, TopicRule, Wire, decoder_for_known, definition_line, stream_line
from rosbridge_eth.capture.rules import ARCHIVE_LIMIT
from rosbridge_eth.chunk import Chunk, Log, drop
from rosbridge_eth.ledger.contract import set_data_gas
from rosbridge_eth.ledger.submitter import BATCH_BYTES
from rosbridge_eth.spool import Spool
from rosbridge_eth.writer import LogWriter
from smcrypto import sm2

RATE, START = 30, 1_763_690_000 * 10**9
STORE = get_typestore(Stores.ROS1_NOETIC)
KINDS = {"jpeg": "sensor_msgs/msg/CompressedImage", "raw": "sensor_msgs/msg/Image"}
MB = 1e6


def images(kind: str, count: int) -> Iterator[tuple[int, bytes]]:
    """Receive time and bytes of each image."""
    random, (y, x) = numpy.random.default_rng(1), numpy.mgrid[0:480, 0:640]
    types = STORE.types
    for n in range(count):
        at = START + n * 10**9 // RATE
        header = types["std_msgs/msg/Header"](n, types["builtin_interfaces/msg/Time"](at // 10**9, at % 10**9), "cam")
        if kind == "jpeg":
            message = types[KINDS[kind]](header, "jpeg", random.integers(0, 256, 50_000).astype(numpy.uint8))
        else:
            pattern = numpy.stack([(x + 3 * n) % 256, (y + n) % 256, (x + y) % 256], -1)
            pixels = (pattern + random.integers(0, 3, pattern.shape)).astype(numpy.uint8).reshape(-1)
            message = types[KINDS[kind]](header, 480, 640, "rgb8", 0, 1920, pixels)
        yield at, bytes(STORE.serialize_ros1(message, KINDS[kind]))


def timed(call: Callable[[], object]) -> float:
    """Seconds of processor time."""
    before = time.process_time()
    call()
    return time.process_time() - before


def step_by_step(kind: str, seconds: int, folder: Path) -> None:
    """Capture, sealing and spool, and what the chunks would cost."""
    raws = list(images(kind, seconds * RATE))
    total = sum(len(raw) for _, raw in raws) / MB
    decoder = decoder_for_known(Wire.ROS1, KINDS[kind])
    assert decoder is not None
    capture = Capture([TopicRule("**", limit=ARCHIVE_LIMIT, archive=True)], source_kind="bag")
    key, reader, log = sm2.PrivateKey.generate(), sm2.PrivateKey.generate().public_key, Log(bytes(32), bytes(32))
    writer = LogWriter(log, key, [reader], previous=bytes(32), stream_line=stream_line("bag", ""), now=0.0)
    lines: list[tuple[float, bytes]] = []
    chunks: list[Chunk] = []

    def capture_all() -> None:
        for at, raw in raws:
            found = capture.process(RawMessage("/camera", KINDS[kind], at, raw, decoder), at)
            assert found is not None
            lines.append(((at - START) / 1e9, found.line))

    def seal_all() -> None:
        for now, line in lines:
            writer.add(line, now, (KINDS[kind], definition_line(decoder)), archived=True)
            chunks.extend(writer.closed(now, 0))
        chunks.extend(writer.finish(0))

    def spool_all() -> None:
        for chunk in chunks:
            spool.append(chunk)

    spool = Spool(folder / f"{kind}.sqlite", log, max_bytes=1 << 32, drop=lambda chunk: drop(log, key, chunk))
    for name, call in (("capture", capture_all), ("sealing", seal_all),
                       ("spool", spool_all)):  # fmt: skip
        spent = timed(call)
        print(f"{kind}: {name}: {total / spent:.0f} MB/s")
    spool.close()
    sizes, alone = [len(chunk.on_chain.encoded) for chunk in chunks], set_data_gas([])
    bodies = sum(len(chunk.body) for chunk in chunks if chunk.header.archived)
    minute = 60 / seconds
    full = (set_data_gas(sizes) - alone + alone * sum(sizes) / BATCH_BYTES) * minute
    each = sum(set_data_gas([size]) for size in sizes) * minute
    print(
        f"{kind}: a minute: {total * minute:.0f} MB of images, {bodies * minute / MB:.0f} MB of bodies in"
        f" {len(chunks) * minute:.0f} chunks; {full / 1e6:.2f} Mgas in full batches, {each / 1e6:.2f} Mgas in a"
        f" transaction each; on the chain it would be {40 * bodies * minute / 1e6:.0f} Mgas"
    )


def processor_time(pid: int) -> float:
    """Seconds that a process has used, its own and the system's for it."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


@contextmanager
def archive(kind: str, folder: Path) -> Iterator[tuple[str, Callable[[], int]]]:
    """What server.toml says of it, and what tells how many processes' time it is."""
    if kind == "folder":
        (folder / "bodies").mkdir()
        yield f'\n[archive]\nurl = "{folder / "bodies"}"\n', lambda: 0
        return
    from bridge.archive.s3 import S3

    (folder / "s3").mkdir()
    server = S3(folder / "s3")
    assert server.process is not None
    try:
        yield server.toml(), lambda: server.process.pid
    finally:
        server.kill()


def for_real(kind: str, seconds: int, where: str, folder: Path) -> None:
    with archive(where, folder) as (toml, other), faults.Site(folder) as site:
        site.home.config.write_text(site.home.config.read_text() + toml)
        site.restart_server()
        with Writer(folder / "video.bag") as bag:
            line = bag.add_connection("/camera", KINDS[kind], typestore=STORE)
            total = 0
            for at, raw in images(kind, seconds * RATE):
                bag.write(line, at, raw)
                total += len(raw)
        name = site.register()
        site.join(name, home := folder / name)
        (home / "robot.toml").write_text(
            'topics = [{ topic = "/camera", store = "archive" }]\n[spool]\nmax_size = "4 GiB"\n'
            f'[source]\nkind = "bag"\nspeed = "max"\npath = "{folder / "video.bag"}"\n'
        )
        workers = [site.child(f"worker-{n}") for n in range(2)]
        before, began = sum(map(processor_time, workers)), time.monotonic()
        stored = processor_time(other()) if other() else 0.0
        robot, spent = site.run_robot(home, folder / "robot.log", {}), 0.0
        while not robot.ended():
            spent = processor_time(robot.pid) or spent
            time.sleep(0.05)
        assert robot.wait() == 0, robot.said
        took, served = time.monotonic() - began, sum(map(processor_time, workers)) - before
        stored = (processor_time(other()) if other() else 0.0) - stored
        store = f", the S3 server {stored:.1f} s" if other() else ""
        print(
            f"{kind}, {where}: {total / MB:.0f} MB in {took:.1f} s ({total / MB / took:.1f} MB/s); processor time:"
            f" robot {spent:.1f} s ({total / MB / spent:.1f} MB/s), server {served:.1f} s"
            f" ({total / MB / served:.1f} MB/s){store}"
        )


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=int, default=10, help="of video")
    parser.add_argument("--kind", nargs="+", choices=KINDS, default=list(KINDS))
    parser.add_argument("--archive", nargs="+", choices=["folder", "s3"], default=["folder", "s3"])
    chosen = parser.parse_args(arguments)
    print(f"load average: {', '.join(f'{each:.1f}' for each in os.getloadavg())}")
    for kind in chosen.kind:
        with tempfile.TemporaryDirectory() as folder:
            step_by_step(kind, chosen.seconds, Path(folder))
        for where in chosen.archive:
            with tempfile.TemporaryDirectory() as folder:
                for_real(kind, chosen.seconds, where, Path(folder))


if __name__ == "__main__":
    main()

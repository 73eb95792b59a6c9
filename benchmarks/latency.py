"""How long a message takes from capture to the server's store and to the chain, through networks that lose and delay.

    python -m benchmarks.paper --only latency

One robot with everything real (source, capture, disk, channel), a server's shard as a process of its own, anvil with
a block for what is written at once and one confirmation, and between robot and server a relay that loses and delays
datagrams. A message counts from the moment at which its source hands it out; it is stored, or confirmed, when the robot
is told so. A chunk is closed a second after its first message (`period`, the default), so that half a second is the
least there can be on average.
"""

from __future__ import annotations

import heapq
import multiprocessing
import random
import select
import socket
import statistics
import tempfile
import threading
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import bridge_costs
import load
from rosbridge_eth.capture import Capture, stream_line
from rosbridge_eth.channel import Client, ClientConfig
from rosbridge_eth.channel.udp import server_socket
from rosbridge_eth.config import Address
from rosbridge_eth.identity import Identity
from rosbridge_eth.log.chunk import Chunk, Log, drop, robot_id
from rosbridge_eth.log.store import place_of
from rosbridge_eth.log.writer import LogWriter
from rosbridge_eth.robot.loop import Robot
from rosbridge_eth.robot.sender import Sender
from rosbridge_eth.robot.spool import Spool

NETWORKS = ((0.0, 0.0), (0.05, 0.02), (0.05, 0.1), (0.3, 0.02), (0.3, 0.1), (0.3, 0.3))
"""Loss each way, and seconds that a datagram takes each way: a round trip of 0, 40, 200 or 600 ms."""
SHARES = (("least", 0.0), ("median", 0.5), ("95 %", 0.95), ("99 %", 0.99), ("most", 1.0))
OPENING = 2  # lines of a stream that are no messages: what it is from, and the type's definition
FORK = multiprocessing.get_context("fork")


class SlowRelay(threading.Thread):
    """Passes datagrams between one client and `server`; each way, each is lost with a chance or comes after `delay`."""

    def __init__(self, server: tuple[str, int], loss: float, delay: float, seed: int = 1) -> None:
        super().__init__(name="relay", daemon=True)
        self._server, self._loss, self._delay, self._random = server, loss, delay, random.Random(seed)
        self._near, self._far = (socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2))
        for sock in (self._near, self._far):
            sock.bind(("127.0.0.1", 0))
        self.address = Address(*self._near.getsockname())
        self._ended = threading.Event()

    def run(self) -> None:
        client: Any = None
        waiting: list[tuple[float, int, socket.socket, bytes, Any]] = []
        count = 0
        while not self._ended.is_set():
            wait = max(0.0, waiting[0][0] - time.monotonic()) if waiting else 0.05
            for sock in select.select([self._near, self._far], [], [], min(wait, 0.05))[0]:
                data, sender = sock.recvfrom(65_535)
                client = sender if sock is self._near else client
                out, to = (self._far, self._server) if sock is self._near else (self._near, client)
                count += 1
                if self._random.random() >= self._loss:
                    heapq.heappush(waiting, (time.monotonic() + self._delay, count, out, data, to))
            while waiting and waiting[0][0] <= time.monotonic():
                _, _, out, data, to = heapq.heappop(waiting)
                out.sendto(data, to)

    def close(self) -> None:
        self._ended.set()
        self.join()
        self._near.close()
        self._far.close()


class Paced(bridge_costs.Odometry):
    """The sample's Odometry at a real pace; remembers when each message was handed out."""

    def __init__(self, count: int, pace: float) -> None:
        super().__init__(count)
        self._pace = pace
        self.handed_out: list[float] = []

    def run(self, emit: Any, stop: threading.Event) -> None:
        began = time.monotonic()
        for number, message in enumerate(self):
            if stop.wait(max(0.0, began + number / self._pace - time.monotonic())):
                return
            self.handed_out.append(time.monotonic())
            emit(message)
        stop.wait()  # until all is confirmed


class Told:
    """When the robot was told of each of its chunks that it is stored, and that it is confirmed."""

    def __init__(self, robot: Robot) -> None:
        self._sender, self.chunks = robot.sender, list[Chunk]()
        self.stored, self.confirmed = list[float](), list[float]()
        append = robot.spool.append

        def keep(chunk: Chunk) -> None:
            append(chunk)
            self.chunks.append(chunk)

        robot.spool.append = keep  # type: ignore[method-assign]

    def look(self) -> None:
        """To be called at every turn of the robot's loop."""
        state = self._sender.state
        if state is not None:
            for place, times in ((state.head, self.stored), (state.confirmed, self.confirmed)):
                while len(times) < len(self.chunks) and place_of(self.chunks[len(times)].header) <= place:
                    times.append(time.monotonic())


def through(operator: load.Operator, robot: Identity, loss: float, delay: float, messages: int, pace: float) -> Any:
    """Seconds of each message until it was stored, and until it was confirmed; sorted."""
    sock = server_socket(Address("127.0.0.1", 0))
    here, there = FORK.Pipe()
    serving = FORK.Process(target=operator.serve, args=(0, 1, sock, FORK.Value("d"), there))
    serving.start()
    relay = SlowRelay(sock.getsockname(), loss, delay)
    relay.start()
    place, key, now = Log(operator.ledger.ledger, robot_id(robot.name)), robot.signing_key, time.monotonic()
    spool = Spool(operator.spools / f"{robot.name}.sqlite", place, max_bytes=1 << 30, drop=partial(drop, place, key))
    writer = LogWriter(
        place, key, [operator.reader.encryption_certificate.public_key], previous=spool.last_digest,
        stream_line=stream_line("bag", "benchmark"), now=now,
    )  # fmt: skip
    client = Client(ClientConfig(), robot, operator.trust, None, now)
    source = Paced(messages, pace)
    made = Robot(
        source=source, capture=Capture([bridge_costs.rule(False)], source_kind="bag"),  # type: ignore[arg-type]
        writer=writer, spool=spool, client=client, sender=Sender(client, spool, writer), servers=[relay.address],
    )  # fmt: skip
    told = Told(made)

    def turn() -> None:
        told.look()
        if sum(chunk.header.records for chunk in told.chunks[: len(told.confirmed)]) >= messages + OPENING:
            made.stop()

    made.run(on_turn=turn)
    relay.close()
    serving.terminate()
    here.send(0)
    here.recv()
    serving.join()
    sock.close()
    return [_spread(source.handed_out, told.chunks, times) for times in (told.stored, told.confirmed)]


def _spread(handed_out: Sequence[float], chunks: Sequence[Chunk], times: Sequence[float]) -> list[float]:
    """Seconds of each message, sorted: the records of the chunks in order, behind the lines that open the stream."""
    records = [at for chunk, at in zip(chunks, times, strict=False) for _ in range(chunk.header.records)]
    return sorted(at - begun for begun, at in zip(handed_out, records[OPENING:], strict=True))


def measure(quick: bool) -> dict[str, Any]:
    """Both distributions in seconds, for every network."""
    count, networks = 165 if quick else 3000, NETWORKS[:2] if quick else NETWORKS
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        operator = load.Operator(Path(folder), "anvil", "sqlite", len(networks), lambda text: None)
        try:
            for robot, (loss, delay) in zip(operator.robots, networks, strict=True):
                stored, confirmed = through(operator, robot, loss, delay, count, bridge_costs.PACE)
                rows.append({"loss": loss, "delay": delay, "stored": figures(stored), "confirmed": figures(confirmed)})
        finally:
            operator.close()
    return {"messages": count, "pace": bridge_costs.PACE, "rows": rows}


def figures(ordered: Sequence[float]) -> dict[str, float]:
    named = {name: ordered[int(share * (len(ordered) - 1))] for name, share in SHARES}
    return named | {"mean": statistics.fmean(ordered)}

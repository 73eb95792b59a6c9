"""What a message costs the robot and the server, stage by stage, and how many go through in a second.

    python benchmarks/bridge_costs.py [--messages 3000] [--json FILE]

The messages are the sample bag's Odometry, over and over. In the first part
both ends run in one process without a socket, and the time of each stage is
added up where it is spent. In the second, robot and server are two processes
on loopback with everything real up to the server's commit.

For comparison, the paper's user end took 0.852 ms a message and its server
0.422 ms to decrypt one, on an i9-10900KF at 3.7 GHz (Security and
Communication Networks 2022, article 7206494).
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import platform
import tempfile
import threading
import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any

from rosbridge_eth import identity as ids
from rosbridge_eth.capture import Capture, RawMessage, TopicRule
from rosbridge_eth.channel import Client, ClientConfig, MessageReceived, Server, ServerConfig, cookie_key
from rosbridge_eth.channel.udp import UdpLoop, client_socket, server_sockets
from rosbridge_eth.protocol import RecordStatus, Registration
from rosbridge_eth.robot.process import TAKE, Robot
from rosbridge_eth.robot.recorder import Recorder
from rosbridge_eth.robot.sender import Sender
from rosbridge_eth.sealing import Sealer
from rosbridge_eth.server.reception import Reception
from rosbridge_eth.server.worker import Worker
from rosbridge_eth.sources import BagSettings, Selection
from rosbridge_eth.sources.bag import BagSource
from rosbridge_eth.sources.sample import sample_bag
from rosbridge_eth.store import Spool, SqliteInbox

TOPIC = "/robot_1/odom"
NOW = datetime.now(UTC)


class Identities:
    """A CA, a server, a robot and a reader, made once."""

    def __init__(self) -> None:
        ca = ids.create_ca("benchmark", at=NOW)
        self.server = ids.enrol(ca, ids.Role.SERVER, "server", at=NOW)
        self.robot = ids.enrol(ca, ids.Role.ROBOT, "robot_1", at=NOW)
        self.reader = ids.enrol(ca, ids.Role.READER, "owner", at=NOW)
        self.trust = ids.Trust((ca.certificate,))

    def recorder(self, spool: Spool) -> Recorder:
        sealer = Sealer(
            self.robot.public.robot_id, partial(ids.sign, self.robot.signing_key),
            [self.reader.encryption_certificate.public_key], previous=spool.last,
        )
        return Recorder(Capture([TopicRule(TOPIC)]), sealer, spool)

    def reception(self, server: Server, inbox: SqliteInbox) -> Reception:
        registration = Registration(True, "0x0", "0x0", 1, 0)
        return Reception(server, inbox, status_of=lambda id: RecordStatus("stored"),
                         registration_of=lambda peer: registration)


class Odometry:
    """A source of `count` messages: the sample bag's, again and again."""

    live = False

    def __init__(self, count: int) -> None:
        bag = BagSource(BagSettings(sample_bag(), speed=None), Selection([TOPIC]))
        self.messages = list(bag.messages())
        bag.close()
        self.count = count

    def __iter__(self) -> Iterator[RawMessage]:
        for number in range(self.count):
            yield self.messages[number % len(self.messages)]

    def offers(self) -> list[Any]:
        return []

    def decoders(self) -> dict[str, Any]:
        return {}

    def run(self, emit: Any, stop: threading.Event) -> None:
        for message in self:
            if stop.is_set():
                return
            emit(message)

    def close(self) -> None:
        """Nothing is open."""


class Stopwatch:
    """Seconds by stage."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = defaultdict(float)

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        started = time.perf_counter()
        yield
        self.seconds[stage] += time.perf_counter() - started


def stage_costs(who: Identities, folder: Path, count: int) -> dict[str, dict[str, float]]:
    """Milliseconds per message of each stage, both ends in one process, no socket."""
    watch = Stopwatch()
    spool, inbox = Spool(folder / "spool.sqlite", who.robot.public.robot_id), SqliteInbox(folder / "inbox.sqlite")
    recorder = who.recorder(spool)
    now = time.monotonic()
    client = Client(ClientConfig(), who.robot, who.trust, "server", now)
    server = Server(ServerConfig(), who.server, who.trust, cookie_key(who.server), now)
    sender, reception = Sender(client, spool), who.reception(server, inbox)
    there, back = ("192.0.2.1", 7410), ("192.0.2.2", 5000)
    client.connect(there, now)

    def exchange(measured: bool) -> None:
        now = time.monotonic()
        watcher = watch if measured else Stopwatch()
        with watcher("robot: send"):
            spool.commit(now)
            sender.send(now)
            client.handle_timer(now)
            sent = client.datagrams_to_send(now)
        with watcher("server: receive and open"):
            for data, _ in sent:
                server.receive_datagram(data, back, now)
            arrived = []
            while (event := server.next_event()) is not None:
                if isinstance(event, MessageReceived):
                    arrived.append(event)
        with watcher("server: commit and answer"):
            if arrived:
                reception.take(arrived, wall=time.time(), now=now)
            server.handle_timer(now)
            answers = server.datagrams_to_send(now)
        with watcher("robot: acknowledgements"):
            for data, _ in answers:
                client.receive_datagram(data, there, now)
            while (event := client.next_event()) is not None:
                sender.handle(event, now)

    while not client.writable(time.monotonic()):
        exchange(measured=False)
    for number, raw in enumerate(Odometry(count)):
        recorder.take(raw, wall_ns=time.time_ns(), mono_ns=time.monotonic_ns(), now=time.monotonic())
        if number % TAKE == TAKE - 1:  # as the robot's loop turns while messages come in
            exchange(measured=True)
    while not sender.idle:
        exchange(measured=True)
    spool.close()
    inbox.close()
    times = recorder.times
    robot = {"capture": times.capture, "seal": times.seal, "spool": times.spool,
             "send": watch.seconds["robot: send"], "acknowledgements": watch.seconds["robot: acknowledgements"]}
    serving = {"receive and open": watch.seconds["server: receive and open"],
               "commit and answer": watch.seconds["server: commit and answer"]}
    return {
        end: {stage: seconds / count * 1000 for stage, seconds in stages.items()}
        for end, stages in (("robot", robot), ("server", serving))
    }


def throughput(who: Identities, folder: Path, count: int) -> float:
    """Messages per second from the bag to the server's commit, robot and server as two processes on loopback."""
    [sock] = server_sockets(("127.0.0.1", 0))
    port = sock.getsockname()[1]
    context = multiprocessing.get_context("fork")
    stop = context.Event()

    def serve() -> None:
        inbox = SqliteInbox(folder / "inbox-2.sqlite")
        server = Server(ServerConfig(), who.server, who.trust, cookie_key(who.server), time.monotonic())
        Worker(
            server, who.reception(server, inbox),
            lambda on_event, on_batch: UdpLoop(server, sock, on_event, on_batch=on_batch), lambda peer: True, lambda: 1,
        ).run(stop.is_set)

    serving = context.Process(target=serve)
    serving.start()
    spool = Spool(folder / "spool-2.sqlite", who.robot.public.robot_id)
    recorder = who.recorder(spool)
    client = Client(ClientConfig(), who.robot, who.trust, "server", time.monotonic())
    sender = Sender(client, spool)
    near, address = client_socket(("127.0.0.1", port))
    loop = UdpLoop(client, near, lambda event: sender.handle(event, time.monotonic()))
    client.connect(address, time.monotonic())
    robot = Robot(source=Odometry(count), recorder=recorder, sender=sender, spool=spool, client=client, loop=loop)
    started = time.perf_counter()
    robot.run()
    seconds = time.perf_counter() - started
    stop.set()
    serving.join(10)
    if sender.statistics.stored < count:
        raise SystemExit(f"only {sender.statistics.stored} of {count} were stored")
    return count / seconds


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--messages", type=int, default=3000)
    parser.add_argument("--json", type=Path, help="write the figures here as well")
    options = parser.parse_args()
    who = Identities()
    with tempfile.TemporaryDirectory() as folder:
        costs = stage_costs(who, Path(folder), options.messages)
        rate = throughput(who, Path(folder), options.messages)
    print(f"{platform.processor() or platform.machine()}, Python {platform.python_version()}, "
          f"{options.messages} Odometry messages\n")
    print("| end | stage | ms per message |\n| --- | --- | ---: |")
    for end, stages in costs.items():
        for stage, cost in stages.items():
            print(f"| {end} | {stage} | {cost:.3f} |")
        print(f"| {end} | **in all** | **{sum(stages.values()):.3f}** |")
    print(f"\nThrough loopback, robot and server as two processes: {rate:.0f} messages/s")
    if options.json:
        options.json.write_text(json.dumps({"milliseconds": costs, "messages_per_second": rate}, indent=1))


if __name__ == "__main__":
    main()

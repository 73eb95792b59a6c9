"""Two machines with one robot's identity at one worker: the session goes to and fro, and the operator is told."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from rosbridge_eth import identity as ids
from rosbridge_eth.channel import Client, ClientConfig, Server, ServerConfig, cookie_key
from rosbridge_eth.channel.udp import UdpLoop, client_socket, server_sockets
from rosbridge_eth.protocol import RecordStatus, Registration
from rosbridge_eth.server.reception import Reception
from rosbridge_eth.server.worker import Worker
from rosbridge_eth.store import SqliteInbox

NOW = datetime.now(UTC) - timedelta(hours=1)
CA = ids.create_ca("operator", at=NOW)
HUB = ids.enrol(CA, ids.Role.SERVER, "hub", at=NOW)
ROBOTS = [ids.enrol(CA, ids.Role.ROBOT, name, at=NOW) for name in ("robot_1", "robot_2")]
TRUST = ids.Trust((CA.certificate,))
PATIENCE = 30.0  # s, until a test gives up


@pytest.fixture
def port(tmp_path: Path) -> Iterator[int]:
    """Of a worker that runs."""
    [sock] = server_sockets(("127.0.0.1", 0))
    stop = threading.Event()

    def serve() -> None:
        server = Server(ServerConfig(), HUB, TRUST, cookie_key(HUB), time.monotonic())
        reception = Reception(
            server, SqliteInbox(tmp_path / "inbox.sqlite"), status_of=lambda id: RecordStatus("unknown"),
            registration_of=lambda peer: Registration(False, None, "0x", 1, 0),
        )
        Worker(server, reception, lambda on_event, on_batch: UdpLoop(server, sock, on_event, on_batch=on_batch),
               lambda peer: True, lambda: 1).run(stop.is_set)

    thread = threading.Thread(target=serve)
    thread.start()
    yield sock.getsockname()[1]
    stop.set()
    thread.join()


class Machine:
    def __init__(self, who: ids.Identity, port: int) -> None:
        self.client = Client(ClientConfig(), who, TRUST, "hub", time.monotonic())
        sock, address = client_socket(("127.0.0.1", port))
        self.loop = UdpLoop(self.client, sock, lambda event: None)
        self.client.connect(address, time.monotonic())
        self.until("connected")
        self.place = f"127.0.0.1 port {sock.getsockname()[1]}"

    def until(self, state: str) -> None:
        end = time.monotonic() + PATIENCE
        while self.client.state != state:
            assert time.monotonic() < end, self.client.state
            self.loop.step(0.2)

    def close(self) -> None:
        self.client.close(time.monotonic())
        self.until("idle")
        self.loop.close()



def warnings(caplog: pytest.LogCaptureFixture) -> list[str]:
    return [entry.getMessage() for entry in caplog.records if entry.levelno >= logging.WARNING]


def test_a_second_machine_with_the_same_identity_is_told_of_with_both_addresses(
    port: int, caplog: pytest.LogCaptureFixture
) -> None:
    first, second = Machine(ROBOTS[0], port), Machine(ROBOTS[0], port)
    end = time.monotonic() + PATIENCE
    while not warnings(caplog) and time.monotonic() < end:
        second.loop.step(0.2)
    [told] = warnings(caplog)
    assert "robot robot_1" in told and first.place in told and second.place in told
    second.close()
    first.loop.close()


def test_other_robots_and_a_robot_that_comes_again_are_no_reason(port: int, caplog: pytest.LogCaptureFixture) -> None:
    other, first = Machine(ROBOTS[1], port), Machine(ROBOTS[0], port)
    first.close()
    Machine(ROBOTS[0], port).close()
    other.close()
    assert warnings(caplog) == []

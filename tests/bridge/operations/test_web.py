"""The HTTP end: three paths, verdicts as status codes, and clients that dawdle or lie."""

from __future__ import annotations

import http.client
import json
import socket
from collections.abc import Iterator

import pytest

from rosbridge_eth.errors import NetworkError
from rosbridge_eth.operations.board import Board
from rosbridge_eth.operations.figures import Condition, Snapshot, sample
from rosbridge_eth.operations.web import AT_ONCE, Web


@pytest.fixture
def board() -> Board:
    made = Board(["robot"])
    made.put(Snapshot.of("robot", [sample("captured", 3)], [Condition("robot has a session", True)]))
    return made


@pytest.fixture
def web(board: Board) -> Iterator[Web]:
    made = Web(("127.0.0.1", 0), board)
    made.start()
    yield made
    made.stop()


def ask(web: Web, path: str, method: str = "GET") -> tuple[int, bytes]:
    connection = http.client.HTTPConnection(*web.address, timeout=5)
    try:
        connection.request(method, path)
        answer = connection.getresponse()
        return answer.status, answer.read()
    finally:
        connection.close()


def test_metrics_health_and_readiness_are_served(web: Web):
    status, body = ask(web, "/metrics")
    assert status == 200 and b'rosbridge_eth_captured_total{process="robot"} 3.0' in body
    assert ask(web, "/healthz")[0] == 200
    status, body = ask(web, "/readyz?verbose=1")
    assert status == 200 and json.loads(body)["ok"] is True
    assert ask(web, "/readyz", "HEAD") == (200, b"")


def test_what_does_not_hold_is_503_with_the_reason(web: Web, board: Board):
    board.put(Snapshot.of("robot", [], [Condition("robot has a session", False, "no answer")]))
    status, body = ask(web, "/readyz")
    assert status == 503
    assert {"name": "robot has a session", "ok": False, "says": "no answer"} in json.loads(body)["conditions"]
    assert ask(web, "/healthz")[0] == 200


@pytest.mark.parametrize("path", ["/", "/metrics/", "/../metrics", "//x/metrics", "/" + "a" * 60_000])
def test_there_is_nothing_else(web: Web, path: str):
    assert ask(web, path)[0] == 404


@pytest.mark.parametrize("method", ["POST", "PUT", "DELETE", "OPTIONS"])
def test_nothing_can_be_written(web: Web, method: str):
    assert ask(web, "/metrics", method)[0] == 501


def test_clients_that_say_nothing_or_nonsense_hold_nobody_up(web: Web):
    silent = [socket.create_connection(web.address, timeout=5) for _ in range(AT_ONCE - 1)]
    try:
        silent[0].sendall(b"\x16\x03\x01 this is no HTTP")
        assert ask(web, "/healthz")[0] == 200
    finally:
        for sock in silent:
            sock.close()


def test_more_clients_than_are_served_at_once_are_turned_away_and_it_recovers(web: Web):
    crowd = [socket.create_connection(web.address, timeout=5) for _ in range(3 * AT_ONCE)]
    turned_away = 0
    for sock in crowd[AT_ONCE:]:
        try:
            turned_away += sock.recv(1) == b""
        except ConnectionResetError:
            turned_away += 1
    assert turned_away == 2 * AT_ONCE
    for sock in crowd:
        sock.close()
    for _ in range(100):  # until the threads have seen that their clients are gone
        try:
            if ask(web, "/healthz")[0] == 200:
                break
        except (http.client.HTTPException, ConnectionError):
            continue
    assert ask(web, "/healthz")[0] == 200


def test_a_port_that_is_taken_is_an_error_that_names_the_key(web: Web, board: Board):
    with pytest.raises(NetworkError, match="correct `monitor`"):
        Web(web.address, board)

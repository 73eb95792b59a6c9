"""/metrics, /healthz and /readyz over HTTP.

Meant for the machine itself or a private network: whoever reaches the port
reads names, balances and counts. It takes no input but the path, and serves a
few requests at a time, each within seconds.
"""

from __future__ import annotations

import json
import logging
import socket
import threading
from collections.abc import Sequence
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

from prometheus_client import CollectorRegistry
from prometheus_client.exposition import CONTENT_TYPE_LATEST, generate_latest

from rosbridge_eth.errors import NetworkError
from rosbridge_eth.operations.board import Board, BoardCollector
from rosbridge_eth.operations.figures import Condition

log = logging.getLogger(__name__)

AT_ONCE = 16  # requests; more are turned away
TIMEOUT = 5.0  # seconds for a client to send its request and take the answer


def render(board: Board) -> bytes:
    """The board in the Prometheus text format."""
    registry = CollectorRegistry(auto_describe=False)
    registry.register(BoardCollector(board))
    return generate_latest(registry)


def verdict(conditions: Sequence[Condition]) -> tuple[HTTPStatus, bytes]:
    """200 where all hold, else 503; the body names each."""
    good = all(condition.holds for condition in conditions)
    body = {
        "ok": good,
        "conditions": [
            {"name": each.name, "ok": each.holds, **({"says": each.says} if each.says else {})} for each in conditions
        ],
    }
    return (HTTPStatus.OK if good else HTTPStatus.SERVICE_UNAVAILABLE), json.dumps(body, indent=1).encode() + b"\n"


class _Request(BaseHTTPRequestHandler):
    """One connection, one request."""

    server_version, sys_version = "rosbridge-eth", ""
    protocol_version = "HTTP/1.0"
    timeout = TIMEOUT
    board: Board

    def do_GET(self) -> None:
        path = self.path.partition("?")[0]
        if path == "/metrics":
            self._answer(HTTPStatus.OK, render(self.board), CONTENT_TYPE_LATEST)
        elif path == "/healthz":
            self._answer(*verdict(self.board.health()), "application/json")
        elif path == "/readyz":
            self._answer(*verdict(self.board.readiness()), "application/json")
        else:
            self._answer(HTTPStatus.NOT_FOUND, b"/metrics /healthz /readyz\n", "text/plain")

    do_HEAD = do_GET

    def _answer(self, status: HTTPStatus, body: bytes, kind: str) -> None:
        self.send_response(status)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(body)))
        self.send_header("Cache-Control", "no-store")
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(body)

    def log_message(self, format: str, *arguments: Any) -> None:
        """What a client asked for is its own words: not for the log."""


class Web(ThreadingHTTPServer):
    """Serves a board from threads of its own between `start` and `stop`."""

    daemon_threads = True

    def __init__(self, address: tuple[str, int], board: Board) -> None:
        """NetworkError if the port cannot be had."""
        if ":" in address[0]:
            self.address_family = socket.AF_INET6
        self._free = threading.BoundedSemaphore(AT_ONCE)
        self._thread = threading.Thread(target=self.serve_forever, args=(0.1,), name="web", daemon=True)
        try:
            super().__init__(address, type("_BoardRequest", (_Request,), {"board": board}))
        except OSError as error:
            raise NetworkError(
                f"TCP port {address[1]} of {address[0]} cannot be opened: {error.strerror}; correct `monitor`"
            ) from error

    @property
    def address(self) -> tuple[str, int]:
        host, port = self.server_address[:2]
        return str(host), int(port)

    def start(self) -> None:
        self._thread.start()

    def stop(self) -> None:
        self.shutdown()
        self.server_close()
        self._thread.join()

    def process_request(self, request: Any, client_address: Any) -> None:
        if not self._free.acquire(blocking=False):
            self.shutdown_request(request)
            return
        super().process_request(request, client_address)

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._free.release()

    def handle_error(self, request: Any, client_address: Any) -> None:
        log.debug("a client of the monitor went away")

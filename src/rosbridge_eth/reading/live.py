"""A page that shows robots as their log is proven: trajectories, latest values, and how the chain stands.

The page asks for `events` (Server-Sent Events) and is sent all there is to show, at most once a second and only where
it changed. A page that missed something has missed nothing, so neither end remembers what the other knows. It is
served to whoever asks at a name of this machine's own: no site elsewhere that a browser shows can read it.

Memory is bounded: so many points of a trajectory, the newest record of so many topics, the findings of the verdict.
"""

from __future__ import annotations

import json
import re
import socket
import sys
import threading
import time
from collections.abc import Iterable, Mapping, Sequence
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib import resources
from io import BufferedReader
from itertools import islice
from typing import Any, Final

from rosbridge_eth.config.values import Address, time_text
from rosbridge_eth.errors import NetworkError
from rosbridge_eth.reading.follow import EVERY, Followed
from rosbridge_eth.reading.outputs import Trajectory, flattened
from rosbridge_eth.reading.verdict import HEARTBEAT, shown
from rosbridge_eth.reading.verify import ProvenRecord

MAX_POINTS: Final = 1 << 10
"""Of a topic's trajectory; a longer one is thinned out all over its length."""
MAX_TOPICS: Final = 64
MAX_FIELDS: Final = 64
MAX_TOPIC: Final = 255
"""Characters of its name."""
MAX_CONNECTIONS: Final = 64
"""At once, with those of the pages that are shown; each has a thread. Further ones are closed."""
QUIET: Final = 15
"""So many seconds without news, and a comment is sent: an end that is gone is noticed."""
PATIENCE: Final = 10.0
"""Seconds for a whole request to come, and for an answer to be taken."""
OWN_NAMES: Final = frozenset({"127.0.0.1", "localhost", "::1"})
_FILES: Final = {
    "/": ("live.html", "text/html"), "/live.css": ("live.css", "text/css"),
    "/live.js": ("live.js", "text/javascript"), "/drawing.js": ("drawing.js", "text/javascript"),
}  # fmt: skip
_HEADERS: Final = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self';"
    " base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff", "Referrer-Policy": "no-referrer", "Cache-Control": "no-store",
    "Cross-Origin-Resource-Policy": "same-origin",
}  # fmt: skip


class View:
    """What the page shows. Written by the thread that reads, `state` asked for by those that serve."""

    def __init__(self, nodes: Sequence[str], confirmations: int, robots: Iterable[str]) -> None:
        self._lock, self.version, self.closed = threading.Lock(), 0, threading.Event()
        self._made, self._due = (-1, b""), 0.0
        self._about = {"nodes": nodes, "confirmations": confirmations}
        self._tracks = {name: Trajectory(MAX_POINTS) for name in robots}
        self._latest: dict[str, dict[str, ProvenRecord]] = {name: {} for name in self._tracks}
        self._stands: dict[str, dict[str, Any]] = {name: {} for name in self._tracks}

    def write(self, name: str, record: ProvenRecord) -> None:
        with self._lock:
            self._tracks[name].write(record)
            latest = self._latest[name]
            if record.content.topic in latest or len(latest) < MAX_TOPICS:
                latest[record.content.topic] = record  # what is shown of it is made when it is asked for
            self.version += 1

    def show(self, robots: Iterable[Followed]) -> None:
        """How the robots' logs stand now."""
        with self._lock:
            for robot in robots:
                self._stands[robot.name] = _standing(robot)
            self.version += 1

    def state(self) -> tuple[int, bytes]:
        """The version and, as JSON, all of it; made once a second at most, for all pages: nobody writes meanwhile."""
        with self._lock:
            if time.monotonic() < self._due:
                return self._made
            robots = [
                {"name": name, **self._stands[name], "tracks": _tracks(track),
                 "latest": [_values(one) for _, one in sorted(self._latest[name].items())]}
                for name, track in self._tracks.items()
            ]  # fmt: skip
            state = json.dumps(self._about | {"robots": robots}, separators=(",", ":")).encode()
            self._made, self._due = (self.version, state), time.monotonic() + EVERY
            return self._made


def _standing(robot: Followed) -> dict[str, Any]:
    if robot.reading is None:
        return {"trouble": robot.trouble}
    verdict, top = robot.reading.verdict(), robot.reading.top
    head = verdict.head
    return {
        "trouble": robot.trouble, "sound": verdict.sound, "block": verdict.block, "block_s": top.time,
        "chunks": verdict.chunks, "records": verdict.records, "goodbye": head is not None and head.goodbye,
        "sealed_ms": head and head.sealed_ms, "silent_s": HEARTBEAT, "lines": list(verdict.lines()),
    }  # fmt: skip


def _tracks(trajectory: Trajectory) -> list[dict[str, Any]]:
    return [
        {"topic": shown(topic, MAX_TOPIC), "count": track.count,
         "from_ns": str(track.kept[0][0]), "to_ns": str(track.last[0]),
         "points": [[float(f"{x:.10g}"), float(f"{y:.10g}")] for _, x, y in (*track.kept, track.last)]}
        for topic, track in trajectory.tracks.items()
    ]  # fmt: skip


def _values(record: ProvenRecord) -> dict[str, Any]:
    content, place = record.content, record.place
    cells = flattened(content.data, "")
    fields = [[shown(name), shown(_text(value), 80)] for name, value in islice(cells, MAX_FIELDS)]
    return {
        "topic": shown(content.topic, MAX_TOPIC), "type": shown(content.type_name),
        "received": time_text(content.received_ns), "chunk": place.chunk, "block": place.block,
        "fields": fields, "more": sum(1 for _ in cells),
    }  # fmt: skip


def _text(value: Any) -> str:
    if isinstance(value, list):
        return f"[{', '.join(map(_text, value[:6]))}{f', … {len(value):,} in all' if len(value) > 6 else ''}]"
    return f"{value:.6g}" if isinstance(value, float) else value if isinstance(value, str) else json.dumps(value)


class Page:
    """Serves a view from threads of its own until `close`. NetworkError where the address cannot be opened."""

    def __init__(self, address: Address, view: View) -> None:
        files = resources.files(__package__)
        handler = type("_View", (_Handler,), {
            "view": view, "names": OWN_NAMES | {address.host.lower()},
            "files": {path: (files.joinpath(name).read_bytes(), kind) for path, (name, kind) in _FILES.items()},
        })  # fmt: skip
        room = threading.BoundedSemaphore(MAX_CONNECTIONS)
        server = type("_Server", (_Server,), {"address_family": address.family, "room": room})
        try:
            self._http = server(tuple(address), handler)
        except OSError as error:
            raise NetworkError(f"the page cannot be served at {address}: {error.strerror}; choose another") from error
        self.address, self._view = Address(address.host, self._http.server_address[1]), view
        threading.Thread(target=self._http.serve_forever, args=(0.2,), name="page", daemon=True).start()

    def close(self) -> None:
        self._view.closed.set()
        self._http.shutdown()
        self._http.server_close()


class _Server(ThreadingHTTPServer):
    daemon_threads, request_queue_size = True, MAX_CONNECTIONS
    room: threading.BoundedSemaphore

    def verify_request(self, request: Any, client_address: Any) -> bool:
        return self.room.acquire(blocking=False)

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        try:
            super().process_request_thread(request, client_address)
        finally:
            self.room.release()

    def handle_error(self, request: Any, client_address: Any) -> None:
        if not isinstance(sys.exception(), OSError):  # a page that was closed
            super().handle_error(request, client_address)


class _Request(socket.SocketIO):
    """What comes on a connection, until PATIENCE is over: whoever sends a byte now and then holds no thread."""

    def __init__(self, connection: socket.socket, patience: float) -> None:
        super().__init__(connection, "r")
        self._connection, self._end = connection, time.monotonic() + patience

    def readinto(self, buffer: Any) -> int | None:
        left = self._end - time.monotonic()
        if left <= 0:
            raise TimeoutError
        self._connection.settimeout(left)
        return super().readinto(buffer)


class _Handler(BaseHTTPRequestHandler):
    view: View
    names: frozenset[str]
    files: Mapping[str, tuple[bytes, str]]
    timeout, server_version, sys_version = PATIENCE, "rosbridge-eth", ""

    def setup(self) -> None:
        super().setup()
        self.rfile = BufferedReader(_Request(self.connection, self.timeout))

    def do_GET(self) -> None:
        self.connection.settimeout(self.timeout)
        # A site that gave its own name this machine's address (DNS rebinding) comes with its own name here.
        if re.sub(r":\d+$", "", self.headers.get("Host", "")).strip("[]").lower() not in self.names:
            self._send(HTTPStatus.FORBIDDEN, b"this page is shown under this machine's own address only\n")
        elif self.path == "/events" and self.headers.get("Sec-Fetch-Site", "none") not in ("none", "same-origin"):
            # Another site's page cannot read them, but could use all the connections.
            self._send(HTTPStatus.FORBIDDEN, b"these events are for this page only\n")
        elif self.path == "/events":
            self._send_events()
        elif self.path in self.files:
            self._send(HTTPStatus.OK, *self.files[self.path])
        else:
            self._send(HTTPStatus.NOT_FOUND, b"the page is /\n")

    def _send(self, status: HTTPStatus, body: bytes, kind: str = "text/plain") -> None:
        self.send_response(status)
        for name, value in (_HEADERS | {"Content-Type": f"{kind}; charset=utf-8"}).items():
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(body)

    def _send_events(self) -> None:
        self._send(HTTPStatus.OK, b"retry: 1000\n\n", "text/event-stream")
        sent, quiet = -1, 0
        while not self.view.closed.wait(EVERY if sent >= 0 else 0):
            quiet += 1
            if self.view.version != sent:
                (sent, state), quiet = self.view.state(), 0
                self.wfile.write(b"data: " + state + b"\n\n")
            elif quiet >= QUIET:
                self.wfile.write(b":\n\n")
                quiet = 0

    def log_message(self, format: str, *args: Any) -> None:
        """Nothing: whoever looks on is no event of the reading."""

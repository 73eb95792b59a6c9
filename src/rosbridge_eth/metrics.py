"""What the processes count, as Prometheus has it, and the HTTP server of /metrics, /healthz and /readyz.

The server's processes share their counts by prometheus_client's multiprocess mode: files in a folder that the
environment names before this module is first imported (supervisor.py). The table of docs/operations.md is
`reference`. The server is healthy while its processes beat, and ready when every condition holds, too.
"""

from __future__ import annotations

import json
import os
import socket
import threading
import time
from collections.abc import Collection, Mapping
from http import HTTPStatus
from typing import Any, Final
from wsgiref.simple_server import WSGIRequestHandler, make_server

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram
from prometheus_client.exposition import CONTENT_TYPE_LATEST, ThreadingWSGIServer, generate_latest
from prometheus_client.multiprocess import MultiProcessCollector

from rosbridge_eth.errors import NetworkError

SILENCE: Final = 15.0  # seconds without a beat after which a process counts as hanging
BEAT_EVERY: Final = 1.0
DEADLINE: Final = 10.0  # seconds for a client to send its request and take the answer
LATENCIES: Final = (0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 30.0, 60.0, 300.0, 1800.0)
"""Upper bounds in seconds: from a local chain's block to a node that was away for half an hour."""

REGISTRY = CollectorRegistry()


def _counter(name: str, help: str, *labels: str) -> Counter:
    return Counter(f"rosbridge_eth_{name}", help, labels, registry=REGISTRY)


def _gauge(name: str, help: str, *labels: str) -> Gauge:
    return Gauge(f"rosbridge_eth_{name}", help, labels, registry=REGISTRY, multiprocess_mode="mostrecent")


CHANNEL = _gauge("channel", "Counts of the channel since the process began, by what was counted.", "process", "count")
DROPPED = _gauge("datagrams_dropped", "Datagrams dropped without an answer, by reason.", "process", "reason")
CHUNKS = _gauge("chunks", "Chunks that arrived, by what became of them.", "process", "outcome")
RECORDS_STORED = _counter("records_stored", "Records stored by the server.", "robot")
WAITING = _gauge("waiting_chunks", "Chunks in the inbox that are not confirmed on the chain.", "robot")
WAITING_BYTES = _gauge("waiting_bytes", "Their bytes.", "robot")
OLDEST = _gauge("waiting_seconds", "Age of the oldest of them.", "robot")
BALANCE = _gauge("balance_eth", "Balance of the robot's account, and of the operator's.", "robot")
HELD = _gauge("on_hold", "1 while nothing is written for the robot; `status` says why.", "robot")
WRITTEN = _counter("records_written", "Records seen confirmed on the chain.", "robot")
GAS = _counter("gas_used", "Gas of the transactions seen in blocks.", "robot")
LATENCY = Histogram(
    "rosbridge_eth_confirm_seconds", "From the inbox's commit to the confirmation on the chain.", registry=REGISTRY,
    buckets=LATENCIES,
)  # fmt: skip
HEAD = _gauge("head_block", "Number of the node's latest block.")
HEAD_AGE = _gauge("head_age_seconds", "Age of that block by its own timestamp.")
DISK_FREE = _gauge("disk_free_bytes", "Bytes free where the store is.")
RESTARTS = _counter("process_restarts", "How often a process was started again.", "process")
BEAT = _gauge("beat_seconds", "When the process last took a turn, seconds since 1970.", "process")
CONDITION = _gauge("condition", "1 while the condition holds; /readyz lists them.", "name")

CAPTURED = _counter("captured", "Records captured by this robot.")
LOST = _gauge("lost", "Messages that were not captured, by topic and why; the log says so, too.", "topic", "why")
SPOOL_CHUNKS = _gauge("spool_chunks", "Chunks in the spool: all, not stored by the server, set aside.", "state")
SPOOL_BYTES = _gauge("spool_bytes", "Bytes in the spool.")
CONNECTED = _gauge("connected", "1 while a session with the server stands.")


def collected() -> CollectorRegistry:
    """The registry to show: of all processes where they share a folder, else of this one."""
    if "PROMETHEUS_MULTIPROC_DIR" not in os.environ:
        return REGISTRY
    registry = CollectorRegistry()
    MultiProcessCollector(registry)  # type: ignore[no-untyped-call]
    return registry


def beat(process: str, wall: float) -> None:
    BEAT.labels(process).set(wall)


def conditions(registry: CollectorRegistry, expected: Collection[str], wall: float) -> Mapping[str, bool]:
    """Of each expected process whether it beats, and of each condition whether it holds."""
    found = {f"{process} runs": False for process in expected}
    for family in registry.collect():
        for sample in family.samples:
            if sample.name == "rosbridge_eth_beat_seconds" and sample.labels["process"] in expected:
                found[f"{sample.labels['process']} runs"] = wall - sample.value <= SILENCE
            elif sample.name == "rosbridge_eth_condition":
                found[sample.labels["name"]] = sample.value == 1
    return found


class _Handler(WSGIRequestHandler):
    timeout = DEADLINE

    def log_message(self, format: str, *arguments: Any) -> None:
        """Nothing: what a client asked for is its own words."""


class _Server(ThreadingWSGIServer):
    """Threads without number are not had: a connection that is not done after DEADLINE is shut."""

    def server_bind(self) -> None:
        self._open: dict[socket.socket, float] = {}
        super().server_bind()

    def process_request(self, request: Any, client_address: Any) -> None:
        self._open[request] = time.monotonic() + DEADLINE
        super().process_request(request, client_address)

    def shutdown_request(self, request: Any) -> None:
        self._open.pop(request, None)
        super().shutdown_request(request)

    def service_actions(self) -> None:
        now = time.monotonic()
        for request, deadline in list(self._open.items()):
            if now > deadline:
                self._open.pop(request, None)
                try:
                    request.shutdown(socket.SHUT_RDWR)
                except OSError:
                    continue  # the client has gone by itself

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Nothing: a client went away."""


class Web:
    """Serves from threads of its own between `start` and `stop`. NetworkError if the port cannot be had.

    Meant for the machine itself or a private network: whoever reaches the port reads names, balances and counts.
    """

    def __init__(self, address: tuple[str, int], expected: Collection[str]) -> None:
        self._expected = expected
        server = type("_Server6", (_Server,), {"address_family": socket.AF_INET6}) if ":" in address[0] else _Server
        try:
            self._http = make_server(address[0], address[1], self._answer, server, _Handler)
        except OSError as error:
            raise NetworkError(
                f"TCP port {address[1]} of {address[0]} cannot be opened: {error.strerror}; correct `monitor`"
            ) from error
        self._thread = threading.Thread(target=self._http.serve_forever, args=(0.2,), name="web", daemon=True)

    @property
    def address(self) -> tuple[str, int]:
        host, port = self._http.server_address[:2]
        return str(host), int(port)

    def start(self) -> None:
        self._thread.start()

    def stop(self) -> None:
        self._http.shutdown()
        self._http.server_close()

    def _answer(self, environ: Mapping[str, Any], start_response: Any) -> list[bytes]:
        path, registry = environ["PATH_INFO"], collected()
        status, body, kind = HTTPStatus.OK, b"", "application/json"
        if path == "/metrics":
            body, kind = generate_latest(registry), CONTENT_TYPE_LATEST
        elif path in ("/healthz", "/readyz"):
            found = conditions(registry, self._expected, time.time())
            if path == "/healthz":
                found = {name: holds for name, holds in found.items() if name.endswith(" runs")}
            status = HTTPStatus.OK if all(found.values()) else HTTPStatus.SERVICE_UNAVAILABLE
            body = json.dumps({"ok": all(found.values()), "conditions": found}, indent=1).encode() + b"\n"
        else:
            status, body, kind = HTTPStatus.NOT_FOUND, b"/metrics /healthz /readyz\n", "text/plain"
        headers = [("Content-Type", kind), ("Content-Length", str(len(body))), ("Cache-Control", "no-store")]
        start_response(f"{status.value} {status.phrase}", headers)
        return [body]


def reference() -> str:
    """The table of docs/operations.md, which a test compares."""
    lines = ["| metric | kind | labels | |", "| --- | --- | --- | --- |"]
    for family in REGISTRY.collect():
        metric = family.name + ("_total" if family.type == "counter" else "")
        lines.append(f"| `{metric}` | {family.type} | {_labels(family.name)} | {family.documentation} |")
    return "\n".join(lines) + "\n"


def _labels(name: str) -> str:
    metric = REGISTRY._names_to_collectors[name]
    return ", ".join(f"`{label}`" for label in metric._labelnames)  # type: ignore[attr-defined]

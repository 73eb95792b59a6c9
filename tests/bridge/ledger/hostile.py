"""A node that does what it likes: a TCP server whose answers a test gives."""

from __future__ import annotations

import json
import socket
import threading
from collections.abc import Callable
from typing import Any

Answer = Callable[[socket.socket, list[dict[str, Any]]], None]


class HostileNode:
    """answer: is given the connection and the requests of one HTTP request, and says what it wants."""

    def __init__(self, answer: Answer) -> None:
        self._answer = answer
        self._server = socket.create_server(("127.0.0.1", 0))
        self.url = f"http://127.0.0.1:{self._server.getsockname()[1]}"
        self.asked: list[str] = []
        self.over = threading.Event()
        threading.Thread(target=self._serve, daemon=True).start()

    def __enter__(self) -> HostileNode:
        return self

    def __exit__(self, *_: object) -> None:
        self.over.set()
        self._server.close()

    def _serve(self) -> None:
        while True:
            try:
                connection, _ = self._server.accept()
            except OSError:
                return
            threading.Thread(target=self._talk, args=(connection,), daemon=True).start()

    def _talk(self, connection: socket.socket) -> None:
        with connection, connection.makefile("rb") as stream:
            try:
                while stream.readline():
                    length = 0
                    while (line := stream.readline().strip()):
                        name, _, value = line.partition(b":")
                        if name.lower() == b"content-length":
                            length = int(value)
                    body = json.loads(stream.read(length))
                    requests = body if isinstance(body, list) else [body]
                    self.asked += [request["method"] for request in requests]
                    self._answer(connection, body)
            except (OSError, ValueError):
                pass


def http(body: bytes, status: str = "200 OK", headers: str = "") -> bytes:
    head = f"HTTP/1.1 {status}\r\nContent-Type: application/json\r\nContent-Length: {len(body)}\r\n{headers}\r\n"
    return head.encode() + body


def says(**results: Any) -> Answer:
    """Answers by method; an Exception's text is an error of JSON-RPC; bytes are sent as they are."""

    def one(request: dict[str, Any]) -> dict[str, Any]:
        result = results.get(request["method"])
        given = {"error": {"code": -32000, "message": str(result)}} if isinstance(result, Exception) else {
            "result": result}  # fmt: skip
        return {"jsonrpc": "2.0", "id": request["id"]} | given

    def answer(connection: socket.socket, body: Any) -> None:
        raw = next((r for request in ([body] if isinstance(body, dict) else body)
                    if isinstance(r := results.get(request["method"]), bytes)), None)  # fmt: skip
        found = [one(request) for request in body] if isinstance(body, list) else one(body)
        connection.sendall(raw or http(json.dumps(found).encode()))

    return answer

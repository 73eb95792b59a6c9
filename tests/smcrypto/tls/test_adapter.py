"""`requests` with SMAdapter: against Python's http.server over our own sockets, and against Tongsuo."""

from __future__ import annotations

import re
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest
import requests

from smcrypto.errors import InvalidOption
from smcrypto.tls import SUITES, TLSError
from smcrypto.tls.adapter import SMAdapter
from tls_authority import HOST, Authority

SUITE = "ECDHE_SM4_GCM_SM3"
TIMEOUT = 20.0  # seconds; only a failure waits for so long


@pytest.fixture(scope="module")
def authority() -> Authority:
    return Authority.make()


@pytest.fixture(autouse=True)
def _resolved(monkeypatch: pytest.MonkeyPatch) -> None:
    """The name of the certificate leads here."""
    from urllib3.util import connection

    create = connection.create_connection

    def to_this_machine(address: tuple[str, int], *rest: Any, **options: Any) -> Any:
        return create(("127.0.0.1", address[1]), *rest, **options)

    monkeypatch.setattr(connection, "create_connection", to_this_machine)


class Answers(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"

    def do_GET(self) -> None:
        self.do_POST()

    def do_POST(self) -> None:
        body = self.rfile.read(int(self.headers.get("Content-Length", 0)))
        answer = f"{self.command} {self.path} from {self.client_address[1]}: ".encode() + body
        self.send_response(200)
        if self.path == "/cut":
            self.end_headers()
            self.wfile.write(b"half of")
            self.connection.context = None  # type: ignore[attr-defined]
            self.connection._completed = None  # type: ignore[attr-defined]  # so that no close_notify is sent
            self.close_connection = True
            return
        self.send_header("Content-Length", str(len(answer)))
        self.end_headers()
        self.wfile.write(answer)

    def log_message(self, *_: Any) -> None:
        pass


class Server(ThreadingHTTPServer):
    daemon_threads = True

    def handle_error(self, request: Any, client_address: Any) -> None:
        pass


@contextmanager
def serving(context: Any) -> Iterator[str]:
    with Server(("127.0.0.1", 0), Answers) as server:
        server.socket = context.wrap_socket(server.socket, server_side=True)
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.05})
        thread.start()
        try:
            yield f"https://{HOST}:{server.server_address[1]}"
        finally:
            server.shutdown()
            thread.join()


def session(authority: Authority, suite: str = SUITE) -> requests.Session:
    made = requests.Session()
    made.trust_env = False
    made.mount("https://", SMAdapter(authority.context(suite, authority.client)))
    return made


@pytest.mark.parametrize("suite", [SUITE, "TLS_SM4_GCM_SM3"])
def test_requests_go_over_one_connection(authority: Authority, suite: str) -> None:
    assert suite in SUITES
    serve = serving(authority.context(suite, authority.server, verify_client="required"))
    with serve as address, session(authority, suite) as client:
        first = client.get(f"{address}/a", timeout=TIMEOUT)
        assert first.text.startswith("GET /a from ")
        data = bytes(range(256)) * 400
        second = client.post(f"{address}/b", data=data, timeout=TIMEOUT)
        assert second.content.endswith(data)
        port = first.text.split()[-1].rstrip(":")
        assert second.content.startswith(f"POST /b from {port}: ".encode())


def test_a_server_that_is_not_trusted(authority: Authority) -> None:
    with serving(authority.context(SUITE, authority.server)) as address:
        with session(Authority.make()) as client, pytest.raises(requests.exceptions.SSLError, match="issuer"):
            client.get(address, timeout=TIMEOUT)
        with session(authority) as client:
            with pytest.raises(requests.exceptions.SSLError, match="example"):
                client.get(address.replace(HOST, "another.example"), timeout=TIMEOUT, verify=False)
            assert client.get(address, timeout=TIMEOUT).ok  # the server goes on


def test_an_answer_that_is_cut_is_an_error(authority: Authority) -> None:
    serve = serving(authority.context(SUITE, authority.server))
    with serve as address, session(authority) as client, pytest.raises(TLSError, match="close_notify"):
        client.get(f"{address}/cut", timeout=TIMEOUT)


def test_a_proxy_is_refused_and_http_is_left_alone(authority: Authority) -> None:
    with session(authority) as client:
        with pytest.raises(InvalidOption, match="proxy"):
            client.get("https://server.example", proxies={"https": "http://127.0.0.1:9"}, timeout=TIMEOUT)
        client.mount("http://", SMAdapter(authority.context(SUITE)))
        with Server(("127.0.0.1", 0), Answers) as server:
            thread = threading.Thread(target=server.handle_request)
            thread.start()
            assert client.get(f"http://{HOST}:{server.server_address[1]}/plain", timeout=TIMEOUT,
                              headers={"Connection": "close"}).ok  # fmt: skip
            thread.join(TIMEOUT)


@pytest.mark.parametrize("page", ["howto-tls.md", "zh/howto-tls.md"])
def test_the_examples_of_the_page(
    authority: Authority, page: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("root.pem").write_bytes(bytes(authority.root.certificate.to_pem()))
    look_up = socket.getaddrinfo

    def to_this_machine(host: str, *rest: Any, **options: Any) -> Any:
        return look_up("127.0.0.1" if host == HOST else host, *rest, **options)

    monkeypatch.setattr(socket, "getaddrinfo", to_this_machine)
    text = (Path(__file__).parents[3] / "docs" / page).read_text("utf-8")
    blocks = re.findall(r"^```python\n(.*?)^```$", text, re.S | re.M)
    assert len(blocks) == 3
    names: dict[str, Any] = {}
    with serving(authority.context("ECC_SM4_GCM_SM3", authority.server)) as address:
        for block in blocks:
            exec(block.replace("443", address.rpartition(":")[2]), names)
    printed = capsys.readouterr().out
    assert "ECC_SM4_GCM_SM3" in printed
    assert len(re.findall(r"\b200\b", printed)) == 3  # as a word: a port may hold these digits, too

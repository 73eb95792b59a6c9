"""A node by JSON-RPC that answers as nodes should not: each wrong answer has its class, none a traceback."""

from __future__ import annotations

import http.server
import json
import threading
from collections.abc import Callable, Iterator

import pytest

from rosbridge_eth.errors import ChainError
from rosbridge_eth.ledger import failures
from rosbridge_eth.ledger.chain import Call
from rosbridge_eth.ledger.jsonrpc import JsonRpcChain

HASH, ADDRESS = "0x" + "ab" * 32, "0x" + "11" * 20
BLOCK = {
    "number": "0x10",
    "hash": HASH,
    "parentHash": HASH,
    "timestamp": "0x5",
    "gasLimit": "0x1c9c380",
    "baseFeePerGas": "0x7",
    "extraData": "0x" + "00" * 97,  # Clique's: web3 by itself would refuse the block
}


class Script:
    """A transport that answers by a function of the request."""

    def __init__(self, answer: Callable[[dict], object]) -> None:
        self.answer = answer
        self.asked: list = []

    def exchange(self, body: bytes) -> bytes:
        request = json.loads(body)
        self.asked.append(request)
        if isinstance(request, list):
            answer: object = [{"jsonrpc": "2.0", "id": r["id"]} | self.answer(r) for r in request]  # type: ignore[operator]
        else:
            answer = self.answer(request)
            if isinstance(answer, bytes):
                return answer
            if isinstance(answer, dict):
                answer = {"jsonrpc": "2.0", "id": request["id"]} | answer
        return json.dumps(answer).encode()

    def close(self) -> None:
        pass


def chain(answer: Callable[[dict], object], **options) -> JsonRpcChain:
    return JsonRpcChain("http://node:8545", transport=Script(answer), **options)


def test_a_block_with_cliques_extra_data_is_read():
    head = chain(lambda request: {"result": BLOCK}).head()
    assert (head.number, head.hash.hex(), head.timestamp, head.base_fee) == (16, "ab" * 32, 5, 7)


def test_a_block_from_before_london_has_no_base_fee():
    old = {key: value for key, value in BLOCK.items() if key != "baseFeePerGas"}
    assert chain(lambda request: {"result": old}).head().base_fee is None


@pytest.mark.parametrize(
    ("answer", "kind"),
    [
        (b"<html>gateway</html>", failures.Garbled),
        (b"", failures.Garbled),
        (b"[1]", failures.Garbled),
        ({}, failures.Garbled),
        ({"id": 99999, "result": "0x1"}, failures.Garbled),
        ({"result": None}, failures.Garbled),
        ({"result": "1"}, failures.Garbled),
        ({"result": "0xzz"}, failures.Garbled),
        ({"result": 5}, failures.Garbled),
        ({"result": "0x" + "1" * 70}, failures.Garbled),
        ({"error": "words only"}, failures.Refused),
        ({"error": {"code": -32005, "message": "limit exceeded"}}, failures.RateLimited),
        ({"error": {"code": -32000}}, failures.Refused),
        ({"error": {"code": "x", "message": None}}, failures.Refused),
    ],
)
def test_an_answer_that_is_none_is_named_for_what_it_is(answer: object, kind: type[failures.NodeFailure]):
    with pytest.raises(kind, match="http://node:8545") as failure:
        chain(lambda request: answer).chain_id()
    assert type(failure.value) is kind


@pytest.mark.parametrize("field", ["number", "hash", "parentHash", "timestamp", "gasLimit"])
@pytest.mark.parametrize("value", [None, "0x", "nonsense", 7, "0xabg", []])
def test_a_block_with_a_wrong_field_is_garbled(field: str, value: object):
    with pytest.raises(failures.Garbled):
        chain(lambda request: {"result": BLOCK | {field: value}}).head()


def test_receipts_and_logs_of_a_wrong_form_are_garbled():
    receipt = {
        "transactionHash": HASH,
        "blockNumber": "0x1",
        "blockHash": HASH,
        "status": "0x1",
        "gasUsed": "0x5208",
        "effectiveGasPrice": "0x1",
        "from": ADDRESS,
        "logs": [],
        "contractAddress": None,
    }
    (good,) = chain(lambda request: {"result": receipt}).receipts([bytes.fromhex(HASH[2:])])
    assert good is not None
    assert good.succeeded
    assert good.gas_used == 21000
    for field in receipt:
        if field in ("contractAddress", "effectiveGasPrice", "blockHash"):
            continue
        with pytest.raises(failures.Garbled):
            chain(lambda request, f=field: {"result": receipt | {f: "?"}}).receipts([bytes(32)])
    waiting = receipt | {"blockHash": None}
    assert chain(lambda request: {"result": waiting}).receipts([bytes(32)]) == [None]
    for logs in ({"result": {}}, {"result": [5]}, {"result": [{"address": "0x1"}]}, {"result": [{"topics": 1}]}):
        with pytest.raises(failures.Garbled):
            chain(lambda request, a=logs: a).logs(ADDRESS, [None], 0, 1)


def test_transactions_go_in_one_batch_and_each_has_its_own_answer():
    def answer(request):
        raw = request["params"][0]
        if raw == "0x02":
            return {"error": {"code": -32000, "message": "already known"}}
        return {"result": "0x" + raw[2:].rjust(64, "0")} if raw != "0x03" else {"result": "garbage"}

    node = chain(answer)
    first, second, third = node.send([b"\1", b"\2", b"\3"])
    assert first == bytes(31) + b"\1"
    assert isinstance(second, failures.AlreadyKnown)
    assert isinstance(third, failures.Garbled)
    assert [len(request) for request in node._transport.asked] == [3]


def test_a_node_that_takes_no_batches_gets_them_one_by_one():
    class NoBatches(Script):
        def exchange(self, body: bytes) -> bytes:
            if body.startswith(b"["):
                return b'{"jsonrpc": "2.0", "id": null, "error": {"code": -32600, "message": "no batches"}}'
            return super().exchange(body)

    script = NoBatches(lambda request: {"result": HASH})
    assert JsonRpcChain("http://node", transport=script).send([b"a", b"b"]) == [bytes.fromhex("ab" * 32)] * 2


def test_reading_is_tried_again_and_sending_is_not():
    pauses: list[float] = []
    refusals = [failures.Unreachable("x"), failures.RateLimited("x", 3.0)]

    def answer(request):
        if refusals:
            raise refusals.pop(0)
        return {"result": "0x7"}

    node = chain(answer, attempts=3, sleep=pauses.append)
    assert node.chain_id() == 7
    assert pauses == [0.1, 3.0]
    refusals[:] = [failures.Unreachable("x")]
    (sent,) = node.send([b"a"])
    assert isinstance(sent, failures.Unreachable)
    assert len(pauses) == 2


def test_the_tip_comes_from_the_gas_price_where_a_node_knows_no_tips():
    answers = {
        "eth_maxPriorityFeePerGas": {"error": {"code": -32601, "message": "method not found"}},
        "eth_gasPrice": {"result": hex(5_000_000_007)},
        "eth_getBlockByNumber": {"result": BLOCK},
    }
    assert chain(lambda request: answers[request["method"]]).priority_fee() == 5_000_000_000


def test_a_url_is_shown_without_what_may_be_secret():
    node = JsonRpcChain("https://user:pass@node.example:9/v3/secretkey?token=x", transport=Script(lambda r: b""))
    assert node.url == "https://node.example:9"
    with pytest.raises(failures.Garbled) as failure:
        node.chain_id()
    assert "secretkey" not in str(failure.value)
    for url in ("ftp://node", "node:8545", "http://", ""):
        with pytest.raises(ChainError, match="URL"):
            JsonRpcChain(url)


# ---------------------------------------------------------------------- over a real socket


@pytest.fixture
def server() -> Iterator[tuple[str, dict]]:
    script: dict = {"status": 200, "body": b"{}", "headers": {}, "hang": None}

    class Handler(http.server.BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            self.rfile.read(int(self.headers["Content-Length"]))
            if script["hang"] is not None:
                script["hang"].wait(5)
                return
            self.send_response(script["status"])
            for name, value in script["headers"].items():
                self.send_header(name, value)
            self.send_header("Content-Length", str(len(script["body"])))
            self.end_headers()
            self.wfile.write(script["body"])

        def log_message(self, *arguments: object) -> None:
            pass

    httpd = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    threading.Thread(target=httpd.serve_forever, daemon=True).start()
    yield f"http://127.0.0.1:{httpd.server_port}", script
    httpd.shutdown()
    httpd.server_close()


@pytest.mark.parametrize(
    ("status", "body", "kind"),
    [
        (429, b"", failures.RateLimited),
        (413, b"", failures.TooLarge),
        (403, b"no", failures.Refused),
        (502, b"<html>", failures.Unreachable),
        (404, b"<html>", failures.Garbled),
        (200, b"<html>", failures.Garbled),
        (400, b'{"error": {"code": -32000, "message": "nonce too low"}}', failures.NonceTooLow),
        (500, b'{"error": {"code": -32000, "message": "already known"}}', failures.AlreadyKnown),
    ],
)
def test_http_status_and_body_give_the_class(server, status: int, body: bytes, kind: type[failures.NodeFailure]):
    url, script = server
    script |= {"status": status, "body": body, "headers": {"Retry-After": "7"}}
    with pytest.raises(kind) as failure:
        JsonRpcChain(url).call(Call(ADDRESS, b""))
    if isinstance(failure.value, failures.RateLimited):
        assert failure.value.retry_after == 7


def test_a_node_that_hangs_or_is_not_there_is_unreachable(server):
    url, script = server
    script["hang"] = threading.Event()
    with pytest.raises(failures.Unreachable, match="no answer within"):
        JsonRpcChain(url, timeout=0.2).chain_id()
    script["hang"].set()
    with pytest.raises(failures.Unreachable, match="no connection"):
        JsonRpcChain("http://127.0.0.1:9", timeout=1).chain_id()
    with pytest.raises(failures.Unreachable):
        JsonRpcChain("ws://127.0.0.1:9", timeout=1).chain_id()

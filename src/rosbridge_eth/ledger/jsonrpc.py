"""A node by JSON-RPC, over HTTP or WebSocket.

Only the fields the ledger needs are read, each checked for its form: an answer
that is not one is Garbled, never a KeyError far away. Since extraData is not
among them, networks with proof of authority (Clique signs in there) need no
special treatment. Blocks without a base fee (before London) get legacy
transactions, see transactions.Fees.

Several transactions go to the node in one batch request; a node that refuses
batches gets them one by one.
"""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from itertools import count
from typing import Any, Protocol, TypeVar
from urllib.parse import urlsplit

from rosbridge_eth.errors import ChainError
from rosbridge_eth.ledger.chain import Block, Call, Log, Receipt
from rosbridge_eth.ledger.failures import (
    Garbled,
    NodeFailure,
    RateLimited,
    Refused,
    TooLarge,
    Unreachable,
    Unsupported,
    classify,
)

T = TypeVar("T")
MAX_BATCH = 50  # requests in one batch; providers commonly allow 100
CLOSE_SECONDS = 1.0  # for a node to say goodbye
MAX_PAUSE = 5.0  # seconds between attempts at most
FALLBACK_PRIORITY_FEE = 1_000_000_000


class Transport(Protocol):
    """Carries one JSON text to the node and its answer back; NodeFailure if that fails."""

    def exchange(self, body: bytes) -> bytes: ...

    def close(self) -> None: ...


class HttpTransport:
    """One keep-alive connection per thread."""

    def __init__(self, url: str, timeout: float) -> None:
        self._url = url
        self._timeout = timeout
        self._local = threading.local()

    def exchange(self, body: bytes) -> bytes:
        import requests

        session = getattr(self._local, "session", None)
        if session is None:
            session = self._local.session = requests.Session()
            session.headers["Content-Type"] = "application/json"
        try:
            answer = session.post(self._url, data=body, timeout=self._timeout)
            content = bytes(answer.content)
        except requests.Timeout as error:
            raise Unreachable(f"no answer within {self._timeout:g} s") from error
        except requests.RequestException as error:
            raise Unreachable(f"no connection ({type(error).__name__})") from error
        status = answer.status_code
        if status == 429:
            wait = answer.headers.get("Retry-After", "")
            raise RateLimited("HTTP 429, too many requests", float(wait) if wait.isdigit() else None)
        if status == 413:
            raise TooLarge("HTTP 413, request entity too large")
        if status >= 400 and content.lstrip()[:1] not in (b"{", b"["):
            if status in (401, 403):
                raise Refused(f"HTTP {status}, the node denies access")
            raise (Unreachable if status >= 500 else Garbled)(f"HTTP {status}")
        return content

    def close(self) -> None:
        session = getattr(self._local, "session", None)
        if session is not None:
            session.close()


class WebSocketTransport:
    """One connection, opened when needed; requests follow one another."""

    def __init__(self, url: str, timeout: float) -> None:
        self._url = url
        self._timeout = timeout
        self._lock = threading.Lock()
        self._socket: Any = None
        self._open = ExitStack()

    def exchange(self, body: bytes) -> bytes:
        from websockets.exceptions import WebSocketException
        from websockets.sync.client import connect

        with self._lock:
            try:
                if self._socket is None:
                    connection = connect(
                        self._url, open_timeout=self._timeout, close_timeout=CLOSE_SECONDS, max_size=None
                    )
                    self._socket = self._open.enter_context(connection)
                self._socket.send(body.decode())
                answer = self._socket.recv(timeout=self._timeout)
            except TimeoutError as error:
                self._reset()
                raise Unreachable(f"no answer within {self._timeout:g} s") from error
            except (OSError, WebSocketException) as error:
                self._reset()
                raise Unreachable(f"no connection ({type(error).__name__})") from error
            return answer.encode() if isinstance(answer, str) else bytes(answer)

    def _reset(self) -> None:
        """After a failure the next answer on this connection could be that of an old request."""
        self._socket = None
        self._open.close()

    def close(self) -> None:
        with self._lock:
            self._reset()


class JsonRpcChain:
    """A Chain behind a URL.

    timeout: seconds for one request. attempts: how often a reading request is tried
    before a transient failure is reported; sending is never repeated by itself.
    """

    def __init__(
        self,
        url: str,
        *,
        timeout: float = 10.0,
        attempts: int = 1,
        transport: Transport | None = None,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        parts = urlsplit(url)
        if parts.scheme not in ("http", "https", "ws", "wss") or not parts.hostname:
            raise ChainError(f"{parts.scheme}://… is not the URL of a node; http, https, ws and wss are known")
        port = f":{parts.port}" if parts.port else ""
        self._shown = f"{parts.scheme}://{parts.hostname}{port}"
        kind = HttpTransport if parts.scheme.startswith("http") else WebSocketTransport
        self._transport: Transport = transport or kind(url, timeout)
        self._attempts = attempts
        self._sleep = sleep
        self._ids = count(1)

    @property
    def url(self) -> str:
        return self._shown

    def close(self) -> None:
        self._transport.close()

    # ------------------------------------------------------------------ JSON-RPC

    def request(self, method: str, *params: object) -> Any:
        """The result of one call; NodeFailure otherwise. Tried `attempts` times where it failed in passing."""
        pause = 0.1
        for attempt in range(1, self._attempts + 1):
            try:
                return self._once(method, params)
            except NodeFailure as failure:
                if not failure.transient or attempt == self._attempts:
                    raise
                wait = failure.retry_after if isinstance(failure, RateLimited) else None
                self._sleep(min(wait or pause, MAX_PAUSE))
                pause *= 2
        raise ValueError("attempts must be at least 1")

    def _once(self, method: str, params: Sequence[object]) -> Any:
        id = next(self._ids)
        answer = self._exchange({"jsonrpc": "2.0", "id": id, "method": method, "params": list(params)})
        if not isinstance(answer, dict) or answer.get("id", id) not in (id, None):
            raise self._named(Garbled(f"{method}: not an answer to the request"))
        return self._result(method, answer)

    def _exchange(self, body: object) -> Any:
        try:
            return json.loads(self._transport.exchange(json.dumps(body).encode()))
        except NodeFailure as failure:
            raise self._named(failure) from failure
        except ValueError as error:
            raise self._named(Garbled("the answer is not JSON")) from error

    def _result(self, method: str, answer: dict[str, Any]) -> Any:
        error = answer.get("error")
        if error is not None:
            if not isinstance(error, dict):
                raise self._named(classify(str(error)))
            code = error.get("code")
            words, code = str(error.get("message", "")), code if isinstance(code, int) else None
            raise self._named(classify(words, code, error.get("data")))
        if "result" not in answer:
            raise self._named(Garbled(f"{method}: neither result nor error"))
        return answer["result"]

    def _named(self, failure: NodeFailure) -> NodeFailure:
        """Say which node. The class and what it carries stay."""
        text = str(failure)
        if not text.startswith(self._shown):
            failure.args = (f"{self._shown}: {text}",)
        return failure

    def _many(self, method: str, params: Sequence[Sequence[object]]) -> list[Any]:
        """Results or NodeFailures, in order; one HTTP request for MAX_BATCH of them."""
        results: list[Any] = []
        for start in range(0, len(params), MAX_BATCH):
            results += self._batch(method, params[start : start + MAX_BATCH])
        return results

    def _batch(self, method: str, params: Sequence[Sequence[object]]) -> list[Any]:
        ids = [next(self._ids) for _ in params]
        if len(params) > 1:
            body = [
                {"jsonrpc": "2.0", "id": id, "method": method, "params": list(p)}
                for id, p in zip(ids, params, strict=True)
            ]
            answer = self._exchange(body)
            if isinstance(answer, list):
                by_id = {a.get("id"): a for a in answer if isinstance(a, dict)}
                return [
                    self._settled(method, by_id[id]) if id in by_id else self._named(Garbled(f"{method}: no answer"))
                    for id in ids
                ]
        # A single request, or a node that does not take batches.
        return [self._attempt(method, p) for p in params]

    def _attempt(self, method: str, params: Sequence[object]) -> Any:
        try:
            return self._once(method, params)
        except NodeFailure as failure:
            return failure

    def _settled(self, method: str, answer: dict[str, Any]) -> Any:
        try:
            return self._result(method, answer)
        except NodeFailure as failure:
            return failure

    # ------------------------------------------------------------------ Chain

    def _read(self, read: Callable[[Any, str], T], method: str, *params: object) -> T:
        """The result of one call in the form that `read` expects."""
        try:
            return read(self.request(method, *params), method)
        except Garbled as failure:
            raise self._named(failure) from failure

    def chain_id(self) -> int:
        return self._read(_quantity, "eth_chainId")

    def head(self) -> Block:
        block = self._read(_block, "eth_getBlockByNumber", "latest", False)
        if block is None:
            raise self._named(Garbled("eth_getBlockByNumber: there is no latest block"))
        return block

    def block(self, number: int) -> Block | None:
        return self._read(_block, "eth_getBlockByNumber", hex(number), False)

    def code(self, address: str) -> bytes:
        return self._read(_data, "eth_getCode", address, "latest")

    def balance(self, address: str) -> int:
        return self._read(_quantity, "eth_getBalance", address, "latest")

    def nonce(self, address: str, block: int | None = None) -> int:
        return self._read(_quantity, "eth_getTransactionCount", address, _tag(block))

    def priority_fee(self) -> int:
        try:
            return self._read(_quantity, "eth_maxPriorityFeePerGas")
        except (Unsupported, Refused):
            pass  # an older node; its gas price is base fee and tip together
        price = self._read(_quantity, "eth_gasPrice")
        base_fee = self.head().base_fee
        return price if base_fee is None else max(price - base_fee, FALLBACK_PRIORITY_FEE)

    def call(self, call: Call, block: int | None = None) -> bytes:
        return self._read(_data, "eth_call", _call(call), _tag(block))

    def estimate_gas(self, call: Call) -> int:
        return self._read(_quantity, "eth_estimateGas", _call(call))

    def send(self, raws: Sequence[bytes]) -> list[bytes | NodeFailure]:
        answers = self._many("eth_sendRawTransaction", [["0x" + raw.hex()] for raw in raws])
        return [self._hash(answer, "eth_sendRawTransaction") for answer in answers]

    def _hash(self, answer: Any, method: str) -> bytes | NodeFailure:
        if isinstance(answer, NodeFailure):
            return answer
        try:
            return _data(answer, method, 32)
        except Garbled as failure:
            return self._named(failure)

    def receipts(self, tx_hashes: Sequence[bytes]) -> list[Receipt | None]:
        found: list[Receipt | None] = []
        for answer in self._many("eth_getTransactionReceipt", [["0x" + hash.hex()] for hash in tx_hashes]):
            if isinstance(answer, NodeFailure):
                raise answer
            try:
                found.append(_receipt(answer))
            except Garbled as failure:
                raise self._named(failure) from failure
        return found

    def knows(self, tx_hash: bytes) -> bool:
        return self.request("eth_getTransactionByHash", "0x" + tx_hash.hex()) is not None

    def logs(self, address: str, topics: Sequence[bytes | None], from_block: int, to_block: int) -> list[Log]:
        wanted = [None if topic is None else "0x" + topic.hex() for topic in topics]
        where = {"address": address, "topics": wanted, "fromBlock": hex(from_block), "toBlock": hex(to_block)}
        return self._read(_logs, "eth_getLogs", where)


# ---------------------------------------------------------------------- reading what a node says


def _tag(block: int | None) -> str:
    return "latest" if block is None else hex(block)


def _call(call: Call) -> dict[str, str]:
    fields = {"data": "0x" + call.data.hex(), "value": hex(call.value)}
    if call.to is not None:
        fields["to"] = call.to
    if call.sender is not None:
        fields["from"] = call.sender
    return fields


def _quantity(value: object, where: str) -> int:
    if isinstance(value, str) and value.startswith("0x") and len(value) <= 66:
        try:
            return int(value, 16)
        except ValueError:
            pass  # reported below, with every other form that is not a quantity
    raise Garbled(f"{where}: not a quantity: {str(value)[:80]!r}")


def _data(value: object, where: str, size: int | None = None) -> bytes:
    if isinstance(value, str) and value.startswith("0x"):
        try:
            data = bytes.fromhex(value[2:])
        except ValueError:
            data = None
        if data is not None and size in (None, len(data)):
            return data
    raise Garbled(f"{where}: not {'' if size is None else f'{size} bytes of '}data: {str(value)[:80]!r}")


def _address(value: object, where: str) -> str:
    from eth_utils.address import to_checksum_address

    return str(to_checksum_address(_data(value, where, 20)))


def _fields(value: object, where: str) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise Garbled(f"{where}: not an object: {str(value)[:80]!r}")
    return value


def _block(value: object, where: str) -> Block | None:
    if value is None:
        return None
    fields = _fields(value, where)
    base_fee = fields.get("baseFeePerGas")
    return Block(
        _quantity(fields.get("number"), "block number"),
        _data(fields.get("hash"), "block hash", 32),
        _data(fields.get("parentHash"), "parent hash", 32),
        _quantity(fields.get("timestamp"), "block timestamp"),
        _quantity(fields.get("gasLimit"), "gas limit"),
        None if base_fee is None else _quantity(base_fee, "base fee"),
    )


def _log(value: object) -> Log:
    fields = _fields(value, "log")
    topics = fields.get("topics")
    if not isinstance(topics, list):
        raise Garbled("log: topics are not a list")
    return Log(
        _address(fields.get("address"), "log address"),
        tuple(_data(topic, "log topic", 32) for topic in topics),
        _data(fields.get("data"), "log data"),
        _quantity(fields.get("blockNumber"), "log block number"),
        _data(fields.get("blockHash"), "log block hash", 32),
        _data(fields.get("transactionHash"), "log transaction hash", 32),
        _quantity(fields.get("logIndex"), "log index"),
    )


def _logs(value: object, where: str) -> list[Log]:
    if not isinstance(value, list):
        raise Garbled(f"{where}: not a list")
    return [_log(item) for item in value if not (isinstance(item, dict) and item.get("removed"))]


def _receipt(value: object) -> Receipt | None:
    if value is None:
        return None
    fields = _fields(value, "receipt")
    if fields.get("blockHash") is None:
        return None  # some nodes answer so for a transaction that still waits
    logs = fields.get("logs")
    if not isinstance(logs, list):
        raise Garbled("receipt: logs are not a list")
    created = fields.get("contractAddress")
    return Receipt(
        _data(fields.get("transactionHash"), "receipt transaction hash", 32),
        _quantity(fields.get("blockNumber"), "receipt block number"),
        _data(fields.get("blockHash"), "receipt block hash", 32),
        _quantity(fields.get("status"), "receipt status") == 1,
        _quantity(fields.get("gasUsed"), "receipt gas used"),
        _quantity(fields.get("effectiveGasPrice", "0x0"), "receipt gas price"),
        _address(fields.get("from"), "receipt sender"),
        tuple(_log(log) for log in logs),
        None if created is None else _address(created, "receipt contract address"),
    )

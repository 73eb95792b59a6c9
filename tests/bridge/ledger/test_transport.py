"""A node may be slow, broken or hostile: what it says ends in a value or a ChainError, in bounded time and memory."""

from __future__ import annotations

import gzip
import json
import socket
import time
from contextlib import suppress
from itertools import pairwise
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bridge.ledger.hostile import HostileNode, http, says
from rosbridge_eth.errors import ChainError, ConfigError
from rosbridge_eth.ledger import Ledger
from rosbridge_eth.ledger.transport import (
    AlreadyKnown,
    ChainUnavailable,
    NonceTooLow,
    OutOfFunds,
    Reverted,
    TooMuch,
    Underpriced,
    classify,
    printable,
    shown,
)

CONTRACT = "0x5FbDB2315678afecb367f032d93F642f64180aa3"
TK = bytes(31) + b"\1"
HASH = "0x" + "11" * 32
BLOCK = {
    "number": "0x7", "timestamp": "0x65000000", "hash": HASH, "gasLimit": "0x1c9c380", "baseFeePerGas": "0x7",
    "extraData": "0x" + "00" * 97, "parentHash": HASH, "transactions": [],
}  # fmt: skip


def ledger(node: HostileNode, timeout: float = 5.0) -> Ledger:
    return Ledger(node.url, CONTRACT, timeout=timeout)


@pytest.mark.parametrize("through_a_proxy", [False, True])
def test_an_answer_that_comes_a_byte_now_and_then_is_given_up(through_a_proxy: bool, monkeypatch: pytest.MonkeyPatch):
    def drip(connection: socket.socket, body: Any) -> None:
        for byte in http(json.dumps({"jsonrpc": "2.0", "id": 0, "result": "0x1"}).encode()):
            if node.over.wait(0.1):
                return
            connection.sendall(bytes([byte]))

    def drip_body(connection: socket.socket, body: Any) -> None:
        connection.sendall(b"HTTP/1.1 200 OK\r\nContent-Length: 1000000\r\n\r\n")
        while not node.over.wait(0.1):
            connection.sendall(b" ")

    for answer in (drip, drip_body):
        with HostileNode(answer) as node:
            began, url = time.monotonic(), node.url
            if through_a_proxy:
                monkeypatch.setenv("http_proxy", node.url)
                url = "http://node.example"
            with pytest.raises(ChainUnavailable, match="too slow"):
                Ledger(url, CONTRACT, timeout=0.5).block_number()
            assert time.monotonic() - began < 10


def test_a_node_that_says_nothing_is_given_up():
    with HostileNode(lambda connection, body: node.over.wait(5) and None) as node, pytest.raises(ChainUnavailable):
        ledger(node, timeout=0.3).block_number()


@pytest.mark.parametrize("compressed", [False, True])
def test_a_giant_answer_is_not_read(compressed: bool):
    sent = []

    def giant(connection: socket.socket, body: Any) -> None:
        if compressed:
            bomb = gzip.compress(bytes(200 * 2**20), 9)
            connection.sendall(http(bomb, headers="Content-Encoding: gzip\r\n"))
            return
        connection.sendall(b"HTTP/1.1 200 OK\r\nContent-Length: 1800000000\r\n\r\n")
        for _ in range(1800):
            connection.sendall(b" " * 10**6)
            sent.append(10**6)

    with HostileNode(giant) as node, pytest.raises(TooMuch, match="bytes"):
        ledger(node, timeout=20).block_number()
    assert sum(sent) < 100 * 2**20


@pytest.mark.parametrize(
    "body",
    [
        b"", b"<html>502</html>", b"null", b"[]", b"{}", b"1", b'"x"', b"\xff\xfe", b"[" * 100_000,
        b'{"jsonrpc":"2.0","id":0,"result":' + b"9" * 10_000 + b"}",
        b'{"jsonrpc":"2.0","id":0,"error":"no"}', b'{"jsonrpc":"2.0","id":0,"error":{"code":"x","message":5}}',
        b'{"jsonrpc":"2.0","id":0,"error":{"code":-32000}}', b'{"jsonrpc":"2.0","id":0}',
        b'{"jsonrpc":"2.0","id":0,"error":{"code":3,"message":"\\u001b[2Jexecution reverted","data":"0x9"}}',
    ],
)  # fmt: skip
def test_what_is_no_answer_is_said_in_one_line(body: bytes):
    with HostileNode(lambda connection, _: connection.sendall(http(body))) as node:
        asked = ledger(node)
        for ask in (
            asked.block, asked.block_number, lambda: asked.standings([TK]), lambda: asked.nonces([CONTRACT]),
            lambda: list(asked.data_events(TK, 0, 10)), lambda: asked.balance(CONTRACT), lambda: asked.receipt(TK),
            asked.check, lambda: asked.call(CONTRACT, b"", gas=1),
        ):  # fmt: skip
            try:
                ask()
            except ChainError as error:
                assert str(error).isprintable()
                assert len(str(error)) < 600
                continue
            assert ask() is None  # a receipt that is null is one that is not there


@pytest.mark.parametrize(
    "change",
    [
        {"timestamp": hex(2**240)}, {"timestamp": "0x-1"}, {"timestamp": None}, {"timestamp": [1]}, {"number": "soon"},
        {"number": hex(2**64)}, {"hash": "0x11"}, {"hash": 5}, {"gasLimit": {}}, {"baseFeePerGas": hex(2**200)},
        {"number": True}, {"extraData": None},
    ],
)  # fmt: skip
def test_a_block_of_another_form_is_none(change: dict[str, Any]):
    with HostileNode(says(eth_getBlockByNumber=BLOCK)) as node:
        assert ledger(node).block().time == 0x65000000
        with pytest.raises(ChainUnavailable, match="in place of"):
            ledger(node).block(8)
    with HostileNode(says(eth_getBlockByNumber=BLOCK | change)) as node:
        try:
            ledger(node).block()
        except ChainError:
            return
        assert change == {"extraData": None}


@given(st.recursive(st.none() | st.booleans() | st.integers() | st.text() | st.floats(allow_nan=False),
                    lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner)))  # fmt: skip
@settings(max_examples=60)
def test_any_json_is_a_value_or_a_chain_error(value: Any):
    method = dict.fromkeys(
        ["eth_getBlockByNumber", "eth_getLogs", "eth_call", "eth_getTransactionCount", "eth_getTransactionReceipt",
         "eth_blockNumber", "eth_getBalance", "eth_getCode", "eth_sendRawTransaction"], value)  # fmt: skip
    with HostileNode(says(**method)) as node:
        asked = ledger(node)
        for ask in (
            asked.block, asked.block_number, lambda: asked.standings([TK]), lambda: asked.nonces([CONTRACT]),
            lambda: list(asked.data_events(TK, 0, 3)), lambda: list(asked.newest_data(TK, 3)),
            lambda: asked.receipt(TK), lambda: asked.balance(CONTRACT), lambda: asked.send([b"x"]), asked.check,
            lambda: asked.check_data(TK, 0, [], 0, b""), asked.operator,
        ):  # fmt: skip
            with suppress(ChainError):
                ask()


def test_the_nodes_own_error_is_shown_whatever_the_status():
    error = {"code": -32005, "message": "daily quota exceeded"}
    body = json.dumps({"jsonrpc": "2.0", "id": 0, "error": error}).encode()
    for status in ("200 OK", "400 Bad Request", "429 Too Many Requests", "500 Internal Server Error"):
        with (
            HostileNode(lambda connection, _, status=status: connection.sendall(http(body, status))) as node,
            pytest.raises(ChainUnavailable, match="daily quota exceeded"),
        ):
            ledger(node).block_number()
    with (
        HostileNode(lambda connection, _: connection.sendall(http(b"<html>", "429 Too Many Requests"))) as node,
        pytest.raises(ChainUnavailable, match="HTTP 429 Too Many Requests"),
    ):
        ledger(node).block_number()


def test_a_node_cannot_send_the_client_elsewhere():
    with (
        HostileNode(says(eth_blockNumber="0x1", eth_call="0x")) as other,
        HostileNode(lambda c, _: c.sendall(http(b"", "307 Elsewhere", f"Location: {other.url}\r\n"))) as node,
    ):
        with pytest.raises(ChainError):
            ledger(node).block_number()
        assert other.asked == []
    # OffchainLookup of EIP-3668: an error that names URLs to be fetched
    lookup = "0x556f1830" + "00" * 320
    answer = {"jsonrpc": "2.0", "id": 0, "error": {"code": 3, "message": "execution reverted", "data": lookup}}
    with HostileNode(lambda c, _: c.sendall(http(json.dumps(answer).encode()))) as node, pytest.raises(ChainError):
        ledger(node).standings([TK])


def test_events_that_were_not_asked_for_are_not_believed():
    event = {
        "address": CONTRACT, "blockNumber": "0x3", "logIndex": "0x0", "transactionHash": HASH, "blockHash": HASH,
        "transactionIndex": "0x0", "removed": False, "data": "0x" + "00" * 32 + f"{64:064x}" + "00" * 32,
        "topics": [], }  # fmt: skip
    with HostileNode(says(eth_getLogs=[])) as node:
        topic = ledger(node)._contract.events.Data().topic
    right = event | {"topics": [topic, "0x" + TK.hex(), "0x" + "00" * 32, "0x" + "00" * 32]}
    with HostileNode(says(eth_getLogs=[right])) as node:
        [found] = ledger(node).data_events(TK, 3, 3)
        assert (found.first, found.chunks, found.block) == (0, (), 3)
    for wrong in (
        {"address": "0x" + "22" * 20}, {"blockNumber": "0x4"}, {"data": "0x"}, {"data": "0x" + "ff" * 96},
        {"topics": [right["topics"][0], "0x" + "33" * 32, *right["topics"][2:]]}, {"topics": right["topics"][:3]},
        {"topics": ["0x" + "44" * 32, *right["topics"][1:]]}, {"topics": None}, {"transactionHash": None},
    ):  # fmt: skip
        with HostileNode(says(eth_getLogs=[right | wrong])) as node, pytest.raises(ChainError):
            list(ledger(node).data_events(TK, 3, 3))


def test_links_that_lead_nowhere_end():
    with HostileNode(says(eth_getLogs=[])) as node, pytest.raises(ChainError, match="must be"):
        list(ledger(node).newest_data(TK, 9))
    assert len(node.asked) == 1


def test_a_link_that_does_not_lead_back_is_not_followed():
    """The batch of block 7 says that the one before it is in block 7 as well."""
    with HostileNode(says(eth_getLogs=[])) as node:
        topic = ledger(node)._contract.events.Data().topic

    def log(first: int, block: int, previous: int) -> dict[str, Any]:
        return {
            "address": CONTRACT, "blockNumber": hex(block), "logIndex": "0x0", "transactionHash": HASH,
            "blockHash": HASH, "transactionIndex": "0x0", "removed": False,
            "data": f"0x{previous:064x}{64:064x}{0:064x}",
            "topics": [topic, "0x" + TK.hex(), f"0x{first:064x}", "0x" + "00" * 32],
        }  # fmt: skip

    logs = [log(2, 9, 8), log(1, 8, 7), log(0, 7, 7)]

    def answer(connection: socket.socket, body: Any) -> None:
        start, end = (int(body["params"][0][key], 16) for key in ("fromBlock", "toBlock"))
        found = [each for each in logs if start <= int(each["blockNumber"], 16) <= end]
        connection.sendall(http(json.dumps({"jsonrpc": "2.0", "id": body["id"], "result": found}).encode()))

    read = []
    with HostileNode(answer) as node, pytest.raises(ChainError, match="names a block before it"):
        for event in ledger(node).newest_data(TK, 9):
            read.append(event.first)
    assert read == [2, 1]


def test_ranges_are_halved_where_they_are_refused_and_doubled_again():
    asked = []

    def picky(connection: socket.socket, body: Any) -> None:
        asked_for = body["params"][0]
        start, end = int(asked_for["fromBlock"], 16), int(asked_for["toBlock"], 16)
        asked.append((start, end))
        refused = {"error": {"code": -32005, "message": "query returned more than 10000 results"}}
        answer = refused if end - start >= 300 else {"result": []}
        connection.sendall(http(json.dumps({"jsonrpc": "2.0", "id": body["id"]} | answer).encode()))

    with HostileNode(picky) as node:
        assert list(ledger(node).data_events(TK, 0, 2000)) == []
    answered = [(start, end) for start, end in asked if end - start < 300]
    assert answered[0][0] == 0
    assert answered[-1][1] == 2000
    assert all(one[1] + 1 == other[0] for one, other in pairwise(answered))
    refusal = ValueError("query returned more than 10000 results")
    with HostileNode(says(eth_getLogs=refusal)) as node, pytest.raises(TooMuch):
        list(ledger(node).data_events(TK, 5, 5))


def test_many_requests_go_in_batches_that_nodes_and_their_proxies_take():
    sizes = []

    def count(connection: socket.socket, body: Any) -> None:
        sizes.append((len(body), len(json.dumps(body))))
        answer = [{"jsonrpc": "2.0", "id": request["id"], "result": HASH} for request in body]
        connection.sendall(http(json.dumps(answer).encode()))

    with HostileNode(count) as node:
        assert ledger(node).send([bytes(98_000)] * 20 + [b"x"] * 120) == [None] * 140
    assert len(sizes) == 35
    assert all(size < 10**6 for _, size in sizes)


@pytest.mark.parametrize(
    ("words", "kind"),
    [
        ("already known", AlreadyKnown), ("Known transaction: 0x12", AlreadyKnown), ("AlreadyKnown", AlreadyKnown),
        ("transaction already imported", AlreadyKnown), ("Unknown transaction type", ChainUnavailable),
        ("nonce too low: next nonce 5, tx nonce 4", NonceTooLow), ("OldNonce", NonceTooLow),
        ("replacement transaction underpriced", Underpriced), ("transaction underpriced: gas tip cap 0", Underpriced),
        ("max fee per gas less than block base fee: address 0x, maxFeePerGas: 1", Underpriced),
        ("FeeTooLow, MaxFeePerGas too low", Underpriced),
        ("insufficient funds for gas * price + value: balance 0", OutOfFunds), ("Insufficient funds", OutOfFunds),
        ("execution reverted: NotNext", Reverted), ("VM Exception while processing transaction: revert", Reverted),
        ("exceed maximum block range: 5000", TooMuch), ("query returned more than 10000 results", TooMuch),
        ("Log response size exceeded.", TooMuch), ("block range is too wide", TooMuch),
        ("txpool is full", ChainUnavailable), ("", ChainUnavailable), (None, ChainUnavailable), ({}, ChainUnavailable),
    ],
)  # fmt: skip
def test_nodes_words_are_understood(words: object, kind: type[ChainError]):
    assert type(classify(words)) is kind


def test_access_keys_and_control_characters_are_not_shown():
    assert shown("https://user:secret@node.example:8545/v3/0123456789abcdef?key=1") == "https://node.example:8545"
    assert shown("http://[::1]:8545") == "http://[::1]:8545"
    assert printable("a\x1b[31m\r\nb\u202e") == "a [31m  b"
    assert len(printable("x" * 10_000)) == 300
    with pytest.raises(ChainUnavailable) as caught:
        Ledger("http://user:secret@127.0.0.1:1/key", CONTRACT).block_number()
    assert "secret" not in str(caught.value)
    assert "key" not in str(caught.value)
    assert str(caught.value).startswith("http://127.0.0.1:1 does not answer (Connection refused); start")


@pytest.mark.parametrize("url", [
    "nonsense", "file:///etc/passwd", "http://", "127.0.0.1:8545", "", "http://:8545", "http://127.0.0.1:99999",
    "http://127.0.0.1:65536", "http://127.0.0.1:x", "http://[::1:8545", "http://[::1", "http://key@/",
])  # fmt: skip
def test_what_is_no_url_of_a_node_is_told_as_that(url: str):
    with pytest.raises(ConfigError, match="no URL of a node"):
        Ledger(url, CONTRACT)

"""A node that gives what a file of tests/vectors/log/logs.json says, and what `read` makes of it."""

from __future__ import annotations

import json
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from types import SimpleNamespace
from typing import Any, cast

from eth_hash.auto import keccak

from rosbridge_eth.identity import Trust, read_certificates
from rosbridge_eth.ledger import Ledger
from rosbridge_eth.reading import read_robot
from rosbridge_eth.reading.outputs import json_line
from smcrypto import sm2

MADE = "0x" + "00" * 32


class Node:
    """Answers JSON-RPC at `url`; the newest block is the one behind the last event."""

    def __init__(self, file: dict[str, Any]) -> None:
        node, self._file = self, file
        self._top = len(file["events"]) + 2

        class Handler(BaseHTTPRequestHandler):
            protocol_version = "HTTP/1.1"

            def do_POST(self) -> None:
                body = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
                given = [node.answer(one) for one in body] if isinstance(body, list) else node.answer(body)
                data = json.dumps(given).encode()
                self.send_response(200)
                self.send_header("Content-Type", "application/json")
                self.send_header("Content-Length", str(len(data)))
                self.end_headers()
                self.wfile.write(data)

            def log_message(self, *_: object) -> None:
                pass

        self._server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.url = f"http://127.0.0.1:{self._server.server_address[1]}"

    def __enter__(self) -> Node:
        threading.Thread(target=self._server.serve_forever, args=(0.05,), daemon=True).start()
        return self

    def __exit__(self, *_: object) -> None:
        self._server.shutdown()
        self._server.server_close()

    def answer(self, request: dict[str, Any]) -> dict[str, Any]:
        asked = cast("list[Any]", request.get("params", []))
        result: Any
        match request["method"]:
            case "eth_chainId":
                result = hex(self._file["chain_id"])
            case "eth_blockNumber":
                result = hex(self._top)
            case "eth_call":
                result = self._file["standings"]
            case "eth_getBlockByNumber":
                result = self._block(self._top if asked[0] == "latest" else int(asked[0], 16))
            case "eth_getLogs":
                result = [*self._logs(asked[0])]
            case other:
                raise AssertionError(other)
        return {"jsonrpc": "2.0", "id": request["id"], "result": result}

    def _hash(self, number: int) -> str:
        return "0x" + keccak(b"block %d" % number).hex() if number else str(self._file["genesis"])

    def _block(self, number: int) -> dict[str, Any]:
        return {
            "number": hex(number), "hash": self._hash(number), "parentHash": self._hash(max(0, number - 1)),
            "timestamp": hex(self._file["first_block_time"] + number), "gasLimit": "0x1c9c380", "gasUsed": "0x0",
            "baseFeePerGas": "0x1", "difficulty": "0x0", "nonce": "0x0000000000000000", "extraData": "0x",
            "miner": "0x" + "00" * 20, "transactions": [], "size": "0x0", "uncles": [], "logsBloom": "0x" + "00" * 256,
            "stateRoot": MADE, "receiptsRoot": MADE, "transactionsRoot": MADE, "sha3Uncles": MADE, "mixHash": MADE,
        }  # fmt: skip

    def _logs(self, asked: dict[str, Any]) -> Any:
        low, high = (int(asked[name], 16) for name in ("fromBlock", "toBlock"))
        kinds = asked["topics"][0]
        for event in self._file["events"]:
            if low <= event["block"] <= high and event["topics"][0] in ([kinds] if isinstance(kinds, str) else kinds):
                yield {
                    "address": self._file["contract"], "topics": event["topics"], "data": event["data"],
                    "blockNumber": hex(event["block"]), "transactionHash": event["transaction"],
                    "transactionIndex": "0x0", "blockHash": self._hash(event["block"]), "logIndex": "0x0",
                    "removed": False,
                }  # fmt: skip


def ask_read(node: Node, file: dict[str, Any]) -> tuple[dict[str, Any], list[str]]:
    """The verdict, as far as every reader gives it, and the lines."""
    place = SimpleNamespace(chain_id=file["chain_id"], genesis=file["genesis"], contract=file["contract"])
    ledger = Ledger.connect(node.url, place)
    reading = read_robot(
        [ledger], file["robot"], trust=Trust(read_certificates(file["ca"].encode())), now=file["first_block_time"],
        reader=sm2.PrivateKey.from_bytes(bytes.fromhex(file["reader_key"])),
    )  # fmt: skip
    lines = [json_line(record) for record in reading.records()]
    verdict = reading.verdict()
    ledger.close()
    head = verdict.head
    return {
        "sound": verdict.sound, "chunks": verdict.chunks, "block": verdict.block, "records": verdict.records,
        "counts": dict(sorted(verdict.counts.items())),
        "places": {
            kind: sorted({
                place for one in verdict.findings if one.kind.label == kind
                for first, last in one.places for place in range(first, last + 1)
            })
            for kind in sorted(verdict.counts) if kind != "withheld"
        },
        "head": head and {"stream": head.stream, "number": head.number, "digest": head.digest, "goodbye": head.goodbye},
        "certificates": [
            {"index": one.first, "revoked": one.revoked, "fingerprint": one.fingerprint, "trusted": one.key is not None}
            for one in verdict.certificates
        ],
    }, lines  # fmt: skip

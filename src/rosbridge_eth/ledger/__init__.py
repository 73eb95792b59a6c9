"""The ledger: the contract, the chains it runs on, and how batches get there and come back.

    chain = ledger.connect("http://127.0.0.1:8545")      or ledger.embedded()
    contract = ledger.deploy(chain, operator)            or ledger.Contract.at(chain, address)
    history = ledger.fetch(chain, contract, robot)

web3, py-evm and eth-account are imported where they are first needed, so that
commands which talk to no node start fast.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from rosbridge_eth.ledger.chain import Block, Call, Chain, Log, Receipt
from rosbridge_eth.ledger.contract import Contract, RobotState, deploy
from rosbridge_eth.ledger.history import ChainRecord, History, Problem, ProblemKind, Registration, block_at, fetch

if TYPE_CHECKING:
    from rosbridge_eth.ledger.embedded import EmbeddedChain
    from rosbridge_eth.ledger.jsonrpc import JsonRpcChain

__all__ = [
    "Block",
    "Call",
    "Chain",
    "ChainRecord",
    "Contract",
    "History",
    "Log",
    "Problem",
    "ProblemKind",
    "Receipt",
    "Registration",
    "RobotState",
    "block_at",
    "connect",
    "deploy",
    "embedded",
    "fetch",
]


def connect(url: str, *, timeout: float = 10.0) -> JsonRpcChain:
    """A node by its URL (http, https, ws, wss); `timeout` in seconds for each request. Does not ask it yet."""
    from rosbridge_eth.ledger.jsonrpc import JsonRpcChain

    return JsonRpcChain(url, timeout=timeout)


def embedded(*, fund: Mapping[str, int] | None = None, auto_mine: bool = True) -> EmbeddedChain:
    """A chain in this process that ends with it; `fund` gives addresses their first wei."""
    from rosbridge_eth.ledger.embedded import EmbeddedChain

    return EmbeddedChain(fund=fund, auto_mine=auto_mine)

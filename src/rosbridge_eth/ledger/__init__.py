"""The ledger: the contract, the chains it runs on, and how batches get there and come back.

    chain = ledger.connect("http://127.0.0.1:8545")      or ledger.embedded.EmbeddedChain()
    contract = ledger.deploy(chain, operator)            or ledger.Contract.at(chain, address)
    journal = ledger.Journal(path, ledger.Binding.of(contract))
    submitter = ledger.Submitter(journal, ...)           submitter.seal(records, now)
    ledger.pump(submitter, chain, now)
    history = ledger.fetch(chain, contract, robot)

web3, py-evm and eth-account are imported where they are first needed, so that
commands which talk to no node start fast.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from rosbridge_eth.ledger.accounts import Keyring
from rosbridge_eth.ledger.batching import Batcher, Limits
from rosbridge_eth.ledger.chain import Block, Call, Chain, Log, Receipt
from rosbridge_eth.ledger.contract import Contract, RobotState, deploy
from rosbridge_eth.ledger.failures import NodeFailure
from rosbridge_eth.ledger.history import ChainRecord, History, Problem, ProblemKind, Registration, block_at, fetch
from rosbridge_eth.ledger.journal import Binding, Journal, LeaseLost
from rosbridge_eth.ledger.pump import pump, run
from rosbridge_eth.ledger.recovery import adopt_history, missing_batches
from rosbridge_eth.ledger.submitter import BatchTiming, Sealing, Settings, Status, Submitter

if TYPE_CHECKING:
    from rosbridge_eth.ledger.jsonrpc import JsonRpcChain

__all__ = [
    "BatchTiming",
    "Batcher",
    "Binding",
    "Block",
    "Call",
    "Chain",
    "ChainRecord",
    "Contract",
    "History",
    "Journal",
    "Keyring",
    "LeaseLost",
    "Limits",
    "Log",
    "NodeFailure",
    "Problem",
    "ProblemKind",
    "Receipt",
    "Registration",
    "RobotState",
    "Sealing",
    "Settings",
    "Status",
    "Submitter",
    "adopt_history",
    "block_at",
    "connect",
    "deploy",
    "fetch",
    "missing_batches",
    "pump",
    "run",
]


def connect(url: str, *, timeout: float = 10.0, attempts: int = 1) -> JsonRpcChain:
    """A node by its URL (http, https, ws, wss). Does not ask it anything yet.

    timeout: seconds for one request. attempts: how often a reading request is tried; a
    submitter tries again by itself, a reader wants 3 or so.
    """
    from rosbridge_eth.ledger.jsonrpc import JsonRpcChain

    return JsonRpcChain(url, timeout=timeout, attempts=attempts)

"""What a node answers when it does not do what was asked, sorted by what the caller can do about it.

Nodes say the same thing in different words, and JSON-RPC gives most of it one
code (-32000). The table below is matched in order, without regard to case.
Where the words are from:

    geth        core/txpool/errors.go, core/error.go, core/vm/errors.go
    anvil       crates/anvil/core + crates/anvil/src/eth/error.rs (Foundry)
    nethermind  Nethermind.TxPool/AcceptTxResult.cs
    besu        RpcErrorType.java
    erigon      txpool/txpoolcfg (its DiscardReason)
    py-evm      eth/validation.py (the embedded chain words its own as geth does)

An answer that fits no row is `Refused` and carries the node's words.
"""

from __future__ import annotations

import re
from typing import Any, ClassVar

from rosbridge_eth.errors import ChainError


class NodeFailure(ChainError):
    """A request to the node failed. `transient`: the same request may succeed later, unchanged."""

    transient: ClassVar[bool] = False


class AlreadyKnown(NodeFailure):
    """The node has this very transaction: as good as accepted."""


class NonceTooLow(NodeFailure):
    """The account has gone past this nonce: this transaction was mined, or another one with its nonce."""


class NonceTooHigh(NodeFailure):
    """An earlier nonce is missing and the node does not hold transactions back; or its queue is full."""

    transient = True


class Underpriced(NodeFailure):
    """The fee is too low: for the node, for the next block, or to replace what has this nonce."""


class InsufficientFunds(NodeFailure):
    """The account cannot pay for gas limit * fee + value."""


class GasRefused(NodeFailure):
    """The gas limit is below what the transaction needs by itself, or above what a block holds."""


class TooLarge(NodeFailure):
    """The transaction is larger than the node takes."""


class Reverted(NodeFailure):
    """The contract refused. `name` is its custom error, '' where there is none; `arguments` are its values."""

    def __init__(self, message: str, data: bytes = b"", name: str = "", arguments: tuple[Any, ...] = ()) -> None:
        super().__init__(message)
        self.data = data
        self.name = name
        self.arguments = arguments


class RateLimited(NodeFailure):
    """The node wants fewer requests. `retry_after`: seconds it asked for, if it said."""

    transient = True

    def __init__(self, message: str, retry_after: float | None = None) -> None:
        super().__init__(message)
        self.retry_after = retry_after


class Unreachable(NodeFailure):
    """No answer: no connection, a time-out, or a gateway's error. Whether it was done is unknown."""

    transient = True


class Garbled(NodeFailure):
    """An answer that is not one: not JSON, not JSON-RPC, or not of the form the method has."""

    transient = True


class PoolFull(NodeFailure):
    """The node has no room for more transactions now."""

    transient = True


class Unsupported(NodeFailure):
    """The node does not offer this method."""


class RangeTooWide(NodeFailure):
    """The node wants logs asked for in smaller pieces."""


class Refused(NodeFailure):
    """The node refused in words that fit no other class."""


_TABLE: tuple[tuple[type[NodeFailure], str], ...] = (
    (AlreadyKnown, r"already known|already imported|known transaction|alreadyknown|already exists|duplicate hash"),
    (NonceTooLow, r"nonce too low|nonce too old|oldnonce|nonce .*is lower than|invalid nonce.*too low"),
    (NonceTooHigh, r"nonce too high|nonce too distant|noncegap|nonce gap|future transaction|exceeds account limit"),
    (
        Underpriced,
        r"underpriced|fee too low|feetoolow|max fee per gas less than block base fee|gas price too low|"
        r"gas price below|max priority fee per gas higher than max fee|replacementnotallowed|tip .*too low",
    ),
    (
        InsufficientFunds,
        r"insufficient funds|insufficientfunds|upfront cost exceeds|insufficient balance|not enough funds",
    ),
    (
        TooLarge,
        r"oversized data|transaction too large|rlp too long|request entity too large|body too large|init ?code size",
    ),
    (
        GasRefused,
        r"intrinsic gas|exceeds block gas limit|gas limit reached|gas limit too (high|low)|gaslimitexceeded|"
        r"gas required exceeds allowance|out of gas|exceeds transaction gas (cap|limit)|floor data gas|"
        r"cap.*gas limit|transaction gas limit",
    ),
    (Reverted, r"revert|custom error|invalid opcode"),
    (RateLimited, r"rate limit|too many requests|request limit|exceeded.*(capacity|quota)|compute units"),
    (PoolFull, r"txpool is full|pool is full|pool limit|queue.*full"),
    (
        RangeTooWide,
        r"block range|range too (wide|large)|range.*exceed|too many results|more than \d+ results|"
        r"query returned more|response size|log response",
    ),
    (Unsupported, r"method .*(not found|not supported|does not exist|unavailable)|unsupported method"),
    (Unreachable, r"timed? ?out|connection (refused|reset|aborted)|bad gateway|service unavailable|header not found"),
)
_PATTERNS = tuple((kind, re.compile(pattern, re.IGNORECASE | re.DOTALL)) for kind, pattern in _TABLE)


def revert_data(value: object) -> bytes:
    """What a node put in `error.data`: hex, hex within words ("Reverted 0x..."), or an object that holds it."""
    if isinstance(value, dict):
        found = (revert_data(value[key]) for key in ("data", "result", "output", "return") if key in value)
        return next(filter(None, found), b"")
    if isinstance(value, str) and (match := re.search(r"0x((?:[0-9a-fA-F]{2})+)", value)):
        return bytes.fromhex(match[1])
    return b""


def classify(message: str, code: int | None = None, data: object = None) -> NodeFailure:
    """The failure that an error object of JSON-RPC stands for."""
    words = " ".join(message.split())[:500] or f"error {code}"
    if code == 3 or (code == -32015 and data):  # EIP-1474's successor in geth and others: execution reverted
        return Reverted(words, revert_data(data))
    if code in (-32005, 429):  # "limit exceeded" of EIP-1474, used for both rates and ranges
        wide = next((kind for kind, pattern in _PATTERNS if kind is RangeTooWide and pattern.search(words)), None)
        return RangeTooWide(words) if wide else RateLimited(words)
    for kind, pattern in _PATTERNS:
        if pattern.search(words):
            return Reverted(words, revert_data(data)) if kind is Reverted else kind(words)
    if code == -32601:
        return Unsupported(words)
    if code == -32700:
        return Garbled(words)
    return Refused(words)

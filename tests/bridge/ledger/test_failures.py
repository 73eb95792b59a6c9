"""What nodes really say, and what it means for the caller. The words are those of the nodes' own sources."""

from __future__ import annotations

import pytest

from rosbridge_eth.ledger import failures
from rosbridge_eth.ledger.failures import classify

WORDS = [
    # geth
    ("already known", failures.AlreadyKnown),
    ("nonce too low: next nonce 5, tx nonce 4", failures.NonceTooLow),
    ("nonce too high", failures.NonceTooHigh),
    ("transaction underpriced: gas tip cap 1, minimum needed 1000000", failures.Underpriced),
    ("replacement transaction underpriced", failures.Underpriced),
    (
        "max fee per gas less than block base fee: address 0x00, maxFeePerGas: 1, baseFee: 875000000",
        failures.Underpriced,
    ),
    ("insufficient funds for gas * price + value: balance 0, tx cost 1, overshot 1", failures.InsufficientFunds),
    ("insufficient funds for transfer", failures.InsufficientFunds),
    ("intrinsic gas too low: gas 1, minimum needed 21000", failures.GasRefused),
    ("insufficient gas for floor data gas cost: gas 30000, minimum needed 50000", failures.GasRefused),
    ("exceeds block gas limit", failures.GasRefused),
    ("gas required exceeds allowance (30000000)", failures.GasRefused),
    ("out of gas", failures.GasRefused),
    ("oversized data: transaction size 140000, limit 131072", failures.TooLarge),
    ("txpool is full", failures.PoolFull),
    ("execution reverted", failures.Reverted),
    # anvil
    ("transaction already imported", failures.AlreadyKnown),
    ("Out of gas: gas required exceeds allowance: 30000000", failures.GasRefused),
    ("Insufficient funds for gas * price + value", failures.InsufficientFunds),
    # nethermind
    ("AlreadyKnown", failures.AlreadyKnown),
    ("OldNonce, Current nonce: 5, nonce of rejected tx: 4", failures.NonceTooLow),
    ("NonceGap, Future nonce. Expected nonce: 5", failures.NonceTooHigh),
    ("FeeTooLow, MaxFeePerGas too low", failures.Underpriced),
    ("InsufficientFunds, Account balance: 0", failures.InsufficientFunds),
    ("GasLimitExceeded, Gas limit: 30000000", failures.GasRefused),
    ("ReplacementNotAllowed", failures.Underpriced),
    # besu
    ("Known transaction", failures.AlreadyKnown),
    ("Nonce too low", failures.NonceTooLow),
    ("Upfront cost exceeds account balance", failures.InsufficientFunds),
    ("Transaction gas limit exceeds block gas limit", failures.GasRefused),
    # providers
    ("Too Many Requests", failures.RateLimited),
    ("Your app has exceeded its compute units per second capacity", failures.RateLimited),
    ("query returned more than 10000 results", failures.RangeTooWide),
    ("eth_getLogs is limited to a 10,000 block range", failures.RangeTooWide),
    ("the method eth_maxPriorityFeePerGas does not exist/is not available", failures.Unsupported),
    ("request timed out", failures.Unreachable),
    ("something nobody has said before", failures.Refused),
    ("", failures.Refused),
]


@pytest.mark.parametrize(("words", "kind"), WORDS, ids=lambda value: value if isinstance(value, str) else "")
def test_a_nodes_words_are_sorted(words: str, kind: type[failures.NodeFailure]):
    failure = classify(words, -32000)
    assert type(failure) is kind
    assert words.split(":")[0] in str(failure)


def test_codes_of_their_own_count_before_words():
    assert type(classify("whatever", -32601)) is failures.Unsupported
    assert type(classify("limit exceeded", -32005)) is failures.RateLimited
    assert type(classify("query returned more than 10000 results", -32005)) is failures.RangeTooWide
    assert type(classify("x", 429)) is failures.RateLimited
    assert type(classify("parse error", -32700)) is failures.Garbled


@pytest.mark.parametrize(
    "data",
    [
        "0x12345678aa",
        "Reverted 0x12345678aa",
        {"data": "0x12345678aa"},
        {"result": "0x12345678aa"},
        {"data": {"data": "0x12345678aa"}},
    ],
)
def test_revert_data_is_found_wherever_a_node_puts_it(data: object):
    failure = classify("execution reverted", 3, data)
    assert isinstance(failure, failures.Reverted)
    assert failure.data == bytes.fromhex("12345678aa")


@pytest.mark.parametrize("data", [None, "0x", "", 5, [], {"other": "0x12"}, "0x123"])
def test_revert_data_that_is_none_is_empty(data: object):
    failure = classify("execution reverted", 3, data)
    assert isinstance(failure, failures.Reverted)
    assert failure.data in (b"", b"\x12")


def test_only_what_may_pass_is_transient():
    passing = {c for c in vars(failures).values() if isinstance(c, type) and getattr(c, "transient", False)}
    assert passing == {
        failures.NonceTooHigh,
        failures.RateLimited,
        failures.Unreachable,
        failures.Garbled,
        failures.PoolFull,
    }

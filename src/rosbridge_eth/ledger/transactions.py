"""Signed transactions and what they offer to pay: EIP-1559 (type 2), or EIP-155 where there is no base fee."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from rosbridge_eth.ledger.chain import Block

if TYPE_CHECKING:
    from eth_account.signers.local import LocalAccount

BUMP_PERCENT = 12  # nodes ask for 10 % more to replace a transaction (geth: PriceBump); rounding must not lose it


@dataclass(frozen=True, slots=True)
class Fees:
    """What a transaction offers for a unit of gas, in wei: at most `max_fee`, of it `tip` to the miner.

    `legacy`: one price, `max_fee`, for a network without base fees.
    """

    max_fee: int
    tip: int
    legacy: bool = False

    @staticmethod
    def suggested(head: Block, priority_fee: int) -> Fees:
        """Enough for six full blocks in a row: the base fee rises by at most 1/8 a block, 1.125**6 > 2."""
        if head.base_fee is None:
            return Fees(priority_fee, priority_fee, legacy=True)
        return Fees(2 * head.base_fee + priority_fee, priority_fee)

    def bumped(self, market: Fees) -> Fees:
        """At least 12 % more of both, and at least what the market asks now."""
        return Fees(
            max(self.max_fee * (100 + BUMP_PERCENT) // 100 + 1, market.max_fee),
            max(self.tip * (100 + BUMP_PERCENT) // 100 + 1, market.tip),
            market.legacy,
        )

    def capped(self, limit: int) -> Fees:
        return Fees(min(self.max_fee, limit), min(self.tip, limit), self.legacy)

    def replaces(self, old: Fees) -> bool:
        """Would a node take this in place of `old`?"""
        return all(100 * new >= 110 * was for new, was in ((self.max_fee, old.max_fee), (self.tip, old.tip)))


@dataclass(frozen=True, slots=True)
class Transaction:
    """What is to be signed."""

    chain_id: int
    nonce: int
    to: str | None
    data: bytes = field(repr=False)
    gas: int
    fees: Fees
    value: int = 0


@dataclass(frozen=True, slots=True)
class SignedTransaction:
    """The bytes to hand to a node, and their hash."""

    hash: bytes
    raw: bytes = field(repr=False)


def sign(transaction: Transaction, account: LocalAccount) -> SignedTransaction:
    """Sign for `account`. The same transaction gives the same bytes (RFC 6979)."""
    fields: dict[str, int | str | bytes] = {
        "chainId": transaction.chain_id,
        "nonce": transaction.nonce,
        "gas": transaction.gas,
        "value": transaction.value,
        "data": transaction.data,
    }
    fees = transaction.fees
    if fees.legacy:
        fields["gasPrice"] = fees.max_fee
    else:
        fields |= {"type": 2, "maxFeePerGas": fees.max_fee, "maxPriorityFeePerGas": fees.tip}
    if transaction.to is not None:
        fields["to"] = transaction.to
    signed = account.sign_transaction(fields)  # type: ignore[arg-type]
    return SignedTransaction(bytes(signed.hash), bytes(signed.raw_transaction))

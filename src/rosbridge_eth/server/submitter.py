"""Brings what is in the inbox onto the chain: look, compare, send what is missing. Level-triggered, without a journal.

A turn looks at how every robot stands in the contract (how many chunks, the hash of the last: `tail`), finds the row
with that hash in the inbox, and sends what follows it, in batches. The contract takes a batch only if it follows
what is there, so nothing can be written twice or out of order, whatever is sent; all that is decided here is what
not to waste gas on. What is in flight is kept in memory only; after a restart it is waited for.

    the tail is no row (the inbox was lost, or put back   read the batches back from the last one, until it is known
    from an old copy), or a row does not follow the one   which rows are on the chain; those go, the last confirmed
    in front and the inbox does not know all that was     chunk and what is behind it on the chain stand in front of
    ever written                                          the others; heads are raised, so that a robot which sends
                                                          them again is told they are known
    the pool has fewer transactions than are in flight    the missing ones again, at today's price or the same
    the pool has more: a restart, somebody else           wait 30 s, then send over them
    nothing moved for 30 s                                all in flight again, an eighth dearer or at today's price
    the count is not what the transactions in blocks      forget what is in flight; then one batch at a time, tried
    should have made it: reverted, or a reorganisation    first, until one is written; refused: the robot is on hold

A batch counts as confirmed when a block N - 1 below the newest has it (N = 1: the newest itself).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, NamedTuple

from eth_hash.auto import keccak

from rosbridge_eth.errors import ChainError
from rosbridge_eth.inbox import Head, Inbox, Row
from rosbridge_eth.ledger import contract
from rosbridge_eth.ledger.contract import Block, Fees, Ledger, Standing
from rosbridge_eth.ledger.transport import AlreadyKnown, NonceTooLow, OutOfFunds, Reverted, Underpriced
from rosbridge_eth.log.chunk import Chunk, Header, Malformed
from rosbridge_eth.server.walk import Walk

if TYPE_CHECKING:
    from eth_account.signers.local import LocalAccount

BATCH_BYTES = 96 * 1024  # nodes take transactions of 128 KiB
BATCH_GAS = 8_000_000
IN_FLIGHT = 8  # transactions of one account; geth's pool has room for 16 of each
PATIENCE = 30.0  # seconds without progress, before something is done about it
BUSY, IDLE, LONGEST_PAUSE = 0.25, 1.0, 30.0  # seconds to the next turn
SEND_BYTES = 2**22  # of transactions, handed to the node at once
TOP_UPS = 20  # sent together; the next ones when all of them are in blocks
WALK = 50  # batches read back for one robot in one turn
ROWS = IN_FLIGHT * BATCH_BYTES // 203  # no chunk is smaller than 203 bytes
MINUTE, DAY = 60.0, 86_400.0
BURST = 3600.0  # seconds of a robot's gas that it may use at once
ALL = bytes(16)
"""No robot has this stream: a head for it says that the inbox knows the head of every stream on the chain."""


@dataclass(frozen=True, slots=True)
class Settings:
    """confirmations: blocks, its own included. Amounts in wei, max_fee for a unit of gas; gas_per_day of a robot."""

    confirmations: int = 1
    max_fee: int = 500 * 10**9
    low_water: int = contract.WEI_PER_ETH // 20
    top_up: int = contract.WEI_PER_ETH // 2
    gas_per_day: int = 10_000_000_000


class Batch(NamedTuple):
    """Rows for one transaction: `first` is the number of the first on the chain, `tail` the hash in front of it."""

    first: int
    tail: bytes
    rows: tuple[Row, ...]
    gas: int
    full: bool

    @property
    def end(self) -> int:
        return self.first + len(self.rows)


@dataclass(slots=True)
class Account:
    """What is remembered of a robot, and of the operator, between two turns."""

    nonce: int | None = None  # of the first in flight
    flights: list[Batch] = field(default_factory=list)
    fees: Fees | None = None  # what those offer
    since: float = 0.0  # of the last progress
    careful: bool = False  # the next batch is tried first
    hold: str | None = None  # why nothing is written
    walk: Walk | None = None
    new: bytes = b""  # digest of a row that is known not to be on the chain
    gas: float = 0.0  # that may be used now
    gas_at: float = 0.0

    def due(self, now: float) -> bool:
        """Whether PATIENCE is over; also where the clock was put back."""
        return not 0 <= now - self.since < PATIENCE


class Work(NamedTuple):
    """A robot with something to send or in flight. after: the position of the chain's tail in the inbox."""

    tk: bytes
    standing: Standing
    after: int | None
    oldest: float


class _Hold(Exception):
    """Nothing is to be written for this robot now, and why."""


class Submitter:
    """The one that writes. `turn` does what there is to do now.

    robots: the Tk of all registered robots. account: the key that writes for a robot, None where there is none; asked
    often. operator: pays for the robots' accounts, None where somebody else does.
    """

    def __init__(
        self, ledger: Ledger, inbox: Inbox, robots: Callable[[], Collection[bytes]],
        account: Callable[[bytes], LocalAccount | None], operator: LocalAccount | None, settings: Settings,
    ) -> None:  # fmt: skip
        self._ledger, self._inbox, self._robots = ledger, inbox, robots
        self._account, self._operator, self._settings = account, operator, settings
        self._known: dict[bytes, Account] = {}
        self._funds = Account()
        self._fees = Fees(0, 0)
        self._pause = IDLE
        self._looked_at = self._cleaned_at = 0.0
        self.trouble: str | None = None  # why nothing can be written at all
        self.unconfirmed: str | None = None  # why nothing can be confirmed
        self.funds: str | None = None  # why accounts are not topped up
        self.head: Block | None = None
        self.operator_balance: int | None = None  # the operator's, wei, a minute old at most
        self.standings: Mapping[bytes, Standing] = {}  # at the last look
        self.gas: Counter[bytes] = Counter()  # that the transactions sent for each robot use
        self.counts: Counter[str] = Counter()

    def turn(self, now: float) -> float:
        """now: seconds since 1970. Seconds until the next turn is wanted. StoreError of the inbox passes through."""
        try:
            if self.head is None or self.trouble is not None:  # whose place another chain may have taken
                self._ledger.check()
            head = self._ledger.block()
            if head == self.head and 0 <= now - self._looked_at < IDLE:
                return BUSY
            self.head, self._looked_at = head, now
            self.trouble = None
            busy = self._look(head, now)
            if not 0 <= now - self._cleaned_at < MINUTE:
                self._inbox.forget(now - DAY)
                self.operator_balance = self._ledger.balance(self._operator.address) if self._operator else None
                self._cleaned_at = now
        except ChainError as error:
            self.trouble, self._looked_at = str(error), float("-inf")
            self._pause = min(2 * self._pause, LONGEST_PAUSE)
            return self._pause
        self._pause = IDLE
        return BUSY if busy else IDLE

    # ------------------------------------------------------------------ look

    def _look(self, head: Block, now: float) -> bool:
        """Whether there is something to send or in flight."""
        self._inbox.append([], now)  # InboxExchanged, if it was
        self._fees = self._ledger.fees(head).limited(self._settings.max_fee)
        # Before the balances: what is in a block by now is in them, so nobody is topped up twice.
        [funds] = self._ledger.nonces([self._operator.address]) if self._operator else [(0, 0)]
        robots = list(self._robots())
        self.standings = standings = dict(zip(robots, self._ledger.standings(robots), strict=True))
        self._confirm(standings, head, now)
        work = []
        for tk, standing in standings.items():
            account = self._known.setdefault(tk, Account(gas=self._settings.gas_per_day * BURST / DAY, gas_at=now))
            try:
                after = self._place(tk, account, standing, now)
                if rows := self._inbox.rows(tk, after, 1):
                    work.append(Work(tk, standing, after, rows[0].taken_at))
                else:
                    account.hold, account.flights = None, []
            except _Hold as why:
                account.hold, account.flights = str(why), []
            certificates = contract.NOTHING if standing.revoked else standing.certificates_hash
            self._inbox.set_state(tk, hold=account.hold, certificates_hash=certificates)
        if head.base_fee is not None and head.base_fee > self._settings.max_fee:
            self.trouble = f"a unit of gas costs {head.base_fee / 10**9:.1f} gwei, which is above max_fee_gwei"
        else:
            if work:
                self._send(work, head, now)
            self._top_up(work, funds, now)
        return bool(work)

    def _confirm(self, standings: Mapping[bytes, Standing], head: Block, now: float) -> None:
        block = head.number - self._settings.confirmations + 1
        if block <= 0:
            return
        try:
            then = self._ledger.standings(list(standings), block)
            self.unconfirmed = None
        except ChainError as error:
            self.unconfirmed = f"the node does not tell how block {block} was: {error}"
            return
        for tk, standing in zip(standings, then, strict=True):
            position = self._inbox.find(tk, standing.tail) if standing.chunks else None
            if position is not None or not standing.chunks:
                self._inbox.confirm(tk, position, now, standing.data_block)

    def _place(self, tk: bytes, account: Account, standing: Standing, now: float) -> int | None:
        """The position of the row that is the chain's last chunk; None: there is none yet."""
        key = self._account(tk)
        if standing.account is None:
            raise _Hold("it is not registered in the contract")
        if standing.revoked:
            raise _Hold("it is revoked")
        if key is None or key.address != standing.account:
            raise _Hold(f"it writes with account {standing.account}, whose key is not here")
        if not standing.chunks:
            return None
        position = self._inbox.find(tk, standing.tail)
        if position is None:
            first = self._headers(tk, [row.position for row in self._inbox.rows(tk, None, 1)])
            self._walk(tk, account, standing, first[0] if first else None, now)
            position = self._inbox.find(tk, standing.tail)
        return position

    # ------------------------------------------------------------------ compare

    def _rows(self, work: Work, account: Account, now: float) -> list[Row]:
        """The rows behind the chain's tail, as far as it is known that they are not on the chain."""
        tk, standing, after, _ = work
        whole = self._inbox.head(tk, ALL) is not None
        if after is None and not whole:
            self._inbox.raise_heads(tk, {ALL: Head(0, contract.NOTHING)})
        if after is None or whole:
            return self._inbox.rows(tk, after, ROWS)
        rows = self._inbox.rows(tk, after, 8 * IN_FLIGHT)
        front, *headers = self._headers(tk, [after, *(row.position for row in rows)])
        for count, header in enumerate(headers):
            behind = header.stream == front.stream and header.number > front.number
            if not behind and header.previous != front.digest and header.digest != account.new:
                if count == 0:
                    self._walk(tk, account, standing, header, now)
                return rows[:count]
            front = header
        return rows

    def _headers(self, tk: bytes, positions: Sequence[int]) -> list[Header]:
        return [Chunk.parse(chunk).header for chunk in self._inbox.chunks(tk, positions)]

    def _walk(self, tk: bytes, account: Account, standing: Standing, oldest: Header | None, now: float) -> None:
        """Read back until it is known whether `oldest` is on the chain, the first of the rows in question (None: there
        are none); then make the inbox follow. Goes on in the next turn where that takes long.

        What is not confirmed becomes rows again: the chain may turn back, and the robot not send it any more.
        """
        final = (self.head.number if self.head else 0) - self._settings.confirmations + 1
        walk = account.walk = account.walk or Walk(self._ledger.newest_data(tk, standing.data_block), final)
        try:
            for count, event in enumerate(walk.events, 1):
                walk.add(event)
                if walk.settles(oldest):
                    break
                if count == WALK:
                    raise _Hold("what is on the chain is being read")
            else:
                walk.heads[ALL] = Head(0, contract.NOTHING)  # nothing is left that was not read
        except ChainError as error:
            account.walk = None
            raise _Hold(f"what is on the chain cannot be read: {error}") from error
        account.walk = None
        self.counts["walks"] += 1
        if not walk.newest or keccak(walk.newest[0]) != standing.tail:
            raise _Hold("the chain changed while it was read")
        self._inbox.raise_heads(tk, walk.heads)  # from here on, nothing of it is taken
        after = self._inbox.find(tk, standing.tail)
        if after is None or any(row.digest in walk.on_chain for row in self._inbox.rows(tk, after, 2**31)):
            try:
                front = [Chunk.parse(encoded) for encoded in reversed(walk.newest)]
            except Malformed as error:
                raise _Hold(f"what another program wrote is on the chain: {error}") from error
            self._inbox.rebase(tk, front, walk.on_chain, now)
            account.flights = []
            self.counts["rebases"] += 1
        if oldest is not None and oldest.digest not in walk.on_chain:
            account.new = oldest.digest

    # ------------------------------------------------------------------ send

    def _send(self, work: Sequence[Work], head: Block, now: float) -> None:
        nonces = self._ledger.nonces([w.standing.account or "" for w in work])
        # Looked at twice, with the nonces in between: where both looks agree, the nonces belong to them.
        second = self._ledger.standings([w.tk for w in work])
        steady = [
            (w, nonce) for w, nonce, then in zip(work, nonces, second, strict=True)
            if (w.standing.chunks, w.standing.tail) == (then.chunks, then.tail)
        ]  # fmt: skip
        # What no pool took, as of a robot without money, needs no room.
        room = 2 * head.gas_limit - sum(
            batch.gas for w, (latest, pending) in zip(work, nonces, strict=True)
            for batch in self._known[w.tk].flights[: max(pending - latest, 0)]
        )  # fmt: skip
        outbox: list[tuple[Account, Fees, bytes]] = []
        for w, (latest, pending) in sorted(steady, key=lambda item: item[0].oldest):
            account = self._known[w.tk]
            try:
                rows = self._rows(w, account, now)
                self._reconcile(account, w.standing, rows, latest, now)
                if (again := self._again(account, latest, pending, now)) is None:
                    continue
                new = self._batches(w, account, rows, head, room, now)
            except _Hold as why:
                account.hold = str(why)
                continue
            room -= sum(batch.gas for batch in new)
            account.flights += new
            for number, batch in list(enumerate(account.flights, latest))[again:]:
                outbox.append((account, account.fees or self._fees, self._signed(w.tk, account, number, batch)))
                if sum(len(raw) for _, _, raw in outbox) > SEND_BYTES:
                    self._flush(outbox)
        self._flush(outbox)

    def _reconcile(self, account: Account, standing: Standing, rows: Sequence[Row], latest: int, now: float) -> None:
        """What became of the transactions in flight, by the account's nonce and the contract's count."""
        done = 0 if account.nonce is None else latest - account.nonce
        mined, account.flights = account.flights[: max(done, 0)], account.flights[max(done, 0) :]
        expected = mined[-1].end if mined else account.flights[0].first if account.flights else standing.chunks
        if done < 0 or expected != standing.chunks:
            account.flights, account.careful = [], True
            self.counts["surprises"] += 1
        elif mined:
            account.careful = False
        flown = [(row.position, row.digest) for batch in account.flights for row in batch.rows]
        if flown != [(row.position, row.digest) for row in rows[: len(flown)]]:
            account.flights = []  # the rows are others now, or stand elsewhere: robots filled a lost inbox again
        if done or account.nonce is None:
            account.since = now
        account.nonce = latest

    def _again(self, account: Account, latest: int, pending: int, now: float) -> int | None:
        """From which of its flights on the account is to send again; None: it waits for what is in the pool."""
        in_pool, flights = max(pending - latest, 0), len(account.flights)
        if in_pool and account.due(now):
            # Stuck, or somebody else's.
            account.fees = self._fees.at_least((account.fees or self._fees).raised()).limited(self._settings.max_fee)
            account.since = now
            self.counts["raised"] += 1
            return 0
        if in_pool > flights:
            return None
        account.fees = self._fees.at_least(account.fees) if flights and account.fees else self._fees
        self.counts["again"] += flights - in_pool
        return in_pool

    def _batches(
        self, work: Work, account: Account, rows: Sequence[Row], head: Block, room: int, now: float
    ) -> list[Batch]:
        """New ones behind those in flight, as many as may be: among all of them one that is not full."""
        flown = sum(len(batch.rows) for batch in account.flights)
        rest, new = list(rows[flown:]), list[Batch]()
        front = rows[flown - 1].hash if flown else work.standing.tail
        first = work.standing.chunks + flown
        while rest and len(account.flights) + len(new) < (1 if account.careful else IN_FLIGHT):
            batch = _cut(first, front, rest, min(head.gas_limit // 2, BATCH_GAS))
            if not batch.full and not all(other.full for other in [*account.flights, *new]):
                break
            if batch.gas > room - sum(other.gas for other in new):
                break
            if account.careful:
                self._try(work, account, batch, now)
            used = contract.set_data_cost([row.size for row in batch.rows])
            if not self._affords(account, used, now):
                account.hold = "it used the gas of its day (gas_per_day); more comes by the hour"
                break
            account.hold = None
            self.gas[work.tk] += used
            new.append(batch)
            rest, first, front = rest[len(batch.rows) :], batch.end, batch.rows[-1].hash
        self.counts["sent"] += len(new)
        return new

    def _try(self, work: Work, account: Account, batch: Batch, now: float) -> None:
        """_Hold if the contract would refuse it; asked again every PATIENCE."""
        if account.hold is not None and not account.due(now):
            raise _Hold(account.hold)
        try:
            self._ledger.call(work.standing.account or "", self._calldata(work.tk, batch), gas=batch.gas)
        except Reverted as error:
            account.since = now
            raise _Hold(str(error)) from error

    def _affords(self, account: Account, gas: int, now: float) -> bool:
        """Take the gas from what the robot may use. gas_per_day flows in; an hour's at most is kept, and there after a
        start: so much a robot gone mad, or who stole its key, can spend at once.
        """
        a_second = self._settings.gas_per_day / DAY
        account.gas = min(BURST * a_second, account.gas + max(0.0, now - account.gas_at) * a_second)
        account.gas_at = now
        if account.gas < min(gas, BURST * a_second):  # a batch above an hour's gas takes that of the hours after it
            return False
        account.gas -= gas
        return True

    def _calldata(self, tk: bytes, batch: Batch) -> bytes:
        chunks = self._inbox.chunks(tk, [row.position for row in batch.rows])
        return self._ledger.calldata("setData", tk, batch.first, batch.tail, chunks)

    def _signed(self, tk: bytes, account: Account, nonce: int, batch: Batch) -> bytes:
        key, fees = self._account(tk), account.fees or self._fees
        if key is None:
            raise ChainError("the key of a robot's account is gone")
        return self._ledger.sign(key, self._calldata(tk, batch), nonce=nonce, gas=batch.gas, fees=fees).raw

    def _flush(self, outbox: list[tuple[Account, Fees, bytes]]) -> None:
        answers = self._ledger.send([raw for _, _, raw in outbox]) if outbox else []
        for (account, offered, _), error in zip(outbox, answers, strict=True):
            match error:
                case None | AlreadyKnown() | OutOfFunds():
                    pass  # an account that is out of funds is topped up
                case NonceTooLow():
                    account.nonce, account.flights = None, []
                case Underpriced():
                    account.fees = offered.raised().limited(self._settings.max_fee)
                    self.trouble = str(error) if account.fees == offered else self.trouble
                case _:
                    self.trouble = str(error)
        outbox.clear()

    # ------------------------------------------------------------------ money

    def _top_up(self, work: Sequence[Work], nonces: tuple[int, int], now: float) -> None:
        """allocETH for accounts that have work and less than low water, or than what is in flight may cost; nothing
        while the operator's last transactions are in no block.
        """
        funds, (latest, pending) = self._funds, nonces
        if funds.nonce != latest:
            funds.nonce, funds.since = latest, now
        poor = []
        for w in work:
            account = self._known[w.tk]
            cost = sum(batch.gas for batch in account.flights) * (account.fees or self._fees).highest
            if w.standing.balance < min(max(self._settings.low_water, cost), contract.BALANCE_LIMIT // 2):
                poor.append(w.standing)
        if not poor:
            self.funds = None
        if self._operator is None or not poor or (pending > latest and not funds.due(now)):
            return
        stuck = pending > latest
        funds.fees = self._fees.at_least(funds.fees.raised()) if stuck and funds.fees else self._fees
        funds.since = now
        self.operator_balance = left = self._ledger.balance(self._operator.address)
        self.funds, raws = None, list[bytes]()
        for standing in sorted(poor, key=lambda standing: standing.balance)[:TOP_UPS]:
            data = self._ledger.calldata("allocETH", standing.account)
            wei = min(self._settings.top_up, contract.BALANCE_LIMIT - standing.balance)
            left -= wei + contract.call_gas(data) * funds.fees.highest
            if left < 0:
                self.funds = f"the operator's account {self._operator.address} is empty; pay something into it"
                break
            nonce, gas = latest + len(raws), contract.call_gas(data)
            raws.append(self._ledger.sign(self._operator, data, nonce=nonce, gas=gas, fees=funds.fees, value=wei).raw)
        for error in self._ledger.send(raws):
            if error is None:
                self.counts["top-ups"] += 1
            elif not isinstance(error, AlreadyKnown):
                self.funds = str(error)


def _cut(first: int, tail: bytes, rows: Sequence[Row], most: int) -> Batch:
    """As many rows as one transaction takes, one at least."""
    count, size, gas = 0, 0, contract.set_data_gas([])
    for row in rows:
        more = contract.set_data_gas([row.size]) - contract.set_data_gas([])
        if count and (size + row.size > BATCH_BYTES or gas + more > most):
            break
        count, size, gas = count + 1, size + row.size, gas + more
    return Batch(first, tail, tuple(rows[:count]), gas, count < len(rows))

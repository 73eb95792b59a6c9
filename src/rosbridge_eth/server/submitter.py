"""Brings what is in the store onto the chain: look, compare, send what is missing. Level-triggered, without a journal.

A turn looks at how every robot stands in the contract (how many chunks, the hash of the last: `tail`), finds the row
with that hash in the store, and sends what follows it up to the store's head, in batches. The contract takes a batch
only if it follows what is there, so nothing can be written twice or out of order, whatever is sent; all that is
decided here is what not to waste gas on. What is in flight is kept in memory only; after a restart it is waited for.

    the tail is neither a row nor in front of the first   the store's head is set to that chunk, which the contract's
    one: the store was lost or put back from an old       last event has; the robot is told so, and sends what follows
    copy, or another submitter writes for the robot
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
from typing import TYPE_CHECKING, Any, NamedTuple

from eth_hash.auto import keccak

from rosbridge_eth.errors import ChainError
from rosbridge_eth.ledger import contract
from rosbridge_eth.ledger.contract import Block, Fees, Ledger, Standing
from rosbridge_eth.ledger.transport import AlreadyKnown, NonceTooLow, OutOfFunds, Reverted, Underpriced
from rosbridge_eth.log.chunk import Chunk, Header, Malformed
from rosbridge_eth.log.store import NOWHERE, Row, State, Store, place_of

if TYPE_CHECKING:
    from eth_account.signers.local import LocalAccount

BATCH_BYTES = 96 * 1024  # nodes take transactions of 128 KiB
BATCH_GAS = 8_000_000
IN_FLIGHT = 8  # transactions of one account; geth's pool has room for 16 of each
PATIENCE = 30.0  # seconds without progress, before something is done about it
BUSY, IDLE, LONGEST_PAUSE = 0.25, 1.0, 30.0  # seconds to the next turn
SEND_BYTES = 2**22  # of transactions, handed to the node at once
TOP_UPS = 20  # sent together; the next ones when all of them are in blocks
ROWS = IN_FLIGHT * BATCH_BYTES // 203  # no chunk is smaller than 203 bytes
_MOST = contract.BALANCE_LIMIT // 2  # that is waited for on an account
MINUTE, HOUR, DAY = 60.0, 3600.0, 86_400.0
BURST = HOUR  # seconds of a robot's gas that it may use at once


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


class Look(NamedTuple):
    """A robot in the contract, there at the block that confirms (None: not known), and in the store."""

    standing: Standing
    then: Standing | None
    state: State


@dataclass(slots=True)
class Account:
    """What is remembered of a robot, and of the operator, between two turns."""

    nonce: int | None = None  # of the first in flight
    flights: list[Batch] = field(default_factory=list)
    fees: Fees | None = None  # what those offer
    since: float = 0.0  # of the last progress
    careful: bool = False  # the next batch is tried first
    hold: str = ""  # why nothing is written
    quiet: Look | None = None  # the last look, where it found nothing to do
    final: tuple[bytes, bytes] = (contract.NOTHING, NOWHERE)  # hash and place of the last chunk that is confirmed
    gas: float = 0.0  # that may be used now
    gas_at: float = 0.0

    def due(self, now: float) -> bool:
        """Whether PATIENCE is over; also where the clock was put back."""
        return not 0 <= now - self.since < PATIENCE


class Work(NamedTuple):
    """A robot with rows that are not on the chain: those behind the place `after`, up to `head`."""

    tk: bytes
    standing: Standing
    after: bytes
    head: bytes
    oldest: float


class _Hold(Exception):
    """Nothing is to be written for this robot now, and why."""


class Submitter:
    """The one that writes. `turn` does what there is to do now.

    robots: the Tk of the registered robots that it writes for. account: the key that writes for a robot, None where
    there is none; asked often. operator: pays for the robots' accounts, None where somebody else does; `others`: the Tk
    of robots that are written for elsewhere and paid for here.
    """

    def __init__(
        self, ledger: Ledger, store: Store, robots: Callable[[], Collection[bytes]],
        account: Callable[[bytes], LocalAccount | None], operator: LocalAccount | None, settings: Settings,
        others: Callable[[], Collection[bytes]] = tuple,
    ) -> None:  # fmt: skip
        self._ledger, self.store, self._robots, self._others = ledger, store, robots, others
        self._account, self._operator, self._settings = account, operator, settings
        self._known: dict[bytes, Account] = {}
        self._funds, self._paid = Account(), list[Standing]()
        self._fees = Fees(0, 0)
        self._pause = IDLE
        self._looked_at = self._minute_at = self._hour_at = 0.0
        self.trouble: str | None = None  # why nothing can be written at all
        self.unconfirmed: str | None = None  # why nothing can be confirmed
        self.funds: str | None = None  # why accounts are not topped up
        self.head: Block | None = None
        self.operator_balance: int | None = None  # the operator's, wei, a minute old at most
        self.standings: Mapping[bytes, Standing] = {}  # at the last look
        self.gas: Counter[bytes] = Counter()  # that the transactions sent for each robot use
        self.counts: Counter[str] = Counter()

    def turn(self, now: float) -> float:
        """now: seconds since 1970. Seconds until the next turn is wanted. StoreError passes through."""
        try:
            if self.head is None or self.trouble is not None:  # whose place another chain may have taken
                self._ledger.check()
            head = self._ledger.block()
            if head == self.head and 0 <= now - self._looked_at < IDLE:
                return BUSY
            self.head, self._looked_at = head, now
            self.trouble = None
            if minute := not 0 <= now - self._minute_at < MINUTE:
                self._minute_at = now
                self.operator_balance = self._ledger.balance(self._operator.address) if self._operator else None
                self._paid = self._ledger.standings(list(self._others())) if self._operator else []
            busy = self._look(head, now)
            if minute:
                self._forget(now)
        except ChainError as error:
            self.trouble, self._looked_at = str(error), float("-inf")
            self._pause = min(2 * self._pause, LONGEST_PAUSE)
            return self._pause
        self._pause = IDLE
        return BUSY if busy else IDLE

    def _forget(self, now: float) -> None:
        """Confirmed rows that are a day old, looked for once an hour, or fill half of a robot's share."""
        half, hour = self.store.max_bytes_per_robot // 2, not 0 <= now - self._hour_at < HOUR
        self._hour_at = now if hour else self._hour_at
        for tk, size in self.store.sizes().items():
            if tk in self.standings and (hour or size > half):
                self.store.forget(tk, now - DAY, half)

    # ------------------------------------------------------------------ look

    def _look(self, head: Block, now: float) -> bool:
        """Whether there is something to send or in flight."""
        self._fees = self._ledger.fees(head).limited(self._settings.max_fee)
        # Before the balances: what is in a block by now is in them, so nobody is topped up twice.
        [funds] = self._ledger.nonces([self._operator.address]) if self._operator else [(0, 0)]
        robots = list(self._robots())
        self.standings = standings = dict(zip(robots, self._ledger.standings(robots), strict=True))
        then = self._then(robots, head)
        work = []
        for tk, state in zip(robots, self.store.states(robots), strict=True):
            account = self._known.setdefault(tk, Account(gas=self._settings.gas_per_day * BURST / DAY, gas_at=now))
            look = Look(standings[tk], then.get(tk), state)
            if look != account.quiet:
                found = self._look_at(tk, account, look)
                work += found
                account.quiet = None if found or account.hold else look
        if head.base_fee is not None and head.base_fee > self._settings.max_fee:
            self.trouble = f"a unit of gas costs {head.base_fee / 10**9:.1f} gwei, which is above max_fee_gwei"
        else:
            if work:
                self._send(work, head, now)
            self._top_up(work, funds, now)
        return bool(work)

    def _then(self, robots: Sequence[bytes], head: Block) -> Mapping[bytes, Standing]:
        """How the robots stood at the newest block that counts as confirmed."""
        block = head.number - self._settings.confirmations + 1
        if block <= 0 or self._settings.confirmations == 1:
            return self.standings if block > 0 else {}
        try:
            then = self._ledger.standings(robots, block)
        except ChainError as error:
            self.unconfirmed = f"the node does not tell how block {block} was: {error}"
            return {}
        self.unconfirmed = None
        return dict(zip(robots, then, strict=True))

    def _look_at(self, tk: bytes, account: Account, look: Look) -> list[Work]:
        """Compare one robot's log in the store with what the chain has of it; what there is to send."""
        standing, then, state = look
        found: list[Work] = []
        changes: dict[str, Any] = {}
        try:
            after = self._place(tk, standing, state)
            if then is not None:
                changes = self._confirmed(tk, account, then, state)
            changes["certificates"] = contract.NOTHING if standing.revoked else standing.certificates_hash
            self._may_write(tk, standing)
            if after is not None and (rows := self.store.rows(tk, after, 1)) and rows[0].place <= state.head:
                found.append(Work(tk, standing, after, state.head, rows[0].taken_at))
            else:
                account.hold, account.flights = "", []
        except _Hold as why:
            account.hold, account.flights = str(why), []
        changes["hold"] = account.hold
        if any(getattr(state, name) != value for name, value in changes.items()):
            self.store.set_state(tk, **changes)
        return found

    def _place(self, tk: bytes, standing: Standing, state: State) -> bytes | None:
        """The place behind which the rows are not on the chain; None: the store followed the chain just now."""
        if standing.tail == state.base or standing.account is None:
            return NOWHERE
        place = self.store.find(tk, standing.tail)
        if place is not None and place <= state.head:
            return place
        self.store.follow(tk, standing.tail, self._last(tk, standing))
        self.counts["followed"] += 1
        return None

    def _confirmed(self, tk: bytes, account: Account, then: Standing, state: State) -> dict[str, Any]:
        """What the state is to say of the last chunk that is confirmed; nothing new where it is not known."""
        if then.tail != account.final[0]:
            place = NOWHERE if not then.chunks else self.store.find(tk, then.tail)
            if place is None and then.tail == state.base and (header := self._last(tk, then)):
                place = place_of(header)  # the store followed the chain, and has no row of it
            if place is None:
                return {}
            account.final = (then.tail, place)
        return {"confirmed": account.final[1], "block": then.data_block}

    def _last(self, tk: bytes, standing: Standing) -> Header | None:
        """The header of the robot's last chunk on the chain, None if it has none."""
        if not standing.chunks:
            return None
        try:
            event = next(self._ledger.newest_data(tk, standing.data_block), None)
        except ChainError as error:
            raise _Hold(f"its last chunk on the chain cannot be read: {error}") from error
        chunk = event.chunks[-1] if event and event.chunks else b""
        if keccak(chunk) != standing.tail:
            raise _Hold("the chain changed while its last chunk was read")
        try:
            return Chunk.parse(chunk).header
        except Malformed as error:
            raise _Hold(f"what another program wrote is on the chain: {error}") from error

    def _may_write(self, tk: bytes, standing: Standing) -> None:
        key = self._account(tk)
        if standing.account is None:
            raise _Hold("it is not registered in the contract")
        if standing.revoked:
            raise _Hold("it is revoked")
        if key is None or key.address != standing.account:
            raise _Hold(f"it writes with account {standing.account}, whose key is not here")

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
                rows = [row for row in self.store.rows(w.tk, w.after, ROWS) if row.place <= w.head]
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
        flown = [row.hash for batch in account.flights for row in batch.rows]
        if flown != [row.hash for row in rows[: len(flown)]]:
            account.flights = []  # the rows are others now: the store was lost and filled again
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
            account.hold = ""
            self.gas[work.tk] += used
            new.append(batch)
            rest, first, front = rest[len(batch.rows) :], batch.end, batch.rows[-1].hash
        self.counts["sent"] += len(new)
        return new

    def _try(self, work: Work, account: Account, batch: Batch, now: float) -> None:
        """_Hold if the contract would refuse it; asked again every PATIENCE."""
        if account.hold and not account.due(now):
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
        chunks = self.store.chunks(tk, [row.place for row in batch.rows])
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
        """allocETH for accounts with less than low water, or than what is in flight may cost (elsewhere: one batch),
        here only where there is work; nothing while the operator's last transactions are in no block.
        """
        funds, (latest, pending) = self._funds, nonces
        if funds.nonce != latest:
            funds.nonce, funds.since = latest, now
        enough = max(self._settings.low_water, BATCH_GAS * self._fees.highest)
        poor = [s for s in self._paid if s.account and not s.revoked and s.balance < min(enough, _MOST)]
        for w in work:
            account = self._known[w.tk]
            cost = sum(batch.gas for batch in account.flights) * (account.fees or self._fees).highest
            if w.standing.balance < min(max(self._settings.low_water, cost), _MOST):
                poor.append(w.standing)
        if not poor:
            self.funds = None
        if self._operator is None or not poor or (pending > latest and not funds.due(now)):
            return
        stuck = pending > latest
        funds.fees = self._fees.at_least(funds.fees.raised()) if stuck and funds.fees else self._fees
        funds.since = now
        self.operator_balance = left = self._ledger.balance(self._operator.address)
        self.funds, raws, paid = None, list[bytes](), list[Standing]()
        for standing in sorted(poor, key=lambda standing: standing.balance)[:TOP_UPS]:
            data = self._ledger.calldata("allocETH", standing.account)
            wei = min(self._settings.top_up, contract.BALANCE_LIMIT - standing.balance)
            left -= wei + contract.call_gas(data) * funds.fees.highest
            if left < 0:
                self.funds = f"the operator's account {self._operator.address} is empty; pay something into it"
                break
            nonce, gas = latest + len(raws), contract.call_gas(data)
            raws.append(self._ledger.sign(self._operator, data, nonce=nonce, gas=gas, fees=funds.fees, value=wei).raw)
            paid.append(standing)
        for standing, error in zip(paid, self._ledger.send(raws), strict=True):
            if error is None:
                self.counts["top-ups"] += 1
            elif not isinstance(error, AlreadyKnown):
                self.funds = str(error)
                continue
            self._paid = [other for other in self._paid if other.account != standing.account]


def _cut(first: int, tail: bytes, rows: Sequence[Row], most: int) -> Batch:
    """As many rows as one transaction takes, one at least."""
    count, size, gas = 0, 0, contract.set_data_gas([])
    for row in rows:
        more = contract.set_data_gas([row.size]) - contract.set_data_gas([])
        if count and (size + row.size > BATCH_BYTES or gas + more > most):
            break
        count, size, gas = count + 1, size + row.size, gas + more
    return Batch(first, tail, tuple(rows[:count]), gas, count < len(rows))

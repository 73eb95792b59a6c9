"""Brings sealed batches onto the chain: what to ask a node next, and what its answers mean.

Sans-IO: `actions(now)` says what to ask, `handle(action, answer, now)` takes the
answer, a value or a NodeFailure; pump.py stands between this and a Chain. The
state of every transaction is in the journal and moves by states.TRANSITIONS
alone; what is kept here besides are views of the chain and times to try again,
and losing those costs a question.

One round: the head; the accounts in use; then for every job what its state asks for.

    SEALED     estimate the gas, take a nonce, sign, keep           -> READY
    READY      hand the kept bytes to the node                      -> PENDING
    PENDING    once the account's nonce has passed, ask for receipts -> INCLUDED
               not mined: known to the node? fee too low? -> the same bytes again, a higher fee,
               or, if nothing keeps a node from mining it and it does not, halves
    INCLUDED   is its block still the chain's, and N deep?          -> CONFIRMED
    CONFIRMED  is the highest such block still the chain's?         else -> PENDING

Nothing is dropped for lack of money, of a node, or of permission: such batches
wait and `status` says for what. Only a record that can never be written becomes
a dead letter. Nothing is written twice: a batch keeps its index until it is
settled, and the contract takes one batch per index.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, TypeAlias

from rosbridge_eth.ledger import batching
from rosbridge_eth.ledger.batching import Limits
from rosbridge_eth.ledger.chain import Block, Call, Receipt
from rosbridge_eth.ledger.contract import BALANCE_LIMIT, calldata, explain
from rosbridge_eth.ledger.failures import (
    AlreadyKnown,
    GasRefused,
    InsufficientFunds,
    NodeFailure,
    NonceTooLow,
    RateLimited,
    Reverted,
    TooLarge,
    Underpriced,
)
from rosbridge_eth.ledger.journal import Attempt, Job, Journal, Lease
from rosbridge_eth.ledger.states import IN_FLIGHT, Event, Kind, State
from rosbridge_eth.ledger.transactions import Fees, Transaction, sign
from rosbridge_eth.records import RecordId, SealedRecord

if TYPE_CHECKING:
    from eth_account.signers.local import LocalAccount

WEI_PER_ETH = 10**18
_NOT_ALLOWED = ("NotRegistered", "NotTheRobot", "AlreadyRevoked")  # the contract's reasons against a robot
_ALLOC_NOT_ALLOWED = ("NotOperator", "AccountNotRegistered", "AboveLimit")


@dataclass(frozen=True, slots=True)
class Settings:
    """How the submitter behaves. Times in seconds, amounts in wei."""

    limits: Limits = field(default_factory=Limits)
    confirmations: int = 3  # blocks, the one that holds the transaction included
    max_in_flight: int = 8  # transactions of one account that wait for a block; nodes keep 16 (geth: AccountSlots)
    poll: float = 1.0  # between two looks at the chain
    bump_after: float = 30.0  # without a block, before the fee is raised
    probe_after: float = 10.0  # without a block, before the node is asked whether it still has it
    stuck_blocks: int = 10  # mined past a transaction that could pay, before it counts as one that never will be
    stuck_bumps: int = 2  # and so often its fee was raised
    gas_margin: int = 20  # percent over the estimate
    max_fee: int = 500 * 10**9  # per gas; above it the submitter waits
    low_water: int = WEI_PER_ETH // 10  # an account below this is topped up
    top_up: int = WEI_PER_ETH  # by this much
    lease: float = 30.0  # how long a dead submitter's accounts stay its own
    retry: float = 1.0  # after a failure, doubled each time
    max_retry: float = 60.0


# ---------------------------------------------------------------------- what is asked of a node


@dataclass(frozen=True, slots=True)
class ReadHead:
    """Answer: (Block, tip suggested)."""


@dataclass(frozen=True, slots=True)
class ReadAccount:
    """Answer: AccountView. `deep_block`: the height whose blocks count as final."""

    account: str
    deep_block: int


@dataclass(frozen=True, slots=True)
class ReadBlock:
    """Is the block at this height still the one with this hash? Answer: Block or None."""

    number: int
    hash: bytes


@dataclass(frozen=True, slots=True)
class EstimateGas:
    """Answer: gas."""

    job: int
    call: Call


@dataclass(frozen=True, slots=True)
class Broadcast:
    """Answer: for each, its hash or a NodeFailure."""

    attempts: tuple[Attempt, ...]


@dataclass(frozen=True, slots=True)
class FetchReceipts:
    """Has one of the transactions with this nonce been mined? Answer: Receipt or None, for each."""

    account: str
    nonce: int
    attempts: tuple[Attempt, ...]


@dataclass(frozen=True, slots=True)
class Probe:
    """Does the node still have it? Answer: bool."""

    job: int
    tx_hash: bytes


Action: TypeAlias = ReadHead | ReadAccount | ReadBlock | EstimateGas | Broadcast | FetchReceipts | Probe


@dataclass(frozen=True, slots=True)
class AccountView:
    """An account as of the head: transactions mined, those mined for good, wei."""

    nonce: int
    deep_nonce: int
    balance: int


Answer: TypeAlias = (
    NodeFailure
    | tuple[Block, int]
    | AccountView
    | Block
    | int
    | bool
    | list[bytes | NodeFailure]
    | list[Receipt | None]
    | None
)


# ---------------------------------------------------------------------- what people are told


@dataclass(frozen=True, slots=True)
class BatchTiming:
    """A confirmed batch: seconds from sealed to accepted by a node, from there into a block, and N blocks deep."""

    job: int
    robot: bytes
    records: int
    submit: float
    include: float
    confirm: float
    block_number: int
    tx_hash: bytes
    gas_used: int


@dataclass(frozen=True, slots=True)
class Status:
    """Why things are as they are."""

    head: Block | None
    states: dict[State, int]
    balances: dict[str, int]
    blocked: dict[bytes, str]  # robots the contract does not let write, and why
    treasury_empty: bool
    fee_capped: bool  # the market asks more than Settings.max_fee
    not_ours: tuple[str, ...]  # accounts another submitter holds
    failure: str | None  # the last one of the node, None once it answers again


@dataclass(frozen=True, slots=True)
class Sealing:
    """What became of records given to `seal`: all of them are safe now."""

    jobs: tuple[Job, ...]
    known: tuple[RecordId, ...]  # were in the journal already
    dead: tuple[RecordId, ...]  # can be in no batch


@dataclass(slots=True)
class _Retry:
    """When to ask again after failures, later each time."""

    at: float = 0.0
    failures: int = 0

    def failed(self, now: float, settings: Settings, wait: float | None = None) -> None:
        pause = min(settings.retry * 2**self.failures, settings.max_retry)
        self.failures += 1
        self.at = now + (pause if wait is None else max(wait, pause))

    def wait(self, until: float) -> None:
        self.at = until

    def succeeded(self) -> None:
        self.at, self.failures = 0.0, 0


@dataclass(slots=True)
class _Wait:
    """How long the lowest nonce of an account has stood still although nothing was in its way."""

    job: int
    tx_hash: bytes
    since_block: int


class Submitter:
    """For all robots of one contract.

    account_of: the account a robot (Tk) signs with now, None if there is none.
    operator: pays top-ups from its own balance, the treasury; None: there are none.
    holder: names this process in the leases.
    """

    def __init__(
        self,
        journal: Journal,
        *,
        contract: str,
        chain_id: int,
        account_of: Callable[[bytes], LocalAccount | None],
        operator: LocalAccount | None,
        holder: str,
        settings: Settings | None = None,
    ) -> None:
        self._journal = journal
        self._contract = contract
        self._chain_id = chain_id
        self._account_of = account_of
        self._operator = operator
        self._holder = holder
        self._settings = settings or Settings()
        self._jobs = {job.id: job for job in journal.jobs()}
        self._leases: dict[str, Lease] = {}
        self._not_ours: set[str] = set()
        self._stale = False  # an account came to us that another submitter may have acted for
        self._head: Block | None = None
        self._tip = 0
        self._views: dict[str, AccountView] = {}
        self._views_of: dict[str, bytes] = {}  # the head a view is of
        self._blocks_checked: dict[int, bytes] = {}  # height -> the head it was checked at
        self._settled: Job | None = None  # the highest, and the head at which it was looked up
        self._settled_of: bytes | None = None
        self._next_poll = 0.0
        self._asked: set[Action] = set()
        self._node = _Retry()
        self._retries: dict[int, _Retry] = {}
        self._receipts_at: dict[tuple[str, int], bytes] = {}  # nonce -> the head its receipts were asked at
        self._probed: dict[int, float] = {}
        self._waits: dict[str, _Wait] = {}
        self._blocked: dict[bytes, str] = {}
        self._poor: set[str] = set()  # accounts a node or the contract called so
        self._treasury_empty = False
        self._fee_capped = False
        self._failure: str | None = None
        self._timings: list[BatchTiming] = []

    # ------------------------------------------------------------------ for the server

    def seal(self, records: Iterable[SealedRecord], now: float) -> Sealing:
        """Take records over: when this returns they are on disk here. One robot's stay in order."""
        by_robot: dict[bytes, list[SealedRecord]] = {}
        known: list[RecordId] = []
        dead: list[RecordId] = []
        with self._journal.transaction():
            records = list({record.id: record for record in records}.values())
            had = self._journal.known(record.id for record in records)
            for record in records:
                reason = batching.refusal(record, self._settings.limits)
                if record.id in had:
                    known.append(record.id)
                elif reason is not None:
                    self._journal.bury(record, reason, now)
                    dead.append(record.id)
                else:
                    by_robot.setdefault(record.id.robot, []).append(record)
            batches = [batch for mine in by_robot.values() for batch in batching.plan(mine, self._settings.limits)]
            jobs = self._journal.seal(batches, now)
        self._jobs.update((job.id, job) for job in jobs)
        return Sealing(tuple(jobs), tuple(known), tuple(dead))

    def confirmed(self) -> list[Job]:
        """Batches N blocks deep that nobody has acknowledged yet."""
        return [job for job in self._journal.jobs((State.CONFIRMED,)) if job.kind is Kind.BATCH]

    def acknowledge(self, jobs: Sequence[Job]) -> None:
        """Those who waited for these batches know."""
        self._journal.acknowledged(jobs)

    def idle(self) -> bool:
        """Is nothing on its way?"""
        return not self._jobs

    def backlog(self) -> int:
        """Batches on their way; whoever seals more should mind it.

        Those of robots that may not write are not counted: they can wait for ever, and others must not wait with them.
        """
        return sum(1 for job in self._jobs.values() if job.kind is Kind.BATCH and job.robot not in self._blocked)

    def timings(self) -> list[BatchTiming]:
        """Of the batches confirmed since the last call."""
        timings, self._timings = self._timings, []
        return timings

    def status(self) -> Status:
        return Status(
            self._head,
            self._journal.counts(),
            {account: view.balance for account, view in self._views.items()},
            dict(self._blocked),
            self._treasury_empty,
            self._fee_capped,
            tuple(sorted(self._not_ours)),
            self._failure,
        )

    def close(self) -> None:
        """Give the leases back."""
        for lease in self._leases.values():
            self._journal.release(lease)
        self._leases.clear()

    # ------------------------------------------------------------------ asking

    def next_timer(self, now: float) -> float:
        """When `actions` will have something at the latest."""
        return max(now, self._node.at, self._next_poll)

    def actions(self, now: float) -> list[Action]:
        """What to ask now, in this order; each is asked once until it is answered."""
        if now < self._node.at:
            return []
        head = None if now >= self._next_poll else self._head
        wanted: list[Action] = [ReadHead()] if head is None else self._round(head, now)
        if self._stale and head is not None:
            self._jobs = {job.id: job for job in self._journal.jobs()}
            waiting = {job.robot for job in self._jobs.values()}
            self._blocked = {robot: why for robot, why in self._blocked.items() if robot in waiting}
            self._stale = False
            wanted = self._round(head, now)
        fresh = [action for action in wanted if action not in self._asked]
        self._asked.update(fresh)
        return fresh

    def _round(self, head: Block, now: float) -> list[Action]:
        jobs = self._jobs_by_account()
        accounts = self._accounts_in_use(jobs, now)
        deep = max(0, head.number - self._settings.confirmations + 1)
        stale = [a for a in accounts if self._views_of.get(a) != head.hash]
        if stale:
            return [ReadAccount(account, deep) for account in stale]
        wanted: list[Action] = list(self._blocks_to_check(head))
        for account in accounts:
            if self._operator is not None and account == self._operator.address:
                jobs = self._jobs_by_account()  # with the top-ups that the others have just asked for
            wanted += self._for_account(account, jobs.get(account, []), head, now)
        return wanted

    def _jobs_by_account(self) -> dict[str, list[Job]]:
        jobs: dict[str, list[Job]] = {}
        for job in self._jobs.values():
            account = self._account_for(job)
            if account is not None:
                jobs.setdefault(account, []).append(job)
        return jobs

    def _accounts_in_use(self, jobs: Iterable[str], now: float) -> list[str]:
        """Of the accounts with jobs those that this submitter may act for, the operator's last."""
        names = list(jobs)
        if self._operator is not None and names:
            names = [name for name in names if name != self._operator.address]
            names.append(self._operator.address)
        return [name for name in names if self._leased(name, now)]

    def _account_for(self, job: Job) -> str | None:
        if job.account is not None:
            return job.account
        signer = self._operator if job.kind is Kind.TOP_UP else self._account_of(job.robot)
        if signer is None:
            self._blocked[job.robot] = "there is no account for this robot; register it"
            return None
        return signer.address

    def _leased(self, account: str, now: float) -> bool:
        lease = self._leases.get(account)
        if lease is None or now > lease.expires - self._settings.lease / 2:
            lease = self._journal.lease(account, self._holder, now, self._settings.lease)
            if lease is None:
                self._leases.pop(account, None)
                self._not_ours.add(account)
                return False
            mine = self._leases.get(account)
            self._stale = self._stale or mine is None or mine.token != lease.token
            self._leases[account] = lease
            self._not_ours.discard(account)
        return True

    def _blocks_to_check(self, head: Block) -> Iterable[ReadBlock]:
        """Blocks that hold what is not settled, and the highest of those that do."""
        blocks = {job.block_number: job.block_hash for job in self._jobs.values() if job.state is State.INCLUDED}
        if self._settled_of != head.hash:
            self._settled, self._settled_of = self._journal.highest_settled(), head.hash
        if self._settled is not None:
            blocks.setdefault(self._settled.block_number, self._settled.block_hash)
        for number, hash in sorted(blocks.items(), key=lambda item: item[0] or 0):
            if number is not None and hash is not None and self._blocks_checked.get(number) != head.hash:
                yield ReadBlock(number, hash)

    def _for_account(self, account: str, mine: Sequence[Job], head: Block, now: float) -> list[Action]:
        view = self._views[account]
        robot = next((job.robot for job in mine if job.kind is not Kind.TOP_UP), b"")
        with_nonce = sorted((job for job in mine if job.nonce is not None and job.state in _UNMINED), key=_nonce)
        for nonce in sorted({_nonce(job) for job in with_nonce if _nonce(job) < view.nonce}):
            if self._receipts_at.get((account, nonce)) != head.hash:
                return [FetchReceipts(account, nonce, tuple(self._journal.attempts(account, nonce)))]
        self._fill_gaps(account, robot, view, now)
        in_flight = [job for job in with_nonce if job.state in IN_FLIGHT]
        first = next((job for job in in_flight if job.nonce == view.nonce), None)
        wanted = [] if first is None else self._urge(first, view, head, now)
        now_so = (self._jobs.get(job.id) for job in in_flight)  # as they are after that
        in_flight = [job for job in now_so if job is not None and job.state in IN_FLIGHT]
        ready = [job for job in in_flight if job.state is State.READY and self._due(job, now)]
        if ready:
            wanted.append(Broadcast(tuple(self._journal.latest_attempt(job) for job in ready)))
        self._mind_balance(account, view, mine, now)
        room = self._settings.max_in_flight - len(in_flight)
        spendable = view.balance - sum(_cost(job) for job in in_flight if _nonce(job) >= view.nonce)
        tried: set[bytes] = set()
        for job in sorted((job for job in mine if job.state is State.SEALED), key=_order):
            if job.nonce is None and (room <= 0 or job.held_nonce is not None):
                continue
            if job.kind is Kind.TOP_UP and job.nonce is None and self._needless(job):
                self._drop_top_up(job, "the account has enough again", now)
                continue
            if job.robot in tried and (job.robot in self._blocked or account in self._poor):
                continue  # one is enough to find out whether it is so still
            tried.add(job.robot)
            if self._due(job, now) and self._affordable(job, spendable, head):
                room -= job.nonce is None
                wanted.append(EstimateGas(job.id, self._call(job, account)))
        return wanted

    def _due(self, job: Job, now: float) -> bool:
        retry = self._retries.get(job.id)
        return retry is None or now >= retry.at

    def _affordable(self, job: Job, spendable: int, head: Block) -> bool:
        """A first look, before the estimate: what is surely too dear waits for a top-up.

        Not for a robot that is blocked: only the contract can say that it is so no more.
        """
        base = head.base_fee or 0
        if job.kind is Kind.TOP_UP:
            self._treasury_empty = spendable < job.value + 100_000 * base
            return not self._treasury_empty
        return spendable > 21_000 * base or job.robot in self._blocked

    def _call(self, job: Job, account: str) -> Call:
        if job.kind is Kind.BATCH:
            data = calldata("setBatch", job.robot, job.batch_index, self._journal.packed(job))
            return Call(self._contract, data, account)
        if job.kind is Kind.TOP_UP:
            return Call(self._contract, calldata("allocETH", job.target), account, job.value)
        return Call(account, b"", account)

    def _fill_gaps(self, account: str, robot: bytes, view: AccountView, now: float) -> None:
        """A nonce that nothing holds would keep all later ones waiting for ever.

        Nothing is later where the account was a robot's and is so no more: its key is not at hand, and need not be.
        """
        if not any(signer is not None and signer.address == account for signer in self._signers(robot)):
            return
        for nonce in range(view.nonce, self._journal.next_nonce(account)):
            if not self._journal.nonce_is_used(account, nonce):
                self._keep(self._journal.fill(robot, self._leases[account], nonce, now))

    def _mind_balance(self, account: str, view: AccountView, mine: Sequence[Job], now: float) -> None:
        """Plan a top-up for a robot's account that runs low."""
        if self._operator is None or account == self._operator.address:
            return
        if view.balance >= self._settings.low_water and account not in self._poor:
            return
        under_way = any(job.kind is Kind.TOP_UP and job.target == account for job in self._jobs.values())
        batch = next((job for job in mine if job.kind is Kind.BATCH), None)
        if under_way or batch is None or batch.robot in self._blocked or not self._leased(self._operator.address, now):
            return
        amount = min(self._settings.top_up, BALANCE_LIMIT - view.balance)
        if amount > 0:
            self._keep(self._journal.top_up(batch.robot, account, amount, self._leases[self._operator.address], now))
            self._poor.discard(account)

    def _needless(self, job: Job) -> bool:
        """Did somebody else pay before this top-up was signed?"""
        view = self._views.get(job.target or "")
        return view is not None and view.balance >= self._settings.low_water and job.target not in self._poor

    def _urge(self, job: Job, view: AccountView, head: Block, now: float) -> list[Action]:
        """The lowest nonce that waits holds up all others."""
        if job.state is not State.PENDING or job.fees is None or job.signed_at is None:
            return []
        settings, attempt = self._settings, self._journal.latest_attempt(job)
        payable = head.base_fee is None or job.fees.max_fee >= head.base_fee
        wait = self._waits.get(job.account or "")
        if wait is None or wait.job != job.id or not payable or view.balance < _cost(job):
            wait = self._waits[job.account or ""] = _Wait(job.id, attempt.hash, head.number)
        if job.bumps >= settings.stuck_bumps and head.number - wait.since_block >= settings.stuck_blocks:
            del self._waits[job.account or ""]
            self._give_up(job, "a node takes it but none mines it", now)
            return []
        if now - max(job.signed_at, job.included_at or 0.0) >= settings.bump_after or not payable:
            self._bump(job, now)
            return []
        last = self._probed.get(job.id, job.signed_at)
        return [Probe(job.id, attempt.hash)] if now - last >= settings.probe_after else []

    # ------------------------------------------------------------------ answers

    def handle(self, action: Action, answer: Answer, now: float) -> None:
        """Take the answer to one action."""
        self._asked.discard(action)
        if isinstance(answer, NodeFailure):
            answer = explain(answer)
            if not isinstance(action, EstimateGas) or answer.transient:
                self._node_failed(answer, now)
                return
        else:
            self._node.succeeded()
            self._failure = None
        match action, answer:
            case ReadHead(), (Block() as head, int(tip)):
                self._on_head(head, tip, now)
            case ReadAccount(account), AccountView() as view:
                self._on_account(account, view)
            case ReadBlock(number, hash), (Block() | None) as block:
                self._on_block(number, hash, block, now)
            case EstimateGas(id), int(gas):
                self._on_estimate(id, gas, now)
            case EstimateGas(id), NodeFailure() as failure:
                self._on_estimate_failed(id, failure, now)
            case Broadcast(attempts), list(results):
                for attempt, result in zip(attempts, results, strict=True):
                    if not isinstance(result, Receipt | None):
                        self._on_sent(attempt, result, now)
            case FetchReceipts(account, nonce, attempts), list(receipts):
                found = [receipt for receipt in receipts if isinstance(receipt, Receipt)]
                self._on_receipts(account, nonce, attempts, found, now)
            case Probe(id), bool(known):
                self._on_probe(id, known, now)
            case _:
                raise TypeError(f"{type(answer).__name__} does not answer {type(action).__name__}")

    def _node_failed(self, failure: NodeFailure, now: float) -> None:
        self._failure = str(failure)
        self._node.failed(now, self._settings, failure.retry_after if isinstance(failure, RateLimited) else None)

    def _keep(self, *jobs: Job) -> None:
        """Follow jobs that are open, forget the others."""
        for job in jobs:
            if job.state in (State.SEALED, State.READY, State.PENDING, State.INCLUDED, State.SPLIT):
                self._jobs[job.id] = job
            else:
                self._jobs.pop(job.id, None)
                self._retries.pop(job.id, None)
                self._probed.pop(job.id, None)

    def _retry(self, job: Job) -> _Retry:
        return self._retries.setdefault(job.id, _Retry())

    def _on_head(self, head: Block, tip: int, now: float) -> None:
        self._head, self._tip = head, tip
        self._next_poll = now + self._settings.poll
        self._fee_capped = self._market(head).max_fee > self._settings.max_fee

    def _on_account(self, account: str, view: AccountView) -> None:
        if self._head is not None:
            old = self._views.get(account)
            self._views[account] = view
            self._views_of[account] = self._head.hash
            if old is not None and view.balance > old.balance:
                self._poor.discard(account)
                for job in self._jobs.values():
                    if job.state in _UNMINED and job.id in self._retries and self._account_for(job) == account:
                        self._retries[job.id].succeeded()  # money came in: what waited for it need not

    def _on_block(self, number: int, hash: bytes, block: Block | None, now: float) -> None:
        head = self._head
        if head is None:
            return
        if block is None or block.hash != hash:
            self._on_reorganisation(hash, now)
            return
        self._blocks_checked = {n: h for n, h in self._blocks_checked.items() if h == head.hash}
        self._blocks_checked[number] = head.hash
        if head.number - number + 1 < self._settings.confirmations:
            return
        for job in [j for j in self._jobs.values() if j.state is State.INCLUDED and j.block_hash == hash]:
            lease = self._lease_of(job, now)
            if lease is not None:
                buried, others = self._journal.buried(job, lease, now)
                self._keep(buried, *others)
                if buried.kind is Kind.BATCH:
                    self._timings.append(_timing(buried, now))

    def _on_reorganisation(self, hash: bytes, now: float) -> None:
        """That block is gone, and what was in it is on its way again."""
        gone = [job for job in self._jobs.values() if job.state is State.INCLUDED and job.block_hash == hash]
        if self._settled is not None and self._settled.block_hash == hash:
            gone.append(self._settled)  # and what lies below it comes up next
            self._settled_of = None
        for job in gone:
            lease = self._lease_of(job, now)
            if lease is not None:
                self._keep(self._journal.reorged(job, lease))
                self._receipts_at.pop((job.account or "", job.nonce or 0), None)
                self._views_of.pop(job.account or "", None)

    def _lease_of(self, job: Job, now: float) -> Lease | None:
        """Of the account a job is signed by; None while another has it, or had it and the job is not read anew yet."""
        if job.account is None or not self._leased(job.account, now) or self._stale:
            return None
        return self._leases[job.account]

    # ---- signing

    def _market(self, head: Block) -> Fees:
        return Fees.suggested(head, self._tip)

    def _on_estimate(self, id: int, estimate: int, now: float) -> None:
        job, head = self._jobs.get(id), self._head
        if job is None or head is None or job.state is not State.SEALED:
            return
        account = self._account_for(job)
        if account is None or account not in self._leases:
            return
        self._blocked.pop(job.robot, None)
        gas = estimate * (100 + self._settings.gas_margin * (1 + 2 * job.failures)) // 100
        if job.kind is Kind.BATCH and gas > max(self._settings.limits.gas, estimate) and job.count > 1:
            gas = self._settings.limits.gas
        if gas > head.gas_limit:
            if estimate > head.gas_limit:
                self._give_up(job, f"needs {estimate} gas, a block holds {head.gas_limit}", now)
                return
            gas = head.gas_limit
        market = self._market(head)
        fees = market if job.fees is None else job.fees.bumped(market)
        fees = fees.capped(self._settings.max_fee)
        if head.base_fee is not None and fees.max_fee < head.base_fee:
            self._retry(job).wait(now + self._settings.poll)  # dearer than allowed: wait for better times
            return
        view = self._views[account]
        others = [j for j in self._jobs.values() if j.account == account and j.state in IN_FLIGHT]
        spendable = view.balance - sum(_cost(j) for j in others if j.nonce is not None and j.nonce >= view.nonce)
        if gas * fees.max_fee + job.value > spendable:
            self._short_of_money(job, account, now)
            return
        nonce = job.nonce if job.nonce is not None else max(view.nonce, self._journal.next_nonce(account))
        self._sign(job, Event.SIGNED, nonce, gas, fees, now)

    def _short_of_money(self, job: Job, account: str, now: float) -> None:
        if job.kind is Kind.TOP_UP:
            self._treasury_empty = True
        else:
            self._poor.add(account)
        self._retry(job).failed(now, self._settings)

    def _sign(self, job: Job, event: Event, nonce: int, gas: int, fees: Fees, now: float) -> None:
        signer = self._signer(job)
        if signer is None:
            return
        call = self._call(job, signer.address)
        unsigned = Transaction(self._chain_id, nonce, call.to, call.data, gas, fees, call.value)
        lease = self._leases[signer.address]
        signed = sign(unsigned, signer)
        self._keep(
            self._journal.signed(job, event, lease, nonce=nonce, gas=gas, fees=fees, transaction=signed, now=now)
        )
        if job.kind is Kind.TOP_UP:
            self._treasury_empty = False

    def _signer(self, job: Job) -> LocalAccount | None:
        """Whose key signs: the account the job has a nonce of, while the key is at hand."""
        candidates = self._signers(job.robot)
        if job.kind is Kind.BATCH:
            candidates.reverse()
        for signer in candidates:
            if signer is not None and job.account in (None, signer.address):
                return signer
        self._blocked[job.robot] = f"the key of {job.account} is not at hand"
        return None

    def _signers(self, robot: bytes) -> list[LocalAccount | None]:
        return [self._operator, self._account_of(robot) if robot else None]

    def _on_estimate_failed(self, id: int, failure: NodeFailure, now: float) -> None:
        job = self._jobs.get(id)
        if job is None or job.state is not State.SEALED:
            return
        account = self._account_for(job) or ""
        name = failure.name if isinstance(failure, Reverted) else ""
        if isinstance(failure, InsufficientFunds) or name == "NoBalance":
            self._blocked.pop(job.robot, None)  # the contract looks at the balance last
            self._short_of_money(job, account, now)
        elif job.kind is Kind.TOP_UP and name in _ALLOC_NOT_ALLOWED:
            self._drop_top_up(job, str(failure), now)
        elif name in _NOT_ALLOWED:
            self._blocked[job.robot] = str(failure)
            self._retry(job).failed(now, self._settings)
        elif name == "BatchIndexTaken" and job.nonce is None:
            self._keep(self._journal.reindexed(job, self._leases[account]))
        elif name == "MalformedRecords" or isinstance(failure, TooLarge | GasRefused):
            self._give_up(job, str(failure), now)
        else:
            self._failure = str(failure)
            self._retry(job).failed(now, self._settings)

    def _drop_top_up(self, job: Job, reason: str, now: float) -> None:
        """It is planned anew if it is needed still."""
        self._treasury_empty = False
        lease = self._leases[self._account_for(job) or ""]
        self._keep(*filter(None, self._journal.refused(job, lease, reason, now)))

    def _give_up(self, job: Job, reason: str, now: float) -> None:
        """It can never be written as it is: cut it in halves; one record alone is a dead letter."""
        lease = self._leases[self._account_for(job) or ""]
        if job.kind is Kind.BATCH and job.count > 1:
            self._keep(*self._journal.halved(job, lease, reason))
        elif job.kind is Kind.FILLER:
            self._failure = f"account {job.account}: nothing with nonce {job.nonce} is mined ({reason})"
            self._retry(job).failed(now, self._settings)
        else:
            self._keep(*filter(None, self._journal.refused(job, lease, reason, now)))

    def _bump(self, job: Job, now: float) -> None:
        """The same again for more money, unless that is more than allowed."""
        head = self._head
        if head is None or job.fees is None or job.nonce is None or job.gas is None:
            return
        fees = job.fees.bumped(self._market(head)).capped(self._settings.max_fee)
        if not fees.replaces(job.fees):
            self._fee_capped = True
            self._retry(job).wait(now + self._settings.bump_after)
            return
        if not self._retry(job).at > now:
            self._sign(job, Event.BUMPED, job.nonce, job.gas, fees, now)

    # ---- sending

    def _on_sent(self, attempt: Attempt, result: bytes | NodeFailure, now: float) -> None:
        job = self._jobs.get(attempt.job)
        if job is None or job.state is not State.READY or job.nonce != attempt.nonce:
            return
        lease = self._leases[attempt.account]
        match result:
            case bytes() | AlreadyKnown():
                self._keep(self._journal.accepted(job, lease, now))
                self._retry(job).succeeded()
            case NonceTooLow():
                # Mined already, or someone else used the nonce: the receipts will tell.
                self._views_of.pop(attempt.account, None)
                self._retry(job).wait(now + self._settings.poll)
            case Underpriced():
                self._bump(job, now)
                self._retry(job).failed(now, self._settings)
            case InsufficientFunds():
                self._short_of_money(job, attempt.account, now)
            case GasRefused() | TooLarge():
                self._give_up(job, str(result), now)
            case NodeFailure() as failure:
                self._failure = str(failure)
                wait = failure.retry_after if isinstance(failure, RateLimited) else None
                self._retry(job).failed(now, self._settings, wait)

    def _on_probe(self, id: int, known: bool, now: float) -> None:
        job = self._jobs.get(id)
        if job is None:
            return
        self._probed[id] = now
        lease = self._lease_of(job, now)
        if not known and job.state is State.PENDING and lease is not None:
            self._waits.pop(job.account or "", None)
            self._keep(self._journal.dropped(job, lease))

    # ---- mined

    def _on_receipts(
        self, account: str, nonce: int, attempts: Sequence[Attempt], found: Sequence[Receipt], now: float
    ) -> None:
        head, view = self._head, self._views.get(account)
        if head is None or view is None:
            return
        self._receipts_at[account, nonce] = head.hash
        lease = self._leases[account]
        if not found:
            if nonce < view.deep_nonce:
                for job in self._holding(account, nonce):
                    reason = f"another transaction of {account} has nonce {nonce}"
                    self._keep(*_flat(self._journal.nonce_lost(job, Event.SUPERSEDED, lease, reason)))
            return
        receipt = found[0]
        (id,) = {attempt.job for attempt in attempts if attempt.hash == receipt.tx_hash}
        job = self._journal.job(id)
        if receipt.succeeded:
            if job.state in (State.READY, State.PENDING, State.SPLIT, State.DEAD):
                mined, overtaken = self._journal.mined(job, receipt, lease, now)
                self._keep(mined, *overtaken)
                self._waits.pop(account, None)
                self._blocks_checked.pop(receipt.block_number, None)  # there is something new in it
        elif nonce < view.deep_nonce:
            # Not before it is final: until then a reorganisation could still make it succeed.
            reason = f"transaction 0x{receipt.tx_hash.hex()} reverted in block {receipt.block_number}"
            for holder in self._holding(account, nonce):
                event = Event.FAILED if holder.id == id else Event.SUPERSEDED
                self._keep(*_flat(self._journal.nonce_lost(holder, event, lease, reason)))

    def _holding(self, account: str, nonce: int) -> list[Job]:
        return [
            job
            for job in self._jobs.values()
            if job.account == account and job.nonce == nonce and job.state in _UNMINED
        ]


_UNMINED = (State.SEALED, State.READY, State.PENDING)


def _nonce(job: Job) -> int:
    """Of a job that has one."""
    return -1 if job.nonce is None else job.nonce


def _flat(pair: tuple[Job, list[Job]]) -> list[Job]:
    return [pair[0], *pair[1]]


def _cost(job: Job) -> int:
    """What a transaction may cost at most, in wei."""
    return job.value + (job.gas or 0) * (job.fees.max_fee if job.fees else 0)


def _order(job: Job) -> tuple[bool, int]:
    """Those that have a nonce first: others wait behind it."""
    return job.nonce is None, job.id


def _timing(job: Job, now: float) -> BatchTiming:
    submitted = job.submitted_at if job.submitted_at is not None else now
    included = job.included_at if job.included_at is not None else now
    return BatchTiming(
        job.id,
        job.robot,
        job.count,
        submitted - job.sealed_at,
        included - submitted,
        now - included,
        job.block_number or 0,
        job.tx_hash or b"",
        job.gas_used or 0,
    )

"""A batch's latencies are the node's: what it takes its time for is in them, on the clock that was passed in."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import pytest

from bridge.operations.conftest import PASSPHRASE, Place
from rosbridge_eth.config import load_server_config
from rosbridge_eth.ledger.accounts import Keyring
from rosbridge_eth.ledger.submitter import BatchTiming
from rosbridge_eth.operations.figures import Condition
from rosbridge_eth.records import RecordId, SealedRecord, robot_id
from rosbridge_eth.registry import Registry
from rosbridge_eth.server.assembly import bound_contract, open_inbox, open_journal, open_submission
from rosbridge_eth.server.publishing import Costs

TO_ACCEPT, TO_ANSWER = 3.0, 0.25


class Clock:
    def __init__(self) -> None:
        self.now = 1_000_000.0

    def __call__(self) -> float:
        return self.now


class SlowChain:
    """The real embedded chain, whose answers take time on the test's clock."""

    def __init__(self, chain: Any, clock: Clock) -> None:
        self._chain, self._clock = chain, clock

    def __getattr__(self, name: str) -> Any:
        return getattr(self._chain, name)

    def send(self, raws: Sequence[bytes]) -> Any:
        self._clock.now += TO_ACCEPT
        return self._chain.send(raws)

    def receipts(self, hashes: Sequence[bytes]) -> Any:
        self._clock.now += TO_ANSWER
        return self._chain.receipts(hashes)


@pytest.mark.slow
def test_submit_include_and_confirm_are_timed_and_add_up(place: Place):
    clock, confirmed, costs = Clock(), list[BatchTiming](), Costs()
    config, deployment = load_server_config(place.operator.config), place.operator.deployment()
    contract = bound_contract(place.chain, deployment)
    object.__setattr__(contract, "chain", SlowChain(place.chain, clock))
    inbox = open_inbox(config, place.operator)
    submission = open_submission(
        config=config, contract=contract, journal=open_journal(place.operator, deployment), inbox=inbox,
        registry=Registry(place.operator.registry), keys=Keyring.load(place.operator.accounts, PASSPHRASE),
        on_confirmed=confirmed.append,
    )
    records = [SealedRecord(RecordId(robot_id("robot_1"), bytes(16), seq), bytes(300)) for seq in range(5)]
    inbox.append(records, clock.now)
    began = clock.now
    for _ in range(200):
        submission.turn(clock.now, flush=True, clock=clock)
        if confirmed:
            break
        clock.now += 0.1
    (timing,) = confirmed
    assert timing.records == 5
    assert timing.submit >= TO_ACCEPT
    assert timing.include >= TO_ANSWER
    assert timing.confirm >= 0
    assert timing.submit + timing.include + timing.confirm == pytest.approx(clock.now - began, abs=1.0)

    costs.add(timing)
    snapshot = costs.snapshot(submission, submission.status())
    values = {one.metric: one.value for one in snapshot.samples}
    assert values["records_gathered"] == values["records_confirmed"] == 5
    assert values["gas_used"] == timing.gas_used > 21_000
    assert values["submit_seconds"] == (values["submit_seconds"][0], timing.submit)  # type: ignore[index]
    assert Condition("submitter holds its leases", True) in snapshot.conditions

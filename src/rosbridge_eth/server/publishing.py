"""What each of the server's processes publishes of itself, as snapshots for the monitor."""

from __future__ import annotations

from collections.abc import Mapping

from rosbridge_eth.channel import Statistics
from rosbridge_eth.channel.udp import UdpLoop
from rosbridge_eth.ledger.submitter import BatchTiming, Status
from rosbridge_eth.operations.endpoint import channel_samples
from rosbridge_eth.operations.figures import Condition, Histogram, Snapshot, histogram, sample
from rosbridge_eth.server.reception import Reception
from rosbridge_eth.server.submission import Submission

SUPERVISOR, SUBMITTER, MONITOR = "supervisor", "submitter", "monitor"


def worker_name(number: int) -> str:
    return f"worker-{number}"


def worker_snapshot(number: int, counted: Statistics, loop: UdpLoop, reception: Reception) -> Snapshot:
    """A worker's channel, and what became of the records that reached it."""
    name = worker_name(number)
    trouble = reception.trouble
    return Snapshot.of(
        name,
        [
            *channel_samples(counted, loop.socket, loop.lost_sends),
            sample("cookies", counted.cookies),
            sample("resets", counted.resets),
            sample("address_changes", counted.address_changes),
            sample("sessions", counted.connections),
            sample("half_open", counted.half_open),
            sample("held_bytes", counted.held_bytes),
            *(sample("records", number, outcome) for outcome, number in sorted(reception.counts.items())),
        ],
        [Condition(f"{name} stores records", trouble is None, trouble or "")],
    )


class Costs:
    """The latencies and the gas of confirmed batches."""

    def __init__(self) -> None:
        self._submit, self._include, self._confirm = Histogram(), Histogram(), Histogram()
        self.batches = self.records = self.gas = 0

    def add(self, timing: BatchTiming) -> None:
        self._submit.observe(timing.submit)
        self._include.observe(timing.include)
        self._confirm.observe(timing.confirm)
        self.batches += 1
        self.records += timing.records
        self.gas += timing.gas_used

    def snapshot(self, submission: Submission, status: Status) -> Snapshot:
        """The submitter's own figures, and whether it can act."""
        others = ", ".join(status.not_ours)
        return Snapshot.of(
            SUBMITTER,
            [
                sample("records_gathered", submission.gathered),
                sample("batches_sealed", submission.sealed),
                sample("batches_confirmed", self.batches),
                sample("records_confirmed", self.records),
                sample("gas_used", self.gas),
                histogram("submit_seconds", self._submit),
                histogram("include_seconds", self._include),
                histogram("confirm_seconds", self._confirm),
                sample("robots_blocked", len(status.blocked)),
                sample("accounts_not_leased", len(status.not_ours)),
                sample("treasury_empty", status.treasury_empty),
                sample("fee_capped", status.fee_capped),
            ],
            [
                Condition("submitter holds its leases", not others, others and f"another submitter holds {others}"),
                Condition("submitter reaches the node", status.failure is None, status.failure or ""),
                Condition("treasury can pay", not status.treasury_empty,
                          "send ETH to the operator's account" if status.treasury_empty else ""),
            ],
        )


def supervisor_snapshot(up: Mapping[str, bool], restarts: Mapping[str, int]) -> Snapshot:
    """Which processes run."""
    return Snapshot.of(
        SUPERVISOR,
        [
            *(sample("process_up", runs, name) for name, runs in sorted(up.items())),
            *(sample("process_restarts", restarts.get(name, 0), name) for name in sorted(up)),
        ],
        [Condition(f"{name} runs", runs, "" if runs else "it is started again") for name, runs in sorted(up.items())],
    )

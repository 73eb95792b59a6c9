"""From a raw message to sealed records in the spool: capture, seal, keep, in one thread and one call."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

from rosbridge_eth.capture import Capture, CapturedRecord, RawMessage
from rosbridge_eth.records import SealedRecord, SeqRange
from rosbridge_eth.sealing import RecordTooLarge, Sealer
from rosbridge_eth.store import Delivery, Spool, SpoolFull

_DELIVERY = {"reliable": Delivery.RELIABLE, "latest": Delivery.LATEST}


@dataclass(slots=True)
class StageTimes:
    """Seconds spent in each stage so far, over `records` records: what a message costs on the robot."""

    records: int = 0
    capture: float = 0.0
    seal: float = 0.0
    spool: float = 0.0


class Recorder:
    """Owns the capture and the sealer; the spool it shares with the sender. For one thread at a time.

    All times are arguments: wall_ns and mono_ns stand in the record, `now` is
    the spool's clock (monotonic seconds).
    """

    def __init__(self, capture: Capture, sealer: Sealer, spool: Spool) -> None:
        self._capture, self._sealer, self._spool = capture, sealer, spool
        self._lanes: dict[str, int] = {}
        self.times = StageTimes()
        self.too_large = 0
        self.refused = 0

    def take(
        self, raw: RawMessage, *, wall_ns: int, mono_ns: int, now: float, clock_synchronised: bool = False
    ) -> CapturedRecord | None:
        """Capture, seal and keep one message; None where it was not due, or could not be kept (and is counted)."""
        started = time.perf_counter()
        captured = self._capture.process(raw, wall_ns, mono_ns, clock_synchronised)
        if captured is None:
            return None
        seen = time.perf_counter()
        try:
            sealed = self._sealer.seal(captured.to_json(), wall_ns)
        except RecordTooLarge:
            self.too_large += 1
            return None
        encrypted = time.perf_counter()
        lane = self._lanes.setdefault(captured.topic, len(self._lanes))
        try:
            self._spool.append(sealed, _DELIVERY[captured.delivery], now, lane)
        except SpoolFull:
            self.refused += 1
            return None
        kept = time.perf_counter()
        times = self.times
        times.records += 1
        times.capture += seen - started
        times.seal += encrypted - seen
        times.spool += kept - encrypted
        return captured

    @property
    def left_out(self) -> int:
        """Messages that were due and could not become a record: too large, of another type, or not to be decoded."""
        topics = self._capture.statistics().values()
        return self.too_large + sum(topic.refused + topic.undecodable for topic in topics)

    def declare_dropped(self, *, wall_ns: int, now: float) -> bool:
        """Seal a gap record for what the spool had to drop, if there is anything to declare."""
        return self._spool.declare(lambda ranges: self._seal_gap(ranges, wall_ns), now)

    def _seal_gap(self, ranges: Sequence[SeqRange], wall_ns: int) -> Sequence[SealedRecord]:
        return self._sealer.declare(ranges, wall_ns)

    def finish(self, *, wall_ns: int, now: float) -> None:
        """The source has ended in good order: say so in the stream, so that its end cannot be withheld unseen."""
        end = self._sealer.end(wall_ns)
        if end:
            self._spool.append(end, Delivery.CONTROL, now)

"""The robot's process: a thread reads the source, one loop seals, spools, sends and listens.

The source's thread only puts raw messages into a bounded ring; everything
that has state belongs to the loop. A bag waits where the ring is full, so
nothing is skipped however fast it is replayed.
"""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable

from rosbridge_eth.capture import CapturedRecord, RawMessage
from rosbridge_eth.channel import Client
from rosbridge_eth.channel.udp import UdpLoop
from rosbridge_eth.robot.clock import clock_synchronised
from rosbridge_eth.robot.recorder import Recorder
from rosbridge_eth.robot.sender import Sender
from rosbridge_eth.sources import Source
from rosbridge_eth.store import Spool

RING = 1024  # raw messages between the source's thread and the loop
TAKE = 32  # raw messages sealed before the network gets its turn again
LONGEST_WAIT = 0.25
SYNCHRONISED_EVERY = 10.0  # seconds between questions to the kernel whether its clock is synchronised
LAST_WORDS_TIME = 1.0  # seconds after `stop` to hand over what is left
CLOSING_TIME = 1.0  # seconds for the server to learn that the robot leaves


class Robot:
    """One identity's process, run by `run` in the calling thread until its source ends or `stop` is called.

    on_captured: called with each record, in the loop's thread (the demo compares with what it reads back).
    """

    def __init__(
        self,
        *,
        source: Source,
        recorder: Recorder,
        sender: Sender,
        spool: Spool,
        client: Client,
        loop: UdpLoop,
        on_captured: Callable[[CapturedRecord], None] = lambda record: None,
    ) -> None:
        self.recorder, self.sender, self.spool, self.client, self.loop = recorder, sender, spool, client, loop
        self._source = source
        self._on_captured = on_captured
        self._ring: queue.Queue[RawMessage] = queue.Queue(RING)
        self._stop = threading.Event()
        self._source_ended = threading.Event()
        self._source_error: BaseException | None = None
        self._synchronised, self._asked_at = False, float("-inf")
        self.spool_left = 0
        """Records that the server had not acknowledged when `run` ended; the next run sends them."""

    def stop(self) -> None:
        """Let `run` come to an end, from any thread or a signal handler; what is not acknowledged stays spooled."""
        self._stop.set()
        self.loop.wake()

    @property
    def dropped(self) -> int:
        """Messages of a live source that this robot was too slow to capture, so far."""
        return sum(self._source.dropped.values())

    def summary(self) -> str:
        """What became of everything, in one line; to be asked after `run`."""
        sender, spool = self.sender.statistics, self.spool.statistics
        lost = {
            "dropped because they came too fast": self.dropped,
            "left out as too large or undecodable": self.recorder.left_out,
            "not kept for want of room": self.recorder.refused,
            "superseded by newer ones": spool.superseded,
            "dropped from the full spool": spool.dropped,
            "refused by the server": sender.refused + sender.conflicts,
        }
        parts = [f"{self.recorder.times.records} captured"]
        parts += [f"{count} {what}" for what, count in lost.items() if count]
        parts += [f"{sender.stored} stored by the server", f"{self.spool_left} kept for later"]
        line = ", ".join(parts)
        if not self.spool_left:
            return f"{line}."
        if sender.refusal is not None:
            return f"{line}: {sender.refusal}."
        if not sender.sessions:
            return f"{line}: there was no session yet when it was stopped."
        return f"{line}: it was stopped before the server had them; the next start sends them."

    def run(self, *, on_turn: Callable[[], None] = lambda: None) -> None:
        """Until `stop`, or until the source has ended and the server has everything.

        on_turn: called at every turn of the loop, to show progress. Raises
        what the source raised, after everything that was captured is delivered.
        """
        reading = threading.Thread(target=self._read, name="source", daemon=True)
        reading.start()
        finished = False
        try:
            while not self._stop.is_set():
                now = time.monotonic()
                self._take(now)
                if not finished and self._source_ended.is_set() and self._ring.empty():
                    finished = True
                    self.recorder.finish(wall_ns=time.time_ns(), now=now)
                self.sender.send(now)
                self.spool.commit(now)
                on_turn()
                if finished and self.sender.idle:
                    break
                self.loop.step(self._wait(now))
            else:
                self.recorder.finish(wall_ns=time.time_ns(), now=time.monotonic())
                self._say_the_end()
        finally:
            self._stop.set()
            self._leave()
            self._source.close()
            reading.join(timeout=5)
            self.spool_left = self.spool.statistics.records
            self.spool.close()
            self.loop.close()
        if self._source_error is not None:
            raise self._source_error

    def _read(self) -> None:
        try:
            self._source.run(self._emit, self._stop)
        except BaseException as error:  # kept and raised in the thread that waits for this one
            self._source_error = error
        finally:
            self._source_ended.set()
            self.loop.wake()

    def _emit(self, raw: RawMessage) -> None:
        while not self._stop.is_set():
            try:
                self._ring.put(raw, timeout=0.2)
            except queue.Full:
                continue
            self.loop.wake()
            return

    def _take(self, now: float) -> None:
        if now - self._asked_at > SYNCHRONISED_EVERY:
            self._synchronised, self._asked_at = clock_synchronised(), now
        for _ in range(TAKE):
            try:
                raw = self._ring.get_nowait()
            except queue.Empty:
                return
            captured = self.recorder.take(
                raw,
                wall_ns=time.time_ns(),
                mono_ns=time.monotonic_ns(),
                now=now,
                clock_synchronised=self._synchronised,
            )
            if captured is not None:
                self._on_captured(captured)

    def _wait(self, now: float) -> float:
        if not self._ring.empty():
            return 0.0
        timers = (self.spool.next_commit(), self.sender.next_timer())
        return max(0.0, min([LONGEST_WAIT, *(timer - now for timer in timers if timer is not None)]))

    def _say_the_end(self) -> None:
        """After `stop`: bring what is left and the stream's end to the server, if that takes no longer than a moment.

        Otherwise it waits in the spool: the next run sends it.
        """
        deadline = time.monotonic() + LAST_WORDS_TIME
        while self.sender.statistics.connected and not self.sender.idle and (now := time.monotonic()) < deadline:
            self.spool.commit(now)
            self.sender.send(now)
            self.loop.step(0.02)

    def _leave(self) -> None:
        """End the session in good order, so that the server need not wait for a silent robot."""
        now = time.monotonic()
        deadline = now + CLOSING_TIME
        self.client.close(now)
        while self.client.next_timer() is not None and time.monotonic() < deadline:
            self.loop.step(0.05)

"""The robot's end: captures, writes chunks into the spool, and brings to the server what it does not have.

    source's threads -> Queue -> Robot's loop: capture -> writer -> spool -> Sender -> channel

The source's threads only put raw messages into a bounded queue; everything that has state belongs to the loop, which
lets messages gather for GATHER between two turns. Where the queue is full a bag waits, and messages of a live source
are dropped and counted, which becomes `lost` lines of the log.
"""

from __future__ import annotations

import ctypes
import logging
import os
import sys
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from datetime import UTC, datetime, timedelta
from functools import partial
from typing import TypeVar

from rosbridge_eth.capture import Capture, RawMessage, Record, stream_line
from rosbridge_eth.channel import Client, ClientConfig, Event, Mode
from rosbridge_eth.channel.udp import ClientLoop
from rosbridge_eth.config import RobotConfig, load_robot_config, reread
from rosbridge_eth.config.home import RobotHome
from rosbridge_eth.config.values import Address, counted, parse_address
from rosbridge_eth.errors import BridgeError, ConfigError, StoreError
from rosbridge_eth.identity import Role, Trust, load_identity, read_certificates
from rosbridge_eth.log.chunk import MAX_READERS, STREAM_SIZE, Chunk, Log, drop, robot_id
from rosbridge_eth.log.store import place_of
from rosbridge_eth.log.writer import LogWriter
from rosbridge_eth.robot.blackbox import BlackBox
from rosbridge_eth.robot.sender import Sender
from rosbridge_eth.robot.sources import Selection, Source, open_source
from rosbridge_eth.robot.sources.queue import Queue
from rosbridge_eth.robot.spool import Spool
from rosbridge_eth.terminal import Trouble
from smcrypto import __version__, sm2, x509

log = logging.getLogger(__name__)
_T = TypeVar("_T")

REPLAYED_BYTES = 4 << 20  # of raw messages between the source and the loop, where the source can wait
LIVE_BYTES = 128 << 20  # and where it cannot: twice the largest message that is decoded
TAKE = 128  # raw messages captured before the network gets its turn again
GATHER = 0.05  # seconds that messages gather in the queue: a turn of the loop costs as much as some of them
LONGEST_WAIT = 0.25
LOOK_EVERY = 1.0  # seconds between looks at what was lost, and at whether the kernel's clock is synchronised
CLOCKS_APART = 60.0  # seconds between this clock and the server's that are worth a warning
SPOOL_AGAIN = 1.0  # seconds before a spool that took nothing is tried again
MAX_UNSPOOLED = 16  # chunks kept in memory while the spool takes nothing; then nothing more is captured
MARKS = 512  # places of the log for which it is known how many records of each topic are sealed up to there
LAST_WORDS_TIME = 1.0  # seconds after `stop` to hand over what is left

_TIME_ERROR = 5  # adjtimex(2): the clock is not synchronised
_TIMEX_SIZE = 512  # struct timex has 208 bytes on 64-bit Linux; modes = 0 in its first word asks and changes nothing


def clock_synchronised() -> bool:
    """Whether the kernel counts its clock as synchronised (NTP, PTP, chrony); False where it cannot be asked."""
    adjtimex = getattr(ctypes.CDLL(None), "adjtimex", None) if sys.platform.startswith("linux") else None
    return adjtimex is not None and 0 <= int(adjtimex(ctypes.create_string_buffer(_TIMEX_SIZE))) < _TIME_ERROR


class Robot:
    """One identity's process, run by `run` in the calling thread until its source ends or `stop` is called."""

    def __init__(
        self, *, source: Source, capture: Capture, writer: LogWriter, spool: Spool, client: Client,
        servers: Sequence[Address], sender: Sender, box: BlackBox | None = None,
    ) -> None:  # fmt: skip
        self.capture, self.writer, self.spool, self.box = capture, writer, spool, box or BlackBox(())
        self.client, self.sender, self.loop = client, sender, ClientLoop(client, servers, self.handle)
        self.source, self.chunks = source, 0
        self.written = Counter[str]()
        """Records given to the writer, by topic."""
        self._marks: deque[tuple[bytes, Counter[str]]] = deque()  # place, and records sealed up to there
        self._confirmed = Counter[str]()
        self._queue = Queue(LIVE_BYTES if source.live else REPLAYED_BYTES, waits=not source.live)
        self._stop, self._source_ended = threading.Event(), threading.Event()
        self._source_error: BaseException | None = None
        self._unspooled: deque[Chunk] = deque()
        self._failing: dict[str, tuple[str, float]] = {}  # what the spool does not do now: why, and when it is retried
        self._look_at = self._take_at = float("-inf")
        self._synchronised = self._finished = False
        self.summary = ""
        """What became of everything, in one line, after `run`."""
        self.spool_trouble = Trouble(log, "the spool")

    def stop(self) -> None:
        """Let `run` come to an end, from any thread or a signal handler; what is not stored stays in the spool."""
        self._stop.set()
        self.loop.wake()

    def reload(self, config: RobotConfig, readers: Sequence[sm2.PublicKey]) -> None:
        """Go on by other topics, nodes and [capture], and seal for these readers; to be called in the loop's thread."""
        self._add_losses(time.monotonic())
        self.box.change_rules(config.triggers())
        self.capture.change_rules(config.rules())
        self.source.watch(Selection.of(config))
        self.writer.change_readers(readers)

    def fire(self, why: str, name: str | None = None) -> None:
        """An event of this trigger, or of all, by hand; to be called in the loop's thread."""
        replayed = 0 if self.source.live else self.box.newest_ns
        self.box.fire(replayed or time.time_ns(), why, name)
        if self._finished and self.box.released:  # the source has ended, and with it the stream
            self._finished = False
            self.writer.new_stream()

    @property
    def lost(self) -> dict[tuple[str, str], int]:
        """Messages that are not in the log, by topic and why: lost by the source, refused, no memory to keep them."""
        return {**self._source_lost, **self.capture.lost, **self.box.lost}

    @property
    def _source_lost(self) -> dict[tuple[str, str], int]:
        return {**self.source.lost, **self._queue.lost}

    @property
    def captured(self) -> int:
        """Records given to the writer; what is kept in memory for an event is not among them."""
        return self.written.total()

    def confirmed(self) -> Counter[str]:
        """Records confirmed on the chain since the start, by topic: those up to the newest place that is confirmed.

        A chunk holds records of all topics, so what is kept are places of the log and not records. Of more than MARKS
        places that wait every second is left out: then it is less, by less than what one of them stands for.
        """
        while self._marks and self._marks[0][0] <= self.sender.newest:
            self._confirmed = self._marks.popleft()[1]
        return self._confirmed

    def run(self, *, on_turn: Callable[[], None] = lambda: None) -> None:
        """Until `stop`, or until the source has ended and the server has everything.

        on_turn: called at every turn of the loop, to show progress. Raises what the source raised: of a live one at
        once, so that it can be started again, of another after everything that was captured is delivered.
        """
        reading = threading.Thread(target=self._read, name="source", daemon=True)
        reading.start()
        try:
            while not self._stop.is_set():
                now = time.monotonic()
                self._take(now)
                if not self._finished and self._source_ended.is_set() and not self._queue and not self.box.released:
                    self._finish(now)
                else:
                    self._spool_chunks([] if self._finished else self.writer.closed(now, time.time_ns() // 10**6), now)
                if shard := self.sender.elsewhere:
                    with suppress(ValueError):
                        self.loop.go(parse_address(shard), now)
                self.loop.seek(now)
                self._send(now)
                on_turn()
                if self._finished and not self._unspooled and self._idle(False, now):
                    break
                self.loop.step(self._wait(now))
            else:
                self._queue.close()
                while (self._queue or self.box.released) and len(self._unspooled) < MAX_UNSPOOLED:
                    self._take(now := time.monotonic())
                    self._spool_chunks(self.writer.closed(now, time.time_ns() // 10**6), now)
                if not self._finished:
                    self._finish(time.monotonic())
                self._failing.clear()  # the last chunks do not wait
                self._spool_chunks([], time.monotonic())
                self._last_words()
        finally:
            self._stop.set()
            self._queue.close()
            try:
                self.client.close(time.monotonic())  # so that the server need not wait for a silent robot
                self.loop.step(0.0)
            finally:
                self.source.close()
                reading.join(timeout=5)
                self.summary = self._spool_or("the spool cannot be read", "sum", time.monotonic(), self._summarise)
                self.spool.close()
                self.loop.close()
        if self._source_error is not None:
            raise self._source_error

    # The source's thread

    def _read(self) -> None:
        try:
            self.source.run(self._emit, self._stop)
        except BaseException as error:  # kept and raised in the thread that waits for this one
            self._source_error = error
            log.error("the source has ended", exc_info=error)
            if self.source.live:
                self._stop.set()
        finally:
            self._source_ended.set()
            self.loop.wake()

    def _emit(self, raw: RawMessage) -> None:
        if self._queue.put(raw) and time.monotonic() >= self._take_at:  # else it wakes by itself
            self.loop.wake()

    # The loop's thread

    def _take(self, now: float) -> None:
        if now >= self._look_at:
            self._look_at, self._synchronised = now + LOOK_EVERY, clock_synchronised()
            if len(self._unspooled) < MAX_UNSPOOLED:
                self._add_losses(now)
        for _ in range(TAKE):
            if len(self._unspooled) >= MAX_UNSPOOLED or self.writer.next_timer() <= now:
                break
            if self.box.released:  # before anything new, so that no more is kept than was stated
                self._write(self.box.released.popleft(), now)
            elif (raw := self._queue.take()) is not None:
                self._take_at = now + GATHER
                self._capture(raw, now)
            else:
                break

    def _capture(self, raw: RawMessage, now: float) -> None:
        self.box.look(raw)
        record = self.capture.process(raw, time.time_ns(), self._synchronised)
        if record is not None and record.trigger is not None:
            self.box.keep(record.trigger, record)
        elif record is not None:
            self._write(record, now)

    def _write(self, record: Record, now: float) -> None:
        self.writer.add(record.line, now, record.definition, topic=record.topic)
        if record.definition is not None:  # else it is no message
            self.written[record.topic] += 1

    def _add_losses(self, now: float) -> None:
        for line in self.capture.loss_lines({**self._source_lost, **self.box.lost}):
            self.writer.add(line, now)

    def _finish(self, now: float) -> None:
        self._finished = True
        self._add_losses(now)
        self._spool_chunks(self.writer.finish(time.time_ns() // 10**6), now)

    def _spool_chunks(self, chunks: list[Chunk], now: float) -> None:
        """Append, in order; while the spool takes nothing the chunks wait in memory, and then messages in the queue."""
        self._unspooled.extend(chunks)
        self.chunks += len(chunks)
        if chunks:
            self._marks.append((place_of(chunks[-1].header), self.writer.sealed.copy()))
            if len(self._marks) > MARKS:
                self._marks = deque([*self._marks][::-2][::-1])
        self._spool_or(None, "append", now, self._append)

    def _append(self) -> None:
        while self._unspooled:
            self.spool.append(self._unspooled[0])
            self._unspooled.popleft()

    def _send(self, now: float) -> None:
        self._spool_or(None, "send", now, lambda: self.sender.send(now))

    def _wait(self, now: float) -> float:
        due = LONGEST_WAIT if self._finished else self.writer.next_timer() - now
        if len(self._unspooled) < MAX_UNSPOOLED:
            if self.box.released or len(self._queue) >= TAKE or (self._queue and self._source_ended.is_set()):
                return 0.0
            if self._queue or self._take_at > now:  # until then nobody wakes the loop for a message
                due = min(due, self._take_at - now)
        return max(0.0, min(LONGEST_WAIT, due))

    def _last_words(self) -> None:
        """After `stop`: bring what is left to the server, if that takes no longer than a moment."""
        deadline = time.monotonic() + LAST_WORDS_TIME
        while self.sender.connected and (now := time.monotonic()) < deadline:
            self._spool_chunks([], now)
            self._send(now)  # which notes the newest state, too, so that the summary says what the server has
            if self._idle(True, now):
                break
            self.loop.step(0.02)

    def handle(self, event: Event) -> None:
        """Take one event of the client."""
        self.sender.handle(event, time.monotonic())

    def _idle(self, otherwise: bool, now: float) -> bool:
        return self._spool_or(otherwise, "idle", now, lambda: self.sender.idle)

    def _spool_or(self, otherwise: _T, what: str, now: float, call: Callable[[], _T]) -> _T:
        """What `call` gives, or `otherwise` where the spool does not do that; then it is retried SPOOL_AGAIN later.

        A spool may do one thing and not another: it works again when all that it did not do is done.
        """
        if now < self._failing.get(what, ("", now))[1]:
            return otherwise
        try:
            given = call()
        except StoreError as error:
            self._failing[what], given = (str(error), now + SPOOL_AGAIN), otherwise
        else:
            self._failing.pop(what, None)
        self.spool_trouble.now(next((why for why, _ in self._failing.values()), None))
        return given

    def _summarise(self) -> str:
        spool, sender = self.spool.statistics(), self.sender
        lost = {
            "messages lost before they could be captured": sum(self._source_lost.values()),
            "messages left out as too large or undecodable": sum(self.capture.lost.values()),
            "records that there was no memory for until their event": self.box.lost.total(),
            "messages lost, since the spool took nothing":
                len(self._queue) + len(self.box.released) if self._unspooled else 0,
            "chunks lost, since the spool took nothing": len(self._unspooled),
            f"chunks dropped, since the {'disk was full' if self.spool.disk_was_full else 'spool was at its max_size'}":
                spool.dropped_bodies,
            "chunks refused by the server": sender.refused,
        }
        parts = [f"{counted(self.captured, 'record')} captured in {counted(self.chunks, 'chunk')}"]
        parts += [f"{count} {what}" for what, count in lost.items() if count]
        if not spool.unstored:
            return ", ".join([*parts, "nothing waits for the server."])
        line = ", ".join([*parts, f"{counted(spool.unstored, 'chunk')} not yet at the server"])
        if why := sender.held or sender.refusal:
            return f"{line}: {why}."
        if not sender.sessions:
            return f"{line}: there was no session yet when it was stopped."
        return f"{line}: it was stopped before the server had them; the next start sends them."


# Putting a robot together


def certificate_clock(home: RobotHome) -> Callable[[], datetime]:
    """The clock to check certificates against: many robots start in 1970 for want of a battery, so it is never before
    the latest time that a server has proven to this robot."""
    return lambda: datetime.fromtimestamp(max(time.time(), home.clock_floor()), UTC)


def keep_time(home: RobotHome, seconds: float) -> None:
    """Keep the time that a server proved, for this clock; on a full disk the next server's will do.

    A clock that is far from the server's is told: every record bears this machine's time.
    """
    away = time.time() - seconds
    if abs(away) > CLOCKS_APART:
        log.warning(
            "this machine's clock is %s %s the server's, and every record bears its time: set it (NTP, chrony)",
            timedelta(seconds=round(abs(away))), "ahead of" if away > 0 else "behind",
        )  # fmt: skip
    try:
        home.raise_clock_floor(seconds)
    except OSError as error:
        log.warning("the server's time cannot be kept for the next start: %s", error.strerror)


def reader_keys(home: RobotHome, roots: Sequence[x509.Certificate]) -> list[sm2.PublicKey]:
    """The encryption keys of everybody who may read. Each file holds a reader's two certificates, signing first.

    One whose certificates have ended is left out, and named in the log; ConfigError where nobody is left.
    """
    trust, keys, now = Trust(roots), [], certificate_clock(home)()
    files = sorted(home.readers.glob("*.pem"))
    if not 1 <= len(files) <= MAX_READERS:
        raise ConfigError(
            f"{home.readers} has the certificates of {len(files)} readers, and a chunk is for 1 to {MAX_READERS}: join"
            " again with the bundle, or correct the folder"
        )
    for path in files:
        found = read_certificates(path.read_bytes())
        if len(found) != 2:
            raise ConfigError(f"{path} holds {len(found)} certificates; a reader has two, signing and encryption")
        signing, encryption = found
        born = max(signing.not_before, encryption.not_before)
        peer = trust.check(signing.to_der(), encryption.to_der(), role=Role.READER, at=born)
        if now > peer.not_after:
            log.warning("not sealed for %s: its certificate ended at %s", peer, peer.not_after)
        else:
            keys.append(peer.encryption_certificate.public_key)
    if not keys:
        raise ConfigError("the certificates of all readers have ended, so nobody may open the records: join again")
    return keys


def open_robot(home: RobotHome, config: RobotConfig, password: bytes) -> Robot:
    """The robot of this home, ready to `run`. Raises ConfigError, IdentityError, SourceError, StoreError."""
    end = home.bridge()
    identity, roots = load_identity(home.identity, password)
    readers = reader_keys(home, roots)
    settings, _ = config.source_and_why(os.environ)
    source = open_source(settings, Selection.of(config))
    capture = Capture(config.rules(), source_kind=source.kind, live=source.live)
    box = BlackBox(config.triggers())
    for topic, decoders in source.decoders().items():
        for decoder in decoders:
            capture.check(topic, decoder)  # a field that a type does not have is told now, not at its first message
            box.check(topic, decoder)
    place = Log(end.ledger, robot_id(identity.name))
    key = identity.signing_key
    spool = Spool(home.spool, place, max_bytes=config.spool.max_size, drop=partial(drop, place, key))
    now = time.monotonic()
    # A robot that begins in 1970, its disk lost, begins its log behind what was written under its name before.
    known = max(certificate_clock(home)(), identity.public.not_before)
    since = int(known.timestamp() * 1000 - 1).to_bytes(8, "big") + bytes(STREAM_SIZE - 8)
    first_line = stream_line(source.kind, f"rosbridge_eth {__version__}")
    writer = LogWriter(
        place, key, readers, previous=spool.last_digest, newest=max(spool.newest[:STREAM_SIZE], since),
        stream_line=first_line, period=config.log.period, heartbeat=config.log.heartbeat, compress=config.log.compress,
        now=now,
    )
    client = Client(
        ClientConfig(mode=Mode[config.channel.upper()]), identity, Trust(roots), end.server_name, now,
        wall=certificate_clock(home),
    )
    sender = Sender(client, spool, writer, channel=config.channel, on_server_time=partial(keep_time, home))
    return Robot(
        source=source, capture=capture, writer=writer, spool=spool, client=client,
        servers=[config.server] if config.server else end.addresses(), sender=sender, box=box,
    )


def read_again(robot: Robot, home: RobotHome, running: RobotConfig) -> RobotConfig:
    """Reload robot.toml and the readers, without losing a message: topics, nodes, triggers,
    and readers; of a bag or a simulation, which was chosen from at the start, readers alone. What holds from now on.

    What cannot be used is told, and nothing changes.
    """
    keys = ("topics", "nodes", "trigger") if robot.source.live else ()
    try:
        config, said = reread(running, load_robot_config(home.config), keys)
        roots = read_certificates((home.identity / "ca.crt.pem").read_bytes())
        robot.reload(config, reader_keys(home, roots))
    except (BridgeError, OSError) as error:
        log.error("nothing is reloaded: %s", error)
        return running
    log.warning("%s", said)
    return config

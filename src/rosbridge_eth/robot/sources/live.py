"""What live sources have in common: a thread that receives, and a bounded backlog between it and the robot.

A live source must not make a publisher wait: ROS would slow the robot down, or drop the connection. So whatever
receives puts messages into the backlog without waiting, and the thread that runs the source takes them out. When there
is no room, the oldest message of the topic that takes most of it goes, and is counted: a camera that floods the robot
costs images, not the odometry beside it.
"""

from __future__ import annotations

import logging
import threading
from abc import abstractmethod
from collections import Counter, deque
from collections.abc import Mapping
from typing import Final

from rosbridge_eth.capture import RawMessage
from rosbridge_eth.robot.sources.protocol import Clock, Emit, Selection, Source

log = logging.getLogger(__name__)

MESSAGES: Final = 4096
SIZE: Final = 128 << 20
"""Bytes; twice the largest message that is decoded."""
OVERHEAD: Final = 512
"""Bytes counted for each message besides its own."""
TAKE_PATIENCE: Final = 0.1
"""Seconds after which the emitting thread looks whether it is to stop."""
LOST: Final = frozenset({"lost", "too_large", "foreign"})
"""Of what is counted, that for which a message is not in the log."""
MAX_SAID: Final = 2048
"""Things remembered as said."""


class LiveSource(Source):
    """A graph of publishers that come and go. It runs once.

    counts: of each topic by what happened to its messages or publishers, as the kinds of source say.
    """

    live = True

    def __init__(self, selection: Selection, clock: Clock | None, messages: int, size: int) -> None:
        self.counts: Counter[tuple[str, str]] = Counter()
        self._selection, self._clock = selection, clock or Clock()
        self._backlog = Backlog(messages, size)
        self._ending = threading.Event()
        self._failure: BaseException | None = None
        self._receiving = threading.Thread(target=self._receive_until_the_end, name=self.kind, daemon=True)
        self._said: dict[str, None] = {}
        self._lock = threading.RLock()  # of the counts and of what was said

    def watch(self, selection: Selection) -> None:
        self._selection = selection

    @abstractmethod
    def _receive(self) -> None:
        """Put what arrives into the backlog until `_ending` is set; in the thread that receives."""

    def _receive_until_the_end(self) -> None:
        try:
            self._receive()
        except BaseException as error:  # handed to the thread that runs the source, which raises it
            if not self._ending.is_set():
                self._failure = error
        finally:
            self._backlog.close()

    def run(self, emit: Emit, stop: threading.Event) -> None:
        """Emit what arrives until `stop` is set or the source is closed. Raises SourceError.

        `emit` may block for as long as it likes: what then finds no room is dropped.
        """
        self._receiving.start()
        try:
            while not stop.is_set():
                receiving = self._receiving.is_alive()  # asked first: then nothing comes after a take in vain
                message = self._backlog.take(TAKE_PATIENCE)
                if message is not None:
                    emit(message)
                elif not receiving:
                    break
        finally:
            self.close()
        if self._failure is not None:
            raise self._failure

    @property
    def lost(self) -> Mapping[tuple[str, str], int]:
        with self._lock:
            lost = {key: count for key, count in dict(self.counts).items() if key[1] in LOST}
        return lost | {(topic, "dropped"): count for topic, count in self._backlog.dropped.items()}

    def _say(self, key: str, text: str | None) -> None:
        """For the log, once for each key; None as text: it is over, say it anew the next time."""
        with self._lock:
            known = key in self._said
            if text is None:
                self._said.pop(key, None)
            elif not known:
                while len(self._said) >= MAX_SAID:
                    del self._said[next(iter(self._said))]
                self._said[key] = None
        if text is None and known:
            log.info("%s: in order again", key)
        elif text is not None and not known:
            log.warning("%s", text)


class Backlog:
    """A queue from one or several threads to one. Order is that of `put`, across topics.

    messages, size: how many messages and bytes are held, at most.
    """

    def __init__(self, messages: int = MESSAGES, size: int = SIZE) -> None:
        self._limit, self._size_limit = messages, size
        self._changed = threading.Condition()
        self._messages: dict[int, RawMessage] = {}  # by number of arrival
        self._by_topic: dict[str, deque[int]] = {}
        self._bytes: dict[str, int] = {}
        self._next = self._total = 0
        self._closed = False
        self._dropped: Counter[str] = Counter()

    def put(self, message: RawMessage) -> None:
        """Keep the message, making room where there is none. Does not wait."""
        size, topic = len(message.raw) + OVERHEAD, message.topic
        with self._changed:
            if self._closed:
                return
            if size > self._size_limit:
                self._drop(topic)
                return
            while len(self._messages) >= self._limit:
                self._drop_oldest(max(self._by_topic, key=lambda name: len(self._by_topic[name])))
            while self._total + size > self._size_limit:
                self._drop_oldest(max(self._bytes, key=self._bytes.__getitem__))
            self._messages[self._next] = message
            self._by_topic.setdefault(topic, deque()).append(self._next)
            self._bytes[topic] = self._bytes.get(topic, 0) + size
            self._total += size
            self._next += 1
            self._changed.notify()

    def take(self, timeout: float) -> RawMessage | None:
        """The oldest message; None after `timeout` seconds without one, or when closed and empty."""
        with self._changed:
            if not self._messages and not self._closed:
                self._changed.wait(timeout)
            return self._pop(next(iter(self._messages))) if self._messages else None

    def close(self) -> None:
        """Take no more; what is there can still be taken, and a waiting `take` returns."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()

    @property
    def dropped(self) -> Mapping[str, int]:
        """Messages that had to make room, by topic."""
        with self._changed:
            return dict(self._dropped)

    def _drop_oldest(self, topic: str) -> None:
        self._pop(self._by_topic[topic][0])
        self._drop(topic)

    def _pop(self, number: int) -> RawMessage:
        """Of its topic, a message is always the oldest when it leaves."""
        message = self._messages.pop(number)
        topic, size = message.topic, len(message.raw) + OVERHEAD
        self._by_topic[topic].popleft()
        self._bytes[topic] -= size
        self._total -= size
        if not self._by_topic[topic]:
            del self._by_topic[topic], self._bytes[topic]
        return message

    def _drop(self, topic: str) -> None:
        self._dropped[topic] += 1
        if self._dropped[topic] == 1:
            log.warning(
                "%s: messages arrive faster than they are taken, and the oldest are dropped and counted; "
                "set a rate, or choose fewer fields or topics", topic,
            )

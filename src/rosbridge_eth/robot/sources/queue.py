"""The queue between a source and the robot's loop, bounded by bytes. Where there is no room, one rule holds:

    waits         `put` waits for room: a bag or a simulation is read more slowly
    otherwise     the oldest message of the topic that takes most of the room is dropped and counted

A live source must not make a publisher wait: ROS would slow the robot down, or drop the connection. So a camera that
floods the robot costs images, not the odometry beside it.
"""

from __future__ import annotations

import logging
import threading
from collections import Counter, deque
from collections.abc import Mapping
from typing import Final

from rosbridge_eth.capture import RawMessage

log = logging.getLogger(__name__)

OVERHEAD: Final = 512
"""Bytes counted for each message besides its own."""


class Queue:
    """From one or several threads to one. Order is that of `put`, across topics.

    size: bytes that are held at most; a single message may be larger where `put` waits.
    """

    def __init__(self, size: int, *, waits: bool) -> None:
        self._size, self._waits = size, waits
        self._lock = threading.Lock()
        self._changed = threading.Condition(self._lock)
        self._messages: deque[RawMessage] = deque()
        self._bytes = Counter[str]()  # of each topic
        self._total = 0
        self._dropped = Counter[str]()
        self._closed = False

    def __len__(self) -> int:
        return len(self._messages)

    def put(self, message: RawMessage) -> bool:
        """Keep the message. Whether there was none before it."""
        topic, size = message.topic, len(message.raw) + OVERHEAD
        with self._lock:
            while self._waits and not self._closed and self._messages and self._total + size > self._size:
                self._changed.wait()
            if self._closed:
                return False
            if not self._waits and size > self._size:
                self._drop(topic)
                return False
            first = not self._messages
            while not self._waits and self._total + size > self._size:
                largest = max(self._bytes, key=self._bytes.__getitem__)
                oldest = next(number for number, each in enumerate(self._messages) if each.topic == largest)
                self._count(self._messages[oldest], -1)
                del self._messages[oldest]
                self._drop(largest)
            self._messages.append(message)
            self._count(message, 1)
            return first

    def take(self) -> RawMessage | None:
        """The oldest message; None where there is none. Does not wait."""
        with self._lock:
            if not self._messages:
                return None
            if self._waits and self._total <= self._size // 2:  # not at each message: waking a thread costs more
                self._changed.notify_all()
            message = self._messages.popleft()
            self._count(message, -1)
            return message

    def close(self) -> None:
        """Keep nothing more, and let nobody wait; what is there can still be taken."""
        with self._lock:
            self._closed = True
            self._changed.notify_all()

    @property
    def lost(self) -> Mapping[tuple[str, str], int]:
        """Messages that had to make room, by topic and "dropped"."""
        return {(topic, "dropped"): count for topic, count in dict(self._dropped).items()}

    def _count(self, message: RawMessage, sign: int) -> None:
        size = sign * (len(message.raw) + OVERHEAD)
        self._bytes[message.topic] += size
        self._total += size

    def _drop(self, topic: str) -> None:
        self._dropped[topic] += 1
        if self._dropped[topic] == 1:
            log.warning(
                "%s: messages arrive faster than they are taken, and the oldest are dropped and counted; "
                "set a rate, or choose fewer fields or topics", topic,
            )

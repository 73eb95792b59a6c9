"""The queue between the threads of a live source and the robot's loop, bounded by bytes.

A live source must not make a publisher wait: ROS would slow the robot down, or drop the connection. So `put` never
waits. Where there is no room, the oldest message of the topic that takes most of the room is dropped and counted: a
camera that floods the robot costs images, not the odometry beside it.
"""

from __future__ import annotations

import logging
import threading
from collections import Counter, deque
from typing import Final

from rosbridge_eth.capture import RawMessage

log = logging.getLogger(__name__)

OVERHEAD: Final = 512
"""Bytes counted for each message besides its own."""


class Queue:
    """From one or several threads to one. Order is that of `put`, across topics.

    size: bytes that are held at most. dropped: messages that had to make room, by topic.
    """

    def __init__(self, size: int) -> None:
        self.dropped = Counter[str]()
        self._size = size
        self._changed = threading.Condition()
        self._messages: dict[int, RawMessage] = {}  # by number of arrival
        self._numbers: dict[str, deque[int]] = {}  # of each topic, oldest first
        self._bytes = Counter[str]()  # of each topic
        self._next = self._total = 0
        self._closed = False

    def put(self, message: RawMessage) -> None:
        """Keep the message, and drop others to make room for it. Does not wait."""
        with self._changed:
            if self._closed:
                return
            topic, size = message.topic, len(message.raw) + OVERHEAD
            if size > self._size:
                self._drop(topic)
                return
            while self._total + size > self._size:
                largest = max(self._bytes, key=self._bytes.__getitem__)
                self._pop(self._numbers[largest][0])
                self._drop(largest)
            self._messages[self._next] = message
            self._numbers.setdefault(topic, deque()).append(self._next)
            self._bytes[topic] += size
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

    def _pop(self, number: int) -> RawMessage:
        """Of its topic, a message is always the oldest when it leaves."""
        message = self._messages.pop(number)
        size = len(message.raw) + OVERHEAD
        self._numbers[message.topic].popleft()
        self._bytes[message.topic] -= size
        self._total -= size
        return message

    def _drop(self, topic: str) -> None:
        self.dropped[topic] += 1
        if self.dropped[topic] == 1:
            log.warning(
                "%s: messages arrive faster than they are taken, and the oldest are dropped and counted; "
                "set a rate, or choose fewer fields or topics", topic,
            )

"""What a live source has received and the robot has not taken yet: bounded, and never an obstacle to receiving.

A live source must not make a publisher wait: ROS would slow the robot down, or
drop the connection. So whatever receives puts messages here without waiting,
and whatever feeds the robot takes them out. When there is no room, the oldest
message of the topic that takes most of it goes, and is counted: a camera that
floods the robot costs images, not the odometry beside it.
"""

from __future__ import annotations

import logging
import threading
from collections import deque
from collections.abc import Mapping
from typing import Final

from rosbridge_eth.capture import RawMessage

log = logging.getLogger(__name__)

MESSAGES: Final = 4096
SIZE: Final = 128 << 20
"""Bytes; twice the largest message that is decoded."""
OVERHEAD: Final = 512
"""Bytes counted for each message besides its own."""


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
        self._next = 0
        self._total = 0
        self._closed = False
        self._dropped: dict[str, int] = {}

    def put(self, message: RawMessage) -> None:
        """Keep the message, making room where there is none. Does not wait."""
        size, topic, said = len(message.raw) + OVERHEAD, message.topic, None
        with self._changed:
            if self._closed:
                return
            if size > self._size_limit:
                said = self._count(topic)
            else:
                while len(self._messages) >= self._limit:
                    said = self._drop_oldest(max(self._by_topic, key=lambda name: len(self._by_topic[name]))) or said
                while self._total + size > self._size_limit:
                    said = self._drop_oldest(max(self._bytes, key=self._bytes.__getitem__)) or said
                self._messages[self._next] = message
                self._by_topic.setdefault(topic, deque()).append(self._next)
                self._bytes[topic] = self._bytes.get(topic, 0) + size
                self._total += size
                self._next += 1
                self._changed.notify()
        if said is not None:
            log.warning(
                "%s: messages arrive faster than they are taken, and the oldest are dropped and counted; "
                "set a rate, or choose fewer fields or topics",
                said,
            )

    def take(self, timeout: float) -> RawMessage | None:
        """The oldest message; None after `timeout` seconds without one, or when closed and empty."""
        with self._changed:
            if not self._messages and not self._closed:
                self._changed.wait(timeout)
            if not self._messages:
                return None
            number = next(iter(self._messages))
            message = self._messages.pop(number)
            self._forget(message)
            return message

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

    def __len__(self) -> int:
        return len(self._messages)

    def _drop_oldest(self, topic: str) -> str | None:
        self._forget(self._messages.pop(self._by_topic[topic][0]))
        return self._count(topic)

    def _forget(self, message: RawMessage) -> None:
        """Of its topic, a message is always the oldest when it leaves."""
        topic, size = message.topic, len(message.raw) + OVERHEAD
        self._by_topic[topic].popleft()
        self._bytes[topic] -= size
        self._total -= size
        if not self._by_topic[topic]:
            del self._by_topic[topic], self._bytes[topic]

    def _count(self, topic: str) -> str | None:
        """The topic if it is the first time."""
        self._dropped[topic] = self._dropped.get(topic, 0) + 1
        return topic if self._dropped[topic] == 1 else None

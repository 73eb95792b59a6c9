"""Messages between the sockets and whoever takes them: bounded, and never in the sockets' way.

A publisher must not be made to wait: rospy would hold up the robot's own
program. So when there is no room, the topic that takes most of it loses its
oldest message; a slow topic keeps its place beside a camera.
"""

from __future__ import annotations

import threading
from collections import OrderedDict, deque

from rosbridge_eth.capture import RawMessage


class WaitingRoom:
    """At most `messages` messages and `size` bytes. One thread puts, another takes."""

    def __init__(self, messages: int, size: int) -> None:
        self._messages, self._size = messages, size
        self._queue: OrderedDict[int, RawMessage] = OrderedDict()
        self._of_topic: dict[str, deque[int]] = {}
        self._bytes_of: dict[str, int] = {}
        self._bytes = 0
        self._next = 0
        self._condition = threading.Condition()

    def put(self, message: RawMessage) -> list[RawMessage]:
        """Add a message; what had to go for it, which may be itself if it alone is too large. Never waits."""
        dropped = []
        with self._condition:
            self._queue[self._next] = message
            self._of_topic.setdefault(message.topic, deque()).append(self._next)
            self._account(message, len(message.raw))
            self._next += 1
            while len(self._queue) > self._messages or self._bytes > self._size:
                dropped.append(self._drop())
            self._condition.notify()
        return dropped

    def take(self, timeout: float) -> RawMessage | None:
        """The oldest message; None if none comes within `timeout` seconds."""
        with self._condition:
            if not self._queue and not self._condition.wait_for(lambda: bool(self._queue), timeout):
                return None
            _, message = self._queue.popitem(last=False)
            self._of_topic[message.topic].popleft()
            self._account(message, -len(message.raw))
            return message

    def __len__(self) -> int:
        return len(self._queue)

    def _drop(self) -> RawMessage:
        share = self._bytes_of.__getitem__ if self._bytes > self._size else lambda topic: len(self._of_topic[topic])
        topic = max(self._of_topic, key=share)
        message = self._queue.pop(self._of_topic[topic].popleft())
        self._account(message, -len(message.raw))
        return message

    def _account(self, message: RawMessage, size: int) -> None:
        self._bytes += size
        self._bytes_of[message.topic] = self._bytes_of.get(message.topic, 0) + size
        if not self._of_topic[message.topic]:
            del self._of_topic[message.topic], self._bytes_of[message.topic]

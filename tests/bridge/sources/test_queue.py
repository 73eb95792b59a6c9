"""What a live source keeps for a robot that is slow: order, bounds, whom a flood costs its messages."""

from __future__ import annotations

import threading

import pytest

from rosbridge_eth.capture import RawMessage, Wire, decoder_for
from rosbridge_eth.robot.sources import Selection
from rosbridge_eth.robot.sources.live import LiveSource
from rosbridge_eth.robot.sources.queue import OVERHEAD, Queue

DECODER = decoder_for(Wire.CDR, "std_msgs/msg/String", "string data")


def message(topic: str, number: int, size: int = 10) -> RawMessage:
    return RawMessage(topic, "std_msgs/msg/String", number, bytes(size), DECODER)


def drain(queue: Queue) -> list[tuple[str, int]]:
    found = []
    while (taken := queue.take(0)) is not None:
        found.append((taken.topic, taken.received_ns))
    return found


def test_what_came_just_before_the_end_is_not_left_behind(monkeypatch):
    """The message comes, and the receiving thread ends, after the emitting one found nothing."""

    class Late(LiveSource):
        kind = "late"

        def offers(self):
            return ()

        def _receive(self):
            waited.wait(5)
            self._queue.put(message("/a", 1))

    waited, emitted = threading.Event(), []
    source = Late(Selection(["/a"]), None, 10_000)
    take = source._queue.take

    def nothing_yet(timeout):
        if waited.is_set():
            return take(timeout)
        waited.set()
        source._receiving.join()
        return None

    monkeypatch.setattr(source._queue, "take", nothing_yet)
    source.run(emitted.append, threading.Event())
    assert [each.received_ns for each in emitted] == [1]


def test_order_is_that_of_arrival_across_topics():
    queue = Queue(1 << 20)
    sent = [(f"/{number % 3}", number) for number in range(100)]
    for topic, number in sent:
        queue.put(message(topic, number))
    assert drain(queue) == sent
    assert queue.dropped == {}


def test_a_flood_costs_its_own_topic_and_the_newest_stay(caplog):
    queue = Queue(7 * (1000 + OVERHEAD) + 3 * (10 + OVERHEAD))
    queue.put(message("/odom", 0))
    for number in range(1000):
        queue.put(message("/camera", number, 1000))
        queue.put(message("/odom", number + 1)) if number in (300, 600) else None
    kept = drain(queue)
    assert [number for topic, number in kept if topic == "/odom"] == [0, 301, 601]
    assert [number for topic, number in kept if topic == "/camera"] == list(range(993, 1000))
    assert queue.dropped == {"/camera": 993}
    assert len(caplog.records) == 1
    assert "/camera" in caplog.text


def test_many_small_messages_do_not_cost_a_few_large_ones_their_place():
    queue = Queue(1_000_000)
    for number in range(3):
        queue.put(message("/map", number, 100_000))
    for number in range(5000):
        queue.put(message("/imu", number, 10))
    kept = (1_000_000 - 3 * (100_000 + OVERHEAD)) // (10 + OVERHEAD)
    assert queue.dropped == {"/imu": 5000 - kept}
    assert [number for topic, number in drain(queue) if topic == "/map"] == [0, 1, 2]


@pytest.mark.parametrize("size", [1, 1000, 5000])
def test_bytes_are_bounded(size):
    limit = 20_000
    queue = Queue(limit)
    for number in range(100):
        queue.put(message("/a", number, size))
    kept = drain(queue)
    assert len(kept) == min(100, limit // (size + OVERHEAD))
    assert kept[-1] == ("/a", 99)
    assert queue.dropped.get("/a", 0) == 100 - len(kept)


def test_a_message_above_the_bound_does_not_cost_the_others():
    queue = Queue(10_000)
    queue.put(message("/odom", 1))
    queue.put(message("/map", 2, 10_001))
    assert drain(queue) == [("/odom", 1)]
    assert queue.dropped == {"/map": 1}


def test_closing_ends_a_wait_and_keeps_what_was_received():
    queue = Queue(1 << 20)
    queue.put(message("/a", 1))
    found: list[RawMessage | None] = []

    def take_two() -> None:
        found.extend((queue.take(60), queue.take(60)))

    waiting = threading.Thread(target=take_two)
    waiting.start()
    queue.close()
    waiting.join(10)
    assert not waiting.is_alive()
    assert [taken and taken.received_ns for taken in found] == [1, None]
    queue.put(message("/a", 2))
    assert drain(queue) == []


class Quick(LiveSource):
    """A graph that publishes ten messages at once, and knows of others that did not come through."""

    kind = "ros2"

    def offers(self):
        return ()

    def _receive(self):
        with self._queue._changed:  # none is taken in between
            for number in range(10):
                self._queue.put(message("/a", number))
        self._losses["/a", "lost"] += 3
        self._losses["/b", "foreign"] += 1


def test_what_a_live_source_loses_is_told_by_topic_and_why():
    source, emitted = Quick(Selection(["**"]), None, 4 * (10 + OVERHEAD)), []
    source.run(emitted.append, threading.Event())
    assert [raw.received_ns for raw in emitted] == [6, 7, 8, 9], "it ends when its graph has, and nothing waits"
    assert source.lost == {("/a", "dropped"): 6, ("/a", "lost"): 3, ("/b", "foreign"): 1}

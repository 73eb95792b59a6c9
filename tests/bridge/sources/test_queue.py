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
    while (taken := queue.take()) is not None:
        found.append((taken.topic, taken.received_ns))
    return found


def test_order_is_that_of_arrival_across_topics():
    queue = Queue(1 << 20, waits=False)
    sent = [(f"/{number % 3}", number) for number in range(100)]
    for topic, number in sent:
        queue.put(message(topic, number))
    assert drain(queue) == sent
    assert queue.lost == {}


def test_a_flood_costs_its_own_topic_and_the_newest_stay(caplog):
    queue = Queue(7 * (1000 + OVERHEAD) + 3 * (10 + OVERHEAD), waits=False)
    queue.put(message("/odom", 0))
    for number in range(1000):
        queue.put(message("/camera", number, 1000))
        queue.put(message("/odom", number + 1)) if number in (300, 600) else None
    kept = drain(queue)
    assert [number for topic, number in kept if topic == "/odom"] == [0, 301, 601]
    assert [number for topic, number in kept if topic == "/camera"] == list(range(993, 1000))
    assert queue.lost == {("/camera", "dropped"): 993}
    assert len(caplog.records) == 1
    assert "/camera" in caplog.text


def test_many_small_messages_do_not_cost_a_few_large_ones_their_place():
    queue = Queue(1_000_000, waits=False)
    for number in range(3):
        queue.put(message("/map", number, 100_000))
    for number in range(5000):
        queue.put(message("/imu", number, 10))
    kept = (1_000_000 - 3 * (100_000 + OVERHEAD)) // (10 + OVERHEAD)
    assert queue.lost == {("/imu", "dropped"): 5000 - kept}
    assert [number for topic, number in drain(queue) if topic == "/map"] == [0, 1, 2]


@pytest.mark.parametrize("size", [1, 1000, 5000])
def test_bytes_are_bounded(size):
    limit = 20_000
    queue = Queue(limit, waits=False)
    for number in range(100):
        queue.put(message("/a", number, size))
    kept = drain(queue)
    assert len(kept) == min(100, limit // (size + OVERHEAD))
    assert kept[-1] == ("/a", 99)
    assert queue.lost.get(("/a", "dropped"), 0) == 100 - len(kept)


def test_a_message_above_the_bound_does_not_cost_the_others():
    queue = Queue(10_000, waits=False)
    queue.put(message("/odom", 1))
    queue.put(message("/map", 2, 10_001))
    assert drain(queue) == [("/odom", 1)]
    assert queue.lost == {("/map", "dropped"): 1}


def test_where_put_waits_nothing_is_dropped_and_the_bound_is_kept():
    queue, found = Queue(5 * (10 + OVERHEAD), waits=True), []

    def put_all() -> None:
        for number in range(1000):
            queue.put(message("/a", number))

    putting = threading.Thread(target=put_all)
    putting.start()
    while len(found) < 1000:
        assert len(queue) <= 5
        if (taken := queue.take()) is not None:
            found.append(taken.received_ns)
    putting.join(10)
    assert found == list(range(1000)) and queue.lost == {}


def test_a_message_larger_than_the_bound_passes_where_put_waits():
    queue = Queue(1000, waits=True)
    assert queue.put(message("/map", 1, 100_000))
    assert drain(queue) == [("/map", 1)]


def test_put_tells_whether_there_was_nothing_before():
    queue = Queue(1 << 20, waits=False)
    assert [queue.put(message("/a", number)) for number in range(3)] == [True, False, False]
    drain(queue)
    assert queue.put(message("/a", 4))


def test_closing_ends_a_wait_and_keeps_what_was_received():
    queue = Queue(10 + OVERHEAD, waits=True)
    queue.put(message("/a", 1))
    waiting = threading.Thread(target=lambda: queue.put(message("/a", 2)))
    waiting.start()
    queue.close()
    waiting.join(10)
    assert not waiting.is_alive()
    queue.put(message("/a", 3))
    assert drain(queue) == [("/a", 1)]


def test_what_a_live_source_loses_is_told_by_topic_and_why():
    class Quick(LiveSource):
        """A graph that publishes ten messages at once, and knows of others that did not come through."""

        kind = "ros2"

        def offers(self):
            return ()

        def run(self, emit, stop):
            for number in range(10):
                emit(message("/a", number))
            self._losses["/a", "lost"] += 3
            self._losses["/b", "foreign"] += 1

    source, queue = Quick(Selection(["**"]), None), Queue(4 * (10 + OVERHEAD), waits=False)
    source.run(queue.put, threading.Event())
    assert [number for _, number in drain(queue)] == [6, 7, 8, 9]
    assert {**source.lost, **queue.lost} == {("/a", "dropped"): 6, ("/a", "lost"): 3, ("/b", "foreign"): 1}

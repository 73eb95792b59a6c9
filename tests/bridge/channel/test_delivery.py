"""Loss detection, probes and answers of one session, packet by packet: RFC 9002 in exact numbers.

The client's packets are kept from the server; the test answers in the server's name, and chooses what it acknowledges.
"""

from __future__ import annotations

import pytest

from bridge.channel.steps import Steps, events
from rosbridge_eth.channel import End
from rosbridge_eth.channel.delivery import MAX_PTO
from rosbridge_eth.channel.transfer import NEVER
from rosbridge_eth.channel.wire import PROBE, SEGMENT_SIZE, Answer


class Line:
    """A client whose packets nobody gets; `acknowledge` says the contrary of some of them."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, silence: float = 1000.0) -> None:
        for name, value in (("SILENCE", silence), ("PROBE_FIRST", 1000.0), ("KEEP_ALIVE", 1000.0)):
            monkeypatch.setattr(f"rosbridge_eth.channel.client.{name}", value)
        self.steps = Steps().until_connected()
        self.client = self.steps.client
        self.sending = self.client._session.sending
        self.now = 1000.0
        self.client.handle_timer(self.now)
        [number] = self.send(10)
        self.acknowledge([number], round_trip=0.1, next_segment=1)  # its round trip is the first sample
        events(self.client)

    def pass_time(self, seconds: float) -> list[int]:
        """Let every timer fire that is due until then; the numbers of the packets that were sent."""
        end = self.now + seconds
        sent = self.flush()
        while (when := self.client.next_timer()) is not None and when <= end:
            self.now = max(self.now, when)
            self.client.handle_timer(self.now)
            sent += self.flush()
        self.now = end
        return sent

    def flush(self) -> list[int]:
        sent = self.client.datagrams_to_send(self.now)
        return [int.from_bytes(data[9:13], "big") for data, _ in sent]

    def send(self, *sizes: int) -> list[int]:
        """Messages, each in packets of its own."""
        numbers = []
        for size in sizes:
            self.client.send(bytes(size - 4))
            numbers += self.flush()
        return numbers

    def acknowledge(self, numbers: list[int], *, round_trip: float = 0.0, next_segment: int = 0) -> None:
        self.now += round_trip
        largest = max(numbers)
        bits = sum(1 << largest - number for number in numbers)
        session = self.steps.session
        session.credit += 1200
        datagram = session.seal(Answer(largest, next_segment, 0, bits, b"").to_bytes())
        self.client.receive_datagram(datagram, ("192.0.2.1", 4433), self.now)

    @property
    def counted(self) -> tuple[int, int]:
        counted = self.client.statistics()
        return counted["packets_lost"], counted["retransmitted"]


def test_a_packet_is_lost_when_a_later_one_is_acknowledged_and_nine_eighths_of_a_round_trip_have_passed(monkeypatch):
    line = Line(monkeypatch)
    a, b, c = line.send(100, 100, 100)
    line.acknowledge([b, c], round_trip=0.1)
    assert line.counted == (0, 0)  # 1/8 of a round trip is left for what was overtaken
    delay = line.sending._round_trip.loss_delay()
    assert delay == pytest.approx(9 / 8 * 0.1)
    assert line.pass_time(delay - 0.1 - 0.001) == []
    assert line.counted == (0, 0)
    again = line.pass_time(0.002)
    assert len(again) == 1 and line.counted == (1, 1)
    line.acknowledge(again, round_trip=0.1)
    assert line.sending.oldest == NEVER and not line.sending._unsent
    line.acknowledge([a, b, c, *again])  # a late one, too, changes nothing
    assert line.counted == (1, 1)


def test_what_nobody_acknowledges_is_probed_and_not_taken_for_lost(monkeypatch):
    line = Line(monkeypatch)
    line.send(100, 100, 100)
    pto = line.sending.pto
    assert line.pass_time(pto - 0.001) == []
    for count in range(1, 4):
        assert len(line.pass_time(0.002)) == 2
        assert line.counted == (0, 2 * count)
        assert line.pass_time(pto * 2**count - 0.003) == []
        line.pass_time(0.001)


def test_the_probe_timeout_is_four_seconds_at_most_and_short_again_after_an_acknowledgement(monkeypatch):
    line = Line(monkeypatch)
    line.send(100)
    sent = line.pass_time(60.0)
    assert 60 / MAX_PTO <= len(sent) / 2 <= 60 / MAX_PTO + 8
    line.acknowledge(sent[-1:])
    line.send(100)
    before = line.sending.pto
    assert len(line.pass_time(before + 0.001)) == 2


def test_a_segment_is_not_sent_again_for_a_packet_whose_place_another_has_taken(monkeypatch):
    line = Line(monkeypatch)
    line.send(100, 100)
    probes = line.pass_time(line.sending.pto + 0.001)
    assert len(probes) == 2 and line.counted == (0, 2)
    [later] = line.send(100)
    line.acknowledge([later], round_trip=0.05)
    assert line.flush() == []  # both packets of before are lost, but their segments are on their way already
    assert line.counted == (2, 2)
    line.acknowledge([*probes, later])
    assert line.sending.oldest == NEVER and line.counted == (2, 2)


def test_a_segment_that_arrived_is_not_sent_again_though_its_packets_acknowledgement_was_lost(monkeypatch):
    line = Line(monkeypatch)
    line.send(100, 100)
    [third] = line.send(100)
    line.acknowledge([third], round_trip=0.1, next_segment=4)  # segments 1 to 3, that is all of them
    assert line.sending._segments == {} and not line.sending._unsent
    line.pass_time(1.0)
    assert line.counted[1] == 0


def test_who_waits_for_nothing_any_more_does_not_find_its_peer_silent(monkeypatch):
    line = Line(monkeypatch, silence=5.0)
    line.send(100, 100)
    [third] = line.send(100)
    line.acknowledge([third], round_trip=0.1, next_segment=4)
    line.pass_time(8.0)  # the first two packets are lost, and what was in them has arrived
    assert line.sending.oldest == NEVER and line.client.connected


def test_only_what_is_named_is_acknowledged(monkeypatch):
    line = Line(monkeypatch)
    numbers = line.send(*[100] * 9)
    line.acknowledge([numbers[0], numbers[3], numbers[8]])
    assert sorted(line.sending._flights) == [n for i, n in enumerate(numbers) if i not in (0, 3, 8)]
    assert len(line.sending._segments) == 6


def test_what_is_lost_goes_again_in_the_order_of_the_stream_and_before_what_is_new(monkeypatch):
    line = Line(monkeypatch)
    line.send(*[SEGMENT_SIZE] * 5)
    [last] = line.send(100)
    order: list[int] = []
    real = line.sending.next
    line.sending.next = lambda now: (
        (found := real(now)) and order.append(int.from_bytes(found[1][1:5], "big"))
    ) or found
    line.acknowledge([last], round_trip=0.2)
    line.client.handle_timer(line.now + 0.05)
    line.client.send(bytes(50))
    line.flush()
    assert order == [1, 2, 3, 4, 5, 7]


def test_without_an_outage_the_window_is_kept_and_after_one_it_begins_anew(monkeypatch):
    line = Line(monkeypatch)
    before = line.sending._window.size
    line.send(100)
    pto = line.sending.pto
    line.pass_time(3 * pto + 0.01)  # two probe timeouts
    assert line.sending._window.size == before
    line.pass_time(4 * pto)
    assert line.sending._window.size == 2 * 1200


def test_a_server_answers_after_eight_packets_at_once_at_a_gap_and_else_after_its_delay():
    steps = Steps().until_connected()
    count = iter(range(1000))

    def packet() -> list[bytes]:
        return steps.from_client(b"\1" + next(count).to_bytes(4, "big") + bytes(100))

    assert [len(packet()) for _ in range(17)] == [0] * 7 + [1] + [0] * 7 + [1] + [0]
    assert steps.server.next_timer() <= steps.now
    steps.server.handle_timer(steps.now)  # the sweep
    assert steps.server.next_timer() == pytest.approx(steps.now + 0.02)
    steps.client._session.sending.take_number()
    assert len(packet()) == 1  # a number is missing
    assert len(packet()) == 0
    steps.now += 0.02
    steps.server.handle_timer(steps.now)
    assert len(steps.server.datagrams_to_send(steps.now)) == 1
    assert steps.server.next_timer() > steps.now + 0.4
    assert len(steps.from_client(PROBE)) == 1  # at once


def test_a_sender_goes_no_further_than_the_receiver_has_room_beyond_a_segment_that_is_missing(monkeypatch):
    line = Line(monkeypatch)
    monkeypatch.setattr("rosbridge_eth.channel.transfer.SEGMENTS", 4)
    numbers = line.send(*[100] * 6)
    assert len(numbers) == 4  # segments 1 to 4
    line.acknowledge(numbers[1:], round_trip=0.05, next_segment=1)
    assert line.flush() == []
    [again] = line.pass_time(line.sending.pto)[:1]
    line.acknowledge([again], next_segment=5)
    assert len(line.flush()) == 1  # both that waited, in one


def test_a_session_ends_when_its_peers_numbers_are_used_up():
    steps = Steps().until_connected()
    events(steps.server)
    steps.client._session.sending.packets = 2**20 - 1
    steps.from_client(PROBE)
    assert events(steps.server) == []
    steps.from_client(PROBE)
    [ended] = events(steps.server)
    assert ended.reason is End.EXPIRED

"""Peers that hold a good session and misuse it, and strangers who touch somebody's session.

A stranger changes nothing. A peer that breaks the protocol loses its session,
and what it can make this end hold is bounded.
"""

from __future__ import annotations

import random

import pytest

from bridge.channel.steps import HERE, Steps, dropped, events, flipped
from bridge.channel.world import SERVER_ADDRESS, make_client, make_server
from rosbridge_eth.channel import (
    AddressChanged,
    ClientConfig,
    Disconnected,
    Drop,
    End,
    Full,
    MessageAnswered,
    MessageReceived,
    ServerConfig,
)
from rosbridge_eth.channel.session import PART_SIZE, Parts
from rosbridge_eth.channel.wire import PART, WHOLE, Frame, Malformed, ack_frame

ELSEWHERE = ("203.0.113.66", 6666)


def connected(config: ServerConfig | None = None, **options) -> Steps:
    steps = Steps(server=make_server(1000.0, config), **options).until_connected()
    events(steps.server)
    return steps


def from_client(steps: Steps, frames: bytes) -> list[bytes]:
    """A packet of the client's keys with any frames at all in it."""
    return steps.to_server(steps.client._session._seal(frames, steps.now))


def from_server(steps: Steps, frames: bytes) -> list[bytes]:
    [connection] = steps.server._connections.values()
    return steps.to_client(connection.session._seal(frames, steps.now))


def message(ident: int, payload: bytes = b"x") -> bytes:
    return WHOLE.pack(Frame.MESSAGE, ident, len(payload)) + payload


def part(ident: int, total: int, offset: int, data: bytes, kind: Frame = Frame.MESSAGE_PART) -> bytes:
    return PART.pack(kind, ident, total, offset, len(data)) + data


BREACHES_OF_A_CLIENT = {
    "no frame that exists": b"\x00",
    "a server's frame": WHOLE.pack(Frame.ANSWER, 0, 1) + b"x",
    "acknowledgement of a packet never sent": ack_frame([(0, 1000)], 0.0),
    "acknowledgement below zero": bytes((Frame.ACK,)) + (1).to_bytes(6, "big") + bytes(2) + b"\0\x09" + b"\0",
    "empty range": bytes((Frame.ACK,)) + (1).to_bytes(6, "big") + bytes(4) + b"\1" + bytes(4),
    "message longer than its packet": WHOLE.pack(Frame.MESSAGE, 0, 500) + b"short",
    "half a frame": WHOLE.pack(Frame.MESSAGE, 0, 500)[:5],
    "half an acknowledgement": ack_frame([(0, 0)], 0.0)[:7],
    "message too long": part(0, 0xFFFF, 0, bytes(1000)),
    "part outside its message": part(0, 2000, 1900, bytes(300)),
    "crumbs": part(0, 2000, 0, bytes(10)),
    "empty part": part(0, 2000, 0, b""),
    "parts of two lengths": part(0, 900, 0, bytes(300)) + part(0, 901, 300, bytes(300)),
    "overlapping parts": part(0, 600, 0, bytes(300)) + part(0, 600, 290, bytes(300)),
    "epoch skipped": bytes((Frame.KEY_UPDATE,)) + (7).to_bytes(4, "big"),
    "half an epoch": bytes((Frame.KEY_UPDATE, 0)),
    "close without a reason": bytes((Frame.CLOSE,)),
    "close for no reason that exists": bytes((Frame.CLOSE, 99)),
}


@pytest.mark.parametrize("breach", BREACHES_OF_A_CLIENT)
def test_a_client_that_breaks_the_protocol_loses_its_session(breach):
    steps = connected()
    answers = from_client(steps, BREACHES_OF_A_CLIENT[breach])
    [ended] = [e for e in events(steps.server) if isinstance(e, Disconnected)]
    assert ended.reason is End.PROTOCOL
    assert steps.server.statistics().held_bytes == 0
    steps.to_client(*answers)
    [told] = events(steps.client)
    assert isinstance(told, Disconnected) and told.reason is End.PROTOCOL


BREACHES_OF_A_SERVER = {
    "a client's frame": message(0),
    "answer to nothing": WHOLE.pack(Frame.ANSWER, 5, 1) + b"x",
    "part of an answer to nothing": part(5, 900, 0, bytes(300), Frame.ANSWER_PART),
    "acknowledgement of a packet never sent": ack_frame([(0, 1000)], 0.0),
    "answer too long": part(0, 0xFFFF, 0, bytes(1000), Frame.ANSWER_PART),
    "half an acceptance": bytes((Frame.ACCEPTED,)) + bytes(10),
}


@pytest.mark.parametrize("breach", BREACHES_OF_A_SERVER)
def test_a_server_that_breaks_the_protocol_loses_the_client(breach):
    steps = connected()
    asked = steps.client.send(b"question")
    from_server(steps, BREACHES_OF_A_SERVER[breach])
    [ended] = events(steps.client)
    assert ended.reason is End.PROTOCOL and ended.unanswered == (asked,)


def test_random_frames_never_do_anything_but_end_the_session():
    draw = random.Random(7)
    steps = connected()
    for _ in range(200):
        if steps.client.state != "connected":
            steps = connected()
        from_client(steps, draw.randbytes(draw.randrange(1, 80)))
        from_server_frames = bytes((draw.randrange(1, 13),)) + draw.randbytes(draw.randrange(0, 60))
        if steps.server._connections:
            from_server(steps, from_server_frames)
        if not steps.server._connections:
            steps = connected()


def test_a_message_id_used_again_is_delivered_once():
    steps = connected()
    for _ in range(5):
        from_client(steps, message(0, b"first") + message(0, b"second"))
    heard = events(steps.server)
    assert [e.payload for e in heard] == [b"first"]
    steps.server.reply(heard[0].connection, 0, b"answer")
    with pytest.raises(ValueError, match="not waiting"):
        steps.server.reply(heard[0].connection, 0, b"answer")
    with pytest.raises(ValueError, match="not waiting"):
        steps.server.reply(heard[0].connection, 1, b"answer to nothing")
    from_client(steps, message(0, b"third") + part(0, 900, 0, bytes(300)))
    assert events(steps.server) == []


def test_what_a_client_makes_the_server_hold_is_bounded():
    config = ServerConfig(max_unanswered=8, max_unanswered_bytes=50_000, max_total_bytes=300_000)
    steps = connected(config)
    for ident in range(600):
        from_client(steps, part(ident, 40_000, 0, bytes(1000)))  # messages that never end
    assert steps.server.statistics().held_bytes <= 2 * 50_000
    [connection] = steps.server._connections.values()
    assert len(connection.session._incoming) <= 4 * 8
    assert dropped(steps.server)[Drop.FULL] > 500
    assert events(steps.server) == []
    from_client(steps, message(5_000_000))
    assert events(steps.server) == []


def test_all_clients_together_hold_no_more_than_the_total():
    config = ServerConfig(max_total_bytes=120_000)
    server = make_server(1000.0, config)
    from bridge.channel.world import robot

    for number in range(4):
        client = make_client(1000.0, None, robot(f"robot_{number}"))
        steps = Steps(server=server, client=client).until_connected()
        for ident in range(100):
            from_client(steps, message(ident, bytes(1100)))
    heard = [e for e in events(server) if isinstance(e, MessageReceived)]
    assert sum(len(e.payload) for e in heard) <= 120_000
    for event in heard:
        server.reply(event.connection, event.message_id, b"")
    server.close(1000.0)
    assert server.statistics().held_bytes == 0


def test_what_is_refused_for_lack_of_room_is_not_acknowledged():
    steps = connected(ServerConfig(max_unanswered=1, max_unanswered_bytes=48 * 1024, max_total_bytes=1500))
    from_client(steps, message(0, bytes(1100)))
    [connection] = steps.server._connections.values()
    before = list(connection.session._received.ranges)
    from_client(steps, message(1, bytes(1100)))
    assert connection.session._received.ranges == before


def test_a_client_takes_no_more_messages_than_may_wait():
    steps = Steps(
        server=make_server(1000.0, ServerConfig(max_unanswered=5)),
        client=make_client(1000.0, ClientConfig(max_unanswered=100)),
    ).until_connected()
    for _ in range(5):
        assert steps.client.writable(steps.now)
        steps.client.send(b"x")
    assert not steps.client.writable(steps.now)
    with pytest.raises(Full):
        steps.client.send(b"x")


def test_epochs_cannot_be_driven_on_without_end():
    steps = connected()
    [connection] = steps.server._connections.values()
    for epoch in range(1, 50):
        from_client(steps, bytes((Frame.KEY_UPDATE,)) + epoch.to_bytes(4, "big"))
        if not steps.server._connections:
            break
        assert len(connection.session._in) <= 2
    assert connection.session._in_epoch == 1  # one a second, whatever is asked for


# Strangers


def test_every_flipped_bit_of_a_packet_is_dropped_and_the_packet_still_counts():
    steps = connected()
    steps.client.send(b"the message")
    [(packet, _)] = steps.client.datagrams_to_send(steps.now)
    for bit in range(len(packet) * 8):
        for answer in steps.to_server(flipped(packet, bit)):
            assert answer[0] == 5  # the connection id was hit: a reset for a connection nobody has
    for length in range(len(packet)):
        assert [a for a in steps.to_server(packet[:length]) if a[0] != 5] == []
    assert events(steps.server) == []
    steps.to_server(packet)
    before = dropped(steps.server)[Drop.REPLAYED]
    steps.to_server(packet)
    assert [e.payload for e in events(steps.server)] == [b"the message"]
    assert dropped(steps.server)[Drop.REPLAYED] == before + 1


def test_forged_numbers_do_not_move_the_replay_window():
    steps = connected()
    steps.client.send(b"the message")
    [(packet, _)] = steps.client.datagrams_to_send(steps.now)
    for number in (2**47, 2**40, 5000, 10):
        steps.to_server(packet[:9] + number.to_bytes(6, "big") + packet[15:])
    steps.to_server(packet)
    assert len(events(steps.server)) == 1


def test_a_reset_without_the_token_is_ignored_and_with_it_is_not():
    steps = connected()
    session = steps.client._session
    draw = random.Random(3)
    for _ in range(1000):
        steps.to_client(b"\x05\x01" + session.remote_cid + draw.randbytes(16))
    token = session.accepted.reset_token
    for bit in range(128):
        steps.to_client(b"\x05\x01" + session.remote_cid + flipped(token, bit))
    steps.to_client(b"\x05\x01" + bytes(8) + token)
    assert events(steps.client) == [] and dropped(steps.client)[Drop.RESET] == 1129
    steps.to_client(b"\x05\x01" + session.remote_cid + token)
    [ended] = events(steps.client)
    assert ended.reason is End.RESET


def test_nobody_learns_the_token_of_a_living_session():
    """Another process of the server does not know the connection; it must not say what would end it."""
    steps = connected()
    steps.client.send(b"x")
    [(packet, _)] = steps.client.datagrams_to_send(steps.now)
    other = make_server(1000.0, ServerConfig(worker=1))
    other.receive_datagram(packet, ELSEWHERE, steps.now)
    assert other.datagrams_to_send(steps.now) == []
    steps.server.receive_datagram(flipped(packet, 200), ELSEWHERE, steps.now)
    assert steps.server.datagrams_to_send(steps.now) == []


def test_resets_are_limited_and_smaller_than_what_draws_them():
    server = make_server(1000.0, ServerConfig(reset_rate=10.0))
    sent = 0
    for number in range(500):
        server.receive_datagram(b"\x40\0" + number.to_bytes(7, "big") + bytes(23), ELSEWHERE, 1000.0)
        for data, _ in server.datagrams_to_send(1000.0):
            assert len(data) < 32
            sent += 1
    assert sent == 10


def test_packets_copied_to_another_address_move_nothing_and_draw_at_most_three_bytes_for_one():
    """Somebody on the path repeats the client's newest packets from his own address, before they arrive."""
    steps = connected()
    drawn = spent = 0
    for number in range(50):
        steps.now += 0.1
        steps.client.send(b"%d" % number)
        for data, _ in steps.client.datagrams_to_send(steps.now):
            steps.server.receive_datagram(data, ELSEWHERE, steps.now)
            spent += len(data)
        for event in events(steps.server):
            assert isinstance(event, MessageReceived)
            steps.server.reply(event.connection, event.message_id, bytes(5000))
        for data, address in steps.server.datagrams_to_send(steps.now):
            assert address in (HERE, ELSEWHERE)
            if address == ELSEWHERE:
                drawn += len(data)
            else:
                steps.client.receive_datagram(data, SERVER_ADDRESS, steps.now)
    assert 0 < drawn <= 3 * spent
    assert drawn < 30 * 50  # a challenge of 40 bytes at most five times a second
    assert steps.server._connections.popitem()[1].address == HERE


def test_a_path_response_from_the_wrong_place_moves_nothing():
    steps = connected()
    steps.client.send(b"x")
    [(packet, _)] = steps.client.datagrams_to_send(steps.now)
    steps.server.receive_datagram(packet, ELSEWHERE, steps.now)
    sent = steps.server.datagrams_to_send(steps.now)
    [challenge] = [data for data, address in sent if address == ELSEWHERE]
    response = steps.to_client(challenge)  # it is forwarded to the client, which answers from where it is
    steps.to_server(*response)
    assert [e for e in events(steps.server) if isinstance(e, AddressChanged)] == []
    for data in response:
        steps.server.receive_datagram(data, ELSEWHERE, steps.now)
    assert [e for e in events(steps.server) if isinstance(e, AddressChanged)] == []


def test_a_client_hears_only_the_address_it_talks_to():
    steps = connected()
    asked = steps.client.send(b"x")
    steps.to_server(*(d for d, _ in steps.client.datagrams_to_send(steps.now)))
    [heard] = events(steps.server)
    steps.server.reply(heard.connection, heard.message_id, b"y")
    for data, _ in steps.server.datagrams_to_send(steps.now):
        steps.client.receive_datagram(data, ELSEWHERE, steps.now)
        assert events(steps.client) == []
        steps.to_client(data)
    assert events(steps.client) == [MessageAnswered(asked, b"y")]


def test_parts_come_in_any_order_once():
    whole = random.Random(1).randbytes(5000)
    offsets = list(range(0, 5000, PART_SIZE))
    for seed in range(20):
        parts = Parts(5000)
        random.Random(seed).shuffle(offsets)
        results = [parts.add(o, whole[o : o + PART_SIZE]) for o in offsets]
        assert results[-1] == whole and results[:-1] == [None] * (len(offsets) - 1)


def test_a_part_that_swallows_another_is_noticed():
    parts = Parts(1000)
    parts.add(0, bytes(500))
    with pytest.raises(Malformed):
        parts.add(300, bytes(500))


def test_a_packet_held_back_and_sent_later_from_elsewhere_is_no_move():
    steps = connected()
    steps.client.send(b"held back")
    [(held, _)] = steps.client.datagrams_to_send(steps.now)
    steps.client.send(b"newer")
    steps.to_server(*(data for data, _ in steps.client.datagrams_to_send(steps.now)))
    steps.server.receive_datagram(held, ELSEWHERE, steps.now)
    assert all(address == HERE for _, address in steps.server.datagrams_to_send(steps.now))
    assert [e.payload for e in events(steps.server)] == [b"newer", b"held back"]  # it counts, wherever it came from

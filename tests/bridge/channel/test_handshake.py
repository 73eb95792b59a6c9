"""Handshakes that must not succeed: impostors, altered, replayed, reflected, downgraded, cut short.

Each is refused cheaply, without a reply where none is due, and leaves nothing
behind; afterwards the honest message still works.
"""

from __future__ import annotations

import random
from collections.abc import Callable
from dataclasses import replace
from datetime import timedelta

import pytest

from bridge.channel.steps import HERE, OPEN, Steps, dropped, events, flipped
from bridge.channel.world import (
    BIRTH,
    TODAY,
    authority,
    cookie_key,
    hub,
    identity,
    make_client,
    make_server,
    robot,
    trust,
    wall,
)
from rosbridge_eth import identity as ids
from rosbridge_eth.channel import (
    ClientConfig,
    Connected,
    Disconnected,
    Drop,
    End,
    HandshakeFailed,
    Message,
    Mode,
    Randomness,
    Reason,
    Server,
    ServerConfig,
)
from rosbridge_eth.channel.handshake import (
    ClientHandshake,
    HandshakeRefused,
    ServerHandshake,
)
from rosbridge_eth.channel.wire import HELLO_PADDING, Hello, Kind

BOTH = (Mode.EXCHANGE, Mode.TRANSPORT)
modes = pytest.mark.parametrize("mode", BOTH, ids=lambda mode: mode.name.lower())


def expired(role: ids.Role, name: str) -> ids.Identity:
    then = BIRTH - timedelta(days=1000)
    return ids.enrol(ids.create_ca("operator", at=then), role, name, at=then)


def swapped(who: ids.Identity) -> ids.Identity:
    return replace(
        who,
        signing_key=who.encryption_key,
        signing_certificate=who.encryption_certificate,
        encryption_key=who.signing_key,
        encryption_certificate=who.signing_certificate,
    )


def patched(mine: ids.Identity, other: ids.Identity) -> ids.Identity:
    """Somebody else's certificates with one's own keys."""
    return replace(other, signing_key=mine.signing_key, encryption_key=mine.encryption_key)


IMPOSTORS = {
    "another CA": lambda: (identity(ids.Role.ROBOT, "robot_1", "stranger"), Drop.CERTIFICATE, Reason.CERTIFICATE),
    "a reader": lambda: (identity(ids.Role.READER, "alice", "operator"), Drop.CERTIFICATE, Reason.CERTIFICATE),
    "a server": lambda: (hub(), Drop.CERTIFICATE, Reason.CERTIFICATE),
    "expired": lambda: (expired(ids.Role.ROBOT, "old"), Drop.CERTIFICATE, Reason.EXPIRED),
    "certificates swapped": lambda: (swapped(robot()), Drop.CERTIFICATE, Reason.CERTIFICATE),
    "without the keys": lambda: (patched(robot("robot_2"), robot()), Drop.SIGNATURE, None),
}


@modes
@pytest.mark.parametrize("who", IMPOSTORS)
def test_a_server_refuses_an_impostor(mode, who):
    impostor, drop, hint = IMPOSTORS[who]()
    steps = Steps(mode, client=make_client(1000.0, ClientConfig(mode=mode), impostor))
    answer = steps.until_offer()
    assert dropped(steps.server) == {drop: 1}
    assert events(steps.server) == []
    assert steps.server.statistics()["half_open"] == 0
    if hint is None:
        assert answer == []
    else:
        steps.to_client(*answer)
        steps.client.handle_timer(steps.now + 100)
        [failed] = events(steps.client)
        assert isinstance(failed, HandshakeFailed) and failed.hint is hint


def test_a_server_refuses_who_is_not_on_the_allow_list_even_after_it_knew_them():
    allowed = {"robot_1"}
    listed = ids.Trust((authority("operator").certificate,), allowed=lambda peer: peer.name in allowed)
    server = make_server(1000.0, trust=listed)
    steps = Steps(server=server).until_connected()
    events(server)
    allowed.clear()
    server.close_peer("robot_1")
    [ended] = events(server)
    assert isinstance(ended, Disconnected) and ended.reason is End.REVOKED
    steps.to_client(*(data for data, _ in server.datagrams_to_send(steps.now)))
    [ended] = events(steps.client)
    assert ended.reason is End.REVOKED
    again = Steps(server=server, now=1001.0)
    again.until_offer()
    assert dropped(server) == {Drop.CERTIFICATE: 1}
    assert server.statistics()["connections"] == 0


FALSE_SERVERS = {
    "another CA": lambda: identity(ids.Role.SERVER, "hub", "stranger"),
    "another name": lambda: identity(ids.Role.SERVER, "other", "operator"),
    "a robot": lambda: robot("hub"),
    "expired": lambda: expired(ids.Role.SERVER, "hub"),
    "without the keys": lambda: patched(identity(ids.Role.SERVER, "other", "operator"), hub()),
}


@modes
@pytest.mark.parametrize("who", FALSE_SERVERS)
def test_a_client_refuses_a_false_server(mode, who):
    from rosbridge_eth.channel import Server

    false = FALSE_SERVERS[who]()
    server = Server(ServerConfig(modes=(mode,)), false, trust(), bytes(32), 1000.0, wall=lambda: TODAY)
    steps = Steps(mode, server=server)
    assert steps.to_client(*steps.until_offer()) == []  # nothing more is said to it
    assert sum(dropped(steps.client).values()) == 1
    steps.client.handle_timer(steps.now + 100)
    [failed] = events(steps.client)
    assert isinstance(failed, HandshakeFailed) and "refused" in failed.why
    assert failed.hint == (Reason.EXPIRED if who == "expired" else None)
    assert events(server) == []


# Altered


def test_every_bit_of_a_hello_is_either_noticed_or_leads_the_answer_astray():
    steps = Steps()
    for bit in range(len(steps.hello) * 8):
        answers = steps.to_server(flipped(steps.hello, bit))
        if 3 <= bit // 8 < 27:  # connection id and nonce: a HELLO of nobody
            [answer] = answers
            assert len(answer) * 3 < len(steps.hello)
            assert steps.to_client(answer) == []
        else:
            assert answers == []
    assert steps.server.statistics()["half_open"] == 0 and len(steps.server._sources) == 0
    assert steps.until_offer()


def test_every_bit_of_a_cookie_is_noticed_by_one_or_the_other():
    for bit in range(51 * 8):
        steps = Steps()
        steps.until_cookie()
        proof = steps.to_client(flipped(steps.cookie, bit))
        if proof:
            assert steps.to_server(*proof) == []
            assert dropped(steps.server) == {Drop.COOKIE: len(proof)}
        assert steps.server.statistics()["half_open"] == 0


@modes
def test_every_bit_of_a_proof_is_noticed(mode):
    draw = random.Random(20)
    steps = Steps(mode)
    first, *rest = steps.until_proof()
    header = range(53 * 8)
    body = draw.sample(range(53 * 8, len(first) * 8), 80)
    for bit in (*header, *body):
        server = make_server(steps.now, ServerConfig(modes=(mode,), **OPEN))
        for data in (flipped(first, bit), *rest):
            server.receive_datagram(data, HERE, steps.now)
        answers = [data for data, _ in server.datagrams_to_send(steps.now)]
        assert all(data[0] == 5 for data in answers), bit  # at most a hint, never an OFFER
        assert not server._connections, bit
        assert sum(dropped(server).values()) >= 1 or server.statistics()["half_open"] == 1, bit  # or waits for pieces
        if 2 * 8 <= bit < 51 * 8:
            assert answers == [] and server.statistics()["half_open"] == (1 if rest else 0), bit
    assert steps.to_server(first, *rest)[0][0] == 4


def proof_and_offer(mode):
    randomness = Randomness()
    client = ClientHandshake(mode, robot(), b"clientid", randomness)
    cookie = bytes(24)
    proof = client.proof(cookie)
    known = trust()

    def serve(body: bytes) -> ServerHandshake:
        return ServerHandshake(
            Hello(mode, b"clientid", client.hello.nonce),
            cookie,
            body,
            identity=hub(),
            trust=known,
            server_cid=b"serverid",
            randomness=randomness,
            at=TODAY,
        )

    return client, proof, serve, known


@modes
@pytest.mark.parametrize("seed", range(3))
def test_no_altered_proof_or_offer_is_accepted(mode, seed):
    draw = random.Random(seed)
    client, proof, serve, known = proof_and_offer(mode)
    for bit in draw.sample(range(len(proof) * 8), 60):
        with pytest.raises(HandshakeRefused):
            serve(flipped(proof, bit))
    server = serve(proof)
    for bit in draw.sample(range(len(server.offer) * 8), 60):
        with pytest.raises(HandshakeRefused):
            client.accept(flipped(server.offer, bit), known, server_name="hub", at=TODAY)
    for length in draw.sample(range(len(server.offer)), 60):
        with pytest.raises(HandshakeRefused):
            client.accept(server.offer[:length], known, server_name="hub", at=TODAY)
        with pytest.raises(HandshakeRefused):
            serve(proof[: min(length, len(proof) - 1)])
    agreed = client.accept(server.offer, known, server_name="hub", at=TODAY)
    for bit in range(256):
        with pytest.raises(HandshakeRefused):
            server.confirm(flipped(agreed.finished, bit))
        with pytest.raises(HandshakeRefused):
            server.confirm(flipped(agreed.finished, 256 + bit))
        with pytest.raises(HandshakeRefused):
            serve(proof).confirm(agreed.finished) if bit < 3 else server.confirm(agreed.finished[: bit // 4])


@modes
def test_every_bit_of_the_finished_packet_is_noticed_without_a_reply(mode):
    steps = Steps(mode)
    finished = steps.until_finished()
    for bit in range(len(finished) * 8):
        assert steps.to_server(flipped(finished, bit)) == [], bit
    assert events(steps.server) == []
    steps.to_client(*steps.to_server(finished))
    assert [type(event) for event in events(steps.server)] == [Connected]
    assert [type(event) for event in events(steps.client)] == [Connected]


# Replayed, reflected, downgraded, cut short


def test_a_replayed_proof_draws_nothing_new():
    steps = Steps()
    offer = steps.until_offer()
    assert steps.to_server(*steps.proof) == []  # at once: no
    steps.now += 0.2
    assert steps.to_server(*steps.proof) == offer  # later: the same bytes, no new signature
    steps.to_server(*steps.to_client(*offer))
    before = steps.server.statistics()["handshakes_begun"]
    steps.now += 1
    assert [data for data in steps.to_server(*steps.proof) if data[0] < 0x40] == []
    assert dropped(steps.server)[Drop.REPLAYED_HANDSHAKE] == len(steps.proof)
    assert [data for data in steps.to_server(*steps.proof, source=("203.0.113.9", 50000)) if data[0] < 0x40] == []
    steps.now += 60
    steps.server.handle_timer(steps.now)
    assert [data for data in steps.to_server(*steps.proof) if data[0] < 0x40] == []
    assert dropped(steps.server)[Drop.COOKIE] == 2 * len(steps.proof)
    assert steps.server.statistics()["handshakes_begun"] == before


def test_recorded_messages_mean_nothing_to_a_new_client():
    old = Steps().until_connected()
    new = Steps(server=old.server)
    for data in (old.cookie, *old.offer, *old.accepted):
        assert new.to_client(data) == []
    new.until_proof()
    for data in (old.cookie, *old.offer, *old.accepted):
        assert new.to_client(data) == []
    assert new.client.state == "proving"


def test_what_an_end_sent_itself_is_not_taken_back():
    steps = Steps().until_connected()
    steps.client.send(b"message")
    [(sent, _)] = steps.client.datagrams_to_send(steps.now)
    mine = [steps.hello, *steps.proof, steps.finished, sent]
    before = sum(dropped(steps.client).values())
    assert steps.to_client(*mine) == []
    assert sum(dropped(steps.client).values()) == before + len(mine)
    theirs = [steps.cookie, *steps.offer, *steps.accepted]
    before = sum(dropped(steps.server).values())
    assert steps.to_server(*theirs) == []
    assert sum(dropped(steps.server).values()) == before + len(theirs)
    assert [type(event) for event in events(steps.server)] == [Connected]


def test_one_mode_is_configured_and_none_is_fallen_back_to():
    steps = Steps(server=make_server(1000.0, ServerConfig(modes=(Mode.TRANSPORT,))))
    assert steps.to_server(steps.hello) == []
    assert dropped(steps.server) == {Drop.MODE: 1}


def test_a_mode_changed_on_the_way_is_noticed_where_both_are_allowed():
    server = make_server(1000.0, ServerConfig(modes=BOTH, **OPEN))
    steps = Steps(server=server)
    weaker = steps.hello[:2] + bytes((Mode.TRANSPORT,)) + steps.hello[3:]
    [cookie] = steps.to_server(weaker)
    assert steps.to_client(cookie) == []
    proof = steps.to_client(cookie[:2] + bytes((Mode.EXCHANGE,)) + cookie[3:])
    assert steps.to_server(*proof) == []
    assert steps.to_server(*(data[:2] + bytes((Mode.TRANSPORT,)) + data[3:] for data in proof)) == []
    assert set(dropped(server)) == {Drop.COOKIE, Drop.MALFORMED}
    assert not server._connections


@modes
def test_messages_cut_short_draw_no_reply(mode):
    steps = Steps(mode)
    for length in range(len(steps.hello)):
        assert steps.to_server(steps.hello[:length]) == []
    steps.until_cookie()
    for length in range(len(steps.cookie)):
        assert steps.to_client(steps.cookie[:length]) == []
    proof = steps.to_client(steps.cookie)
    last = proof[-1]
    for length in range(1, 53):
        assert steps.to_server(last[:length]) == []
    assert steps.server.statistics()["half_open"] == 0
    assert steps.to_server(*proof)


# What strangers cost


def test_ten_thousand_hellos_leave_no_trace():
    steps = Steps()
    draw = random.Random(1)
    for _ in range(10_000):
        hello = Hello(Mode.EXCHANGE, draw.randbytes(8), draw.randbytes(16)).datagram(Kind.HELLO, HELLO_PADDING)
        source = (f"10.{draw.randrange(256)}.{draw.randrange(256)}.{draw.randrange(256)}", draw.randrange(65536))
        [answer] = steps.to_server(hello, source=source)
        assert len(answer) == 51
    server = steps.server
    assert (len(server._half_open), len(server._connections), len(server._sources)) == (0, 0, 0)
    assert server.next_timer() is None


def test_a_source_that_fails_is_slowed_down_and_others_are_not():
    server = make_server(1000.0, ServerConfig(source_rate=1.0, source_burst=5.0))
    for _ in range(12):
        steps = Steps(server=server, client=make_client(1000.0, None, patched(robot("robot_2"), robot())))
        steps.until_offer()
    assert dropped(server)[Drop.SIGNATURE] == 5
    assert dropped(server)[Drop.SOURCE_LIMIT] >= 7
    honest = Steps(server=server)
    cookie = honest.to_server(honest.hello, source=("198.51.100.99", 7))
    assert honest.to_server(*honest.to_client(*cookie), source=("198.51.100.99", 7))


def test_many_robots_behind_one_address_are_not_slowed_down():
    server = make_server(1000.0, ServerConfig(source_rate=0.001, source_burst=2.0))
    for number in range(8):
        who = robot(f"robot_{number}")
        Steps(server=server, client=make_client(1000.0, None, who)).until_connected()
    assert server.statistics()["connections"] == 8


def test_a_robot_that_finds_the_server_full_is_not_slowed_down_for_it():
    server = make_server(1000.0, ServerConfig(source_rate=0.001, source_burst=2.0, max_connections=1))
    Steps(server=server, client=make_client(1000.0, None, robot("robot_1"))).until_connected()
    for _ in range(5):
        [refusal] = Steps(server=server, client=make_client(1000.0, None, robot("robot_2"))).until_offer()
        assert refusal[0] == Kind.REFUSAL and refusal[-1] == Reason.FULL
    server.close()
    server.datagrams_to_send(1000.0)
    Steps(server=server, client=make_client(1000.0, None, robot("robot_2"))).until_connected()


def busy_server(seconds: float, config: ServerConfig) -> tuple[Server, Callable[[], int]]:
    """A server on a machine where each handshake takes so long, and how many PROOFs it has examined."""
    reading = [0]

    def stopwatch() -> float:
        reading[0] += 1
        return reading[0] * seconds

    server = Server(config, hub(), trust(), cookie_key(hub()), 1000.0, wall=wall, stopwatch=stopwatch)
    return server, lambda: reading[0] // 2


def test_handshakes_take_their_share_of_time_and_no_more():
    server, examined = busy_server(0.05, ServerConfig(handshake_share=0.5, max_half_open=1000, **OPEN))
    for tenth in range(100):
        now = 1000.0 + tenth / 10
        server.handle_timer(now)
        server.datagrams_to_send(now)
        for _ in range(3):
            Steps(server=server, now=now).until_offer()
    assert 90 <= examined() <= 110  # ten seconds, half of them, at 50 ms, and the burst
    server.handle_timer(1100.0)
    assert dropped(server)[Drop.BUSY] == 300 - examined()  # forgotten in the line
    assert server.statistics()["half_open"] == 0


def test_an_overloaded_server_does_no_work_for_clients_that_have_given_up_and_holds_it_against_nobody():
    """Who stood in line for longer than a client's patience is not examined, and may come again at once."""
    server, examined = busy_server(0.5, ServerConfig(handshake_share=0.5, source_rate=0.001, source_burst=20.0))
    waiting = [Steps(server=server, client=make_client(1000.0, None, robot(f"robot_{n}"))) for n in range(20)]
    for number, steps in enumerate(waiting):
        source = (HERE[0], 1000 + number)
        for data in steps.to_client(*steps.to_server(steps.hello, source=source)):
            server.receive_datagram(data, source, 1000.0)
        server.datagrams_to_send(1000.0)
    answered_late = 0
    while server.next_timer() is not None and server.next_timer() < 1008.0:
        now, before = server.next_timer(), examined()
        server.handle_timer(now)
        answered_late += (examined() - before) * (now > 1000.0 + ClientConfig().attempt_timeout - 1)
    assert answered_late == 0
    assert 4 <= examined() < 8
    assert dropped(server)[Drop.BUSY] == 20 - examined()
    server.handle_timer(1020.0)
    server.datagrams_to_send(1020.0)
    late = Steps(server=server, now=1020.0)
    assert late.until_offer()


def test_handshakes_for_which_there_is_no_time_yet_stand_in_line_and_are_answered_in_order_unasked():
    server, examined = busy_server(0.1, ServerConfig(handshake_share=0.5, **OPEN))
    robots = [Steps(server=server, client=make_client(1000.0, None, robot(f"robot_{n}"))) for n in range(12)]
    answered: list[tuple[str, int]] = []

    def deliver(now: float) -> None:
        answered.extend(address for _, address in server.datagrams_to_send(now) if address not in answered)

    for number, steps in enumerate(robots):
        source = ("198.51.100.7", 1000 + number)
        proof = steps.to_client(*steps.to_server(steps.hello, source=source))
        for data in [*proof, *proof]:  # what is repeated takes no second place
            server.receive_datagram(data, source, 1000.0)
        deliver(1000.0)
    assert 0 < examined() < 12
    while examined() < 12:
        now = server.next_timer()
        assert now is not None and now < 1003.0
        server.handle_timer(now)
        deliver(now)
    assert answered == [("198.51.100.7", 1000 + number) for number in range(12)]
    assert dropped(server) == {}


def test_half_open_handshakes_are_few_and_forgotten():
    server = make_server(1000.0, ServerConfig(max_half_open=4))
    for _ in range(9):
        Steps(server=server).until_offer()
    assert server.statistics()["half_open"] == 4
    assert dropped(server)[Drop.HALF_OPEN] >= 5
    server.handle_timer(1010.0)
    assert server.statistics()["half_open"] == 0 and not server._connections
    assert events(server) == []


def test_a_session_stands_until_the_new_one_is_finished():
    first = Steps().until_connected()
    server = first.server
    events(server)
    second = Steps(server=server)
    finished = second.until_finished()
    first.client.send(b"still here")
    first.to_server(*(data for data, _ in first.client.datagrams_to_send(first.now)))
    [heard] = events(server)
    assert isinstance(heard, Message) and heard.payload == b"still here"
    second.to_server(finished)
    assert [type(event) for event in events(server)] == [Disconnected, Connected]

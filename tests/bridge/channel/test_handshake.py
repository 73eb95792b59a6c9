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
from rosbridge_eth.channel.handshake import Agreed, ClientHandshake, answer_proof
from rosbridge_eth.channel.wire import HELLO_PADDING, Hello, Kind, Refused

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
    assert steps.server.statistics()["half_open"] == 0
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
    body = draw.sample(range(53 * 8, 1100 * 8), 80)
    for bit in (*header, *body):
        server = make_server(steps.now, ServerConfig(modes=(mode,), **OPEN))
        for data in (flipped(first, bit), *rest):
            server.receive_datagram(data, HERE, steps.now)
        answers = [data for data, _ in server.datagrams_to_send(steps.now)]
        assert all(data[0] == 5 for data in answers), bit  # at most a hint, never an OFFER
        assert not server._sessions, bit
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

    def serve(body: bytes) -> Agreed:
        return answer_proof(
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
        with pytest.raises(Refused):
            serve(flipped(proof, bit))
    served = serve(proof)
    offer = served.told
    for bit in draw.sample(range(len(offer) * 8), 60):
        with pytest.raises(Refused):
            client.accept(flipped(offer, bit), known, server_name="hub", at=TODAY)
    for length in draw.sample(range(len(offer)), 60):
        with pytest.raises(Refused):
            client.accept(offer[:length], known, server_name="hub", at=TODAY)
        with pytest.raises(Refused):
            serve(proof.rstrip(b"\0")[: min(length, len(proof.rstrip(b"\0")) - 1)])
    agreed = client.accept(offer, known, server_name="hub", at=TODAY)
    assert (agreed.secrets.client, agreed.secrets.server) == (served.secrets.client, served.secrets.server)
    assert (agreed.peer.name, served.peer.name, agreed.told) == ("hub", "robot_1", b"serverid")


@modes
def test_every_bit_of_the_first_packet_is_noticed_without_a_reply(mode):
    """It confirms that the client has the keys; until it opens there is no session and none is replaced."""
    steps = Steps(mode)
    first = steps.until_first()
    for bit in range(len(first) * 8):
        assert steps.to_server(flipped(first, bit)) == [], bit
    for length in range(len(first)):
        assert steps.to_server(first[:length]) == [], length
    assert events(steps.server) == []
    assert steps.server.statistics().items() >= {("connections", 0), ("half_open", 1)}
    steps.to_client(*steps.to_server(first))
    assert [type(event) for event in events(steps.server)] == [Connected]
    [connected] = events(steps.client)
    assert isinstance(connected, Connected) and connected.server_time == TODAY


@modes
def test_a_client_is_not_connected_before_the_servers_first_packet_opens(mode):
    steps = Steps(mode)
    [answer] = steps.to_server(steps.until_first())
    for bit in range(len(answer) * 8):
        steps.to_client(flipped(answer, bit))
    assert steps.client.phase == "confirming" and steps.client.room() == 0
    assert events(steps.client) == []
    steps.to_client(answer)
    assert steps.client.connected and steps.client.room() > 70_000


# Replayed, reflected, downgraded, cut short


def test_a_replayed_proof_is_not_examined_again():
    examined = [0]

    def stopwatch() -> float:
        examined[0] += 1
        return 0.0

    server = Server(ServerConfig(**OPEN), hub(), trust(), cookie_key(hub()), 1000.0, wall=wall, stopwatch=stopwatch)
    steps = Steps(server=server)
    offer = steps.until_offer()
    assert examined == [2]  # begin and end of one
    assert steps.to_server(*steps.proof) == offer  # the same bytes, no new signature
    steps.to_server(*steps.to_client(*offer))
    assert [type(event) for event in events(server)] == [Connected]
    for later in (0.0, 5.0, 14.9):
        steps.now = 1000.0 + later
        server.handle_timer(steps.now)
        assert steps.to_server(*steps.proof) in (offer, [])
        assert steps.to_server(*steps.proof, source=("203.0.113.9", 50000)) == []  # its cookie is another's
    steps.now = 1060.0
    server.handle_timer(steps.now)
    assert [data for data in steps.to_server(*steps.proof) if data[0] < 0x40] == []
    assert dropped(server)[Drop.COOKIE] == 4 * len(steps.proof)
    assert examined == [2]


def test_recorded_messages_mean_nothing_to_a_new_client():
    old = Steps().until_connected()
    new = Steps(server=old.server)
    for data in (old.cookie, *old.offer, *old.answer):
        assert new.to_client(data) == []
    new.until_proof()
    for data in (old.cookie, *old.offer, *old.answer):
        assert new.to_client(data) == []
    assert new.client.phase == "proving"


def test_what_an_end_sent_itself_is_not_taken_back():
    steps = Steps().until_connected()
    [sent] = steps.sent(b"message")
    mine = [steps.hello, *steps.proof, steps.first, sent]
    before = sum(dropped(steps.client).values())
    assert steps.to_client(*mine) == []
    assert sum(dropped(steps.client).values()) == before + len(mine)
    theirs = [steps.cookie, *steps.offer, *steps.answer]
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
    assert not server._sessions


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
    assert (len(server._proofs), len(server._offered), len(server._sessions)) == (0, 0, 0)
    assert server.next_timer() is None


def test_a_robot_that_finds_the_server_full_is_told_and_let_in_later():
    server = make_server(1000.0, ServerConfig(max_connections=1, **OPEN))
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
    server, examined = busy_server(0.05, ServerConfig(handshake_share=0.5, max_half_open=1000))
    for tenth in range(100):
        now = 1000.0 + tenth / 10
        server.handle_timer(now)
        server.datagrams_to_send(now)
        for _ in range(3):
            Steps(server=server, now=now).until_offer()
    assert 90 <= examined() <= 110  # ten seconds, half of them, at 50 ms, and the burst
    assert dropped(server)[Drop.BUSY] == 300 - examined()
    server.handle_timer(1100.0)
    assert server.statistics()["half_open"] == 0


def test_a_proof_that_found_no_time_is_examined_when_it_comes_again():
    server, examined = busy_server(0.5, ServerConfig(handshake_share=0.5))
    first, second = Steps(server=server), Steps(server=server, client=make_client(1000.0, None, robot("robot_2")))
    assert first.until_offer() and second.until_offer() == []
    assert examined() == 1
    second.now = 1002.0
    [offer] = second.to_server(second.proof[0])
    assert offer[0] == Kind.OFFER and examined() == 2


def test_half_open_handshakes_are_few_and_forgotten():
    """Those whose PROOF is not whole: the oldest goes. Those that were answered: no more until some are over."""
    server = make_server(1000.0, ServerConfig(modes=BOTH, max_half_open=4, **OPEN))
    honest = Steps(Mode.TRANSPORT, server=server)
    honest.until_proof()
    waiting = [Steps(Mode.TRANSPORT, server=server) for _ in range(9)]
    for steps in waiting:
        steps.to_server(steps.until_proof()[0])
    assert server.statistics()["half_open"] == 4 and len(server._proofs) == 4
    assert dropped(server) == {Drop.HALF_OPEN: 5}
    assert honest.to_server(*honest.proof)[0][0] == Kind.OFFER  # whole at once: nobody keeps it out
    for number in range(9):
        Steps(server=server, client=make_client(1000.0, who=robot(f"robot_{number}"))).until_offer()
    assert len(server._sessions) == 4
    server.handle_timer(1020.0)
    assert server.statistics()["half_open"] == 0 and not server._sessions and not server._offered
    assert events(server) == []


def test_a_robot_that_begins_sessions_without_end_keeps_no_other_out():
    server = make_server(1000.0, ServerConfig(max_half_open=4, **OPEN))
    for _ in range(9):
        last = Steps(server=server)
        last.until_offer()
    assert server.statistics()["half_open"] == 1
    Steps(server=server, client=make_client(1000.0, who=robot("robot_2"))).until_connected()
    last.to_server(*last.to_client(*last.offer))
    assert server.statistics().items() >= {("connections", 2), ("half_open", 0)}


def test_an_offer_longer_than_its_proof_comes_as_the_proof_is_repeated():
    """As where the server's name is much longer than the robot's: each datagram draws one."""
    name = "a-server-whose-name-is-much-longer-than-its-robots"
    who = identity(ids.Role.SERVER, name, "operator")
    server = Server(ServerConfig(**OPEN), who, trust(), bytes(32), 1000.0, wall=wall)
    steps = Steps(server=server, client=make_client(1000.0, server_name=name))
    assert len(steps.until_offer()) == len(steps.proof) == 1
    [again] = steps.to_client(*steps.offer)
    assert again == steps.proof[0]
    [rest] = steps.to_server(again)
    [first] = steps.to_client(rest)
    assert steps.to_client(*steps.to_server(first)) == [] and steps.client.connected


def test_a_session_stands_until_the_new_one_is_finished():
    first = Steps().until_connected()
    server = first.server
    events(server)
    second = Steps(server=server)
    confirmation = second.until_first()
    first.to_server(*first.sent(b"still here"))
    [heard] = events(server)
    assert isinstance(heard, Message) and heard.payload == b"still here"
    second.to_server(confirmation)
    assert [type(event) for event in events(server)] == [Disconnected, Connected]


def test_a_first_packet_that_was_held_back_replaces_no_session_that_was_begun_later():
    first = Steps()
    server, held = first.server, first.until_first()
    second = Steps(server=server, now=1001.0).until_connected()
    events(server)
    assert second.to_server(held) == [] and events(server) == []
    assert dropped(server) == {Drop.UNKNOWN_CONNECTION: 1}
    second.to_server(*second.sent(b"still here"))
    assert [event.payload for event in events(server)] == [b"still here"]
    assert server.statistics().items() >= {("connections", 1), ("half_open", 0)}

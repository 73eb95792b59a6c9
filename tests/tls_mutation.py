"""Handshakes with one change made to the bytes on their way, for the tests and for fuzz/tls_flights.py.

What must hold, whatever the change: each side ends with a TLSError, or goes on as if nothing had happened; both
complete the handshake only if they agree on everything; no other exception; memory stays bounded.
"""

from __future__ import annotations

from functools import cache
from random import Random

from smcrypto.tls import SUITES, DataReceived, SMContext, TLSError
from tls_peers import Pair, client_context, completed, pair, server_context


@cache
def contexts(suite: str) -> tuple[SMContext, SMContext]:
    version = SUITES[suite][1]
    return (
        client_context(versions=[version], suites=[suite], certificate=True, alpn=["h2"]),
        server_context(versions=[version], suites=[suite], verify_client="required", alpn=["h2"]),
    )


def mutate(data: bytes, random: Random) -> bytes:
    """One change: a bit, a byte, a piece left out, doubled, moved, filled or put in; or several bytes."""
    at = random.randrange(len(data))
    length = min(random.choice((1, 1, 2, 3, 4, 16, 100)), len(data) - at)
    piece = data[at : at + length]
    match random.randrange(8):
        case 0:
            return data[:at] + bytes([data[at] ^ 1 << random.randrange(8)]) + data[at + 1 :]
        case 1:
            return data[:at] + bytes([random.choice((0, 1, 127, 128, 255))]) + data[at + 1 :]
        case 2:
            return data[:at] + data[at + length :]
        case 3:
            return data[:at] + piece + data[at:]
        case 4:
            return data[:at] + data[at + length :] + piece
        case 5:
            return data[:at] + bytes(length) + data[at + length :]
        case 6:
            return data[:at] + random.randbytes(length) + data[at:]
        case _:
            changed = bytearray(data)
            for _ in range(random.randrange(2, 6)):
                changed[random.randrange(len(data))] = random.randrange(256)
            return bytes(changed)


def mutated_handshake(suite: str, random: Random) -> str:
    """Run one, with one flight changed, to the end. What became of it: the alert's name, or "held", or "waits"."""
    made = pair(*contexts(suite))
    flight, step = random.randrange(5), random.choice((1 << 30, 1 << 30, 50))
    outcome = "waits"
    try:
        carry(made, flight, step, random)
    except TLSError as error:
        outcome = error.alert.name
        for connection in (made.client, made.server):
            assert len(connection.data_to_send()) < 1 << 17
    for connection in (made.client, made.server):
        assert len(connection._records.incoming) <= 5 + (1 << 14) + 2048
        assert len(connection._records.message) <= 4 + (1 << 17)
    both = [completed_of(events) for events in (made.client_events, made.server_events)]
    if outcome == "waits" and all(both):
        client, server = completed(made.client_events), completed(made.server_events)
        assert (client.suite, client.alpn, client.resumed) == (server.suite, server.alpn, server.resumed)
        outcome = "held"
    for events in (made.client_events, made.server_events):
        for event in events:
            assert not isinstance(event, DataReceived) or event.data == b"data"
    return outcome


def completed_of(events: list) -> bool:  # type: ignore[type-arg]
    return any(type(event).__name__ == "HandshakeCompleted" for event in events)


def carry(made: Pair, flight: int, step: int, random: Random) -> None:
    number, asked = 0, False
    while True:
        idle = True
        for sender, receiver, events in (
            (made.client, made.server, made.server_events), (made.server, made.client, made.client_events),
        ):  # fmt: skip
            data = sender.data_to_send()
            if not data:
                continue
            idle = False
            if number == flight:
                data = mutate(data, random)
            number += 1
            for i in range(0, len(data), step):
                events += receiver.receive_data(data[i : i + step])
        if idle and (asked or not completed_of(made.client_events)):
            return
        if idle:
            asked = True
            made.client.send(b"data")

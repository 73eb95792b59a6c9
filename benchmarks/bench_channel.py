"""What a message, a handshake and a stranger cost at each end of the channel. No sockets: bytes in, bytes out.

Run: PYTHONPATH=src python benchmarks/bench_channel.py

A message is one record of 256 or 512 sealed bytes with its 25 bytes of
request. "robot" is all it does for a message: queueing, packing, sealing,
opening and working through the server's answers. "server" is receiving,
opening, delivering, answering, sealing the answers. Beside them stands what
AES-GCM of OpenSSL, by `cryptography`, would take for the same packets' cipher
alone, in the same run: the share of the cost that is Python's and the channel's.
"""

from __future__ import annotations

import os
import platform
import statistics
import sys
import time
from collections.abc import Callable
from datetime import UTC, datetime, timedelta

from rosbridge_eth import identity as ids
from rosbridge_eth.channel import Client, ClientConfig, MessageReceived, Mode, Server, ServerConfig, cookie_key
from rosbridge_eth.channel.wire import Hello
from smcrypto import sm3, sm4

HERE, THERE = ("192.0.2.7", 50000), ("192.0.2.1", 4433)
AT = datetime.now(UTC) - timedelta(hours=1)
CA = ids.create_ca("bench", at=AT)
HUB = ids.enrol(CA, ids.Role.SERVER, "hub", at=AT)
TRUST = ids.Trust((CA.certificate,))
clock = time.perf_counter


def robot(name: str = "robot_1") -> ids.Identity:
    return ids.enrol(CA, ids.Role.ROBOT, name, at=AT)


def make_server(mode: Mode = Mode.EXCHANGE) -> Server:
    config = ServerConfig(modes=(mode,), source_rate=1e9, source_burst=1e9, handshake_share=1e9)
    return Server(config, HUB, TRUST, cookie_key(HUB), 0.0)


def handshake(server: Server, client: Client, now: float) -> tuple[float, float]:
    """Connect; seconds spent by the server and by the client."""
    spent = [0.0, 0.0]
    client.connect(THERE, now)
    for _ in range(6):
        began = clock()
        sent = client.datagrams_to_send(now)
        spent[1] += clock() - began
        began = clock()
        for data, _ in sent:
            server.receive_datagram(data, HERE, now)
        sent = server.datagrams_to_send(now)
        spent[0] += clock() - began
        began = clock()
        for data, _ in sent:
            client.receive_datagram(data, THERE, now)
        spent[1] += clock() - began
    while client.next_event() or server.next_event():
        pass
    if client.state != "connected":
        raise RuntimeError(f"not connected: {server.statistics()}")
    return spent[0], spent[1]


def messages(size: int, batch: int, rounds: int) -> tuple[float, float, float, float]:
    """Microseconds per message: robot sending, robot receiving, server receiving, server answering."""
    server, client = make_server(), Client(ClientConfig(), robot(), TRUST, "hub", 0.0)
    handshake(server, client, 0.0)
    payload = os.urandom(size)
    samples: list[tuple[float, float, float, float]] = []
    now = 0.0
    for _ in range(rounds):
        now += 0.05  # a pause in which pacing lets everything go
        began = clock()
        for _ in range(batch):
            client.send(payload)
        sent = client.datagrams_to_send(now)
        robot_send = clock() - began
        now += 0.001
        began = clock()
        for data, _ in sent:
            server.receive_datagram(data, HERE, now)
        heard = []
        while (event := server.next_event()) is not None:
            heard.append(event)
        server_receive = clock() - began
        began = clock()
        for event in heard:
            if isinstance(event, MessageReceived):
                server.reply(event.connection, event.message_id, b"\0")
        sent = server.datagrams_to_send(now)
        server_answer = clock() - began
        began = clock()
        for data, _ in sent:
            client.receive_datagram(data, THERE, now)
        answered = 0
        while client.next_event() is not None:
            answered += 1
        robot_receive = clock() - began
        if answered == batch:
            samples.append((robot_send, robot_receive, server_receive, server_answer))
        now += 0.03
        for data, _ in client.datagrams_to_send(now):  # the acknowledgement of the answers, when it is due
            server.receive_datagram(data, HERE, now)
        server.datagrams_to_send(now)
        while client.next_event() is not None:
            pass
    if len(samples) < rounds // 2:
        raise RuntimeError(f"only {len(samples)} of {rounds} rounds went through: {client.statistics()}")
    medians = [statistics.median(column) / batch * 1e6 for column in zip(*samples, strict=True)]
    return medians[0], medians[1], medians[2], medians[3]


def each(call: Callable[[], object], count: int) -> float:
    """Median microseconds of a call."""
    times = []
    for _ in range(count):
        began = clock()
        call()
        times.append(clock() - began)
    return statistics.median(times) * 1e6


def main() -> None:
    print(f"{platform.python_implementation()} {platform.python_version()} on {platform.machine()}, "
          f"{os.cpu_count()} cores; SM3: {sm3.ENGINE}")
    gcm, key = sm4.SM4GCM(os.urandom(16)), os.urandom(16)
    nonce, header = bytes(12), bytes(15)
    print("\ncipher of one packet, µs        100 B   600 B  1150 B")
    sizes = (100, 600, 1150)
    print("  SM4-GCM, smcrypto          " + "".join(
        f"{each(lambda s=s: gcm.encrypt(nonce, bytes(s), header), 300):8.1f}" for s in sizes))
    try:
        from cryptography.hazmat.primitives.ciphers.aead import AESGCM
    except ImportError:
        print("  (cryptography is not installed: no peer)", file=sys.stderr)
    else:
        aes = AESGCM(key)
        print("  AES-GCM, OpenSSL           " + "".join(
            f"{each(lambda s=s: aes.encrypt(nonce, bytes(s), header), 300):8.1f}" for s in sizes))
    print("\nper message, µs       robot sends  robot hears  server hears  server answers")
    for size in (256 + 25, 512 + 25):
        for batch in (1, 4, 32):
            row = messages(size, batch, 200 if batch < 32 else 60)
            print(f"  {size:4d} B, {batch:2d} at once" + "".join(f"{value:13.1f}" for value in row))
    print("\nhandshake, ms             server      client")
    for mode in Mode:
        for label, count in (("first", 1), ("again", 10)):
            who = [robot(f"robot_{i}") for i in range(8)]
            server = make_server(mode)
            runs = []
            for number, identity in enumerate(who):
                found = [
                    handshake(server, Client(ClientConfig(mode=mode), identity, TRUST, "hub", 0.0), number * 10.0 + i)
                    for i in range(count)
                ]
                runs.append(found[-1])
            columns = [statistics.median(column) * 1e3 for column in zip(*runs, strict=True)]
            print(f"  {mode.name.lower():9s} {label} {columns[0]:12.2f}{columns[1]:12.2f}")
    server = make_server()
    print("\nwhat a stranger costs the server, µs")
    hello = Hello(Mode.EXCHANGE, os.urandom(8), os.urandom(32)).to_bytes()

    def offered(data: bytes) -> Callable[[], object]:
        def deliver() -> None:
            server.receive_datagram(data, HERE, 1.0)
            server.datagrams_to_send(1.0)
        return deliver

    forged = b"\x03" + hello[1:43] + os.urandom(24) + b"\0\1" + bytes(1000)
    print(f"  a HELLO, answered by a cookie      {each(offered(hello), 2000):8.1f}")
    print(f"  a PROOF with a cookie made up      {each(offered(forged), 2000):8.1f}")
    print(f"  1,200 bytes of noise               {each(offered(b'X' + os.urandom(1199)), 2000):8.1f}")
    print(f"  a packet of no connection          {each(offered(b'@' + os.urandom(1199)), 2000):8.1f}")
    handshake(server, Client(ClientConfig(), robot("victim"), TRUST, "hub", 1.0), 1.0)
    cid = next(iter(server._connections))
    noise = b"@" + cid + (10**6).to_bytes(6, "big") + os.urandom(1185)
    print(f"  a forged packet of a live session  {each(offered(noise), 500):8.1f}")


if __name__ == "__main__":
    main()

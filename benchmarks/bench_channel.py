"""What chunks, a handshake and a stranger cost at each end of the channel, and how fast it carries.

Run: PYTHONPATH=src python benchmarks/bench_channel.py [--link]

Without sockets: bytes in, bytes out, the processor's time of the two ends apart. Through loopback: two processes and
their sockets. Beside the cipher stands AES-GCM of OpenSSL, by `cryptography`, in the same run. --link adds the rates
through simulated links with loss (minutes).
"""

from __future__ import annotations

import argparse
import os
import platform
import statistics
import sys
import time
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from functools import partial
from pathlib import Path

from rosbridge_eth import identity as ids
from rosbridge_eth.channel import Client, ClientConfig, Connected, Message, Mode, Server, ServerConfig, cookie_key
from rosbridge_eth.channel.udp import UdpLoop, client_socket, server_socket
from rosbridge_eth.channel.wire import HELLO_PADDING, SEGMENT_SIZE, Hello, Kind
from smcrypto import sm3, sm4

HERE, THERE = ("192.0.2.7", 50000), ("192.0.2.1", 4433)
CHUNK = 8_600  # bytes: 100 records of the sample's Odometry
AT = datetime.now(UTC) - timedelta(hours=1)
CA = ids.create_ca("bench", at=AT)
HUB = ids.enrol(CA, ids.Role.SERVER, "hub", at=AT)
ROBOT = ids.enrol(CA, ids.Role.ROBOT, "robot_1", at=AT)
TRUST = ids.Trust((CA.certificate,))
clock = time.process_time


def make_server(now: float = 0.0, mode: Mode = Mode.EXCHANGE) -> Server:
    config = ServerConfig(modes=(mode,), source_rate=1e9, source_burst=1e9, handshake_share=1e9)
    return Server(config, HUB, TRUST, cookie_key(HUB), now)


def make_client(now: float = 0.0, mode: Mode = Mode.EXCHANGE) -> Client:
    return Client(ClientConfig(mode=mode), ROBOT, TRUST, "hub", now)


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


def carried(size: int, count: int) -> tuple[float, float]:
    """Microseconds per message at the robot and at the server, answered by 41 bytes each (a Stored)."""
    server, client = make_server(), make_client()
    handshake(server, client, 0.0)
    payload, answer = os.urandom(size), bytes(41)
    robot = hub = now = 0.0
    sent = got = answered = 0
    while answered < count:
        now += 0.005
        began = clock()
        client.handle_timer(now)
        while sent < count and client.writable(size):
            client.send(payload)
            sent += 1
        up = client.datagrams_to_send(now)
        robot += clock() - began
        began = clock()
        server.handle_timer(now)
        for data, _ in up:
            server.receive_datagram(data, HERE, now)
        while (event := server.next_event()) is not None:
            if isinstance(event, Message):
                got += 1
                server.send(event.connection, answer)
        down = server.datagrams_to_send(now)
        hub += clock() - began
        began = clock()
        for data, _ in down:
            client.receive_datagram(data, THERE, now)
        while (event := client.next_event()) is not None:
            answered += isinstance(event, Message)
        robot += clock() - began
    return robot / count * 1e6, hub / count * 1e6


def loopback(megabytes: float) -> None:
    """Two processes, one socket each."""
    count = int(megabytes * 1e6 / CHUNK)
    listening = server_socket(("127.0.0.1", 0))
    sock, address = client_socket(listening.getsockname()[:2])
    server, client = make_server(time.monotonic()), make_client(time.monotonic())
    child = os.fork()
    if child == 0:
        loop = UdpLoop(
            server,
            listening,
            lambda event: server.send(event.connection, bytes(41)) if isinstance(event, Message) else None,
        )
        while not client_gone(server):
            loop.step(0.5)
        spent = time.process_time()
        print(f"  the server's process worked          {spent:8.2f} s, {megabytes / spent:5.2f} MB/s of its time")
        sys.stdout.flush()
        os._exit(0)
    answered = 0

    def on_event(event: object) -> None:
        nonlocal answered
        answered += isinstance(event, Message)

    loop = UdpLoop(client, sock, on_event)
    client.connect(address, time.monotonic())
    while client.state != "connected":
        loop.step(1.0)
    payload, sent = os.urandom(CHUNK), 0
    began, worked = time.perf_counter(), time.process_time()
    while answered < count:
        while sent < count and client.writable(CHUNK):
            client.send(payload)
            sent += 1
        loop.step(0.5)
    took, worked = time.perf_counter() - began, time.process_time() - worked
    counted = client.statistics()
    client.close(time.monotonic())
    loop.close()
    os.waitpid(child, 0)
    print(f"  the robot's process worked           {worked:8.2f} s, {megabytes / worked:5.2f} MB/s of its time")
    print(f"  {count} chunks, each answered, took {took:10.2f} s, {megabytes / took:5.2f} MB/s, "
          f"{counted['packets_lost']} packets lost")


def client_gone(server: Server) -> bool:
    counted = server.statistics()
    return counted["handshakes"] > 0 and counted["connections"] == 0


def each(call: Callable[[], object], count: int) -> float:
    """Median microseconds of a call."""
    times = []
    for _ in range(count):
        began = clock()
        call()
        times.append(clock() - began)
    return statistics.median(times) * 1e6


def ciphers() -> None:
    gcm, key, nonce, header = sm4.SM4GCM(os.urandom(16)), os.urandom(16), bytes(12), bytes(13)
    sizes = (100, 600, SEGMENT_SIZE)
    print("\ncipher of one packet, µs        100 B   600 B  1166 B")
    print("  SM4-GCM, smcrypto          " + "".join(
        f"{each(partial(gcm.encrypt, nonce, bytes(size), header), 300):8.1f}" for size in sizes))
    try:
        from cryptography.hazmat.primitives.ciphers.aead import AESGCM
    except ImportError:
        print("  (cryptography is not installed: no peer)", file=sys.stderr)
        return
    aes = AESGCM(key)
    print("  AES-GCM, OpenSSL           " + "".join(
        f"{each(partial(aes.encrypt, nonce, bytes(size), header), 300):8.1f}" for size in sizes))


def strangers() -> None:
    server = make_server()
    print("\nwhat a stranger costs the server, µs")
    hello = Hello(Mode.EXCHANGE, os.urandom(8), os.urandom(16)).datagram(Kind.HELLO, HELLO_PADDING)

    def offered(data: bytes) -> Callable[[], object]:
        def deliver() -> None:
            server.receive_datagram(data, HERE, 1.0)
            server.datagrams_to_send(1.0)
        return deliver

    forged = b"\x03" + hello[1:27] + os.urandom(24) + b"\0\1" + bytes(1000)
    print(f"  a HELLO, answered by a cookie      {each(offered(hello), 2000):8.1f}")
    print(f"  a PROOF with a cookie made up      {each(offered(forged), 2000):8.1f}")
    print(f"  1,200 bytes of noise               {each(offered(b'X' + os.urandom(1199)), 2000):8.1f}")
    print(f"  a packet of no connection          {each(offered(b'@' + os.urandom(1199)), 2000):8.1f}")
    handshake(server, make_client(1.0), 1.0)
    noise = b"@" + next(iter(server._connections)) + (10**6).to_bytes(4, "big") + os.urandom(1187)
    print(f"  a forged packet of a live session  {each(offered(noise), 500):8.1f}")


def links() -> None:
    """Through the simulated network of the tests: time to a session, and the rate for 60 seconds."""
    sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "tests"))
    from bridge.channel.simulation import Faults, Network
    from bridge.channel.world import RobotProgram, ServerProgram

    print("\nseconds to a session, round trip 40 ms, 400 seeds     median    95 %")
    for loss in (0.0, 0.1, 0.2, 0.3):
        times = []
        for seed in range(400 if loss else 2):
            network = Network(seed, Faults(loss=loss, delay=0.02))
            ServerProgram(network)
            robot = RobotProgram(network, [])
            events: list[float] = []
            robot.host.on_event = lambda event, network=network, events=events: (
                events.append(network.now) if isinstance(event, Connected) else None
            )
            network.run(lambda events=events: bool(events))
            times.append(events[0] - 1000.0)
        print(f"  {loss:4.0%} loss {statistics.median(times):46.2f}{statistics.quantiles(times, n=20)[-1]:8.2f}")
    print("\nkB/s in the first 60 s, jitter 5 %      no loss     10 %     30 %")
    for round_trip in (0.05, 0.2, 0.6):
        row = []
        for loss in (0.0, 0.1, 0.3):
            network = Network(1, Faults(loss=loss, delay=round_trip / 2, jitter=round_trip / 20))
            hub = ServerProgram(network)
            robot = RobotProgram(network, [bytes(CHUNK)] * 10_000_000)
            network.run(lambda robot=robot: robot.sent is not None)
            began, end = network.now, network.now + 60.0
            stored = hub.stored.setdefault("robot_1", [])
            network.run(lambda network=network, end=end, stored=stored: network.now > end or len(stored) > 4000)
            row.append(len(stored) * CHUNK / (network.now - began) / 1e3)
        print(f"  round trip {round_trip * 1000:3.0f} ms" + " " * 16 + "".join(f"{rate:9.0f}" for rate in row))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--link", action="store_true", help="also simulate links with loss")
    chosen = parser.parse_args()
    print(f"{platform.python_implementation()} {platform.python_version()} on {platform.machine()}, "
          f"{os.cpu_count()} cores; SM3: {sm3.ENGINE}")
    ciphers()
    print("\nper message, µs, no sockets        robot  server   MB/s of both on one core")
    for size, count in ((200, 2000), (CHUNK, 300), (68_000, 40)):
        robot, hub = carried(size, count)
        print(f"  {size:6d} bytes {robot:25.0f}{hub:8.0f}{size / (robot + hub):10.2f}")
    print("\nthrough loopback, two processes, chunks of 100 records")
    sys.stdout.flush()
    loopback(10.0)
    print("\nhandshake, ms             server      client")
    for mode in Mode:
        server = make_server(mode=mode)
        runs = [handshake(server, make_client(mode=mode), float(number)) for number in range(20)]
        columns = [statistics.median(column) * 1e3 for column in zip(*runs, strict=True)]
        print(f"  {mode.name.lower():9s} {columns[0]:18.2f}{columns[1]:12.2f}")
    strangers()
    if chosen.link:
        links()


if __name__ == "__main__":
    main()

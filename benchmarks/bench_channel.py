"""What chunks, a handshake and a stranger cost at each end of the channel, and how fast it carries.

Run: PYTHONPATH=src python benchmarks/bench_channel.py [--link [SEEDS]] [--beside COMMIT]

Without sockets: bytes in, bytes out, the processor's time of the two ends apart. Through loopback: two processes and
their sockets. Beside the cipher stands AES-GCM of OpenSSL, by `cryptography`, in the same run. --link adds what
simulated links with loss allow (channel_links.py); --beside the same at another commit, in the same run.
"""

from __future__ import annotations

import argparse
import os
import platform
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from functools import partial
from pathlib import Path

from rosbridge_eth import identity as ids
from rosbridge_eth.channel import Client, ClientConfig, Message, Mode, Server, ServerConfig, State, cookie_key
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
    config = ServerConfig(modes=(mode,), handshake_share=1e9)
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
    if not client.connected:
        raise RuntimeError(f"not connected: {server.statistics()}")
    return spent[0], spent[1]


def carried(size: int, count: int) -> tuple[float, float]:
    """Microseconds per message at the robot and at the server, answered by a state of 121 bytes (log/hop.py)."""
    server, client = make_server(), make_client()
    handshake(server, client, 0.0)
    payload, rest = os.urandom(size), bytes(117)
    robot = hub = now = 0.0
    sent = got = answered = 0
    while answered < count:
        now += 0.005
        began = clock()
        client.handle_timer(now)
        while sent < count and client.room() >= size:
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
                server.set_state(event.connection, got.to_bytes(4, "big") + rest)
        down = server.datagrams_to_send(now)
        hub += clock() - began
        began = clock()
        for data, _ in down:
            client.receive_datagram(data, THERE, now)
        while (event := client.next_event()) is not None:
            answered = int.from_bytes(event.data[:4], "big") if isinstance(event, State) else answered
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
        got = 0

        def take(event: object) -> None:
            nonlocal got
            if isinstance(event, Message):
                got += 1
                server.set_state(event.connection, got.to_bytes(4, "big") + bytes(117))

        loop = UdpLoop(server, listening, take)
        while not client_gone(server):
            loop.step(0.5)
        spent = time.process_time()
        print(f"  the server's process worked          {spent:8.2f} s, {megabytes / spent:5.2f} MB/s of its time")
        sys.stdout.flush()
        os._exit(0)
    answered = 0

    def on_event(event: object) -> None:
        nonlocal answered
        answered = int.from_bytes(event.data[:4], "big") if isinstance(event, State) else answered

    loop = UdpLoop(client, sock, on_event)
    client.connect(address, time.monotonic())
    while not client.connected:
        loop.step(1.0)
    payload, sent = os.urandom(CHUNK), 0
    began, worked = time.perf_counter(), time.process_time()
    while answered < count:
        while sent < count and client.room() >= CHUNK:
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
    noise = b"@" + next(iter(server._sessions)) + (10**6).to_bytes(4, "big") + os.urandom(1187)
    print(f"  a forged packet of a live session  {each(offered(noise), 500):8.1f}")


def links(seeds: int, commit: str | None) -> None:
    """channel_links.py over the sources here, then over those of another commit."""
    here = Path(__file__).resolve().parent.parent
    program = [sys.executable, str(here / "benchmarks/channel_links.py"), str(seeds)]
    print(f"\nsimulated links, {seeds} seeds", flush=True)
    subprocess.run(program, env={**os.environ, "PYTHONPATH": f"{here}/src:{here}/tests"}, check=True)
    if commit is not None:
        with tempfile.TemporaryDirectory() as there:
            archive = ["git", "archive", "--output", f"{there}/sources.tar", commit, "src", "tests"]
            subprocess.run(archive, cwd=here, check=True)
            subprocess.run(["tar", "xf", "sources.tar"], cwd=there, check=True)
            print(f"\nthe same at {commit}", flush=True)
            subprocess.run(program, env={**os.environ, "PYTHONPATH": f"{there}/src:{there}/tests"}, check=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--link", type=int, nargs="?", const=100, metavar="SEEDS", help="also simulate links with loss")
    parser.add_argument("--beside", metavar="COMMIT", help="with --link: the same at this commit")
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
        links(chosen.link, chosen.beside)


if __name__ == "__main__":
    main()

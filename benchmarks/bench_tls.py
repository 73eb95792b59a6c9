"""TLCP and TLS 1.3: a handshake, and a connection that carries 4 MiB, both sides in one process.

Keys and certificates are warm: they have served before, as those of a server and of a client that comes back have; no
session is resumed. The peer is bctls, in Java, whose two sides run in two threads; ours run in one. It takes part where
BCTLS_PEER names its folder (tests/smcrypto/tls/peers/bctls).
"""

from __future__ import annotations

import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from smcrypto.tls import Connection, DataReceived, SMContext
from tls_authority import HOST, Authority, bctls

SUITES = ("ECC_SM4_GCM_SM3", "ECDHE_SM4_GCM_SM3", "TLS_SM4_GCM_SM3", "TLS_SM4_CCM_SM3")
TLS13 = SUITES[2:]
MEBIBYTES = 4
DATA = bytes(MEBIBYTES << 20)


@pytest.fixture(scope="module")
def authority() -> Authority:
    return Authority.make()


def connect(client: SMContext, server: SMContext) -> tuple[Connection, Connection]:
    near, far = Connection(client, server_hostname=HOST), Connection(server, server_side=True)
    while out := near.data_to_send():
        far.receive_data(out)
        near.receive_data(far.data_to_send())
    return near, far


def carry(client: SMContext, server: SMContext) -> None:
    near, far = connect(client, server)
    near.send(DATA)
    events = far.receive_data(near.data_to_send())
    if sum(len(event.data) for event in events if isinstance(event, DataReceived)) != len(DATA):
        raise ValueError("not all data came")


def contexts(authority: Authority, suite: str) -> tuple[SMContext, SMContext]:
    client = authority.client if suite.startswith("ECDHE") else None  # which shows its certificates as well
    made = authority.context(suite, client), authority.context(suite, authority.server)
    for _ in range(5):
        connect(*made)
    return made


@pytest.fixture(scope="module", params=TLS13)
def java(request: pytest.FixtureRequest, authority: Authority, tmp_path_factory: Any) -> Iterator[Any]:
    folder: Path = tmp_path_factory.mktemp("bctls")
    (folder / "cert").write_bytes(authority.server.certificate.to_der())
    (folder / "key").write_bytes(authority.server.key.to_der())
    command = [part for part in bctls() if part != "-XX:TieredStopAtLevel=1"]  # here Java is to compile all it can
    arguments = ["benchmark", request.param, "-cert", folder / "cert", "-key", folder / "key"]
    with subprocess.Popen(
        [*map(str, command), *map(str, arguments)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, bufsize=1
    ) as process:
        stdin, stdout = process.stdin, process.stdout
        if stdin is None or stdout is None or stdout.readline() != "ready\n":
            raise OSError("bctls does not start")

        def connection(mebibytes: int) -> None:
            stdin.write(f"{mebibytes}\n")
            if stdout.readline() != "done\n":
                raise OSError("bctls failed")

        yield request.param, connection
        process.kill()


@pytest.mark.parametrize("suite", SUITES)
def test_handshake(benchmark: Any, authority: Authority, suite: str) -> None:
    benchmark.group = f"{suite}, handshake of both sides"
    benchmark.extra_info["implementation"] = "smcrypto"
    benchmark(connect, *contexts(authority, suite))


@pytest.mark.parametrize("suite", TLS13)
def test_data(benchmark: Any, authority: Authority, suite: str) -> None:
    benchmark.group = f"{suite}, a connection with {MEBIBYTES} MiB"
    benchmark.extra_info.update(implementation="smcrypto", bytes=len(DATA))
    benchmark(carry, *contexts(authority, suite))


def test_handshake_of_bctls(benchmark: Any, java: Any) -> None:
    suite, connection = java
    benchmark.group = f"{suite}, handshake of both sides"
    benchmark.extra_info["implementation"] = "bctls"
    benchmark(connection, 0)


def test_data_of_bctls(benchmark: Any, java: Any) -> None:
    suite, connection = java
    benchmark.group = f"{suite}, a connection with {MEBIBYTES} MiB"
    benchmark.extra_info.update(implementation="bctls", bytes=len(DATA))
    benchmark(connection, MEBIBYTES)

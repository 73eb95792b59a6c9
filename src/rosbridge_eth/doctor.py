"""`doctor`: tries everything that a home depends on, for real, and names the mend for what does not work.

Each check yields findings. It changes nothing: what is not there yet is not
made, and a port or a session that is tried is given back.
"""

from __future__ import annotations

import importlib
import importlib.util
import json
import os
import platform
import shutil
import socket
import stat
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from enum import StrEnum
from pathlib import Path

from rosbridge_eth import ledger
from rosbridge_eth.channel import Client, ClientConfig, Connected, Event, HandshakeFailed
from rosbridge_eth.channel.udp import RECEIVE_BUFFER, UdpLoop, client_socket, server_sockets
from rosbridge_eth.config import (
    RobotConfig,
    ServerConfig,
    load_reader_config,
    load_robot_config,
    load_server_config,
)
from rosbridge_eth.errors import BridgeError, NetworkError
from rosbridge_eth.home import HomeKind, OperatorHome, ReaderHome, RobotHome
from rosbridge_eth.identity import Identity, Trust, load_identity, read_certificates
from rosbridge_eth.ledger.accounts import Keyring
from rosbridge_eth.registry import Registry
from rosbridge_eth.robot import assembly as robot_assembly
from rosbridge_eth.robot.clock import certificate_clock, clock_synchronised
from rosbridge_eth.robot.sender import mend as mend_of
from rosbridge_eth.server.administration import load_ca
from rosbridge_eth.server.assembly import bound_contract, open_chain, open_inbox, open_journal
from rosbridge_eth.sources import open_source
from rosbridge_eth.store.peek import peek_spool

OLDEST_PYTHON = (3, 11)
PACKAGES = ("pydantic", "eth_account", "web3", "rosbags", "redis", "prometheus_client", "rich", "typer")
HANDSHAKE_TIME = 6.0  # seconds for a server to answer
ATTEMPT_TIME = 2.5  # seconds for one attempt; what a server says of a refusal is known when it ends
EXPIRY = timedelta(days=30)
LITTLE_ROOM = 1 << 30  # bytes
_ETH = 10**18


class Result(StrEnum):
    OK = "ok"
    NOTE = "note"  # works, and will not for ever or not at its best
    BROKEN = "broken"
    SKIPPED = "skipped"  # could not be tried; `mend` says what it takes


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing that was tried: what was found, and the mend where something is to be done."""

    what: str
    result: Result
    found: str
    mend: str = ""


Check = Callable[[], Iterable[Finding]]


def ok(what: str, found: str) -> Finding:
    return Finding(what, Result.OK, found)


def note(what: str, found: str, mend: str) -> Finding:
    return Finding(what, Result.NOTE, found, mend)


def broken(what: str, found: str, mend: str) -> Finding:
    return Finding(what, Result.BROKEN, found, mend)


def skipped(what: str, why: str, mend: str) -> Finding:
    return Finding(what, Result.SKIPPED, why, mend)


def examine(checks: Iterable[tuple[str, Check]]) -> Iterator[Finding]:
    """Run the checks one after the other; a failure of the bridge's own is a finding, and its text has the mend."""
    for what, check in checks:
        try:
            yield from check()
        except BridgeError as error:
            # What to do comes last: after a semicolon, after a reason in brackets, or as a second sentence.
            parts = (str(error).partition(mark) for mark in ("; ", "): ", ". "))
            found, mark, mend = next((part for part in parts if part[2]), (str(error), "", ""))
            yield broken(what, found + mark.strip(".;: "), mend or "correct what this names")


def checks_of(path: Path, kind: HomeKind, passphrase: bytes | None) -> list[tuple[str, Check]]:
    """Everything there is to try for this home."""
    machine: list[tuple[str, Check]] = [
        ("Python", _python),
        ("packages", _packages),
        ("clock", _clock),
        ("home", lambda: _permissions(path)),
        ("disk", lambda: _disk(path)),
    ]
    match kind:
        case HomeKind.OPERATOR:
            return machine + _operator(OperatorHome(path), passphrase)
        case HomeKind.ROBOT:
            return machine + _robot(RobotHome(path), passphrase)
        case HomeKind.READER:
            return machine + _reader(ReaderHome(path), passphrase)


# ---------------------------------------------------------------------- the machine


def _python() -> Iterator[Finding]:
    version = platform.python_version()
    if sys.version_info < OLDEST_PYTHON:
        yield broken("Python", version, "install Python 3.11 or newer")
    else:
        yield ok("Python", version)


def _packages() -> Iterator[Finding]:
    absent = []
    for name in PACKAGES:
        try:
            importlib.import_module(name)
        except ImportError:
            absent.append(name)
    if absent:
        yield broken("packages", "not to be imported: " + ", ".join(absent), "pip install 'pysmcrypto[bridge]'")
    else:
        yield ok("packages", "all there")
    if importlib.util.find_spec("coincurve") is None:
        yield note("coincurve", "absent", "pip install coincurve: signing a transaction is then ten times as fast")


def _clock() -> Iterator[Finding]:
    now = datetime.now(UTC)
    if now.year < 2026:
        yield broken("clock", f"it says {now:%Y-%m-%d}", "set the clock; certificates are refused before their time")
    elif not clock_synchronised():
        yield note(
            "clock", "the kernel does not hold it to be synchronised",
            "start systemd-timesyncd or chrony; records say of themselves that their time is not to be relied on",
        )
    else:
        yield ok("clock", "synchronised")


def _permissions(path: Path) -> Iterator[Finding]:
    mode = stat.S_IMODE(path.stat().st_mode)
    if mode & 0o022:
        yield broken("home", f"others may write to {path} (mode {mode:04o})", f"chmod 700 {path}")
    elif mode & 0o055:
        yield note("home", f"others may look into {path} (mode {mode:04o})", f"chmod 700 {path}")
    else:
        yield ok("home", f"{path}, its owner's alone")
    if not os.access(path, os.W_OK):
        yield broken("home", f"{path} is not writable for this user", "run as the user the service runs as")
    for key in sorted(path.rglob("*.key.pem")):
        mode = stat.S_IMODE(key.stat().st_mode)
        if mode & 0o077:
            yield broken(
                "key files", f"{key} is open to others (mode {mode:04o})",
                f"chmod 600 {key}, and if it may have been read, register anew",
            )


def _disk(path: Path) -> Iterator[Finding]:
    free = shutil.disk_usage(path).free
    if free < LITTLE_ROOM:
        yield note("disk", f"{free >> 20} MiB free at {path}", "make room; records wait here while the chain is away")
    else:
        yield ok("disk", f"{free >> 30} GiB free")


def _receive_buffer(setting: str) -> Iterator[Finding]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER)
        granted = sock.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF)
    if sys.platform.startswith("linux"):
        granted //= 2  # the kernel doubles what it was asked, for its own books: socket(7)
    if granted < RECEIVE_BUFFER:
        yield note(
            "receive buffer", f"the kernel grants {granted >> 10} KiB of {RECEIVE_BUFFER >> 10} KiB",
            f"sysctl -w net.core.rmem_max={RECEIVE_BUFFER} ({setting})",
        )
    else:
        yield ok("receive buffer", f"{granted >> 10} KiB")


def _certificates(folder: Path) -> Iterator[Finding]:
    """Are the certificates in a folder in force, and for how long?"""
    now = datetime.now(UTC)
    for path in sorted(folder.glob("*.crt.pem")):
        for certificate in read_certificates(path.read_bytes()):
            left = certificate.not_after - now
            if left < timedelta(0):
                yield broken("certificates", f"{path} expired on {certificate.not_after:%Y-%m-%d}", "register anew")
            elif certificate.not_before > now:
                yield broken("certificates", f"{path} begins on {certificate.not_before:%Y-%m-%d}", "set the clock")
            elif left < EXPIRY:
                yield note("certificates", f"{path} expires in {left.days} days", "renew it: docs/operations.md")
            else:
                yield ok("certificates", f"{path.name} of {folder.name} until {certificate.not_after:%Y-%m-%d}")


def _head(chain: ledger.Chain) -> Iterator[Finding]:
    head = chain.head()
    age = max(0, int(time.time()) - head.timestamp)
    yield ok("node", f"{chain.url} answers; block {head.number}, {age} s old, chain {chain.chain_id()}")


# ---------------------------------------------------------------------- an operator's home


def _operator(home: OperatorHome, passphrase: bytes | None) -> list[tuple[str, Check]]:
    def config() -> ServerConfig:
        return load_server_config(home.config)

    return [
        ("configuration", lambda: (ok("configuration", str(home.config)) for _ in [config()])),
        ("certificates", lambda: (*_certificates(home.ca), *_certificates(home.server))),
        ("passphrase", lambda: _operator_secrets(home, passphrase)),
        ("UDP port", lambda: _port(config())),
        ("receive buffer", lambda: _receive_buffer("net.core.rmem_max in /etc/sysctl.d")),
        ("registry", lambda: _registry(home)),
        ("store", lambda: _store(home, config())),
        ("node", lambda: _node(home, config())),
    ]


def _operator_secrets(home: OperatorHome, passphrase: bytes | None) -> Iterator[Finding]:
    if passphrase is None:
        yield skipped("passphrase", "not tried", "give --passphrase-file")
        return
    load_ca(home, passphrase)
    load_identity(home.server, passphrase)
    Keyring.load(home.accounts, passphrase)
    yield ok("passphrase", "opens the CA, the server's keys and the accounts")


def _port(config: ServerConfig) -> Iterator[Finding]:
    try:
        for sock in server_sockets(config.listen):
            sock.close()
    except NetworkError as error:
        found = str(error).partition(";")[0]
        yield note("UDP port", found, "fine if the server runs; otherwise stop what has the port")
        return
    yield ok("UDP port", f"{config.listen} is free for the server")


def _registry(home: OperatorHome) -> Iterator[Finding]:
    registry = Registry(home.registry)
    try:
        names = registry.all()
    finally:
        registry.close()
    yield ok("registry", f"{sum(name.revoked_at is None for name in names)} names in force")


def _store(home: OperatorHome, config: ServerConfig) -> Iterator[Finding]:
    if not home.deployment_file.exists():
        yield skipped("store", "no contract is deployed yet", f"deploy --home {home.path}")
        return
    if config.store.url != "sqlite" or home.inbox.exists():
        inbox = open_inbox(config, home)
        try:
            held = inbox.statistics(time.time())
        finally:
            inbox.close()
        yield ok("inbox", f"{held.waiting + held.leased} records wait")
        if held.dead:
            yield note("inbox", f"{held.dead} records under identities that are taken",
                       "two robots with one identity? docs/operations.md, dead letters")
    if home.journal.exists():
        journal = open_journal(home, home.deployment())
        try:
            dead = journal.count_dead_letters()
        finally:
            journal.close()
        yield ok("journal", "opens, and is of this contract")
        if dead:
            yield note("journal", f"{dead} dead letters", "docs/operations.md, dead letters")


def _node(home: OperatorHome, config: ServerConfig) -> Iterator[Finding]:
    chain = open_chain(config)
    try:
        yield from _head(chain)
        if not home.deployment_file.exists():
            yield skipped("contract", "none is deployed yet", f"deploy --home {home.path}")
            return
        deployment = home.deployment()
        bound_contract(chain, deployment)
        yield ok("contract", f"{deployment.contract} has the code of this version")
        yield from _balances(chain, home, config)
    finally:
        chain.close()


def _balances(chain: ledger.Chain, home: OperatorHome, config: ServerConfig) -> Iterator[Finding]:
    operator = json.loads(home.accounts.read_bytes())["operator"]
    treasury = chain.balance(operator) / _ETH
    if treasury < config.funds.by:
        yield broken("treasury", f"{operator} has {treasury:.4f} ETH, a top-up takes {config.funds.by:g}",
                     f"send ETH to {operator}")
    else:
        yield ok("treasury", f"{treasury:.4f} ETH")
    registry = Registry(home.registry)
    try:
        robots = [robot for robot in registry.all("robot") if robot.revoked_at is None and robot.account]
    finally:
        registry.close()
    low = [robot.name for robot in robots if chain.balance(robot.account or "") / _ETH < config.funds.below]
    if low:
        yield note("robots' accounts", f"below {config.funds.below:g} ETH: {', '.join(low)}",
                   "the server tops them up when they write, as long as the treasury can")
    elif robots:
        yield ok("robots' accounts", f"{len(robots)} have enough")


# ---------------------------------------------------------------------- a robot's home


def _robot(home: RobotHome, password: bytes | None) -> list[tuple[str, Check]]:
    def config() -> RobotConfig:
        return load_robot_config(home.config)

    opened: list[Identity] = []

    return [
        ("configuration", lambda: (ok("configuration", str(home.config)) for _ in [config()])),
        ("bridge", lambda: (ok("bridge", f"{end.robot} of {end.server_name}") for end in [home.bridge()])),
        ("certificates", lambda: _certificates(home.identity)),
        ("readers", lambda: _readers(home, config())),
        ("source", lambda: _source(config())),
        ("password", lambda: _robot_secrets(home, password, opened)),
        ("spool", lambda: _spool(home)),
        ("server", lambda: _handshake(home, config(), opened)),
    ]


def _readers(home: RobotHome, config: RobotConfig) -> Iterator[Finding]:
    roots = read_certificates((home.identity / "ca.crt.pem").read_bytes())
    keys = robot_assembly.reader_keys(config, home, roots)
    yield ok("readers", f"{len(keys)} can open what this robot writes")


def _source(config: RobotConfig) -> Iterator[Finding]:
    settings, why = config.source_and_why(os.environ)
    if settings.kind.startswith("ros"):
        set_up = {name: value for name, value in sorted(os.environ.items()) if name.startswith("ROS_")}
        yield ok("ROS environment", ", ".join(f"{name}={value}" for name, value in set_up.items()) or "nothing set")
    source = open_source(settings.settings(), config.selection())
    try:
        offers = source.offers()
    finally:
        source.close()
    if settings.kind == "sim":
        yield note("source", f"SIMULATED, {why}", "write a [source] for a real robot")
    elif not offers:
        yield note("source", f"{settings.kind} answers and offers no topic", "start what publishes")
    else:
        yield ok("source", f"{settings.kind} ({why}) offers {len(offers)} topics")


def _robot_secrets(home: RobotHome, password: bytes | None, opened: list[Identity]) -> Iterator[Finding]:
    if password is None:
        yield skipped("password", "not tried", "give --passphrase-file with the registration password")
        return
    identity, _ = load_identity(home.identity, password)
    opened.append(identity)
    yield ok("password", f"opens the keys of {identity.name}")


def _spool(home: RobotHome) -> Iterator[Finding]:
    if not home.spool.exists():
        yield ok("spool", "none yet; the first start makes it")
        return
    held = peek_spool(home.spool)
    if held.records is None or held.bytes is None:
        yield ok("spool", "in use by the robot that runs")
    else:
        yield ok("spool", f"{held.records} records, {held.bytes >> 10} KiB wait for the server")


def _handshake(home: RobotHome, config: RobotConfig, opened: Sequence[Identity]) -> Iterator[Finding]:
    """A session with the server, as the robot would make it, and its end."""
    end = home.bridge()
    place = config.server or robot_assembly.parse_server(end.server_address)
    if not opened:
        yield skipped("server", f"{place} not tried", "give --passphrase-file: it takes the robot's keys to be let in")
        return
    if home.spool.exists() and peek_spool(home.spool).in_use:
        yield skipped("server", f"{place} not tried: a session would end that of the robot that runs",
                      "see its /readyz, or stop it")
        return
    roots = read_certificates((home.identity / "ca.crt.pem").read_bytes())
    sock, address = client_socket(place)
    events: list[Event] = []
    now = time.monotonic()
    client = Client(
        ClientConfig(mode=robot_assembly.MODES[config.channel], attempt_timeout=ATTEMPT_TIME), opened[0], Trust(roots),
        end.server_name, now, wall=certificate_clock(home),
    )
    loop = UdpLoop(client, sock, events.append)
    client.connect(address, now)
    try:
        while time.monotonic() < now + HANDSHAKE_TIME and not any(isinstance(e, Connected) for e in events):
            loop.step(0.2)
        took = time.monotonic() - now
        client.close(time.monotonic())
        loop.step(0.0)
    finally:
        loop.close()
    if any(isinstance(event, Connected) for event in events):
        yield ok("server", f"{place} made a session in {took * 1000:.0f} ms")
        return
    failures = [e for e in events if isinstance(e, HandshakeFailed)] or [HandshakeFailed("no answer")]
    # One attempt may have lost what another was told.
    failure = next((event for event in reversed(failures) if event.hint is not None), failures[-1])
    if client.statistics().datagrams_received == 0:
        mend = (
            f"is the server up, its `public` address right, UDP port {place.port} open in every firewall between, and"
            f' does it take channel = "{config.channel}" (`channel` in its server.toml)?'
        )
    else:
        mend = mend_of(failure, config.channel)
    yield broken("server", f"{place}: {failure.why}", mend)


# ---------------------------------------------------------------------- a reader's folder


def _reader(home: ReaderHome, passphrase: bytes | None) -> list[tuple[str, Check]]:
    def node() -> Iterator[Finding]:
        config = load_reader_config(home.config)
        chain = ledger.connect(config.chain)
        try:
            yield from _head(chain)
            ledger.Contract.at(chain, config.contract)
            yield ok("contract", f"{config.contract} has the code of this version")
        finally:
            chain.close()

    def secrets() -> Iterator[Finding]:
        if passphrase is None:
            yield skipped("passphrase", "not tried", "give --passphrase-file")
            return
        identity, _ = load_identity(load_reader_config(home.config).identity, passphrase)
        yield ok("passphrase", f"opens the keys of {identity.name}")

    return [
        ("certificates", lambda: _certificates(load_reader_config(home.config).identity)),
        ("passphrase", secrets),
        ("node", node),
    ]

"""`doctor`: tries everything that a home depends on, for real, and names the fix for what does not work.

A check is a function that yields findings. What a running home shows comes from `status`; the checks here try the rest:
keys, certificates, disk, ports, a session (`topics` tries the source). Nothing is changed or made,
and a port or session that was tried is given back.
"""

from __future__ import annotations

import os
import sqlite3
import stat
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing
from datetime import UTC, datetime, timedelta
from functools import partial
from pathlib import Path
from typing import Annotated, Any, NamedTuple, TypeAlias

import typer

from rosbridge_eth import identity as ids
from rosbridge_eth.channel import Client, ClientConfig, Connected, Event, HandshakeFailed, Mode
from rosbridge_eth.channel.udp import UdpLoop, client_socket, server_socket
from rosbridge_eth.config import Address, RobotConfig, load_reader_config, load_robot_config, load_server_config
from rosbridge_eth.config.home import HomeKind, OperatorHome, ReaderHome, RobotHome, kind_of
from rosbridge_eth.config.passphrases import passphrase_file, read_passphrase
from rosbridge_eth.errors import BridgeError
from rosbridge_eth.files import read_file
from rosbridge_eth.operator import status
from rosbridge_eth.operator.status import span
from rosbridge_eth.robot.loop import certificate_clock, clock_synchronised, reader_keys
from rosbridge_eth.robot.sender import fix
from rosbridge_eth.terminal import OPERATOR_HOME, AnyHomeOption, Json, data, print_json, table, talk

HANDSHAKE_TIME, ATTEMPT_TIME = 6.0, 2.5  # seconds for a server to answer; for an attempt, with which a refusal is known
EXPIRY = timedelta(days=30)
LITTLE_ROOM = 64 << 20  # bytes
WRONG_CLOCK = 300.0  # seconds between two clocks of which one is wrong
OLD_HEAD = 12 * 3600.0  # seconds since the last block


class Finding(NamedTuple):
    """One thing that was tried: what was found, and the fix where something is to be done.

    result: "ok"; "note": it works, and will not for ever or not at its best; "broken"; "skipped": it could not be
    tried, and `fix` says what it takes.
    """

    result: str
    what: str
    found: str
    fix: str = ""


Home: TypeAlias = OperatorHome | RobotHome | ReaderHome
Findings: TypeAlias = Iterator[Finding]
Check: TypeAlias = Callable[[Any, bytes | None], Findings]
"""A check is given the home, as what it is, and, where there is one, the passphrase of its keys."""
ok, note, broken, skipped = (partial(Finding, result) for result in ("ok", "note", "broken", "skipped"))


def examine(checks: Mapping[str, Check], home: Any, secret: bytes | None) -> Findings:
    """Run the checks one after the other; a failure of the bridge's own is a finding, whose text has the fix. What
    ends several checks is told once."""
    told = set[str]()
    for what, check in checks.items():
        try:
            yield from check(home, secret)
        except (OSError, sqlite3.Error) as error:
            name = getattr(error, "filename", None)
            yield broken(what, f"{f'{name}: ' if name else ''}{getattr(error, 'strerror', None) or error}",
                         "see that it is there, whole, and this user's to read")
        except BridgeError as error:
            if str(error) in told:
                continue
            told.add(str(error))
            yield broken(what, str(error))


# The machine


def clock(home: Home, secret: bytes | None) -> Findings:
    if not clock_synchronised():
        yield note("clock", "not synchronised with a time server",
                   "start systemd-timesyncd or chrony; until then records say that their time is not to be relied on")
    else:
        yield ok("clock", "synchronised")


def files(home: Home, secret: bytes | None) -> Findings:
    mode = stat.S_IMODE(home.path.stat().st_mode)
    if mode & 0o077:
        yield broken("home", f"{home.path} is open to others (mode {mode:04o})", f"chmod 700 {home.path}")
    else:
        yield ok("home", f"{home.path}, its owner's alone")
    for key in sorted([*home.path.rglob("*.key.pem"), *home.path.glob("accounts.json")]):
        read_file(key, private=True)


def disk(home: Home, secret: bytes | None) -> Findings:
    found = os.statvfs(home.path)
    free = found.f_bavail * found.f_frsize
    if free < LITTLE_ROOM or (found.f_files and not found.f_favail):
        yield broken("disk", f"{free >> 20} MiB and {found.f_favail} files free at {home.path}",
                     "make room: until there is some nothing more is taken; what was taken is safe")
    else:
        yield ok("disk", f"{free >> 20} MiB free")


def certificates(folder: Path, renewal: str) -> Findings:
    """Are the certificates in a folder in force, and for how long? renewal: how they are made again."""
    now = datetime.now(UTC)
    for path in sorted(folder.glob("*.crt.pem")):
        for each in ids.read_certificates(path.read_bytes()):
            fix = "make a new home, with a new CA" if path.name == "ca.crt.pem" else renewal
            if each.not_after < now:
                yield broken("certificates", f"{path} expired on {each.not_after:%Y-%m-%d}", fix)
            elif each.not_before > now:
                yield broken("certificates", f"{path} begins on {each.not_before:%Y-%m-%d}", "set the clock")
            elif each.not_after - now < EXPIRY:
                yield note("certificates", f"{path} expires in {(each.not_after - now).days} days", fix)
            else:
                yield ok("certificates", f"{path.name} of {folder.name} until {each.not_after:%Y-%m-%d}")


def node_found(url: str, block: int, age: float) -> Findings:
    """age: of the node's last block by this machine's clock, in seconds."""
    yield ok("node", f"{url} answers; block {block}, {span(max(0.0, age))} old")
    if age < -WRONG_CLOCK:
        yield broken("clock", f"it is {span(-age)} behind the last block", "set this machine's clock")
    elif age > OLD_HEAD:
        yield broken("clock", f"by it, the last block is {span(age)} old",
                     "set the clock if it is ahead; else see to the chain's nodes, which make no blocks (a local chain"
                     " makes the next one with the next transaction)")


def state(report: status.Report) -> Findings:
    """What `status` finds broken."""
    for what, said in [*report["alarms"], *report["unknown"]]:
        if (what, said) != status.NO_SERVER:
            yield broken(what, said)


# An operator's home


def operator_configuration(home: OperatorHome, secret: bytes | None) -> Findings:
    addresses = load_server_config(home.config).addresses()
    yield ok("configuration", f"{home.config}; robots are told to send to {', '.join(map(str, addresses))}")


def operator_passphrase(home: OperatorHome, secret: bytes | None) -> Findings:
    from rosbridge_eth.ledger import Keyring

    if secret is None:
        yield skipped("passphrase", "none was given", "give --passphrase-file")
        return
    ids.load_identity(home.server, secret)
    Keyring.load(home.accounts, secret)
    yield ok("passphrase", "opens the server's keys and the accounts")


def operations(home: OperatorHome, secret: bytes | None) -> Findings:
    """What `status` finds; and where no server runs here, whether its ports are free."""
    from rosbridge_eth.server import metrics

    report, config = status.of_operator(home), load_server_config(home.config)
    found = [*state(report)]
    yield from found
    waits = sum(robot.get("waiting", {}).get("chunks", 0) for robot in report["robots"].values())
    works = {"registry": f"{sum(each['revoked'] is None for each in report['names'])} names in force"}
    if report["contract"]:
        works["store"] = f"{waits} chunks wait"
    if (eth := report["operator"]["eth"]) is not None:
        works["treasury"] = f"{eth:.4f} ETH"
    yield from (ok(what, said) for what, said in works.items() if what not in {each.what for each in found})
    if node := report["node"]:
        yield from node_found(node["url"], node["block"], node["age_seconds"])
    if report["process"] is None:
        for shard in range(config.shards):
            server_socket(config.listen.next(shard)).close()
            metrics.require_free(config.monitor and config.monitor.next(shard))
        yield ok("server", "does not run here; its ports are free")
    elif not report["process"]:
        yield ok("server", "runs, and is ready")


# A robot's home


def bridge(home: RobotHome, secret: bytes | None) -> Findings:
    end, config = home.bridge(), load_robot_config(home.config)
    yield ok("configuration", str(home.config))
    place = config.server or end.addresses()[0]
    if place.nowhere:
        yield broken("bridge", f"it was told to send to {place}, which no machine can have",
                     'write server = "HOST:PORT", as the server is reached, into robot.toml')
    else:
        yield ok("bridge", f"{end.robot} sends to {end.server_name} at {place}")


def robot_certificates(home: RobotHome, secret: bytes | None) -> Findings:
    answer = f"`register {home.bridge().robot} REQUEST --replace` with {home.request.name}"
    yield from certificates(home.identity, f"let the operator run {answer}, and join again")


def readers(home: RobotHome, secret: bytes | None) -> Findings:
    home.bridge()  # with which the CA's certificate came
    roots = ids.read_certificates((home.identity / "ca.crt.pem").read_bytes())
    yield ok("readers", f"{len(reader_keys(home, roots))} can open what it writes")


def session(home: RobotHome, secret: bytes | None) -> Findings:
    """The spool, and a session with the server as the robot would make it."""
    from rosbridge_eth.server import metrics

    report, end, config = status.of_robot(home), home.bridge(), load_robot_config(home.config)
    server = config.server or end.addresses()[0]
    yield from state(report)
    if report["runs"]:
        if not report["alarms"]:
            yield ok("robot", "runs, and is ready")
        yield skipped("server", f"{server} not tried: a session would end that of the robot that runs",
                      "see `status` of this home")
        return
    metrics.require_free(config.monitor)
    yield ok("robot", "does not run; its ports are free")
    if secret is None:
        yield skipped("server", f"{server} not tried: a session needs the robot's keys", "give --passphrase-file")
        return
    identity, roots = ids.load_identity(home.identity, secret)
    yield ok("password", f"opens the keys of {identity.name}")
    yield from try_session(home, config, identity, ids.Trust(roots), end.server_name, server)


def try_session(
    home: RobotHome, config: RobotConfig, identity: ids.Identity, trust: ids.Trust, name: str, server: Address
) -> Findings:
    """Make a session with the server and end it; the server's time is compared with ours."""
    sock, address = client_socket(server)
    events, now = list[Event](), time.monotonic()
    settings = ClientConfig(mode=Mode[config.channel.upper()], attempt_timeout=ATTEMPT_TIME)
    client = Client(settings, identity, trust, name, now, wall=certificate_clock(home))
    client.connect(address, now)
    with closing(UdpLoop(client, sock, events.append)) as loop:
        while time.monotonic() < now + HANDSHAKE_TIME and not any(isinstance(each, Connected) for each in events):
            loop.step(0.2)
        client.close(time.monotonic())
        loop.step(0.0)
    failed = [event for event in events if isinstance(event, HandshakeFailed)]
    for connected in (event for event in events if isinstance(event, Connected)):
        yield ok("server", f"{server} made a session")
        off = 0.0 if connected.server_time is None else time.time() - connected.server_time.timestamp()
        if abs(off) > WRONG_CLOCK:
            yield broken("clock", f"it is {span(abs(off))} {'ahead of' if off > 0 else 'behind'} the server's",
                         "set the one of the two that is wrong")
        return
    # A refusal with its reason first: one attempt may have lost what another was told.
    why = min(failed, key=lambda failure: failure.hint is None, default=HandshakeFailed("no answer"))
    yield broken("server", f"{server}: {why.why}", fix(why, config.channel)
                 if client.statistics()["datagrams_received"] else
                 f"is the server up, its `public` address right, UDP port {server.port} open in every firewall between,"
                 f' and does it take channel = "{config.channel}" (`channel` in its server.toml)?')


# A reader's folder


def own_keys(home: ReaderHome, secret: bytes | None) -> Findings:
    yield from certificates(home.path, "let the operator make this reader again (`reader NAME --replace`)")
    if secret is None:
        yield skipped("passphrase", "none was given", "give --passphrase-file")
    else:
        yield ok("passphrase", f"opens the keys of {ids.load_identity(home.path, secret)[0].name}")


def reader_nodes(home: ReaderHome, secret: bytes | None) -> Findings:
    from rosbridge_eth.ledger import Ledger

    config = load_reader_config(home.config)

    def look(url: str, secret: bytes | None) -> Findings:
        with closing(Ledger.connect(url, config)) as ledger:
            ledger.check()
            head = ledger.block()
            yield from node_found(ledger.url, head.number, time.time() - head.time)

    for url in config.chain:
        yield from examine({"node": look}, url, secret)


_MACHINE: dict[str, Check] = {"clock": clock, "key files": files, "disk": disk}
CHECKS: dict[HomeKind, tuple[type[Home], dict[str, Check]]] = {
    HomeKind.OPERATOR: (OperatorHome, _MACHINE | {
        "configuration": operator_configuration,
        "certificates": lambda home, _: certificates(home.path / "ca", ""),
        "server's certificates": lambda home, _: certificates(
            home.server, f"run `renew --home {home.path}`, then start the server again"),
        "passphrase": operator_passphrase, "server": operations,
    }),
    HomeKind.ROBOT: (RobotHome, _MACHINE | {
        "configuration": bridge, "certificates": robot_certificates, "readers": readers, "server": session,
    }),
    HomeKind.READER: (ReaderHome, _MACHINE | {"keys": own_keys, "node": reader_nodes}),
}  # fmt: skip


# The command

_SIGN = {"ok": "ok", "note": "NOTE", "broken": "BROKEN", "skipped": "not tried"}


def doctor(
    home: AnyHomeOption = OPERATOR_HOME,
    passphrase: Annotated[Path | None, typer.Option(
        "--passphrase-file", help="Of this home's keys (a robot's password), to try them.")] = None,
    json: Json = False,
) -> None:
    """Check everything a home depends on, and name the fix. An operator's, a robot's, a reader's.

    Exits with 1 if something is broken.
    """
    kind = kind_of(home)
    file = passphrase or passphrase_file(kind)
    secret = None if file is None else read_passphrase(kind, "", file=file)
    findings, (of, checks) = list[Finding](), CHECKS[kind]
    for finding in examine(checks, of(home), secret):
        findings.append(finding)
        if not json and finding.result != "ok":
            told = "; ".join(filter(None, (finding.found, finding.fix)))
            talk(f"{_SIGN[finding.result]}: {finding.what}: {told}")
    count = sum(finding.result == "broken" for finding in findings)
    if json:
        print_json({"home": str(home), "kind": kind, "broken": count, "findings": [f._asdict() for f in findings]})
    else:
        rows = [(f.what, _SIGN[f.result], f.found) for f in findings]
        data.print(table(f"The {kind}'s home {home}", ["what", "result", "found"], rows))
    if count:
        raise BridgeError(f"broken: {count}; each line above names the fix")

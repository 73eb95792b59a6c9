"""`status`: what is where, by a home: who is enrolled, connected, waiting or on hold, and what the chain has.

It asks registry, inbox, node and, where `monitor` is configured, the running server or robot; whatever of them does
not answer, the rest is shown, and a sentence says what is not known and why. Nothing is changed or made.
"""

from __future__ import annotations

import http.client
import json as jsonlib
import time
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import closing, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, NamedTuple

import typer
from rich.console import Group, RenderableType
from rich.text import Text

from rosbridge_eth.chunk import Chunk, Log, robot_id
from rosbridge_eth.config import ServerConfig, load_reader_config, load_robot_config, load_server_config
from rosbridge_eth.database import InUse, NothingThere
from rosbridge_eth.errors import BridgeError, ChainError, ConfigError, IdentityError
from rosbridge_eth.home import HomeKind, OperatorHome, ReaderHome, RobotHome, kind_of
from rosbridge_eth.identity import Role
from rosbridge_eth.terminal import OPERATOR_HOME, AnyHomeOption, Json, data, print_json, table, talk

if TYPE_CHECKING:
    from rosbridge_eth.inbox import Inbox
    from rosbridge_eth.ledger import Ledger, Standing
    from rosbridge_eth.registry import Enrolment

_WEI: Final = 10**18
ANSWER_TIME = 5.0  # seconds for a node or a monitor
SPENDING_BLOCKS = 100  # what an account spends is seen by its balance so many blocks ago: geth keeps 128 states
SEEN = 15.0  # seconds since a worker last saw the session
FOLLOW_EVERY = 2.0
PAGE = 200  # rows of the inbox looked through at once
DEAD = 1000  # dead letters; the inbox keeps no more
Report = dict[str, Any]
Figure = tuple[str, Mapping[str, str], float]


class Located(NamedTuple):
    """Where a chunk is. state: unknown, stored (in the inbox), written (in a block), confirmed, dead letter.

    proven: what the contract says, asked with checkData; None where no block has it.
    """

    state: str
    transaction: str | None = None
    block: int | None = None
    proven: bool | None = None


def locate(home: OperatorHome, ledger: Ledger, robot: str, stream: str, number: int) -> Located:
    """Where a robot's chunk is: in the inbox behind what the chain has, or on the chain, by the links of its events."""
    from eth_utils.crypto import keccak

    from rosbridge_eth.registry import Registry
    from rosbridge_eth.supervisor import open_store

    config, tk = load_server_config(home.config), robot_id(robot)
    with Registry(home.registry) as registry:
        if tk not in registry.names():
            raise IdentityError(f"no robot {robot!r} is enrolled; `status` lists the names")
    if len(stream) != 32 or not set(stream.lower()) <= set("0123456789abcdef"):
        raise ConfigError(f"the stream is 32 hex digits, as `read --json` shows it, not {stream!r}")
    [standing], wanted, found = ledger.standings([tk]), (bytes.fromhex(stream), number), Located("unknown")
    try:
        with closing(open_store(config, home, read_only=True)) as inbox:
            found = _in_inbox(inbox, tk, standing, wanted)
    except NothingThere:
        pass
    for event in () if found.state == "stored" else ledger.newest_data(tk, standing.data_block):
        for index, encoded in reversed([*enumerate(event.chunks)]):
            header = Chunk.parse(encoded).header
            if (header.stream, header.number) == wanted:
                deep = event.block <= ledger.block_number() - config.chain.confirmations + 1
                hashes = [keccak(chunk) for chunk in event.chunks]
                proven = ledger.check_data(tk, event.first, hashes, index, encoded)
                transaction = "0x" + event.transaction.hex()
                return Located("confirmed" if deep else "written", transaction, event.block, proven)
            if header.stream == wanted[0] and header.number < number:
                return found  # what is before it in the log is before it on the chain
    return found


def _in_inbox(inbox: Inbox, tk: bytes, standing: Standing, wanted: tuple[bytes, int]) -> Located:
    """Whether it waits behind what the chain has, or is given up."""
    head = inbox.head(tk, wanted[0])
    after = inbox.find(tk, standing.tail) if standing.chunks else None
    while head is not None and head.number >= wanted[1] and (rows := inbox.rows(tk, after, PAGE)):
        if wanted in map(_place, inbox.chunks(tk, [row.position for row in rows])):
            return Located("stored")
        after = rows[-1].position
    dead = wanted in (_place(letter.chunk) for letter in inbox.dead(DEAD) if letter.tk == tk)
    return Located("dead letter" if dead else "unknown")


def _place(encoded: bytes) -> tuple[bytes, int]:
    header = Chunk.parse(encoded).header
    return header.stream, header.number


# What is asked


@contextmanager
def _asking(report: Report, what: str) -> Iterator[None]:
    """What cannot be known becomes a sentence of the report."""
    try:
        yield
    except NothingThere:
        pass
    except BridgeError as error:
        report["unknown"].append(f"{what}: {error}")


def ask_monitor(address: tuple[str, int], path: str) -> bytes:
    """What a monitor answers. OSError, HTTPException."""
    # 0.0.0.0 is where a monitor may listen; it answers on the loopback.
    host = {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(address[0], address[0])  # noqa: S104 - not bound here
    with closing(http.client.HTTPConnection(host, address[1], timeout=ANSWER_TIME)) as connection:
        connection.request("GET", path)
        return connection.getresponse().read()


def _figures(report: Report, address: tuple[str, int] | None, whose: str) -> list[Figure]:
    """What the running process says: its figures with their labels; in the report, whether it is ready."""
    from prometheus_client.parser import text_string_to_metric_families

    report["process"] = None
    if address is None:
        report["unknown"].append(f"the {whose}: its configuration has no `monitor`, so that it cannot be asked")
        return []
    try:
        conditions = jsonlib.loads(ask_monitor(address, "/readyz"))["conditions"]
        families = [*text_string_to_metric_families(ask_monitor(address, "/metrics").decode())]
        report["process"] = [name for name, holds in conditions.items() if not holds]
    except (OSError, http.client.HTTPException, ValueError, LookupError, TypeError, AttributeError) as error:
        kind = type(error).__name__
        report["unknown"].append(f"the {whose}: no answer from its monitor at port {address[1]} ({kind}); does it run?")
        return []
    samples = [sample for family in families for sample in family.samples]
    return [(sample.name.removeprefix("rosbridge_eth_"), sample.labels, sample.value) for sample in samples]


def _head(report: Report, ledger: Ledger) -> None:
    head = ledger.block()
    report["node"] = {"url": ledger.url, "block": head.number, "age_seconds": max(0.0, time.time() - head.time)}
    try:
        ledger.check()
    except ChainError as error:
        report["wrong_chain"] = str(error)
        raise


def _operator(place: OperatorHome) -> Report:
    from rosbridge_eth.ledger import Ledger
    from rosbridge_eth.registry import Registry

    config = load_server_config(place.config)
    with Registry(place.registry) as registry:
        enrolled, robots = registry.all(), registry.robots()
    report: Report = {
        "names": [
            {"role": each.role, "name": each.name, "enrolled": each.enrolled_at,
             "revoked": each.revoked_at, "account": each.account}
            for each in enrolled
        ],
        "robots": {each.name: {"account": each.account, "in_force": each.revoked_at is None}
                   for each in robots.values()},
        "operator": {"account": place.account, "eth": None}, "contract": None, "node": None, "dead": [], "unknown": [],
    }  # fmt: skip
    figures = _figures(report, config.monitor, "server")
    seen = {labels["robot"]: (at, labels["address"]) for at, labels in sorted(
        ((value, labels) for name, labels, value in figures if name == "session_seen_seconds"), key=lambda one: one[0])}
    for name, robot in report["robots"].items() if report["process"] is not None else ():
        at, address = seen.get(name, (0.0, None))
        robot |= {"connected": time.time() - at < SEEN, "address": address}
    with _asking(report, "the contract"):
        deployment = place.deployment()
        report |= {"contract": deployment.contract, "chain": deployment.chain_id}
        with _asking(report, "what waits"):
            _add_inbox(report, place, config, robots)
        with _asking(report, "the chain"), closing(
            Ledger.connect(config.chain.url, deployment, timeout=ANSWER_TIME)
        ) as ledger:
            _head(report, ledger)
            _add_standings(report, ledger, robots)
            report["operator"]["eth"] = ledger.balance(place.account) / _WEI
    return report


def _add_inbox(report: Report, place: OperatorHome, config: ServerConfig, robots: Mapping[bytes, Enrolment]) -> None:
    from rosbridge_eth.supervisor import open_store

    names = {tk: robot.name for tk, robot in robots.items()}
    with closing(open_store(config, place, read_only=True)) as inbox:
        for tk, waiting in inbox.totals().items():
            robot = report["robots"].setdefault(names.get(tk, tk.hex()), {"account": None, "in_force": False})
            oldest = None if waiting.oldest is None else max(0.0, time.time() - waiting.oldest)
            robot |= {"waiting": waiting._asdict() | {"oldest": oldest}, "hold": inbox.state(tk).hold}
        reasons = Counter((letter.tk, letter.why) for letter in inbox.dead(DEAD))
    report["dead"] = [{"robot": names.get(tk, tk.hex()), "why": why, "chunks": count}
                      for (tk, why), count in reasons.items()]  # fmt: skip


def _add_standings(report: Report, ledger: Ledger, robots: Mapping[bytes, Enrolment]) -> None:
    """What the chain has of each robot, and how long its account lasts at what it spent lately."""
    head, seconds = report["node"]["block"], 0
    before: dict[bytes, Standing] = {}
    with _asking(report, "what robots spend"):
        block = max(1, head - SPENDING_BLOCKS)
        before = dict(zip(robots, ledger.standings([*robots], block), strict=True))
        seconds = ledger.block_time(head) - ledger.block_time(block)
    for (tk, robot), now in zip(robots.items(), ledger.standings([*robots]), strict=True):
        spent = before[tk].balance - now.balance if tk in before else 0
        days = now.balance / spent * seconds / 86_400 if spent > 0 and seconds > 0 else None
        report["robots"][robot.name] |= {
            "chunks": now.chunks, "eth": now.balance / _WEI, "days_left": days, "revoked_on_chain": now.revoked
        }


def _robot(place: RobotHome) -> Report:
    from rosbridge_eth.spool import Spool

    end, config = place.bridge(), load_robot_config(place.config)
    report: Report = {
        "robot": end.robot, "server": f"{end.server_name} at {config.server or end.server_address}",
        "topics": [topic.topic for topic in config.topics], "nodes": list(config.nodes),
        "contract": end.contract, "chain": end.chain_id, "runs": False, "spool": None, "process": None, "unknown": [],
    }  # fmt: skip
    with _asking(report, "the spool"):
        log = Log(end.ledger, robot_id(end.robot))
        try:
            with closing(Spool(place.spool, log, max_bytes=1, drop=lambda chunk: chunk, read_only=True)) as spool:
                report["spool"] = spool.statistics()._asdict()
        except InUse:
            report["runs"] = True
            wanted = ("captured", "connected", "lost", "spool_bytes", "spool_chunks", "spool_dropped")
            report["figures"] = {
                " ".join([name, *(text for label, text in labels.items() if label != "robot")]): value
                for name, labels, value in _figures(report, config.monitor, "robot") if name in wanted
            }  # fmt: skip
    return report


def _reader(place: ReaderHome) -> Report:
    from rosbridge_eth.ledger import Ledger

    config = load_reader_config(place.config)
    report: Report = {"contract": config.contract, "chain": config.chain_id, "nodes": [], "unknown": []}
    for url in config.chain:
        with _asking(report, "a node"), closing(Ledger.connect(url, config, timeout=ANSWER_TIME)) as ledger:
            _head(report, ledger)
            report["nodes"].append(report.pop("node"))
    return report


# What is shown


def span(seconds: float | None) -> str:
    """A length of time in its largest fitting unit."""
    for unit, name in (86_400, "d"), (3600, "h"), (60, "m"):
        if seconds is not None and seconds >= 2 * unit:
            return f"{round(seconds / unit)}{name}"
    return "" if seconds is None else f"{round(seconds)}s"


def _block(node: Mapping[str, Any] | None) -> tuple[str, object]:
    known = node is not None and f"{node['block']}, {span(node['age_seconds'])} old, at {node['url']}"
    return "last block", known or "not known"


def _process(report: Report) -> list[tuple[str, object]]:
    failing = report["process"]
    return [] if failing is None else [("process", "NOT READY: " + ", ".join(failing) if failing else "ready")]


def _show_operator(report: Report) -> Iterator[RenderableType]:
    columns = ["robot", "state", "session", "on chain", "waiting", "oldest", "ETH", "days"]
    rows = []
    for name, robot in report["robots"].items():
        waiting, days = robot.get("waiting", {}), robot.get("days_left")
        rows.append((
            name, "in force" if robot["in_force"] else "revoked",
            {None: "?", False: "no"}.get(robot.get("connected"), robot.get("address")), robot.get("chunks", "?"),
            waiting.get("chunks", "?"), span(waiting.get("oldest")),
            f"{robot['eth']:.4f}" if "eth" in robot else "?", "" if days is None else f"{days:.1f}",
        ))  # fmt: skip
    yield table("Robots: session from where, chunks on the chain and waiting for it", columns, rows, right=range(3, 8))
    eth, contract = report["operator"]["eth"], report["contract"]
    others = [f"{each['role']} {each['name']}" for each in report["names"]
              if each["role"] != Role.ROBOT and each["revoked"] is None]  # fmt: skip
    yield table("Server", ["what", "value"], [
        ("contract", f"{contract} on chain {report['chain']}" if contract else "none yet; run `deploy`"),
        _block(report["node"]), ("treasury", "not known" if eth is None else f"{eth:.4f} ETH"),
        ("also in force", ", ".join(others)), *_process(report),
        *(("dead letters", f"{each['chunks']} chunks of {each['robot']}: {each['why']}") for each in report["dead"]),
    ])  # fmt: skip
    for name, robot in report["robots"].items():
        if robot.get("hold"):
            yield f"On hold, {name}: {robot['hold']}."
    for name, each in {"operator": report["operator"], **report["robots"]}.items():
        if each["account"]:
            yield f"{each['account']}  {name}"  # whole lines, to be copied


def _show_robot(report: Report) -> Iterator[RenderableType]:
    kept = "in use by the robot" if report["runs"] else "nothing yet"
    if spool := report["spool"]:
        kept = f"{spool['chunks']} chunks, {spool['bytes'] >> 10} KiB; the server lacks {spool['unstored']} of them"
        kept += f" and refused {spool['aside']}" if spool["aside"] else ""
    yield table(f"Robot {report['robot']}", ["what", "value"], [
        ("server", report["server"]), ("topics, nodes", ", ".join([*report["topics"], *report["nodes"]])),
        ("contract", f"{report['contract']} on chain {report['chain']}"), ("runs", "yes" if report["runs"] else "no"),
        ("spool", kept), *_process(report),
        *((name.replace("_", " "), f"{value:.0f}") for name, value in report.get("figures", {}).items()),
    ])  # fmt: skip


def _show_reader(report: Report) -> Iterator[RenderableType]:
    contract = ("contract", f"{report['contract']} on chain {report['chain']}")
    yield table("Reader", ["what", "value"], [contract, *map(_block, report["nodes"] or [None])])


def _look(path: Path) -> tuple[Report, list[RenderableType]]:
    """The report on a home, and how it is shown."""
    kind = kind_of(path)
    match kind:
        case HomeKind.OPERATOR:
            shown = _show_operator(report := _operator(OperatorHome(path)))
        case HomeKind.ROBOT:
            shown = _show_robot(report := _robot(RobotHome(path)))
        case HomeKind.READER:
            shown = _show_reader(report := _reader(ReaderHome(path)))
    return {"kind": kind, **report}, [Text(each) if isinstance(each, str) else each for each in shown]


def add_commands(app: typer.Typer) -> None:
    app.command(epilog="Example: rosbridge-eth status --home robot")(status)


def status(
    home: AnyHomeOption = OPERATOR_HOME,
    follow: Annotated[bool, typer.Option("--follow", help="Look again every two seconds, until Ctrl-C.")] = False,
    json: Json = False,
) -> None:
    """What is where: robots, what waits and why, dead letters, balances, the last block. Of any home.

    What cannot be known, because node, store or server do not answer, is said. Exits with 7 where the node is on
    another chain than the contract.
    """
    from rich.live import Live

    report, shown = _look(home)
    if follow and not json:
        with Live(console=data, auto_refresh=False) as live:
            while True:
                live.update(Group(*shown, *map(Text, report["unknown"])), refresh=True)
                time.sleep(FOLLOW_EVERY)
                report, shown = _look(home)
    if json:
        print_json(report)
    else:
        for each in shown:
            data.print(each, soft_wrap=isinstance(each, Text))
        for line in report["unknown"]:
            talk(line)
    if "wrong_chain" in report:
        raise ChainError(report["wrong_chain"])

"""`status`: what is where, by a home: who is enrolled, connected, waiting or on hold, and what the chain has.

It asks registry, store, node and the figures of the running server or robot. Where one of them does not answer, the
rest is shown, and `unknown` says what is missing; `alarms` is what somebody has to see to. Both are (what, sentence),
which `doctor` tells, too. Nothing is changed or made.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer
from rich.console import Group, RenderableType
from rich.text import Text

from rosbridge_eth.config import ServerConfig, load_robot_config, load_server_config
from rosbridge_eth.config.home import HomeKind, OperatorHome, RobotHome, kind_of, shard_of
from rosbridge_eth.config.values import counted
from rosbridge_eth.errors import BridgeError, ChainError, ConfigError, IdentityError
from rosbridge_eth.identity import Role
from rosbridge_eth.log.chunk import Chunk, Log, robot_id
from rosbridge_eth.log.database import InUse, NothingThere
from rosbridge_eth.log.hop import FORKED
from rosbridge_eth.operator.registry import Enrolment, Registry, differences
from rosbridge_eth.robot.spool import Spool
from rosbridge_eth.terminal import OPERATOR_HOME, AnyHomeOption, Json, data, plain, print_json, table, talk

if TYPE_CHECKING:
    from rosbridge_eth.ledger import Ledger
    from rosbridge_eth.server.metrics import Figure

_WEI: Final = 10**18
ANSWER_TIME = 5.0  # seconds for a node or a monitor
SEEN = 15.0  # seconds since a worker last saw the session
DEAD = 1000  # dead letters; the store keeps no more
Report = dict[str, Any]
TOO_OLD = 120.0  # seconds that a chunk waits to be confirmed, before it is an alarm
FORKED_FOR = 600.0  # seconds for which it is told that a log went on in two places
_SILENT = "what uses the spool shows no figures: what is captured, and whether there is a session, is not known"
NO_SERVER = ("server", "it does not run here: who is connected, rates and gas are not known")
_OF_ROBOT = {"records_per_second": "rate", "newest_chunk_seconds": "newest", "gas": "gas", "chain_chunks": "chunks",
             "chain_block": "block", "on_hold": "hold", "waiting_chunks": "chunks", "waiting_seconds": "oldest"}
"""The server's figures of a robot, and what they are called here."""


@contextmanager
def _asking(report: Report, what: str) -> Iterator[None]:
    """What cannot be known becomes a sentence of the report."""
    try:
        yield
    except NothingThere:
        pass
    except BridgeError as error:
        report["unknown"].append((what, str(error)))


def _running(report: Report, home: Path) -> list[Figure]:
    """What the processes of this home show; in the report, those that were killed and the conditions that do not hold,
    and None without a process."""
    from rosbridge_eth.server import metrics

    found = metrics.running(home)
    report["process"] = [
        failing for process, figures in found.items()
        for failing in ([f"{process} runs"] if figures is None else metrics.failing(figures))
    ] if found else None  # fmt: skip
    report["alarms"] += [("not ready", f"{failing}: no") for failing in report["process"] or ()]
    return [figure for figures in found.values() for figure in figures or ()]


def _add_figures(report: Report, figures: Collection[Figure]) -> None:
    """What the server shows of each robot."""
    now = time.time()
    for robot in report["robots"].values() if figures else ():
        robot |= {"connected": False, "address": None}
    for name, labels, value in sorted(figures, key=lambda figure: figure[2]):
        if (robot := report["robots"].get(labels.get("robot"))) is None:
            continue
        if name == "forked_seconds":
            robot["forked"] = now - value < FORKED_FOR
        elif name == "session_seen_seconds" and now - value < SEEN:
            robot |= {"connected": True, "address": labels["address"]}
        elif name in _OF_ROBOT:
            of = robot.setdefault("waiting", {}) if name.startswith("waiting_") else robot
            of[_OF_ROBOT[name]] = max(0.0, now - value) if name == "newest_chunk_seconds" else value


def of_operator(place: OperatorHome, name: str | None = None) -> Report:
    """name: of the only robot that is looked at, and how far its log is on the chain."""
    from rosbridge_eth.ledger import Ledger

    config = load_server_config(place.config)
    with Registry(place.registry) as registry:
        enrolled, robots = registry.all(), registry.robots()
    if name is not None:
        if (tk := robot_id(name)) not in robots:
            raise IdentityError(f"no robot {name!r} is enrolled; `status` lists the names")
        robots = {tk: robots[tk]}
    report: Report = {
        "names": [
            {"role": each.role, "name": each.name, "enrolled": each.enrolled_at,
             "revoked": each.revoked_at, "account": each.account}
            for each in enrolled
        ],
        "robots": {each.name: {"account": each.account, "in_force": each.revoked_at is None}
                   for each in robots.values()},
        "operator": {"account": place.account, "eth": None}, "contract": None, "node": None,
        "dead": [], "alarms": [], "unknown": [],
    }  # fmt: skip
    _add_figures(report, _running(report, place.path))
    if report["process"] is None:
        report["unknown"].append(NO_SERVER)
    with _asking(report, "contract"):
        deployment = place.deployment()
        report |= {"contract": deployment.contract, "chain": deployment.chain_id}
        with _asking(report, "store"):
            _add_inbox(report, place, config, robots)
        with _asking(report, "node"), closing(
            Ledger.connect(config.chain.url, deployment, timeout=ANSWER_TIME)
        ) as ledger:
            head = ledger.block()
            report["node"] = {"url": ledger.url, "block": head.number, "age_seconds": time.time() - head.time}
            try:
                ledger.check()
            except ChainError as error:
                report["wrong_chain"] = str(error)
                raise
            _add_standings(report, ledger, enrolled, robots)
            _add_account(report, ledger, config.funds.by)
            if name is not None:
                report["robots"][name]["log"] = _log(ledger, tk, head.number - config.chain.confirmations + 1)
    _add_alarms(report)
    return report


def fleet(place: OperatorHome) -> RenderableType:
    """The picture of a running server at its terminal, from its own figures alone."""
    report: Report = {"robots": {}, "dead": [], "alarms": []}
    try:
        with Registry(place.registry) as registry:
            report["robots"] = {robot.name: {"in_force": True} for robot in registry.robots().values()
                                if robot.revoked_at is None}  # fmt: skip
    except BridgeError as error:  # of a file that is changed at this moment
        return plain(str(error))
    _add_figures(report, _running(report, place.path))
    _add_alarms(report)
    return Group(_robots(report), *map(plain, _alarms(report)))


def _add_inbox(report: Report, place: OperatorHome, config: ServerConfig, robots: Mapping[bytes, Enrolment]) -> None:
    from rosbridge_eth.server.shard import open_store

    names, reasons = {tk: robot.name for tk, robot in robots.items()}, Counter[tuple[bytes, str]]()
    for shard in range(config.shards):
        with suppress(NothingThere), closing(open_store(config, place, shard, read_only=True)) as store:
            for tk in (each for each in store.sizes() if shard_of(each, config.shards) == shard):
                waiting, [state] = store.waiting(tk), store.states([tk])
                robot = report["robots"].setdefault(names.get(tk, tk.hex()), {"account": None, "in_force": False})
                oldest = None if waiting.oldest is None else max(0.0, time.time() - waiting.oldest)
                hold = state.hold if waiting.chunks or robot["in_force"] else ""
                robot |= {"waiting": waiting._asdict() | {"oldest": oldest}, "hold": hold}
            reasons.update((letter.tk, letter.why) for letter in store.dead(DEAD)
                           if shard_of(letter.tk, config.shards) == shard)
            store.check()
    report["dead"] = [{"robot": names.get(tk, tk.hex()), "why": why, "chunks": count}
                      for (tk, why), count in reasons.items()]  # fmt: skip


def _add_standings(
    report: Report, ledger: Ledger, enrolled: Sequence[Enrolment], robots: Mapping[bytes, Enrolment]
) -> None:
    """What the chain has of each robot, and what it says otherwise than the registry."""
    standings = dict(zip(robots, ledger.standings([*robots]), strict=True))
    report["alarms"] += differences(enrolled, standings).items()
    for tk, now in standings.items():
        report["robots"][robots[tk].name] |= {
            "chunks": now.chunks, "block": now.data_block, "eth": now.balance / _WEI,
            "revoked_on_chain": now.revoked, "in_force": robots[tk].revoked_at is None and not now.revoked,
        }  # fmt: skip


def _add_account(report: Report, ledger: Ledger, top_up: float) -> None:
    """Whether the operator's account is the contract's, and can pay the next top-up."""
    account = report["operator"]["account"]
    eth = report["operator"]["eth"] = ledger.balance(account) / _WEI
    if (operator := ledger.operator()) != account:
        report["alarms"].append((
            "operator", f"the contract's is {operator}, this home's {account}: use the home of that account, or let it"
            " offer the contract, and take it over (`handover`)"))  # fmt: skip
    if eth < top_up:
        report["alarms"].append((
            "treasury", f"{account} has {eth:.4f} ETH, and a top-up takes {top_up:g}: send ETH to it"))  # fmt: skip


def _log(ledger: Ledger, tk: bytes, confirmed: int) -> dict[str, Report | None]:
    """The last chunk of the robot's log that the chain has, and the last one up to the block `confirmed`."""
    [standing] = ledger.standings([tk])
    log: dict[str, Report | None] = {"written": None, "confirmed": None}
    for event in ledger.newest_data(tk, standing.data_block):
        header = Chunk.parse(event.chunks[-1]).header
        place = {"stream": header.stream.hex(), "number": header.number, "block": event.block,
                 "transaction": "0x" + event.transaction.hex()}  # fmt: skip
        log["written"] = log["written"] or place
        if event.block <= confirmed:
            return log | {"confirmed": place}
    return log


def _add_alarms(report: Report) -> None:
    """What somebody has to see to about robots."""
    for name, robot in report["robots"].items():
        if hold := robot.get("hold"):
            why = f"it is on hold: {hold}" if isinstance(hold, str) else "it is on hold; `status` says why"
            report["alarms"].append((name, why))
        if robot.get("forked"):
            report["alarms"].append((name, FORKED))
        if (oldest := robot.get("waiting", {}).get("oldest") or 0) > TOO_OLD:
            report["alarms"].append((name, f"a chunk has waited {span(oldest)} to be confirmed"))


def _alarms(report: Report) -> list[str]:
    """As they are shown: dead letters, too, for which `doctor` knows no fix."""
    dead = [(each["robot"], f"dead letters, {counted(each['chunks'], 'chunk')}: {each['why']}")
            for each in report.get("dead", ())]  # fmt: skip
    return [f"ALARM: {what}: {said}" for what, said in [*report["alarms"], *dead]]


def of_robot(place: RobotHome) -> Report:
    end, config = place.bridge(), load_robot_config(place.config)
    report: Report = {
        "robot": end.robot, "server": f"{end.server_name} at {config.server or end.addresses()[0]}",
        "topics": [topic.topic for topic in config.topics], "nodes": list(config.nodes),
        "contract": end.contract, "chain": end.chain_id, "runs": False, "spool": None, "process": None, "alarms": [],
        "unknown": [],
    }  # fmt: skip
    with _asking(report, "spool"):
        log = Log(end.ledger, robot_id(end.robot))
        try:
            with closing(Spool(place.spool, log, max_bytes=1, drop=lambda chunk: chunk, read_only=True)) as spool:
                report["spool"] = spool.statistics()._asdict()
        except InUse:
            report["runs"] = True
            running = _running(report, place.path)
            if not running:
                report["unknown"].append(("robot", _SILENT))
            report["alarms"] += [("log", FORKED) for name, _, value in running
                                 if name == "forked_seconds" and time.time() - value < FORKED_FOR]  # fmt: skip
            report["figures"], report["records"] = _of_robot(running), _by_topic(running)
    return report


def _of_robot(running: Iterable[Figure]) -> dict[str, float]:
    wanted = ("captured", "connected", "lost", "spool_bytes", "spool_chunks", "spool_dropped", "trigger_fired",
              "trigger_records")  # fmt: skip
    return {" ".join([name, *(text for label, text in labels.items() if label != "robot")]): value
            for name, labels, value in running if name in wanted}  # fmt: skip


def _by_topic(running: Iterable[Figure]) -> dict[str, dict[str, float]]:
    """Topic to the states of its records, and how many are in each."""
    found: dict[str, dict[str, float]] = {}
    for name, labels, value in running:
        if name == "records":
            found.setdefault(labels["topic"], {})[labels["state"]] = value
    return found


def robot_picture(name: str, session: str, running: Sequence[Figure]) -> RenderableType:
    """The picture of a running robot at its terminal, from its own figures."""
    rows = [("session", session), *_rows(_of_robot(running))]
    return Group(_records(_by_topic(running)), table(name, ["what", "value"], rows))


def _rows(figures: Mapping[str, float]) -> Iterator[tuple[str, str]]:
    return ((name.replace("_", " "), f"{value:,.0f}") for name, value in figures.items())


# What is shown


def span(seconds: float | None) -> str:
    """A length of time in its largest fitting unit."""
    for unit, name in (86_400, "d"), (3600, "h"), (60, "m"):
        if seconds is not None and seconds >= 2 * unit:
            return f"{round(seconds / unit)}{name}"
    return "" if seconds is None else f"{round(seconds)}s"


def _process(report: Report) -> list[tuple[str, object]]:
    failing = report["process"]
    return [] if failing is None else [("process", "NOT READY: " + ", ".join(failing) if failing else "ready")]


def _robots(report: Report) -> RenderableType:
    columns, rows = ["robot", "session", "newest", "rec/s", "waiting", "on chain", "Mgas", "ETH"], []
    for name, robot in report["robots"].items():
        waiting, session = robot.get("waiting", {}), {None: "?", False: "no", True: "yes"}[robot.get("connected")]
        oldest = f" ({span(waiting['oldest'])})" if waiting.get("oldest") else ""
        rows.append((
            name, session if robot["in_force"] else "revoked", span(robot.get("newest")),
            _figure(robot, "rate", ".1f"), _figure(waiting, "chunks", ".0f") + oldest,
            _figure(robot, "chunks", ".0f"), f"{robot['gas'] / 1e6:.1f}" if "gas" in robot else "?",
            _figure(robot, "eth", ".4f"),
        ))  # fmt: skip
    return table("Robots: chunks that wait (how long) and that are on the chain", columns, rows, right=range(1, 8))


def _records(topics: Mapping[str, Mapping[str, float]]) -> RenderableType:
    states = ["captured", "sealed", "waiting", "confirmed"]
    rows = [(topic, *(_figure(topics[topic], state, ",.0f") for state in states)) for topic in sorted(topics)]
    return table("Records, and of those sealed in chunks what waits for the chain", ["topic", *states], rows,
                 right=range(1, 5))  # fmt: skip


def _figure(of: Mapping[str, Any], key: str, form: str) -> str:
    """A number, or a question mark where it is not known."""
    return format(of[key], form) if key in of else "?"


def _show_operator(report: Report) -> Iterator[RenderableType]:
    yield _robots(report)
    eth, node = report["operator"]["eth"], report["node"]
    head = f"{node['block']}, {span(max(0.0, node['age_seconds']))} old, at {node['url']}" if node else "not known"
    others = [f"{each['role']} {each['name']}" for each in report["names"]
              if each["role"] != Role.ROBOT and each["revoked"] is None]  # fmt: skip
    yield table("Server", ["what", "value"], [
        ("contract", report["contract"] or "none yet; run `deploy`"), ("chain", report.get("chain", "")),
        ("last block", head), ("treasury", "not known" if eth is None else f"{eth:.4f} ETH"),
        ("also in force", ", ".join(others)), *_process(report),
    ])  # fmt: skip
    for name, robot in report["robots"].items():
        for state, place in robot.get("log", {}).items():
            yield f"{name}: {state} " + ("is nothing" if place is None else (
                f"up to chunk {place['number']} of stream {place['stream']}, in block {place['block']},"
                f" transaction {place['transaction']}"
            ))  # fmt: skip
    yield from _alarms(report)
    for name, each in {"operator": report["operator"], **report["robots"]}.items():
        if each["account"]:
            yield f"{each['account']}  {name}"  # whole lines, to be copied
        if each.get("address"):
            yield f"{name} sends from {each['address']}"


def _show_robot(report: Report) -> Iterator[RenderableType]:
    kept = "in use by the robot" if report["runs"] else "nothing yet"
    if spool := report["spool"]:
        chunks = counted(spool["chunks"], "chunk")
        kept = f"{chunks}, {spool['bytes'] >> 10} KiB; the server lacks {spool['unstored']} of them"
        kept += f" and refused {spool['aside']}" if spool["aside"] else ""
    yield table(f"Robot {report['robot']}", ["what", "value"], [
        ("server", report["server"]), ("topics, nodes", ", ".join([*report["topics"], *report["nodes"]])),
        ("contract", report["contract"]), ("chain", report["chain"]), ("runs", "yes" if report["runs"] else "no"),
        ("spool", kept), *_process(report),
        *_rows(report.get("figures", {})),
    ])  # fmt: skip
    if "records" in report:
        yield _records(report["records"])
    yield from _alarms(report)


def _look(path: Path, robot: str | None) -> tuple[Report, list[RenderableType]]:
    """The report on a home, or on one robot of it, and how it is shown."""
    kind = kind_of(path)
    match kind:
        case HomeKind.OPERATOR:
            shown = _show_operator(report := of_operator(OperatorHome(path), robot))
        case HomeKind.ROBOT:
            if robot is not None:
                raise ConfigError(f"{path} is the home of one robot; leave its name out")
            shown = _show_robot(report := of_robot(RobotHome(path)))
        case HomeKind.READER:
            raise ConfigError(f"{path} is a reader's home, which has no status; run `doctor --home {path}`")
    return {"kind": kind, **report}, [plain(each) if isinstance(each, str) else each for each in shown]


def status(
    robot: Annotated[str | None, typer.Argument(help="This one alone, and how far its log is on the chain.")] = None,
    home: AnyHomeOption = OPERATOR_HOME, json: Json = False,
) -> None:  # fmt: skip
    """Show the state: robots, waiting chunks, balances, alarms. Of an operator's home, or a robot's.

    What cannot be known, because node, store or server do not answer, is said. Exits with 7 where the node is on
    another chain than the contract.
    """
    report, shown = _look(home, robot)
    if json:
        print_json(report)
    else:
        for each in shown:
            data.print(each, soft_wrap=isinstance(each, Text))
        for what, said in report["unknown"]:
            talk(f"{what}: {said}")
    if "wrong_chain" in report:
        raise ChainError(report["wrong_chain"])

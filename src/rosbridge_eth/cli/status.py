"""`status`: what is where, of an operator's or a robot's home; of running processes as far as they have a monitor."""

from __future__ import annotations

import http.client
import json as jsonlib
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rosbridge_eth import ledger
from rosbridge_eth.cli.options import OPERATOR_HOME, OperatorHomeOption
from rosbridge_eth.cli.output import Json, data, print_json, table, talk
from rosbridge_eth.config import load_reader_config, load_robot_config, load_server_config
from rosbridge_eth.errors import ChainError
from rosbridge_eth.home import HomeKind, OperatorHome, ReaderHome, RobotHome, kind_of
from rosbridge_eth.identity import Role
from rosbridge_eth.ledger.states import Kind
from rosbridge_eth.records import robot_id

if TYPE_CHECKING:
    from rosbridge_eth.registry import Enrolment
    from rosbridge_eth.store import Inbox

_ETH = 10**18
_ASK = 3.0  # seconds for a monitor to answer
_DEAD_SHOWN = 1000  # the inbox's dead letters are counted by reason up to here
_SHOWN = {
    "server": ("sessions", "records_total", "datagrams_received_total", "datagrams_dropped_total",
               "socket_overflows_total", "process_restarts_total"),
    "robot": ("connected", "captured_total", "sent_total", "acknowledged_total", "spool_records", "spool_bytes",
              "spool_removed_total", "datagrams_dropped_total"),
}


def add_commands(app: typer.Typer) -> None:
    app.command(epilog="Example: rosbridge-eth status --home robot")(status)


def status(
    home: OperatorHomeOption = OPERATOR_HOME,
    robot_home: Annotated[Path | None, typer.Option(help="A robot's folder; --home finds out by itself, too.")] = None,
    json: Json = False,
) -> None:
    """What is where: names, queues, ages, drops, dead letters, balances, the last block. Also of a robot's home.

    Exits with 7 where the node is on another chain than the contract; one that does not answer is only told.
    """
    place = robot_home or home
    kind = kind_of(place)
    match kind:
        case HomeKind.OPERATOR:
            report, show = _operator(OperatorHome(place)), _print_operator
        case HomeKind.ROBOT:
            report, show = _robot(RobotHome(place)), _print_robot
        case HomeKind.READER:
            report, show = _reader(ReaderHome(place)), _print_reader
    if json:
        print_json({"kind": kind, **report})
    else:
        show(report)
    if "wrong_chain" in report:
        raise ChainError(report["wrong_chain"])


def _monitor(address: tuple[str, int] | None, which: str) -> dict[str, Any] | None:
    """What the running process says, as {figure: value or {label: value}}; None where it cannot be asked."""
    from prometheus_client.parser import text_string_to_metric_families

    if address is None:
        return None
    try:
        ready, conditions = _get(address, "/readyz")
        _, figures = _get(address, "/metrics")
        verdict = jsonlib.loads(conditions)
    except (OSError, http.client.HTTPException, ValueError):
        return None
    found: dict[str, Any] = {}
    for family in text_string_to_metric_families(figures.decode()):
        for sample in family.samples:
            name = sample.name.removeprefix("rosbridge_eth_")
            if name in _SHOWN[which]:
                labels = [value for label, value in sorted(sample.labels.items()) if label != "process"]
                if name == "process_restarts_total":
                    labels = [sample.labels["process"]]
                if labels:
                    below = found.setdefault(name, {})
                    below[labels[0]] = below.get(labels[0], 0) + sample.value
                else:
                    found[name] = found.get(name, 0) + sample.value
    not_held = [f"{each['name']}: {each.get('says', '')}" for each in verdict["conditions"] if not each["ok"]]
    return {"ready": ready == http.client.OK, "not_ready": not_held, "figures": found}


def _get(address: tuple[str, int], path: str) -> tuple[int, bytes]:
    # 0.0.0.0 is where a monitor may listen; it answers on the loopback.
    host = {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(address[0], address[0])  # noqa: S104 - not bound here
    connection = http.client.HTTPConnection(host, address[1], timeout=_ASK)
    try:
        connection.request("GET", path)
        answer = connection.getresponse()
        return answer.status, answer.read()
    finally:
        connection.close()


def _monitor_rows(running: dict[str, Any] | None) -> list[tuple[str, object]]:
    if running is None:
        return [("process", "not running, or without `monitor` in its configuration")]
    rows: list[tuple[str, object]] = [("process", "ready" if running["ready"] else "NOT READY")]
    for name, value in running["figures"].items():
        label = name.removesuffix("_total").replace("_", " ")
        if isinstance(value, dict):
            shown = ", ".join(f"{number:.0f} {what}" for what, number in value.items() if number)
            rows.append((label, shown or "none"))
        else:
            rows.append((label, f"{value:.0f}"))
    return rows


# ---------------------------------------------------------------------- an operator's home


def _operator(place: OperatorHome) -> dict[str, Any]:
    from rosbridge_eth.registry import Registry
    from rosbridge_eth.server.assembly import bound_contract, open_chain, open_inbox, open_journal

    config = load_server_config(place.config)
    registry = Registry(place.registry)
    names = registry.all()
    registry.close()
    report: dict[str, Any] = {
        "names": [
            {"role": n.role, "name": n.name, "account": n.account, "enrolled": n.enrolled_at.isoformat(),
             "revoked": None if n.revoked_at is None else n.revoked_at.isoformat()}
            for n in names
        ],
        "server": _monitor(config.monitor, "server"),
    }
    if not place.deployment_file.exists():
        return report
    deployment = place.deployment()
    inbox, journal = open_inbox(config, place), open_journal(place, deployment)
    try:
        held = inbox.statistics(time.time())
        report |= {
            "contract": deployment.contract,
            "chain": deployment.chain_id,
            "inbox": {"waiting": held.waiting, "leased": held.leased, "done": held.done, "dead": held.dead,
                      "bytes": held.bytes, "oldest_seconds": held.oldest_age},
            "batches": {str(state): count for state, count in journal.counts().items()},
            "dead_letters": journal.count_dead_letters(),
            "dead": _dead(journal, inbox, names),
            "waiting_batches": _waiting(journal, names),
        }
    finally:
        inbox.close()
        journal.close()
    node = open_chain(config)
    try:
        head = node.head()
        try:
            bound_contract(node, deployment)
        except ChainError as failure:
            return report | {"wrong_chain": str(failure)}
        report["block"] = head.number
        report["block_age_seconds"] = max(0.0, time.time() - head.timestamp)
        operator = jsonlib.loads(place.accounts.read_bytes())["operator"]
        report["operator"] = operator
        accounts = [operator, *(n.account for n in names if n.account and n.revoked_at is None)]
        report["balances"] = {account: node.balance(account) / _ETH for account in accounts}
    except ChainError as failure:
        report["node"] = str(failure)
    finally:
        node.close()
    return report


def _waiting(journal: ledger.Journal, names: Sequence[Enrolment]) -> list[dict[str, Any]]:
    """The batches that are not settled, by robot, and what keeps them as far as this home knows."""
    robots = {robot_id(n.name): n.name for n in names if n.role == Role.ROBOT}
    in_force = {n.name for n in names if n.role == Role.ROBOT and n.revoked_at is None}
    counts = Counter(job.robot for job in journal.jobs() if job.kind is Kind.BATCH)
    return [
        {"robot": robots.get(tk, tk.hex()), "batches": count,
         "why": "for the chain" if robots.get(tk) in in_force else "revoked: the contract takes nothing of it"
                if tk in robots else "not in the registry"}
        for tk, count in counts.items()
    ]


def _dead(journal: ledger.Journal, inbox: Inbox, names: Sequence[Enrolment]) -> list[dict[str, Any]]:
    """What will never be written, by robot and reason; of the inbox's the first thousand."""
    robots = {robot_id(n.name): n.name for n in names if n.role == Role.ROBOT}
    counts = Counter({(tk, reason): count for tk, reason, count in journal.dead_by_reason()})
    counts.update((letter.record.id.robot, letter.reason) for letter in inbox.dead_letters(_DEAD_SHOWN))
    return [{"robot": robots.get(tk, tk.hex()), "reason": reason, "records": count}
            for (tk, reason), count in counts.items()]


def _print_operator(report: dict[str, Any]) -> None:
    balances = report.get("balances", {})
    rows = [
        (n["role"], n["name"], n["account"] or "", f"{balances[n['account']]:.4f}" if n["account"] in balances else "",
         "revoked" if n["revoked"] else "in force")
        for n in report["names"]
    ]
    if "operator" in report:
        rows.insert(0, ("operator", "", report["operator"], f"{balances[report['operator']]:.4f}", ""))
    data.print(table("Names", ["role", "name", "account", "ETH", "state"], rows, right=[3]))
    data.print(table("Server", ["what", "value"], _monitor_rows(report["server"])))
    if "contract" not in report:
        talk("No contract is deployed yet; run `deploy`.")
        return
    inbox = report["inbox"]
    oldest = "none" if inbox["oldest_seconds"] is None else f"{inbox['oldest_seconds']:.1f} s"
    block = "the node does not answer"
    if "block" in report:
        block = f"{report['block']}, {report['block_age_seconds']:.0f} s old"
    elif "wrong_chain" in report:
        block = "the node is on another chain"
    rows2 = [
        ("contract", report["contract"]),
        ("chain", report["chain"]),
        ("last block", block),
        ("inbox waiting", f"{inbox['waiting'] + inbox['leased']} (oldest {oldest}), {inbox['bytes'] / 1024:.0f} KiB"),
        ("dead letters", inbox["dead"] + report["dead_letters"]),
        *((f"of {each['robot']} dead", f"{each['records']} ({each['reason']})") for each in report["dead"]),
        *((f"batches {state}", count) for state, count in report["batches"].items()),
        *((f"of {each['robot']} wait", f"{each['batches']} batches ({each['why']})")
          for each in report["waiting_batches"]),
    ]
    data.print(table("Ledger", ["what", "value"], rows2))
    if "node" in report:
        talk(report["node"])
    _say_not_ready(report["server"])


def _say_not_ready(running: dict[str, Any] | None) -> None:
    for line in (running or {}).get("not_ready", []):
        talk(f"not ready: {line}")


# ---------------------------------------------------------------------- a robot's, a reader's


def _robot(place: RobotHome) -> dict[str, Any]:
    from rosbridge_eth.store.peek import peek_spool

    end, config = place.bridge(), load_robot_config(place.config)
    held = peek_spool(place.spool) if place.spool.exists() else None
    running = _monitor(config.monitor, "robot")
    records, size = (None, None) if held is None else (held.records, held.bytes)
    if running is not None:
        records = int(running["figures"].get("spool_records", 0))
        size = int(running["figures"].get("spool_bytes", 0))
    return {
        "robot": end.robot,
        "server": str(config.server or end.server_address),
        "contract": end.contract,
        "chain": end.chain_id,
        "topics": [topic.topic for topic in config.topics],
        "nodes": list(config.nodes),
        "runs": running is not None or (held is not None and held.in_use),
        "spool": {"records": records, "bytes": size},
        "process": running,
    }


def _print_robot(report: dict[str, Any]) -> None:
    spool = report["spool"]
    kept = "nothing yet" if not report["runs"] else "in use by the robot; set `monitor` in robot.toml to look inside"
    if spool["records"] is not None:
        kept = f"{spool['records']} records, {spool['bytes'] / 1024:.0f} KiB"
    rows: list[tuple[str, object]] = [
        ("server", report["server"]),
        ("topics, nodes", ", ".join([*report["topics"], *report["nodes"]])),
        ("contract", f"{report['contract']} on chain {report['chain']}"),
        ("runs", "yes" if report["runs"] else "no"),
        ("waiting for the server", kept),
        *(_monitor_rows(report["process"]) if report["process"] is not None else []),
    ]
    data.print(table(f"Robot {report['robot']}", ["what", "value"], rows))
    _say_not_ready(report["process"])


def _reader(place: ReaderHome) -> dict[str, Any]:
    config = load_reader_config(place.config)
    report: dict[str, Any] = {"contract": config.contract}
    node = ledger.connect(config.chain)
    try:
        report |= {"node": node.url, "chain": node.chain_id(), "block": node.head().number}
        try:
            ledger.Contract.at(node, config.contract)
        except ChainError as failure:
            report["wrong_chain"] = str(failure)
    except ChainError as failure:
        report["failure"] = str(failure)
    finally:
        node.close()
    return report


_SAID = ("failure", "wrong_chain")  # as sentences, after the table


def _print_reader(report: dict[str, Any]) -> None:
    data.print(table("Reader", ["what", "value"], [(k, v) for k, v in report.items() if k not in _SAID]))
    if "failure" in report:
        talk(report["failure"])

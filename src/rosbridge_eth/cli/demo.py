"""`demo`: the main job in one process: a bag through real UDP onto an EVM and back, every record proven and compared.

Operator, server, robot and reader are the same parts that run apart otherwise, on the embedded chain; only the
processes are threads. What comes back is compared with the bag's messages, field by field, not with what was sent.
"""

from __future__ import annotations

import random
import secrets
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from html import escape
from importlib import resources
from importlib.util import find_spec
from pathlib import Path
from socket import socket
from string import Template
from typing import Annotated, Any, NamedTuple

import typer
from rich.table import Table

from rosbridge_eth.channel.udp import server_socket
from rosbridge_eth.config import load_robot_config, load_server_config
from rosbridge_eth.config.home import OperatorHome, ReaderHome, RobotHome
from rosbridge_eth.config.values import time_text
from rosbridge_eth.errors import BridgeError, ConfigError, VerificationError
from rosbridge_eth.identity import Trust, load_ca, load_identity
from rosbridge_eth.ledger import Keyring, Ledger
from rosbridge_eth.operator import enrolment
from rosbridge_eth.operator.bundle import Request, ask_to_join, join, read_bundle
from rosbridge_eth.reading import ProvenRecord, Verdict, outputs, read_robot
from rosbridge_eth.reading.compare import Comparison, compare
from rosbridge_eth.robot.loop import Robot, open_robot
from rosbridge_eth.robot.sources import sample_bag
from rosbridge_eth.robot.topics import robot_toml
from rosbridge_eth.server.shard import Secrets, Shard, open_shard, open_store
from rosbridge_eth.terminal import data, errors, log_to_stderr, table, talk

ROBOT = "robot_1"
FUNDS = 1000 * 10**18
SETTLE = 60.0  # seconds for the last chunk to be confirmed
PICTURE = (
    '<figure><img src="trajectory.png" alt="The trajectory">'
    "<figcaption>The trajectory, drawn from the records on the chain</figcaption></figure>"
)
NO_PICTURE = "<p>With matplotlib, the trajectory is drawn here: pip install 'pysmcrypto[plot]'</p>"


class Transaction(NamedTuple):
    """A batch on the chain."""

    block: int
    chunks: int
    bytes: int
    gas: int
    hash: str


@dataclass(frozen=True, slots=True)
class DemoResult:
    """Everything the report shows. times: of each step, seconds."""

    captured: int
    chunks: int
    times: Mapping[str, float]
    transactions: tuple[Transaction, ...]
    verdict: Verdict
    records: tuple[ProvenRecord, ...]
    comparison: Comparison
    contract: str
    seconds: float

    @property
    def passed(self) -> bool:
        """Every captured record came back, proven, equal to the bag's, once, and the robot has said goodbye."""
        head, equal = self.verdict.head, self.comparison.equal
        said = self.verdict.sound and head is not None and head.goodbye and not self.comparison.differences
        return said and self.captured == equal == len(self.records) > 0


class LossySocket(socket):
    """A server's socket on a network that loses this share of the datagrams, each way."""

    def __init__(self, sock: socket, loss: float) -> None:
        super().__init__(fileno=sock.detach())
        self.setblocking(False)
        self._loss = loss

    def recvfrom(self, *arguments: Any) -> Any:
        while True:
            received = super().recvfrom(*arguments)
            if random.random() >= self._loss:  # noqa: S311 - a bad network, not a secret
                return received

    def sendto(self, *arguments: Any) -> int:
        return super().sendto(*arguments) if random.random() >= self._loss else 0  # noqa: S311


@contextmanager
def _serving(shard: Shard) -> Iterator[Callable[[], None]]:
    """The server, in threads; gives what raises its failure in this one."""
    stop = threading.Event()
    with ThreadPoolExecutor(1) as threads:
        task = threads.submit(shard.run, stop.is_set)
        try:
            yield lambda: task.result() if task.done() else None
        finally:
            stop.set()
            shard.worker.loop.wake()
    task.result()


def run_demo(
    folder: Path, bag: Path, *, topics: Sequence[str] = (f"/{ROBOT}/odom",),
    network: Callable[[socket], socket] = lambda sock: sock, on_step: Callable[[str], None] = lambda text: None,
    on_turn: Callable[[Robot], None] = lambda robot: None,
) -> DemoResult:  # fmt: skip
    """Run everything in `folder` (empty or absent), with fresh keys that are of no use afterwards.

    network: makes the server's socket that of a worse network. on_step: is told what begins. on_turn: is given the
    robot at each turn of its loop.
    """
    from rosbridge_eth.ledger.nodes import EmbeddedChain  # which imports web3

    started, times = time.monotonic(), dict[str, float]()
    home, robot_home, reader_home = (
        OperatorHome(folder / "operator"), RobotHome(folder / "robot"), ReaderHome(folder / "reader")
    )  # fmt: skip
    passphrase, password, reader_passphrase = (secrets.token_hex(16).encode() for _ in range(3))
    now = datetime.now(UTC)

    @contextmanager
    def step(name: str) -> Iterator[None]:
        on_step(name)
        began = time.perf_counter()
        yield
        times[name] = time.perf_counter() - began

    with step("keys and certificates"):
        enrolment.init_home(
            home, passphrase, reader=reader_home, reader_passphrase=reader_passphrase, now=now, listen="127.0.0.1:0",
            public="127.0.0.1:7410",
        )
        keys = Keyring.load(home.accounts, passphrase)
        ask_to_join(robot_home, ROBOT, password)
    with step("chain and contract"):
        chain = EmbeddedChain(fund={keys.operator.address: FUNDS})
        deployment = enrolment.deploy_contract(home, chain, keys)
        ledger = Ledger.connect(chain, deployment)
    config = load_server_config(home.config)
    with step("registration"):
        made = enrolment.register_robot(
            home, ROBOT, ca=load_ca(home.ca, passphrase, now), keys=keys, ledger=ledger, now=now,
            inbox=lambda: open_store(config, home, 0), request=Request.decode(robot_home.request.read_bytes()),
        )
        join(robot_home, read_bundle(made.bundle.read_bytes()))

    sock, inbox = network(server_socket(config.listen)), open_store(config, home, 0)
    shard = open_shard(config, home, Secrets(enrolment.load_server_identity(home, passphrase), keys), ledger, sock)
    # Short chunks, so that there are several.
    more = 'speed = "max"\n[log]\nperiod = "50ms"\n'
    robot_home.config.write_text(f'server = "127.0.0.1:{sock.getsockname()[1]}"\n{robot_toml(topics, str(bag))}{more}')
    robot = open_robot(robot_home, load_robot_config(robot_home.config), password)

    with _serving(shard) as check:

        def turn() -> None:
            check()
            on_turn(robot)

        with step("replay and delivery over UDP"):
            robot.run(on_turn=turn)
        turn()
        with step("last batches"):
            deadline = time.monotonic() + SETTLE
            while any(inbox.waiting(tk).chunks for tk in inbox.sizes()):
                check()
                if time.monotonic() > deadline:
                    raise BridgeError(f"not everything is in a block after {SETTLE:.0f} s; run the demo again")
                time.sleep(0.02)
    with step("fetch, open and verify"):
        reader, roots = load_identity(reader_home.path, reader_passphrase)
        reading = read_robot([ledger], ROBOT, trust=Trust(roots), reader=reader.encryption_key, now=time.time())
        records = tuple(reading.records())
        verdict = reading.verdict()
    with step("comparison with the bag"):
        comparison = compare(bag, topics, [record.content for record in records])
    transactions = [
        Transaction(event.block, len(event.chunks), sum(map(len, event.chunks)),
                    0 if (receipt := ledger.receipt(event.transaction)) is None else receipt.gas_used,
                    "0x" + event.transaction.hex())
        for event in ledger.data_events(reading.verifier.log.tk, 0, ledger.block_number())
    ]  # fmt: skip
    return DemoResult(
        robot.captured, robot.chunks, times, tuple(transactions), verdict, records, comparison, deployment.contract,
        time.monotonic() - started,
    )


def _html(table: Table) -> str:
    """A table of the terminal as one of a page."""
    kinds = [' class="number"' if column.justify == "right" else "" for column in table.columns]
    rows = zip(*([escape(str(cell)) for cell in column.cells] for column in table.columns), strict=True)
    head = "".join(f"<th{kind}>{escape(str(each.header))}" for kind, each in zip(kinds, table.columns, strict=True))
    body = "".join("<tr>" + "".join(f"<td{kind}>{cell}" for kind, cell in zip(kinds, row, strict=True)) for row in rows)
    return f"<h2>{escape(str(table.title))}</h2><div class=table><table><tr>{head}{body}</table></div>\n"


def _page(result: DemoResult, bag: str, picture: str, tables: Sequence[Table]) -> str:
    """The report. What a bag, a robot or a node wrote is escaped."""
    verdict, gas = result.verdict, sum(each.gas for each in result.transactions)
    figures = [
        (f"{result.captured:,}", "records captured"), (f"{len(result.records):,}", "records proven"),
        (f"{result.comparison.equal:,}", "equal to the bag's"),
        (f"{gas / max(1, len(result.records)):,.0f}", "gas a record"), (f"{result.seconds:.1f} s", "for all of it"),
    ]  # fmt: skip
    log = [
        ("Robot", verdict.robot), ("Verdict", "sound" if verdict.sound else "NOT SOUND"),
        ("Contract", result.contract), ("Chunks", f"{verdict.chunks}, read up to block {verdict.block}"),
    ]  # fmt: skip
    if head := verdict.head:
        log.append(("Last chunk", f"sealed at {time_text(head.sealed_ms * 10**6)} by the robot's clock"))
        end = "said goodbye: nothing is missing at the end" if head.goodbye else "not said goodbye: more may follow"
        log.append(("End", f"The robot has {end}"))
    log += [("Certificate", str(each)) for each in verdict.certificates]
    notes = "".join(f"<li>{escape(str(note))}" for note in (*verdict.findings, *result.comparison.differences))
    passed = "Every record came back, proven and equal to the bag's."
    return Template((resources.files(__package__) / "report.html").read_text("utf-8")).substitute(
        bag=escape(f"The bag {bag}, sent over UDP, written to an Ethereum contract, read back from the chain alone"),
        mood="good" if result.passed else "bad",
        verdict=passed if result.passed else "Not every record came back as it is in the bag.",
        figures="".join(f"<p><b>{number}</b>{what}</p>" for number, what in figures), picture=picture,
        log="".join(f"<dt>{name}<dd>{escape(value)}" for name, value in log),
        notes=f"<h2>Notes</h2><ul>{notes}</ul>" if notes else "", tables="".join(map(_html, tables)),
    )  # fmt: skip


# The command


def demo(
    report: Annotated[Path, typer.Option(help="Folder for the report; made if absent.")] = Path("demo-report"),
    bag: Annotated[Path | None, typer.Option(help="A bag of your own; without it, the sample.")] = None,
    topic: Annotated[list[str] | None, typer.Option(help="Topics to take; without it, /robot_1/odom.")] = None,
    loss: Annotated[float, typer.Option(
        min=0, max=0.9, help="Lose this share of the datagrams.")] = 0.0,
) -> None:
    """See it work: a bag goes onto a chain and back, proven and compared.

    In one process, over real UDP, on a chain that ends with it.

    Exits with 9 if a single record is missing, altered or doubled.
    """
    log_to_stderr()
    try:  # what cannot be written is told now, not after all the work
        report.mkdir(parents=True, exist_ok=True)
        (report / "report.html").touch()
    except OSError as error:
        raise ConfigError(f"{report} cannot be written: {error.strerror}; choose another --report") from error
    chosen, topics = bag or sample_bag(), topic or [f"/{ROBOT}/odom"]
    with tempfile.TemporaryDirectory(prefix="rosbridge-eth-") as home, errors.status("") as progress:

        def show(robot: Robot) -> None:
            progress.update(f"{robot.captured} records captured, {robot.sender.confirmed} chunks on the chain")

        result = run_demo(
            Path(home), chosen, topics=topics, network=lambda sock: LossySocket(sock, loss),
            on_step=lambda text: errors.print(f"· {text}"), on_turn=show,
        )
    (report / "records.jsonl").write_text("".join(map(outputs.json_line, result.records)), encoding="utf-8")
    picture = NO_PICTURE
    if find_spec("matplotlib"):
        trajectory = outputs.Trajectory()
        for record in result.records:
            trajectory.write(record)
        picture = PICTURE if trajectory.draw(report / "trajectory.png") else ""
    counts = [("records captured", result.captured), ("chunks of the robot's log", result.chunks),
              ("records equal to the bag's", result.comparison.equal)]  # fmt: skip
    times = [(name, f"{seconds * 1000:.0f} ms") for name, seconds in result.times.items()]
    heads = ("block", "chunks", "bytes", "gas", "gas/record", "transaction")
    share = len(result.records) / max(1, sum(each.bytes for each in result.transactions))  # records a byte
    batches = [
        (each.block, each.chunks, each.bytes, each.gas, f"{each.gas / max(1.0, each.bytes * share):.0f}", each.hash)
        for each in result.transactions
    ]
    said = [*result.verdict.lines(), *result.comparison.differences]
    tables = [
        table("Records", ["what", "number"], counts, right=[1]),
        table("Time", ["step", "time"], times, right=[1]),
        table(f"Transactions to {result.contract}", heads, batches, right=[0, 1, 2, 3, 4]),
    ]
    (report / "report.html").write_text(_page(result, chosen.name, picture, tables[1:]), encoding="utf-8")
    data.print(*tables)
    for line in said:
        talk(line)
    if not result.passed:
        raise VerificationError("not every record came back as it is in the bag; the lines above say which")
    talk(f"{result.comparison.equal} of {result.captured} records came back from the chain, proven and equal to the"
         f" bag's, in {result.seconds:.1f} s. The report is {report / 'report.html'}.")

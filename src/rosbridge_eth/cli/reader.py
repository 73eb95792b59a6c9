"""`read` and `compare`: what a robot wrote, proven, from the chain alone; `evidence`, `verify` and `grant`: what a
reader hands to others, and how they check it."""

from __future__ import annotations

import re
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import asdict
from datetime import UTC, datetime
from itertools import islice
from pathlib import Path
from typing import Annotated, Any, TypeAlias

import typer

from rosbridge_eth.config import load_reader_config
from rosbridge_eth.config.home import ReaderHome
from rosbridge_eth.config.passphrases import read_passphrase
from rosbridge_eth.config.values import Address, counted, parse_address, parse_time
from rosbridge_eth.errors import ChainError, ConfigError, IdentityError, VerificationError
from rosbridge_eth.files import write_atomically
from rosbridge_eth.identity import Role, Trust, load_identity, public_identity, read_certificates
from rosbridge_eth.ledger import Ledger
from rosbridge_eth.reading import Bookmarks, Choice, ProvenRecord, Reading, Verdict, outputs, read_robot
from rosbridge_eth.reading import compare as comparing
from rosbridge_eth.reading import evidence as proofs
from rosbridge_eth.reading import grant as granting
from rosbridge_eth.reading.follow import EVERY, Followed, Following
from rosbridge_eth.reading.live import OWN_NAMES, Page, View
from rosbridge_eth.reading.verdict import shown
from rosbridge_eth.terminal import READER_HOME, Json, PassphraseFile, ReaderHomeOption, print_json, read_given, talk

DAY_NS = 86_400 * 10**9

RobotName: TypeAlias = Annotated[str, typer.Argument(help="The robot's name.")]
Topic: TypeAlias = Annotated[str | None, typer.Option(help="Only this topic.")]
From: TypeAlias = Annotated[str | None, typer.Option(
    "--from", help="Only what was received from this time on; a date begins at midnight, UTC.")]
To: TypeAlias = Annotated[str | None, typer.Option(
    help="Only what was received before this time; with a date, to the end of that day.")]
At: TypeAlias = Annotated[str | None, typer.Option(help="Only the last record of each topic up to this moment.")]
Nodes: TypeAlias = Annotated[list[str] | None, typer.Option(
    "--node", help="Ask these nodes, not those of reader.toml.")]
Confirmations: TypeAlias = Annotated[int, typer.Option(
    min=1, max=100_000, help="Read up to the block that has this many confirmations, itself counted.")]
Confirm: TypeAlias = Annotated[bool, typer.Option(
    "--confirm", help="I compared the fingerprints of new certificates; they are right.")]


def _time(text: str | None, *, end: bool = False) -> int | None:
    """A time; a date is its first moment in UTC, or with `end` the first one after it."""
    try:
        if text is not None and re.fullmatch(r"\d{4}-\d\d-\d\d", text, re.ASCII):
            return parse_time(f"{text}T00:00:00Z") + DAY_NS * end
        return None if text is None else parse_time(text)
    except ValueError as error:
        raise typer.BadParameter(f"{text!r}: write a time such as 2026-11-21T10:00:00Z, or a date") from error


def _choice_of(topic: str | None, from_: str | None, to: str | None, at: str | None) -> Choice:
    choice = Choice(topic, _time(from_), _time(to, end=True), _time(at))
    if choice.at_ns is not None and (choice.from_ns is not None or choice.to_ns is not None):
        raise typer.BadParameter("give --at, or --from and --to, not both", param_hint="--at")
    if choice.from_ns is not None and choice.to_ns is not None and choice.from_ns >= choice.to_ns:
        raise typer.BadParameter(f"{from_} is not before --to {to}", param_hint="--from")
    return choice


def _address(text: str | None) -> Address | None:
    try:
        return None if text is None else parse_address(text if ":" in text else f"127.0.0.1:{text}")
    except ValueError as error:
        raise typer.BadParameter(f"{text!r}: write a port, or HOST:PORT", param_hint="--serve") from error


def read(
    robot: Annotated[list[str], typer.Argument(metavar="ROBOT", help="The robot's name; several with --serve.")],
    home: ReaderHomeOption = READER_HOME, topic: Topic = None, from_: From = None, to: To = None, at: At = None,
    bag: Annotated[Path | None, typer.Option(help="Write NAME.bag (ROS 1), NAME.mcap, NAME.db3 or a folder.")] = None,
    table: Annotated[Path | None, typer.Option(help="Write NAME.csv or NAME.parquet.")] = None,
    plot: Annotated[Path | None, typer.Option(help="Draw the trajectory: .png, .svg or .pdf.")] = None,
    field: Annotated[list[str] | None, typer.Option(
        help="Draw this field over time instead, such as pose.pose.position.x.")] = None,
    follow: Annotated[bool, typer.Option("--follow", help="Go on as blocks come, until Ctrl-C.")] = False,
    serve: Annotated[str | None, typer.Option(
        metavar="[HOST:]PORT", help="With --follow: show it on a page, on this machine.")] = None,
    node: Nodes = None, confirmations: Confirmations = 1, confirm: Confirm = False,
    passphrase_file: PassphraseFile = None, json: Json = False,
) -> None:  # fmt: skip
    """Read a robot's records from the chain, verified. As JSON lines, bag, table or plot.

    What is proven is kept in the reader's home, sealed, so the next time only what is new is asked for. Exits with 9
    where what the chain has is not what the robot wrote, or not all of it, and with 4 where every record of it is
    sealed for others. With --follow, an .mcap file grows; others are there at the end.
    """
    choice, robot = _choice_of(topic, from_, to, at), [*dict.fromkeys(robot)]
    if field and plot is None:
        raise typer.BadParameter("name the picture with --plot", param_hint="--field")
    address = _address(serve)
    if address is not None and not follow:
        raise typer.BadParameter("--serve needs --follow", param_hint="--serve")
    if follow and choice.at_ns is not None:
        raise typer.BadParameter("give --at or --follow, not both", param_hint="--follow")
    if follow and bag is not None and bag.suffix != ".mcap":
        raise typer.BadParameter(f"only an .mcap file can be read while it grows, not {bag}", param_hint="--bag")
    if len(robot) > 1 and (address is None or bag or table or plot):
        raise typer.BadParameter("several robots need --serve, and no --bag, --table or --plot", param_hint="ROBOT")
    for path, check in ((bag, outputs.check_bag), (table, outputs.check_table), (plot, outputs.check_picture)):
        if path is not None:
            check(path)
    picture = outputs.Curves(field) if field else outputs.Trajectory()
    chosen = dict.fromkeys(robot, 0)
    with closing(_Reader(home, node, confirmations, confirm, passphrase_file)) as reader, ExitStack() as stack:
        files = ExitStack()  # which is left first: what it holds is whole before the verdict is said
        turns: list[Callable[[], object]] = [sys.stdout.flush]
        records: Iterator[tuple[str, ProvenRecord]]
        if follow:
            records, said = stack.enter_context(_following(reader, robot, choice, address, turns))
        else:
            [name] = robot
            reading, of_it = stack.enter_context(reader.reading(name))
            records, said = ((name, record) for record in reading.records(choice)), {name: of_it}
        stack.enter_context(files)
        made = None if bag is None else files.enter_context(outputs.bag(bag, grows=follow))
        sinks: list[Callable[[ProvenRecord], object]] = [] if made is None else [made.write]
        if made is not None and follow:
            turns.append(made.flush)
        if table is not None:
            sinks.append(files.enter_context(outputs.table(table)).write)
        if plot is not None:
            sinks.append(picture.write)
        if not sinks and not json and address is None:
            sinks.append(lambda record: print(outputs.json_line(record), end=""))
        for name, record in records:
            chosen[name] += 1
            for sink in sinks:
                sink(record)
    for name, of_it in said.items():
        of_it["chosen"] = chosen[name]
        if json:
            print_json(of_it)
    if made is not None:
        talk(f"{bag}: {made.whole:,} whole messages, {made.partial:,} with fields left out, {made.as_json:,} as JSON")
    if not follow and not chosen[name]:
        _tell_topics(topic, reading)
    for name, of_it in said.items():
        reader.require_sound(name, of_it)
    if plot is not None and not picture.draw(plot):
        what = "a number there" if field else "a position"
        raise ConfigError(f"{plot} shows nothing: none of the {sum(chosen.values())} chosen records holds {what}")


def compare(
    bag: Annotated[Path, typer.Argument(help="A recording: a .bag, .mcap or .db3 file, or a ROS 2 bag's folder.")],
    robot: RobotName,
    home: ReaderHomeOption = READER_HOME,
    topic: Annotated[list[str] | None, typer.Option(help="Only these topics; each must be on the chain.")] = None,
    some: Annotated[bool, typer.Option(
        "--some", help="The robot captures only some messages: those it does not are no difference.")] = False,
    node: Nodes = None, confirmations: Confirmations = 1, confirm: Confirm = False,
    passphrase_file: PassphraseFile = None, json: Json = False,
) -> None:  # fmt: skip
    """Compare a recording with the chain. Message by message, field by field.

    Exits with 9 if a record is missing, altered or doubled, or none is there to compare.
    """
    with (
        closing(_Reader(home, node, confirmations, confirm, passphrase_file)) as reader,
        reader.reading(robot) as (reading, said),
    ):
        made = comparing.compare(bag, topic or [], (one.content for one in reading.records()), some=some)
        said |= asdict(made)
    if json:
        print_json(said)
    for line in made.differences:
        talk(line)
    if made.wrong > len(made.differences):
        talk(f"and {made.wrong - len(made.differences):,} differences more")
    if made.absent:
        talk(f"the chain has no record from the bag's time on {', '.join(made.absent)}")
    talk(f"equal to the bag's: {counted(made.equal, 'record')}; {counted(made.wrong, 'difference')}")
    reader.require_sound(robot, said)
    if made.wrong or not made.equal:
        raise VerificationError(f"what the chain has of {robot} is not what {bag} holds; see above")


def evidence(
    robot: RobotName,
    file: Annotated[Path, typer.Argument(help="The file to write; as a page that checks itself if it ends in .html.")],
    home: ReaderHomeOption = READER_HOME, topic: Topic = None, from_: From = None, to: To = None, at: At = None,
    node: Nodes = None, confirmations: Confirmations = 1, confirm: Confirm = False,
    passphrase_file: PassphraseFile = None,
) -> None:  # fmt: skip
    """Write a file that proves chosen records without key or node. It opens nothing else.

    Exits with 9, like read, where the log that they are from is not sound; the file is written nevertheless.
    """
    choice = _choice_of(topic, from_, to, at)
    if choice == _choice_of(None, None, None, None):
        raise typer.BadParameter("say which records: --topic, --at, or --from and --to", param_hint="--topic")
    if file.exists() or not file.parent.is_dir():
        raise ConfigError(f"{file} exists already, or its folder does not; name a new file")
    with (
        closing(_Reader(home, node, confirmations, confirm, passphrase_file)) as reader,
        reader.reading(robot) as (reading, said),
    ):
        records = list(islice(reading.records(choice), proofs.MAX_CHOSEN + 1))
        for _ in reading.proven:
            continue  # the verdict is on all of the log
        if not records:
            _tell_topics(topic, reading)
            raise ConfigError("no record was chosen; nothing is written")
        made = proofs.make(reading, records)
    write_atomically(file, (made.page() if file.suffix == ".html" else made.encode() + "\n").encode(), new=True)
    what = counted(len(made.records), "record")
    talk(f"{file}: {what}, for `verify {file} --ca ca.crt.pem`; who has it can read what it shows")
    reader.require_sound(robot, said)


def verify(
    file: Annotated[Path, typer.Argument(help="What `evidence` wrote, JSON or page.")],
    ca: Annotated[Path, typer.Option(help="The CA's certificate (PEM): from the operator, not from who has the file.")],
    node: Annotated[str | None, typer.Option(help="Ask this node whether the contract has it.")] = None,
    json: Json = False,
) -> None:
    """Check evidence, and say what it proves. What it shows goes to stdout as JSON lines; no node is needed.

    Exits with 9 where anything does not hold, with 7 where the node named does not answer.
    """
    data = read_given(file, proofs.MAX_FILE + 1)
    given = proofs.Evidence.read(data)
    roots = read_certificates(read_given(ca))
    found = proofs.verify(given, roots, lambda line: talk(f"holds: {line}"))
    asked = None if node is None else proofs.ask(given, found, roots, node)
    if asked is not None:
        talk(f"holds: the contract has {counted(len(given.chunks), 'chunk')} as the file says, says {asked.node}")
    if json:
        print_json(found.as_json())
    else:
        for record in found.records:
            print(outputs.json_line(record), end="")
    talk("What this proves:")
    for line in found.proves(asked):
        talk(f"- {line}")
    talk("What it does not prove:")
    for line in found.proves_not(asked):
        talk(f"- {line}")
    if data.strip().decode() not in (given.encode(), given.page().strip()):
        talk("The page differs from the one that this version writes: rely on this output, not on the page.")


def grant(
    robot: RobotName,
    from_: Annotated[str, typer.Option("--from", help="Chunks that hold a message received from this time on,")],
    to: Annotated[str, typer.Option(help="and before this time. Everything in these chunks is opened.")],
    reader: Annotated[str, typer.Option(help="For whom: that reader's public.pem, or NAME for readers/NAME.pem.")],
    out: Annotated[Path | None, typer.Option(help="The file to write; ROBOT-NAME.grant without it.")] = None,
    home: ReaderHomeOption = READER_HOME,
    node: Nodes = None, confirmations: Confirmations = 1, confirm: Confirm = False,
    passphrase_file: PassphraseFile = None,
) -> None:  # fmt: skip
    """Let somebody else read a time span of a robot's log. Nothing goes on the chain.

    They put the file into `grants/` of their own home, and `read` opens these chunks. It cannot be taken back.
    """
    choice, known = _choice_of(None, from_, to, None), ReaderHome(home).require().path / "readers" / f"{reader}.pem"
    peer = public_identity(read_given(known if known.exists() else Path(reader)))
    now = datetime.now(UTC)
    with closing(_Reader(home, node, confirmations, confirm, passphrase_file)) as own:
        peer = own.trust.check(*peer.pair, role=Role.READER, at=now)
        out = out or Path(f"{robot}-{peer.name}.grant")
        if out.exists():
            raise ConfigError(f"{out} exists already; name another with --out")
        with own.reading(robot) as (reading, said):
            keys = granting.keys_of(reading, choice)
        if not keys:
            raise ConfigError(f"this reader can open nothing of {robot} that was received in that time; see above")
        made = granting.make(
            keys, ledger=reading.verifier.log.ledger, robot=robot, begin=from_, end=to, by=own.identity, to=peer,
            now=now,
        )  # fmt: skip
    write_atomically(out, made, new=True)
    talk(f"{out} opens {counted(len(keys), 'chunk')} of {robot} for reader {peer.name}, and for nobody else.")
    talk(f"Whoever has {peer.name}'s home puts it into `grants/` there and runs: rosbridge-eth read {robot}")
    own.require_sound(robot, said)


# What the commands share


class _Reader:
    """Who reads, with what: made of a reader's home and the options that the commands share."""

    def __init__(
        self, home: Path, nodes: Sequence[str] | None, confirmations: int, confirm: bool, passphrase_file: Path | None
    ) -> None:
        self.home = ReaderHome(home).require()
        config = load_reader_config(self.home.config)
        passphrase = read_passphrase("reader", "Passphrase of the reader", file=passphrase_file)
        self.identity, roots = load_identity(self.home.path, passphrase)
        self.trust, self.confirmations, self.confirm = Trust(roots), confirmations, confirm
        self.bookmarks = Bookmarks(self.home.path / "bookmarks.json")
        self._granted = granting.open_folder(
            self.home.grants, ledger=config.ledger, reader=self.identity, trust=self.trust
        )
        self.ledgers = [Ledger.connect(url, config) for url in nodes or config.chain]

    def close(self) -> None:
        for ledger in self.ledgers:
            ledger.close()

    def begin(self, robot: str, **more: Any) -> Reading:
        """`read_robot` with all of this. more: at least `now`."""
        return read_robot(
            self.ledgers, robot, trust=self.trust, reader=self.identity.encryption_key, bookmarks=self.bookmarks,
            granted=self._granted.get(robot), memo=self.home.path / "proven", confirmations=self.confirmations, **more,
        )  # fmt: skip

    @contextmanager
    def reading(self, robot: str) -> Iterator[tuple[Reading, dict[str, Any]]]:
        """A reading, and where its verdict is when it has ended. Then the bookmark is kept and the verdict is shown."""
        said = dict[str, Any]()
        with closing(self.begin(robot, now=time.time())) as reading:
            yield reading, said
            verdict = reading.verdict()
        reading.keep(self.bookmarks, confirm=self.confirm)
        said |= _say(verdict)

    def require_sound(self, robot: str, said: dict[str, Any]) -> None:
        if not said["sound"]:
            raise VerificationError(
                f"what the chain has of {robot} is not what the robot wrote; see the findings above"
            )
        if not said["records"] and "no-grant" in said["counts"]:
            raise IdentityError(
                f"nothing of {robot} is sealed for this reader; put {self.home.public} into its `readers/`"
            )


def _say(verdict: Verdict) -> dict[str, Any]:
    """Say it; the verdict as JSON."""
    for line in verdict.lines():
        talk(line)
    return verdict.as_json()


@contextmanager
def _following(
    reader: _Reader, robots: Sequence[str], choice: Choice, address: Address | None,
    turns: Sequence[Callable[[], object]],
) -> Iterator[tuple[Iterator[tuple[str, ProvenRecord]], dict[str, dict[str, Any]]]]:  # fmt: skip
    """Records as they are proven, until SIGINT or SIGTERM; and where the verdicts are when that has ended.

    turns: called whenever all was given that there is.
    """
    said, stop = dict[str, dict[str, Any]](), threading.Event()
    followed = [Followed(name, reader.begin, reader.bookmarks, confirm=reader.confirm) for name in robots]
    following = Following(followed, reader.ledgers)
    view = View([ledger.url for ledger in reader.ledgers], reader.confirmations, robots)
    with ExitStack() as stack:
        if address is not None:
            page = Page(address, view)
            stack.callback(page.close)
            talk(f"The page is http://{page.address}/; Ctrl-C ends it.")
            if address.host not in OWN_NAMES:
                talk("It has no password: whoever reaches that address sees what this reader may read.")

        def end(number: int, frame: object) -> None:
            stop.set()
            signal.signal(number, signal.default_int_handler)  # the second one does not wait

        def records() -> Iterator[tuple[str, ProvenRecord]]:
            while not stop.is_set():
                for name, record in following.new(choice):
                    view.write(name, record)
                    yield name, record
                    if stop.is_set():
                        return
                for turn in turns:
                    turn()
                view.show(following.robots)
                for line in following.news():
                    talk(line)
                stop.wait(EVERY)

        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            stack.callback(signal.signal, number, signal.signal(number, end))
        yield records(), said
    for robot in following.robots:
        if robot.reading is None:  # as with a `read` that is interrupted
            raise ChainError(f"{robot.name}: {robot.trouble}") if robot.trouble else KeyboardInterrupt
        said[robot.name] = _say(robot.reading.verdict())


def _tell_topics(topic: str | None, reading: Reading) -> None:
    """Nothing was chosen: what there is, for who named a topic that is not there."""
    if topic is not None and topic not in reading.topics:
        there = ", ".join(shown(each) for each in sorted(reading.topics)[:20]) or "no topic"
        talk(f"nothing was read on {shown(topic)}; what was read is on: {there}")

"""`evidence`, `verify` and `grant`: what a reader hands to others, and how they check it."""

from __future__ import annotations

from datetime import UTC, datetime
from itertools import islice
from pathlib import Path
from typing import Annotated

import typer

from rosbridge_eth.cli.reader import (
    ArchiveUrl,
    At,
    Confirm,
    Confirmations,
    From,
    Nodes,
    RobotName,
    To,
    Topic,
    asking,
    choice_of,
    reading_as,
    reading_of,
    require_sound,
    tell_topics,
)  # fmt: skip
from rosbridge_eth.errors import ConfigError
from rosbridge_eth.home import ReaderHome
from rosbridge_eth.terminal import READER_HOME, Json, PassphraseFile, ReaderHomeOption, print_json, read_given, talk


def add_commands(app: typer.Typer) -> None:
    app.command(
        epilog="Example: rosbridge-eth grant robot_1 --from 2026-11-21T10:00:00Z --to 2026-11-21T10:05:00Z"
        " --reader insurer.pem"
    )(grant)
    app.command(epilog="Example: rosbridge-eth evidence robot_1 crash.html --at 2026-11-21T10:00:00Z")(evidence)
    app.command(epilog="Example: rosbridge-eth verify crash.html --ca ca.crt.pem")(verify)


def evidence(
    robot: RobotName,
    file: Annotated[Path, typer.Argument(help="The file to write; as a page that checks itself if it ends in .html.")],
    home: ReaderHomeOption = READER_HOME,
    topic: Topic = None,
    from_: From = None,
    to: To = None,
    at: At = None,
    node: Nodes = None,
    archive: ArchiveUrl = None,
    confirmations: Confirmations = 1,
    confirm: Confirm = False,
    passphrase_file: PassphraseFile = None,
) -> None:
    """Write one file that proves chosen records to somebody who has neither key nor node. It opens nothing else.

    Exits with 9, like read, where the log that they are from is not sound; the file is written nevertheless.
    """
    from rosbridge_eth.files import write_atomically
    from rosbridge_eth.reading import evidence as making

    choice = choice_of(topic, from_, to, at)
    if choice == choice_of(None, None, None, None):
        raise typer.BadParameter("say which records: --topic, --at, or --from and --to", param_hint="--topic")
    if file.exists() or not file.parent.is_dir():
        raise ConfigError(f"{file} is there already, or its folder is not; name a new file")
    place = ReaderHome(home).require()
    with reading_of(place, robot, node, archive, confirmations, confirm, passphrase_file) as (reading, said):
        records = list(islice(reading.records(choice), making.MAX_CHOSEN + 1))
        for _ in reading.chunks:
            continue  # the verdict is on all of the log
        if not records:
            tell_topics(topic, reading)
            raise ConfigError("no record was chosen; nothing is written")
        made = making.make(reading, records)
    write_atomically(file, (made.page() if file.suffix == ".html" else made.encode() + "\n").encode(), new=True)
    talk(f"{file}: {len(made.records):,} records, for `verify {file} --ca ca.crt.pem`; who has it can read them")
    require_sound(place, robot, said)


def verify(
    file: Annotated[Path, typer.Argument(help="What `evidence` wrote, JSON or page.")],
    ca: Annotated[Path, typer.Option(help="The CA's certificate (PEM): from the operator, not from who has the file.")],
    node: Annotated[str | None, typer.Option(help="Ask this node whether the blocks are its chain's.")] = None,
    json: Json = False,
) -> None:
    """Check evidence, without a node: what it shows goes to stdout as JSON lines, and what that proves is said.

    Exits with 9 where anything does not hold, with 7 where the node named does not answer.
    """
    from rosbridge_eth.identity import read_certificates
    from rosbridge_eth.reading import evidence as checking

    data = read_given(file, checking.MAX_FILE + 1)
    given = checking.Evidence.read(data)
    found = checking.verify(given, read_certificates(read_given(ca)), lambda line: talk(f"holds: {line}"))
    if node is not None:
        checking.ask(found, node)
        talk(f"holds: all {len(found.blocks)} blocks are those of the chain, says {node}")
    if json:
        print_json(found.as_json())
    else:
        for record in found.records:
            print(record.json_line(), end="")
    talk("What this proves:")
    for line in found.proves():
        talk(f"- {line}")
    talk("What it does not prove:")
    for line in found.proves_not("" if node is None else node):
        talk(f"- {line}")
    if data.strip().decode() not in (given.encode(), given.page().strip()):
        talk("The page around it is not as this version writes it: go by what stands here, and not by what it shows.")


def grant(
    robot: RobotName,
    from_: Annotated[str, typer.Option("--from", help="Chunks that hold a message received from this time on,")],
    to: Annotated[str, typer.Option(help="and before this time. Everything in these chunks is opened.")],
    reader: Annotated[str, typer.Option(help="For whom: that reader's public.pem, or NAME for readers/NAME.pem.")],
    out: Annotated[Path | None, typer.Option(help="The file to write; ROBOT-NAME.grant without it.")] = None,
    home: ReaderHomeOption = READER_HOME,
    node: Nodes = None,
    archive: ArchiveUrl = None,
    confirmations: Confirmations = 1,
    confirm: Confirm = False,
    passphrase_file: PassphraseFile = None,
) -> None:
    """Hand the keys of a span of a robot's log to somebody who is no reader of it. Nothing goes on the chain.

    They put the file into `grants/` of their own home, and `read` opens these chunks. It cannot be taken back.
    """
    from rosbridge_eth.files import write_atomically
    from rosbridge_eth.identity import Role, public_identity
    from rosbridge_eth.reading import grant as granting

    choice, place = choice_of(None, from_, to, None), ReaderHome(home).require()
    known = place.path / "readers" / f"{reader}.pem"
    peer = public_identity(read_given(known if known.exists() else Path(reader)))
    now = datetime.now(UTC)
    with asking(place, node, archive, confirmations, passphrase_file) as asked:
        certificates = peer.signing_certificate.to_der(), peer.encryption_certificate.to_der()
        peer = asked.trust.check(*certificates, role=Role.READER, at=now)
        out = out or Path(f"{robot}-{peer.name}.grant")
        if out.exists():
            raise ConfigError(f"{out} is there already; name another with --out")
        with reading_as(asked, robot, confirm) as (reading, said):
            keys = granting.keys_of(reading, choice)
        if not keys:
            raise ConfigError(f"this reader can open nothing of {robot} that was received in that time; see above")
        made = granting.make(
            keys, ledger=reading.verifier.log.ledger, robot=robot, begin=from_, end=to, by=asked.identity, to=peer,
            now=now,
        )  # fmt: skip
    write_atomically(out, made, new=True)
    chunks = f"{len(keys):,} chunk{'s' * (len(keys) > 1)}"
    talk(f"{out} opens {chunks} of {robot} for reader {peer.name}, and for nobody else.")
    talk(f"Whoever has {peer.name}'s home puts it into `grants/` there and runs: rosbridge-eth read {robot}")
    require_sound(place, robot, said)

"""The command line: parses, calls, prints. Data goes to stdout, messages to stderr.

Exit codes are those of rosbridge_eth.errors.ExitCode; a failure a person can act on is one sentence on stderr and
never a traceback.
"""

from __future__ import annotations

import os
import sqlite3
import sys
from collections.abc import Callable, Sequence
from typing import Annotated, Any, Final

import typer
from typer.core import TyperGroup

from rosbridge_eth.cli import demo, operator, reader, robot
from rosbridge_eth.errors import BridgeError, ExitCode
from rosbridge_eth.operator import doctor, status
from rosbridge_eth.robot import topics
from rosbridge_eth.terminal import talk
from smcrypto import __version__

INTERRUPTED = 130  # as shells say it of Ctrl-C; typer, too

COMMANDS: Final[dict[str, dict[str, tuple[Callable[..., None], str]]]] = {
    "All": {
        "demo": (demo.demo, "demo --report demo-report"),
        "status": (status.status, "status robot_1; rosbridge-eth status --home robot"),
        "doctor": (doctor.doctor, "doctor --home robot --passphrase-file password"),
        "backup": (operator.backup, "backup copy-of-operator"),
        "passwd": (operator.passwd, "passwd --home robot"),
    },
    "Operator": {
        "up": (operator.up, "up; rosbridge-eth up --chain http://127.0.0.1:8545"),
        "init": (operator.init, "init --chain http://127.0.0.1:8545"),
        "chain": (operator.chain, "chain --port 8545"),
        "deploy": (operator.deploy, "deploy --wait 60"),
        "register": (operator.register, "register robot_1 request.json"),
        "server": (operator.server, "server; rosbridge-eth server --shard 2"),
        "revoke": (operator.revoke, "revoke robot_1"),
        "renew": (operator.renew, "renew"),
        "reader": (operator.add_reader, "reader analyst --to analyst"),
        "mnemonic": (operator.mnemonic, "mnemonic"),
        "handover": (operator.handover, "handover 0x5aAe…; rosbridge-eth handover --home new"),
    },
    "Robot": {
        "join": (robot.join, "join --name robot_1 --source ros1 --topic /odom"),
        "topics": (topics.topics, "topics --source drive.bag"),
        "robot": (robot.robot, "robot --home robot --verbose"),
        "trigger": (robot.trigger, "trigger crash"),
    },
    "Reader": {
        "read": (reader.read, "read robot_1 --topic /robot_1/odom > records.jsonl;"
                              " rosbridge-eth read robot_1 robot_2 --follow --serve 8080"),
        "compare": (reader.compare, "compare my.bag robot_1 --topic /robot_1/odom"),
        "evidence": (reader.evidence, "evidence robot_1 crash.html --at 2026-11-21T10:00:00Z"),
        "verify": (reader.verify, "verify crash.html --ca ca.crt.pem"),
        "grant": (reader.grant, "grant robot_1 --from 2026-11-21T10:00:00Z --to 2026-11-21T10:05:00Z"
                                " --reader insurer.pem"),
    },
}  # fmt: skip
"""By who gives it: each command's name, function and an example, in the order in which they are needed."""


class _Grouped(TyperGroup):
    """Shows the commands in these groups."""

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        for title, names in COMMANDS.items():
            with formatter.section(title):
                formatter.write_dl([(name, self.commands[name].get_short_help_str(70)) for name in names])


app = typer.Typer(
    name="rosbridge-eth",
    cls=_Grouped,
    help="From the name of a ROS topic to a verified record on an Ethereum chain.\n\n"
    "Begin with `demo`; docs/walkthrough.md shows all parts in ten minutes.",
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
for _commands in COMMANDS.values():
    for _name, (_function, _example) in _commands.items():
        app.command(_name, epilog=f"Example: rosbridge-eth {_example}")(_function)


def _version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"rosbridge-eth {__version__}")
        raise typer.Exit


@app.callback()
def _options(
    shown: Annotated[bool, typer.Option("--version", callback=_version, is_eager=True, help="Print it.")] = False,
) -> None:
    """See `app`'s help."""


def run(arguments: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code."""
    try:
        try:
            app(args=None if arguments is None else list(arguments), prog_name="rosbridge-eth")
        finally:
            _flush()
    except BridgeError as error:
        talk(f"rosbridge-eth: {error}")
        return int(error.exit_code)
    except SystemExit as stop:  # how typer ends: 0, or 2 for a usage error it has explained
        if stop.code == INTERRUPTED:
            talk("rosbridge-eth: interrupted")
        return stop.code if isinstance(stop.code, int) else int(ExitCode.OK)
    except BrokenPipeError:  # `read | head`: the reader of stdout has ended
        return int(ExitCode.FAILED)
    except OSError as error:  # a file or folder given by the user that cannot be read or written, a full disk
        named = " and ".join(str(name) for name in (error.filename, error.filename2) if name is not None)
        talk(f"rosbridge-eth: {named + ': ' if named else ''}{error.strerror or error}")
        return int(ExitCode.FAILED)
    except sqlite3.Error as error:  # what the stores make no sentence of themselves: a registry on a full disk
        talk(f"rosbridge-eth: a database of this home cannot be used: {error}; check the disk and who may write there")
        return int(ExitCode.STORE)
    except KeyboardInterrupt:
        talk("rosbridge-eth: interrupted")
        return INTERRUPTED
    return int(ExitCode.OK)


def _flush() -> None:
    """What cannot be written is told now: at its end the interpreter would show an exception, and exit with 120."""
    try:
        sys.stdout.flush()
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # where the rest goes at that end
        raise

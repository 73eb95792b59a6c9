"""The command line: parses, calls, prints. Data goes to stdout, messages to stderr.

Exit codes are those of rosbridge_eth.errors.ExitCode; a failure a person can act on is one sentence on stderr and
never a traceback.
"""

from __future__ import annotations

import os
import sqlite3
import sys
from collections.abc import Sequence
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from rosbridge_eth.cli import demo, operator, reader, robot
from rosbridge_eth.errors import BridgeError, ExitCode
from rosbridge_eth.operator import doctor, status
from rosbridge_eth.robot import topics
from rosbridge_eth.terminal import talk
from smcrypto import __version__

INTERRUPTED = 130  # as shells say it of Ctrl-C; typer, too

GROUPS = {
    "All": ("demo", "status", "doctor", "backup", "passwd"),
    "Operator": ("up", "init", "chain", "deploy", "register", "server", "revoke", "renew", "reader", "mnemonic",
                 "handover"),
    "Robot": ("join", "topics", "robot", "trigger"),
    "Reader": ("read", "compare", "evidence", "verify", "grant"),
}


class _Grouped(TyperGroup):
    """Commands by who gives them, in the order in which they are needed; what is in no group comes last."""

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        named = {name for names in GROUPS.values() for name in names}
        others = tuple(name for name in self.list_commands(ctx) if name not in named)
        for title, names in (*GROUPS.items(), ("Other", others)):
            found = [(name, command) for name in names if (command := self.get_command(ctx, name)) is not None]
            if found:
                with formatter.section(title):
                    formatter.write_dl([(name, command.get_short_help_str(70)) for name, command in found])


app = typer.Typer(
    name="rosbridge-eth",
    cls=_Grouped,
    help="From the name of a ROS topic to a verified record on an Ethereum chain.\n\n"
    "Begin with `demo`; docs/walkthrough.md goes through everything else in ten minutes.",
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
for part in (demo, operator, robot, topics, reader, status, doctor):
    part.add_commands(app)


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

"""Options that several commands share."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, TypeAlias

import typer

from rosbridge_eth.operations.logs import LogFormat

OperatorHomeOption: TypeAlias = Annotated[
    Path, typer.Option("--home", help="The operator's folder.", envvar="ROSBRIDGE_ETH_HOME", show_default=True)
]
RobotHomeOption: TypeAlias = Annotated[
    Path, typer.Option("--home", help="The robot's folder.", envvar="ROSBRIDGE_ETH_ROBOT_HOME", show_default=True)
]
PassphraseFile: TypeAlias = Annotated[
    Path | None,
    typer.Option(
        "--passphrase-file",
        help="Read the operator passphrase from the first line of this file, rather than ask for it.",
    ),
]
PasswordFile: TypeAlias = Annotated[
    Path | None,
    typer.Option("--password-file", help="Read the robot's registration password from the first line of this file."),
]
Verbose: TypeAlias = Annotated[
    int,
    typer.Option("--verbose", "-v", count=True, help="Log what happens on stderr; twice (-vv): every record, by name."),
]
LogFormatOption: TypeAlias = Annotated[LogFormat, typer.Option("--log-format", help="How a line of the log looks.")]

OPERATOR_HOME = Path("operator")
ROBOT_HOME = Path("robot")

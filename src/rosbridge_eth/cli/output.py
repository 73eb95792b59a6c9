"""How the commands speak: one console for talk (stderr), one for data (stdout); logs are operations.logs'."""

from __future__ import annotations

import json
import logging
import sys
from collections.abc import Iterable, Sequence
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.table import Table

from rosbridge_eth.operations.logs import speaks_json

log = logging.getLogger(__name__)

errors = Console(stderr=True, highlight=False, soft_wrap=True)
data = Console(highlight=False)

Json = Annotated[bool, typer.Option("--json", help="Print JSON on stdout.")]


def talk(text: str) -> None:
    """A line for the person at the terminal; never parsed as markup. An event, where stderr carries JSON."""
    if speaks_json():
        log.warning("%s", text)
        return
    errors.print(text, markup=False)


def print_json(value: Any) -> None:
    """One JSON value on stdout, for programs."""
    sys.stdout.write(json.dumps(value, ensure_ascii=False) + "\n")


def table(title: str, columns: Sequence[str], rows: Iterable[Sequence[object]], *, right: Sequence[int] = ()) -> Table:
    """A table whose cells are plain text; `right` are the columns aligned to the right."""
    made = Table(title=title, title_justify="left", header_style="bold")
    for index, column in enumerate(columns):
        made.add_column(column, justify="right" if index in right else "left", overflow="fold")
    for row in rows:
        made.add_row(*(str(cell).replace("[", r"\[") for cell in row))
    return made


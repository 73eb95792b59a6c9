"""`doctor`: what works and what does not, with the mend beside it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from rosbridge_eth.cli.options import OPERATOR_HOME, OperatorHomeOption
from rosbridge_eth.cli.output import Json, data, print_json, table, talk
from rosbridge_eth.errors import BridgeError
from rosbridge_eth.home import HomeKind, kind_of
from rosbridge_eth.passphrases import credential, read_passphrase

_SIGN = {"ok": "ok", "note": "NOTE", "broken": "BROKEN", "skipped": "not tried"}
_SECRET = {HomeKind.OPERATOR: "operator", HomeKind.ROBOT: "robot", HomeKind.READER: "reader"}


def add_commands(app: typer.Typer) -> None:
    app.command(epilog="Example: rosbridge-eth doctor --home robot --passphrase-file password")(doctor)


def doctor(
    home: OperatorHomeOption = OPERATOR_HOME,
    passphrase_file: Annotated[
        Path | None,
        typer.Option(help="Passphrase of this home, to try its keys, too; for a robot, its registration password."),
    ] = None,
    json: Json = False,
) -> None:
    """Try everything this home depends on, and name the mend for what does not work. An operator's, robot's, reader's.

    Exits with 1 if something is broken.
    """
    from rosbridge_eth.doctor import Result, checks_of, examine

    kind = kind_of(home)
    name = _SECRET[kind]
    given = passphrase_file is not None or credential(name) is not None
    passphrase = read_passphrase(name, "", file=passphrase_file) if given else None
    findings = []
    for finding in examine(checks_of(home, kind, passphrase)):
        findings.append(finding)
        if not json and finding.result is not Result.OK:
            talk(f"{_SIGN[finding.result]}: {finding.what}: {finding.found}. {finding.mend}")
    counts = {result: sum(finding.result is result for finding in findings) for result in Result}
    if json:
        print_json({
            "home": str(home), "kind": kind, "broken": counts[Result.BROKEN],
            "findings": [
                {"what": f.what, "result": f.result, "found": f.found, "mend": f.mend} for f in findings
            ],
        })
    else:
        data.print(table(f"The {kind}'s home {home}", ["what", "result", "found"],
                         [(f.what, _SIGN[f.result], f.found) for f in findings]))
    if counts[Result.BROKEN]:
        raise BridgeError(f"{counts[Result.BROKEN]} things are broken; each line above names the mend")

"""A page of docs/ typed as it stands, in an empty folder: real processes, real services.

The marks are words behind a fence's language. `sh`: run, in order, in one shell; `sh MARK`: run by the test that asks
for the mark, or not, as what installs or belongs to a machine that is not here. `toml FILE` and `conf FILE`: the block
is that file; `>> FILE`: goes to its end. `text`: lines that the commands before have to print, on whichever stream;
`…` stands for anything.
Ports are replaced by free ones, so that pages run beside whatever else runs.
"""

from __future__ import annotations

import os
import re
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Mapping
from fnmatch import fnmatchcase
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
_FENCE = re.compile(r"^```(\w+)(?: +([^\n]*))?\n(.*?)^```", re.MULTILINE | re.DOTALL)
TYPED_IN = 200.0  # seconds, on a machine that is busy with other things


def script_of(page: str, marked: str = "") -> tuple[str, list[str]]:
    """The page as a shell script, and what it has to print."""
    commands, says = list[str](), list[str]()
    for language, mark, text in _FENCE.findall((ROOT / "docs" / page).read_text(encoding="utf-8")):
        if language == "sh" and mark == marked:
            commands.append(text)
        elif language == "text" and mark == marked:
            says += text.splitlines()
        elif language in ("toml", "conf") and mark:
            into = mark if mark.startswith(">>") else f"> {mark}"
            commands.append(f"cat {into} <<'END OF THE BLOCK'\n\n{text}END OF THE BLOCK\n")
    return "\n".join(commands), says


def type_page(
    page: str, folder: Path, *, ports: Mapping[str, int] | None = None, environment: Mapping[str, str] | None = None,
    before: str = "", after: str = "", marked: str = "", python: str = sys.executable,
    shell: tuple[str, ...] = ("bash",), typed: str = "",
) -> str:  # fmt: skip
    """Run a page's commands and give what they printed.

    ports: written on the page -> here. before, after: commands of the test's own. python: that runs the bridge.
    """
    commands, says = script_of(page, marked)
    for written, here in (ports or {}).items():
        commands = re.sub(rf"\b{written}\b", str(here), commands)
        says = [line.replace(written, str(here)) for line in says]
    programs = folder / ".programs"
    programs.mkdir(exist_ok=True)
    (programs / "rosbridge-eth").write_text(
        f'#!/bin/sh\nPYTHONPATH={shlex.quote(str(ROOT / "src"))} exec {shlex.quote(python)} -m rosbridge_eth "$@"\n'
    )
    (programs / "rosbridge-eth").chmod(0o755)
    kept = {name: value for name, value in os.environ.items() if not name.startswith(("ROS_", "PYTHONPATH"))}
    kept |= {"PATH": f"{programs}:{os.environ['PATH']}", "COLUMNS": "120", **(environment or {})}
    with (folder / ".printed").open("wb") as printed:
        process = subprocess.Popen(
            [*shell, "-c", f"set -euo pipefail\n{before}\n{commands}\n{after}"], cwd=folder, env=kept,
            stdin=subprocess.PIPE, stdout=printed, stderr=printed, start_new_session=True,
        )  # fmt: skip
        assert process.stdin is not None
        process.stdin.write(typed.encode())
        process.stdin.close()
        try:
            code = process.wait(TYPED_IN)
        finally:
            end_session(process.pid)
    said = (folder / ".printed").read_text(errors="replace")
    assert code == 0, f"{page} ended with {code}:\n{said[-5000:]}"
    missing = [line for line in says if not any(fnmatchcase(one, line.replace("…", "*")) for one in said.splitlines())]
    assert not missing, f"{page} did not print {missing}:\n{said[-5000:]}"
    assert "Traceback" not in said, said[-5000:]
    return said


def end_session(leader: int) -> None:
    """End what a page started in the background."""
    for number, patience in ((signal.SIGTERM, 10.0), (signal.SIGKILL, 5.0)):
        deadline = time.monotonic() + patience
        while time.monotonic() < deadline:
            try:
                os.killpg(leader, number)
            except ProcessLookupError:
                return
            time.sleep(0.1)

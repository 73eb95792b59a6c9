"""docs/walkthrough.md, executed as a reader would type it: real processes, real UDP, a real node."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "docs" / "walkthrough.md"


@pytest.mark.service
@pytest.mark.slow
def test_the_walkthrough_runs_as_it_is_written(tmp_path: Path, require: Callable[[str], str]) -> None:
    require("npx")
    commands = "\n".join(re.findall(r"^```sh\n(.*?)^```", PAGE.read_text(), re.MULTILINE | re.DOTALL))
    assert commands.count("rosbridge-eth") > 10
    script = f'set -euo pipefail\nrosbridge-eth() {{ "{sys.executable}" -m rosbridge_eth "$@"; }}\n{commands}'
    environment = {**os.environ, "PYTHONPATH": str(ROOT / "src"), "COLUMNS": "120"}
    environment.pop("ROSBRIDGE_ETH_HOME", None)
    bash = shutil.which("bash")
    assert bash
    process = subprocess.Popen(
        [bash, "-c", script], cwd=tmp_path, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        text=True, start_new_session=True,
    )
    # The commands in the background hold the pipes open, so the shell's end is waited for, not theirs.
    try:
        code = process.wait(timeout=270)
    finally:
        os.killpg(process.pid, signal.SIGTERM)
    out, err = process.communicate(timeout=20)
    assert code == 0, err[-3000:]
    assert "the contract says true" in out, out
    records = [json.loads(line) for line in (tmp_path / "records.jsonl").read_text().splitlines()]
    assert len(records) == 50
    assert {record["topic"] for record in records} == {"/robot_1/odom"}
    analysts = [json.loads(line) for line in (tmp_path / "analyst.jsonl").read_text().splitlines()]
    assert len(analysts) == 50, "the second run alone was sealed for the second reader"
    assert not {r["proof"]["stream"] for r in analysts} & {r["proof"]["stream"] for r in records}
    assert len((tmp_path / "records.csv").read_text().splitlines()) == 51, "fifty records and the heads"
    assert (tmp_path / "recovered.mcap").stat().st_size > 5_000
    assert (tmp_path / "trajectory.png").stat().st_size > 5_000
    assert "revoked" in out

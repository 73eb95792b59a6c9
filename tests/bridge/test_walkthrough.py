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
    assert commands.count("rosbridge-eth") > 15
    script = f'set -euo pipefail\nrosbridge-eth() {{ "{sys.executable}" -m rosbridge_eth "$@"; }}\n{commands}'
    environment = {**os.environ, "PYTHONPATH": str(ROOT / "src"), "COLUMNS": "120"}
    for name in [name for name in environment if name.startswith("ROSBRIDGE_ETH_")]:
        del environment[name]
    bash = shutil.which("bash")
    assert bash
    process = subprocess.Popen(
        [bash, "-c", script], cwd=tmp_path, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        text=True, start_new_session=True,
    )
    # The commands in the background hold the pipes open, so the shell's end is waited for, not theirs.
    try:
        code = process.wait(timeout=500)
    finally:
        os.killpg(process.pid, signal.SIGTERM)
    out, err = process.communicate(timeout=30)
    assert code == 0, out[-1000:] + err[-3000:]
    assert "the contract says true" in out, out
    records = [json.loads(line) for line in (tmp_path / "records.jsonl").read_text().splitlines()]
    assert len(records) == 50
    assert {record["topic"] for record in records} == {"/robot_1/odom"}
    assert {record["source"] for record in records} == {"sim"}
    verdict = json.loads((tmp_path / "verdict.json").read_text())
    assert verdict["sound"] and verdict["head"]["goodbye"] and verdict["records"] == 50
    analysts = [json.loads(line) for line in (tmp_path / "analyst.jsonl").read_text().splitlines()]
    assert len(analysts) == 50, "the second run alone was sealed for the second reader"
    before = {record["captured_ns"] for record in records}
    assert min(record["captured_ns"] for record in analysts) > max(before)
    assert (tmp_path / "trajectory.png").stat().st_size > 5_000
    assert (tmp_path / "recovered.bag").stat().st_size > 5_000
    assert "revoked" in out and "Traceback" not in err
    fingerprints = re.findall(r"CA is ((?:[0-9a-f]{4} ){15}[0-9a-f]{4})", err)
    assert len(fingerprints) == 2 and len(set(fingerprints)) == 1, "what is to be compared"

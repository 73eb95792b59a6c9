"""The commands of docs/fleet-ca.md, run as they stand there."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import smcrypto

PAGE = Path(__file__).resolve().parents[2] / "docs" / "fleet-ca.md"


def test_the_page_works_from_its_first_command_to_its_last(require: Callable[[str], str], tmp_path: Path) -> None:
    require("openssl")
    bash = require("bash")
    blocks = re.findall(r"^```(sh|python)\n(.*?)^```$", PAGE.read_text("utf-8"), re.MULTILINE | re.DOTALL)
    assert len(blocks) == 10
    environment = os.environ | {
        "PYTHONPATH": str(Path(smcrypto.__file__).parents[1]),
        "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}",
    }
    for language, text in blocks:
        command = [bash, "-euo", "pipefail", "-c", text] if language == "sh" else [sys.executable, "-c", text]
        done = subprocess.run(command, cwd=tmp_path, env=environment, input=b"y\ny\n", capture_output=True, check=False)
        assert done.returncode == 0, f"{text}\n{done.stdout.decode()}\n{done.stderr.decode()}"
        if language == "python":
            assert "was revoked at" in done.stdout.decode()

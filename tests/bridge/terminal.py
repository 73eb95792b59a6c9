"""A command at a terminal of its own, as a person sees it and types into it."""

from __future__ import annotations

import fcntl
import os
import pty
import re
import select
import signal
import struct
import subprocess
import sys
import termios
import time
from pathlib import Path
from typing import Self

SOURCE = Path(__file__).resolve().parents[2] / "src"


class Terminal:
    """`rosbridge-eth ARGUMENTS` in `folder`, 120 columns wide. `shown` is all it wrote, without colours."""

    def __init__(self, folder: Path, *arguments: str, python: str = sys.executable, **environment: str) -> None:
        ours, theirs = pty.openpty()
        fcntl.ioctl(ours, termios.TIOCSWINSZ, struct.pack("HHHH", 50, 120, 0, 0))
        kept = {name: value for name, value in os.environ.items() if not name.startswith(("ROS_", "ROSBRIDGE_ETH_"))}
        self.process = subprocess.Popen(
            [python, "-m", "rosbridge_eth", *arguments], cwd=folder, stdin=theirs, stdout=theirs, stderr=theirs,
            env={**kept, "PYTHONPATH": str(SOURCE), "TERM": "xterm", **environment}, start_new_session=True,
            preexec_fn=lambda: fcntl.ioctl(0, termios.TIOCSCTTY, 0),
        )  # fmt: skip
        os.close(theirs)
        self._ours, self.shown, self._seen = ours, "", 0

    def _read(self, seconds: float) -> bool:
        """Whether there was something; False at the end, too."""
        if not select.select([self._ours], [], [], seconds)[0]:
            return False
        try:
            data = os.read(self._ours, 65_536)
        except OSError:  # the other end is closed
            return False
        self.shown += re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", data.decode(errors="replace"))
        return bool(data)

    def until(self, text: str, seconds: float = 120.0) -> str:
        """Wait until `text` is shown behind what was waited for before; what stood in between."""
        deadline = time.monotonic() + seconds
        while text not in self.shown[self._seen :]:
            if not self._read(0.2) and (self.process.poll() is not None or time.monotonic() > deadline):
                raise AssertionError(f"{text!r} is not shown: {self.shown[-2000:]}")
        end = self.shown.index(text, self._seen) + len(text)
        between, self._seen = self.shown[self._seen : end], end
        return between

    def type(self, line: str) -> None:
        os.write(self._ours, line.encode() + b"\n")

    def answer(self, prompt: str, line: str) -> None:
        self.until(prompt)
        self.type(line)

    def end(self, seconds: float = 60.0) -> int:
        """Wait for the end; the exit code."""
        deadline = time.monotonic() + seconds
        while self.process.poll() is None and time.monotonic() < deadline:
            self._read(0.2)
        while self._read(0.1):
            pass
        return self.process.wait(1)

    def interrupt(self) -> int:
        """Ctrl-C; the exit code."""
        os.write(self._ours, b"\x03")
        return self.end()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGTERM)
            try:
                self.end(20)
            except subprocess.TimeoutExpired:
                os.killpg(self.process.pid, signal.SIGKILL)
        os.close(self._ours)

"""Genuine ROS 2 nodes for the tests: processes of the Python named by ROS2_PYTHON, which install.sh makes.

Each test has a ROS domain of its own, so that tests side by side do not hear each other.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from conftest import unavailable

HERE = Path(__file__).parent
SOURCES = HERE.parents[3] / "src"
PATIENCE = 60.0  # discovery takes half a minute on a machine that is busy with other things
DOMAINS = 90  # above 101, ports may collide with those the system hands out


def ros2_python() -> str:
    """The interpreter, or the test is skipped."""
    path = os.environ.get("ROS2_PYTHON")
    if not path:
        unavailable("ROS2_PYTHON does not name a Python with rclpy (tests/bridge/sources/ros2/install.sh makes one)")
    if subprocess.run([path, "-c", "import rclpy"], capture_output=True, check=False).returncode:
        unavailable(f"{path} has no rclpy")
    return str(path)


def free_domain(number: int) -> int:
    """A domain for the `number`-th test of this worker."""
    worker = int(os.environ.get("PYTEST_XDIST_WORKER", "gw0")[2:])
    return 1 + (worker * 45 + number % 45) % DOMAINS


class Program:
    """A process that talks JSON lines; its stderr is kept."""

    def __init__(self, command: list[str], environment: dict[str, str]) -> None:
        self.process = subprocess.Popen(
            command,
            env=environment,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            bufsize=1,
        )
        self.lines: list[str] = []
        self.errors: list[str] = []
        self._changed = threading.Condition()
        self._readers = [
            threading.Thread(target=self._read, args=(stream, kept), daemon=True)
            for stream, kept in ((self.process.stdout, self.lines), (self.process.stderr, self.errors))
        ]
        for reader in self._readers:
            reader.start()

    def _read(self, stream: Any, kept: list[str]) -> None:
        for line in stream:
            with self._changed:
                kept.append(line.rstrip("\n"))
                self._changed.notify_all()
        with self._changed:
            self._changed.notify_all()

    def until(self, condition: Callable[[], bool], what: str) -> None:
        deadline = time.monotonic() + PATIENCE
        with self._changed:
            while not condition():
                left = deadline - time.monotonic()
                assert left > 0 and (self.process.poll() is None or any(r.is_alive() for r in self._readers)), (
                    f"{what} did not happen; stdout: {self.lines[-5:]}; stderr: {self.errors[-20:]}"
                )
                self._changed.wait(min(left, 0.5))

    def says(self, text: str) -> None:
        self.until(lambda: any(text in line for line in self.errors), f"saying {text!r}")

    def finish(self, number: int | None = None) -> int:
        if number is not None and self.process.poll() is None:
            self.process.send_signal(number)
        elif self.process.stdin is not None:
            self.process.stdin.close()
        code = self.process.wait(PATIENCE)
        for reader in self._readers:
            reader.join(PATIENCE)
        return code

    def leave(self) -> None:
        """End in good order: what is killed is missed by Fast DDS for a while, and leaves its shared memory behind."""
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGTERM)
            try:
                self.process.communicate(timeout=5)
            except (subprocess.TimeoutExpired, ValueError):
                self.kill()

    def kill(self) -> None:
        self.process.kill()
        self.process.wait(PATIENCE)


class Node(Program):
    """publishing.py: every order is answered before the next."""

    def __init__(self, command: list[str], environment: dict[str, str]) -> None:
        super().__init__(command, environment)
        self._answers = 1
        self._wait()

    def _wait(self) -> None:
        self.until(lambda: len(self.lines) >= self._answers, "the node's answer")

    def order(self, **what: Any) -> None:
        self.process.stdin.write(json.dumps(what) + "\n")
        self.process.stdin.flush()
        self._answers += 1
        self._wait()


class Watcher(Program):
    """watching.py: the source under test."""

    def __init__(self, command: list[str], environment: dict[str, str]) -> None:
        self._parsed: list[dict[str, Any]] = []
        super().__init__(command, environment)

    def _of(self, kind: str) -> list[Any]:
        self._parsed += map(json.loads, self.lines[len(self._parsed) :])
        return [found[kind] for found in self._parsed if kind in found]

    @property
    def records(self) -> list[dict[str, Any]]:
        return self._of("record")

    @property
    def declared(self) -> list[dict[str, Any]]:
        return self._of("declared")

    @property
    def rebuilt(self) -> list[bool]:
        return self._of("rebuilt")

    def opened(self) -> None:
        self.until(lambda: bool(self.lines), "the source's opening")

    def watches(self, topic: str) -> None:
        self.until(lambda: any(f"{topic}: watched" in line for line in self.errors), f"watching {topic}")

    def recorded(self, count: int) -> list[dict[str, Any]]:
        self.until(lambda: len(self.records) >= count, f"the record {count}")
        return self.records

    def stop(self) -> dict[str, dict[str, int]]:
        """SIGTERM; the statistics it ends with."""
        code = self.finish(signal.SIGTERM)
        assert code == 0, self.errors[-20:]
        (statistics,) = self._of("statistics")
        (threads,) = self._of("threads")
        assert threads == ["MainThread"]
        return statistics


class Graph:
    """One domain, its nodes and watchers; all end with the test."""

    def __init__(self, python: str, domain: int, folder: Path, ends: ExitStack) -> None:
        self.domain, self._python, self._folder, self._ends = domain, python, folder, ends
        # Nothing of this process's own interpreter, and no ROS that may be sourced around it.
        self.environment = {
            "PATH": os.environ["PATH"],
            "HOME": str(folder),
            "PYTHONPATH": str(SOURCES),
            "PYTHONUNBUFFERED": "1",
            "ROS_DOMAIN_ID": str(domain),
            "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        }

    def _keep(self, program: Program) -> None:
        self._ends.callback(program.leave)

    def node(self, name: str, **environment: str) -> Node:
        node = Node([self._python, str(HERE / "publishing.py"), name], {**self.environment, **environment})
        self._keep(node)
        return node

    def watcher(self, config: str, *arguments: str, **environment: str) -> Watcher:
        file = self._folder / "robot.toml"
        file.write_text(config if "[source]" in config else config + '\n[source]\nkind = "ros2"\n')
        watcher = Watcher(
            [self._python, str(HERE / "watching.py"), str(file), *arguments], {**self.environment, **environment}
        )
        self._keep(watcher)
        watcher.opened()
        return watcher

    def program(self, arguments: list[str], **environment: str) -> Program:
        """Any program of that Python."""
        program = Program([self._python, *arguments], {**self.environment, **environment})
        self._keep(program)
        return program

    def run(self, script: str) -> str:
        """The output of a program of the same Python."""
        return subprocess.run(
            [self._python, "-c", script], env=self.environment, capture_output=True, text=True, check=True
        ).stdout


@contextmanager
def graph(python: str, domain: int, folder: Path) -> Iterator[Graph]:
    with ExitStack() as ends:
        yield Graph(python, domain, folder, ends)

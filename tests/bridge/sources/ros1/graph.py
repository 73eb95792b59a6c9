"""A real ROS 1 graph for the tests: Debian's master and real publishers as processes, and a Ros1Source that listens."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import threading
import time
import xmlrpc.client
from collections.abc import Callable, Sequence
from pathlib import Path

from ports import free_port
from rosbridge_eth.capture import Capture, RawMessage, TopicRule, parse_line
from rosbridge_eth.robot.sources import Selection
from rosbridge_eth.robot.sources.queue import Queue
from rosbridge_eth.robot.sources.ros1.source import Ros1Source

SYSTEM_PYTHON = "/usr/bin/python3"  # where Debian's ROS packages are, whatever environment this runs in
PUBLISHERS = Path(__file__).with_name("publishers.py")
PATIENCE = 20.0


def eventually(condition: Callable[[], object], what: str, patience: float = PATIENCE) -> None:
    """Wait until something holds that another process brings about."""
    deadline = time.monotonic() + patience
    while not condition():
        assert time.monotonic() < deadline, f"waited {patience} s in vain: {what}"
        time.sleep(0.02)


class Graph:
    """A master, and whatever is started with it. Every process is ended by `close`."""

    def __init__(self, folder: Path) -> None:
        self.port = free_port()
        self.uri = f"http://127.0.0.1:{self.port}"
        self.environment = {
            **{key: value for key, value in os.environ.items() if not key.startswith(("ROS", "PYTHON"))},
            "ROS_MASTER_URI": self.uri, "ROS_IP": "127.0.0.1", "ROS_LOG_DIR": str(folder),
            "PYTHONUNBUFFERED": "1", "PYTHONDONTWRITEBYTECODE": "1",
        }  # fmt: skip
        self.processes: list[subprocess.Popen[str]] = []
        self.master: subprocess.Popen[str] | None = None

    def start_master(self) -> None:
        self.master = self.start("rosmaster", "--core", "-p", str(self.port))
        eventually(self.answers, "the master starts")

    def stop_master(self) -> None:
        assert self.master is not None
        self.kill(self.master)

    def answers(self) -> bool:
        try:
            return bool(self.call("getPid")[0] == 1)
        except OSError:
            return False

    def call(self, method: str, *parameters: str) -> list:
        with xmlrpc.client.ServerProxy(self.uri) as master:
            return getattr(master, method)("/test", *parameters)

    def subscribers(self, topic: str) -> list[str]:
        return next((nodes for name, nodes in self.call("getSystemState")[2][1] if name == topic), [])

    def start(self, *command: str) -> subprocess.Popen[str]:
        process = subprocess.Popen(
            command, env=self.environment, text=True, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
            start_new_session=True,
        )  # fmt: skip
        self.processes.append(process)
        return process

    def publish(self, node: str, *topics: dict, wait: bool = True) -> subprocess.Popen[str]:
        """A rospy node, once it has registered its topics; see publishers.py."""
        program = {"node": node, "wait": wait, "topics": topics}
        process = self.start(SYSTEM_PYTHON, str(PUBLISHERS), json.dumps(program))
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
        return process

    def kill(self, process: subprocess.Popen[str]) -> None:
        """As a power cut: nobody is told."""
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()
        if process.stdout is not None:
            process.stdout.close()
        if process in self.processes:
            self.processes.remove(process)

    def close(self) -> None:
        for process in list(self.processes):
            self.kill(process)


class Listening:
    """A source that runs in a thread, and its queue; every message goes through Capture in a second one, as in a robot.

    tolerant: a message that cannot be captured is no failure.
    """

    def __init__(self, uri: str, topics: Sequence[str] = (), nodes: Sequence[str] = (), *,
                 tolerant: bool = False, **settings: object) -> None:
        chosen = {"master": uri, "hostname": "127.0.0.1", **settings}
        self.source = Ros1Source(Selection(topics, nodes), **chosen)  # type: ignore[arg-type]
        self.capture = Capture([TopicRule("**", limit=4096)], source_kind="ros1")
        self.raw: list[RawMessage] = []
        self.data: dict[str, list] = {}
        self.stop = threading.Event()
        self._tolerant = tolerant
        self.failure: list[BaseException] = []
        self.take: Callable[[RawMessage], object] = self.keep
        self.queue = Queue(2 * self.source.max_message, waits=False)
        parts = self._run, self._emit
        self._threads = [threading.Thread(target=self._do, args=(part,), daemon=True) for part in parts]

    def __enter__(self) -> Listening:
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop.set()
        for thread in self._threads:
            thread.join(10)
            assert not thread.is_alive()
        if self.failure:
            raise self.failure[0]

    def _do(self, what: Callable[[], None]) -> None:
        try:
            what()
        except BaseException as error:
            self.failure.append(error)

    def _run(self) -> None:
        self.source.run(self.queue.put, self.stop)

    def _emit(self) -> None:
        while not self.stop.wait(0.002):
            while (raw := self.queue.take()) is not None:
                self.take(raw)

    @property
    def lost(self) -> dict[tuple[str, str], int]:
        return {**self.source.lost, **self.queue.lost}

    def keep(self, raw: RawMessage) -> None:
        self.raw.append(raw)
        record = self.capture.process(raw, time.time_ns())
        if record is None:
            assert self._tolerant, f"{raw.topic} cannot be captured"
            return
        self.data.setdefault(raw.topic, []).append(parse_line(record.line).data)

    def count(self, topic: str) -> int:
        return len(self.data.get(topic, ()))

    def wait_for(self, topic: str, count: int, patience: float = PATIENCE) -> list:
        eventually(
            lambda: self.failure or self.count(topic) >= count,
            f"{count} messages of {topic}; there are {self.count(topic)}",
            patience,
        )
        return self.data.get(topic, [])

    def connected(self, topic: str) -> int:
        """Publishers of the topic that are being read."""
        known = self.source._topics.get(topic)
        publishers = known.publishers.copy().values() if known else ()
        return sum(each.connected and not each.over.is_set() for each in publishers)

    def numbers(self, topic: str) -> list[int]:
        return [data["data"] for data in self.data.get(topic, ())]

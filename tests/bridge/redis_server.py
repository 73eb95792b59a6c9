"""A real Redis for tests: its own process, port and folder; it can be killed and started again on its data."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import time
from contextlib import suppress
from pathlib import Path

import redis

from conftest import unavailable
from ports import free_port

DURABLE = ("--appendonly", "yes", "--appendfsync", "always", "--maxmemory-policy", "noeviction")


class RedisServer:
    """redis-server on a free port of loopback. options replace those that make it durable."""

    def __init__(self, folder: Path, *options: str) -> None:
        program = shutil.which("redis-server")
        if program is None:
            unavailable("the program 'redis-server' is not installed")
        self.port = free_port()
        self.folder = folder
        self.url = f"redis://127.0.0.1:{self.port}/0"
        self.arguments = [
            str(program), "--port", str(self.port), "--bind", "127.0.0.1", "--dir", str(folder), "--save", "",
            *(options or DURABLE),
        ]
        self._process: subprocess.Popen[bytes] | None = None
        self.start()

    def start(self) -> None:
        """Start it on the data that is there, and wait until it answers."""
        with (self.folder / "redis.log").open("ab") as log:
            self._process = subprocess.Popen(self.arguments, stdout=log, stderr=log)
        with self.client() as client:
            for _ in range(500):
                try:
                    client.ping()
                    return
                except redis.exceptions.AuthenticationError:
                    return
                except redis.RedisError:
                    try:
                        self._process.wait(0.02)
                        break
                    except subprocess.TimeoutExpired:
                        continue
        self.kill()
        raise RuntimeError((self.folder / "redis.log").read_text())

    @property
    def runs(self) -> bool:
        return self._process is not None

    def client(self, **more) -> redis.Redis:
        """A plain client."""
        return redis.Redis(port=self.port, **more)

    def kill(self) -> None:
        """SIGKILL."""
        self._signal(signal.SIGKILL)

    def stop(self) -> None:
        self._signal(signal.SIGTERM)

    def pause(self) -> None:
        """It keeps its connections and answers nothing, until `resume`."""
        assert self._process is not None
        os.kill(self._process.pid, signal.SIGSTOP)

    def resume(self) -> None:
        assert self._process is not None
        os.kill(self._process.pid, signal.SIGCONT)

    def _signal(self, number: int) -> None:
        if self._process is not None:
            self._process.send_signal(number)
            self._process.wait(timeout=20)
            self._process = None


class RedisClusterServer:
    """A Redis Cluster of three nodes, each a RedisServer with a third of the slots; no replicas."""

    def __init__(self, folder: Path) -> None:
        self.nodes: list[RedisServer] = []
        try:
            for number in range(3):
                (folder / str(number)).mkdir()
                bus = ("--cluster-enabled", "yes", "--cluster-node-timeout", "1000", "--cluster-port", str(free_port()))
                self.nodes.append(RedisServer(folder / str(number), *DURABLE, *bus))
            self._join()
        except BaseException:
            self.kill()
            raise
        self.url = f"redis://127.0.0.1:{self.nodes[0].port}/0"

    def _join(self) -> None:
        for number, node in enumerate(self.nodes):
            with node.client() as client:
                begin, end = 16384 * number // 3, 16384 * (number + 1) // 3 - 1
                client.execute_command("CLUSTER", "ADDSLOTSRANGE", begin, end)
                client.execute_command("CLUSTER", "SET-CONFIG-EPOCH", number + 1)
                for other in self.nodes[:number]:
                    bus = other.arguments[other.arguments.index("--cluster-port") + 1]
                    client.execute_command("CLUSTER", "MEET", "127.0.0.1", other.port, bus)
        self.wait("ok")

    def wait(self, state: str) -> None:
        """Until every node that runs says this of the cluster ("ok", "fail")."""
        for node in self.nodes:
            if not node.runs:
                continue
            for _ in range(1000):
                with node.client() as client, suppress(redis.RedisError):
                    if client.cluster("info")["cluster_state"] == state:
                        break
                time.sleep(0.02)
            else:
                raise RuntimeError((node.folder / "redis.log").read_text())

    def client(self) -> redis.RedisCluster:
        """A plain client."""
        return redis.RedisCluster.from_url(self.url)

    def kill(self) -> None:
        """SIGKILL, all of them."""
        for node in self.nodes:
            node.kill()

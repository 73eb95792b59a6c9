"""Ports for the servers that tests and benchmarks start."""

from __future__ import annotations

import fcntl
import random
import socket
import tempfile
from pathlib import Path
from typing import IO

_reserved: list[IO[bytes]] = []  # open for as long as this process lives, and locked so long


def free_port(kind: int = socket.SOCK_STREAM, count: int = 1) -> int:
    """A port that no other process which asks here is given, and below those that the kernel gives out by itself; or
    the first of so many in a row.

    Between the choice and its use seconds may pass: a lock on a file of the port's name keeps the processes of a
    parallel test run apart.
    """
    folder = Path(tempfile.gettempdir()) / "rosbridge_eth-ports"
    folder.mkdir(exist_ok=True)
    while True:
        first = random.SystemRandom().randrange(20_000, 32_000 - count)
        files = [(folder / str(port)).open("wb") for port in range(first, first + count)]
        try:
            for port, file in enumerate(files, first):
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                with socket.socket(socket.AF_INET, kind) as probe:
                    probe.bind(("127.0.0.1", port))
        except OSError:
            for file in files:
                file.close()
            continue
        _reserved.extend(files)
        return first

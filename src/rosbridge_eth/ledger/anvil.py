"""A local anvil (Foundry's development node), started as a child process.

`npx --yes @foundry-rs/anvil@VERSION` fetches it the first time. With a state file
the chain survives a restart: anvil writes it every few seconds, and when it is asked to end.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import socket
import subprocess
import time
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType

from rosbridge_eth.errors import ChainError
from rosbridge_eth.ledger.failures import NodeFailure
from rosbridge_eth.ledger.jsonrpc import JsonRpcChain

VERSION = "1.7.1"
START_SECONDS = 60.0  # the first start downloads it
STOP_SECONDS = 10.0
STATE_SECONDS = 5  # what a node that is killed loses of its chain, at most


class Anvil:
    """A running anvil at `url`. Ends with `stop`, or with the `with` block."""

    def __init__(self, url: str, process: subprocess.Popen[bytes], log: Path | None) -> None:
        self.url = url
        self._process = process
        self._log = log

    @property
    def pid(self) -> int:
        return self._process.pid

    def running(self) -> bool:
        return self._process.poll() is None

    def wait(self) -> int:
        """Block until it ends; its exit code."""
        return self._process.wait()

    def stop(self) -> None:
        """Let it write its state and end; kill it if it does not."""
        for sent in (signal.SIGINT, signal.SIGKILL):
            if not self.running():
                return
            try:
                # npx starts anvil as a child of its own: the signal goes to the group that start() made.
                os.killpg(self._process.pid, sent)
            except ProcessLookupError:
                return
            try:
                self._process.wait(STOP_SECONDS)
            except subprocess.TimeoutExpired:
                continue

    def kill(self) -> None:
        """As a power cut would."""
        os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait(STOP_SECONDS)

    def __enter__(self) -> Anvil:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.stop()


def _require_free(port: int) -> None:
    """Otherwise whatever listens there would answer in anvil's place."""
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind(("127.0.0.1", port))
        except OSError as error:
            raise ChainError(f"port {port} of 127.0.0.1 is in use ({error.strerror}); choose another one") from error


def keep_one_genesis(state: Path) -> None:
    """Leave a state file of anvil with the first block that its chain began with.

    A restarted anvil makes a first block of its own before it reads the file, and later writes both; the start after
    that takes either, and so may come back as another chain. Each is as old as its start: the oldest is the chain's.
    ChainError if the file was cut off, as when anvil was killed while it wrote, or cannot be put right.
    """
    try:
        content = json.loads(state.read_bytes())
        first = [block for block in content["blocks"] if int(block["header"]["number"], 16) == 0]
        ages = [int(block["header"]["timestamp"], 16) for block in first]
    except FileNotFoundError:
        return
    except (ValueError, KeyError, TypeError) as error:
        raise ChainError(
            f"{state} is not whole, anvil was killed while it wrote it; put back a copy of the file, "
            "or move it away to begin a new chain with a new home"
        ) from error
    if len(first) > 1:
        genesis = first[ages.index(min(ages))]
        content["blocks"] = [block for block in content["blocks"] if block is genesis or block not in first]
        whole = state.with_name(state.name + ".new")
        try:
            whole.write_text(json.dumps(content))
            whole.replace(state)
        except OSError as error:
            whole.unlink(missing_ok=True)
            raise ChainError(f"{whole} cannot be written: {error.strerror}") from error


def start(
    port: int,
    *,
    state: Path | None = None,
    block_time: float | None = None,
    log: Path | None = None,
    options: Sequence[str] = (),
) -> Anvil:
    """Start anvil on 127.0.0.1:port and wait until it answers.

    state: the file that keeps the chain. block_time: seconds between blocks; without it
    every transaction gets its block at once. log: where its output goes (nowhere otherwise).
    ChainError if npx is missing, the port is taken, the state is not whole or it does not start.
    """
    _require_free(port)
    if state is not None:
        keep_one_genesis(state)
    program = shutil.which("anvil")
    npx = shutil.which("npx")
    if program:
        command = [program]
    elif npx:
        command = [npx, "--yes", f"@foundry-rs/anvil@{VERSION}"]
    else:
        raise ChainError("a local chain needs anvil or, to fetch it, npx (of Node.js); install one of them")
    command += ["--host", "127.0.0.1", "--port", str(port), *options]
    if state is not None:
        command += ["--state", str(state), "--state-interval", str(STATE_SECONDS)]
    if block_time is not None:
        command += ["--block-time", f"{block_time:g}"]
    output = log.open("ab") if log else None
    try:
        process = subprocess.Popen(  # noqa: S603 - a fixed program, no shell
            command,
            stdin=subprocess.DEVNULL,
            stdout=output or subprocess.DEVNULL,
            stderr=subprocess.STDOUT if output else subprocess.PIPE,
            start_new_session=True,
        )
    finally:
        if output:
            output.close()
    anvil = Anvil(f"http://127.0.0.1:{port}", process, log)
    probe = JsonRpcChain(anvil.url, timeout=2)
    deadline = time.monotonic() + START_SECONDS
    try:
        while True:
            if not anvil.running():
                said = b"" if process.stderr is None else process.stderr.read()
                words = said.decode(errors="replace").strip()[-300:]
                raise ChainError(f"anvil ended while starting on port {port}: {words}")
            try:
                probe.chain_id()
                return anvil
            except NodeFailure as failure:
                if time.monotonic() > deadline:
                    raise ChainError(f"anvil does not answer on port {port} after {START_SECONDS:.0f} s") from failure
                time.sleep(0.05)
    except BaseException:
        anvil.stop()
        raise
    finally:
        probe.close()

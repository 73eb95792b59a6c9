"""Chains to begin with: one inside this process, and anvil (Foundry's development node) as a process of its own."""

from __future__ import annotations

import ast
import json
import logging
import os
import shutil
import signal
import socket
import subprocess
import threading
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from web3 import HTTPProvider
from web3.middleware import combine_middleware
from web3.providers.eth_tester import EthereumTesterProvider

from rosbridge_eth.errors import ChainError
from rosbridge_eth.ledger.transport import limit_recursion, session

log = logging.getLogger(__name__)

_CALLER = "0x7E5F4552091A69125d5DfCb7b8C2659029395Bdf"  # eth-tester's first account, in whose name it makes calls


class EmbeddedChain(EthereumTesterProvider):
    """eth-tester's chain (py-evm) for Ledger.connect and Ledger.deploy. It ends with the process.

    Every transaction gets a block at once. Safe to use from several threads.
    """

    def __init__(self, fund: Mapping[str, int] | None = None, *, rules: Any = None) -> None:
        """fund: wei of these accounts at the beginning. rules: a VM class of py-evm, Prague's otherwise."""
        from eth_tester import EthereumTester, PyEVMBackend  # type: ignore[import-untyped, unused-ignore]
        from eth_utils.address import to_canonical_address

        wealth = {_CALLER: 10**27} | dict(fund or {})
        state = {
            to_canonical_address(account): {"balance": wei, "nonce": 0, "code": b"", "storage": {}}
            for account, wei in wealth.items()
        }
        genesis = PyEVMBackend.generate_genesis_params({"gas_limit": 30_000_000})
        backend = PyEVMBackend(genesis, state, rules and ((0, rules),))
        super().__init__(EthereumTester(backend))
        limit_recursion()  # py-evm wants more for calls within calls 1,024 deep; the contract here makes none
        self._lock = threading.RLock()
        # What web3 puts between itself and eth-tester, for requests that come in a batch.
        self._formatted = combine_middleware(self._middleware, None, self.make_request)  # type: ignore[arg-type]

    def make_request(self, method: Any, params: Any) -> Any:
        """As a node answers: failures are errors of JSON-RPC, a revert with its data."""
        from eth_tester.exceptions import TransactionFailed  # type: ignore[import-untyped, unused-ignore]

        with self._lock:
            try:
                return super().make_request(method, params)
            except TransactionFailed as error:
                said = str(error).removeprefix("execution reverted: ")  # the data is there as Python shows bytes
                data = {"data": "0x" + ast.literal_eval(said).hex()} if said[:2] in ("b'", 'b"') else {}
                answer = {"code": 3, "message": f"execution reverted: {said}"} | data
            except Exception as error:  # of many classes: eth-tester's, py-evm's, eth_utils'
                answer = {"code": -32000, "message": str(error) or type(error).__name__}
            return {"jsonrpc": "2.0", "id": 0, "error": answer}

    def make_batch_request(self, requests: Any) -> Any:
        return [self._formatted(method, params) for method, params in requests]


# ---------------------------------------------------------------------- anvil

VERSION = "1.7.1"
START_SECONDS = 60.0  # the first start downloads it
STOP_SECONDS = 10.0
STATE_SECONDS = 5  # between two times that anvil writes its state
_WITH_US = 'exec 3<&0; { read -r _ <&3; kill -KILL 0; } & exec "$@" </dev/null 3<&-'
"""Runs a program until its input, a pipe that nobody writes to, is closed; then all of its group is killed."""


def is_free(port: int) -> bool:
    """Whether a TCP port of 127.0.0.1 is free."""
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind(("127.0.0.1", port))
        except OSError:
            return False
        return True


def free_port(first: int) -> int:
    """The first of `first` and those above that is free."""
    return next(port for port in range(first, 65_536) if is_free(port))


class Anvil:
    """A running anvil at `url`. Made by `start`; ends with `stop` or the `with` block.

    Where it has a state file, the chain survives: anvil writes it every STATE_SECONDS and at its end. A kill costs what
    came since, and in the middle of writing may cost the file: use geth for a chain that is to stay. It ends with the
    process that started it, also if that one is killed.
    """

    def __init__(self, port: int, process: subprocess.Popen[bytes], state: Path | None) -> None:
        self.url = f"http://127.0.0.1:{port}"
        self._process, self._state = process, state
        self._provider = HTTPProvider(
            self.url, {"timeout": 120.0}, session(limit=2**32), exception_retry_configuration=None
        )

    @staticmethod
    def start(
        port: int, *, state: Path | None = None, block_time: float | None = None, options: Sequence[str] = ()
    ) -> Anvil:
        """Start anvil on 127.0.0.1:port and wait until it answers; npx fetches it the first time.

        state: the file that keeps the chain. block_time: seconds between blocks; without it every transaction gets
        its block at once. ChainError if it is missing or does not start, or the port is taken.
        """
        if not is_free(port):  # whatever listens there would answer in anvil's place
            raise ChainError(f"port {port} of 127.0.0.1 is in use; choose another")
        if shutil.which("anvil"):
            command = ["anvil"]
        elif shutil.which("npx"):
            command = ["npx", "--yes", "--prefer-offline", f"@foundry-rs/anvil@{VERSION}"]
        else:
            raise ChainError(
                "a local chain needs anvil (https://getfoundry.sh) or, to fetch it, npx (of Node.js): install one of"
                " them, or use a node of yours (`up --chain URL`, or [chain] url in server.toml)"
            )
        command += ["--host", "127.0.0.1", "--port", str(port), *options]
        if state is not None:
            command += ["--state", str(state), "--state-interval", str(STATE_SECONDS)]
            command += ["--timestamp", str(_begun(state))]
        if block_time is not None:
            command += ["--block-time", f"{block_time:g}"]
        process = subprocess.Popen(  # noqa: S603 - fixed programs
            ["/bin/sh", "-c", _WITH_US, "sh", *command], stdin=subprocess.PIPE, stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL, start_new_session=True,
        )  # fmt: skip
        anvil = Anvil(port, process, state)
        deadline = time.monotonic() + START_SECONDS
        while True:
            try:
                anvil.ask("eth_chainId")
                break
            except ChainError as error:
                if anvil.running() and time.monotonic() < deadline:
                    time.sleep(0.05)
                    continue
                anvil.kill()
                raise ChainError(
                    f"anvil does not start on port {port}; {' '.join(command)} tells why"
                    + (f"; it may be that {state} is damaged" if state and state.exists() else "")
                ) from error
        if state is not None:
            anvil.ask("evm_setTime", hex(int(time.time())))  # it goes on from that of its first block
        return anvil

    def fund(self, account: str, eth: int) -> None:
        """Give an account so much ETH, if it has less."""
        if int(self.ask("eth_getBalance", account, "latest"), 16) < eth * 10**18:
            self.ask("anvil_setBalance", account, hex(eth * 10**18))

    def ask(self, method: str, *params: Any) -> Any:
        """Any JSON-RPC call, such as anvil's own; ChainError if it gives no result."""
        try:
            answer: Any = self._provider.make_request(method, params)
            return answer["result"]
        except (OSError, ValueError, KeyError) as error:
            raise ChainError(f"anvil refuses {method}: {error}") from error

    @property
    def pid(self) -> int:
        return self._process.pid

    def running(self) -> bool:
        return self._process.poll() is None

    def wait(self) -> int:
        """Block until it ends; its exit code."""
        return self._process.wait()

    def keeps(self, account: str) -> None:
        """Wait until the state file has this account. ChainError."""
        deadline = time.monotonic() + START_SECONDS
        while self._state and not (
            self._state.exists() and account[2:].lower() in self._state.read_text("utf-8").lower()
        ):
            if not self.running() or time.monotonic() > deadline:
                raise ChainError(f"anvil does not write {self._state}; is there room on the disk?")
            time.sleep(0.1)

    def stop(self) -> None:
        """Let it write its state and end; kill it if it does not."""
        self._end(signal.SIGINT)

    def kill(self) -> None:
        """As a power cut would."""
        self._end(signal.SIGKILL)

    def _wait_for_the_rest(self, deadline: float) -> None:
        """npx ends before the anvil that it started, which still writes its state; the shell that watches us stays."""
        while time.monotonic() < deadline:
            names = set[str]()
            for file in Path("/proc").glob("[0-9]*/stat"):
                with suppress(OSError):  # it has ended
                    name, _, rest = file.read_text().rpartition(")")
                    state, _, group = rest.split()[:3]
                    if int(group) == self._process.pid and state != "Z":
                        names.add(name.partition("(")[2])
            if names <= {"sh"}:
                return
            time.sleep(0.02)

    def _end(self, number: signal.Signals) -> None:
        with suppress(ProcessLookupError, subprocess.TimeoutExpired):
            if self.running():
                # npx starts anvil as a child of its own: the signal goes to the group that start() made.
                os.killpg(self._process.pid, number)
                self._process.wait(STOP_SECONDS)
                self._wait_for_the_rest(time.monotonic() + STOP_SECONDS)
        if self._process.stdin is not None:
            self._process.stdin.close()  # and what is left of the group is killed
        self._process.wait()

    def __enter__(self) -> Anvil:
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()


def _begun(state: Path) -> int:
    """When the chain began, in seconds since 1970: now, if there is none.

    anvil makes a first block at every start and then has both, its own and the file's; with this time they are one.
    """
    try:
        heads = [block["header"] for block in json.loads(state.read_bytes())["blocks"]]
        return min(int(head["timestamp"], 16) for head in heads if int(head["number"], 16) == 0)
    except (OSError, ValueError, LookupError, TypeError):  # one that is damaged is told by anvil
        return int(time.time())

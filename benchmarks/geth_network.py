"""Private networks as the paper had them: geth nodes by proof of authority (Clique, EIP-225) or of work (ethash).

Each node is its own process with its own keys, database and peers, on loopback. geth 1.13 is the last one that signs
Clique blocks, 1.10.26 the last that mines; `benchmarks/install_geth.sh` builds either. Used by the tests of the ledger
on a real node, chain_interaction.py, load.py and paper.py.
"""

from __future__ import annotations

import json
import os
import shutil
import struct
import subprocess
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import requests
from eth_account import Account
from eth_hash.auto import keccak
from eth_keys.datatypes import PrivateKey

from ports import free_port

CHAIN_ID, EPOCH, GAS_LIMIT = 4711, 30_000, 30_000_000
DIFFICULTY = 0x4CCC8  # of the paper's network by proof of work
PATIENCE = 60.0
CONSENSUS = {"clique": ("GETH", "1.13."), "ethash": ("GETH_POW", "1.10.")}
"""By each consensus, the variable of the environment that names the program, and its version."""
_PASSWORD = "a node's own, on a machine that nobody else uses"


class Unavailable(Exception):
    """A program that a benchmark takes is not installed."""


def find_geth(consensus: str = "clique") -> str:
    """The program that the environment names, or the one on PATH."""
    variable, version = CONSENSUS[consensus]
    program = os.environ.get(variable) or shutil.which("geth")
    if not program or not Path(program).exists():
        raise Unavailable(f"no geth {version}x is installed: benchmarks/install_geth.sh builds it, {variable} names it")
    said = subprocess.run([program, "version"], capture_output=True, text=True, check=True).stdout
    if f"Version: {version}" not in said:
        raise Unavailable(f"{program} is not geth {version}x, which {consensus} takes; {variable} names another")
    return program


def make_dag(folder: Path) -> None:
    """The 1 GB of ethash's first epoch, without which nobody mines; made once, in minutes of a core.

    geth would make the next epoch's beside the mining, 30,000 blocks before anybody needs it, on all cores. A file that
    begins as one does keeps it from that.
    """
    folder.mkdir(parents=True, exist_ok=True)
    if not (folder / "full-R23-0000000000000000").exists():
        subprocess.run([find_geth("ethash"), "makedag", "0", str(folder)], check=True, capture_output=True)
    next_seed = keccak(bytes(32))[:8].hex()
    (folder / f"full-R23-{next_seed}").write_bytes(struct.pack("<II", 0xBADDCAFE, 0xFEE1DEAD).ljust(4096, b"\0"))


def new_key() -> PrivateKey:
    return PrivateKey(os.urandom(32))


def ten_accounts(operator: str) -> dict[str, int]:
    """The paper's: 100 ETH for each of ten, one of which is the operator's."""
    return dict.fromkeys([operator, *(new_key().public_key.to_checksum_address() for _ in range(9))], 100 * 10**18)


def genesis(signers: list[str], balances: Mapping[str, int], period: int, gas_limit: int) -> dict[str, Any]:
    """The first block of a network with London's rules, where these may sign, one block every `period` seconds.

    Without a period it is by proof of work, as difficult as the paper's.
    """
    forks = ["homestead", "eip150", "eip155", "eip158", "byzantium", "constantinople", "petersburg", "istanbul",
             "berlin", "london"]
    between = "".join(address[2:].lower() for address in sorted(signers, key=str.lower))
    engine = {"clique": {"period": period, "epoch": EPOCH}} if period else {"ethash": {}}
    return {
        "config": {"chainId": CHAIN_ID, **{f"{fork}Block": 0 for fork in forks}, **engine},
        "difficulty": "1" if period else hex(DIFFICULTY),
        "gasLimit": hex(gas_limit),
        "extraData": "0x" + "00" * 32 + between + "00" * 65 if period else "0x",
        "alloc": {address: {"balance": hex(wei)} for address, wei in balances.items()},
    }


class Node:
    """One geth, with its keys unlocked, as nobody may run it who has anything to lose.

    options: more of geth's command line. A value of None is a flag.
    """

    def __init__(self, program: str, folder: Path, signer: PrivateKey, options: Mapping[str, object]) -> None:
        self._options = options
        self._program, self._folder, self._signer = program, folder, signer
        self.signer = signer.public_key.to_checksum_address()
        self.http_port, self._peer_port, self._engine_port = (free_port() for _ in range(3))
        self.url = f"http://127.0.0.1:{self.http_port}"
        # The node's name in the network is a public key too; the signer's serves.
        self.enode = f"enode://{signer.public_key.to_hex()[2:]}@127.0.0.1:{self._peer_port}?discport=0"
        self._process: subprocess.Popen[bytes] | None = None
        (folder / "keystore").mkdir(parents=True)
        locked = Account.encrypt(signer.to_bytes(), _PASSWORD, kdf="pbkdf2", iterations=1)
        (folder / "keystore" / f"UTC--2026-01-01T00-00-00Z--{self.signer[2:].lower()}").write_text(json.dumps(locked))
        (folder / "password").write_text(_PASSWORD)
        (folder / "nodekey").write_text(signer.to_hex()[2:])

    @property
    def log(self) -> Path:
        return self._folder / "geth.log"

    def init(self, first_block: dict[str, Any]) -> None:
        file = self._folder / "genesis.json"
        file.write_text(json.dumps(first_block))
        subprocess.run([self._program, "init", "--datadir", str(self._folder), str(file)], capture_output=True,
                       check=True)

    def start(self) -> None:
        options = {
            "datadir": self._folder, "nodekey": self._folder / "nodekey", "networkid": CHAIN_ID, "syncmode": "full",
            "port": self._peer_port, "nat": "none", "netrestrict": "127.0.0.0/8", "authrpc.port": self._engine_port,
            "http.port": self.http_port, "http.api": "eth,net,web3,admin,miner,debug", "unlock": self.signer,
            "password": self._folder / "password", "miner.etherbase": self.signer, "miner.gasprice": 1, "cache": 64,
            "verbosity": 3,
            **dict.fromkeys(["nodiscover", "ipcdisable", "http", "allow-insecure-unlock", "txpool.nolocals"]),
            **self._options,
        }
        with self.log.open("ab") as log:
            self._process = subprocess.Popen(
                [self._program, *(f"--{k}" if v is None else f"--{k}={v}" for k, v in options.items())],
                stdin=subprocess.DEVNULL, stdout=log, stderr=log,
            )
        deadline = time.monotonic() + PATIENCE
        while True:
            try:
                self.request("eth_chainId")
                return
            except (OSError, RuntimeError) as failure:
                if self._process.poll() is not None or time.monotonic() > deadline:
                    raise RuntimeError(self.log.read_text(errors="replace")[-2000:]) from failure
                time.sleep(0.05)

    def request(self, method: str, *params: object) -> Any:
        """The result of any JSON-RPC call."""
        body: Any = {"jsonrpc": "2.0", "id": 1, "method": method, "params": params}
        answer = requests.post(self.url, json=body, timeout=5).json()
        if "error" in answer:
            raise RuntimeError(f"{method}: {answer['error']}")
        return answer["result"]

    def height(self) -> int:
        return int(self.request("eth_blockNumber"), 16)

    def restart(self) -> None:
        """An orderly end and a new start: what waited in its pool is gone."""
        if self._process is not None:
            self._process.terminate()
            self._process.wait(PATIENCE)
        self.start()

    def kill(self) -> None:
        """As a power cut would; what it had not written to its disk is gone."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()


class Network:
    """Nodes that know each other. Of three Clique signers two make blocks without the third (EIP-225).

    period: seconds between blocks. dag: by proof of work instead, with the dataset in this folder (`make_dag`); the
    first `miners` nodes mine with one thread each, the others follow.
    """

    def __init__(
        self, folder: Path, balances: Mapping[str, int], *, nodes: int = 3, period: int = 1, gas_limit: int = GAS_LIMIT,
        dag: Path | None = None, miners: int = 1,
    ) -> None:  # fmt: skip
        program = find_geth("clique" if dag is None else "ethash")
        keys = [new_key() for _ in range(nodes)]
        shared = {"miner.gaslimit": gas_limit}
        signing = shared | {"mine": None}
        mining = signing | {"miner.threads": 1, "ethash.dagdir": dag, "ethash.dagsinmem": 0, "ethash.dagsondisk": 1,
                            "ethash.dagslockmmap": "false"}  # fmt: skip
        roles = [signing if dag is None else mining if number < miners else shared for number in range(nodes)]
        self.nodes = [
            Node(program, folder / f"node-{number}", key, role)
            for number, (key, role) in enumerate(zip(keys, roles, strict=True))
        ]
        period = period if dag is None else 0
        self._patience = PATIENCE if dag is None else 15 * PATIENCE  # a block comes when it comes
        first_block = genesis([node.signer for node in self.nodes], balances, period, gas_limit)
        try:
            for node in self.nodes:
                node.init(first_block)
                node.start()
            self.connect()
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> Network:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        for node in self.nodes:
            node.kill()

    def connect(self) -> None:
        """Everybody to everybody; returns when all are."""
        for node in self.nodes:
            for other in self.nodes:
                if other is not node:
                    node.request("admin_addPeer", other.enode)
        self._await("the nodes are connected",
                    lambda: all(int(node.request("net_peerCount"), 16) == len(self.nodes) - 1 for node in self.nodes))

    def cut_off(self, node: Node) -> None:
        """`node` hears the others no more, nor they it, until `connect`."""
        others = [other for other in self.nodes if other is not node]

        def alone() -> bool:
            for other in others:  # again and again: a connection that was just being made outlives the order to drop it
                other.request("admin_removePeer", node.enode)
                node.request("admin_removePeer", other.enode)
            return int(node.request("net_peerCount"), 16) == 0

        self._await("the node is alone", alone)

    def await_blocks(self, count: int, node: Node | None = None) -> None:
        """Until so many more blocks are on top."""
        node = node or self.nodes[0]
        aim = node.height() + count
        self._await(f"{count} more blocks", lambda: node.height() >= aim)

    def _await(self, what: str, holds: Any) -> None:
        deadline = time.monotonic() + self._patience
        while not holds():
            if time.monotonic() > deadline:
                raise RuntimeError(f"{what}: not within {self._patience:.0f} s")
            time.sleep(0.05)

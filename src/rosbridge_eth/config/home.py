"""The folders the commands work in: what stands where at the operator's end, on a robot, and at a reader's.

Each has a `home.json` that says whose home it is; it is written last, so a home that was cut short is none: its
`.unfinished` is left, and who makes a home there starts again. While a shard of the server or a robot runs,
`.shard-0.json` or `.robot.json` is what it counts (metrics).

An operator's home (made by `init`); it holds no reader's key and no robot's:

    server.toml          settings of the server
    ca.crt.pem ca/       the CA's certificate, and its key, unless that is kept in a folder elsewhere
    server/              the server's identity; its keys, like the CA's, under the operator passphrase
    readers/NAME.pem     the certificates of those who may read; robots are given them
    accounts.json        the seed of all Ethereum accounts, under the same passphrase
    registry.sqlite      who is enrolled
    deployment.json      the contract, and the chain it is on (made by `deploy`)
    reader.toml          the same for readers, to be put beside their keys
    store-0.sqlite       the replica of their logs that shard 0 of the server has; store-1.sqlite and so on
    bundles/             what `register` writes for robots

A robot's home (made by `join`):

    robot.toml           its topics
    bridge.json          the server, and the ledger it writes to; absent until it has its bundle
    request.json         what it asks the operator to certify, where it made its own keys
    NAME.bundle          the operator's answer, which `robot` joins with and removes
    identity/            its keys, under its own password, its certificates, and the CA's
    readers/NAME.pem     who may read what it writes
    spool.sqlite         its replica of its log
    NAME.fire            an event that `trigger NAME` asks for; the robot takes it within a second and removes it
    clock                the latest time the server proved (seconds since 1970), for robots without a clock battery

A reader's home (made by `init` or `reader`, to be carried to the machine that reads):

    reader.toml          the ledger, the nodes, and where the rest is
    *.key.pem *.crt.pem  its keys, under its own passphrase, its certificates, and the CA's
    public.pem           its two certificates, for robots that shall seal for it
    grants/              what other readers granted to it
"""

from __future__ import annotations

import json
import shlex
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any, TypeVar

from rosbridge_eth.config.values import Address, parse_address
from rosbridge_eth.errors import BridgeError, ChainError, ConfigError
from rosbridge_eth.files import write_atomically
from rosbridge_eth.log.chunk import ledger_id, robot_id

_LATEST = 2**35  # seconds since 1970; a later time is a damaged file's
_FORMAT = "rosbridge-eth home 3"
_UNFINISHED = ".unfinished"
SERVER = "server"
"""The name in the certificate of every operator's server."""


class HomeKind(StrEnum):
    """Whose home a folder is."""

    OPERATOR = "operator"
    ROBOT = "robot"
    READER = "reader"


_WHOSE = {HomeKind.OPERATOR: "an operator's", HomeKind.ROBOT: "a robot's", HomeKind.READER: "a reader's"}


def shard_of(tk: bytes, shards: int) -> int:
    """To which of so many shards a robot belongs."""
    return int.from_bytes(tk, "big") % shards


def ledger_of(chain_id: int, genesis: str, contract: str) -> bytes:
    """chunk.ledger_id of a hash and an address in 0x-hex."""
    return ledger_id(chain_id, bytes.fromhex(genesis.removeprefix("0x")), bytes.fromhex(contract.removeprefix("0x")))


@dataclass(frozen=True, slots=True)
class Deployment:
    """A contract on a chain, which has it in `block`. The first block's hash and the address are 0x-hex."""

    chain_id: int
    genesis: str
    contract: str
    block: int

    @property
    def ledger(self) -> bytes:
        """What every signature of a log covers, 32 bytes (chunk.ledger_id)."""
        return ledger_of(self.chain_id, self.genesis, self.contract)


@dataclass(frozen=True, slots=True)
class BridgeEnd:
    """What a robot knows of the other end. `servers` has HOST:PORT of each shard; the ledger as in Deployment."""

    robot: str
    server_name: str
    servers: list[str]
    chain_id: int
    genesis: str
    contract: str

    @property
    def ledger(self) -> bytes:
        """As Deployment.ledger."""
        return ledger_of(self.chain_id, self.genesis, self.contract)

    def addresses(self) -> tuple[Address, Address]:
        """Where the server is to be asked: at the robot's shard, and else at the first one, which is always there.

        Where the number of shards is another by now, either says where the robot belongs."""
        shard = shard_of(robot_id(self.robot), len(self.servers))
        return parse_address(self.servers[shard]), parse_address(self.servers[0])


# JSON files

_Document = TypeVar("_Document")


def _save(path: Path, value: dict[str, Any]) -> None:
    write_atomically(path, json.dumps(value, indent=1).encode() + b"\n")


def _load(form: Callable[..., _Document], path: Path, fix: str, absent: BridgeError) -> _Document:
    """What is made of the object in a file. ConfigError with the fix where it is none; `absent` without a file."""
    try:
        return form(**json.loads(path.read_bytes()))
    except FileNotFoundError:
        raise absent from None
    except OSError as error:
        raise ConfigError(f"{path} cannot be read: {error.strerror}") from error
    except (ValueError, TypeError) as error:
        raise ConfigError(f"{path} is damaged ({error}); {fix}") from error


def make_home(path: Path, kind: HomeKind, **more: str) -> None:
    """Make a folder somebody's home, as the last step; `more` is kept with it (`home_of`)."""
    _save(path / "home.json", {"format": _FORMAT, "kind": str(kind), **more})


def home_of(path: Path, kind: HomeKind | None = None, fix: str = "") -> dict[str, Any]:
    """What `make_home` wrote. ConfigError where it is no home, of another edition, or not of this kind."""
    absent = ConfigError(
        f"{path} is not a home; `init --home` makes an operator's, `join` a robot's, `reader NAME` a reader's"
        if kind is None else f"{path} is not {_WHOSE[kind]} home; {fix}"
    )
    head = _load(dict[str, Any], path / "home.json", "restore it from your backup", absent)
    if head.get("format") != _FORMAT or head.get("kind") not in HomeKind.__members__.values():
        raise ConfigError(f"{path} was made by another version of this program; use that one, or make a new home")
    if kind is not None and head["kind"] != kind:
        raise ConfigError(f"{path} is {_WHOSE[HomeKind(head['kind'])]} home, not {_WHOSE[kind]}; give another --home")
    return head


def kind_of(path: Path) -> HomeKind:
    """Whose home this is; ConfigError if it is none."""
    return HomeKind(home_of(path)["kind"])


def require_empty(path: Path) -> None:
    """ConfigError unless nothing is there yet: a home is made in an empty folder."""
    if (path / "home.json").exists():
        raise ConfigError(f"{path} is {_WHOSE[kind_of(path)]} home already; choose another folder")
    if path.exists() and not (path / _UNFINISHED).exists() and (not path.is_dir() or any(path.iterdir())):
        raise ConfigError(f"{path} is not empty; choose another folder, or remove it")


@contextmanager
def new_home(path: Path) -> Iterator[None]:
    """An empty folder for a home, which is whole when the block ends; cut short, by a kill too, nothing of it counts.

    ConfigError where anything else is there.
    """
    require_empty(path)
    ours, mark = not path.exists(), path / _UNFINISHED
    path.mkdir(mode=0o700, parents=True, exist_ok=True)
    mark.touch()
    _clear(path)
    try:
        yield
    except BaseException:
        _clear(path)
        mark.unlink(missing_ok=True)
        if ours:
            path.rmdir()
        raise
    mark.unlink(missing_ok=True)


def _clear(path: Path) -> None:
    for each in path.iterdir():
        if each.is_dir() and not each.is_symlink():
            shutil.rmtree(each)
        elif each.name != _UNFINISHED:
            each.unlink()


class OperatorHome:
    """Paths of an operator's home; nothing here reads a secret."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.config = path / "server.toml"
        self.ca_certificate = path / "ca.crt.pem"
        self.server = path / "server"
        self.readers = path / "readers"
        self.accounts = path / "accounts.json"
        self.registry = path / "registry.sqlite"
        self.deployment_file = path / "deployment.json"
        self.reader_config = path / "reader.toml"
        self.bundles = path / "bundles"

    def store(self, shard: int) -> Path:
        return self.path / f"store-{shard}.sqlite"

    @property
    def ca(self) -> Path:
        """The folder of the CA's key and certificate; `init` may have been given another than ours."""
        return self.path / str(home_of(self.path).get("ca", "ca"))

    @property
    def account(self) -> str:
        """The operator's account on the chain, which accounts.json shows in the clear."""
        fix = "restore it from your backup"
        absent = ConfigError(f"{self.accounts} is missing; {fix}")
        return str(_load(dict[str, Any], self.accounts, fix, absent)["operator"])

    def require(self) -> OperatorHome:
        """This home, if `init` made it; else ConfigError."""
        home_of(self.path, HomeKind.OPERATOR, f"run `init --home {self.path}` first")
        return self

    def save_deployment(self, deployment: Deployment) -> None:
        _save(self.deployment_file, asdict(deployment))

    def deployment(self) -> Deployment:
        """ChainError where no contract is deployed yet."""
        absent = ChainError(f"no contract is deployed yet; run `deploy --home {self.path}`")
        return _load(Deployment, self.deployment_file, "restore it from your backup", absent)


class RobotHome:
    """Paths of a robot's home."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.config = path / "robot.toml"
        self.bridge_file = path / "bridge.json"
        self.request = path / "request.json"
        self.identity = path / "identity"
        self.readers = path / "readers"
        self.spool = path / "spool.sqlite"
        self.clock = path / "clock"

    @property
    def answer(self) -> Path:
        """Where the bundle that answers the request is put, for `robot` to join with."""
        return self.path / f"{self._head()['name']}.bundle"

    def _head(self) -> dict[str, Any]:
        return home_of(self.path, HomeKind.ROBOT, f"run `join --name NAME --home {self.path}` first")

    def event(self, trigger: str) -> Path:
        """The file that asks for it."""
        return self.path / f"{trigger}.fire"

    def save_bridge(self, end: BridgeEnd) -> None:
        _save(self.bridge_file, asdict(end))

    def bridge(self) -> BridgeEnd:
        """ConfigError where this is no robot's home, or it has not had its bundle yet."""
        self._head()
        absent = ConfigError(
            f"this robot has no certificates yet: carry {self.request} to the operator, whose `register` answers with"
            f" a bundle; put that into {self.path} and run `robot --home {shlex.quote(str(self.path))}`"
        )
        return _load(BridgeEnd, self.bridge_file, "join again", absent)

    def clock_floor(self) -> float:
        """The latest time (seconds since 1970) a server proved to this robot; 0 where there is none."""
        try:
            seconds = float(self.clock.read_text())
        except (OSError, ValueError):
            return 0.0
        return seconds if 0 <= seconds < _LATEST else 0.0

    def raise_clock_floor(self, seconds: float) -> None:
        if seconds > self.clock_floor():
            write_atomically(self.clock, f"{seconds:.0f}\n".encode())


class ReaderHome:
    """Paths of a reader's home."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.config = path / "reader.toml"
        self.public = path / "public.pem"
        self.grants = path / "grants"

    def require(self) -> ReaderHome:
        """This home, if it is a reader's; else ConfigError."""
        home_of(self.path, HomeKind.READER, "`init` makes the owner's and `reader NAME` makes another")
        return self

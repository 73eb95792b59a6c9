"""The folders the commands work in: what stands where at the operator's end, and what on the robot.

An operator's home (made by `init`):

    server.toml          settings of the server
    ca/ server/          the CA, and the server's identity; keys encrypted under the operator passphrase
    readers/NAME/        readers' identities made here; `init` makes `owner`. Each folder is a reader's home (below)
    accounts.json        the seed of all Ethereum accounts, under the same passphrase
    registry.sqlite      who is enrolled
    deployment.json      the contract, and the chain it is on (made by `deploy`)
    inbox.sqlite journal.sqlite     the server's store
    bundles/             what `register` writes for robots

A robot's home (made by `join`):

    robot.toml           its topics
    bridge.json          the server, the contract
    identity/            its keys, under the registration password, and the CA certificate
    readers/*.pem        who may read what it writes
    spool.sqlite         records not acknowledged yet
    clock                the latest time the server proved (seconds since 1970), for robots without a clock battery

A reader's home (made by `reader`, to be carried anywhere):

    reader.toml          contract, node, and where the rest is
    *.key.pem *.crt.pem  its keys, under its own passphrase, its certificates, and the CA's
    public.pem           its two certificates, for robots that shall seal for it
"""

from __future__ import annotations

import json
import os
import tempfile
from dataclasses import asdict, dataclass
from enum import StrEnum
from pathlib import Path

from rosbridge_eth.errors import ChainError, ConfigError


@dataclass(frozen=True, slots=True)
class Deployment:
    """A contract on a chain; `block` is the one that holds its creation. Hashes are 0x-hex."""

    chain_id: int
    genesis: str
    contract: str
    code_hash: str
    block: int


@dataclass(frozen=True, slots=True)
class BridgeEnd:
    """What a robot knows of the other end. `server_address` is HOST:PORT."""

    robot: str
    server_name: str
    server_address: str
    contract: str
    chain_id: int


def write_atomically(path: Path, content: bytes, *, mode: int = 0o644) -> None:
    """Write a file so that a crash leaves the old one or the new one, never half of it."""
    descriptor, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(descriptor, "wb") as stream:
            stream.write(content)
            stream.flush()
            os.fsync(stream.fileno())
        Path(temporary).chmod(mode)
        Path(temporary).replace(path)
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise


@dataclass(frozen=True, slots=True)
class OperatorHome:
    """Paths of an operator's home; nothing here reads a secret."""

    path: Path

    @property
    def config(self) -> Path:
        return self.path / "server.toml"

    @property
    def ca(self) -> Path:
        return self.path / "ca"

    @property
    def server(self) -> Path:
        return self.path / "server"

    @property
    def accounts(self) -> Path:
        return self.path / "accounts.json"

    @property
    def registry(self) -> Path:
        return self.path / "registry.sqlite"

    @property
    def inbox(self) -> Path:
        return self.path / "inbox.sqlite"

    @property
    def journal(self) -> Path:
        return self.path / "journal.sqlite"

    @property
    def submitter_lock(self) -> Path:
        return self.path / "submitter.lock"

    @property
    def bundles(self) -> Path:
        return self.path / "bundles"

    def reader(self, name: str) -> Path:
        return self.path / "readers" / name

    def require(self) -> OperatorHome:
        """This home, if `init` made it; else ConfigError."""
        if not self.config.exists():
            raise ConfigError(f"{self.path} is not an operator's home; run `init --home {self.path}` first")
        return self

    @property
    def deployment_file(self) -> Path:
        return self.path / "deployment.json"

    def save_deployment(self, deployment: Deployment) -> None:
        write_atomically(self.deployment_file, json.dumps(asdict(deployment), indent=1).encode() + b"\n")

    def deployment(self) -> Deployment:
        try:
            return Deployment(**json.loads(self.deployment_file.read_bytes()))
        except FileNotFoundError:
            raise ChainError(f"no contract is deployed yet; run `deploy --home {self.path}`") from None
        except (ValueError, TypeError) as error:
            raise ConfigError(f"{self.deployment_file} is damaged ({error}); run `deploy` again") from error


@dataclass(frozen=True, slots=True)
class RobotHome:
    """Paths of a robot's home."""

    path: Path

    @property
    def config(self) -> Path:
        return self.path / "robot.toml"

    @property
    def identity(self) -> Path:
        return self.path / "identity"

    @property
    def readers(self) -> Path:
        return self.path / "readers"

    @property
    def spool(self) -> Path:
        return self.path / "spool.sqlite"

    @property
    def clock(self) -> Path:
        return self.path / "clock"

    @property
    def bridge_file(self) -> Path:
        return self.path / "bridge.json"

    def save_bridge(self, end: BridgeEnd) -> None:
        write_atomically(self.bridge_file, json.dumps(asdict(end), indent=1).encode() + b"\n")

    def bridge(self) -> BridgeEnd:
        try:
            return BridgeEnd(**json.loads(self.bridge_file.read_bytes()))
        except FileNotFoundError:
            text = f"{self.path} is not a robot's home; run `join BUNDLE --home {self.path}` first"
            raise ConfigError(text) from None
        except (ValueError, TypeError) as error:
            raise ConfigError(f"{self.bridge_file} is damaged ({error}); join again") from error

    def clock_floor(self) -> float:
        """The latest time (seconds since 1970) a server proved to this robot; 0 where there is none."""
        try:
            return float(self.clock.read_text())
        except (FileNotFoundError, ValueError):
            return 0.0

    def raise_clock_floor(self, seconds: float) -> None:
        if seconds > self.clock_floor():
            write_atomically(self.clock, f"{seconds:.0f}\n".encode())


@dataclass(frozen=True, slots=True)
class ReaderHome:
    """Paths of a reader's home."""

    path: Path

    @property
    def config(self) -> Path:
        return self.path / "reader.toml"

    @property
    def public(self) -> Path:
        return self.path / "public.pem"


class HomeKind(StrEnum):
    """Whose home a folder is."""

    OPERATOR = "operator"
    ROBOT = "robot"
    READER = "reader"


def kind_of(path: Path) -> HomeKind:
    """Whose home this is, by the file that makes it one; ConfigError if it is nobody's."""
    if OperatorHome(path).config.exists():
        return HomeKind.OPERATOR
    if RobotHome(path).bridge_file.exists():
        return HomeKind.ROBOT
    if ReaderHome(path).config.exists():
        return HomeKind.READER
    raise ConfigError(
        f"{path} is nobody's home; `init --home` makes an operator's, `join BUNDLE --home` a robot's,"
        " `reader NAME` a reader's"
    )

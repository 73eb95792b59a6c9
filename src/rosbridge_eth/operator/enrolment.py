"""What an operator does: make a home, deploy the contract, certify robots and readers, end their rights, look after
the home.

Functions on homes, a CA, a keyring, a Ledger and a Store; the command line asks for passphrases and prints. Every
step that spans the registry, a file and the chain is ordered so that it can be run again after a crash between any two.
"""

from __future__ import annotations

import shutil
import socket
import sqlite3
import time
from collections.abc import Callable, Sequence
from contextlib import closing, suppress
from datetime import datetime
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import urlsplit

from rosbridge_eth import identity as ids
from rosbridge_eth.config import Address, ServerConfig, load_server_config, parse_config
from rosbridge_eth.config.values import parse_address
from rosbridge_eth.errors import ChainError, ConfigError, IdentityError, StoreError
from rosbridge_eth.files import read_file, write_atomically
from rosbridge_eth.identity import CertificateAuthority, Role, check_name
from rosbridge_eth.ledger import Keyring, Ledger, Standing
from rosbridge_eth.ledger.contract import WEI_PER_ETH
from rosbridge_eth.ledger.transport import ChainUnavailable, OutOfFunds, Reverted
from rosbridge_eth.log.chunk import MAX_READERS, robot_id
from rosbridge_eth.log.store import NOWHERE, Store
from rosbridge_eth.operator.bundle import Bundle, Request
from rosbridge_eth.operator.registry import OWNER, Registry
from smcrypto import InvalidKey, sm2

from rosbridge_eth.config.home import (  # isort: skip
    SERVER, BridgeEnd, Deployment, HomeKind, OperatorHome, ReaderHome, home_of, make_home, new_home, require_empty,
)  # fmt: skip

OPERATOR = "operator"  # what the treasury's account is called
HANDING_OVER = 2.0  # seconds after which no session of a name out of force is left: the server looks every second
SUCCESSION = 60.0  # seconds for what the old robot handed over to be confirmed
LAST_WRITES = 20.0  # the same, where a robot is revoked and not replaced: then its right ends all the same
_ANYWHERE = {"0.0.0.0": "192.0.2.1", "::": "2001:db8::1"}  # noqa: S104 - what is looked for; a far address


# The home


def own_address(listen: Address) -> Address:
    """Where others reach a socket that listens there: `listen`, or for any address that of the default route, and
    without one the loopback's."""
    if (far := _ANYWHERE.get(listen.host)) is None:
        return listen
    with socket.socket(listen.family, socket.SOCK_DGRAM) as probe, suppress(OSError):
        probe.connect((far, 9))  # sends nothing; chooses the route
        return listen._replace(host=probe.getsockname()[0])
    return listen._replace(host="::1" if ":" in listen.host else "127.0.0.1")


def server_toml(listen: Address, public: Address, chain_url: str) -> str:
    """The first server.toml of a home: what differs from the defaults, and where the rest is described."""
    told = f'public = "{public}"  # the address robots are given' if public.port else '# public = "HOST:PORT"'
    return (
        "# Settings of the server; docs/configuration.md describes every key.\n"
        f'listen = "{listen}"\n{told}\n\n[chain]\nurl = "{chain_url}"\n'
    )


def init_home(
    home: OperatorHome, passphrase: bytes, *, reader: ReaderHome, reader_passphrase: bytes, now: datetime,
    listen: str = "0.0.0.0:7410", public: str | None = None, chain_url: str = "http://127.0.0.1:8545",
    ca: Path | None = None, ca_passphrase: bytes | None = None, keys: Keyring | None = None,
) -> Keyring:  # fmt: skip
    """Make an operator's home: CA, server's identity, seed of the accounts; and the reader `owner` in its own folder.

    ca: the folder of the CA, which is made there unless it holds one (`ca.key.pem`, `ca.crt.pem`); without it, in the
    home. ca_passphrase: where it differs. keys: instead of a new seed.
    """
    require_empty(home.path)
    require_empty(reader.path)
    try:
        address = parse_address(listen)
        told = own_address(address) if public is None else parse_address(public)
        text = server_toml(address, told, chain_url)
    except ValueError as error:
        raise ConfigError(f"the address {error}") from error
    parse_config(ServerConfig, text, home.config)
    if home.path.resolve() == reader.path.resolve():
        raise ConfigError(f"{home.path} cannot be the reader's home as well; choose another folder for one of them")
    with new_home(home.path), new_home(reader.path):
        for folder in (home.bundles, home.readers):
            folder.mkdir(mode=0o700)
        authority = _make_ca(ca or home.path / "ca", ca_passphrase or passphrase, now)
        write_atomically(home.ca_certificate, authority.certificate.to_pem())
        keys = keys or Keyring.create()
        keys.save(home.accounts, passphrase)
        with Registry(home.registry, new=True) as registry:
            identity = ids.enrol(authority, Role.SERVER, SERVER, at=now)
            ids.save_identity(home.server, identity, [authority.certificate], passphrase)
            registry.enrol(identity.public, now)
            _make_reader(home, reader, OWNER, authority, reader_passphrase, now, registry)
        write_atomically(home.config, text.encode())
        elsewhere = {} if ca is None else {"ca": str(ca.absolute())}
        make_home(home.path, HomeKind.OPERATOR, **elsewhere, reader=str(reader.path.absolute()))
    return keys


def _make_ca(folder: Path, passphrase: bytes, now: datetime) -> CertificateAuthority:
    if not (folder / "ca.key.pem").exists() and not (folder / "ca.crt.pem").exists():
        made = ids.create_ca("rosbridge-eth CA", at=now)
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        write_atomically(folder / "ca.crt.pem", made.certificate.to_pem(), new=True)
        write_atomically(folder / "ca.key.pem", made.key.to_pem(passphrase), mode=0o600, new=True)
    return ids.load_ca(folder, passphrase, now)


def server_trust(home: OperatorHome, registry: Registry) -> ids.Trust:
    """Whom the server believes: certificates of the CA that are in force in the registry."""
    return ids.Trust(ids.read_certificates(read_file(home.ca_certificate)), allowed=registry.allows)


def load_server_identity(home: OperatorHome, passphrase: bytes) -> ids.Identity:
    return ids.load_identity(home.server, passphrase)[0]


def renew_server(home: OperatorHome, *, ca: CertificateAuthority, passphrase: bytes, now: datetime) -> Path:
    """Give the server new keys and certificates under its name; where the old ones are kept.

    Robots know the server by its name and the CA, so nothing changes for them. A running server goes on with the old
    ones until it is started again.
    """
    made = home.path / ".server.new"
    shutil.rmtree(made, ignore_errors=True)  # left by an attempt that was cut short
    old = home.path / f"server.until-{now:%Y%m%dT%H%M%S.%fZ}"
    with Registry(home.registry) as registry:
        identity = ids.enrol(ca, Role.SERVER, SERVER, at=now)
        ids.save_identity(made, identity, [ca.certificate], passphrase)
        if home.server.exists():
            home.server.rename(old)
        made.rename(home.server)
        registry.enrol(identity.public, now, replace=True)
    return old


def backup(path: Path, target: Path) -> None:
    """Copy a home, in use or not, into a new folder. Left out are a CA kept elsewhere, and a robot's spool: a log that
    goes on from an old copy would look forked."""
    home_of(path)
    if path.resolve() in target.resolve().parents:
        raise ConfigError(f"{target} lies in {path}, whose loss it shall outlast; choose a folder elsewhere")
    skipped = shutil.ignore_patterns("*.sqlite*", "*.lock", ".*", "home.json")
    with new_home(target):
        shutil.copytree(path, target, ignore=skipped, dirs_exist_ok=True)
        for database in path.glob("*.sqlite"):
            if (copy := target / database.name).name != "spool.sqlite":
                with closing(sqlite3.connect(database)) as ours, closing(sqlite3.connect(copy)) as theirs:
                    ours.backup(theirs)
                copy.chmod(0o600)
        shutil.copy2(path / "home.json", target)


def change_passphrase(path: Path, old: bytes, new: bytes) -> list[Path]:
    """Put the keys of a home under another passphrase; which files. Cut short, it is run again with the same two.

    A CA in a folder elsewhere keeps its own.
    """
    folder = {HomeKind.OPERATOR: "server", HomeKind.ROBOT: "identity", HomeKind.READER: "."}[home_of(path)["kind"]]
    files, changed = [file for name in (folder, "ca") for file in (path / name).glob("*.key.pem")], dict[Path, bytes]()
    if (accounts := OperatorHome(path).accounts).exists():
        files.append(accounts)
    for file in files:
        content = read_file(file, private=True)
        for passphrase in (old, new):  # what an attempt that was cut short wrote is under the new one
            with suppress(InvalidKey, IdentityError):
                if file == accounts:
                    changed[file] = Keyring.open(content, passphrase).seal(new)
                else:
                    changed[file] = sm2.PrivateKey.from_pem(content, passphrase).to_pem(new)
                break
        else:
            raise IdentityError(f"{file} does not open under this passphrase")
    for file, content in changed.items():
        write_atomically(file, content, mode=0o600)
    return list(changed)


# The contract


def deploy_contract(
    home: OperatorHome, where: Any, keys: Keyring, *, wait: float = 0.0, clock: Callable[[], float] = time.time,
    pause: Callable[[float], None] = time.sleep,
) -> Deployment:
    """Create the contract and write down where it is; ConfigError where one is written down already.

    where: a node's URL or a provider. wait: seconds for a node to answer and for ETH on the operator's account. One
    that an attempt before this one created, and could not write down, is found.
    """
    if home.deployment_file.exists():
        raise ConfigError(
            f"a contract is deployed already ({home.deployment().contract}); a second one would split the logs."
            f" Make another home, or move {home.deployment_file} away if that chain is gone"
        )
    last = clock() + wait
    while True:
        try:
            ledger = Ledger.created_by(where, keys.operator.address) or Ledger.deploy(where, keys.operator)[0]
            genesis = "0x" + ledger.genesis.hex()
            made = Deployment(ledger.chain_id, genesis, ledger.contract, ledger.block_number())
            break
        except (ChainUnavailable, OutOfFunds) as error:
            if clock() < last:
                pause(0.5)
            elif isinstance(error, OutOfFunds):
                raise OutOfFunds(
                    f"{error}: put at least 1 ETH on the operator's account {keys.operator.address} and deploy"
                    " again; it pays for the contract and for the robots"
                ) from error
            else:
                raise
    home.save_deployment(made)
    url = urlsplit(load_server_config(home.config).chain.url)
    # Of the operator's node only scheme, host and port: what else stands in a URL is often a key.
    node = f"{url.scheme}://{url.netloc.rpartition('@')[2]}"
    write_atomically(home.reader_config, _reader_toml(made, node).encode())
    owner = Path(home_of(home.path)["reader"])
    if (owner / "home.json").exists():  # it may have been carried away
        write_atomically(ReaderHome(owner).config, home.reader_config.read_bytes())
    return made


def _reader_toml(ledger: Deployment, node: str) -> str:
    return (
        "# A reader: put this beside its keys. docs/configuration.md describes every key.\n"
        f'contract = "{ledger.contract}"\n'
        f"chain_id = {ledger.chain_id}\n"
        f'genesis = "{ledger.genesis}"\n'
        f'chain = ["{node}"]  # any nodes of this chain\n'
    )


# Readers


def add_reader(
    home: OperatorHome, name: str, reader: ReaderHome, *, ca: CertificateAuthority, passphrase: bytes, now: datetime,
    replace: bool = False,
) -> None:
    """Make another reader in a folder of its own; robots that are registered from now on seal for it, too.

    replace: take a used name over. What was sealed for the old one only its own keys open.
    """
    check_name(name)
    with new_home(reader.path), Registry(home.registry) as registry:
        if not replace:
            registry.require_free(Role.READER, name)
        if len({name, *(known.name for known in registry.readers())}) > MAX_READERS:
            raise IdentityError(f"a chunk can be sealed for {MAX_READERS} readers; more people share a reader's key")
        _make_reader(home, reader, name, ca, passphrase, now, registry, replace=replace)


def _make_reader(
    home: OperatorHome, reader: ReaderHome, name: str, ca: CertificateAuthority, passphrase: bytes, now: datetime,
    registry: Registry, *, replace: bool = False,
) -> None:  # fmt: skip
    identity = ids.enrol(ca, Role.READER, name, at=now)
    ids.save_identity(reader.path, identity, [ca.certificate], passphrase)
    write_atomically(reader.public, identity.public.pem)
    if home.reader_config.exists():
        write_atomically(reader.config, home.reader_config.read_bytes())
    registry.enrol(identity.public, now, replace=replace)
    write_atomically(home.readers / f"{name}.pem", identity.public.pem)
    make_home(reader.path, HomeKind.READER, name=name)


# Robots


class Registered(NamedTuple):
    """A robot that was registered: its account, the block, the bundle's file.

    buried: chunks of the one that bore the name before which became dead letters. readers: for whom the robot seals.
    """

    account: str
    block: int
    bundle: Path
    buried: int
    readers: Sequence[str]


def register_robot(
    home: OperatorHome, name: str, *, ca: CertificateAuthority, keys: Keyring, ledger: Ledger,
    inbox: Callable[[], Store], now: datetime, request: Request | None = None, password: bytes | None = None,
    replace: bool = False, compromised: bool = False, pause: Callable[[float], None] = time.sleep,
) -> Registered:  # fmt: skip
    """Bind a name to certificates and an account, on the chain and in the registry, and write the bundle.

    request: of the robot that made its own keys. Without it they are made here, and the bundle is sealed under
    `password` (the paper's easy_register); whoever made them can sign as the robot.

    replace: take a used name over. The old robot ends first, and for SUCCESSION seconds what it handed over is waited
    for, since afterwards it would count as written after its end; StoreError if it is not confirmed by then.
    compromised: it becomes dead letters instead. inbox: opened where there is something to replace; pause: waits.
    The chain comes before the registry: a crash in between leaves a registration that `replace` replaces.
    """
    config, tk = load_server_config(home.config), robot_id(check_name(name))
    if name == OPERATOR:
        raise IdentityError(f"{name!r} is what the treasury's account is called; choose another name for the robot")
    if request is None and not password:
        raise IdentityError("a robot is registered by its request, or under a password that seals the keys made here")
    if request and request.name != name:
        raise IdentityError(f"the request is of {request.name!r}, not of {name!r}; register it under its own name")
    there = home.deployment()
    servers = [str(address) for address in config.addresses()]
    end = BridgeEnd(name, SERVER, servers, there.chain_id, there.genesis, there.contract)
    with Registry(home.registry) as registry:
        [standing] = ledger.standings([tk])
        if not replace:
            registry.require_free(Role.ROBOT, name)
            if standing.account is not None:
                raise IdentityError(
                    f"robot {name!r} was revoked; give --replace to enrol it again, with a new account and new keys"
                    if standing.revoked else
                    f"the contract knows a robot {name!r} that the registry does not; give --replace to take it over"
                )
        if request is None:
            identity = ids.enrol(ca, Role.ROBOT, name, at=now)
            peer, files = identity.public, ids.identity_files(identity, [ca.certificate], password)
        else:
            peer = ids.enrol_requests(ca, Role.ROBOT, name, request.signing, request.encryption, at=now)
            files = ids.certificate_files(peer, [ca.certificate])
        buried = 0
        if standing.account is not None:
            registry.revoke(Role.ROBOT, name, now)
            left = 0 if standing.revoked else _waiting(inbox, tk, 0.0 if compromised else SUCCESSION, pause)
            if left and not compromised:
                raise StoreError(
                    f"{left} chunks that the old {name!r} handed to the server are not confirmed on the chain yet, and"
                    " would count as written after its end: let the server run and register again, or give them up"
                    " with --compromised"
                )
            if compromised or standing.revoked:
                buried = _bury(inbox, ledger, tk, f"{name} was replaced")
        number, account, block = _register(registry, ledger, keys, tk, peer.certificates, standing)
        registry.enrol(peer, now, number=number, account=account, replace=replace)
        readers = {
            reader.name: reader.certificates.decode() for reader in registry.readers()
            if now <= ids.public_identity(reader.certificates).not_after
        }  # fmt: skip
    text = {file: content.decode() for file, content in files.items()}
    private = {file: text.pop(file) for file in ids.KEY_FILES if file in text}
    made = Bundle(end, text, readers, private).signed(ca.key)
    path = home.bundles / f"{name}.bundle"
    write_atomically(path, made.encode(password), mode=0o600 if made.keys else 0o644)
    with suppress(ChainError):  # then the server gives it some with its first chunk
        if ledger.balance(account) < int(config.funds.below * WEI_PER_ETH):
            ledger.alloc_eth(keys.operator, account, int(config.funds.by * WEI_PER_ETH))
    return Registered(account, block, path, buried, sorted(readers))


def _register(
    registry: Registry, ledger: Ledger, keys: Keyring, tk: bytes, certificates: bytes, standing: Standing
) -> tuple[int, str, int]:
    """Register on the chain with the next account that serves no other robot: number, account and block."""
    put = ledger.registration if standing.account is None else ledger.replace_registration
    number = registry.next_number()
    while True:
        account = keys.account(number).address
        try:
            return number, account, put(keys.operator, tk, account, certificates).block
        except Reverted as refused:
            if refused.name != "AccountInUse":  # by a robot that a registry from an older backup does not know
                raise
            number += 1


def _waiting(inbox: Callable[[], Store], tk: bytes, patience: float, pause: Callable[[float], None]) -> int:
    """Wait until the server closed the session of a robot out of force, and up to `patience` seconds until what it
    handed over is confirmed; how many chunks are not by then."""
    pause(HANDING_OVER)
    with closing(inbox()) as store:
        while (left := store.waiting(tk).chunks) and patience > 0:
            pause(0.2)
            patience -= 0.2
    return left


def _bury(inbox: Callable[[], Store], ledger: Ledger, tk: bytes, why: str) -> int:
    """What the chain does not have of this robot becomes dead letters; how many chunks."""
    [standing] = ledger.standings([tk])
    buried = 0
    with closing(inbox()) as store:
        tail = store.find(tk, standing.tail) or NOWHERE
        while rows := store.rows(tk, tail, 200):
            store.remove(tk, [row.place for row in rows], why)
            buried += len(rows)
    return buried


class Revoked(NamedTuple):
    """block: where the contract ended a robot's right to write; None for others, and where it had none.

    buried: chunks that the server has, that are not on the chain, and that became dead letters.
    """

    block: int | None
    buried: int = 0


def revoke(
    home: OperatorHome, role: Role, name: str, *, keys: Keyring, ledger: Ledger, inbox: Callable[[], Store],
    now: datetime, compromised: bool = False, pause: Callable[[float], None] = time.sleep,
) -> Revoked:  # fmt: skip
    """Take a name out of force: the server closes its session at once, the contract ends its right to write.

    The registry comes first: from then on the server refuses the name, whatever the chain does. What the server has
    of it is given LAST_WRITES seconds to be written, none with `compromised`; the rest becomes dead letters. Run it
    again for chunks that were stored after it.
    ChainError, StoreError: half done; it is run again when node and store answer.
    """
    with Registry(home.registry) as registry:
        known = any(enrolment.name == name for enrolment in registry.all(role))
        in_force = registry.revoke(role, name, now)
    nobody = IdentityError(f"no {role} {name!r} is in force; `status` lists them")
    if role is not Role.ROBOT:
        if known and role is Role.READER:  # also where it was cut short before
            (home.readers / f"{name}.pem").unlink(missing_ok=True)
        if not in_force:
            raise nobody
        return Revoked(None)
    tk = robot_id(name)
    try:
        ledger.check()
        [standing] = ledger.standings([tk])
        ended = standing.account is None or standing.revoked
        if ended and not known:
            raise nobody
        if in_force or not ended:
            _waiting(inbox, tk, 0.0 if compromised or ended else LAST_WRITES, pause)
        buried = _bury(inbox, ledger, tk, f"{name} was revoked")
        if ended and not in_force and not buried:
            raise nobody
        return Revoked(None if ended else ledger.revoke_robot(keys.operator, tk).block, buried)
    except (ChainError, StoreError) as error:
        raise type(error)(
            f"half done: the server takes nothing from {name} any more, but chain or store did not follow ({error});"
            f" run `revoke {name}` again when they answer"
        ) from error

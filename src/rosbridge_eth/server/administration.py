"""What an operator does: make a home, deploy the contract, enrol and revoke, look after accounts.

Functions on an operator's home and a chain; the command line asks for
passphrases and prints. Every step that spans the registry, a file and the
chain is ordered so that it can be run again after a crash between any two.
"""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import datetime
from itertools import chain as one_after_another
from itertools import count
from pathlib import Path
from urllib.parse import urlsplit

from rosbridge_eth.bundle import Bundle, seal_bundle
from rosbridge_eth.config import ServerConfig, load_server_config
from rosbridge_eth.errors import ConfigError, IdentityError, StoreError
from rosbridge_eth.home import Deployment, OperatorHome, ReaderHome, write_atomically
from rosbridge_eth.identity import (
    CertificateAuthority,
    Identity,
    PeerIdentity,
    Role,
    Trust,
    check_name,
    create_ca,
    enrol,
    enrol_requests,
    identity_files,
    load_identity,
    read_certificates,
    save_identity,
)
from rosbridge_eth.ledger import Chain, Contract, deploy
from rosbridge_eth.ledger.accounts import Keyring
from rosbridge_eth.ledger.journal import Attempt, Binding
from rosbridge_eth.ledger.states import State
from rosbridge_eth.reading import join_certificates
from rosbridge_eth.records import robot_id
from rosbridge_eth.registry import OWNER, Enrolment, Registry
from rosbridge_eth.server.assembly import open_inbox, open_journal
from rosbridge_eth.server.worker import LOOK_AT_LIST
from smcrypto import InvalidKey, sm2, x509

GIVEN_UP = "given up by `revoke {}`"  # the reason of dead letters
ACCOUNTS_TRIED = 1000
OPERATOR = "operator"  # what `export` and the figures call the treasury's account
COUNTED = 1000  # records
GIVE_UP_AT_ONCE = 256  # records
HANDING_OVER = 2 * LOOK_AT_LIST  # seconds after which no session of a name out of force is left
SUCCESSION = 60.0  # seconds for what the old robot handed over to be confirmed
LAST_WRITES = 20.0  # the same, where a robot is revoked and not replaced: then its right ends all the same
_WEI = 10**18


def server_toml(listen: str, public: str | None, chain_url: str, name: str) -> str:
    """The first server.toml of a home: what differs from the defaults, and where the rest is described."""
    lines = [
        "# Settings of the server; docs/configuration.md describes every key.",
        f'listen = "{listen}"',
        *([f'public = "{public}"'] if public else ['# public = "HOST:PORT"  # the address robots are given']),
        f'name = "{name}"',
        "",
        "[chain]",
        f'url = "{chain_url}"',
    ]
    return "\n".join(lines) + "\n"


def init_home(
    home: OperatorHome, passphrase: bytes, *, listen: str, public: str | None, chain_url: str, server: str,
    now: datetime,
) -> None:
    """Make an operator's home: CA, server's identity, seed of the accounts, the owner's reader key.

    server.toml comes last, so that a home that was cut short is no home and can be made again elsewhere.
    """
    if home.path.exists() and any(home.path.iterdir()):
        raise ConfigError(f"{home.path} is not empty; choose another folder, or remove it")
    check_name(server)
    home.path.mkdir(mode=0o700, parents=True, exist_ok=True)
    ca = create_ca("rosbridge-eth CA", at=now)
    home.ca.mkdir(mode=0o700)
    write_atomically(home.ca / "ca.key.pem", ca.key.to_pem(passphrase), mode=0o600)
    write_atomically(home.ca / "ca.crt.pem", ca.certificate.to_pem())
    home.bundles.mkdir(mode=0o700)
    registry = Registry(home.registry, new=True)
    _enrol(home, registry, ca, Role.SERVER, server, home.server, passphrase, now)
    owner = _enrol(home, registry, ca, Role.READER, OWNER, home.reader(OWNER), passphrase, now)
    _publish_reader(home.reader(OWNER), owner)
    registry.close()
    Keyring.create().save(home.accounts, passphrase)
    write_atomically(home.config, server_toml(listen, public, chain_url, server).encode())


def _enrol(
    home: OperatorHome, registry: Registry, ca: CertificateAuthority, role: Role, name: str, folder: Path,
    passphrase: bytes, now: datetime,
) -> Identity:
    identity = enrol(ca, role, name, at=now)
    save_identity(folder, identity, [ca.certificate], passphrase)
    _register(registry, identity.public, None, now, replace=False)
    return identity


def _register(
    registry: Registry, peer: PeerIdentity, account: str | None, now: datetime, *, replace: bool,
    number: int | None = None,
) -> Enrolment:
    return registry.enrol(
        number=registry.next_number() if number is None else number,
        role=peer.role,
        name=peer.name,
        fingerprint=peer.signing_certificate.fingerprint(),
        certificates=peer.signing_certificate.to_pem() + peer.encryption_certificate.to_pem(),
        account=account,
        now=now,
        replace=replace,
    )


def load_ca(home: OperatorHome, passphrase: bytes) -> CertificateAuthority:
    """The CA with its key. IdentityError for a wrong passphrase."""
    key_file = home.ca / "ca.key.pem"
    try:
        key = sm2.PrivateKey.from_pem(key_file.read_bytes(), password=passphrase)
    except OSError as error:
        raise IdentityError(f"{key_file} cannot be read: {error.strerror}") from error
    except InvalidKey as error:
        raise IdentityError(f"{key_file} does not open under this passphrase") from error
    return CertificateAuthority(key, ca_certificate(home))


def ca_certificate(home: OperatorHome) -> x509.Certificate:
    path = home.ca / "ca.crt.pem"
    try:
        return read_certificates(path.read_bytes())[0]
    except OSError as error:
        raise IdentityError(f"{path} cannot be read: {error.strerror}") from error


def server_trust(home: OperatorHome, registry: Registry) -> Trust:
    """Whom the server believes: certificates of the CA that are in force in the registry."""
    return Trust(
        roots=[ca_certificate(home)],
        allowed=lambda peer: registry.allows(peer.role, peer.name, peer.signing_certificate.fingerprint()),
    )


def deploy_contract(home: OperatorHome, chain: Chain, operator: Keyring) -> Deployment:
    """Create the contract and write down where it is; ConfigError where one is written down already."""
    if home.deployment_file.exists():
        raise ConfigError(
            f"a contract is deployed already ({home.deployment().contract}); a second one would split the records."
            f" Make another home, or move {home.deployment_file} away if that chain is gone"
        )
    contract = deploy(chain, operator.operator)
    deployment = _deployment(contract)
    home.save_deployment(deployment)
    registry = Registry(home.registry)
    try:
        names = [reader.name for reader in readers(registry)]
    finally:
        registry.close()
    for name in names:
        write_reader_toml(home, home.reader(name))
    return deployment


def _deployment(contract: Contract) -> Deployment:
    binding = Binding.of(contract)
    return Deployment(
        binding.chain_id, "0x" + binding.genesis.hex(), contract.address, "0x" + binding.code_hash.hex(),
        contract.chain.head().number,
    )


@dataclass(frozen=True, slots=True)
class Registered:
    """A robot that was registered: its account, the block, and the bundle's file.

    given_up: records that the name's revoked identity had handed over and that became dead letters.
    """

    name: str
    account: str
    block: int
    bundle: Path
    given_up: int = 0


def register_robot(
    home: OperatorHome,
    name: str,
    *,
    ca: CertificateAuthority,
    keys: Keyring,
    chain: Chain,
    password: bytes,
    now: datetime,
    replace: bool = False,
    requests: tuple[x509.CertificateSigningRequest, x509.CertificateSigningRequest] | None = None,
    clock: Callable[[], float] = time.time,
    pause: Callable[[float], None] = time.sleep,
) -> Registered:
    """Bind a name to certificates and an account, on the chain and in the registry, and write the bundle.

    requests: the robot's own certificate requests (signing, encryption); its
    keys never come here then. The chain comes before the registry: a crash in
    between leaves a registration that `replace` replaces. A robot that is
    replaced ends first, and what it handed over is written under its own name:
    later it would be a revoked identity's. clock, pause: the wall clock, to wait for that.
    """
    config, deployment = load_server_config(home.config), home.deployment()
    check_name(name)
    if name == OPERATOR:
        raise IdentityError(f"{name!r} is what the treasury's account is called; choose another name for the robot")
    registry = Registry(home.registry)
    try:
        if not replace:
            registry.require_free(Role.ROBOT, name)
        contract = Contract.at(chain, deployment.contract)
        number, account = _next_account(registry, contract, keys, name)
        if requests is None:
            identity = enrol(ca, Role.ROBOT, name, at=now)
            peer, files = identity.public, identity_files(identity, [ca.certificate], password)
        else:
            peer = enrol_requests(ca, Role.ROBOT, name, *requests, at=now)
            files = {
                "sign.crt.pem": peer.signing_certificate.to_pem(),
                "enc.crt.pem": peer.encryption_certificate.to_pem(),
                "ca.crt.pem": ca.certificate.to_pem(),
            }
        certificates = join_certificates(peer.signing_certificate.to_der(), peer.encryption_certificate.to_der())
        before = contract.robot(robot_id(name))
        if before.registered and not replace:
            raise IdentityError(_taken(name, before.may_write))
        if replace and before.may_write:
            if registry.find(Role.ROBOT, name) is not None:
                registry.revoke(Role.ROBOT, name, now)
            if left := _not_written(home, config, name, SUCCESSION, clock, pause):
                raise StoreError(
                    f"{left} records that the old {name!r} handed to the server are not on the chain yet, and would"
                    " count as written after its end: let the server run and register again, or give those records up"
                    f" with `revoke {name}` first"
                )
        given_up = 0
        if before.registered and not before.may_write:
            if registry.find(Role.ROBOT, name) is not None:
                registry.revoke(Role.ROBOT, name, now)
            given_up = _give_up(home, config, registry, name, chain, clock, pause)
        call = "replaceRegistration" if before.registered else "registration"
        receipt = contract.transact(keys.operator, call, robot_id(name), account, certificates)
        allot(contract, keys, account, config)
        _register(registry, peer, account, now, replace=replace, number=number)
        bundle = Bundle(
            name=name,
            identity={file: content.decode() for file, content in files.items()},
            server_name=config.name,
            server_address=str(config.public or config.listen),
            readers=tuple(reader.certificates.decode() for reader in readers(registry)),
            contract=deployment.contract,
            chain_id=deployment.chain_id,
        )
    finally:
        registry.close()
    path = home.bundles / f"{name}.bundle"
    write_atomically(path, seal_bundle(bundle, password), mode=0o600)
    return Registered(name, account, receipt.block_number, path, given_up)


def _taken(name: str, may_write: bool) -> str:
    """Why a name that the registry has not in force cannot be had without `replace`."""
    if may_write:
        return f"the contract knows a robot {name!r} that the registry does not; give --replace to take the name over"
    return f"robot {name!r} was revoked; give --replace to enrol the name anew, with a new account and new keys"


def _next_account(registry: Registry, contract: Contract, keys: Keyring, name: str) -> tuple[int, str]:
    """The next number and its account. Those that the contract bound to other robots are left out.

    A registry from an older backup does not know them. An account that the contract bound to this very name is one
    that a registration which was cut short left.
    """
    first = registry.next_number()
    for number in range(first, first + ACCOUNTS_TRIED):
        account = keys.robot(number).address
        if contract.robot_of(account) in (bytes(32), robot_id(name)):
            return number, account
    raise StoreError(
        f"the contract knows the accounts {first} to {first + ACCOUNTS_TRIED - 1} of this home and the registry does"
        " not: restore registry.sqlite from a newer backup"
    )


def _give_up(
    home: OperatorHome,
    config: ServerConfig,
    registry: Registry,
    name: str,
    chain: Chain,
    clock: Callable[[], float],
    pause: Callable[[float], None],
) -> int:
    """Make dead letters of what a revoked robot handed over and the chain does not have; how many records.

    The account of the name's next identity would write them, and readers would find records of a revoked one. A
    server may run meanwhile. From the inbox to the journal first, then what is in the journal, so that a record that
    is sealed in between is found there; each step can be done again.
    """
    robot, reason = robot_id(name), GIVEN_UP.format(name)
    ended = [e for e in registry.all(Role.ROBOT) if e.name == name]
    closed = max((e.revoked_at.timestamp() for e in ended if e.revoked_at is not None), default=0.0) + HANDING_OVER
    pause_for = min(closed - clock(), HANDING_OVER)
    if pause_for > 0:
        pause(pause_for)
    inbox, journal = open_inbox(config, home), open_journal(home, home.deployment())
    buried = 0
    try:
        while held := inbox.held(robot, GIVE_UP_AT_ONCE):
            with journal.transaction():
                known = journal.known(record.id for record in held)
                for record in held:
                    if record.id not in known:
                        journal.bury(record, reason, clock())
                        buried += 1
            inbox.done([record.id for record in held], clock())
        nonces = {(job.account, job.nonce) for job in journal.jobs()
                  if job.robot == robot and job.account is not None and job.nonce is not None}
        spent = {(account, nonce) for account, nonce in nonces if _written(chain, journal.attempts(account, nonce))}
        accounts = [e.account for e in ended if e.account is not None]
        buried += journal.give_up(robot, accounts, spent, reason, clock())
    finally:
        inbox.close()
        journal.close()
    return buried


def _written(chain: Chain, attempts: Sequence[Attempt]) -> bool:
    """Is one of these transactions in a block, and did it do what it was for?"""
    receipts = chain.receipts([attempt.hash for attempt in attempts])
    return any(receipt is not None and receipt.succeeded for receipt in receipts)


def _not_written(
    home: OperatorHome,
    config: ServerConfig,
    name: str,
    patience: float,
    clock: Callable[[], float],
    pause: Callable[[float], None],
) -> int:
    """Wait until all that a robot out of force handed to the server is confirmed; how many records are not by then.

    Of those in the inbox at most COUNTED are counted.
    """
    inbox, journal = open_inbox(config, home), open_journal(home, home.deployment())
    robot, last = robot_id(name), clock() + HANDING_OVER

    def left(limit: int) -> int:
        ids = [record.id for record in inbox.held(robot, limit)]  # before the journal: that is how records go
        sealed = sum(job.count for job in journal.jobs() if job.robot == robot and job.state is not State.SPLIT)
        return sealed + len(set(ids) - journal.known(ids))

    try:
        while (now := clock()) < last + patience:
            if now >= last and left(1) == 0:
                return 0
            pause(0.2)
        return left(COUNTED)
    finally:
        inbox.close()
        journal.close()


def allot(contract: Contract, keys: Keyring, account: str, config: ServerConfig) -> None:
    """Give a robot's account its first ETH, so that its first write need not wait; later the submitter does."""
    if contract.chain.balance(account) < int(config.funds.below * _WEI):
        contract.transact(keys.operator, "allocETH", account, value=int(config.funds.by * _WEI))


def readers(registry: Registry) -> Sequence[Enrolment]:
    """The readers in force."""
    return [reader for reader in registry.all(Role.READER) if reader.revoked_at is None]


@dataclass(frozen=True, slots=True)
class EnrolledReader:
    """A reader's home, and where the one that bore its name before is kept, if there was one."""

    folder: Path
    old: Path | None


def enrol_reader(
    home: OperatorHome, name: str, *, ca: CertificateAuthority, password: bytes, now: datetime, replace: bool = False
) -> EnrolledReader:
    """Make another reader's home; robots that are registered from now on seal for it too.

    replace: take a used name over. What was sealed for the old one only it can read, so its folder is kept aside.
    """
    check_name(name)
    folder = home.reader(name)
    registry = Registry(home.registry)
    try:
        if not replace:
            registry.require_free(Role.READER, name)
            if folder.exists():
                raise IdentityError(
                    f"{folder} is a revoked reader's; choose another name, or give --replace to make {name!r} anew and"
                    " keep that folder aside"
                )
        had = folder.exists()
        identity = enrol(ca, Role.READER, name, at=now)
        with _taking_the_place_of(folder, now) as (made, old):
            save_identity(made, identity, [ca.certificate], password)
            _publish_reader(made, identity)
            if home.deployment_file.exists():
                write_reader_toml(home, made)
        _register(registry, identity.public, None, now, replace=replace)
    finally:
        registry.close()
    return EnrolledReader(folder, old if had else None)


def _publish_reader(folder: Path, reader: Identity) -> None:
    """The certificates by which robots seal for this reader, in one file."""
    certificates = reader.signing_certificate.to_pem() + reader.encryption_certificate.to_pem()
    write_atomically(ReaderHome(folder).public, certificates)


def write_reader_toml(home: OperatorHome, folder: Path) -> None:
    """Make the folder of a reader one that can be carried elsewhere; needs the contract."""
    deployment, node = home.deployment(), urlsplit(load_server_config(home.config).chain.url)
    # Of the operator's node only scheme, host and port: what else stands in a URL is often a key.
    host = f"{node.scheme}://{node.netloc.rpartition('@')[2]}" if node.scheme else "http://127.0.0.1:8545"
    write_atomically(
        ReaderHome(folder).config,
        (
            "# A reader: rosbridge-eth read ROBOT --config reader.toml. docs/configuration.md describes every key.\n"
            f'contract = "{deployment.contract}"\n'
            'ca = "ca.crt.pem"\n'
            'identity = "."\n'
            f'chain = "{host}"  # any node of chain {deployment.chain_id}\n'
        ).encode(),
    )


@dataclass(frozen=True, slots=True)
class Revoked:
    """block: where the contract ended a robot's right to write; None for others, and where it had none.

    not_written: records of it that the server has, that are not on the chain, and that now never will be.
    """

    block: int | None
    not_written: int = 0


def revoke(
    home: OperatorHome,
    role: Role,
    name: str,
    *,
    keys: Keyring,
    chain: Chain,
    now: datetime,
    clock: Callable[[], float] = time.time,
    pause: Callable[[float], None] = time.sleep,
) -> Revoked:
    """Take a name out of force: the server closes its session at once, the contract ends its right to write.

    The registry comes first: from then on the server refuses the name, whatever the chain does. What the server
    acknowledged before is given LAST_WRITES seconds to be written; clock, pause: the wall clock, to wait for that.
    """
    registry = Registry(home.registry)
    try:
        in_force = registry.find(role, name)
        if in_force is None and role is not Role.ROBOT:
            raise IdentityError(f"no {role} {name!r} is enrolled; `status` lists the names")
        if in_force is not None:
            registry.revoke(role, name, now)
    finally:
        registry.close()
    if role is not Role.ROBOT:
        return Revoked(None)
    contract = Contract.at(chain, home.deployment().contract)
    if not contract.robot(robot_id(name)).may_write:
        if in_force is None:
            raise IdentityError(f"no robot {name!r} is enrolled; `status` lists the names")
        return Revoked(None)
    not_written = _not_written(home, load_server_config(home.config), name, LAST_WRITES, clock, pause)
    return Revoked(contract.transact(keys.operator, "revokeRobot", robot_id(name)).block_number, not_written)


def renew_server(home: OperatorHome, *, ca: CertificateAuthority, passphrase: bytes, now: datetime) -> Path:
    """Give the server new keys and certificates under its name; where the old ones are kept.

    Robots know the server by its name and the CA, so nothing changes for them.
    A running server goes on with the old ones until it is started again.
    """
    registry = Registry(home.registry)
    try:
        identity = enrol(ca, Role.SERVER, load_server_config(home.config).name, at=now)
        with _taking_the_place_of(home.server, now) as (made, old):
            save_identity(made, identity, [ca.certificate], passphrase)
        _register(registry, identity.public, None, now, replace=True)
    finally:
        registry.close()
    return old


@contextmanager
def _taking_the_place_of(folder: Path, now: datetime) -> Iterator[tuple[Path, Path]]:
    """A folder to fill, which takes the place of `folder` at the end, and where `folder` is kept aside then.

    Neither's name is one that a reader may have. Cut short, nothing or an empty place is left, and it is done again.
    """
    made = folder.with_name(f".{folder.name}.new")
    old = _free_name(folder.with_name(f"{folder.name}.until-{now:%Y%m%dT%H%M%SZ}"))
    shutil.rmtree(made, ignore_errors=True)  # left by an attempt that was cut short
    try:
        yield made, old
        if folder.exists():
            folder.rename(old)
        made.rename(folder)
    except BaseException:
        shutil.rmtree(made, ignore_errors=True)
        raise


def _free_name(path: Path) -> Path:
    """This name, or where it is taken the first of `-2`, `-3`, … that is not."""
    others = (path.with_name(f"{path.name}-{n}") for n in count(2))
    return next(name for name in one_after_another((path,), others) if not name.exists())


def load_server_identity(home: OperatorHome, passphrase: bytes) -> Identity:
    identity, _ = load_identity(home.server, passphrase)
    return identity

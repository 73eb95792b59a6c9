"""Putting a server together from its home and its configuration."""

from __future__ import annotations

import os
import socket
import time
from collections.abc import Callable
from datetime import UTC, datetime
from typing import TYPE_CHECKING

from rosbridge_eth import ledger
from rosbridge_eth.channel import Mode, Server, cookie_key
from rosbridge_eth.channel import ServerConfig as ChannelServerConfig
from rosbridge_eth.channel.udp import UdpLoop
from rosbridge_eth.config import ServerConfig
from rosbridge_eth.errors import ChainError, ConfigError
from rosbridge_eth.home import Deployment, OperatorHome
from rosbridge_eth.identity import Identity, PeerIdentity, Role, Trust
from rosbridge_eth.ledger import Chain, Contract
from rosbridge_eth.ledger.accounts import Keyring
from rosbridge_eth.ledger.batching import Limits
from rosbridge_eth.ledger.journal import Binding, Journal
from rosbridge_eth.ledger.submitter import BatchTiming, Settings, Submitter
from rosbridge_eth.protocol import Registration
from rosbridge_eth.records import robot_id
from rosbridge_eth.registry import Registry
from rosbridge_eth.server.reception import Reception
from rosbridge_eth.server.submission import Submission
from rosbridge_eth.server.whereabouts import whereabouts
from rosbridge_eth.server.worker import Worker
from rosbridge_eth.store import Inbox, InboxLimits, SqliteInbox

if TYPE_CHECKING:
    from eth_account.signers.local import LocalAccount

MODES = {"exchange": Mode.EXCHANGE, "transport": Mode.TRANSPORT}
_WEI, _GWEI = 10**18, 10**9


def open_chain(config: ServerConfig) -> Chain:
    """The configured node; ConfigError for the embedded chain, which lives and dies with the demo's process."""
    if config.chain.url == "embedded":
        raise ConfigError(
            "[chain] url is \"embedded\", a chain that ends with its process: only `demo` uses it. Start a node"
            " (`chain` starts a local one) and write its URL into server.toml"
        )
    return ledger.connect(config.chain.url)


def open_inbox(config: ServerConfig, home: OperatorHome) -> Inbox:
    """The configured inbox. In a Redis it is bound to the deployed contract, so that servers of others can share it."""
    limits = InboxLimits(config.store.max_records, config.store.max_size)
    if config.store.url == "sqlite":
        return SqliteInbox(home.inbox, limits)
    from rosbridge_eth.store.redis_inbox import RedisInbox  # a client that a server with SQLite need not load

    deployment = home.deployment()
    binding = f"chain {deployment.chain_id}, genesis {deployment.genesis}, contract {deployment.contract}"
    return RedisInbox(config.store.url, binding, limits)


def binding_of(deployment: Deployment) -> Binding:
    """What the store is bound to, as it was written down at the deployment."""
    return Binding(
        deployment.chain_id,
        bytes.fromhex(deployment.genesis.removeprefix("0x")),
        deployment.contract,
        bytes.fromhex(deployment.code_hash.removeprefix("0x")),
    )


def bound_contract(chain: Chain, deployment: Deployment) -> Contract:
    """The deployed contract, if the node's chain is the one it was deployed on; else ChainError with the way out."""
    if chain.chain_id() != deployment.chain_id:
        raise ChainError(
            f"{chain.url} is chain {chain.chain_id()}, the contract was deployed on chain {deployment.chain_id};"
            " correct [chain] url in server.toml"
        )
    genesis = chain.block(0)
    if genesis is None or "0x" + genesis.hash.hex() != deployment.genesis:
        raise ChainError(
            f"{chain.url} is another chain with the id {deployment.chain_id}: its first block differs."
            " If a local chain was made anew, its records are gone with it: make a new home"
        )
    return Contract.at(chain, deployment.contract)


def open_journal(home: OperatorHome, deployment: Deployment) -> Journal:
    return Journal(home.journal, binding_of(deployment))


def channel_config(config: ServerConfig, worker: int) -> ChannelServerConfig:
    limits = config.limits
    return ChannelServerConfig(
        modes=tuple(MODES[mode] for mode in config.channel),
        worker=worker,
        max_connections=limits.connections,
        max_half_open=limits.half_open,
        handshake_share=limits.handshake_share,
        source_rate=limits.source_rate,
        source_burst=limits.source_burst,
        max_unanswered=limits.unanswered,
        max_total_bytes=limits.memory,
    )


def open_worker(
    number: int,
    sock: socket.socket,
    *,
    config: ServerConfig,
    identity: Identity,
    trust: Trust,
    registry: Registry,
    inbox: Inbox,
    journal: Journal,
    deployment: Deployment,
) -> Worker:
    """Worker `number`, which owns `sock`."""
    server = Server(
        channel_config(config, number), identity, trust, cookie_key(identity), time.monotonic()
    )

    def registration_of(peer: PeerIdentity) -> Registration:
        enrolment = registry.find(peer.role, peer.name)
        account = None if enrolment is None else enrolment.account
        now = int(datetime.now(UTC).timestamp())
        return Registration(account is not None, account, deployment.contract, deployment.chain_id, now)

    reception = Reception(
        server,
        inbox,
        status_of=lambda id: whereabouts(id, inbox, journal, time.time()),
        registration_of=registration_of,
    )
    return Worker(
        server,
        reception,
        lambda on_event, on_batch: UdpLoop(server, sock, on_event, on_batch=on_batch),
        trust.allowed or (lambda peer: True),
        registry.revision,
    )


def submitter_settings(config: ServerConfig) -> Settings:
    chain, batch, funds = config.chain, config.batch, config.funds
    return Settings(
        limits=Limits(batch.records, batch.size, batch.gas, batch.age),
        confirmations=chain.confirmations,
        poll=chain.poll,
        bump_after=chain.bump_after,
        max_fee=int(chain.max_fee_gwei * _GWEI),
        low_water=int(funds.below * _WEI),
        top_up=int(funds.by * _WEI),
    )


def account_lookup(registry: Registry, keys: Keyring) -> Callable[[bytes], LocalAccount | None]:
    """For the submitter: the account a robot (Tk) signs with, that of its newest enrolment; None without any.

    Whether it may write is the contract's to say: what a robot had handed over
    when it was taken out of force is written until the chain is told.
    """

    newest: dict[bytes, int] = {}
    revision: tuple[int, int] | None = None

    def account_of(robot: bytes) -> LocalAccount | None:
        nonlocal newest, revision
        if (now := registry.revision()) != revision:  # read before the rows: a change in between is read again
            newest = {robot_id(e.name): e.number for e in registry.all(Role.ROBOT)}
            revision = now
        number = newest.get(robot)
        return None if number is None else keys.robot(number)

    return account_of


def open_submission(
    *,
    config: ServerConfig,
    contract: Contract,
    journal: Journal,
    inbox: Inbox,
    registry: Registry,
    keys: Keyring,
    on_confirmed: Callable[[BatchTiming], None] = lambda timing: None,
    holder: str | None = None,
) -> Submission:
    """The submitter's process. on_confirmed: is given each confirmed batch.

    holder: the name in its leases, that of this process if none is given. A
    name that outlives the process lets the next one go on at once; then no two
    may bear it at a time (`sole_submitter`).
    """
    settings = submitter_settings(config)
    holder = holder or f"{socket.gethostname()}:{os.getpid()}"
    submitter = Submitter(
        journal,
        contract=contract.address,
        chain_id=contract.chain.chain_id(),
        account_of=account_lookup(registry, keys),
        operator=keys.operator,
        holder=holder,
        settings=settings,
    )
    return Submission(
        inbox,
        submitter,
        contract.chain,
        limits=settings.limits,
        holder=holder,
        keep_batches=config.chain.keep,
        remember=config.store.remember,
        prune=journal.prune,
        on_confirmed=on_confirmed,
    )

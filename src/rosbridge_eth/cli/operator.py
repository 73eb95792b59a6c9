"""The operator's commands: init, chain, deploy, register, reader, revoke, renew, export, server, check."""

from __future__ import annotations

import json as jsonlib
import re
import signal
import time
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any

import typer

from rosbridge_eth import ledger
from rosbridge_eth.cli.options import (
    OPERATOR_HOME,
    LogFormatOption,
    OperatorHomeOption,
    PassphraseFile,
    PasswordFile,
    Verbose,
)
from rosbridge_eth.cli.output import Json, print_json, talk
from rosbridge_eth.config import load_server_config
from rosbridge_eth.errors import ConfigError, IdentityError, VerificationError
from rosbridge_eth.home import OperatorHome
from rosbridge_eth.identity import Role
from rosbridge_eth.operations.logs import LogFormat, log_to_stderr
from rosbridge_eth.passphrases import read_passphrase

_ETH = 10**18


def add_commands(app: typer.Typer) -> None:
    app.command(epilog="Example: rosbridge-eth init --chain http://127.0.0.1:8545")(init)
    app.command(epilog="Example: rosbridge-eth chain --port 8545")(chain)
    app.command()(deploy)
    app.command(epilog="Example: rosbridge-eth register robot_1")(register)
    app.command(name="reader", epilog="Example: rosbridge-eth reader analyst")(add_reader)
    app.command(epilog="Example: rosbridge-eth revoke robot_1")(revoke)
    app.command()(renew)
    app.command(epilog="Example: rosbridge-eth export robot_1 keystore.json")(export)
    app.command(epilog="Example: rosbridge-eth server --workers 2")(server)
    app.command(epilog="Example: rosbridge-eth check robot_1 0f3a… 17")(check)


def _passphrase(file: Path | None, *, confirm: bool = False) -> bytes:
    return read_passphrase("operator", "Operator passphrase", file=file, confirm=confirm)


def _now() -> datetime:
    return datetime.now(UTC)


def init(
    home: OperatorHomeOption = OPERATOR_HOME,
    listen: Annotated[str, typer.Option(help="UDP address of the robots' door.")] = "0.0.0.0:7410",
    public: Annotated[str | None, typer.Option(help="The address robots are given, where it differs.")] = None,
    chain: Annotated[str, typer.Option(help="JSON-RPC URL of a node.")] = "http://127.0.0.1:8545",
    server_name: Annotated[str, typer.Option(help="The name in the server's certificate.")] = "server",
    passphrase_file: PassphraseFile = None,
) -> None:
    """Make an operator's home: the CA, the server's identity, the seed of all accounts, the owner's reader key."""
    from rosbridge_eth.ledger.accounts import Keyring
    from rosbridge_eth.server.administration import init_home

    place = OperatorHome(home)
    passphrase = _passphrase(passphrase_file, confirm=True)
    init_home(place, passphrase, listen=listen, public=public, chain_url=chain, server=server_name, now=_now())
    keys = Keyring.load(place.accounts, passphrase)
    talk(f"{home} is an operator's home. Keep its passphrase: nothing in it can be recovered without.")
    talk(f"The operator's account is {keys.operator.address}; it pays for the contract and the robots.")
    talk("Next: `chain` starts a local node (or put ETH on that account at yours), then `deploy`.")


def chain(
    home: OperatorHomeOption = OPERATOR_HOME,
    port: Annotated[int, typer.Option(min=1, max=65535, help="TCP port on 127.0.0.1.")] = 8545,
    block_time: Annotated[
        float | None, typer.Option(min=0.1, help="Seconds between blocks; without it each transaction gets its own.")
    ] = None,
    eth: Annotated[int, typer.Option(min=1, help="ETH on the operator's account.")] = 1000,
) -> None:
    """Start a local anvil whose chain is kept in a file of the home, and give the operator's account ETH on it."""
    from rosbridge_eth.ledger.anvil import start

    place = OperatorHome(home).require()
    operator = jsonlib.loads(place.accounts.read_bytes())["operator"]
    with start(port, state=home / "chain.json", block_time=block_time) as anvil:
        node = ledger.connect(anvil.url)
        if node.balance(operator) < eth * _ETH:
            node.request("anvil_setBalance", operator, hex(eth * _ETH))
        node.close()
        talk(f"A local chain answers at {anvil.url}; {operator} has {eth} ETH. Ctrl-C ends it and keeps the chain.")
        signal.signal(signal.SIGTERM, signal.default_int_handler)
        try:
            anvil.wait()
        except KeyboardInterrupt:
            talk("The chain is kept.")


def deploy(home: OperatorHomeOption = OPERATOR_HOME, passphrase_file: PassphraseFile = None) -> None:
    """Create the contract on the configured chain."""
    from rosbridge_eth.ledger.accounts import Keyring
    from rosbridge_eth.server.administration import deploy_contract
    from rosbridge_eth.server.assembly import open_chain

    place = OperatorHome(home).require()
    node = open_chain(load_server_config(place.config))
    try:
        made = deploy_contract(place, node, Keyring.load(place.accounts, _passphrase(passphrase_file)))
    finally:
        node.close()
    talk(f"The contract is {made.contract} on chain {made.chain_id}. Next: `register NAME` for each robot.")


def register(
    name: Annotated[str, typer.Argument(help="The robot's name: a-z, 0-9, '_', '.', '-'.")],
    home: OperatorHomeOption = OPERATOR_HOME,
    replace: Annotated[bool, typer.Option("--replace", help="Take a used name over; revokes the old one.")] = False,
    csr: Annotated[
        tuple[Path, Path] | None,
        typer.Option(help="The robot's own certificate requests, signing and encryption; its keys stay with it."),
    ] = None,
    passphrase_file: PassphraseFile = None,
    password_file: PasswordFile = None,
) -> None:
    """Register a robot: name and password become an account, certificates, and a bundle to carry to the robot."""
    from rosbridge_eth.ledger.accounts import Keyring
    from rosbridge_eth.server.administration import load_ca, register_robot
    from rosbridge_eth.server.assembly import open_chain

    place = OperatorHome(home).require()
    passphrase = _passphrase(passphrase_file)
    password = read_passphrase("robot", f"Registration password of {name}", file=password_file, confirm=True)
    node = open_chain(load_server_config(place.config))
    try:
        made = register_robot(
            place, name, ca=load_ca(place, passphrase), keys=Keyring.load(place.accounts, passphrase), chain=node,
            password=password, now=_now(), replace=replace, requests=None if csr is None else _requests(*csr),
        )
    finally:
        node.close()
    talk(f"{name} is registered in block {made.block}; its account is {made.account}.")
    if made.given_up:
        talk(f"{made.given_up} records of the revoked {name} are dead letters in {place.journal} now.")
    talk(f"Carry {made.bundle} to the robot and run there: rosbridge-eth join {made.bundle.name}")


def _requests(signing: Path, encryption: Path) -> Any:
    from smcrypto import SMCryptoError, x509

    try:
        return tuple(x509.CertificateSigningRequest.from_pem(path.read_bytes()) for path in (signing, encryption))
    except (OSError, SMCryptoError) as error:
        raise IdentityError(f"a certificate request cannot be read: {error}") from error


def add_reader(
    name: Annotated[str, typer.Argument(help="The reader's name.")],
    home: OperatorHomeOption = OPERATOR_HOME,
    replace: Annotated[
        bool, typer.Option("--replace", help="Take a used name over; revokes the old one and keeps its folder aside.")
    ] = False,
    passphrase_file: PassphraseFile = None,
    password_file: Annotated[
        Path | None, typer.Option(help="Read the new reader's passphrase from the first line of this file.")
    ] = None,
) -> None:
    """Make another reader; robots that are registered from now on seal for it too."""
    from rosbridge_eth.server.administration import enrol_reader, load_ca

    place = OperatorHome(home).require()
    ca = load_ca(place, _passphrase(passphrase_file))
    password = read_passphrase("reader", f"Passphrase of reader {name}", file=password_file, confirm=True)
    made = enrol_reader(place, name, ca=ca, password=password, now=_now(), replace=replace)
    folder = made.folder
    if made.old is not None:
        talk(f"The old {name} is in {made.old}: only its keys open what was sealed for it. Robots seal on for it, too,")
        talk("until its file in their readers folder gives way to the new public.pem.")
    talk(f"{folder} is the home of reader {name}; it can be carried elsewhere. Its reader.toml names the node to ask.")
    talk(f"A robot registered before seals for it too once {folder / 'public.pem'} is in the robot's readers folder.")


def revoke(
    name: Annotated[str, typer.Argument(help="The name to revoke.")],
    home: OperatorHomeOption = OPERATOR_HOME,
    role: Annotated[Role, typer.Option(help="What it is.")] = Role.ROBOT,
    passphrase_file: PassphraseFile = None,
) -> None:
    """Revoke a name: the server closes its session at once, and the chain takes nothing from it any more."""
    from rosbridge_eth.ledger.accounts import Keyring
    from rosbridge_eth.server.administration import COUNTED
    from rosbridge_eth.server.administration import revoke as revoke_name
    from rosbridge_eth.server.assembly import open_chain

    place = OperatorHome(home).require()
    keys = Keyring.load(place.accounts, _passphrase(passphrase_file))
    node = open_chain(load_server_config(place.config))
    try:
        ended = revoke_name(place, role, name, keys=keys, chain=node, now=_now())
    finally:
        node.close()
    talk(f"{role} {name} is revoked" + (f", on the chain in block {ended.block}." if ended.block is not None else "."))
    if ended.not_written:
        number = f"{ended.not_written} records" if ended.not_written < COUNTED else f"{COUNTED} records or more"
        talk(
            f"{number} that {name} had handed over were not on the chain in time and will never be: they stay in the"
            " server's store, where `status` counts them as inbox waiting or batches sealed, until `register"
            f" {name} --replace` makes dead letters of them."
        )


def renew(home: OperatorHomeOption = OPERATOR_HOME, passphrase_file: PassphraseFile = None) -> None:
    """Give the server new keys and certificates, before the old ones expire; then start the server again."""
    from rosbridge_eth.server.administration import load_ca, renew_server

    place = OperatorHome(home).require()
    passphrase = _passphrase(passphrase_file)
    old = renew_server(place, ca=load_ca(place, passphrase), passphrase=passphrase, now=_now())
    talk(f"The server has new keys; those before are in {old}. Start the server again; robots need nothing.")


def export(
    name: Annotated[str, typer.Argument(help="A robot's name, or `operator`.")],
    file: Annotated[Path, typer.Argument(help="The keystore to write.")],
    home: OperatorHomeOption = OPERATOR_HOME,
    role: Annotated[Role | None, typer.Option(help="Whose account: robot or operator.")] = None,
    passphrase_file: PassphraseFile = None,
    password_file: Annotated[
        Path | None, typer.Option(help="Read the keystore's own password from the first line of this file.")
    ] = None,
) -> None:
    """Write an account as a standard keystore that other Ethereum software imports."""
    from rosbridge_eth.home import write_atomically
    from rosbridge_eth.ledger.accounts import Keyring
    from rosbridge_eth.registry import Registry
    from rosbridge_eth.server.administration import OPERATOR

    place = OperatorHome(home).require()
    if file.exists():
        raise ConfigError(f"{file} exists; choose another name")
    keys = Keyring.load(place.accounts, _passphrase(passphrase_file))
    registry = Registry(place.registry)
    robot = registry.find(Role.ROBOT, name)
    registry.close()
    if robot is not None and name == OPERATOR and role is None:
        raise IdentityError(f"{name!r} is a robot and what the treasury is called; say --role robot or --role operator")
    number = 0
    if role is Role.ROBOT or name != OPERATOR:
        if robot is None or role not in (Role.ROBOT, None):
            raise IdentityError(f"no {role or Role.ROBOT} {name!r} has an account; `status` lists the names")
        number = robot.number
    password = read_passphrase("keystore", "Password of the keystore", file=password_file, confirm=True)
    write_atomically(file, jsonlib.dumps(keys.export(number, password)).encode() + b"\n", mode=0o600)
    talk(f"{file} holds the account {keys.account(number).address}.")


def server(
    home: OperatorHomeOption = OPERATOR_HOME,
    workers: Annotated[int | None, typer.Option(min=1, max=64, help="Processes that share the port.")] = None,
    passphrase_file: PassphraseFile = None,
    verbose: Verbose = 0,
    log_format: LogFormatOption = LogFormat.TEXT,
) -> None:
    """Take records from robots and bring them onto the chain, until stopped."""
    from rosbridge_eth.ledger.accounts import Keyring
    from rosbridge_eth.server.administration import load_server_identity
    from rosbridge_eth.server.supervisor import Secrets, Supervisor

    log_to_stderr(log_format, verbose)
    place = OperatorHome(home).require()
    config = load_server_config(place.config)
    if workers is not None:
        config = config.model_copy(update={"workers": workers})
    passphrase = _passphrase(passphrase_file)
    secrets = Secrets(load_server_identity(place, passphrase), Keyring.load(place.accounts, passphrase))

    def ready(address: tuple[str, int]) -> None:
        talk(f"Listening on UDP {address[0]}:{address[1]} with {config.workers} workers; Ctrl-C ends it.")

    Supervisor(place, config, secrets).run(ready)


def check(
    robot: Annotated[str, typer.Argument(help="The robot's name.")],
    stream: Annotated[str, typer.Argument(help="The stream: 32 hex digits.")],
    seq: Annotated[int, typer.Argument(min=0, help="The record's number in the stream.")],
    home: OperatorHomeOption = OPERATOR_HOME,
    json: Json = False,
) -> None:
    """Where is this record? Asks the store, and where it is in a block, the contract itself (checkData)."""
    from rosbridge_eth.ledger import Contract, merkle
    from rosbridge_eth.records import RecordId, robot_id
    from rosbridge_eth.registry import Registry
    from rosbridge_eth.server.assembly import open_chain, open_inbox, open_journal
    from rosbridge_eth.server.whereabouts import whereabouts

    place = OperatorHome(home).require()
    if not re.fullmatch(r"[0-9a-fA-F]{32}", stream):
        raise ConfigError(f"the stream is 32 hex digits, as `read` shows it, not {stream!r}")
    try:
        id = RecordId(robot_id(robot), bytes.fromhex(stream), seq)
    except ValueError as error:
        raise ConfigError(f"not a record's identity: {error}") from error
    registry = Registry(place.registry)
    names = {enrolment.name for enrolment in registry.all(Role.ROBOT)}  # a revoked one's records are there still
    registry.close()
    if robot not in names:
        raise IdentityError(f"no robot {robot!r} is enrolled; `status` lists the names")
    config, deployment = load_server_config(place.config), place.deployment()
    journal, inbox = open_journal(place, deployment), open_inbox(config, place)
    found = whereabouts(id, inbox, journal, time.time())
    proven: bool | None = None
    if found.block is not None:
        proven = False
        node = open_chain(config)
        try:
            contract = Contract.at(node, deployment.contract)
            records = ledger.fetch(node, contract, id.robot, found.block, found.block).records
            for item in records:
                if item.record.id == id:
                    batch = [other.record for other in records if other.batch_index == item.batch_index]
                    path = merkle.proof([merkle.leaf_hash(record) for record in batch], item.leaf)
                    proven = contract.check_data(item.record, item.batch_index, item.leaf, item.leaves, path)
        finally:
            node.close()
    if json:
        print_json({"state": found.state, "transaction": found.transaction, "block": found.block, "proven": proven})
    else:
        where = f" in block {found.block}, transaction {found.transaction}" if found.block is not None else ""
        typer.echo(f"{found.state}{where}" + ("" if proven is None else f"; the contract says {str(proven).lower()}"))
    if proven is False:
        raise VerificationError(
            f"the chain does not have in block {found.block} the record that the store says is there: the chain was"
            " reorganised a moment ago (the submitter writes it again), or the node is behind or another; ask again"
        )

"""The operator's commands: home and contract, robots and readers, server, and looking after all of it."""

from __future__ import annotations

import shlex
import signal
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path
from typing import Annotated
from urllib.parse import urlsplit

import typer

from rosbridge_eth import terminal
from rosbridge_eth.channel.udp import server_socket
from rosbridge_eth.config import load_server_config
from rosbridge_eth.config.home import OperatorHome, ReaderHome, RobotHome, shard_of
from rosbridge_eth.config.passphrases import read_passphrase
from rosbridge_eth.config.values import Address, counted
from rosbridge_eth.errors import ChainError, ConfigError
from rosbridge_eth.files import naming, write_atomically
from rosbridge_eth.identity import CertificateAuthority, Role, load_ca
from rosbridge_eth.ledger import Keyring, Ledger
from rosbridge_eth.log.chunk import robot_id
from rosbridge_eth.log.store import Store
from rosbridge_eth.operator import enrolment, status
from rosbridge_eth.operator.bundle import Request
from rosbridge_eth.reading.verdict import grouped
from rosbridge_eth.server.parent import Parent
from rosbridge_eth.server.shard import Secrets, open_store
from rosbridge_eth.terminal import (
    OPERATOR_HOME,
    READER_HOME,
    LogFormat,
    OperatorHomeOption,
    PassphraseFile,
    live,
    log_to_stderr,
    talk,
    utc_now,
)

_CaPassphraseFile = Annotated[Path | None, typer.Option(help="Of a CA kept apart, where it has one of its own.")]
_ReaderPassphraseFile = Annotated[Path | None, typer.Option(help="The passphrase of the reader's own keys.")]
_ReplaceOption = Annotated[bool, typer.Option("--replace", help="Give a used name to a new one; the old one ends.")]
_CompromisedOption = Annotated[
    bool, typer.Option("--compromised", help="Chunks that are not on the chain yet become dead letters.")]

FUNDS = 1000  # ETH that the operator has on a local chain


def passphrase_of(home: OperatorHome, file: Path | None) -> bytes:
    """The operator passphrase: from `file`, or asked for."""
    load_server_config(home.config)  # a mistake in it is told before anybody types
    return read_passphrase("operator", "Operator passphrase", file=file)


def _ca(home: OperatorHome, passphrase: bytes, file: Path | None) -> CertificateAuthority:
    own = passphrase if file is None else read_passphrase("ca", "Passphrase of the CA", file=file)
    return load_ca(home.ca, own, utc_now())


def _opened(home: Path, file: Path | None) -> tuple[OperatorHome, bytes, Keyring]:
    """An operator's home, its passphrase and its accounts."""
    place = OperatorHome(home).require()
    passphrase = passphrase_of(place, file)
    return place, passphrase, Keyring.load(place.accounts, passphrase)


def _inbox(place: OperatorHome, robot: str) -> Store:
    """The store of the shard to which this robot belongs."""
    config = load_server_config(place.config)
    return open_store(config, place, shard_of(robot_id(robot), config.shards))


@contextmanager
def ledger_of(home: OperatorHome, *, check: bool = True) -> Iterator[Ledger]:
    """The contract on the configured node; ChainError unless it is there, which is not asked without `check`."""
    with closing(Ledger.connect(load_server_config(home.config).chain.url, home.deployment())) as ledger:
        if check:
            ledger.check()
        yield ledger


def up(
    home: OperatorHomeOption = OPERATOR_HOME,
    reader: Annotated[Path, typer.Option(help="Folder for the first reader, `owner`.")] = READER_HOME,
    chain: Annotated[str | None, typer.Option(help="A node of yours; without it, an anvil kept in the home.")] = None,
    listen: Annotated[str | None, typer.Option(help="UDP address on which robots are answered: 0.0.0.0:7410.")] = None,
    public: Annotated[str | None, typer.Option(help="The address robots are given; by default this machine's.")] = None,
    passphrase_file: PassphraseFile = None, verbose: terminal.Verbose = 0,
    log_format: terminal.LogFormatOption = LogFormat.TEXT,
) -> None:  # fmt: skip
    """Run everything: an operator's home, chain, contract, server. For trying out and for small sites.

    What exists is used, so it can be run again. Ctrl-C stops server and chain; both are kept.
    """
    from rosbridge_eth.ledger.nodes import Anvil, free_port, is_free

    log_to_stderr(log_format, verbose)
    for number in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.default_int_handler)
    if not (home / "home.json").exists():
        secret = read_passphrase("operator", "A passphrase for all of it", file=passphrase_file, confirm=True)
        keys = enrolment.init_home(
            OperatorHome(home), secret, reader=ReaderHome(reader), reader_passphrase=secret, now=utc_now(),
            listen=listen or "0.0.0.0:7410", public=public, chain_url=chain or f"http://127.0.0.1:{free_port(8545)}",
        )  # fmt: skip
        talk(f"{home} is an operator's home and {reader} that of the reader `owner`, both under this passphrase.")
        place = OperatorHome(home)
    else:
        place, secret, keys = _opened(home, passphrase_file)
        known = load_server_config(place.config)
        for key, given, now in (
            ("listen", listen, known.listen), ("public", public, ", ".join(map(str, known.public))),
            ("[chain] url", chain, known.chain.url),
        ):
            if given not in (None, str(now)):
                raise ConfigError(f"{place.config} has another address than the option: change {key} there")
    settings = load_server_config(place.config)
    url, state = settings.chain.url, home / "chain.json"
    node, deployed = urlsplit(url), place.deployment_file.exists()
    port = node.port if chain is None and node.hostname == "127.0.0.1" and (state.exists() or not deployed) else None
    anvil: Anvil | None = None

    def look() -> None:
        if anvil is not None and not anvil.running():
            raise ChainError(f"the local chain stopped by itself; its state is in {state}: run `up` again")

    with ExitStack() as stack:
        if port is not None and is_free(port):
            anvil = stack.enter_context(Anvil.start(port, state=state))
            anvil.fund(place.account, FUNDS)
            talk(f"A local chain runs at {anvil.url}; its state is in {state}.")
        if not deployed:
            for shard in range(settings.shards):  # a port that is taken is told before a contract is paid for
                server_socket(settings.listen.next(shard)).close()
            made = enrolment.deploy_contract(place, url, keys)
            if anvil is not None:
                anvil.keeps(made.contract)  # a kill costs some seconds of the chain; without its contract, all of it
            talk(f"The contract is {made.contract} on chain {made.chain_id}.")
        where = "" if home == OPERATOR_HOME else f" --home {shlex.quote(str(home))}"
        talk("On a robot:    rosbridge-eth join")
        talk(f"Here, for it:  rosbridge-eth register NAME REQUEST{where}")
        talk("On the robot:  rosbridge-eth robot")
        _serve(place, secret, keys, look=look)
    talk("Everything is kept; run `up` again to continue.")


def init(
    home: OperatorHomeOption = OPERATOR_HOME,
    reader: Annotated[Path, typer.Option(help="Folder for the first reader, `owner`; carry it away.")] = READER_HOME,
    listen: Annotated[str, typer.Option(help="UDP address on which robots are answered.")] = "0.0.0.0:7410",
    public: Annotated[str | None, typer.Option(help="The address robots are given; by default this machine's.")] = None,
    chain: Annotated[str, typer.Option(help="JSON-RPC URL of a node.")] = "http://127.0.0.1:8545",
    ca: Annotated[Path | None, typer.Option(help="Keep the CA in this folder, or use the one that is there.")] = None,
    mnemonic_file: Annotated[Path | None, typer.Option(help="Restore the accounts from these words.")] = None,
    passphrase_file: PassphraseFile = None, ca_passphrase_file: _CaPassphraseFile = None,
    reader_passphrase_file: _ReaderPassphraseFile = None,
) -> None:  # fmt: skip
    """Make an operator's home, and that of the first reader, `owner`.

    In the operator's are the CA, the server's identity, and the seed of all accounts.
    """
    place = OperatorHome(home)
    passphrase = read_passphrase("operator", "Operator passphrase", file=passphrase_file, confirm=True)
    readers = read_passphrase("reader", "Passphrase of the reader `owner`", file=reader_passphrase_file, confirm=True)
    words = mnemonic_file and read_passphrase("mnemonic", "Mnemonic", file=mnemonic_file).decode()
    keys = enrolment.init_home(
        place, passphrase, reader=ReaderHome(reader), reader_passphrase=readers, now=utc_now(), listen=listen,
        public=public, chain_url=chain, ca=ca,
        ca_passphrase=read_passphrase("ca", "Passphrase of the CA", file=ca_passphrase_file)
        if ca_passphrase_file else None,
        keys=Keyring.from_mnemonic(words) if words else None,
    )
    talk(f"{home} is an operator's home. Keep its passphrase: without it nothing can be recovered.")
    talk(f"{reader} is the home of the reader `owner`: carry it to the machine that reads; {home} opens no record.")
    talk(f"Robots are told to send to {load_server_config(place.config).addresses()[0]}.")
    talk(f"The operator's account is {keys.operator.address}; it pays for the contract and the robots.")
    talk("Next: `chain` starts a local node (or put ETH on that account at yours), then `deploy`.")


def chain(
    home: OperatorHomeOption = OPERATOR_HOME,
    port: Annotated[int, typer.Option(min=1, max=65535, help="TCP port on 127.0.0.1.")] = 8545,
    block_time: Annotated[float | None, typer.Option(
        min=0.1, help="Seconds between blocks; without it each transaction gets its own.")] = None,
) -> None:
    """Start a local chain, kept in the home; the operator has ETH. It is an anvil, which npx fetches."""
    from rosbridge_eth.ledger.nodes import Anvil

    log_to_stderr()
    account = OperatorHome(home).require().account
    for number in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.default_int_handler)
    try:
        with Anvil.start(port, state=home / "chain.json", block_time=block_time) as anvil:
            anvil.fund(account, FUNDS)
            talk(f"A local chain runs at {anvil.url}; {account} has {FUNDS} ETH. Ctrl-C stops it; its state is kept.")
            anvil.wait()
            raise ChainError("the local chain stopped by itself; start it again")
    except KeyboardInterrupt:
        talk("The chain is kept.")


def deploy(
    home: OperatorHomeOption = OPERATOR_HOME,
    wait: Annotated[float, typer.Option(min=0, help="Seconds to wait for the node and for ETH.")] = 0.0,
    passphrase_file: PassphraseFile = None,
) -> None:
    """Create the contract on the configured chain."""
    place, _, keys = _opened(home, passphrase_file)
    made = enrolment.deploy_contract(place, load_server_config(place.config).chain.url, keys, wait=wait)
    talk(f"The contract is {made.contract} on chain {made.chain_id}.")
    talk("Next: `join --name NAME` on a robot, then here `register NAME REQUEST`.")


def register(
    name: Annotated[str, typer.Argument(help="The robot's name: a-z, 0-9, '_', '.', '-'.")],
    request: Annotated[Path | None, typer.Argument(help="The request that `join --name` wrote on the robot.")] = None,
    home: OperatorHomeOption = OPERATOR_HOME, replace: _ReplaceOption = False, compromised: _CompromisedOption = False,
    passphrase_file: PassphraseFile = None, ca_passphrase_file: _CaPassphraseFile = None,
    password_file: terminal.PasswordFile = None,
) -> None:  # fmt: skip
    """Register a robot by its request. It gets an account, certificates, a bundle to carry back.

    Without a request, name and password do (the paper's easy_register); the operator could then sign as the robot.
    """
    asked = None
    if request is not None:
        with naming(request):
            asked = Request.decode(terminal.read_given(request))
    place, passphrase, keys = _opened(home, passphrase_file)
    prompt = f"Registration password of {name}"
    secret = None if asked else read_passphrase("robot", prompt, file=password_file, confirm=True)
    ca = _ca(place, passphrase, ca_passphrase_file)
    with ledger_of(place) as ledger:
        made = enrolment.register_robot(
            place, name, ca=ca, keys=keys, ledger=ledger, inbox=lambda: _inbox(place, name), now=utc_now(),
            request=asked, password=secret, replace=replace, compromised=compromised,
        )  # fmt: skip
    talk(f"{name} is registered in block {made.block}; its account is {made.account}.")
    if asked is None:
        talk(f"Its keys were made here: who has this home and its passphrase can sign as {name}.")
    if made.buried:
        talk(f"Dead letters now: {counted(made.buried, 'chunk')} of the old {name}; `status` lists them.")
    talk(f"It seals for these readers: {', '.join(made.readers)}.")
    talk(f"The CA is {grouped(ca.certificate.fingerprint().hex())}.")
    if request is None:
        talk(f"Carry {made.bundle} to the robot and run there: rosbridge-eth join {made.bundle.name}")
        return
    try:
        answer = RobotHome(request.parent).answer  # where the request lies in the robot's home
        write_atomically(answer, made.bundle.read_bytes())  # which `robot` may look for at this moment
        where = "" if request.parent == terminal.ROBOT_HOME else f" --home {shlex.quote(str(request.parent))}"
        talk(f"Run there now: rosbridge-eth robot{where}")
    except (OSError, ConfigError):
        talk(f"Carry {made.bundle} into the robot's home and run there: rosbridge-eth robot")


def add_reader(
    name: Annotated[str, typer.Argument(help="The reader's name.")],
    to: Annotated[Path | None, typer.Option("--to", help="The reader's folder; without it, one of its name.")] = None,
    home: OperatorHomeOption = OPERATOR_HOME, replace: _ReplaceOption = False, passphrase_file: PassphraseFile = None,
    ca_passphrase_file: _CaPassphraseFile = None, reader_passphrase_file: _ReaderPassphraseFile = None,
) -> None:  # fmt: skip
    """Make another reader. Robots that are registered from now on seal for it too."""
    place, folder = OperatorHome(home).require(), ReaderHome(to or Path(name))
    ca = _ca(place, passphrase_of(place, passphrase_file), ca_passphrase_file)
    secret = read_passphrase("reader", f"Passphrase of reader {name}", file=reader_passphrase_file, confirm=True)
    enrolment.add_reader(place, name, folder, ca=ca, passphrase=secret, now=utc_now(), replace=replace)
    talk(f"{folder.path} is the home of reader {name}; carry it there. Its reader.toml names the node to ask.")
    talk(f"A robot registered before seals for it too once {folder.public} is in the robot's readers folder.")
    if replace:
        talk(f"What was sealed for the old {name} opens only with its old keys.")


def revoke(
    name: Annotated[str, typer.Argument(help="The name to revoke.")],
    home: OperatorHomeOption = OPERATOR_HOME,
    role: Annotated[Role, typer.Option(help="What it is.")] = Role.ROBOT,
    compromised: _CompromisedOption = False, passphrase_file: PassphraseFile = None,
) -> None:  # fmt: skip
    """Revoke a name. The server closes its session at once, and the chain takes nothing from it any more."""
    place, _, keys = _opened(home, passphrase_file)
    with ledger_of(place, check=False) as ledger:  # the server is told even where the node is away
        ended = enrolment.revoke(
            place, role, name, keys=keys, ledger=ledger, now=utc_now(), compromised=compromised,
            inbox=lambda: _inbox(place, name),
        )  # fmt: skip
    talk(f"{role} {name} is revoked" + (f", on the chain in block {ended.block}." if ended.block is not None else "."))
    if ended.buried:
        talk(f"Dead letters now: {counted(ended.buried, 'chunk')} that {name} had handed over, not on the chain.")


def renew(
    home: OperatorHomeOption = OPERATOR_HOME, passphrase_file: PassphraseFile = None,
    ca_passphrase_file: _CaPassphraseFile = None,
) -> None:  # fmt: skip
    """Give the server new keys, before the certificates expire. Then start the server again."""
    place = OperatorHome(home).require()
    passphrase = passphrase_of(place, passphrase_file)
    ca = _ca(place, passphrase, ca_passphrase_file)
    old = enrolment.renew_server(place, ca=ca, passphrase=passphrase, now=utc_now())
    talk(f"The server has new keys; the old ones are in {old}. Restart the server; robots need no change.")


def mnemonic(home: OperatorHomeOption = OPERATOR_HOME, passphrase_file: PassphraseFile = None) -> None:
    """Print the words from which all accounts can be restored. Keep them offline; `init --mnemonic-file` takes them."""
    typer.echo(_opened(home, passphrase_file)[2].mnemonic)


def handover(
    to: Annotated[str | None, typer.Argument(help="The account of the operator's home that takes over.")] = None,
    home: OperatorHomeOption = OPERATOR_HOME, passphrase_file: PassphraseFile = None,
) -> None:  # fmt: skip
    """Offer the contract to another operator, or accept an offer. Without an account: accept.

    Until it is accepted nothing changes, and another offer replaces this one. docs/operations.md has all steps.
    """
    from eth_utils.address import is_address, to_checksum_address

    if to is not None and not is_address(to):
        raise ConfigError(f"{to!r} is no account's address; `status` of the other home shows it")
    place, _, keys = _opened(home, passphrase_file)
    with ledger_of(place) as ledger:
        if to is not None:
            ledger.transact(keys.operator, "offerOperator", to_checksum_address(to))
            talk(f"{ledger.contract} is offered to {to}; it takes effect when that home runs `handover`.")
        else:
            ledger.transact(keys.operator, "acceptOperator")
            talk(f"{keys.operator.address} is the operator of {ledger.contract}. Register each robot with --replace.")


def backup(
    target: Annotated[Path, typer.Argument(help="A new folder.")], home: terminal.AnyHomeOption = OPERATOR_HOME
) -> None:
    """Copy a home, in use or not, into a new folder. Keep it where its keys are safe."""
    enrolment.backup(home, target)
    talk(f"{target} is a copy of {home}.")


def passwd(
    home: terminal.AnyHomeOption = OPERATOR_HOME, passphrase_file: PassphraseFile = None,
    new_passphrase_file: Annotated[Path | None, typer.Option(help="The new one, on the first line.")] = None,
) -> None:  # fmt: skip
    """Change the passphrase of a home's keys."""
    old = read_passphrase("present", "Present passphrase", file=passphrase_file)
    new = read_passphrase("new", "New passphrase", file=new_passphrase_file, confirm=True)
    files = enrolment.change_passphrase(home, old, new)
    talk(f"{len(files)} files of {home} are under the new passphrase.")


def server(
    home: OperatorHomeOption = OPERATOR_HOME,
    shard: Annotated[list[int] | None, typer.Option(
        min=0, help="Run this shard only, where the others run on other machines or as services of their own.")] = None,
    passphrase_file: PassphraseFile = None, verbose: terminal.Verbose = 0,
    log_format: terminal.LogFormatOption = LogFormat.TEXT,
) -> None:  # fmt: skip
    """Receive chunks from robots and write them to the chain."""
    log_to_stderr(log_format, verbose)
    _serve(*_opened(home, passphrase_file), shard or ())


def _serve(
    place: OperatorHome, passphrase: bytes, keys: Keyring, only: Sequence[int] = (),
    look: Callable[[], None] = lambda: None,
) -> None:  # fmt: skip
    """Run the server, or these shards of it; what `look` raises ends it in order."""
    secrets = Secrets(enrolment.load_server_identity(place, passphrase), keys)

    def ready(addresses: list[Address]) -> None:
        talk(f"Listening on UDP {', '.join(map(str, addresses))}; Ctrl-C ends it.")

    with live(lambda: status.fleet(place)) as show:

        def on_look() -> None:
            show()
            look()

        Parent(place, secrets, only).run(ready, on_look)

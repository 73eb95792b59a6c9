"""What a reader reads with: from an operator's home, or from a reader.toml alone."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from rosbridge_eth import ledger
from rosbridge_eth.config import load_reader_config, load_server_config
from rosbridge_eth.errors import IdentityError
from rosbridge_eth.home import OperatorHome
from rosbridge_eth.identity import Identity, load_identity, read_certificates
from rosbridge_eth.ledger import Chain
from smcrypto import x509


@dataclass(frozen=True, slots=True)
class ReadingEnd:
    """A node, the contract's address, the roots, and who reads."""

    chain: Chain
    contract: str
    roots: tuple[x509.Certificate, ...]
    identity: Identity
    from_block: int


def open_reader(home: OperatorHome, config: Path | None, name: str, passphrase: Callable[[], bytes]) -> ReadingEnd:
    """The end that the options describe. Raises ConfigError, IdentityError."""
    if config is not None:
        settings = load_reader_config(config)
        identity, _ = load_identity(settings.identity, passphrase())
        roots = read_certificates(settings.ca.read_bytes())
        return ReadingEnd(ledger.connect(settings.chain), settings.contract, roots, identity, settings.from_block)
    server = load_server_config(home.require().config)
    deployment = home.deployment()
    readers = sorted(key.parent.name for key in (home.path / "readers").glob("*/enc.key.pem"))
    if name not in readers:
        raise IdentityError(f"no such reader: {name}; there are {', '.join(readers)}, and `reader NAME` makes another")
    identity, roots = load_identity(home.reader(name), passphrase())
    return ReadingEnd(ledger.connect(server.chain.url), deployment.contract, roots, identity, 0)

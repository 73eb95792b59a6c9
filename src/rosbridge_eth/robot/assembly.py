"""Putting a robot together from its home and its configuration."""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

from rosbridge_eth.bundle import Bundle
from rosbridge_eth.capture import Capture, CapturedRecord, TopicRule
from rosbridge_eth.channel import Client, ClientConfig, Mode
from rosbridge_eth.channel.udp import UdpLoop, client_socket
from rosbridge_eth.config import Address, RobotConfig
from rosbridge_eth.config.values import time_text
from rosbridge_eth.errors import ConfigError, IdentityError
from rosbridge_eth.home import BridgeEnd, OperatorHome, ReaderHome, RobotHome, write_atomically
from rosbridge_eth.identity import (
    Identity,
    Role,
    Trust,
    identity_from_files,
    load_identity,
    read_certificates,
    sign,
)
from rosbridge_eth.robot.clock import certificate_clock
from rosbridge_eth.robot.process import Robot
from rosbridge_eth.robot.recorder import Recorder
from rosbridge_eth.robot.sender import Sender
from rosbridge_eth.sealing import Sealer, StreamLimits
from rosbridge_eth.sources import BagSource, open_source
from rosbridge_eth.store import Spool, SpoolLimits
from smcrypto import sm2, x509

log = logging.getLogger(__name__)

MODES = {"exchange": Mode.EXCHANGE, "transport": Mode.TRANSPORT}
FIRST_CONFIG = """\
# What this robot sends to the chain; docs/configuration.md describes every key.
topics = ["/robot_1/odom"]
"""


def join(home: RobotHome, bundle: Bundle, password: bytes, keys: Path | None = None) -> None:
    """Make a robot's home of a bundle. keys: the folder of the robot's own keys where the bundle has none (--csr)."""
    if home.bridge_file.exists():
        raise ConfigError(
            f"{home.path} is the home of robot {home.bridge().robot!r} already; choose another folder"
        )
    others = {"an operator's": OperatorHome(home.path).config, "a reader's": ReaderHome(home.path).config}
    for whose, config in others.items():
        if config.exists():
            raise ConfigError(
                f"{home.path} is {whose} home, where a robot's files do not belong; choose another folder"
            )
    files = {name: content.encode() for name, content in bundle.identity.items()}
    for name in ("sign.key.pem", "enc.key.pem"):
        if name not in files:
            if keys is None:
                raise IdentityError("this bundle was made from requests; give the folder of your keys with --keys")
            try:
                files[name] = (keys / name).read_bytes()
            except OSError as error:
                raise IdentityError(f"{keys / name} cannot be read: {error.strerror}") from error
    identity, _ = identity_from_files(files, password)  # refuse what could not be used before anything is written
    home.path.mkdir(mode=0o700, parents=True, exist_ok=True)
    home.identity.mkdir(mode=0o700, exist_ok=True)
    home.readers.mkdir(mode=0o755, exist_ok=True)
    for name, content in files.items():
        write_atomically(home.identity / name, content, mode=0o600 if name.endswith(".key.pem") else 0o644)
    for number, reader in enumerate(bundle.readers):
        write_atomically(home.readers / f"{number}.pem", reader.encode())
    if not home.config.exists():
        write_atomically(home.config, FIRST_CONFIG.encode())
    # The operator made the certificates at a time that has passed: a robot whose clock begins in 1970 may connect.
    home.raise_clock_floor(identity.public.not_before.timestamp())
    home.save_bridge(
        BridgeEnd(bundle.name, bundle.server_name, bundle.server_address, bundle.contract, bundle.chain_id)
    )


def reader_keys(config: RobotConfig, home: RobotHome, roots: tuple[x509.Certificate, ...]) -> list[sm2.PublicKey]:
    """The encryption keys of everybody who may read. Each file holds a reader's two certificates, signing first."""
    trust, keys = Trust(roots), []
    for path in config.reader_files(home.readers):
        found = read_certificates(path.read_bytes())
        if len(found) != 2:
            raise ConfigError(f"{path} holds {len(found)} certificates; a reader has two, signing and encryption")
        signing, encryption = found
        peer = trust.check(
            signing.to_der(), encryption.to_der(), role=Role.READER, at=max(signing.not_before, encryption.not_before)
        )
        keys.append(peer.encryption_certificate.public_key)
    return keys


def open_robot(
    home: RobotHome,
    config: RobotConfig,
    password: bytes,
    *,
    on_captured: Callable[[CapturedRecord], None] = lambda record: None,
) -> Robot:
    """The robot of this home, ready to `run`. Raises ConfigError, IdentityError, SourceError, StoreError."""
    end = home.bridge()
    identity, roots = load_identity(home.identity, password)
    if config.name is not None and config.name != identity.name:
        raise ConfigError(f"name is {config.name!r}, but this home's certificate says {identity.name!r}; drop the key")
    readers = reader_keys(config, home, roots)
    source_config, _ = config.source_and_why(os.environ)
    source = open_source(source_config.settings(), config.selection())
    capture = Capture(config.rules(), live=source.live)
    for topic, decoders in source.decoders().items():
        for decoder in decoders:
            capture.check(topic, decoder)  # a field that a type does not have is told now, not at its first message
    if isinstance(source, BagSource):
        _say_what_is_outside(config.rules(), source.span)
    spool = Spool(
        home.spool,
        identity.public.robot_id,
        SpoolLimits(records=config.spool.max_records, bytes=config.spool.max_size, window=config.spool.commit),
    )
    sealer = _sealer(identity, readers, config, spool)
    recorder = Recorder(capture, sealer, spool)
    now = time.monotonic()
    client = Client(
        ClientConfig(mode=MODES[config.channel]), identity, Trust(roots), end.server_name, now,
        wall=certificate_clock(home),
    )
    sender = Sender(
        client,
        spool,
        release=config.acknowledge,
        channel=config.channel,
        before_sending=lambda: recorder.declare_dropped(wall_ns=time.time_ns(), now=time.monotonic()),
        on_server_time=home.raise_clock_floor,
    )
    socket, address = client_socket(config.server or parse_server(end.server_address))
    loop = UdpLoop(client, socket, lambda event: sender.handle(event, time.monotonic()))
    client.connect(address, now)
    return Robot(
        source=source, recorder=recorder, sender=sender, spool=spool, client=client, loop=loop,
        on_captured=on_captured,
    )


def _say_what_is_outside(rules: Sequence[TopicRule], span: tuple[int, int]) -> None:
    """A rule that nothing in a recording can meet captures nothing, and would do so without a word."""
    first, last = span
    if first > last:
        return  # the source has said that it replays nothing
    for rule in rules:
        key = (
            "at" if rule.at_ns is not None and rule.at_ns > last
            else "from" if rule.from_ns is not None and rule.from_ns > last
            else "until" if rule.until_ns is not None and rule.until_ns <= first
            else None
        )
        if key is not None:
            log.warning(
                "%s: `%s` leaves nothing to capture: what is replayed of the recording goes from %s to %s",
                rule.topic, key, time_text(first), time_text(last),
            )


def parse_server(text: str) -> Address:
    host, _, port = text.rpartition(":")
    return Address(host.strip("[]"), int(port))


def _sealer(identity: Identity, readers: list[sm2.PublicKey], config: RobotConfig, spool: Spool) -> Sealer:
    return Sealer(
        identity.public.robot_id,
        partial(sign, identity.signing_key),
        readers,
        previous=spool.last,
        limits=StreamLimits(records=config.stream.records, age_ns=config.stream.age),
    )

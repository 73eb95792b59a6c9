"""How a robot joins: its request, the bundle that answers it, and the home that it makes of them.

    {"format": "rosbridge-eth request 2", "name": …, "signing": PEM, "encryption": PEM}
    {"format": "rosbridge-eth bundle 3", "name": …, "end": …, "certificates": …, "readers": …, "signature": …}

A request holds two certificate requests (PKCS#10), signed by the keys that they name and that never leave the robot.
A bundle that answers one holds nothing secret. The CA whose certificate is in it signs it, so that nobody else changes
anything of it unseen; the fingerprint of that certificate is compared with the operator's. Where the operator made the
keys (easy_register of the paper), they are in it, encrypted under the registration password, and the whole is a sealed
box (files) under that password.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Sequence
from contextlib import nullcontext, suppress
from dataclasses import asdict, dataclass, field, replace
from typing import NamedTuple

from pydantic import TypeAdapter

from rosbridge_eth import identity as ids
from rosbridge_eth.config.home import BridgeEnd, HomeKind, RobotHome, home_of, make_home, new_home, require_empty
from rosbridge_eth.config.values import parse_address
from rosbridge_eth.errors import BridgeError, ConfigError, IdentityError
from rosbridge_eth.files import box_head, open_box, seal_box, write_atomically
from rosbridge_eth.identity import CERTIFICATE_FILES, KEY_FILES, check_name
from smcrypto import InvalidSignature, SMCryptoError, sm2, x509

log = logging.getLogger(__name__)

FIRST_CONFIG = """\
# What this robot sends to the chain; docs/configuration.md describes every key.
topics = ["/robot_1/odom"]
"""
BUNDLE, REQUEST = "rosbridge-eth bundle 3", "rosbridge-eth request 2"


@dataclass(frozen=True, slots=True)
class Request:
    """What a robot that made its own keys asks the operator to certify."""

    name: str
    signing: x509.CertificateSigningRequest
    encryption: x509.CertificateSigningRequest

    @staticmethod
    def make(name: str, signing_key: sm2.PrivateKey, encryption_key: sm2.PrivateKey) -> Request:
        return Request(name, *ids.requests(name, signing_key, encryption_key))

    def encode(self) -> bytes:
        signing, encryption = self.signing.to_pem().decode(), self.encryption.to_pem().decode()
        head = {"format": REQUEST, "name": self.name, "signing": signing, "encryption": encryption}
        return json.dumps(head, indent=1).encode() + b"\n"

    @staticmethod
    def decode(data: bytes) -> Request:
        """IdentityError where it is none. Its signatures are checked where it is certified."""
        head = box_head(data, REQUEST)
        try:
            pair = [x509.CertificateSigningRequest.from_pem(head[key].encode()) for key in ("signing", "encryption")]
            return Request(check_name(head["name"]), *pair)
        except (SMCryptoError, KeyError, AttributeError) as error:
            raise IdentityError("this request file was damaged") from error


@dataclass(frozen=True, slots=True)
class Bundle:
    """What a robot needs besides its topics.

    certificates: sign.crt.pem, enc.crt.pem and ca.crt.pem. keys: sign.key.pem and enc.key.pem where the operator
    made them, otherwise nothing. readers: name to two certificates in PEM. signature: r | s in hex, of the CA for the
    purpose "bundle", over all but keys and signature as JSON, members in order of their names, without spaces.
    """

    end: BridgeEnd
    certificates: dict[str, str]
    readers: dict[str, str]
    keys: dict[str, str] = field(default_factory=dict, repr=False)
    signature: str = ""

    def _signed(self) -> bytes:
        parts = {"end": asdict(self.end), "certificates": self.certificates, "readers": self.readers}
        return json.dumps(parts, sort_keys=True, separators=(",", ":")).encode()

    def signed(self, ca: sm2.PrivateKey) -> Bundle:
        return replace(self, signature=ids.sign(ca, "bundle", self._signed()).hex())

    def verify(self, ca: sm2.PublicKey) -> None:
        """Return if the CA signed this; else IdentityError."""
        try:
            ids.verify(ca, "bundle", self._signed(), bytes.fromhex(self.signature))
        except (ValueError, InvalidSignature):
            raise IdentityError(
                "this bundle is not what the CA signed: it was altered on its way; have the operator give it again"
            ) from None

    def encode(self, password: bytes | None = None) -> bytes:
        """The bundle as a file's bytes; with keys it needs a password, without it takes none."""
        head = {"format": BUNDLE, "name": self.end.robot}
        if self.keys:
            return seal_box(json.dumps(asdict(self)).encode(), password or b"", head)
        return json.dumps({**head, **asdict(self)}, indent=1).encode() + b"\n"


def needs_password(data: bytes) -> bool:
    """Whether a bundle is sealed, because keys are in it; IdentityError where it is no bundle."""
    return "sealed" in box_head(data, BUNDLE)


def read_bundle(data: bytes, password: bytes | None = None) -> Bundle:
    """The bundle in `data`; IdentityError where it is none, was altered, or the password is another."""
    content = box_head(data, BUNDLE)
    try:
        if "sealed" in content:
            content = json.loads(open_box(data, password or b"", BUNDLE)[1])
        bundle = TypeAdapter(Bundle).validate_python(content)
        for name in (bundle.end.robot, bundle.end.server_name, *bundle.readers):  # most become names of files
            check_name(name)
        if bundle.certificates.keys() != set(CERTIFICATE_FILES) or bundle.keys.keys() not in (set(), set(KEY_FILES)):
            raise ValueError
        addresses = [parse_address(server) for server in bundle.end.servers]
        if not addresses or not bundle.end.ledger or len(bundle.end.genesis + bundle.end.contract) != 66 + 42:
            raise ValueError
    except (ValueError, OverflowError):
        raise IdentityError("this bundle file was damaged") from None
    for address in addresses:
        if address.nowhere:
            raise IdentityError(f"this bundle tells its robot to send to {address}, which no machine can have")
    return bundle


# On the robot


def ask_to_join(home: RobotHome, name: str, password: bytes, config: str = FIRST_CONFIG) -> Request:
    """Make a robot's home with keys of its own and this robot.toml, and the request that a bundle answers."""
    check_name(name)
    with new_home(home.path):
        _make_folders(home, config)
        keys = [sm2.PrivateKey.generate() for _ in KEY_FILES]
        ids.write_files(home.identity, {name: key.to_pem(password) for name, key in zip(KEY_FILES, keys, strict=True)})
        request = Request.make(name, *keys)
        write_atomically(home.request, request.encode())
        make_home(home.path, HomeKind.ROBOT, name=name)
    return request


class Joined(NamedTuple):
    """With what a robot joined. readers: for whom it seals.

    ca: fingerprint of its certificate (SM3, hex), to be compared with the operator's: who could exchange the bundle on
    its way could have made it with a CA of his own.
    """

    ca: str
    readers: Sequence[str]


def join(home: RobotHome, bundle: Bundle, password: bytes | None = None) -> Joined:
    """Complete a robot's home with the bundle that answers its request, or make it of a bundle that holds keys.

    A home may join again where its keys were certified again; its readers are then those of the bundle alone. A bundle
    that was made before the one that the home has is refused: its readers may have been revoked since. A reader whose
    certificates end later is left out where the robot seals (robot.reader_keys), by its clock.
    """
    files = {name: content.encode() for name, content in {**bundle.certificates, **bundle.keys}.items()}
    peer = ids.public_identity(b"".join(files.get(name, b"") for name in ("sign.crt.pem", "enc.crt.pem")))
    if bundle.keys:
        require_empty(home.path)
        ids.identity_from_files(files, password)  # refuse what could not be used before anything is written
    else:
        _require_answer(home, peer)
    roots = ids.read_certificates(files.get("ca.crt.pem", b""))
    bundle.verify(roots[0].public_key)
    trust = ids.Trust(roots)
    # At a time when they hold: a robot's clock may begin in 1970.
    trust.check(*peer.pair, role=ids.Role.ROBOT, name=bundle.end.robot, at=peer.not_before)
    for name, pem in bundle.readers.items():
        reader = ids.public_identity(pem.encode())
        trust.check(*reader.pair, role=ids.Role.READER, name=name, at=max(peer.not_before, reader.not_before))
    before = None
    with suppress(OSError, BridgeError):  # absent, or damaged, which joining again repairs
        before = ids.public_identity(b"".join((home.identity / name).read_bytes() for name in CERTIFICATE_FILES[:2]))
    if before is not None and peer.not_before < before.not_before:
        raise IdentityError("this bundle is older than the one that this robot joined with; have it registered again")
    known = None
    with suppress(ConfigError):  # absent, or damaged, which joining again repairs
        known = home.bridge().ledger
    if known not in (None, bundle.end.ledger):
        raise ConfigError(f"{home.path} writes to another ledger already; choose another folder")
    with new_home(home.path) if bundle.keys else nullcontext():
        _make_folders(home)
        ids.write_files(home.identity, files)
        for name, pem in bundle.readers.items():
            write_atomically(home.readers / f"{name}.pem", pem.encode())
        others = sorted(file for file in home.readers.glob("*.pem") if file.stem not in bundle.readers)
        for file in others:
            file.unlink()
        if others:
            log.warning("no longer sealed for %s: the bundle does not name them",
                        ", ".join(file.stem for file in others))  # fmt: skip
        home.raise_clock_floor(peer.not_before.timestamp())
        home.save_bridge(bundle.end)
        make_home(home.path, HomeKind.ROBOT, name=bundle.end.robot)
    return Joined(roots[0].fingerprint().hex(), sorted(bundle.readers))


def join_with_answer(home: RobotHome) -> Joined | None:
    """Join with the bundle that was put into the home (RobotHome.answer), which then goes; None where there is none.

    A robot that has joined goes on as it is where that fails.
    """
    if not home.answer.exists():
        return None
    try:
        joined = join(home, read_bundle(home.answer.read_bytes()))
    except (BridgeError, OSError) as error:
        said = f"{home.answer} is not used: {error}"
        if not home.bridge_file.exists():
            raise IdentityError(said) from error
        log.error("%s", said)
        return None
    home.answer.unlink()
    return joined


def _require_answer(home: RobotHome, peer: ids.PeerIdentity) -> None:
    """Return if the certificates are for the keys of this home's request."""
    fix = "this bundle answers the request of a robot that made its own keys: join in that robot's home"
    home_of(home.path, HomeKind.ROBOT, fix)
    if not home.request.exists():
        raise IdentityError(f"{home.path} has made no request that this bundle could answer; join in a new folder")
    request = Request.decode(home.request.read_bytes())
    ours = (request.name, request.signing.public_key, request.encryption.public_key)
    if ours != (peer.name, peer.signing_certificate.public_key, peer.encryption_certificate.public_key):
        raise IdentityError(f"this bundle answers another request than {home.request}: it is for other keys")


def _make_folders(home: RobotHome, config: str = FIRST_CONFIG) -> None:
    """The folders of a robot's home, and the configuration that it begins with."""
    home.readers.mkdir(mode=0o700, parents=True, exist_ok=True)
    home.path.chmod(0o700)
    if not home.config.exists():
        write_atomically(home.config, config.encode())

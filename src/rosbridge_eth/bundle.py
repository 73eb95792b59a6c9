"""What robot and operator give each other when a robot joins: its request, and the bundle that answers it.

    {"format": "rosbridge-eth request 2", "name": …, "signing": PEM, "encryption": PEM}
    {"format": "rosbridge-eth bundle 2", "name": …, "server_name": …, …}

A request holds two certificate requests (PKCS#10), signed by the keys that they name and that never leave the robot.
A bundle that answers one holds nothing secret. Where the operator made the keys (easy_register of the paper), they
are in it, encrypted under the registration password, and the whole is a sealed box (files) under that password.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from typing import Any

from rosbridge_eth.errors import IdentityError
from rosbridge_eth.files import box_head, open_box, seal_box
from rosbridge_eth.home import BridgeEnd
from rosbridge_eth.identity import check_name, requests
from smcrypto import SMCryptoError, sm2, x509

BUNDLE, REQUEST = "rosbridge-eth bundle 2", "rosbridge-eth request 2"


@dataclass(frozen=True, slots=True)
class Request:
    """What a robot that made its own keys asks the operator to certify."""

    name: str
    signing: x509.CertificateSigningRequest
    encryption: x509.CertificateSigningRequest

    @staticmethod
    def make(name: str, signing_key: sm2.PrivateKey, encryption_key: sm2.PrivateKey) -> Request:
        return Request(name, *requests(name, signing_key, encryption_key))

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
    made them, otherwise nothing. readers: name to two certificates in PEM.
    """

    end: BridgeEnd
    certificates: dict[str, str]
    readers: dict[str, str]
    keys: dict[str, str] = field(default_factory=dict, repr=False)

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
    content: dict[str, Any] = box_head(data, BUNDLE)
    try:
        if "sealed" in content:
            content = json.loads(open_box(data, password or b"", BUNDLE)[1])
        end = BridgeEnd(**content["end"])
        for name in (end.robot, *content["readers"]):  # they become names of files
            check_name(name)
        return Bundle(end, dict(content["certificates"]), dict(content["readers"]), dict(content["keys"]))
    except (KeyError, TypeError, ValueError) as error:
        raise IdentityError("this bundle file was damaged") from error

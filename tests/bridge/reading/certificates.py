"""Registrations of robot_1 that keep the table of docs/log.md (Certificates), and that break it in one point each."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from datetime import timedelta
from typing import Any, NamedTuple

from bridge.reading.world import NAME, START, authority
from rosbridge_eth.identity import ENCRYPTION_USAGE, SIGNING_USAGE, CertificateAuthority, Identity, Role, create_ca
from smcrypto import der, sm2, x509
from smcrypto.x509 import extensions as ext

URI = f"URI:urn:rosbridge-eth:robot:{NAME}"
END = START + timedelta(days=800)
UNKNOWN = "1.2.156.999.1"


def ca_with(path_length: int | None, **more: Any) -> CertificateAuthority:
    key = sm2.PrivateKey.generate()
    made = x509.self_signed(
        key, subject={"CN": f"CA {key.public_key.to_bytes().hex()[:32]}"}, not_before=START - timedelta(days=1),
        not_after=END, path_length=path_length, **more,
    )  # fmt: skip
    return CertificateAuthority(key, made)


CAS = [authority(), ca_with(1), ca_with(None), ca_with(0, extended_key_usage=("clientAuth",)),
       ca_with(0, extended_key_usage=("serverAuth",)),
       ca_with(0, extensions=[ext.Extension(ext.NAME_CONSTRAINTS, False, b"\x30\0")])]  # fmt: skip
"""Those that are believed."""


def certificate(
    key: sm2.PrivateKey, usage: Sequence[str], *, ca: CertificateAuthority | None = None, basic: bool | None = False,
    purposes: Sequence[str] = (), names: Sequence[str] = (URI,), further: Sequence[ext.Extension] = (),
) -> x509.Certificate:  # fmt: skip
    """basic: cA; None: without basicConstraints."""
    ca = ca or authority()
    request = x509.CertificateSigningRequest.create(key, subject={"CN": NAME})
    made = x509.issue(
        request, ca.certificate, ca.key, not_before=START, not_after=END, ca=bool(basic), key_usage=usage,
        extended_key_usage=purposes, subject_alt_names=names, extensions=further,
    )  # fmt: skip
    return made if basic is not None else without_basic_constraints(made, ca)


def without_basic_constraints(made: x509.Certificate, ca: CertificateAuthority) -> x509.Certificate:
    """In its place stands an extension that nobody knows, and that is not critical, of the same size."""
    old, new = bytes.fromhex("300c0603551d130101ff04023000"), bytes.fromhex("300c0603551d63 04053003020100")
    whole = made.to_der()
    size = 4 + int.from_bytes(whole[6:8], "big")
    body = whole[4 : 4 + size].replace(old, new)
    assert body != whole[4 : 4 + size]
    algorithm = bytes.fromhex("300a06082a811ccf55018375")
    return x509.Certificate.from_der(der.sequence(body, algorithm, der.bit_string(ca.key.sign(body))))


class Case(NamedTuple):
    name: str
    good: bool
    identity: Identity
    registered: bytes


def cases() -> Iterator[Case]:
    critical, other = (ext.Extension(UNKNOWN, wrong, b"\5\0") for wrong in (True, False))
    policies = ext.Extension(ext.CERTIFICATE_POLICIES, True, bytes.fromhex("30083006060455 1d2000"))
    stranger = create_ca("Test CA", at=START)  # of the same name as the CA, with another key
    signing, encryption = SIGNING_USAGE, ENCRYPTION_USAGE
    for name, good, both, first, second in (
        ("as enrolled", True, {}, {}, {}),
        ("also for lists", True, {}, {"usage": (*SIGNING_USAGE, "cRLSign")}, {}),
        ("an extension that nobody knows", True, {"further": [other]}, {}, {}),
        ("keyAgreement alone", True, {}, {}, {"usage": ("keyAgreement",)}),
        ("basicConstraints absent", True, {"basic": None}, {}, {}),
        ("pathLen 1 of the CA", True, {"ca": CAS[1]}, {}, {}),
        ("no pathLen of the CA", True, {"ca": CAS[2]}, {}, {}),
        ("the CA for clientAuth", True, {"ca": CAS[3]}, {}, {}),
        ("the CA for serverAuth", True, {"ca": CAS[4]}, {}, {}),
        ("name constraints of the CA", False, {"ca": CAS[5]}, {}, {}),
        ("critical policies", True, {"further": [policies]}, {}, {}),
        ("for TLS clients", False, {"purposes": ("clientAuth",)}, {}, {}),
        ("the second for TLS clients", False, {}, {}, {"purposes": ("clientAuth",)}),
        ("as before version 3", False, {"purposes": ("clientAuth",)}, {"usage": ("digitalSignature",)}, {}),
        ("no nonRepudiation", False, {}, {"usage": ("digitalSignature",)}, {}),
        ("encryption with nonRepudiation", False, {}, {}, {"usage": ("nonRepudiation", "keyAgreement")}),
        ("any extendedKeyUsage", False, {"purposes": ("anyExtendedKeyUsage",)}, {}, {}),
        ("for servers", False, {"purposes": ("serverAuth",)}, {}, {}),
        ("cA TRUE", False, {"basic": True}, {}, {}),
        ("cA TRUE of the second", False, {}, {}, {"basic": True}),
        ("keyUsage absent", False, {}, {"usage": ()}, {}),
        ("keyUsage of the second absent", False, {}, {}, {"usage": ()}),
        ("signing with keyAgreement", False, {}, {"usage": (*SIGNING_USAGE, "keyAgreement")}, {}),
        ("no digitalSignature", False, {}, {"usage": ("nonRepudiation",)}, {}),
        ("no keyAgreement", False, {}, {}, {"usage": ("keyEncipherment", "dataEncipherment")}),
        ("encryption with digitalSignature", False, {}, {}, {"usage": ("digitalSignature", "keyAgreement")}),
        ("two names", False, {"names": (URI, "DNS:robot_1")}, {}, {}),
        ("no name", False, {"names": ()}, {}, {}),
        ("another robot", False, {"names": ("URI:urn:rosbridge-eth:robot:robot_2",)}, {}, {}),
        ("a reader", False, {"names": (f"URI:urn:rosbridge-eth:reader:{NAME}",)}, {}, {}),
        ("another robot in the second", False, {}, {}, {"names": ("URI:urn:rosbridge-eth:robot:robot_2",)}),
        ("a critical extension that nobody knows", False, {"further": [critical]}, {}, {}),
        ("another CA", False, {"ca": stranger}, {}, {}),
        ("another CA of the second", False, {}, {}, {"ca": stranger}),
        ("a byte behind", False, {}, {}, {}),
        ("one certificate", False, {}, {}, {}),
    ):  # fmt: skip
        keys = [sm2.PrivateKey.generate() for _ in range(2)]
        pair = [
            certificate(key, **{"usage": usage} | both | more)  # type: ignore[arg-type]
            for key, usage, more in zip(keys, (signing, encryption), (first, second), strict=True)
        ]
        registered = b"".join(one.to_der() for one in pair[: 1 if name == "one certificate" else 2])
        registered += b"\0" * (name == "a byte behind")
        yield Case(name, good, Identity(Role.ROBOT, NAME, pair[0], pair[1], keys[0], keys[1]), registered)

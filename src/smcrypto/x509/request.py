"""Certificate signing requests, PKCS#10: RFC 2986; extensions asked for: RFC 2985, 5.4.2."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Final, NamedTuple

from smcrypto import der, pem, sm2
from smcrypto.errors import CertificateError
from smcrypto.inputs import BytesLike, as_bytes, require_type
from smcrypto.sm2 import keyfiles
from smcrypto.x509 import extensions as ext
from smcrypto.x509.names import Name
from smcrypto.x509.signed import Signed, one_block, parsing, read_signed, sign

__all__ = ["CertificateSigningRequest", "RequestAttribute"]

_EXTENSION_REQUEST: Final = "1.2.840.113549.1.9.14"
# RFC 7468, 7: the second label is older and common.
_LABELS: Final = ("CERTIFICATE REQUEST", "NEW CERTIFICATE REQUEST")


class RequestAttribute(NamedTuple):
    """One attribute: identifier, and its values in DER."""

    oid: str
    values: tuple[bytes, ...]


class CertificateSigningRequest:
    """A name, a public key, and the proof that the sender has the private key. What it asks for, the CA decides."""

    __slots__ = ("_attributes", "_der", "_extensions", "_public_key", "_signed", "_subject", "_verified")

    def __init__(self) -> None:
        raise TypeError("requests come from create, from_pem or from_der")

    @classmethod
    def create(
        cls,
        key: sm2.PrivateKey,
        *,
        subject: Name | str | Mapping[str, str] | Iterable[tuple[str, str]],
        subject_alt_names: Iterable[str] = (),
        key_usage: Iterable[str] = (),
        extended_key_usage: Iterable[str] = (),
        uid: BytesLike = sm2.DEFAULT_UID,
    ) -> CertificateSigningRequest:
        """A request signed by `key` under `uid`; what is not empty of the extensions is asked for.

        InvalidOption: a name, usage or alternative name that cannot be written.
        """
        require_type(key, sm2.PrivateKey, "key")
        name = Name.build(subject)
        wanted = ext.requested(name, subject_alt_names, key_usage, extended_key_usage)
        attributes = []
        if wanted:
            extensions = der.sequence(*(e.to_der() for e in wanted))
            attributes.append(der.sequence(der.oid(_EXTENSION_REQUEST), der.set_of(extensions)))
        body = der.sequence(
            der.integer(0), name.to_der(), key.public_key.to_der(), der.explicit(0, *attributes)
        )
        request = cls.from_der(sign(body, key, as_bytes(uid, "uid")))
        request._verified = True
        return request

    @classmethod
    def from_pem(cls, data: BytesLike) -> CertificateSigningRequest:
        """The first request in `data`; text and other blocks around it are skipped."""
        return cls.from_der(one_block(as_bytes(data, "data"), _LABELS, "certificate signing request"))

    @classmethod
    def from_der(cls, data: BytesLike) -> CertificateSigningRequest:
        """CertificateError for anything but one DER request with an SM2 key. The signature is left to `verify`."""
        request = cls.__new__(cls)
        with parsing("certificate signing request"):
            request._read(as_bytes(data, "data"))
        return request

    def _read(self, data: bytes) -> None:
        self._der = data
        self._verified = False
        self._signed: Signed = read_signed(data)
        body = self._signed.fields()
        version = body.integer()
        if version != 0:
            raise CertificateError(f"request version {version}")
        self._subject = Name.read(body)
        self._public_key = sm2.PublicKey.from_bytes(keyfiles.load_public(body.raw(), form="der"))
        # RFC 2986 wants [0] even when it is empty; some software leaves it out then.
        self._attributes = _read_attributes(body.implicit_set_of(0)) if body.has_explicit(0) else ()
        body.finish()
        self._extensions = _requested_extensions(self._attributes)
        # Read now, so that a request whose extensions cannot be read is refused as a whole.
        self.subject_alt_names, self.key_usage, self.extended_key_usage  # noqa: B018

    @property
    def subject(self) -> Name:
        """The name that is asked for."""
        return self._subject

    @property
    def public_key(self) -> sm2.PublicKey:
        """The SM2 key to be certified."""
        return self._public_key

    @property
    def attributes(self) -> tuple[RequestAttribute, ...]:
        """All attributes, in their order (RFC 2986, 4.1)."""
        return self._attributes

    @property
    def extensions(self) -> tuple[ext.Extension, ...]:
        """The extensions asked for."""
        return self._extensions

    def _value(self, oid: str) -> bytes | None:
        return next((e.value for e in self._extensions if e.oid == oid), None)

    @property
    def subject_alt_names(self) -> tuple[str, ...]:
        """The alternative names asked for, as in `Certificate.subject_alt_names`."""
        value = self._value(ext.SUBJECT_ALT_NAME)
        return () if value is None else ext.read_subject_alt_names(value)

    @property
    def key_usage(self) -> frozenset[str] | None:
        """The usages asked for, by name; None if nothing is said."""
        value = self._value(ext.KEY_USAGE)
        return None if value is None else ext.read_key_usage(value)

    @property
    def extended_key_usage(self) -> tuple[str, ...] | None:
        """The purposes asked for, by name or dotted identifier; None if nothing is said."""
        value = self._value(ext.EXTENDED_KEY_USAGE)
        return None if value is None else ext.read_extended_key_usage(value)

    @property
    def verified(self) -> bool:
        """Did `verify` succeed on this object, or was it made here?"""
        return self._verified

    def verify(self, *, uid: BytesLike = sm2.DEFAULT_UID) -> None:
        """CertificateError unless the key in the request made its signature under `uid`."""
        self._signed.verify(self._public_key, as_bytes(uid, "uid"), f"the request of {self._subject or 'nobody'}")
        self._verified = True

    def to_der(self) -> bytes:
        """The bytes it was read from, or made as."""
        return self._der

    def to_pem(self) -> bytes:
        """The same as PEM, label CERTIFICATE REQUEST."""
        return pem.encode(_LABELS[0], self._der)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, CertificateSigningRequest):
            return NotImplemented
        return self._der == other._der

    def __hash__(self) -> int:
        return hash(self._der)

    def __repr__(self) -> str:
        return f"<CertificateSigningRequest {self._subject}>"


def _read_attributes(reader: der.Reader) -> tuple[RequestAttribute, ...]:
    attributes: list[RequestAttribute] = []
    while not reader.at_end():
        one = reader.sequence()
        oid = one.oid()
        members = one.set_of()
        one.finish()
        values: list[bytes] = []
        while not members.at_end():
            values.append(members.checked())
        if not values:
            raise CertificateError(f"attribute {oid} has no value")
        attributes.append(RequestAttribute(oid, tuple(values)))
    return tuple(attributes)


def _requested_extensions(attributes: tuple[RequestAttribute, ...]) -> tuple[ext.Extension, ...]:
    """All that is asked for; Java's tools ask for each extension in an attribute of its own."""
    found: list[ext.Extension] = []
    for attribute in attributes:
        if attribute.oid == _EXTENSION_REQUEST:
            if len(attribute.values) != 1:
                raise CertificateError("a request for extensions has not exactly one value")
            reader = der.Reader(attribute.values[0])
            found += ext.read_extensions(reader)
    if len({extension.oid for extension in found}) != len(found):
        raise CertificateError("an extension is asked for twice")
    return tuple(found)

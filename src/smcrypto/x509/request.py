"""Certificate signing requests, PKCS#10: RFC 2986; extensions asked for: RFC 2985, 5.4.2."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Final, NamedTuple

from smcrypto import der, sm2
from smcrypto.errors import CertificateError
from smcrypto.inputs import BytesLike, as_bytes, require_type
from smcrypto.x509 import extensions as ext
from smcrypto.x509.names import Name
from smcrypto.x509.signed import Signed, sign

__all__ = ["CertificateSigningRequest", "RequestAttribute"]

_EXTENSION_REQUEST: Final = "1.2.840.113549.1.9.14"


class RequestAttribute(NamedTuple):
    """One attribute: identifier, and its values in DER."""

    oid: str
    values: tuple[bytes, ...]


@dataclass(frozen=True, slots=True, init=False, eq=False, repr=False)
class CertificateSigningRequest(Signed):
    """A name, a public key, and the proof that the sender has the private key. What it asks for, the CA decides."""

    KIND = "certificate signing request"
    LABELS = ("CERTIFICATE REQUEST", "NEW CERTIFICATE REQUEST")  # RFC 7468, 7: the second is older and common

    subject: Name
    """The name that is asked for."""
    public_key: sm2.PublicKey
    """The SM2 key to be certified."""
    attributes: tuple[RequestAttribute, ...]
    """All attributes, in their order (RFC 2986, 4.1)."""
    extensions: tuple[ext.Extension, ...]
    """The extensions asked for."""
    subject_alt_names: tuple[str, ...]
    """The alternative names asked for, as in `Certificate.subject_alt_names`."""
    key_usage: frozenset[str] | None
    """The usages asked for, by name; None if nothing is said."""
    extended_key_usage: tuple[str, ...] | None
    """The purposes asked for, by name or dotted identifier; None if nothing is said."""

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
        body = der.sequence(der.integer(0), name.to_der(), key.public_key.to_der(), der.explicit(0, *attributes))
        return cls.from_der(sign(body, key, as_bytes(uid, "uid")))

    def _read(self, body: der.Reader) -> None:
        version = body.integer()
        if version != 0:
            raise CertificateError(f"request version {version}")
        subject = Name.read(body)
        public_key = sm2.PublicKey.from_der(body.raw())
        # RFC 2986 wants [0] even when it is empty; some software leaves it out then.
        attributes = tuple(body.implicit_set_of(0).each(_read_attribute)) if body.has_explicit(0) else ()
        extensions: list[ext.Extension] = []
        for attribute in attributes:  # Java's tools ask for each extension in an attribute of its own
            if attribute.oid == _EXTENSION_REQUEST:
                if len(attribute.values) != 1:
                    raise CertificateError("a request for extensions has not exactly one value")
                extensions += der.parse(attribute.values[0], ext.read_extensions)
        ext.require_distinct(extensions)
        self._fill(
            subject=subject, public_key=public_key, attributes=attributes, extensions=tuple(extensions),
            **ext.values(extensions, "subject_alt_names", "key_usage", "extended_key_usage"),
        )  # fmt: skip

    def verify(self, *, uid: BytesLike = sm2.DEFAULT_UID) -> None:
        """CertificateError unless the key in the request made its signature under `uid`."""
        self._verify(self.public_key, as_bytes(uid, "uid"), f"the request of {self.subject or 'nobody'}")

    def __repr__(self) -> str:
        return f"<CertificateSigningRequest {self.subject}>"


def _read_attribute(reader: der.Reader) -> RequestAttribute:
    one = reader.sequence()
    attribute = RequestAttribute(one.oid(), tuple(one.set_of().rest()))
    if not attribute.values:
        raise CertificateError(f"attribute {attribute.oid} has no value")
    return attribute

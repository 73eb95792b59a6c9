"""The one error of this package, and the alerts it names: RFC 8446, 6; GB/T 38636-2020, 6.3.4."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from enum import IntEnum

from smcrypto.errors import SMCryptoError

__all__ = ["Alert", "TLSError", "refusing", "require"]


class Alert(IntEnum):
    """Alert descriptions that are sent or understood; a received one that is not here counts as internal_error."""

    close_notify, unexpected_message, bad_record_mac, record_overflow = 0, 10, 20, 22
    handshake_failure, bad_certificate, unsupported_certificate = 40, 42, 43
    certificate_revoked, certificate_expired, certificate_unknown = 44, 45, 46
    illegal_parameter, unknown_ca, access_denied, decode_error, decrypt_error = 47, 48, 49, 50, 51
    protocol_version, insufficient_security, internal_error, user_canceled = 70, 71, 80, 90
    no_renegotiation, missing_extension, unsupported_extension, unrecognized_name = 100, 109, 110, 112
    unknown_psk_identity, certificate_required, no_application_protocol = 115, 116, 120

    @classmethod
    def of(cls, number: int) -> Alert:
        return next((alert for alert in cls if alert == number), cls.internal_error)


class TLSError(SMCryptoError):
    """The connection failed and cannot go on.

    alert: what is wrong, as it is told to the peer (it then stands in `Connection.data_to_send`), or as the peer
    told it. A stream that ends without close_notify is close_notify: nothing is sent for it.
    """

    def __init__(self, alert: Alert, text: str) -> None:
        super().__init__(f"{text} ({alert.name})")
        self.alert = alert


def require(holds: object, alert: Alert, text: str) -> None:
    """TLSError unless what the peer sent is as it has to be."""
    if not holds:
        raise TLSError(alert, text)


@contextmanager
def refusing(alert: Alert, text: str) -> Iterator[None]:
    """What the peer sent proves to be no key, signature, ciphertext or certificate: the TLSError that says so."""
    try:
        yield
    except SMCryptoError as error:
        raise TLSError(alert, f"{text}: {error}") from None

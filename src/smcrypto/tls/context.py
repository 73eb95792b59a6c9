"""Configuration of connections, shared by any number of them, as `ssl.SSLContext` is."""

from __future__ import annotations

import secrets
from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import datetime, timezone
from typing import TYPE_CHECKING, Final, Literal

from smcrypto.errors import InvalidOption
from smcrypto.sm2 import PrivateKey
from smcrypto.tls.events import Session
from smcrypto.x509 import AnyCertificate, Certificate

if TYPE_CHECKING:
    import socket

    from smcrypto.tls.sockets import SMSocket

__all__ = ["SUITES", "SMContext", "expect"]

SUITES: Final = {
    "ECDHE_SM4_GCM_SM3": (0xE051, "TLCPv1.1"),
    "ECDHE_SM4_CBC_SM3": (0xE011, "TLCPv1.1"),
    "ECC_SM4_GCM_SM3": (0xE053, "TLCPv1.1"),
    "ECC_SM4_CBC_SM3": (0xE013, "TLCPv1.1"),
    "TLS_SM4_GCM_SM3": (0x00C6, "TLSv1.3"),
    "TLS_SM4_CCM_SM3": (0x00C7, "TLSv1.3"),
}
"""The suites by name: number (GB/T 38636-2020, table 2; RFC 8998, 2) and version."""

MAX_SESSIONS: Final = 1000  # that a server's context remembers


def _now() -> datetime:
    return datetime.now(timezone.utc)


@dataclass(kw_only=True, eq=False)
class SMContext:
    """What a client or server is, trusts and allows. Not to be changed once a connection uses it.

    InvalidOption where the fields do not fit together.
    """

    versions: tuple[str, ...] = ("TLCPv1.1", "TLSv1.3")
    """Versions allowed. A server takes the one that the client asks for; a client asks for the first one only."""
    suites: tuple[str, ...] = tuple(SUITES)
    """Cipher suites by their standard names, the best first. A server takes its own best that the client offers.
    A client without an encryption certificate does not offer ECDHE of TLCP, which needs one."""
    roots: tuple[AnyCertificate, ...] = ()
    """The CAs that are trusted for the peer's certificates."""
    certificates: tuple[AnyCertificate, ...] = ()
    """One's own: the (signing) certificate, then the CAs' up to the root, which may be left out."""
    key: PrivateKey | None = field(default=None, repr=False)
    """Of the first of `certificates`."""
    encryption_certificate: Certificate | None = None
    """TLCP's second certificate, issued by the same CA. A server that allows TLCP needs one; a client does for ECDHE,
    and leaves it out for GmSSL 3.1's servers, which take but one."""
    encryption_key: PrivateKey | None = field(default=None, repr=False)
    """Of the encryption certificate."""
    verify_client: Literal["none", "optional", "required"] = "none"
    """A server's: does it ask for the client's certificate, and may the client have none? ECDHE of TLCP always
    requires one."""
    check_hostname: bool = True
    """A client's: must the server's certificate be for `server_hostname`? If False that may be None."""
    sni: bool = True
    """A client's: tell the server which name is wanted (RFC 6066, 3)? GmSSL 3.1's servers of TLCP refuse every
    extension of the hello, as GB/T 38636-2020 defines none; for them False, and no `alpn`."""
    alpn: tuple[str, ...] = ()
    """Application protocols, the best first. A server that knows none of the client's refuses (RFC 7301, 3.2)."""
    now: Callable[[], datetime] = field(default=_now, repr=False)
    """The clock, aware datetimes."""
    random: Callable[[int], bytes] = field(default=secrets.token_bytes, repr=False)
    """Random bytes for hello messages, secrets, session ids and nonces, but not for SM2 keys and signatures."""
    sessions: dict[bytes, Session] = field(default_factory=dict, init=False, repr=False)
    """A server's: what it can resume, by identity; the oldest go first."""

    def __post_init__(self) -> None:
        unknown = {*self.versions} - {"TLCPv1.1", "TLSv1.3"} | {*self.suites} - {*SUITES}
        expect(not unknown, f"there is no version or suite {unknown}; there are TLCPv1.1, TLSv1.3; {', '.join(SUITES)}")
        expect(self.versions, "no version is allowed")
        for version in self.versions:
            expect(self.suites_of(version), f"no suite of {version} is allowed")
        own = self.certificates[0] if self.certificates else None
        pairs = (own, self.key, "signing"), (self.encryption_certificate, self.encryption_key, "encryption")
        for certificate, key, name in pairs:
            same = getattr(certificate, "public_key", None) == (None if key is None else key.public_key)
            expect(same, f"the {name} key is not that of the {name} certificate; both are given or none")
        expect(own or self.encryption_key is None, "an encryption certificate needs a signing certificate beside it")
        expect(all(0 < len(name.encode()) < 256 for name in self.alpn), "protocols of alpn have 1 to 255 bytes")
        asks = ("none", "optional", "required")
        expect(self.verify_client in asks, f"verify_client must be one of {asks}, not {self.verify_client!r}")

    def suites_of(self, version: str) -> tuple[str, ...]:
        """The allowed suites of one version."""
        return tuple(name for name in self.suites if SUITES[name][1] == version)

    def wrap_socket(
        self, sock: socket.socket, server_side: bool = False, do_handshake_on_connect: bool = True,
        server_hostname: str | None = None, session: Session | None = None,
    ) -> SMSocket:  # fmt: skip
        """As `ssl.SSLContext.wrap_socket`: a socket for data in clear, which takes over `sock`, a TCP socket.

        Where `sock` is connected the handshake is made at once, else by `connect`, `accept` or `do_handshake`.
        Where that fails (TLSError, OSError) it is closed.
        """
        from smcrypto.tls.sockets import SMSocket  # imports ssl, which not every Python has

        return SMSocket(sock, self, server_side, server_hostname, session, do_handshake_on_connect)


def expect(holds: object, text: str) -> None:
    if not holds:
        raise InvalidOption(text)

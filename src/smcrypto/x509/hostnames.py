"""Is a certificate for this host? RFC 9525, 6 (which replaced RFC 6125), and RFC 5280, 4.2.1.6.

Names are compared as A-labels (RFC 5890, 2.3.2.1), which are ASCII; turning other letters into them is left to the
caller, because IDNA 2003 and 2008 differ in which host a name means.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from ipaddress import IPv4Address, IPv6Address, ip_address
from typing import Final, TypeAlias

from smcrypto.errors import CertificateHostnameError, InvalidOption

__all__ = ["IPAddress", "require_hostname"]

IPAddress: TypeAlias = IPv4Address | IPv6Address

# RFC 1123, 2.1, and the underscore, which is in use; no name ends in a label of digits alone, as IPv4 addresses do.
_LABEL: Final = r"[a-z0-9_](?:[a-z0-9_-]{0,61}[a-z0-9_])?"
_HOST: Final = re.compile(rf"(?=.{{1,253}}\Z)(?:{_LABEL}\.)*(?![0-9]+\Z){_LABEL}")


def require_hostname(name: str | IPAddress, names: Iterable[str], addresses: Iterable[IPAddress], what: str) -> None:
    """CertificateHostnameError, about `what`, unless `name` is one of `addresses` or matches one of `names`."""
    reference = _reference(name)
    if isinstance(reference, str):
        # 6.3: `*` as the whole left-most label stands for one label; never for one below a top-level domain.
        _, _, parent = reference.partition(".")
        accepted = (reference, f"*.{parent}" if "." in parent else reference)
        found = any(presented.lower() in accepted for presented in names)
    else:
        found = reference in addresses
    if not found:
        known = ", ".join(map(str, (*names, *addresses))) or "no host"
        raise CertificateHostnameError(f"{what} is for {known}, not for {reference}")


def _reference(name: str | IPAddress) -> str | IPAddress:
    if isinstance(name, IPv4Address | IPv6Address):
        return name
    if not isinstance(name, str):
        raise TypeError(f"name must be a str or an IP address, not {type(name).__name__}")
    try:
        return ip_address(name)
    except ValueError:
        host = name.lower().removesuffix(".")
    if not name.isascii() or not _HOST.fullmatch(host):
        raise InvalidOption(f"{name!r} is not a host name in ASCII letters, nor an IP address")
    return host

"""Why a record cannot be sealed or opened, each reason its own class."""

from __future__ import annotations

from rosbridge_eth.errors import BridgeError, ConfigError, VerificationError


class NoReaders(ConfigError):
    """No reader is configured: records that nobody can open are not worth writing."""


class RecordTooLarge(BridgeError):
    """The payload does not fit a record, even compressed; it was not sealed and no seq was used."""


class Malformed(VerificationError):
    """The bytes have not the form of a record. Nothing in them was authenticated."""


class Altered(VerificationError):
    """The bytes are not what was sealed under this identity: the tag does not hold, or another key is named."""


class Forged(VerificationError):
    """The robot's signature does not hold: somebody else made this, even if they knew the stream's key."""


class NoGrant(VerificationError):
    """The stream's key was not encrypted to this reader."""

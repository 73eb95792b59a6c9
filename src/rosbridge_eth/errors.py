"""Every failure of the bridge that a person has to act on, with the exit code it ends a command with.

A message is one sentence that says what is wrong and what to do. Exit codes
are part of the interface: scripts and service managers act on them.
"""

from __future__ import annotations

from enum import IntEnum
from typing import ClassVar


class ExitCode(IntEnum):
    """Exit codes of `python -m rosbridge_eth`; 0 is success, 2 the command line's own usage error."""

    OK = 0
    FAILED = 1
    USAGE = 2
    CONFIG = 3
    IDENTITY = 4
    STORE = 5
    NETWORK = 6
    CHAIN = 7
    SOURCE = 8
    VERIFICATION = 9


class BridgeError(Exception):
    """Base of the bridge's own errors; shown without a traceback."""

    exit_code: ClassVar[ExitCode] = ExitCode.FAILED

    def __init_subclass__(cls, exit_code: ExitCode | None = None) -> None:
        cls.exit_code = exit_code or cls.exit_code


class ConfigError(BridgeError, exit_code=ExitCode.CONFIG):
    """The configuration cannot be used; the text names file, key and the allowed values."""


class IdentityError(BridgeError, exit_code=ExitCode.IDENTITY):
    """A key, certificate, password or bundle is missing, unreadable, refused or not protected."""


class StoreError(BridgeError, exit_code=ExitCode.STORE):
    """A robot's or the server's store, or the registry, cannot be opened or written."""


class NetworkError(BridgeError, exit_code=ExitCode.NETWORK):
    """A socket cannot be opened, or the peer does not answer or is not who it should be."""


class ChainError(BridgeError, exit_code=ExitCode.CHAIN):
    """The node does not answer, refuses, or is not the chain that was expected."""


class SourceError(BridgeError, exit_code=ExitCode.SOURCE):
    """A bag, master or topic cannot be read."""


class VerificationError(BridgeError, exit_code=ExitCode.VERIFICATION):
    """What was read back is not what was written, or cannot be proven to be."""

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
    PROCESS = 10


class BridgeError(Exception):
    """Base of the bridge's own errors; shown without a traceback."""

    exit_code: ClassVar[ExitCode] = ExitCode.FAILED


class ConfigError(BridgeError):
    """The configuration cannot be used; the text names file, key and the allowed values."""

    exit_code = ExitCode.CONFIG


class IdentityError(BridgeError):
    """A key, certificate, password or bundle is missing, unreadable, refused or not protected."""

    exit_code = ExitCode.IDENTITY


class StoreError(BridgeError):
    """The spool, inbox or journal cannot be opened or written, or belongs to another chain."""

    exit_code = ExitCode.STORE


class NetworkError(BridgeError):
    """A socket cannot be opened, or the peer does not answer or is not who it should be."""

    exit_code = ExitCode.NETWORK


class ChainError(BridgeError):
    """The node does not answer, refuses, or is not the chain that was expected."""

    exit_code = ExitCode.CHAIN


class SourceError(BridgeError):
    """A bag, master or topic cannot be read."""

    exit_code = ExitCode.SOURCE


class VerificationError(BridgeError):
    """What was read back is not what was written, or cannot be proven to be."""

    exit_code = ExitCode.VERIFICATION


class ProcessError(BridgeError):
    """A process of the server ends again and again as soon as it is started."""

    exit_code = ExitCode.PROCESS

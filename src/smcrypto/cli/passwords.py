"""Where passwords come from: a file, an environment variable, or a prompt.

Never the command line, which every user of the machine can read in the
process list.
"""

from __future__ import annotations

import argparse
import getpass
import os
import sys
from pathlib import Path

from smcrypto.errors import InvalidKey

__all__ = ["add_arguments", "named", "read_password"]


def add_arguments(parser: argparse.ArgumentParser) -> argparse._MutuallyExclusiveGroup:
    """The options that name a password; of the group that is returned one can be given."""
    group = parser.add_mutually_exclusive_group()
    group.add_argument("--password-file", type=Path, metavar="FILE", help="read the password from FILE's first line")
    group.add_argument("--password-env", metavar="NAME", help="read the password from the environment variable NAME")
    return group


def named(options: argparse.Namespace) -> bool:
    """Whether the options say where the password is."""
    return options.password_file is not None or options.password_env is not None


def read_password(options: argparse.Namespace, prompt: str, *, confirm: bool = False) -> bytes:
    """The password the options name, or the one typed at a prompt; `confirm` asks twice.

    InvalidKey where there is none: an unset variable, an empty file, no terminal to ask at.
    """
    if options.password_file is not None:
        lines = options.password_file.read_bytes().splitlines()
        password = lines[0] if lines else b""
        origin = str(options.password_file)
    elif options.password_env is not None:
        password = os.fsencode(os.environ.get(options.password_env, ""))
        origin = f"environment variable {options.password_env}"
    else:
        if not sys.stdin.isatty():
            raise InvalidKey("a password is needed: give --password-file or --password-env")
        password = os.fsencode(getpass.getpass(f"{prompt}: "))
        if confirm and os.fsencode(getpass.getpass(f"{prompt} (again): ")) != password:
            raise InvalidKey("the two passwords differ")
        origin = "the prompt"
    if not password:
        raise InvalidKey(f"no password in {origin}")
    return password

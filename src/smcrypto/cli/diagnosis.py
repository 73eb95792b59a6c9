"""`diagnose`: what a key, point, signature or ciphertext is, whether it fits, and the call that reads it."""

from __future__ import annotations

import argparse
import sys
from itertools import islice
from pathlib import Path

from smcrypto.cli import passwords
from smcrypto.cli.files import add_input, chunks
from smcrypto.cli.keys import uid_bytes

__all__ = ["add_parser"]


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    parser = subparsers.add_parser(
        "diagnose", help="what is this, and how is it read",
        description="Say what a key, point, signature or ciphertext is (hex, base64, PEM, DER or raw), whether it fits"
                    " a key, and the call that reads it. Exit with 1 where nothing is known of it.")
    parser.add_argument("--key", type=Path, metavar="FILE", help="a private or public key in any form, to try on it")
    parser.add_argument("--message", type=Path, metavar="FILE", help="what a signature should be of")
    parser.add_argument("--uid", metavar="TEXT", help="a distinguishing id to try beside the usual ones")
    passwords.add_arguments(parser)
    add_input(parser)
    parser.set_defaults(run=run_diagnose)


def run_diagnose(options: argparse.Namespace) -> int:
    from smcrypto.diagnosis import diagnose, key_of

    password = passwords.read_password(options, "Password") if passwords.named(options) else None
    found = diagnose(
        b"".join(islice(chunks(options.file), 2)),  # enough to be refused for its length
        key=None if options.key is None else key_of(options.key.read_bytes(), password),
        message=None if options.message is None else options.message.read_bytes(),
        uid=None if options.uid is None else uid_bytes(options.uid),
        password=password,
    )
    print(found, file=sys.stdout if found.readings else sys.stderr)
    return 0 if found.readings else 1

"""`hash` and `hmac`: SM3 of files, printed as sha256sum prints."""

from __future__ import annotations

import argparse
import hmac
from pathlib import Path

from smcrypto import sm3
from smcrypto.cli.files import chunks

__all__ = ["add_parser"]


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    hash_ = subparsers.add_parser("hash", help="SM3 of files", description="Print the SM3 digest of each file.")
    hash_.add_argument("files", nargs="*", default=["-"], metavar="file")
    hash_.set_defaults(run=run_hash)

    mac = subparsers.add_parser("hmac", help="HMAC-SM3 of files",
                                description="Print the HMAC-SM3 of each file under a key kept in a file.")
    mac.add_argument("--key-file", type=Path, required=True, metavar="FILE", help="the key: all bytes of FILE")
    mac.add_argument("files", nargs="*", default=["-"], metavar="file")
    mac.set_defaults(run=run_hmac)


def run_hash(options: argparse.Namespace) -> int:
    return _print_digests(options.files, sm3.SM3())


def run_hmac(options: argparse.Namespace) -> int:
    return _print_digests(options.files, hmac.new(options.key_file.read_bytes(), digestmod=sm3.SM3))


def _print_digests(names: list[str], start: sm3.SM3 | hmac.HMAC) -> int:
    """Lines of sha256sum: a name that would break one is escaped, and a backslash before the digest says so."""
    for name in names:
        state = start.copy()
        for chunk in chunks(name):
            state.update(chunk)
        escaped = name.replace("\\", "\\\\").replace("\n", "\\n").replace("\r", "\\r")
        print(f"{'' if escaped == name else chr(92)}{state.hexdigest()}  {escaped}")
    return 0

"""`keygen` and `pubkey`: SM2 key files that openssl reads; and the arguments by which commands name keys."""

from __future__ import annotations

import argparse
import os
from pathlib import Path

from smcrypto import sm2
from smcrypto.cli import passwords
from smcrypto.cli.files import add_output, require_absent, write_output, write_private
from smcrypto.errors import InvalidOption

__all__ = ["add_key", "add_parser", "add_prf", "add_public", "add_uid", "load_private", "load_public", "uid_bytes"]

_ENCRYPTED = b"ENCRYPTED PRIVATE KEY"


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    keygen = subparsers.add_parser(
        "keygen", help="make a key pair",
        description="Make an SM2 key pair; the private key file is readable by its owner alone.")
    keygen.add_argument("-o", "--output", type=Path, required=True, metavar="FILE", help="the private key (PEM)")
    keygen.add_argument("--public", type=Path, metavar="FILE", help="write the public key (PEM) here too")
    keygen.add_argument("--format", choices=("pkcs8", "sec1"), default="pkcs8", help="default: %(default)s")
    keygen.add_argument("--encrypt", action="store_true",
                        help="encrypt the private key under a password, asked for unless an option names it")
    add_prf(keygen)
    keygen.add_argument("--force", action="store_true", help="overwrite an existing private key")
    passwords.add_arguments(keygen)
    keygen.set_defaults(run=run_keygen)

    pubkey = subparsers.add_parser("pubkey", help="the public key of a private key",
                                   description="Print the public key (PEM) that belongs to a private key.")
    add_key(pubkey)
    add_output(pubkey)
    pubkey.set_defaults(run=run_pubkey)


def add_key(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--key", type=Path, required=True, metavar="FILE", help="private key (PEM)")
    passwords.add_arguments(parser)


def add_prf(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--prf", choices=("sm3", "sha256"), default="sm3",
                        help="hash that makes a key of the password; OpenSSL 3.0 reads sha256 (default: %(default)s)")


def add_public(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--public", type=Path, required=True, metavar="FILE", help="public key (PEM)")


def add_uid(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--uid", default=sm2.DEFAULT_UID.decode(), metavar="TEXT",
                        help="the signer's distinguishing id (default: %(default)s)")


def uid_bytes(text: str) -> bytes:
    """A distinguishing id as it stood on the command line, byte for byte."""
    return os.fsencode(text)


def load_private(path: Path, options: argparse.Namespace) -> sm2.PrivateKey:
    """The key in a file; the password, where it is encrypted, comes from what `options` name.

    One that is named for a key which is not encrypted is InvalidKey: somebody takes the key to be protected.
    """
    data = path.read_bytes()
    wanted = _ENCRYPTED in data or passwords.named(options)
    password = passwords.read_password(options, f"Password for {path}") if wanted else None
    return sm2.PrivateKey.from_pem(data, password=password)


def load_public(path: Path) -> sm2.PublicKey:
    return sm2.PublicKey.from_pem(path.read_bytes())


def run_keygen(options: argparse.Namespace) -> int:
    require_absent(options.output, force=options.force)  # before a password is asked for
    if options.output == options.public:
        raise InvalidOption("-o and --public name the same file")
    wanted = options.encrypt or passwords.named(options)
    password = passwords.read_password(options, "New password", confirm=True) if wanted else None
    key = sm2.PrivateKey.generate()
    written = key.to_pem(password=password, format=options.format, prf=options.prf)
    write_private(options.output, written, force=options.force)
    if options.public is not None:
        write_output(options.public, [key.public_key.to_pem()])
    return 0


def run_pubkey(options: argparse.Namespace) -> int:
    write_output(options.output, [load_private(options.key, options).public_key.to_pem()])
    return 0

"""`sign` and `verify`: SM2 with SM3 over files of any size, as `openssl dgst -sm3` with a distinguishing id."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from smcrypto import sm2
from smcrypto.cli.files import add_input, add_output, chunks, write_output
from smcrypto.cli.keys import add_key, add_public, add_uid, load_private, load_public, uid_bytes
from smcrypto.errors import InvalidSignature

__all__ = ["add_parser"]


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    sign = subparsers.add_parser("sign", help="sign a file", description="Sign a file with SM2 and SM3.")
    add_key(sign)
    _add_common(sign)
    add_output(sign)
    add_input(sign)
    sign.set_defaults(run=run_sign)

    verify = subparsers.add_parser("verify", help="verify a signature",
                                   description="Exit with 0 where the signature holds, with 1 where it does not.")
    add_public(verify)
    verify.add_argument("--signature", type=Path, required=True, metavar="FILE")
    _add_common(verify)
    add_input(verify)
    verify.set_defaults(run=run_verify)


def _add_common(parser: argparse.ArgumentParser) -> None:
    add_uid(parser)
    parser.add_argument("--encoding", choices=("der", "raw"), default="der",
                        help="der: GM/T 0009, as openssl; raw: r and s, 64 bytes (default: %(default)s)")


def _digest(public_key: sm2.PublicKey, options: argparse.Namespace) -> bytes:
    """e = SM3(Z_A || M), GB/T 32918.2, 6.1 A1 and A2, without holding M in memory."""
    state = public_key.hasher(uid=uid_bytes(options.uid))
    for chunk in chunks(options.file):
        state.update(chunk)
    return state.digest()


def run_sign(options: argparse.Namespace) -> int:
    key = load_private(options.key, options)
    signature = key.sign_digest(_digest(key.public_key, options), encoding=options.encoding)
    write_output(options.output, [signature])
    return 0


def run_verify(options: argparse.Namespace) -> int:
    public_key = load_public(options.public)
    signature = options.signature.read_bytes()
    try:
        public_key.verify_digest(signature, _digest(public_key, options), encoding=options.encoding)
    except InvalidSignature:
        print("smcrypto: the signature does not hold", file=sys.stderr)
        return 1
    print("the signature holds", file=sys.stderr)
    return 0

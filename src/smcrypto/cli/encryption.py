"""`encrypt` and `decrypt`: to an SM2 public key, under a password, or under an SM4 key.

The three forms are those of the openssl command line, so either side reads
the other: `pkeyutl -encrypt` (GM/T 0009), `enc -sm4-MODE -pbkdf2 -md sm3`
(the eight bytes "Salted__", a salt of eight, the ciphertext), and
`enc -sm4-MODE -K -iv`. Only the first notices tampering.
"""

from __future__ import annotations

import argparse
import secrets
from collections.abc import Callable, Iterator
from pathlib import Path

from smcrypto import kdf, sm4
from smcrypto.cli import passwords
from smcrypto.cli.files import add_input, add_output, chunks, read_all, write_output
from smcrypto.cli.keys import load_private, load_public
from smcrypto.errors import InvalidCiphertext, InvalidOption
from smcrypto.sm4.modes import Mode

__all__ = ["add_parser"]

MODES: dict[str, Callable[[bytes], Mode]] = {
    "cbc": sm4.CBC, "ctr": sm4.CTR, "cfb": sm4.CFB, "ofb": sm4.OFB,
}
MAGIC = b"Salted__"
SALT_SIZE = 8
DEFAULT_ITERATIONS = 100_000


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    encrypt = subparsers.add_parser("encrypt", help="encrypt a file", description=__doc__,
                                    formatter_class=argparse.RawDescriptionHelpFormatter)
    encrypt.add_argument("--to", type=Path, metavar="FILE", help="recipient's SM2 public key (PEM)")
    _add_common(encrypt)
    encrypt.set_defaults(run=run_encrypt)

    decrypt = subparsers.add_parser("decrypt", help="decrypt a file", description=__doc__,
                                    formatter_class=argparse.RawDescriptionHelpFormatter)
    decrypt.add_argument("--key", type=Path, metavar="FILE", help="own SM2 private key (PEM)")
    _add_common(decrypt)
    decrypt.set_defaults(run=run_decrypt)


def _add_common(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--encoding", choices=("der", "c1c3c2", "c1c2c3"), default="der",
                        help="form of an SM2 ciphertext (default: %(default)s)")
    passwords.add_arguments(parser)
    parser.add_argument("--iterations", type=int, default=DEFAULT_ITERATIONS,
                        help="of PBKDF2 under a password; openssl's -iter (default: %(default)s)")
    parser.add_argument("--sm4-key-file", type=Path, metavar="FILE", help="SM4 key: the 16 bytes of FILE")
    parser.add_argument("--iv", metavar="HEX", help="with --sm4-key-file: 32 hex digits, never used twice")
    parser.add_argument("--mode", choices=tuple(MODES), default="cbc", help="SM4 mode (default: %(default)s)")
    add_output(parser)
    add_input(parser)


def _cipher(key: bytes, iv: bytes, options: argparse.Namespace) -> sm4.Cipher:
    return sm4.Cipher(key, MODES[options.mode](iv), padding="pkcs7" if options.mode == "cbc" else None)


def _explicit(options: argparse.Namespace) -> tuple[bytes, bytes]:
    try:
        iv = bytes.fromhex(options.iv or "")
    except ValueError:
        raise InvalidOption("--iv must be hex") from None
    return options.sm4_key_file.read_bytes(), iv


def _from_password(password: bytes, salt: bytes, options: argparse.Namespace) -> tuple[bytes, bytes]:
    """Key and IV as `openssl enc -pbkdf2 -md sm3` derives them: 32 bytes at once."""
    derived = kdf.pbkdf2_hmac(password, salt, options.iterations, 32)
    return derived[:16], derived[16:]


def _streamed(context: sm4.CipherStream, pieces: Iterator[bytes]) -> Iterator[bytes]:
    for piece in pieces:
        yield context.update(piece)
    yield context.finalize()


def run_encrypt(options: argparse.Namespace) -> int:
    if options.to is not None:
        sealed = load_public(options.to).encrypt(read_all(options.file), encoding=options.encoding)
        write_output(options.output, iter([sealed]))
        return 0
    head = b""
    if options.sm4_key_file is not None:
        key, iv = _explicit(options)
    else:
        salt = secrets.token_bytes(SALT_SIZE)
        key, iv = _from_password(passwords.read_password(options, "New password", confirm=True), salt, options)
        head = MAGIC + salt

    def output() -> Iterator[bytes]:
        yield head
        yield from _streamed(_cipher(key, iv, options).encryptor(), chunks(options.file))

    write_output(options.output, output())
    return 0


def run_decrypt(options: argparse.Namespace) -> int:
    if options.key is not None:
        message = load_private(options).decrypt(read_all(options.file), encoding=options.encoding)
        write_output(options.output, iter([message]))
        return 0
    pieces = chunks(options.file)
    if options.sm4_key_file is not None:
        key, iv = _explicit(options)
    else:
        head = b""
        while len(head) < len(MAGIC) + SALT_SIZE and (piece := next(pieces, b"")):
            head += piece
        magic, salt, rest = head[:8], head[8:16], head[16:]
        if magic != MAGIC or len(salt) != SALT_SIZE:
            raise InvalidCiphertext("not encrypted under a password: the file does not begin with 'Salted__'")
        key, iv = _from_password(passwords.read_password(options, "Password"), salt, options)
        pieces = _preceded(rest, pieces)
    write_output(options.output, _streamed(_cipher(key, iv, options).decryptor(), pieces))
    return 0


def _preceded(first: bytes, rest: Iterator[bytes]) -> Iterator[bytes]:
    yield first
    yield from rest

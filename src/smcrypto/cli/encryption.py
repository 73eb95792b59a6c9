"""`encrypt` and `decrypt`: to an SM2 public key, under a password, or under an SM4 key.

The three forms are those of the openssl command line, so either side reads
the other: `pkeyutl -encrypt` (GM/T 0009), `enc -sm4-MODE -pbkdf2 -md sm3`
(the eight bytes "Salted__", a salt of eight, the ciphertext), and
`enc -sm4-MODE -K -iv`. Only the first notices tampering: sign what the others
carry. SM2 encrypts a key or a letter; it holds the whole file in memory.
"""

from __future__ import annotations

import argparse
import secrets
from collections.abc import Callable, Iterable, Iterator
from itertools import chain
from pathlib import Path

from smcrypto import kdf, sm4
from smcrypto.cli import passwords
from smcrypto.cli.files import add_input, add_output, chunks, read_all, write_output
from smcrypto.cli.keys import load_private, load_public
from smcrypto.errors import InvalidCiphertext, InvalidOption

__all__ = ["add_parser"]

MODES: dict[str, Callable[[bytes], sm4.Mode]] = {"cbc": sm4.CBC, "ctr": sm4.CTR, "cfb": sm4.CFB, "ofb": sm4.OFB}
MAGIC = b"Salted__"
SALT_SIZE = 8
DEFAULT_ITERATIONS = 100_000


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    for name, run, option, key in (
        ("encrypt", run_encrypt, "--to", "recipient's SM2 public key (PEM)"),
        ("decrypt", run_decrypt, "--key", "own SM2 private key (PEM)"),
    ):
        parser = subparsers.add_parser(name, help=f"{name} a file", description=__doc__,
                                       formatter_class=argparse.RawDescriptionHelpFormatter)
        parser.add_argument(option, type=Path, metavar="FILE", help=key)
        parser.add_argument("--encoding", choices=("der", "c1c3c2", "c1c2c3"), default="der",
                            help="form of an SM2 ciphertext (default: %(default)s)")
        passwords.add_arguments(parser)
        parser.add_argument("--iterations", type=int, default=DEFAULT_ITERATIONS,
                            help="of PBKDF2 under a password; openssl's -iter (default: %(default)s)")
        parser.add_argument("--sm4-key-file", type=Path, metavar="FILE", help="SM4 key: the 16 bytes of FILE")
        parser.add_argument("--iv", metavar="HEX", help="with --sm4-key-file: 32 hex digits, never used twice")
        parser.add_argument("--mode", choices=tuple(MODES), help="SM4 mode (default: cbc)")
        add_output(parser)
        add_input(parser)
        parser.set_defaults(run=run)


def _require_one_secret(options: argparse.Namespace, key_file: Path | None, name: str) -> None:
    """What would be ignored is refused: of an SM2 key, a password and an SM4 key there is one."""
    if key_file is not None and options.mode is not None:
        raise InvalidOption(f"{name} takes no --mode: SM2 encrypts by itself")
    if options.sm4_key_file is None:
        if options.iv is not None:
            raise InvalidOption("--iv belongs to --sm4-key-file")
    elif key_file is not None or passwords.named(options):
        raise InvalidOption(f"--sm4-key-file goes with neither {name} nor a password")
    elif options.iv is None:
        raise InvalidOption("--sm4-key-file needs --iv")


def _cipher(options: argparse.Namespace, salt: bytes, prompt: str, *, confirm: bool = False) -> sm4.Cipher:
    """Under the SM4 key that is given, or under a password: key and IV as `openssl enc -pbkdf2 -md sm3` has them."""
    if options.sm4_key_file is not None:
        try:
            iv = bytes.fromhex(options.iv)
        except ValueError:
            raise InvalidOption("--iv must be hex") from None
        key = options.sm4_key_file.read_bytes()
    else:
        password = passwords.read_password(options, prompt, confirm=confirm)
        derived = kdf.pbkdf2_hmac(password, salt, options.iterations, 32)
        key, iv = derived[:16], derived[16:]
    mode = options.mode or "cbc"
    return sm4.Cipher(key, MODES[mode](iv), padding="pkcs7" if mode == "cbc" else None)


def _streamed(context: sm4.CipherStream, pieces: Iterable[bytes]) -> Iterator[bytes]:
    for piece in pieces:
        yield context.update(piece)
    yield context.finalize()


def run_encrypt(options: argparse.Namespace) -> int:
    _require_one_secret(options, options.to, "--to")
    if options.to is not None:
        if passwords.named(options):
            raise InvalidOption("--to goes without a password")
        sealed = load_public(options.to).encrypt(read_all(options.file), encoding=options.encoding)
        write_output(options.output, [sealed])
        return 0
    salt = secrets.token_bytes(SALT_SIZE)
    head = MAGIC + salt if options.sm4_key_file is None else b""
    cipher = _cipher(options, salt, "New password", confirm=True)
    write_output(options.output, chain([head], _streamed(cipher.encryptor(), chunks(options.file))))
    return 0


def run_decrypt(options: argparse.Namespace) -> int:
    _require_one_secret(options, options.key, "--key")
    if options.key is not None:
        message = load_private(options.key, options).decrypt(read_all(options.file), encoding=options.encoding)
        write_output(options.output, [message])
        return 0
    pieces, salt = chunks(options.file), b""
    if options.sm4_key_file is None:
        first = next(pieces, b"")  # CHUNK bytes, or all there is
        magic, salt, rest = first[:8], first[8:16], first[16:]
        if magic != MAGIC or len(salt) != SALT_SIZE:
            raise InvalidCiphertext("not encrypted under a password: the file has no 'Salted__' and salt at its start")
        pieces = chain([rest], pieces)
    write_output(options.output, _streamed(_cipher(options, salt, "Password").decryptor(), pieces))
    return 0

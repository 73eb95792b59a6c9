"""Input and output of the commands: files or pipes, in chunks, with progress on stderr for what is large."""

from __future__ import annotations

import argparse
import contextlib
import os
import stat
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from smcrypto.errors import InvalidOption

__all__ = ["CHUNK", "add_input", "add_output", "chunks", "read_all", "write_output", "write_private"]

CHUNK = 1 << 20
PROGRESS_FROM = 16 << 20  # smaller files are done before a bar could be read


def add_input(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("file", nargs="?", default="-", help="input file; '-' or nothing is stdin")


def add_output(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("-o", "--output", type=Path, metavar="FILE", help="write here instead of to stdout")


@contextlib.contextmanager
def _opened(name: str) -> Iterator[tuple[BinaryIO, int]]:
    if name == "-":
        yield sys.stdin.buffer, 0
        return
    with Path(name).open("rb") as stream:
        status = os.fstat(stream.fileno())
        yield stream, status.st_size if stat.S_ISREG(status.st_mode) else 0


def chunks(name: str) -> Iterator[bytes]:
    """The input in pieces of CHUNK bytes; a bar on stderr where it is large and stderr is a terminal."""
    with _opened(name) as (stream, size):
        bar = size >= PROGRESS_FROM and sys.stderr.isatty()
        done = 0
        while chunk := stream.read(CHUNK):
            yield chunk
            done += len(chunk)
            if bar:
                filled = 40 * done // size
                print(f"\r{name} [{'#' * filled}{'.' * (40 - filled)}] {100 * done // size:3d} %",
                      end="", file=sys.stderr, flush=True)
        if bar:
            print(file=sys.stderr)


def read_all(name: str) -> bytes:
    return b"".join(chunks(name))


def write_output(path: Path | None, pieces: Iterator[bytes]) -> None:
    """Write the pieces to stdout, or to `path` under a temporary name that is renamed when all is well.

    So a decryption that fails at its end leaves no half-written plaintext behind in a file.
    """
    if path is None:
        for piece in pieces:
            sys.stdout.buffer.write(piece)
        sys.stdout.buffer.flush()
        return
    descriptor, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(descriptor, "wb") as stream:
            for piece in pieces:
                stream.write(piece)
        umask = os.umask(0)
        os.umask(umask)
        Path(temporary).chmod(0o666 & ~umask)
        Path(temporary).replace(path)
    except BaseException:
        Path(temporary).unlink()
        raise


def write_private(path: Path, data: bytes, *, force: bool = False) -> None:
    """Write a key file that only its owner can read (0600); an existing file is kept unless `force`."""
    if path.exists() and not force:
        raise InvalidOption(f"{path} exists; give --force to overwrite it")
    descriptor, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")  # created 0600
    with os.fdopen(descriptor, "wb") as stream:
        stream.write(data)
    Path(temporary).replace(path)

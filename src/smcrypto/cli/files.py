"""Input and output of the commands: files or pipes, in chunks, with progress on stderr for what is large."""

from __future__ import annotations

import argparse
import contextlib
import os
import sys
import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path

from smcrypto.errors import InvalidOption

__all__ = ["CHUNK", "add_input", "add_output", "chunks", "read_all", "require_absent", "write_output", "write_private"]

CHUNK = 1 << 20
PROGRESS_FROM = 16 << 20  # smaller files are done before a bar could be read


def add_input(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("file", nargs="?", default="-", help="input file; '-' or nothing is stdin")


def add_output(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("-o", "--output", type=Path, metavar="FILE", help="write here instead of to stdout")


def chunks(name: str) -> Iterator[bytes]:
    """The input in pieces of CHUNK bytes; a bar on stderr where it is large and stderr is a terminal."""
    with contextlib.nullcontext(sys.stdin.buffer) if name == "-" else Path(name).open("rb") as stream:
        size = 0 if name == "-" else os.fstat(stream.fileno()).st_size  # of a pipe or device it is 0
        bar = size >= PROGRESS_FROM and sys.stderr.isatty()
        done = 0
        while chunk := stream.read(CHUNK):
            yield chunk
            done += len(chunk)
            if bar:
                share = min(done / size, 1.0)  # the file may grow while it is read
                filled = "#" * int(40 * share)
                print(f"\r{name} [{filled:.<40}] {share:4.0%}", end="", file=sys.stderr, flush=True)
        if bar:
            print(file=sys.stderr)


def read_all(name: str) -> bytes:
    return b"".join(chunks(name))


def require_absent(path: Path, *, force: bool) -> None:
    """InvalidOption if there is such a file already, unless `force`."""
    if path.exists() and not force:
        raise InvalidOption(f"{path} exists; give --force to overwrite it")


def write_output(path: Path | None, pieces: Iterable[bytes]) -> None:
    """Write the pieces to stdout, or to `path` at once when all of them are there.

    So a decryption that fails at its end leaves no half-written plaintext behind in a file.
    """
    if path is None:
        sys.stdout.buffer.writelines(pieces)
        sys.stdout.buffer.flush()
        return
    umask = os.umask(0)
    os.umask(umask)
    _write_whole(path, pieces, mode=0o666 & ~umask)


def write_private(path: Path, data: bytes, *, force: bool = False) -> None:
    """Write a key file that only its owner can read (0600); an existing file is kept unless `force`."""
    require_absent(path, force=force)
    _write_whole(path, [data], mode=0o600)


def _write_whole(path: Path, pieces: Iterable[bytes], *, mode: int) -> None:
    """Write under a temporary name, readable by the owner alone, and rename when all is well."""
    if path.exists() and not path.is_file():  # /dev/null, a pipe: not to be replaced by a file
        with path.open("wb") as device:
            device.writelines(pieces)
        return
    target = path.resolve()  # a link stays: /dev/stdout is one, and may lead to a file
    try:
        descriptor, name = tempfile.mkstemp(dir=target.parent, prefix=f".{target.name}.")
    except OSError as error:
        error.filename = str(path)
        raise
    temporary = Path(name)
    try:
        with os.fdopen(descriptor, "wb") as stream:
            stream.writelines(pieces)
        temporary.chmod(mode)
        temporary.replace(target)
    except BaseException:
        temporary.unlink()
        raise

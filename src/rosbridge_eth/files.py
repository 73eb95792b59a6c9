"""Files that are written whole, that nobody else may read, or that open under a password alone.

A sealed box is one JSON object: its head in the clear, then what is sealed.

    {"format": …, …, "scrypt": [n, r, p], "salt": hex, "sealed": base64}

scrypt (RFC 7914) makes an SM4 key of the password; SM4-GCM (RFC 8998) seals the
content and authenticates everything else in the object. The salt is fresh for
each box, so the key is used once and the nonce may be zero.
"""

from __future__ import annotations

import base64
import hashlib
import json
import os
import secrets
import stat
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rosbridge_eth.errors import IdentityError
from smcrypto import InvalidTag, sm4

SCRYPT_N = 2**15  # 32 MiB and about a tenth of a second; for what a robot opens
STRONG_SCRYPT_N = 2**17  # 128 MiB, as the keystores of Ethereum's clients
_SCRYPT_R, _SCRYPT_P, _SCRYPT_MEMORY = 8, 1, 2**28
_NONCE = bytes(12)


def write_atomically(path: Path, content: bytes, *, mode: int = 0o644, new: bool = False) -> None:
    """Write a file so that a crash leaves the old one or the new one, never half of it.

    new: nothing is overwritten; FileExistsError where the file is there.
    """
    descriptor, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(descriptor, "wb") as stream:
            stream.write(content)
            stream.flush()
            os.fsync(stream.fileno())
        os.chmod(temporary, mode)
        (os.link if new else os.replace)(temporary, path)
        folder = os.open(path.parent, os.O_RDONLY)  # a file's name is on the disk when its folder is
        try:
            os.fsync(folder)
        finally:
            os.close(folder)
    finally:
        Path(temporary).unlink(missing_ok=True)


def read_file(path: Path, *, private: bool = False) -> bytes:
    """The content of a file; IdentityError where it cannot be read, or holds a secret that others may read."""
    try:
        mode, content = stat.S_IMODE(path.stat().st_mode), path.read_bytes()
    except OSError as error:
        raise IdentityError(f"{path} cannot be read: {error.strerror}") from error
    if private and mode & 0o077:
        raise IdentityError(
            f"{path} is open to others (mode {mode:04o}); run `chmod 600 {path}`, and if it may have been read,"
            " make new keys"
        )
    return content


@contextmanager
def naming(path: Path) -> Iterator[None]:
    """What is wrong with the content of a file is told with its name."""
    try:
        yield
    except IdentityError as error:
        raise IdentityError(f"{path}: {error}") from error


def seal_box(secret: bytes, password: bytes, head: Mapping[str, Any], *, n: int = SCRYPT_N) -> bytes:
    """`secret` under `password`, as a file's bytes. head: shown in the clear; its "format" says what it is."""
    if not password:
        raise IdentityError("an empty password protects nothing; choose another")
    shown = {**head, "scrypt": [n, _SCRYPT_R, _SCRYPT_P], "salt": secrets.token_hex(16)}
    sealed = sm4.SM4GCM(_key(password, shown)).encrypt(_NONCE, secret, _canonical(shown))
    return json.dumps({**shown, "sealed": base64.b64encode(sealed).decode()}, indent=1).encode() + b"\n"


_MADE_BY = {"request": "`join --name`", "bundle": "`register`", "accounts": "`init`"}
_MAX_BRACKETS = 100  # of nesting json.loads makes recursion, which py-evm allows up to where the stack ends


def box_head(data: bytes, expected: str) -> dict[str, Any]:
    """What a JSON file of ours says in the clear, if its "format" is `expected`; else IdentityError.

    expected: `rosbridge-eth THING 2`. Such a file need not be sealed.
    """
    thing = expected.split()[1]
    try:
        if data.count(b"[") + data.count(b"{") > _MAX_BRACKETS:
            raise ValueError
        head = json.loads(data)
        given = head["format"]
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        made = f"give the {thing} that {_MADE_BY[thing]} wrote"
        raise IdentityError(f"this is no {thing} file of this program, or it was damaged; {made}") from error
    if given != expected:
        raise IdentityError(f"this {thing} file has another format than {expected!r}; use one version on both ends")
    return dict(head)


def open_box(data: bytes, password: bytes, expected: str) -> tuple[dict[str, Any], bytes]:
    """The head and the secret of a sealed box; IdentityError where it is none or the password is another."""
    head = box_head(data, expected)
    thing = expected.split()[1]
    try:
        sealed = base64.b64decode(head.pop("sealed"), validate=True)
        key = _key(password, head)
        return head, sm4.SM4GCM(key).decrypt(_NONCE, sealed, _canonical(head))
    except InvalidTag as error:
        raise IdentityError(f"the {thing} file does not open: the password is wrong, or it was altered") from error
    except (ValueError, KeyError, TypeError) as error:
        raise IdentityError(f"this {thing} file was damaged") from error


def _key(password: bytes, head: Mapping[str, Any]) -> bytes:
    n, r, p = head["scrypt"]
    if (r, p) != (_SCRYPT_R, _SCRYPT_P) or not 2 <= n <= STRONG_SCRYPT_N:  # a stranger's file sets no cost
        raise ValueError("not a cost that this program writes")
    return hashlib.scrypt(password, salt=bytes.fromhex(head["salt"]), n=n, r=r, p=p, maxmem=_SCRYPT_MEMORY, dklen=16)


def _canonical(head: Mapping[str, Any]) -> bytes:
    return json.dumps(head, sort_keys=True, separators=(",", ":")).encode()

"""The file that carries an identity from the operator to a robot: one JSON object, sealed under a password.

    {"format": "rosbridge-eth bundle 1", "name": …, "n": …, "r": …, "p": …, "salt": …, "sealed": …}

scrypt (RFC 7914) makes an SM4 key of the password; SM4-GCM (RFC 8998) seals
the contents and authenticates the outer fields, so a bundle that was altered
on its way does not open. The salt is fresh, so the key is used once and the
nonce may be zero. The private keys inside are PKCS#8, encrypted once more
under the same password, as the robot will keep them.
"""

from __future__ import annotations

import base64
import hashlib
import json
import secrets
from dataclasses import asdict, dataclass
from typing import Any

from rosbridge_eth.errors import IdentityError
from smcrypto import InvalidTag, sm4

FORMAT = "rosbridge-eth bundle 1"
SCRYPT_N, SCRYPT_R, SCRYPT_P = 2**15, 8, 1  # 32 MiB and about a tenth of a second
_NONCE = bytes(12)


@dataclass(frozen=True, slots=True)
class Bundle:
    """What a robot needs besides its topics. `identity` maps file names to PEM; readers are certificates."""

    name: str
    identity: dict[str, str]
    server_name: str
    server_address: str
    readers: tuple[str, ...]
    contract: str
    chain_id: int


def _key(password: bytes, salt: bytes, n: int, r: int, p: int) -> bytes:
    return hashlib.scrypt(password, salt=salt, n=n, r=r, p=p, maxmem=2 * 128 * n * r, dklen=16)


def _associated(outer: dict[str, Any]) -> bytes:
    return json.dumps(outer, sort_keys=True, separators=(",", ":")).encode()


def seal_bundle(bundle: Bundle, password: bytes) -> bytes:
    """The bundle as a file's bytes."""
    salt = secrets.token_bytes(16)
    outer = {"format": FORMAT, "name": bundle.name, "n": SCRYPT_N, "r": SCRYPT_R, "p": SCRYPT_P, "salt": salt.hex()}
    inner = json.dumps(asdict(bundle)).encode()
    sealed = sm4.SM4GCM(_key(password, salt, SCRYPT_N, SCRYPT_R, SCRYPT_P)).encrypt(_NONCE, inner, _associated(outer))
    return json.dumps({**outer, "sealed": base64.b64encode(sealed).decode()}, indent=1).encode() + b"\n"


def open_bundle(data: bytes, password: bytes) -> Bundle:
    """The bundle in `data`; IdentityError where it is none, was altered, or the password is another."""
    try:
        outer = json.loads(data)
        sealed = base64.b64decode(outer.pop("sealed"), validate=True)
        salt = bytes.fromhex(outer["salt"])
        cost = (int(outer["n"]), int(outer["r"]), int(outer["p"]))
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise IdentityError("this is not a bundle; give the file that `register` wrote") from error
    if outer.get("format") != FORMAT or cost != (SCRYPT_N, SCRYPT_R, SCRYPT_P):
        raise IdentityError(f"this bundle has another format than {FORMAT!r}; use the same version on both ends")
    try:
        inner = json.loads(sm4.SM4GCM(_key(password, salt, *cost)).decrypt(_NONCE, sealed, _associated(outer)))
    except InvalidTag as error:
        raise IdentityError("the password is wrong, or the bundle was altered on its way") from error
    return Bundle(**{**inner, "readers": tuple(inner["readers"])})

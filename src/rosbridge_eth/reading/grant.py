"""A grant: a reader hands the keys of chunks that it can open to one person, and nothing goes on the chain.

One JSON object. `sealed` is SM4-GCM, nonce zero, of digest 32 | content key 16 for each chunk, one behind the other,
under a fresh key that `key` has wrapped by SM2 (C1 | C3 | C2) to the person's encryption certificate. The signature is
by the granting reader, for the purpose `grant`, over all members but itself, as they stand here, without spaces: it
says who gave. That a key is the right one each chunk says itself: its root commits to it.
"""

from __future__ import annotations

import secrets
from collections import defaultdict
from datetime import datetime
from pathlib import Path
from typing import Annotated, Final, Literal, TypeAlias

from pydantic import AwareDatetime, BaseModel, StringConstraints

from rosbridge_eth.errors import ConfigError, IdentityError, VerificationError
from rosbridge_eth.identity import Identity, PeerIdentity, Role, Trust, public_identity, sign, verify
from rosbridge_eth.log.chunk import KEY_SIZE
from rosbridge_eth.reading.fetch import Reading
from rosbridge_eth.reading.verdict import shown
from rosbridge_eth.reading.verify import Choice
from smcrypto import InvalidCiphertext, InvalidSignature, InvalidTag, sm4

Keys: TypeAlias = dict[bytes, bytes]
"""By the digest of a chunk, its content key."""
MAX_FILE: Final = 64 * 2**20
"""Of half a million chunks and more."""
_ENTRY: Final = 32 + KEY_SIZE
_NONCE: Final = bytes(12)
_Hex: TypeAlias = Annotated[str, StringConstraints(pattern=r"^([0-9a-f]{2})*$")]


class _Document(BaseModel, extra="forbid"):
    format: Literal["rosbridge-eth grant 2"] = "rosbridge-eth grant 2"
    ledger: _Hex
    robot: str
    begin: str
    end: str
    reader: str
    made: AwareDatetime
    by: str
    key: _Hex
    sealed: _Hex
    signature: _Hex = ""

    @property
    def signed(self) -> bytes:
        return self.model_dump_json(exclude={"signature"}).encode()


def keys_of(reading: Reading, choice: Choice) -> Keys:
    """Of a log that is read to its end, the content keys of all chunks that hold a chosen record."""
    again = reading.again(record.place for record in reading.records(choice))
    return {chunk.header.digest: reading.verifier.key_of(chunk.header) for _, _, chunk in again}


def make(
    keys: Keys, *, ledger: bytes, robot: str, begin: str, end: str, by: Identity, to: PeerIdentity, now: datetime
) -> bytes:
    """The file for `to`, whose certificates are checked."""
    key = secrets.token_bytes(KEY_SIZE)
    sealed = sm4.SM4GCM(key).encrypt(_NONCE, b"".join(digest + one for digest, one in sorted(keys.items())), b"")
    document = _Document(
        ledger=ledger.hex(), robot=robot, begin=begin, end=end, reader=to.name, made=now, by=by.pem.decode(),
        key=to.encryption_certificate.public_key.encrypt(key, encoding="c1c3c2").hex(), sealed=sealed.hex(),
    )  # fmt: skip
    document.signature = sign(by.signing_key, "grant", document.signed).hex()
    made = document.model_dump_json(indent=1).encode() + b"\n"
    if len(made) > MAX_FILE:
        raise ConfigError(f"a grant has at most {MAX_FILE >> 20} MiB, and {len(keys):,} chunks take more; grant parts")
    return made


def open_grant(data: bytes, *, ledger: bytes, reader: Identity, trust: Trust) -> tuple[str, Keys]:
    """Of what `make` made for this reader, the robot and the keys. IdentityError or VerificationError says why not."""
    try:
        document = _Document.model_validate_json(data)
        by = public_identity(document.by.encode())
        signature = bytes.fromhex(document.signature)
    except ValueError as error:  # pydantic's, too
        raise VerificationError("it is no grant of this program, or it was damaged") from error
    trust.check(by.signing_certificate.to_der(), by.encryption_certificate.to_der(), role=Role.READER, at=document.made)
    try:
        verify(by.signing_certificate.public_key, "grant", document.signed, signature)
        if bytes.fromhex(document.ledger) != ledger:
            raise VerificationError("it is for another chain or contract than this reader's")
        key = reader.encryption_key.decrypt(bytes.fromhex(document.key), encoding="c1c3c2")
        content = sm4.SM4GCM(key).decrypt(_NONCE, bytes.fromhex(document.sealed), b"")
    except InvalidSignature:
        raise VerificationError(f"it is not as {by} signed it") from None
    except InvalidCiphertext:
        raise IdentityError(f"it is for reader {shown(document.reader)}, whose keys are not here") from None
    except (InvalidTag, ValueError):
        raise VerificationError(f"{by} signed it, and what is sealed in it does not open") from None
    if len(content) % _ENTRY:
        raise VerificationError(f"{by} signed it, and it does not hold whole keys")
    entries = [content[at : at + _ENTRY] for at in range(0, len(content), _ENTRY)]
    return document.robot, {entry[:32]: entry[32:] for entry in entries}


def open_folder(folder: Path, *, ledger: bytes, reader: Identity, trust: Trust) -> dict[str, Keys]:
    """By robot, the keys of all grants of a folder, which need not be there; an error names one that is no good."""
    found = defaultdict[str, Keys](Keys)
    for file in sorted(folder.glob("*")):
        try:
            if not file.is_file() or file.stat().st_size > MAX_FILE:
                raise VerificationError(f"it is no file, or has more than {MAX_FILE >> 20} MiB")
            robot, keys = open_grant(file.read_bytes(), ledger=ledger, reader=reader, trust=trust)
            found[robot] |= keys
        except (IdentityError, VerificationError) as error:
            raise type(error)(f"the grant {file} cannot be used: {error}; remove it, or ask for another") from error
    return found

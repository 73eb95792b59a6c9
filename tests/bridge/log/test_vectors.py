"""The recorded chunks, computed again from docs/log.md and the standards with nothing of this project.

Textbook arithmetic on affine points, SM3 of the standard library's OpenSSL, SM4-GCM of `cryptography`, the
recursive tree of RFC 9162, and slices by the figures of the documentation. Then the project's own functions
are held against the same values.
"""

from __future__ import annotations

import hashlib
import hmac
import json
import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from bridge.log.test_proof import path, tree_hash
from rosbridge_eth.log.chunk import (
    Chunk,
    Forged,
    Log,
    Proof,
    check_proof,
    content_key,
    drop,
    ledger_id,
    open_lines,
    proofs,
    robot_id,
    seal,
    verify,
    zstd,
)
from sm2_reference import add, multiple, number
from smcrypto import sm2

FOLDER = Path(__file__).parents[2] / "vectors" / "log"
CURVE = sm2.SM2P256V1
TEXT = {"name", "source", "lines"}

try:
    hashlib.new("sm3")
except ValueError:
    pytest.skip("this Python's OpenSSL has no SM3", allow_module_level=True)


def unhexed(key, value):
    if isinstance(value, dict):
        return SimpleNamespace(**{k: unhexed(k, v) for k, v in value.items()})
    if key == "lines":
        return [line.encode() for line in value]
    if isinstance(value, list):
        return [unhexed(key, item) for item in value]
    return bytes.fromhex(value) if isinstance(value, str) and key not in TEXT else value


FILE = json.loads((FOLDER / "chunks.json").read_text())
ROBOT, LEDGER, READERS = (unhexed(name, FILE[name]) for name in ("robot", "ledger", "reader_keys"))
CASES = [unhexed("", case) for case in FILE["tests"]]
case = pytest.mark.parametrize("v", CASES, ids=lambda v: v.name)


def sm3(*data: bytes) -> bytes:
    return hashlib.new("sm3", b"".join(data)).digest()


def mac(key: bytes, data: bytes) -> bytes:
    return hmac.new(key, data, "sm3").digest()


def b32(n: int) -> bytes:
    return n.to_bytes(32, "big")


def point(data: bytes):
    assert data[0] == 4 and len(data) == 65
    return number(data[1:33]), number(data[33:])


def check_signature(public, message: bytes, signature: bytes) -> None:
    """GB/T 32918.2-2016, 7.1, with the default identifier."""
    r, s = number(signature[:32]), number(signature[32:])
    assert 0 < r < CURVE.n and 0 < s < CURVE.n and len(signature) == 64
    z = sm3(b"\0\x80", b"1234567812345678", *map(b32, (CURVE.a, CURVE.b, *CURVE.G, *public)))
    x, _ = add(multiple(s, CURVE.G, CURVE), multiple((r + s) % CURVE.n, public, CURVE), CURVE)
    assert (number(sm3(z, message)) + x) % CURVE.n == r


def unwrapped(private: bytes, data: bytes) -> bytes:
    """GB/T 32918.4-2016, 7.1: C1 | C3 | C2."""
    x, y = map(b32, multiple(number(private), point(data[:65]), CURVE))
    key = bytes(a ^ b for a, b in zip(data[97:], sm3(x, y, b"\0\0\0\1"), strict=False))
    assert sm3(x, key, y) == data[65:97]
    return key


def gcm_open(key: bytes, body: bytes, associated: bytes) -> bytes:
    ciphers = pytest.importorskip("cryptography.hazmat.primitives.ciphers")
    opening = ciphers.Cipher(ciphers.algorithms.SM4(key), ciphers.modes.GCM(bytes(12), body[-16:])).decryptor()
    opening.authenticate_additional_data(associated)
    return opening.update(body[:-16]) + opening.finalize()


def test_robot_and_ledger():
    public = multiple(number(ROBOT.signing_key), CURVE.G, CURVE)
    assert ROBOT.public_key == b"\4" + b32(public[0]) + b32(public[1])
    assert LEDGER.ledger == sm3(b32(LEDGER.chain_id), LEDGER.genesis, LEDGER.contract)
    assert ledger_id(LEDGER.chain_id, LEDGER.genesis, LEDGER.contract) == LEDGER.ledger
    assert robot_id(FILE["robot"]["name"]) == ROBOT.tk


@case
def test_the_chunk_follows_from_the_document(v):
    c = v.chunk
    end = 139 + 113 * v.readers
    header, signature, body = c[:end], c[end : end + 64], c[end + 64 :]
    assert (header, signature) == (v.header, v.signature) and sm3(header) == v.digest
    place = v.stream + v.number.to_bytes(8, "big")
    assert header[:2] == bytes((3, v.goodbye)) and header[2:26] == place and header[26:58] == v.previous
    assert header[58:66] == v.sealed_ms.to_bytes(8, "big") and header[66:70] == len(v.lines).to_bytes(4, "big")
    assert header[70:102] == v.root and header[102:106] == len(body).to_bytes(4, "big")
    assert header[106:138] == v.body_digest == sm3(body) and header[138] == v.readers
    assert v.signed == b"rosbridge-eth/2 chunk\0" + LEDGER.ledger + ROBOT.tk + header
    check_signature(point(ROBOT.public_key), v.signed, signature)
    if not v.lines:
        assert not body and v.root == v.body_digest == sm3(b"")
        return
    for i, private in enumerate(READERS[: v.readers]):
        assert unwrapped(private, header[139 + 113 * i : 252 + 113 * i]) == v.content_key
    assert v.associated_data == LEDGER.ledger + ROBOT.tk + place
    assert gcm_open(v.body_key, body, v.associated_data) == v.plaintext
    assert mac(ROBOT.secret, v.random + v.associated_data + sm3(v.plaintext))[:16] == v.content_key
    assert (v.body_key, v.salt_key) == (
        mac(v.content_key, b"rosbridge-eth/3 body\1")[:16], mac(v.content_key, b"rosbridge-eth/3 salts\1")
    )  # fmt: skip
    content = b"".join(line + b"\n" for line in v.lines)
    assert len(v.plaintext) % 64 == 0
    if not v.compress:
        size = len(content)
        frame = b"\x28\xb5\x2f\xfd\xa0" + size.to_bytes(4, "little") + (8 * size + 1).to_bytes(3, "little") + content
        assert v.plaintext == frame.ljust(len(v.plaintext), b"\0")
    assert zstd.decompress(v.plaintext.rstrip(b"\0").ljust(4, b"\0")) == content
    assert v.salts == [mac(v.salt_key, i.to_bytes(4, "big"))[:16] for i in range(len(v.lines))]
    leaves = [sm3(b"\0", salt, line) for salt, line in zip(v.salts, v.lines, strict=True)]
    assert tree_hash(leaves) == v.root
    if hasattr(v, "proof"):
        index = v.proof.index
        assert v.proof.salt == v.salts[index] and v.proof.path == path(index, leaves)


def test_the_links_and_the_dropped_form_follow_from_the_document():
    assert [v.previous for v in CASES] == [bytes(32), *(v.digest for v in CASES[:-1])]
    v = CASES[0]
    assert v.dropped.chunk == v.header + v.dropped.signature
    assert v.dropped.signed == b"rosbridge-eth/2 dropped\0" + LEDGER.ledger + ROBOT.tk + v.header
    check_signature(point(ROBOT.public_key), v.dropped.signed, v.dropped.signature)


@case
def test_this_library_says_the_same(v):
    log, robot = Log(LEDGER.ledger, ROBOT.tk), sm2.PrivateKey.from_bytes(ROBOT.signing_key)
    readers = [sm2.PrivateKey.from_bytes(key) for key in READERS[: v.readers]]
    chunk = Chunk.parse(v.chunk)
    verify(log, robot.public_key, chunk)
    header = chunk.header
    assert (header.stream, header.number, header.previous, header.sealed_ms, header.goodbye, header.digest) == (
        v.stream, v.number, v.previous, v.sealed_ms, v.goodbye, v.digest
    )  # fmt: skip
    for reader in readers:
        assert open_lines(log, chunk, content_key(header, reader)) == tuple(v.lines)
    again = seal(
        log, robot, v.lines, stream=v.stream, number=v.number, previous=v.previous, sealed_ms=v.sealed_ms,
        readers=[reader.public_key for reader in readers], goodbye=v.goodbye, compress=v.compress,
        secret=ROBOT.secret, randomness=lambda size: v.random,
    )  # fmt: skip
    if not v.compress or zstd.zstd_version == FILE["zstd"]:
        fixed = header.encoded[:139]
        assert again.header.encoded[:139] == fixed and again.body == chunk.body
    if hasattr(v, "proof"):
        proof = Proof(v.proof.index, v.proof.salt, tuple(v.proof.path))
        assert next(proofs(v.lines, v.content_key, [proof.index])) == proof
        check_proof(header.root, header.records, v.lines[proof.index], proof)
    if hasattr(v, "dropped"):
        dropped = Chunk.parse(v.dropped.chunk)
        assert dropped.bare
        verify(log, robot.public_key, dropped)
        assert drop(log, robot, chunk).header == dropped.header
        with pytest.raises(Forged):
            verify(log, robot.public_key, Chunk(header, dropped.signature, chunk.body))


def test_the_generator_makes_these_very_bytes():
    if zstd.zstd_version != FILE["zstd"]:
        pytest.skip(f"the frames were made by zstd {FILE['zstd']}, this is {zstd.zstd_version}")
    program = "import json, make_chunks; print(json.dumps(make_chunks.vectors()))"
    paths = os.pathsep.join([str(FOLDER), *sys.path])
    made = subprocess.run(
        [sys.executable, "-c", program], env=os.environ | {"PYTHONPATH": paths}, capture_output=True, check=True
    )
    assert json.loads(made.stdout) == FILE

"""Makes chunks.json beside it: a log of six chunks, with every input and every value on the way.

Run from the repository: PYTHONPATH=src python tests/vectors/log/make_chunks.py

Keys and random bytes are fixed. smcrypto draws the randomness of its signatures and encryptions by
`secrets.token_bytes`, which is replaced before smcrypto is imported: so they are the same in every run, too.
Only the frame of the compressed chunk depends on the version of zstd, which is recorded; another version
makes other bytes that are as good.

Only needed when the format changes. tests/bridge/log/test_vectors.py computes every value again with code of
its own.
"""

from __future__ import annotations

import json
import secrets
from hashlib import blake2s
from pathlib import Path
from typing import Any

secrets.token_bytes = lambda size=None: b"\x5a" * (size or 32)  # type: ignore[assignment]

from rosbridge_eth.log import chunk as chunks  # noqa: E402
from rosbridge_eth.log.chunk import Chunk, Log  # noqa: E402
from smcrypto import sm2, sm3, sm4  # noqa: E402


def drawn(label: str, size: int) -> bytes:
    """Random-looking bytes that anybody can make again; for vectors alone."""
    return blake2s(label.encode()).digest()[:size]


ROBOT = sm2.PrivateKey.from_bytes(b"\0" + drawn("robot", 31))
READERS = [sm2.PrivateKey.from_bytes(b"\0" + drawn(f"reader {i}", 31)) for i in range(2)]
NAME, CHAIN_ID = "robot_1", 1337
GENESIS, CONTRACT = drawn("genesis", 32), drawn("contract", 20)
LOG = Log(chunks.ledger_id(CHAIN_ID, GENESIS, CONTRACT), chunks.robot_id(NAME))
SEALED_MS = 1_795_226_223_026
STREAMS = [chunks.stream_name(SEALED_MS + i * 60_000, bytes(16), lambda size: drawn("stream", size)) for i in range(2)]
SECRET = chunks.content_secret(ROBOT)

STREAM_LINE = b'{"stream":{"source":"sim","software":"rosbridge_eth 2.0"}}'
TYPE_LINE = (
    b'{"type":"std_msgs/msg/Float64","wire":"ros1","format":"msg","definition":"float64 data"}'
)


def message(index: int) -> bytes:
    received = 1_795_226_223_026_080_984 + index * 100_000_000
    return (
        '{"topic":"/battery","type":"std_msgs/msg/Float64","source":"sim",'
        f'"received_ns":{received},"captured_ns":{received + 263_344},"clock":true,'
        f'"data":{{"data":{12.5 - index / 8}}}}}'
    ).encode()


LOST_LINE = '{"lost":3,"topic":"/kamera/größe","why":"the message is longer than 61440 bytes"}'.encode()
FIRST = [STREAM_LINE, TYPE_LINE, message(0), message(1), message(2), LOST_LINE, message(3)]
SECOND = [STREAM_LINE, TYPE_LINE, *(message(i) for i in range(4, 24))]


def make(
    name: str, lines: list[bytes], stream: int, number: int, previous: bytes, *, goodbye: bool = False,
    compress: bool = False, readers: int = 2, prove: int | None = None,
) -> tuple[Chunk, dict[str, Any]]:  # fmt: skip
    random = drawn(f"{name} key", 32)
    chunk = chunks.seal(
        LOG, ROBOT, lines,
        stream=STREAMS[stream], number=number, previous=previous, sealed_ms=SEALED_MS + number * 1000,
        readers=[reader.public_key for reader in READERS[:readers]], goodbye=goodbye, compress=compress,
        secret=SECRET, randomness=lambda size: random,
    )  # fmt: skip
    header = chunk.header
    case: dict[str, Any] = {
        "name": name, "source": "rosbridge_eth, docs/log.md", "stream": header.stream.hex(), "number": number,
        "previous": previous.hex(), "sealed_ms": header.sealed_ms, "goodbye": goodbye, "compress": compress,
        "readers": readers if lines else 0, "lines": [line.decode() for line in lines],
    }  # fmt: skip
    if lines:
        key = chunks.content_key(header, READERS[0])
        place = header.stream + number.to_bytes(8, "big")
        body_key, salt_key = (sm3.hmac(key, b"rosbridge-eth/3 " + label + b"\1") for label in (b"body", b"salts"))
        plaintext = sm4.SM4GCM(body_key[:16]).decrypt(bytes(12), chunk.body, LOG.ledger + LOG.tk + place)
        case |= {
            "random": random.hex(), "plaintext": plaintext.hex(), "content_key": key.hex(),
            "body_key": body_key[:16].hex(), "salt_key": salt_key.hex(),
            "associated_data": (LOG.ledger + LOG.tk + place).hex(),
            "salts": [sm3.hmac(salt_key, i.to_bytes(4, "big"))[:16].hex() for i in range(len(lines))],
        }  # fmt: skip
    case |= {
        "root": header.root.hex(), "body_digest": header.body_digest.hex(), "header": header.encoded.hex(),
        "digest": header.digest.hex(),
        "signed": (b"rosbridge-eth/2 chunk\0" + LOG.ledger + LOG.tk + header.encoded).hex(),
        "signature": chunk.signature.hex(), "chunk": chunk.encoded.hex(),
    }  # fmt: skip
    if prove is not None:
        proof = next(chunks.proofs(lines, key, [prove]))
        case["proof"] = {
            "index": proof.index, "salt": proof.salt.hex(), "path": [value.hex() for value in proof.path],
        }  # fmt: skip
    return chunk, case


def vectors() -> dict[str, Any]:
    stored, first = make("stored, for two readers", FIRST, 0, 0, bytes(32), prove=4)
    goodbye, last = make("goodbye without records", [], 0, 1, stored.header.digest, goodbye=True)
    packed, second = make("compressed, a new stream", SECOND, 1, 0, goodbye.header.digest, compress=True, readers=1)
    dropped = chunks.drop(LOG, ROBOT, stored)
    first["dropped"] = {
        "signed": (b"rosbridge-eth/2 dropped\0" + LOG.ledger + LOG.tk + dropped.header.encoded).hex(),
        "signature": dropped.signature.hex(), "chunk": dropped.encoded.hex(),
    }  # fmt: skip
    silence, silent = make("heartbeat, nothing to say", [], 1, 1, packed.header.digest)
    alone, one = make("one line", [message(24)], 1, 2, silence.header.digest, readers=1, prove=0)
    lost = [b'{"lost":%d,"topic":"/t","why":"w"}' % n for n in range(1, 1001)]
    _, many = make("a thousand lines", lost, 1, 3, alone.header.digest, compress=True, readers=1, prove=999)
    return {
        "generator": "make_chunks.py",
        "verified_with": "tests/bridge/log/test_vectors.py: textbook SM2 on affine points, SM3 of OpenSSL, "
        "SM4-GCM of cryptography, the recursive tree of RFC 9162",
        "zstd": chunks.zstd.zstd_version,
        "robot": {
            "name": NAME, "signing_key": ROBOT.to_bytes().hex(), "public_key": ROBOT.public_key.to_bytes().hex(),
            "tk": LOG.tk.hex(), "secret": SECRET.hex(),
        },
        "ledger": {
            "chain_id": CHAIN_ID, "genesis": GENESIS.hex(), "contract": CONTRACT.hex(), "ledger": LOG.ledger.hex(),
        },
        "reader_keys": [reader.to_bytes().hex() for reader in READERS],
        "tests": [first, last, second, silent, one, many],
    }  # fmt: skip


if __name__ == "__main__":
    text = json.dumps(vectors(), indent=1, ensure_ascii=False) + "\n"
    (Path(__file__).parent / "chunks.json").write_text(text)

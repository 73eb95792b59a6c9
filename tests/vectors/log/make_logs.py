"""Makes logs.json and grant.json beside this file, and evidence/files.json: whole logs with what a reader says of them.

    PYTHONPATH=src:tests python tests/vectors/log/make_logs.py

Each log is what a node says of one robot: the answer of `standings` and the events as ABI bytes, the times of blocks.
The verdict is that of `read`; that each wrong chunk is found, and under which name, is said here by hand. Keys are new
every time. tests/bridge/reading/test_vectors.py asks `read`, docs/verify.mjs and the page of evidence about all.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any
from unittest import mock

from eth_abi.abi import encode
from eth_hash.auto import keccak

from bridge.reading.certificates import CAS, cases
from bridge.reading.vectors import Node, ask_read
from bridge.reading.world import NAME, START, STREAM_LINE, T0, Pen, authority, line, message, reader, robot
from rosbridge_eth import identity
from rosbridge_eth.log import chunk as chunks
from rosbridge_eth.log.chunk import Chunk, Log, content_key, ledger_id, proofs, robot_id, zstd
from rosbridge_eth.reading.evidence import Evidence, Record, Written
from rosbridge_eth.reading.grant import make as make_grant

FOLDER = Path(__file__).parent
CHAIN_ID, GENESIS, CONTRACT = 1337, keccak(b"genesis"), keccak(b"contract")[:20]
LOG = Log(ledger_id(CHAIN_ID, GENESIS, CONTRACT), robot_id(NAME))
ACCOUNT = "0x" + CONTRACT.hex()


@dataclass
class Made:
    """A log as a contract would have it; block n has one event and was made at T0 + n."""

    name: str
    pen: Pen = field(default_factory=lambda: Pen(log=LOG))
    events: list[dict[str, Any]] = field(default_factory=list)
    about: list[dict[str, Any]] = field(default_factory=list)
    count: int = 0
    last: bytes = b""
    data_block: int = 0
    changed_block: int = 0
    certificates_hash: bytes = bytes(32)
    revoked: bool = False

    def _event(self, signature: str, second: bytes, values: bytes, third: bytes = b"") -> int:
        block = len(self.events) + 1
        topics = [keccak(signature.encode()), LOG.tk, second, *([third] if third else [])]
        self.events.append(
            {
                "topics": ["0x" + topic.hex() for topic in topics],
                "data": "0x" + values.hex(),
                "block": block,
                "transaction": "0x" + keccak(b"transaction %d" % block).hex(),
            }
        )
        return block

    def register(self, certificates: bytes) -> None:
        self.certificates_hash, self.revoked = keccak(certificates), False
        self.changed_block = self._event(
            "Registered(bytes32,address,uint256,uint256,bytes)",
            encode(["address"], [ACCOUNT]),
            encode(["uint256", "uint256", "bytes"], [self.count, self.changed_block, certificates]),
        )

    def revoke(self) -> None:
        self.revoked = True
        self.changed_block = self._event(
            "Revoked(bytes32,address,uint256,uint256)",
            encode(["address"], [ACCOUNT]),
            encode(["uint256", "uint256"], [self.count, self.changed_block]),
        )

    def write(self, *encoded: Chunk | bytes, name: str = "", finding: str | None = None) -> None:
        """finding: what a reader says of the chunk that is named."""
        data = [one if isinstance(one, bytes) else one.encoded for one in encoded]
        if name:
            self.about.append({"chunk": self.count, "name": name, "finding": finding})
        self.data_block = self._event(
            "Data(bytes32,uint256,address,uint256,bytes[])",
            encode(["uint256"], [self.count]),
            encode(["uint256", "bytes[]"], [self.data_block, data]),
            encode(["address"], [ACCOUNT]),
        )
        self.count, self.last = self.count + len(data), data[-1]

    def done(self, cas: Sequence[Any] = (authority(),), **more: Any) -> dict[str, Any]:
        standing = (
            ACCOUNT,
            self.certificates_hash,
            self.revoked,
            self.count,
            keccak(self.last) if self.last else bytes(32),
            0,
            self.data_block,
            self.changed_block,
        )
        file: dict[str, Any] = {
            "name": self.name,
            "source": "rosbridge_eth, docs/reading.md",
            "chain_id": CHAIN_ID,
            "genesis": "0x" + GENESIS.hex(),
            "contract": ACCOUNT,
            "robot": NAME,
            "ca": "".join(one.certificate.to_pem().decode() for one in cas),
            "reader_key": reader().encryption_key.to_bytes().hex(),
            "first_block_time": T0,
            "standings": "0x"
            + encode(["(address,bytes32,bool,uint256,bytes32,uint256,uint256,uint256)[]"], [[standing]]).hex(),
            "events": self.events,
            "about": self.about,
        } | more
        with Node(file) as node:
            verdict, lines = ask_read(node, file)
        for one in self.about:
            there = [kind for kind, places in verdict["places"].items() if one["chunk"] in places]
            assert (one["finding"] in there) if one["finding"] else not {*there} & {"unopenable", "forged"}, (
                one,
                there,
            )
        return file | {"verdict": verdict, "lines": lines}


@contextmanager
def lying(**patches: Any) -> Iterator[None]:
    with mock.patch.multiple(chunks, **patches):
        yield


def padded(frame: bytes) -> bytes:
    return frame.ljust(len(frame) + -len(frame) % 64, b"\0")


def whole() -> dict[str, Any]:
    made = Made("a log of two robots' keys with all that is no breach")
    pen = made.pen
    made.register(robot().public.certificates)
    event = line({"trigger": "crash", "why": "/bumper data == true", "at_ns": 10**18})
    lost = line({"lost": 3, "topic": "/scan", "why": "too long"})
    definition = line({"type": "pkg/msg/Type", "wire": "ros1", "format": "msg", "definition": "float64 x"})
    made.write(pen.write(STREAM_LINE, definition, message(1), message(2, text="é漢\u2028\x9b31m\u202e"), lost))
    kept = pen.write(message(3), message(4))
    dropped = pen.drop(pen.write(message(5), message(6)))
    made.write(
        pen.drop(kept), dropped, pen.write(event, message(7, clock=False)), name="a dropped chunk", finding="dropped"
    )
    made.write(kept, name="the whole chunk behind its dropped form")
    pen.readers = [reader("insurer"), reader()]
    made.write(pen.write(message(8)), name="two readers")
    pen.readers = [reader("insurer")]
    made.write(pen.write(message(9)), name="for another reader", finding="no-grant")
    pen.readers = [reader()]
    made.write(pen.write(), pen.write(goodbye=True))
    made.register(robot(1).public.certificates)
    pen.identity = robot(1)
    pen.new_stream(b"b" * 16)
    made.write(pen.write(*(message(n) for n in range(10, 40))), name="under the second certificate")
    pen.new_stream(b"c" * 16)
    made.write(pen.write(message(40)), name="a stream without goodbye before it", finding="restarted")
    pen.new_stream(b"d" * 16, bytes(32))
    made.write(pen.write(message(41)), name="a robot that knows of nothing before", finding="restarted")
    made.write(pen.write(message(42), sealed_ms=pen.sealed_ms - 5_000), name="a clock that went back", finding="clock")
    return made.done()


def forms() -> Iterator[tuple[str, bytes]]:
    """Bytes that are no chunk."""
    good = Pen(log=LOG).write(message(1), message(2))
    empty = Pen(log=LOG).write()
    fields = struct.Struct(">BB16sQ32sQI32sI32sB")

    def changed(chunk: Chunk, *, rest: bytes | None = None, **values: Any) -> bytes:
        names = (
            "version",
            "flags",
            "stream",
            "number",
            "previous",
            "sealed",
            "records",
            "root",
            "length",
            "digest",
            "n",
        )
        old = dict(zip(names, fields.unpack_from(chunk.encoded), strict=True))
        return fields.pack(*(old | values).values()) + (chunk.encoded[139:] if rest is None else rest)

    yield "nothing", b""
    yield "no chunk at all", b"junk" * 100
    yield "version 2", changed(good, version=2)
    yield "version 4", changed(good, version=4)
    yield "an unknown flag", changed(good, flags=2)
    yield "sealed in the year 10000", changed(good, sealed=253_402_300_800_000)
    yield "1,001 records", changed(good, records=1001)
    yield "no grant", changed(good, n=0, rest=good.encoded[252:])
    yield "17 grants", changed(good, n=17, rest=good.encoded[139:252] * 17 + good.encoded[252:])
    yield "a body that is no multiple of 64", changed(good, length=len(good.body) + 1, rest=good.encoded[139:] + b"\0")
    yield "a byte too many", good.encoded + b"\0"
    yield "a byte too few", good.encoded[:-1]
    yield "half a body", good.encoded[:-64]
    yield "no signature", good.encoded[:252]
    yield "no records and a root", changed(empty, root=bytes(32))
    yield "no records and a grant", changed(empty, n=1, rest=good.encoded[139:252] + empty.encoded[139:])
    yield "no records and a body", changed(empty, length=80, rest=empty.encoded[139:] + bytes(80))


def frames() -> Iterator[tuple[str, str | None, bytes]]:
    """What a body may hold for two messages, and what a reader says."""
    good = message(1), message(2)
    content = b"\n".join([*good, b""])

    def ours(data: bytes) -> bytes:
        return chunks._compressed(data, 9)

    def streamed(data: bytes, **options: int) -> bytes:
        parameters = {int(getattr(zstd.CompressionParameter, name)): value for name, value in options.items()}
        packing = zstd.ZstdCompressor(options=parameters)
        return packing.compress(data) + packing.flush()

    frame, skippable = ours(content), struct.pack("<II", 0x184D2A50, 4) + b"skip"
    dictionary = zstd.train_dict([message(n, topic=f"/t{n % 7}") for n in range(2_000)], 4096)
    packing = zstd.ZstdCompressor()
    for name, made in (
        ("raw blocks", chunks._stored(content)),
        ("blocks of level 19", chunks._framed(zstd.compress(content, 19), content)),
        ("blocks made for a window of 4 MiB", chunks._framed(streamed(content, window_log=22), content)),
    ):
        yield name, None, padded(made)
    for name, made in (
        ("a header with a window", streamed(content)),
        ("a header with a size of another length", zstd.compress(content)),
        ("a checksum", streamed(content, checksum_flag=1)),
        ("a reserved bit", frame[:4] + bytes([frame[4] | 8]) + frame[5:]),
        ("a dictionary", chunks._framed(zstd.compress(content, zstd_dict=dictionary), content)),
        ("a size too small", frame[:5] + b"\1\0\0\0" + frame[9:]),
        ("a size too large", frame[:5] + (len(content) + 1).to_bytes(4, "little") + frame[9:]),
        ("a size of 4 GiB", frame[:5] + b"\xff" * 4 + frame[9:]),
        ("no frame", content),
        ("a header alone", frame[:9]),
        ("a skippable frame before it", skippable + frame),
        ("a skippable frame behind it", frame + skippable),
        ("two frames", frame * 2),
        ("no last block", chunks._framed(packing.compress(content, packing.FLUSH_BLOCK), content)),
        ("a block of the reserved kind", frame[:9] + bytes([frame[9] | 6]) + frame[10:]),
        ("more than 4 MiB", ours(content + b"a" * (4 << 20) + b"\n")),
        ("an empty record in front", ours(b"\n" + content)),
        ("an empty record in the middle", ours(good[0] + b"\n\n" + good[1] + b"\n")),
        ("a record without end", ours(content[:-1])),
        ("a record too few", ours(good[0] + b"\n")),
        ("a record too many", ours(content + good[0] + b"\n")),
    ):
        yield name, "unopenable", padded(made)
    yield "padding that is not zero", "unopenable", padded(frame + b"\0\0\1")
    yield "64 bytes of padding", "unopenable", padded(frame) + bytes(64)


def wrong() -> dict[str, Any]:
    made = Made("each chunk that is wrong")
    pen = made.pen
    made.register(robot().public.certificates)
    made.write(pen.write(message(0)))
    for name, encoded in forms():
        made.write(encoded, name=name, finding="malformed")
    for at, name in (
        (3, "another stream"),
        (25, "another number"),
        (40, "another digest before"),
        (80, "another root"),
        (110, "another body digest"),
        (150, "another grant"),
        (252 + 10, "another signature"),
    ):
        good = bytearray(Pen(log=LOG).write(message(1)).encoded)
        good[at] ^= 1
        made.write(bytes(good), name=name, finding="forged")
    made.write(
        Pen(log=Log(LOG.ledger, robot_id("robot_2"))).write(message(1)), name="for another robot", finding="forged"
    )
    made.write(Pen(log=Log(b"L" * 32, LOG.tk)).write(message(1)), name="for another ledger", finding="forged")
    made.write(Pen(log=LOG, identity=robot(1)).write(message(1)), name="by another key", finding="forged")
    good = Pen(log=LOG).write(message(1))
    made.write(good.encoded[: -len(good.body)], name="a body that somebody else took away", finding="forged")
    dropped = pen.drop(good)
    made.write(
        replace(good, signature=dropped.signature), name="a body under the dropped form's signature", finding="forged"
    )
    whole_one = pen.write(message(1))
    body = bytes([whole_one.body[0] ^ 1]) + whole_one.body[1:]
    made.write(replace(whole_one, body=body), name="another body", finding="altered")
    for name, finding, plaintext in frames():
        with lying(_pack=lambda *given, plaintext=plaintext: plaintext):
            chunk = pen.write(message(1), message(2))
        made.write(chunk, name=name, finding=finding)
    with lying(_body_key=lambda key: b"k" * 16):
        made.write(pen.write(message(1)), name="a body under another key", finding="unopenable")
    with lying(_leaf=lambda salt, text: bytes(32)):
        made.write(pen.write(message(1), message(2)), name="a root of other records", finding="unopenable")
    with lying(_salts=lambda key, indexes: (bytes(16) for _ in indexes)):
        made.write(pen.write(message(1), message(2)), name="other salts", finding="unopenable")
    key = type(reader().encryption_key.public_key)
    for name, wrap in (
        ("a wrapped key of junk", b"\4" + bytes(112)),
        ("a wrapped key with another C3", None),
        ("a wrapped key in compressed form", b"\2" + bytes(112)),
    ):
        encrypt = key.encrypt

        def wrapped(self: Any, data: bytes, *, encoding: Any, wrap: Any = wrap, encrypt: Any = encrypt) -> bytes:
            good = encrypt(self, data, encoding=encoding)
            return wrap or good[:70] + bytes([good[70] ^ 1]) + good[71:]

        with mock.patch.object(key, "encrypt", wrapped):
            chunk = pen.write(message(1))
        made.write(chunk, name=name, finding="no-grant")
    chunk = pen.write(message(1))
    header = chunk.header.encoded[:138] + b"\3" + 2 * (b"\4" + bytes(112)) + chunk.header.grants[0]
    signature = identity.sign(pen.identity.signing_key, "chunk", LOG.ledger + LOG.tk + header)
    third = Chunk.parse(header + signature + chunk.body)
    pen.previous = third.header.digest
    made.write(third, name="the key in the third grant")
    made.write(pen.write(*spoiled(), message(3)), name="lines in another form", finding="unopenable")
    made.write(pen.write(*spelled()), name="lines in their form")
    made.write(
        pen.write(message(1), sealed_ms=int(robot().not_after.timestamp() * 1000) + 1),
        name="sealed after the end",
        finding="untrusted",
    )
    made.revoke()
    made.write(pen.write(message(1)), name="behind a revocation", finding="untrusted")
    return made.done()


def spoiled() -> list[bytes]:
    data = message(1, text="é\u2028", big=2**62, small=1e-300)
    return [
        b"null",
        b"[]",
        b"{}",
        b"1",
        b"no json",
        data + b" ",
        data[:-1],
        data.replace(b",", b", ", 1),
        data.replace(b"/odom", b"\\u002fodom"),
        data.replace(b"/odom", b"\\/odom"),
        data.replace("é".encode(), b"\\u00e9"),
        data.replace(b'"x":1', b'"x":1,"x":2'),
        data.replace(b'"clock":true', b'"clock":1'),
        data.replace(b'"received_ns":1', b'"received_ns":-1'),
        data.replace(b'"received_ns":1', b'"received_ns":1.0'),
        data.replace(b'"received_ns":1', b'"received_ns":9223372036854775808'),
        data.replace(b'"x":1', b'"x":1e400'),
        data.replace(b'"x":1', b'"x":NaN'),
        data.replace(b'"x":1', b'"x":01'),
        data.replace(b'"x":1', b'"x":' + b"[" * 101 + b"]" * 101),
        data.replace(b'"x":1', b'"x":"\\ud800"'),
        data.replace(b'"x":1', b'"x":"\xff"'),
        message(1, text="x" * 62_000),
        data.replace(b'"topic"', b'"topics"'),
        data.replace(b'"data":{', b'"more":1,"data":{'),
        line({"lost": -1, "topic": "/t", "why": "w"}),
        line({"lost": 1, "topic": "/t"}),
        line({"type": "t", "wire": "ros1", "format": 1, "definition": "d"}),
        line({"trigger": "t", "why": "w", "at_ns": 2**63}),
        b'{"stream":{"source":"sim","software":"s"},"x":1}',
    ]


def spelled() -> list[bytes]:
    data = message(1, text="\x7f\u2028 \x9b", big=2**62, small=1e-300)
    return [
        data,
        line({"lost": 2**53, "topic": "/t", "why": 'a"b\n\x1b\\'}),
        STREAM_LINE,
        message(3, lost=5, at_ns=-7),
        data.replace(b'"x":1', b'"x":[1.50,-0,1E5,123456789012345678901234567890]'),
        message(2, nested=[[[{}]]] * 2),
    ]


def links() -> dict[str, Any]:
    made = Made("links in all cases")
    made.register(robot().public.certificates)
    pen = made.pen
    first = pen.chunks(4)
    made.write(*first[:2])
    made.write(first[0], name="a chunk once more", finding="forked")
    made.write(first[3], name="a chunk is missing before it", finding="missing")
    made.write(first[2], name="a chunk out of its order", finding="forked")
    other = Pen(log=LOG, number=2, previous=first[1].header.digest, sealed_ms=pen.sealed_ms)
    made.write(other.write(message(90)), name="another chunk in this place", finding="forked")
    made.write(other.write(message(91)), name="what follows the other", finding=None)
    behind = Pen(log=LOG, number=4, previous=b"?" * 32, sealed_ms=pen.sealed_ms + 5_000)
    made.write(behind.write(message(92)), name="an unknown chunk before it, in the same stream", finding="forked")
    fresh = Pen(log=LOG, stream=b"b" * 16, previous=b"?" * 32, sealed_ms=behind.sealed_ms)
    made.write(fresh.write(message(93)), name="an unknown chunk before it, in a new stream", finding="missing")
    made.write(fresh.write(message(94), goodbye=True))
    made.write(fresh.write(message(95)), name="behind the goodbye of its stream", finding="forked")
    made.write(fresh.write(message(96), goodbye=True), name="and another goodbye")
    fresh.new_stream(b"ab" * 8)
    made.write(
        fresh.write(message(97), goodbye=True), name="a stream that is named below the one before", finding="forked"
    )
    fresh.new_stream(b"b" * 16)
    fresh.number = 7
    made.write(fresh.write(message(98)), name="a stream's name again, in the middle of it", finding="forked")
    fresh.new_stream(b"a" * 16, bytes(32))
    made.write(fresh.write(message(99)), name="a stream below that knows of nothing before", finding="forked")
    fresh.new_stream(b"c" * 16, first[0].header.digest)
    made.write(fresh.write(message(100)), name="a stream that follows an older chunk", finding="forked")
    gone = fresh.write(message(101))
    made.write(
        pen.drop(gone),
        fresh.write(message(102)),
        gone,
        gone,
        name="a dropped chunk, then whole, twice",
        finding="dropped",
    )
    return made.done()


def certificates() -> dict[str, Any]:
    made = Made("certificates, good and bad")
    made.register(robot().public.certificates)
    known = list(cases())
    for case in known:
        made.register(case.registered)
    file = made.done(CAS)
    trusted = [one["trusted"] for one in file["verdict"]["certificates"][1:]]
    assert trusted == [case.good for case in known]
    return file | {
        "certificates": [{"name": case.name, "good": case.good, "der": case.registered.hex()} for case in known]
    }


def withheld() -> dict[str, Any]:
    made = Made("a node that keeps chunks back and has another hash of the last")
    made.register(robot().public.certificates)
    made.write(*made.pen.chunks(2))
    made.write(*made.pen.chunks(3))
    made.write(*made.pen.chunks(2))
    del made.events[2]
    made.last = b"another"
    return made.done()


def grant() -> dict[str, Any]:
    pen = Pen(log=LOG)
    given = pen.chunks(3, records=2)
    keys = {one.header.digest: content_key(one.header, reader().encryption_key) for one in given[1:]}
    file = make_grant(
        keys,
        ledger=LOG.ledger,
        robot=NAME,
        begin="2026-01-02",
        end="2026-01-03",
        by=reader(),
        to=reader("insurer").public,
        now=START,
    )
    return {
        "source": "rosbridge_eth, docs/reading.md, Granting",
        "ca": authority().certificate.to_pem().decode(),
        "ledger": LOG.ledger.hex(),
        "robot": NAME,
        "reader_key": reader("insurer").encryption_key.to_bytes().hex(),
        "grant": file.decode(),
        "keys": {digest.hex(): key.hex() for digest, key in keys.items()},
        "chunks": [one.encoded.hex() for one in given],
    }


def evidence_files() -> Iterator[dict[str, Any]]:
    """Evidence of one record each, good and bad."""

    def made(
        pen: Pen,
        registered: bytes,
        encoded: bytes | None = None,
        texts: Sequence[bytes] = (),
        bare: bool = False,
        **more: Any,
    ) -> str:
        given = texts or [message(1), message(2), message(3)]
        chunk = pen.write(*given)
        [shown] = proofs(given, content_key(chunk.header, reader().encryption_key), [1 % len(given)])
        if encoded is None:
            encoded = (pen.drop(chunk) if bare else chunk).encoded
        values = {
            "robot": NAME,
            "tk": LOG.tk,
            "chain_id": CHAIN_ID,
            "genesis": GENESIS,
            "contract": CONTRACT,
            "certificates": [registered],
            "authorities": [authority().certificate.to_der()],
            "chunks": [
                Written(
                    chunk=0,
                    certificate=0,
                    encoded=encoded,
                    first=0,
                    hashes=[keccak(encoded)],
                    block=1,
                    transaction=keccak(b"t"),
                )
            ],
            "records": [
                Record(
                    chunk=0,
                    record=shown.index,
                    line=given[shown.index].decode("utf-8", "replace"),
                    salt=shown.salt,
                    path=list(shown.path),
                )
            ],
        } | more
        return Evidence(**values).encode()

    def case(name: str, holds: bool, text: str) -> dict[str, Any]:
        return {"name": name, "holds": holds, "text": text}

    registered = robot().public.certificates
    for one in cases():
        text = made(
            Pen(log=LOG, identity=one.identity),
            one.registered,
            authorities=sorted(ca.certificate.to_der() for ca in CAS),
        )
        yield case(f"certificates: {one.name}", one.good, text)
    for name, encoded in forms():
        yield case(f"a chunk: {name}", False, made(Pen(log=LOG), registered, encoded))
    good = made(Pen(log=LOG), registered)
    yield case("a dropped chunk", True, made(Pen(log=LOG), registered, bare=True))
    for name, pen in (
        ("for another robot", Pen(log=Log(LOG.ledger, robot_id("robot_2")))),
        ("for another ledger", Pen(log=Log(b"L" * 32, LOG.tk))),
        ("by another key", Pen(log=LOG, identity=robot(1))),
        ("sealed after the end", Pen(log=LOG, sealed_ms=int(robot().not_after.timestamp() * 1000) + 1)),
    ):
        yield case(f"a chunk: {name}", False, made(pen, registered))
    for text in spoiled():
        if "\ufffd" not in text.decode("utf-8", "replace"):
            yield case(f"a line: {text[:80].decode()}", False, made(Pen(log=LOG), registered, texts=[message(1), text]))
    for text in spelled():
        holds = b'"topic":"/odom"' in text
        yield case(f"a line: {text[:80].decode()}", holds, made(Pen(log=LOG), registered, texts=[message(1), text]))
    value = json.loads(good)
    sealed = value["chunks"][0]["encoded"]
    other = sealed[:-2] + ("00" if sealed[-2:] != "00" else "11")
    yield case("a chunk: another body", False, good.replace(sealed, other))
    [written], [record] = value["chunks"], value["records"]

    def changed(**members: Any) -> str:
        return json.dumps(value | members, separators=(",", ":")).replace("<", "\\u003c")

    for name, text in (
        ("a space", good.replace(",", ", ", 1)),
        ("a member more", changed(more=1)),
        ("another format", changed(format="rosbridge-eth evidence 2")),
        ("members in another order", json.dumps(dict(reversed(value.items())), separators=(",", ":"))),
        ("capitals", good.replace(written["encoded"], written["encoded"].upper())),
        ("another robot", changed(robot="robot_2")),
        ("another Tk", changed(tk="11" * 32)),
        ("another chain", changed(chain_id=1)),
        ("another first block", changed(genesis="11" * 32)),
        ("another contract", changed(contract="11" * 20)),
        ("another CA", changed(authorities=[authority("Another").certificate.to_der().hex()])),
        ("no CA", changed(authorities=[])),
        ("the CA twice", changed(authorities=[value["authorities"][0]] * 2)),
        (
            "certificates of which no chunk is",
            changed(certificates=[registered.hex(), robot(1).public.certificates.hex()]),
        ),
        ("no record", changed(records=[])),
        ("a record twice", changed(records=[record, record])),
        ("a chunk of which no record is", changed(chunks=[written, written | {"chunk": 1, "first": 1}])),
        ("a record of no chunk", changed(records=[record | {"chunk": 1}])),
        ("another line", changed(records=[record | {"line": message(9).decode()}])),
        ("another salt", changed(records=[record | {"salt": "00" * 16}])),
        ("another place", changed(records=[record | {"record": 2}])),
        ("a place that is not there", changed(records=[record | {"record": 3}])),
        ("a path too short", changed(records=[record | {"path": record["path"][:-1]}])),
        ("a path too long", changed(records=[record | {"path": [*record["path"], "00" * 32]}])),
        ("a path the other way round", changed(records=[record | {"path": record["path"][::-1]}])),
        ("a node of the tree as a record", changed(records=[record | {"path": record["path"][1:]}])),
        ("no hash", changed(chunks=[written | {"hashes": []}])),
        ("another index in the batch", changed(chunks=[written | {"first": 1}])),
        ("of no certificate", changed(chunks=[written | {"certificate": 1}])),
        ("no transaction", changed(chunks=[written | {"transaction": ""}])),
        ("no JSON", good[:-1]),
        ("nothing", ""),
    ):
        yield case(f"the file: {name}", False, text)
    yield case("the file: white space around it", True, f"\n {good}\n")
    yield case("the file: as it is made", True, good)


def write(path: Path, value: Any) -> None:
    path.write_text(json.dumps(value, indent=1, ensure_ascii=True) + "\n")


if __name__ == "__main__":
    made_by = {"generator": "make_logs.py", "verified_with": "tests/bridge/reading/test_vectors.py: docs/verify.mjs"}
    write(FOLDER / "logs.json", made_by | {"tests": [whole(), wrong(), links(), certificates(), withheld()]})
    write(FOLDER / "grant.json", {"generator": "make_logs.py", "tests": [grant()]})
    write(
        FOLDER.parent / "evidence" / "files.json",
        {
            "generator": "log/make_logs.py",
            "verified_with": "tests/bridge/reading/test_vectors.py: evidence.js",
            "ca": "".join(one.certificate.to_pem().decode() for one in CAS),
            "tests": list(evidence_files()),
        },
    )

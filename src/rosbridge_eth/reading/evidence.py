"""Evidence: one file that shows chosen records, and no other, to somebody who has neither a key nor a node.

    record --salt, path--> root in a chunk's header --SM2 signature--> the robot's certificate --> the CA
    chunk ---------------> the block and the transaction that wrote it, by name; a node says whether it is so

The file is JSON in one form only, so that no byte of it can change unnoticed; as a page it is the same JSON within HTML
with the verifier in JavaScript (evidence.js). docs/evidence.md says what each member is and what all of it proves.

Nothing in a file is believed: `read` bounds it and takes it apart, `verify` gives what it shows or says what does not
hold; it takes no key, node or home. `ask` asks the contract, on a node, for what only the chain can say.
"""

from __future__ import annotations

import hashlib
import json
import re
from base64 import b64encode
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import closing
from importlib import resources
from itertools import pairwise
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal, NamedTuple

from eth_hash.auto import keccak
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from rosbridge_eth.capture import MessageLine, parse_line

from rosbridge_eth.log.chunk import (  # isort: skip
    Chunk, Header, Log, Proof, check_proof, ledger_id, open_lines, proofs, robot_id, verify as verify_chunk,
)  # fmt: skip
from rosbridge_eth.config.values import counted, time_text
from rosbridge_eth.errors import ChainError, ConfigError, VerificationError
from rosbridge_eth.identity import Trust
from rosbridge_eth.reading.outputs import proof
from rosbridge_eth.reading.verdict import grouped, shown
from rosbridge_eth.reading.verify import LAST_MOMENT, Place, ProvenRecord, Verifier, fingerprint_of, signer
from smcrypto import sm2, sm3, x509

if TYPE_CHECKING:
    from rosbridge_eth.reading.fetch import Reading

FORMAT: Final = "rosbridge-eth evidence 3"
MAX_FILE: Final = 64 * 2**20
MAX_CHOSEN: Final = 100_000
MAX_CERTIFICATES: Final = 1_000
_MAX_STRUCTURE: Final = 4 * 2**20
"""Characters outside of strings. Values take more memory than their text, and each that is wrong still more."""
_BEGIN: Final = '<script type="application/json" id="evidence">'
_END: Final = "</script>"


# The file


Hex32 = Annotated[bytes, Field(min_length=32, max_length=32)]
Count = Annotated[int, Field(ge=0, lt=2**53)]


class _Part(BaseModel):
    # A member too many shows when the file is written again; pydantic's errors for a million of them fill the memory.
    model_config = ConfigDict(extra="ignore", strict=True, frozen=True, ser_json_bytes="hex", val_json_bytes="hex")


class Record(_Part):
    """A record: which one of the robot's log, the line as the robot wrote it, and its way up to the chunk's root."""

    chunk: Count
    record: Count
    line: str
    salt: Annotated[bytes, Field(min_length=16, max_length=16)]
    path: Annotated[list[Hex32], Field(max_length=10)]


class Written(_Part):
    """A chunk as the chain has it, and where: its index in the robot's log, its batch, block and transaction.

    certificate: which one of the file's it is signed under. first: index of the batch's first chunk. hashes: keccak256
    of each chunk of the batch.
    """

    chunk: Count
    certificate: Count
    encoded: bytes
    first: Count
    hashes: Annotated[list[Hex32], Field(max_length=MAX_CHOSEN)]
    block: Count
    transaction: Hex32


class Evidence(_Part):
    """What the file holds. tk: keccak256 of the robot's name, so that a page without keccak can check its signatures.

    certificates: the robot's, each signing and encryption, as they were registered.
    """

    format: Literal["rosbridge-eth evidence 3"] = FORMAT
    robot: Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9_.-]{0,62}$")]
    tk: Hex32
    chain_id: Count
    genesis: Hex32
    contract: Annotated[bytes, Field(min_length=20, max_length=20)]
    authorities: Annotated[list[bytes], Field(min_length=1, max_length=16)]
    certificates: Annotated[list[bytes], Field(min_length=1, max_length=MAX_CERTIFICATES)]
    chunks: Annotated[list[Written], Field(min_length=1, max_length=MAX_CHOSEN)]
    records: Annotated[list[Record], Field(min_length=1, max_length=MAX_CHOSEN)]

    @property
    def log(self) -> Log:
        return Log(ledger_id(self.chain_id, self.genesis, self.contract), self.tk)

    def encode(self) -> str:
        """The one form: ASCII without spaces, members as above; "<" is escaped, so that no page can end in it."""
        return json.dumps(self.model_dump(mode="json"), separators=(",", ":")).replace("<", "\\u003c")

    def page(self) -> str:
        """The same as an HTML page that checks itself. Its policy forbids every connection and any other script."""
        folder = resources.files(__package__)
        made = (folder / "evidence.html").read_text("utf-8")
        for name in ("evidence.js", "drawing.js"):
            made = made.replace(f"/* {name} */", (folder / name).read_text("utf-8"))
        for kind in ("script", "style"):
            found = re.findall(rf"<{kind}>(.*?)</{kind}>", made, re.DOTALL)
            hashes = (b64encode(hashlib.sha256(text.encode()).digest()).decode() for text in found)
            made = made.replace(f"{kind}-hashes", " ".join(f"'sha256-{each}'" for each in hashes))
        return made.replace(_BEGIN, _BEGIN + self.encode(), 1)

    @staticmethod
    def read(data: bytes) -> Evidence:
        """The evidence in a file, JSON or page. VerificationError where it is none."""
        if len(data) > MAX_FILE:
            raise VerificationError(f"evidence has at most {MAX_FILE >> 20} MiB; this file has more")
        try:
            text = data.decode()
            if _BEGIN in text:
                text = text.partition(_BEGIN)[2].partition(_END)[0]
            plain = text.replace(r"\\", "").replace(r'\"', "")
            if plain.count('"') > 2 * _MAX_STRUCTURE or len(re.sub('"[^"]*"?', "", plain)) > _MAX_STRUCTURE:
                raise VerificationError("this file is no evidence: it has more values than any could have")
            evidence = Evidence.model_validate_json(text)
        except ValidationError as error:
            what = error.errors(include_url=False)[0]
            why = ": ".join(filter(None, (" ".join(map(str, what["loc"])), what["msg"])))
            raise VerificationError(f"this file is no evidence: {shown(why)}") from None
        except UnicodeDecodeError:
            raise VerificationError("this file is no evidence: it is not even text") from None
        if evidence.encode() != text.strip():
            raise VerificationError("this file is not in the one form that evidence has: it was altered")
        return evidence


# Checking


class Statement(NamedTuple):
    """What a file shows. authorities, certificates: fingerprints of the CA's and of the robot's signing ones."""

    robot: str
    chain_id: int
    genesis: str
    contract: str
    authorities: tuple[str, ...]
    certificates: tuple[str, ...]
    records: tuple[ProvenRecord, ...]

    def as_json(self) -> dict[str, Any]:
        return {
            "robot": self.robot, "chain_id": self.chain_id, "genesis": self.genesis, "contract": self.contract,
            "authorities": self.authorities, "certificates": self.certificates,
            "records": [{"line": one.line.decode(), "proof": proof(one)} for one in self.records],
        }  # fmt: skip

    def proves(self, asked: Asked | None = None) -> Iterator[str]:
        """asked: what a node has said of it."""
        sealed = _span(time_text(one.place.sealed_ms * 10**6) for one in self.records)
        yield (
            f"The robot {self.robot} signed {counted(len(self.records), 'record')} as given here, sealed {sealed} by"
            " its own clock. The robot is whoever has the key for which the CA made its certificate."
        )
        yield (
            "It signed them for this contract and chain, each at its place in its log, and no other record can stand"
            " at that place."
        )
        if asked is not None:
            made = _span(time_text(time * 10**9) for time in asked.times.values())
            revoked = "REVOKED" if asked.revoked else "not revoked"
            yield (
                f"The contract {self.contract} on the chain with the id {self.chain_id} has this since block"
                f" {_span(asked.times)} ({made} by the chain's clock), says {asked.node}. It counts"
                f" {counted(asked.chunks, 'chunk')} of this robot, which is {revoked} now."
            )

    def proves_not(self, asked: Asked | None = None) -> Iterator[str]:
        if asked is not None:
            yield f"That {asked.node} is a node of the right chain, and that the chain will not replace these blocks."
        else:
            blocks = _span(one.place.block for one in self.records)
            yield (
                f"That the chain has it, in block {blocks} as the file says: ask a node (--node). If it has not,"
                " somebody could have made this with a stolen key of the robot that is revoked or replaced since."
            )
        yield (
            "That CA, contract and chain are the right ones: compare the CA's fingerprint, the contract's address and"
            f" the hash of the first block, {self.genesis}, with what the operator gave you by another way."
        )
        yield "That there are no other records: who made this file chose these."
        yield "That what the robot measured is so, that its clock was right, or that nobody else had its key."


class Asked(NamedTuple):
    """What a node says of evidence. times: of each block that has its chunks, in seconds since 1970."""

    node: str
    times: dict[int, int]
    chunks: int
    revoked: bool


def verify(evidence: Evidence, roots: Sequence[x509.Certificate], told: Callable[[str], None]) -> Statement:
    """What the evidence shows, if all of it holds under `roots`; else VerificationError. Asks nobody.

    told: is given a line for each check that held. Nothing is shown that no check needed.
    """
    e = evidence
    if e.tk != robot_id(e.robot):
        raise VerificationError(f"the chunks are not of the log of {e.robot}")
    trusted = [root for root in roots if root.to_der() in e.authorities]
    if len(trusted) != len(e.authorities) or not _ascend(e.authorities):
        raise VerificationError(f"the evidence is under another CA, {_fingerprints(e.authorities)}")
    told(f"the CA is the one that was given: {_fingerprints(e.authorities)}")
    fingerprints = [fingerprint_of(one) for one in e.certificates]
    try:
        signers = [signer(one, Trust(trusted), e.robot) for one in e.certificates]
    except VerificationError as error:
        raise VerificationError(f"no certificate of this robot that is to be trusted: {error}") from None
    for fingerprint in fingerprints:
        told(f"the CA made the robot's certificate {grouped(fingerprint)}")
    if not _ascend([one.chunk for one in e.chunks]):
        raise VerificationError("the chunks are not in order")
    headers = {one.chunk: _header(e.log, one, signers) for one in e.chunks}
    if {one.certificate for one in e.chunks} != set(range(len(signers))):
        raise VerificationError("there are certificates of which no chunk is")
    told("the robot signed the chunk of each record")
    records = tuple(_records_of(evidence, headers))
    if {one.place.chunk for one in records} != headers.keys():
        raise VerificationError("there are chunks of which no record is")
    told("each record's path leads to the root of its chunk")
    return Statement(
        e.robot, e.chain_id, "0x" + e.genesis.hex(), "0x" + e.contract.hex(),
        tuple(sm3.digest(one).hex() for one in e.authorities), tuple(fingerprints), records,
    )  # fmt: skip


def _header(log: Log, written: Written, signers: Sequence[tuple[sm2.PublicKey, int, int]]) -> Header:
    """The header of a chunk that the robot signed, sealed before its certificate ended."""
    place = written.chunk - written.first
    if written.certificate >= len(signers) or not 0 <= place < len(written.hashes):
        raise VerificationError(f"chunk {written.chunk} is of no certificate, or of no batch")
    key, _, ends = signers[written.certificate]
    try:
        chunk = Chunk.parse(written.encoded)
        verify_chunk(log, key, chunk)
    except VerificationError as error:
        raise VerificationError(f"chunk {written.chunk}: {shown(str(error))}") from None
    if chunk.header.sealed_ms > ends:
        raise VerificationError(f"chunk {written.chunk} was sealed after the end of the robot's certificate")
    return chunk.header


def _records_of(evidence: Evidence, headers: dict[int, Header]) -> Iterator[ProvenRecord]:
    if not _ascend([(one.chunk, one.record) for one in evidence.records]):
        raise VerificationError("the records are not in order")
    written = {one.chunk: one for one in evidence.chunks}
    for one in evidence.records:
        where = f"record {one.record} of chunk {one.chunk}"
        if one.chunk not in headers:
            raise VerificationError(f"{where}: its chunk is not in the file")
        header, of = headers[one.chunk], written[one.chunk]
        try:
            line = one.line.encode()
            check_proof(header.root, header.records, line, Proof(one.record, one.salt, tuple(one.path)))
            content = parse_line(line)
        except (VerificationError, UnicodeEncodeError) as error:
            raise VerificationError(f"{where}: {shown(str(error), 300)}") from None
        if not isinstance(content, MessageLine):
            raise VerificationError(f"{where}: it is no captured message")
        place = Place(one.chunk, header.stream, header.number, header.digest, of.block, None, of.transaction,
                      header.sealed_ms)  # fmt: skip
        yield ProvenRecord(place, one.record, line, content, None)


def _ascend(values: Sequence[Any]) -> bool:
    return all(a < b for a, b in pairwise(values))


def _fingerprints(certificates: Sequence[bytes]) -> str:
    return ", ".join(grouped(sm3.digest(one).hex()) for one in certificates)


def _span(values: Iterable[Any]) -> str:
    """The least and the greatest, or the one."""
    ascending = sorted({*values})
    return " to ".join(map(str, dict.fromkeys((ascending[0], ascending[-1]))))


def ask(evidence: Evidence, statement: Statement, roots: Sequence[x509.Certificate], url: str) -> Asked:
    """What the contract says of evidence that holds, by the node at `url`. ChainError; VerificationError if it does not
    have a chunk, not in the block and transaction that the file names, or registered another certificate for it."""
    from rosbridge_eth.ledger.contract import Ledger

    with closing(Ledger.connect(url, statement)) as ledger:
        ledger.check()
        log, top = evidence.log, ledger.block()
        [standing] = ledger.standings([log.tk], top.number)
        verifier = Verifier(
            evidence.robot, log.ledger, standing, ledger.registrations(log.tk, standing), trust=Trust(roots),
            reader=None, block=top.number, block_time=ledger.block_time, now=0.0,
        )  # fmt: skip
        if not verifier.honest:
            raise VerificationError(f"{ledger.url} does not show the registrations that the contract has")
        times, batches = dict[int, int](), set[tuple[int, int, bytes]]()
        for one in evidence.chunks:
            verifier.authentic(one.chunk, one.encoded)
            if not ledger.check_data(log.tk, one.first, one.hashes, one.chunk - one.first, one.encoded):
                raise VerificationError(f"the contract does not have chunk {one.chunk}, says {ledger.url}")
            if one.block not in times and one.block <= top.number:
                times[one.block] = min(ledger.block_time(one.block), LAST_MOMENT)
                batches |= {(one.block, event.first, event.transaction)
                            for event in ledger.data_events(log.tk, one.block, one.block)}  # fmt: skip
            if (one.block, one.first, one.transaction) not in batches:
                raise VerificationError(f"chunk {one.chunk} is not in block {one.block}, says {ledger.url}")
        return Asked(ledger.url, times, standing.chunks, standing.revoked)


# Making


def make(reading: Reading, records: Sequence[ProvenRecord]) -> Evidence:
    """The evidence of these records of a log that was read to its end. ChainError if the chain changed meanwhile."""
    if len(records) > MAX_CHOSEN:
        raise ConfigError(f"evidence has at most {MAX_CHOSEN:,} records; choose fewer")
    try:
        evidence = _made(reading, records)
        if len(evidence.encode()) > MAX_FILE - 2**20:  # what a page adds is less
            raise ConfigError(f"this evidence would have more than {MAX_FILE >> 20} MiB; choose fewer records")
        verify(evidence, reading.trust.roots, lambda line: None)
    except VerificationError as error:
        raise ChainError(f"what this node gives makes no evidence: {error}; name another with --node") from error
    return evidence


def _made(reading: Reading, records: Sequence[ProvenRecord]) -> Evidence:
    ledger, log = reading.ledger, reading.verifier.log
    numbers = defaultdict[int, set[int]](set)
    for record in records:
        numbers[record.place.chunk].add(record.number)
    certificates, chunks, shown_records = list[bytes](), list[Written](), list[Record]()
    for event, index, chunk in reading.again(record.place for record in records):
        pair = [one for one in reading.registrations if one.index <= index][-1].certificates
        if pair not in certificates:
            certificates.append(pair)
        chunks.append(Written(
            chunk=index, certificate=certificates.index(pair), encoded=chunk.encoded, first=event.first,
            hashes=[keccak(encoded) for encoded in event.chunks], block=event.block, transaction=event.transaction,
        ))  # fmt: skip
        key = reading.verifier.key_of(chunk.header)
        lines = open_lines(log, chunk, key)
        shown_records += [
            Record(chunk=index, record=one.index, line=lines[one.index].decode(), salt=one.salt, path=list(one.path))
            for one in proofs(lines, key, sorted(numbers[index]))
        ]
    return Evidence(
        robot=reading.verifier.name, tk=log.tk, chain_id=ledger.chain_id, genesis=ledger.genesis,
        contract=bytes.fromhex(ledger.contract[2:]), authorities=sorted(root.to_der() for root in reading.trust.roots),
        certificates=certificates, chunks=chunks, records=shown_records,
    )  # fmt: skip

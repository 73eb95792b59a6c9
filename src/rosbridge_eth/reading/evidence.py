"""Evidence: one file that shows chosen records, and no other, to somebody who has neither a key nor a node.

    record --salt, path--> root in a chunk's header --SM2 signature--> the robot's certificate --> the CA
    chunk ---------------> Data event --receipt's trie--> receiptsRoot in a block's header
    batch, registration -> the contract's storage --state's trie--> stateRoot in the last block's header

The file is JSON in one form only, so that no byte of it can change unnoticed; as a page it is the same JSON within HTML
with the verifier in JavaScript (evidence.js). docs/evidence.md says what each member is and what all of it proves.

Nothing in a file is believed: `read` bounds it and takes it apart, `verify` gives what it shows or says what does not
hold. It takes no key, node or home.
"""

from __future__ import annotations

import hashlib
import json
import re
from base64 import b64encode
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import closing
from dataclasses import replace
from importlib import resources
from itertools import pairwise
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal, NamedTuple

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from rosbridge_eth.capture import MessageLine, parse_line
from rosbridge_eth.chunk import Chunk, Header, Log, Proof, check_proof, ledger_id, open_lines, proofs, robot_id
from rosbridge_eth.config.values import counted, time_text
from rosbridge_eth.errors import ChainError, ConfigError, StoreError, VerificationError
from rosbridge_eth.identity import Trust
from rosbridge_eth.ledger import proofs as chain
from rosbridge_eth.ledger.contract import DataEvent, RegistrationEvent, Standing
from rosbridge_eth.reading.verdict import Governing, grouped, printable, shown
from rosbridge_eth.reading.verify import LAST_MOMENT, ProvenRecord, Verifier
from smcrypto import sm3, x509

if TYPE_CHECKING:
    from rosbridge_eth.reading.fetch import Reading

FORMAT: Final = "rosbridge-eth evidence 1"
MAX_FILE: Final = 64 * 2**20
MAX_CHOSEN: Final = 100_000
MAX_REGISTRATIONS: Final = 1_000
_MAX_STRUCTURE: Final = 4 * 2**20
"""Characters outside of strings. Values take more memory than their text, and each that is wrong still more."""
_BEGIN: Final = '<script type="application/json" id="evidence">'
_END: Final = "</script>"


# The file


Hex32 = Annotated[bytes, Field(min_length=32, max_length=32)]
Count = Annotated[int, Field(ge=0, lt=2**53)]


class _Part(BaseModel):
    # A member too many shows when the file is written anew; pydantic's errors for a million of them fill the memory.
    model_config = ConfigDict(extra="ignore", strict=True, frozen=True, ser_json_bytes="hex", val_json_bytes="hex")


class Record(_Part):
    """A record: which one of the robot's log, the line as the robot wrote it, and its way up to the chunk's root."""

    chunk: Count
    record: Count
    line: str
    salt: Annotated[bytes, Field(min_length=16, max_length=16)]
    path: Annotated[list[Hex32], Field(max_length=10)]


class Block(_Part):
    """A block's hash, its header in RLP, and the indices of its transactions whose receipts are shown."""

    hash: Hex32
    header: bytes
    receipts: Annotated[list[Count], Field(max_length=MAX_CHOSEN)]


class Evidence(_Part):
    """What the file holds. The state is that of the last block. nodes: of all tries, each once."""

    format: Literal["rosbridge-eth evidence 1"] = FORMAT
    robot: Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9_.-]{0,62}$")]
    chain_id: Count
    genesis: Hex32
    contract: Annotated[bytes, Field(min_length=20, max_length=20)]
    authorities: Annotated[list[bytes], Field(min_length=1, max_length=16)]
    records: Annotated[list[Record], Field(min_length=1, max_length=MAX_CHOSEN)]
    blocks: Annotated[list[Block], Field(min_length=1, max_length=MAX_CHOSEN)]
    nodes: Annotated[list[bytes], Field(max_length=10 * MAX_CHOSEN)]

    def encode(self) -> str:
        """The one form: ASCII without spaces, members as above; "<" is escaped, so that no page can end in it."""
        return json.dumps(self.model_dump(mode="json"), separators=(",", ":")).replace("<", "\\u003c")

    def page(self) -> str:
        """The same as an HTML page that checks itself. Its policy forbids every connection and any other script."""
        folder = resources.files(__package__)
        made = (folder / "evidence.html").read_text("utf-8")
        made = made.replace("/* evidence.js */", (folder / "evidence.js").read_text("utf-8"))
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


class ShownRecord(NamedTuple):
    """A record that holds. chunk: its index in the robot's log on the chain."""

    chunk: int
    number: int
    line: bytes
    content: MessageLine
    header: Header
    block: chain.Header

    def as_json(self) -> dict[str, Any]:
        header = self.header
        return {
            "chunk": self.chunk, "record": self.number, "stream": header.stream.hex(), "number": header.number,
            "digest": header.digest.hex(), "sealed": time_text(header.sealed_ms * 10**6),
            "block": self.block.number, "block_time": _time(self.block),
        }  # fmt: skip

    def json_line(self) -> str:
        """As `read` gives it: the robot's own line with `proof`; nothing in it acts on a terminal."""
        proof = json.dumps(self.as_json(), separators=(",", ":"))
        return f'{printable(self.line.decode())[:-1]},"proof":{proof}}}\n'


class Statement(NamedTuple):
    """What a file shows. standing: in the last of the blocks. authorities: fingerprints of the CA's certificates."""

    robot: str
    chain_id: int
    genesis: str
    contract: str
    authorities: tuple[str, ...]
    certificates: tuple[Governing, ...]
    standing: Standing
    blocks: tuple[chain.Header, ...]
    records: tuple[ShownRecord, ...]

    def as_json(self) -> dict[str, Any]:
        at = {"revoked": self.standing.revoked, "chunks": self.standing.chunks, "block": self.blocks[-1].number}
        return {
            "robot": self.robot, "chain_id": self.chain_id, "genesis": self.genesis, "contract": self.contract,
            "authorities": self.authorities, "certificates": [one.as_json() for one in self.certificates], "state": at,
            "blocks": [
                {"number": one.number, "hash": "0x" + one.hash.hex(), "time": _time(one)} for one in self.blocks
            ],
            "records": [{"line": one.line.decode(), "proof": one.as_json()} for one in self.records],
        }  # fmt: skip

    def proves(self) -> Iterator[str]:
        sealed = [one.header.sealed_ms * 10**6 for one in self.records]
        low, high = time_text(min(sealed)), time_text(max(sealed))
        last, standing = self.blocks[-1], self.standing
        yield (
            f"The robot {self.robot} signed {counted(len(self.records), 'record')} as given here, sealed"
            f" {f'at {low}' if low == high else f'between {low} and {high}'} by its own clock. The robot is whoever has"
            " the key for which the CA made its certificate."
        )
        yield (
            f"The contract {self.contract} on the chain with the id {self.chain_id} has this since"
            f" {_blocks(sorted({one.block for one in self.records}))}, if these blocks are the chain's."
        )
        yield (
            f"In block {last.number} ({_time(last)}) the contract counts {counted(standing.chunks, 'chunk')} of this"
            f" robot, which is {'REVOKED' if standing.revoked else 'not revoked'} there."
        )

    def proves_not(self, node: str = "") -> Iterator[str]:
        """node: that has said that the blocks are its chain's."""
        if node:
            yield f"That {node} is a node of the right chain, and that the chain will not replace these blocks."
        else:
            yield (
                "That the blocks are the chain's: ask a node (--node), or compare their hashes with one you trust. If"
                " they are not, somebody could have made this with a stolen key of the robot that is revoked since."
            )
        yield (
            "That CA, contract and chain are the right ones: compare the CA's fingerprint, the contract's address and"
            f" the hash of the first block, {self.genesis}, with what the operator gave you by another way."
        )
        yield "That there are no other records: who made this file chose these."
        yield (
            "That what the robot measured is so, that its clock was right, or that nobody else had its key. Whatever"
            " its clock said, a record was signed before its block was made."
        )


def verify(evidence: Evidence, roots: Sequence[x509.Certificate], told: Callable[[str], None]) -> Statement:
    """What the evidence shows, if all of it holds under `roots`; else VerificationError. Asks nobody.

    told: is given a line for each check that held. Nothing is shown that no check needed.
    """
    e, tk = evidence, robot_id(evidence.robot)
    trusted = [root for root in roots if root.to_der() in e.authorities]
    if len(trusted) != len(e.authorities) or not _ascend(e.authorities):
        raise VerificationError(f"the evidence is under another CA, {_fingerprints(e.authorities)}")
    told(f"the CA is the one that was given: {_fingerprints(e.authorities)}")

    nodes = chain.Nodes(e.nodes)
    headers = tuple(chain.Header.parse(block.header) for block in e.blocks)
    if not _ascend([header.number for header in headers]):
        raise VerificationError("the blocks are not in order")
    if [header.hash for header in headers] != [block.hash for block in e.blocks]:
        raise VerificationError("a block's header does not have its hash")
    events = list(_events(evidence, nodes, headers, tk))
    data = [event for event in events if isinstance(event, DataEvent)]
    registrations = [event for event in events if isinstance(event, RegistrationEvent)]
    if len(registrations) > MAX_REGISTRATIONS:
        raise VerificationError(f"the robot has more than {MAX_REGISTRATIONS:,} registrations and revocations")
    told("the contract's events are in these blocks, by the receipts under their receiptsRoot")

    last = headers[-1]
    state = chain.State(nodes, last, e.contract)
    standing = state.standing(tk)
    for event in data:
        if not state.has(tk, event) or event.first + len(event.chunks) > standing.chunks:
            raise VerificationError(f"the contract does not have the batch that begins with chunk {event.first}")
    told(f"the contract is RobotLedger and has these chunks, by the stateRoot of block {last.number}")
    if not len(e.nodes) == len(nodes) == len(nodes.used):
        raise VerificationError("there are nodes of tries that prove nothing")

    log, times = Log(ledger_id(e.chain_id, e.genesis, e.contract), tk), {one.number: one.time for one in headers}
    verifier = Verifier(
        e.robot, log.ledger, standing, registrations,
        trust=Trust(trusted), reader=None, block=last.number, block_time=times.__getitem__, now=0.0,
    )  # fmt: skip
    if not verifier.honest:
        raise VerificationError("the registrations are not those that the contract has")
    told("the registrations of the robot are all that the contract has")
    certificates = verifier.verdict().certificates
    records = tuple(_records_of(evidence, verifier, data, headers))
    for one in certificates:
        if one.key is not None:
            told(f"the CA made the robot's certificate {grouped(one.fingerprint)}, used from chunk {one.first} on")
    told("the robot signed the chunk of each record, and the record's path leads to the chunk's root")
    return Statement(
        e.robot, e.chain_id, "0x" + e.genesis.hex(), "0x" + e.contract.hex(),
        tuple(sm3.digest(one).hex() for one in e.authorities), certificates, standing, headers, records,
    )  # fmt: skip


def _events(
    evidence: Evidence, nodes: chain.Nodes, headers: Sequence[chain.Header], tk: bytes
) -> Iterator[DataEvent | RegistrationEvent]:
    for block, header in zip(evidence.blocks, headers, strict=True):
        if not _ascend(block.receipts) or not (block.receipts or header is headers[-1]):
            raise VerificationError(f"block {header.number} shows no receipts, or not in order")
        for index in block.receipts:
            receipt = chain.receipt_of(nodes, header, index)
            found = list(chain.events_of(receipt, evidence.contract, tk, header.number))
            if not found:
                raise VerificationError(f"receipt {index} of block {header.number} has no event of {evidence.robot}")
            yield from found


def _records_of(
    evidence: Evidence, verifier: Verifier, data: Sequence[DataEvent], headers: Sequence[chain.Header]
) -> Iterator[ShownRecord]:
    written = {index: (chunk, event.block) for event in data for index, chunk in enumerate(event.chunks, event.first)}
    blocks, signed = {header.number: header for header in headers}, dict[int, Header]()
    if not _ascend([(one.chunk, one.record) for one in evidence.records]):
        raise VerificationError("the records are not in order")
    for one in evidence.records:
        where = f"record {one.record} of chunk {one.chunk}"
        if one.chunk not in written:
            raise VerificationError(f"{where}: no event has this chunk")
        encoded, block = written[one.chunk]
        try:
            if one.chunk not in signed:
                signed[one.chunk] = verifier.authentic(one.chunk, encoded)[0].header
            header, line = signed[one.chunk], one.line.encode()
            check_proof(header.root, header.records, line, Proof(one.record, one.salt, tuple(one.path)))
            content = parse_line(line, header.max_line)
        except (VerificationError, UnicodeEncodeError) as error:
            raise VerificationError(f"{where}: {shown(str(error), 300)}") from None
        if not isinstance(content, MessageLine):
            raise VerificationError(f"{where}: it is no captured message")
        yield ShownRecord(one.chunk, one.record, line, content, header, blocks[block])


def _ascend(values: Sequence[Any]) -> bool:
    return all(a < b for a, b in pairwise(values))


def _fingerprints(certificates: Sequence[bytes]) -> str:
    return ", ".join(grouped(sm3.digest(one).hex()) for one in certificates)


def _blocks(blocks: Sequence[chain.Header]) -> str:
    first, last = blocks[0], blocks[-1]
    if first is last:
        return f"block {first.number} ({_time(first)} by the chain's clock)"
    return f"blocks {first.number} to {last.number} ({_time(first)} to {_time(last)} by the chain's clock)"


def _time(block: chain.Header) -> str:
    return time_text(min(block.time, LAST_MOMENT) * 10**9)


def ask(statement: Statement, url: str) -> None:
    """Return if the blocks are those of the chain, says the node at `url`. ChainError, VerificationError."""
    from rosbridge_eth.ledger.contract import Ledger

    ledger = Ledger.connect(url, statement)
    with closing(ledger):
        ledger.check()
        for block in statement.blocks:
            if ledger.block(block.number).hash != block.hash:
                raise VerificationError(f"{ledger.url} has another block {block.number} than the evidence")


# Making


def make(reading: Reading, records: Sequence[ProvenRecord]) -> Evidence:
    """The evidence of these records of a log that was read to its end, by the state of the block up to there.

    ChainError where the node does not give what it takes; nothing comes out that would not hold.
    """
    if len(records) > MAX_CHOSEN:
        raise ConfigError(f"evidence has at most {MAX_CHOSEN:,} records; choose fewer")
    try:
        evidence = _made(reading, records)
        if len(evidence.encode()) > MAX_FILE - 2**20:  # what a page adds is less
            raise ConfigError(f"this evidence would have more than {MAX_FILE >> 20} MiB; choose fewer records")
        verify(evidence, reading.trust.roots, lambda line: None)
    except (ChainError, VerificationError) as error:
        raise ChainError(f"what this node gives makes no evidence: {error}; name another with --node") from error
    return evidence


def _made(reading: Reading, records: Sequence[ProvenRecord]) -> Evidence:
    ledger, log, top = reading.ledger, reading.verifier.log, reading.top
    contract, authorities = bytes.fromhex(ledger.contract[2:]), sorted(root.to_der() for root in reading.trust.roots)
    [standing] = ledger.standings([log.tk], top.number)
    chunks = {record.place.chunk for record in records}
    numbers = {record.place.block for record in records}
    numbers |= {event.block for event in ledger.registrations(log.tk, standing)}
    blocks, used, data = list[Block](), dict[bytes, bytes](), dict[int, DataEvent]()
    for number in sorted({top.number, *numbers}):
        header, transactions = chain.header_of(ledger, number)
        receipts, nodes = chain.prove_receipts(ledger, header, transactions if number in numbers else ())
        indices = list[int]()
        for index, receipt in enumerate(receipts):
            events = list(chain.events_of(receipt, contract, log.tk, number))
            batches = {one.first: one for one in events if isinstance(one, DataEvent)}
            shows = (not chunks.isdisjoint(range(n, n + len(one.chunks))) for n, one in batches.items())
            if any(shows) or len(batches) < len(events):
                chain.receipt_of(nodes, header, index)
                indices.append(index)
                data |= batches
        used |= nodes.used
        blocks.append(Block(hash=header.hash, header=header.encoded, receipts=indices))
    slots = [*chain.robot_slots(log.tk), *(chain.batch_slot(log.tk, first) for first in data)]
    nodes = chain.prove_state(ledger, header, slots)
    state = chain.State(nodes, header, contract)
    state.standing(log.tk)
    if not all(state.has(log.tk, event) for event in data.values()) or ledger.block(top.number).hash != top.hash:
        raise ChainError("the chain was reorganised meanwhile, so do it again")
    return Evidence(
        robot=reading.verifier.name, chain_id=ledger.chain_id, genesis=ledger.genesis, contract=contract,
        authorities=authorities, records=list(_proven(reading, records, data.values())), blocks=blocks,
        nodes=[*(used | nodes.used).values()],
    )  # fmt: skip


def _proven(reading: Reading, records: Sequence[ProvenRecord], data: Iterable[DataEvent]) -> Iterator[Record]:
    """Each record with its way up to the root: for that its chunk is opened once more, with all its lines."""
    numbers = defaultdict[int, set[int]](set)
    for record in records:
        numbers[record.place.chunk].add(record.number)
    for event in data:
        for index, encoded in enumerate(event.chunks, event.first):
            if index in numbers:
                chunk = Chunk.parse(encoded)
                header = chunk.header
                if chunk.bare and reading.bodies is not None:
                    chunk = replace(chunk, body=reading.bodies(header.body_digest, header.body_length) or b"")
                    if sm3.digest(chunk.body) != header.body_digest:
                        raise StoreError(f"the archive does not have the body of {header} any more")
                key = reading.verifier.key_of(header)
                lines = open_lines(reading.verifier.log, chunk, key)
                for one in proofs(lines, key, sorted(numbers[index])):
                    line = lines[one.index].decode()
                    yield Record(chunk=index, record=one.index, line=line, salt=one.salt, path=list(one.path))

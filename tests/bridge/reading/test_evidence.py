"""Evidence: what a file shows without a node, and that nothing of it is altered unnoticed; in Python and JavaScript."""

from __future__ import annotations

import json
import re
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import rlp
from eth_hash.auto import keccak
from hypothesis import given
from hypothesis import strategies as st
from trie.hexary import HexaryTrie

import geth_network
from bridge.reading.recorded import EVIL, KEYS, ROOTS, Recorded, at, odometry, record
from bridge.reading.world import NAME, START, Pen, authority, message, reader, robot
from conftest import unavailable
from ports import free_port
from rosbridge_eth.capture import parse_line
from rosbridge_eth.chunk import Chunk, content_key
from rosbridge_eth.chunk import proofs as record_proofs
from rosbridge_eth.cli import run
from rosbridge_eth.errors import ChainError, ConfigError, StoreError, VerificationError
from rosbridge_eth.identity import Role, Trust, create_ca, enrol, read_certificates
from rosbridge_eth.ledger import Ledger, proofs
from rosbridge_eth.ledger.contract import DataEvent
from rosbridge_eth.ledger.nodes import Anvil, EmbeddedChain
from rosbridge_eth.reading import Choice, Place, ProvenRecord, read_robot
from rosbridge_eth.reading import evidence as evidence_of
from rosbridge_eth.reading.evidence import MAX_FILE, Evidence, Statement, ask, make, verify
from smcrypto import sm3
from vectors_json import load

VECTORS = Path(__file__).resolve().parents[2] / "vectors" / "evidence"
JAVASCRIPT = Path(proofs.__file__).parents[1] / "reading" / "evidence.js"


def start(*options: str) -> Anvil:
    try:
        return Anvil.start(free_port(), options=options)
    except ChainError as error:
        unavailable(str(error))
        raise


@pytest.fixture(scope="module")
def node(require: Callable[[str], str]) -> Iterator[Anvil]:
    require("npx")
    with start() as running:
        yield running


@pytest.fixture(scope="module")
def recorded(node: Anvil) -> Recorded:
    return record(node)


@pytest.fixture(scope="module")
def one(recorded: Recorded) -> str:
    """The file of one record."""
    return recorded.evidence(Choice("/robot_1/odom", at_ns=at(5))).encode()


@pytest.fixture(scope="module")
def span(recorded: Recorded) -> str:
    """The file of six records in three chunks, under both certificates."""
    made = recorded.evidence(Choice("/robot_1/odom", from_ns=at(13.8))).encode()
    assert made.count('"chunk":') == 5
    return made


def check(text: str, roots: Any = ROOTS) -> Statement:
    return verify(Evidence.read(text.encode()), roots, lambda line: None)


@pytest.fixture
def javascript(require: Callable[[str], str]) -> Callable[[list[str]], list[Any]]:
    """What evidence.js makes of each text: what it shows, or why it does not hold."""
    node = require("node")
    program = f"""
const evidence = require({str(JAVASCRIPT)!r})
const plain = (key, value) => (typeof value === 'bigint' ? String(value) : value)
const answers = JSON.parse(require('fs').readFileSync(0, 'utf8')).map((text) => {{
  try {{
    const {{ robot, contract, genesis, chain, state, authorities, records, blocks }} = evidence.verify(text, () => {{}})
    const lines = records.map((one) => [one.chunk, one.record, one.line, one.sealed, one.block.number])
    return {{ robot, contract, genesis, chain, state, authorities, lines, blocks: blocks.map((one) => one.hash) }}
  }} catch (error) {{
    if (!(error instanceof evidence.Wrong)) throw error
    return error.message
  }}
}})
process.stdout.write(JSON.stringify(answers, plain))
"""

    def run(texts: list[str]) -> list[Any]:
        done = subprocess.run([node, "-e", program], input=json.dumps(texts).encode(), capture_output=True, timeout=120)
        assert done.returncode == 0, done.stderr.decode()
        answers: list[Any] = json.loads(done.stdout)
        return answers

    return run


def both(text: str, javascript: Callable[[list[str]], list[Any]]) -> Statement:
    """What both say of a file that holds: the same."""
    found, [there] = check(text), javascript([text])
    assert there == {
        "robot": found.robot, "contract": found.contract, "genesis": found.genesis, "chain": found.chain_id,
        "state": {"revoked": found.standing.revoked, "chunks": found.standing.chunks},
        "authorities": list(found.authorities), "blocks": [block.hash.hex() for block in found.blocks],
        "lines": [
            [each.chunk, each.number, each.line.decode(), each.header.sealed_ms, each.block.number]
            for each in found.records
        ],
    }  # fmt: skip
    return found


pytestmark = pytest.mark.service


# ---------------------------------------------------------------------- what it shows


def test_the_chosen_record_and_no_other_is_shown(recorded: Recorded, one: str, javascript):
    found = both(one, javascript)
    assert [each.line for each in found.records] == [odometry(50)]
    assert found.records[0].as_json() | {"block": 0, "block_time": "", "sealed": "", "digest": ""} == {
        "chunk": 2, "record": 10, "stream": b"a".hex() * 16, "number": 2, "block": 0, "block_time": "", "sealed": "",
        "digest": "",
    }  # fmt: skip
    assert (found.robot, found.contract, found.chain_id) == (NAME, recorded.ledger.contract.lower(), 31337)
    assert (found.standing.chunks, found.standing.revoked) == (10, False)
    assert [each.fingerprint for each in found.certificates] == [
        sm3.digest(identity.signing_certificate.to_der()).hex() for identity in (robot(), robot(1))
    ]
    for text in ("not shown", "/secret", "robot_2", odometry(49).decode()):
        assert text not in one
    data = next(iter(recorded.ledger.data_events(recorded.pen.log.tk, 0, recorded.ledger.block_number())))
    keys = [content_key(Chunk.parse(chunk).header, reader().encryption_key) for chunk in data.chunks]
    assert not any(key.hex() in one for key in keys)


def test_a_span_goes_over_chunks_blocks_and_certificates(span: str, javascript):
    found = both(span, javascript)
    assert [each.line for each in found.records] == [odometry(n) for n in (138, 139, 140, 150, 151)]
    assert [each.chunk for each in found.records] == [6, 6, 7, 8, 9]


def test_the_vector_holds(javascript):
    """Made by an earlier version: what was given to somebody once can be checked for good."""
    text = (VECTORS / "span.json").read_text()
    roots = read_certificates((VECTORS / "ca.crt.pem").read_bytes())
    found, [there] = check(text, roots), javascript([text])
    assert [each.line.decode() for each in found.records] == [line for _, _, line, _, _ in there["lines"]]
    assert [each.line for each in found.records] == [odometry(n) for n in (138, 139, 140, 150, 151)]


def test_a_moment_is_the_last_record_of_each_topic(recorded: Recorded, javascript):
    found = both(recorded.evidence(Choice(at_ns=at(14))).encode(), javascript)
    assert sorted(each.content.topic for each in found.records) == ["/evil", "/robot_1/odom", "/secret"]
    [evil] = [each for each in found.records if each.content.topic == "/evil"]
    assert evil.content.data["text"] == EVIL
    shown = evil.json_line()
    assert "\u202e" not in shown and json.loads(shown)["data"] == evil.content.data


def test_as_json_nothing_of_it_acts_on_a_terminal(recorded: Recorded, tmp_path: Path, capsys):
    (tmp_path / "evil.json").write_text(recorded.evidence(Choice("/evil")).encode())
    assert run(["verify", str(tmp_path / "evil.json"), "--ca", str(write_ca(tmp_path)), "--json"]) == 0
    said = capsys.readouterr().out
    assert said[:-1].isprintable() and said.isascii()
    assert json.loads(json.loads(said)["records"][0]["line"])["data"]["text"] == EVIL


def write_ca(folder: Path) -> Path:
    (folder / "ca.pem").write_bytes(ROOTS[0].to_pem())
    return folder / "ca.pem"


def test_what_it_proves_and_what_not_is_said_in_words(one: str, span: str):
    found = check(one)
    said = " ".join(found.proves())
    assert "robot_1 signed 1 record as given here" in said and f"block {found.records[0].block.number} " in said
    assert "not revoked" in said and "if these blocks are the chain's" in said
    assert "between" in " ".join(check(span).proves())
    limits = " ".join(found.proves_not())
    assert "no other records" in limits and "its clock was right" in limits and "--node" in limits
    assert "--node" not in " ".join(found.proves_not("http://node")) and found.genesis in limits


@pytest.mark.parametrize("fork", ["berlin", "shanghai"])
def test_headers_of_older_forks_have_fewer_fields(fork: str, require, javascript):
    require("npx")
    with start("--hardfork", fork) as node:
        made = Recorded(Ledger.deploy(node.url, KEYS.operator)[0])
        made.write(made.pen.write(odometry(1)))
        evidence = made.evidence(Choice("/robot_1/odom"))
        assert len(proofs.items(evidence.blocks[-1].header)) == {"berlin": 15, "shanghai": 17}[fork]
        both(evidence.encode(), javascript)


def test_on_a_network_with_proof_of_authority(tmp_path: Path, javascript):
    rich = {key.address: 10**21 for key in (KEYS.operator, KEYS.robot(1))}
    try:
        chain = geth_network.Network(tmp_path, rich, nodes=1, period=1)
    except geth_network.Unavailable as reason:
        unavailable(str(reason))
    with chain:
        made = Recorded(Ledger.deploy(chain.nodes[0].url, KEYS.operator)[0])
        made.write(made.pen.write(odometry(1), odometry(2)))
        text = made.evidence(Choice("/robot_1/odom", at_ns=at(0.1))).encode()
        ask(both(text, javascript), chain.nodes[0].url)


def test_a_record_whose_body_is_in_an_archive(node: Anvil, javascript):
    made = Recorded(Ledger.deploy(node.url, KEYS.operator)[0])
    chunk = made.pen.write(odometry(1), message(at(1), "/image", data="iVBOR" * 600_000), archived=True)
    made.write(on_chain=[replace(chunk, body=b"").encoded])
    bodies = {chunk.header.body_digest: chunk.body}
    text = made.evidence(Choice("/image"), bodies=lambda digest, size: bodies.get(digest)).encode()
    [shown] = both(text, javascript).records
    assert shown.content.data["data"] == "iVBOR" * 600_000
    assert len(text) < 3_000_000 + 20_000
    with pytest.raises(StoreError, match="archive"):  # which has lost it by the time it is fetched once more
        made.evidence(Choice("/image"), bodies=lambda digest, size: bodies.pop(digest, None))


def test_a_body_that_was_cut_off_makes_no_dropped_or_archived_chunk(node: Anvil, javascript, monkeypatch):
    """Whoever has the robot's account, the server, can write a header without the body that belongs to it."""
    made = Recorded(Ledger.deploy(node.url, KEYS.operator)[0])
    chunk = made.pen.write(odometry(1), odometry(2))
    made.write(on_chain=[replace(chunk, body=b"").encoded])
    reading = read_robot(
        [made.ledger], NAME, trust=Trust(ROOTS), reader=reader().encryption_key, now=time.time(),
        bodies=lambda digest, size: chunk.body,
    )  # fmt: skip
    assert list(reading.records()) == [] and reading.verdict().counts == {"forged": 1}
    [standing] = made.ledger.standings([made.pen.log.tk])
    place, content = Place(0, b"", 0, b"", standing.data_block, 0, b""), parse_line(odometry(1))
    monkeypatch.setattr(evidence_of, "verify", lambda *_: None)
    text = make(reading, [ProvenRecord(place, 0, odometry(1), content, None)]).encode()  # type: ignore[arg-type]
    with pytest.raises(VerificationError, match="forged: not signed by the robot"):
        check(text)
    assert "did not sign" in javascript([text])[0]


def test_by_somebody_to_whom_the_keys_were_handed(node: Anvil, javascript):
    made = Recorded(Ledger.deploy(node.url, KEYS.operator)[0])
    made.pen.readers = [reader("insurer")]
    chunk = made.pen.write(odometry(1), odometry(2))
    made.write(chunk)
    keys = {chunk.header.digest: content_key(chunk.header, reader("insurer").encryption_key)}
    text = made.evidence(Choice("/robot_1/odom", at_ns=at(0.1)), granted=keys).encode()
    assert [each.line for each in both(text, javascript).records] == [odometry(1)]


def test_a_revoked_robot_is_said_to_be(node: Anvil, javascript):
    made = Recorded(Ledger.deploy(node.url, KEYS.operator)[0])
    made.write(made.pen.write(odometry(1)))
    made.ledger.revoke_robot(KEYS.operator, made.pen.log.tk)
    found = both(made.evidence(Choice("/robot_1/odom")).encode(), javascript)
    assert found.standing.revoked and "REVOKED" in " ".join(found.proves())


# ---------------------------------------------------------------------- nothing can be altered


def altered(value: Any) -> Iterator[tuple[str, Any]]:
    """Every leaf, list and member changed in a few ways, one at a time; a path for each."""
    if isinstance(value, dict):
        for name, inner in value.items():
            for where, other in altered(inner):
                yield f".{name}{where}", value | {name: other}
            yield f"-{name}", {key: inner for key, inner in value.items() if key != name}
        yield "+more", value | {"more": 1}
        yield " reversed", dict(reversed(value.items()))
    elif isinstance(value, list):
        for n, inner in enumerate(value):
            for where, other in altered(inner):
                yield f"[{n}]{where}", [*value[:n], other, *value[n + 1 :]]
            yield f"-[{n}]", value[:n] + value[n + 1 :]
            yield f"+[{n}]", [*value[: n + 1], *value[n:]]
        if value:
            yield " emptied", []
    elif isinstance(value, str):
        end = len(value)
        for n in sorted({0, end // 3, end - 1} & set(range(end))):
            yield f"@{n}", value[:n] + ("1" if value[n] != "1" else "2") + value[n + 1 :]
        yield " shorter", value[:-2]
        yield " longer", value + "00"
        yield " to a number", 1
        if value.upper() != value:
            yield " in capitals", value.upper()
    else:
        yield from ((" + 1", value + 1), (" - 1", value - 1), (" as text", str(value)), (" as a double", value + 0.5))
        yield " to null", None


def test_every_leaf_member_and_list_that_is_altered_is_found(span: str, javascript):
    value = json.loads(span)
    texts = {where: json.dumps(other, separators=(",", ":")).replace("<", "\\u003c") for where, other in altered(value)}
    # Another choice of the robot's records is another file, and as good: it says so much less.
    fewer = {where for where in texts if where.startswith(".records-[")}
    assert len(fewer) == 5 and len(texts) > 500
    held = set()
    for where, text in texts.items():
        try:
            assert len(check(text).records) == 4, where
            held.add(where)
        except VerificationError:
            pass
    assert held == fewer
    some = sorted({*list(texts)[::8], *fewer})
    answers = dict(zip(some, javascript([texts[where] for where in some]), strict=True))
    assert {where for where, answer in answers.items() if not isinstance(answer, str)} == held


def test_the_file_has_one_form(one: str, javascript):
    first, rest = one[: one.index(',"robot"')], one[one.index(',"robot"') :]
    forms = [
        one.replace(",", ", ", 1), one.replace('"format"', '"f\\u006frmat"', 1),
        first + rest.replace('"robot_1"', '"robot\\u005f1"'), first + ',"robot":"robot_2"' + rest,
        one.replace('"chain_id":31337', '"chain_id":31337.0'), one.replace('"chain_id":31337', '"chain_id":3.1337e4'),
        one[:-1], one + "x", one + one,
    ]  # fmt: skip
    for text in forms:
        with pytest.raises(VerificationError):
            check(text)
    assert all(isinstance(answer, str) for answer in javascript(forms))
    assert check(f"\n{one}\r\n") == check(one)


def test_a_record_is_shown_by_nothing_but_its_own_proof(one: str, javascript):
    """The attacks of somebody who knows the format: parts of good evidence put together otherwise."""
    value = json.loads(one)

    def with_record(**changes: Any) -> str:
        return json.dumps(value | {"records": [value["records"][0] | changes]}, separators=(",", ":"))

    line = value["records"][0]["line"]
    texts = {
        "another line": with_record(line=line.replace('"z":0.0', '"z":1.0')),
        "another salt": with_record(salt="00" * 16),
        "a node of the tree as a record": with_record(path=value["records"][0]["path"][1:]),
        "another place": with_record(record=11),
        "another chunk": with_record(chunk=3),
        "swapped robot": json.dumps(value | {"robot": "robot_2"}, separators=(",", ":")),
        "swapped contract": json.dumps(value | {"contract": "11" * 20}, separators=(",", ":")),
        "swapped chain": json.dumps(value | {"chain_id": 1}, separators=(",", ":")),
        "no state": json.dumps(value | {"blocks": value["blocks"][:-1]}, separators=(",", ":")),
        "no registration": json.dumps(value | {"blocks": value["blocks"][1:]}, separators=(",", ":")),
        "no receipt": json.dumps(value | {"blocks": [{**each, "receipts": []} for each in value["blocks"]]},
                                 separators=(",", ":")),
        "a node more": json.dumps(value | {"nodes": [*value["nodes"], "c0"]}, separators=(",", ":")),
    }  # fmt: skip
    for what, text in texts.items():
        with pytest.raises(VerificationError):
            check(text)
            pytest.fail(what)
    assert all(isinstance(answer, str) for answer in javascript(list(texts.values())))


def with_hashes(text: str) -> str:
    """The file with the hashes that its headers have."""
    value = json.loads(text)
    for block in value["blocks"]:
        block["hash"] = keccak(bytes.fromhex(block["header"])).hex()
    return json.dumps(value, separators=(",", ":")).replace("<", "\\u003c")


def rehung(text: str, old: str, new: str) -> str:
    """The file with something else in a receipt, and every hash above it made anew: the block is another one then."""
    value = json.loads(text)
    nodes = value["nodes"]
    [n] = [n for n, node in enumerate(nodes) if old in node]
    assert len(old) == len(new)
    before = keccak(bytes.fromhex(nodes[n])).hex()
    nodes[n] = nodes[n].replace(old, new)
    after = keccak(bytes.fromhex(nodes[n])).hex()
    hung = json.dumps(value, separators=(",", ":"))
    if before not in hung:
        return hung
    [k] = [k for k, node in enumerate(nodes) if before in node] or [None]
    if k is not None:
        return rehung(hung, before, after)
    return with_hashes(hung.replace(before, after))


def test_an_invented_block_does_not_make_a_signature_or_a_storage(one: str, javascript):
    """Offline nobody can know the chain's blocks; what hangs below them still has to fit, and to be signed."""
    header = check(one).records[0].header
    texts = [rehung(one, header.root.hex(), sm3.digest(b"another root").hex()),
             rehung(one, header.stream.hex() + "0" * 15, "00" * 23 + "0")]
    for text in texts:
        assert text != one
        with pytest.raises(VerificationError, match="does not have the batch"):
            check(text)
    assert all("does not have the batch" in answer for answer in javascript(texts))


def test_a_block_with_another_hash_is_told_by_the_node_alone(one: str, node: Anvil, javascript):
    """The limit of what can be known offline: who alters a header and its hash alike shows another block."""
    value = json.loads(one)
    _, *fields = proofs.items(bytes.fromhex(value["blocks"][-1]["header"]))
    value["blocks"][-1]["header"] = rlp.encode([bytes(32), *fields]).hex()
    found = both(with_hashes(json.dumps(value)), javascript)
    assert found.blocks[-1].hash != check(one).blocks[-1].hash
    with pytest.raises(VerificationError, match="another block"):
        ask(found, node.url)


def test_another_ca_is_told(one: str, recorded: Recorded):
    with pytest.raises(VerificationError, match="another CA"):
        check(one, [create_ca("Another", at=START).certificate])
    check(one, [create_ca("Another", at=START).certificate, *ROOTS])


OTHER_CA = create_ca("Test CA", at=START)  # the same subject, another key


@pytest.mark.parametrize(("ca", "role", "name"), [
    (OTHER_CA, Role.ROBOT, NAME), (authority(), Role.ROBOT, "robot_3"), (authority(), Role.READER, NAME),
])  # fmt: skip
def test_who_is_not_the_robot_by_the_ca_is_refused(ca, role, name, node: Anvil, javascript, monkeypatch):
    """On the chain all is well: the operator registered these certificates, and their holder wrote."""
    with monkeypatch.context() as patch:
        checks = Trust.check
        patch.setattr(Trust, "check", lambda self, *pair, at, **_: checks(self, *pair, role=tuple(Role), at=at))
        made = Recorded(Ledger.deploy(node.url, KEYS.operator)[0], Pen(identity=enrol(ca, role, name, at=START)))
        made.write(made.pen.write(odometry(1)))
        evidence = made.evidence(Choice("/robot_1/odom"), [ca.certificate])
    text = evidence.model_copy(update={"authorities": [ROOTS[0].to_der()]}).encode()
    with pytest.raises(VerificationError, match="no certificate of this robot that is to be trusted governs this"):
        check(text)
    [answer] = javascript([text])
    assert "no certificate governs it" in answer


def test_certificates_that_are_none_hide_none_that_follow(node: Anvil, javascript):
    """The contract takes whatever the operator registers: here the beginning of a certificate, of nothing."""
    made = Recorded(Ledger.deploy(node.url, KEYS.operator)[0])
    nothing = bytes.fromhex("3011" "300aa0030201020201013000" "3000" "030100") * 2
    for account, certificates in ((KEYS.robot(3), nothing), (KEYS.robot(1), robot().public.certificates)):
        made.ledger.replace_registration(KEYS.operator, made.pen.log.tk, account.address, certificates)
    made.write(made.pen.write(odometry(1)))
    found = both(made.evidence(Choice("/robot_1/odom")).encode(), javascript)
    assert [one.key is None for one in found.certificates] == [False, True, False]


def test_more_of_the_cas_than_a_file_may_have_is_refused_in_both_languages(javascript):
    value = json.loads((VECTORS / "span.json").read_text())
    more = [create_ca(f"CA {n}", at=START).certificate for n in range(16)]
    value["authorities"] = sorted([*value["authorities"], *(one.to_der().hex() for one in more)])
    text = json.dumps(value, separators=(",", ":"))
    with pytest.raises(VerificationError, match="at most 16"):
        check(text, [*read_certificates((VECTORS / "ca.crt.pem").read_bytes()), *more])
    assert "too much" in javascript([text])[0]


def test_a_page_that_this_version_did_not_write_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    page, file = Evidence.read((VECTORS / "span.json").read_bytes()).page(), tmp_path / "page.html"
    for text, told in ((page, False), (page.replace("The record", "The only record"), True)):
        file.write_text(text, encoding="utf-8")
        assert run(["verify", str(file), "--ca", str(VECTORS / "ca.crt.pem")]) == 0
        said = capsys.readouterr()
        assert ("The page around it is not as this version writes it" in said.err) == told
        assert len(said.out.splitlines()) == 5 and "What it does not prove:" in said.err


# ---------------------------------------------------------------------- files from anybody


@pytest.mark.parametrize("data", [
    b"", b"{}", b"[]", b"null", b"[" * 200_000, b'{"a":' * 100_000, b"\xff\xfe", b"<html></html>", b'"' * 9,
    b"1" * 5_000, b'{"format":"rosbridge-eth evidence 2"}',
    b'<script type="application/json" id="evidence">{}</script>', b"0" * (MAX_FILE + 1), b'{"format":"\\ud800"}',
], ids=range(14))  # fmt: skip
def test_what_is_no_evidence_is_told_in_a_sentence(data: bytes):
    with pytest.raises(VerificationError) as told:
        Evidence.read(data)
    assert len(str(told.value)) < 400 and str(told.value).isprintable()


@given(st.binary(max_size=200))
def test_rlp_is_taken_apart_or_refused(data: bytes):
    try:
        parts = proofs.items(data)
    except VerificationError:
        return
    assert rlp.encode([rlp.decode(part) if isinstance(part, proofs.RlpList) else part for part in parts]) == data


@given(st.lists(st.recursive(st.binary(max_size=70), lambda inner: st.lists(inner, max_size=6), max_leaves=12)))
def test_what_rlp_encodes_is_taken_apart(value: Any):
    def whole(encoded: bytes) -> Any:
        return [whole(part) if isinstance(part, proofs.RlpList) else part for part in proofs.items(encoded)]

    assert whole(rlp.encode(value)) == value


@given(st.binary(max_size=400), st.booleans())
def test_any_receipt_ends_in_events_or_a_sentence(data: bytes, framed: bool):
    address, tk = bytes(20), bytes(32)
    kind = keccak(b"Data(bytes32,uint256,address,uint256,bytes[])")
    receipt = rlp.encode([1, 1, bytes(256), [[address, [kind, tk, bytes(32), bytes(32)], data]]]) if framed else data
    with suppress(VerificationError):
        assert all(sum(map(len, event.chunks)) <= len(data) for event in proofs.events_of(receipt, address, tk, 1))


def test_a_bomb_of_overlapping_chunks_is_refused():
    """An ABI allows many items of an array to be one and the same; Solidity does not write that."""
    count, big = 2_000, bytes(60_000)
    words = [0, 64, count, *[32 * count] * count, len(big)]
    data = b"".join(word.to_bytes(32) for word in words) + big
    kind = keccak(b"Data(bytes32,uint256,address,uint256,bytes[])")
    receipt = rlp.encode([1, 1, bytes(256), [[bytes(20), [kind, bytes(32), bytes(32), bytes(32)], data]]])
    with pytest.raises(VerificationError, match="not as Solidity writes it"):
        list(proofs.events_of(receipt, bytes(20), bytes(32), 1))


def test_a_large_leaf_is_read_once(one: str, javascript):
    """Else many invented headers could have one receipt of megabytes read again and again."""
    value = json.loads(one)
    block = value["blocks"][0]

    def numbered(header: str, number: int) -> dict[str, str]:
        fields = proofs.items(bytes.fromhex(header))
        return {"header": rlp.encode([*fields[:8], number.to_bytes(2, "big"), *fields[9:]]).hex()}

    value["blocks"][-1] |= numbered(value["blocks"][-1]["header"], 60_000)
    value["blocks"].insert(-1, block | numbered(block["header"], 50_000))
    text = with_hashes(json.dumps(value))
    with pytest.raises(VerificationError, match="leaf of another"):
        check(text)
    assert "leaf of another" in javascript([text])[0]


def invented(
    receipt: Callable[[list[Any]], Any] = list,
    state: Callable[[bytes], bytes] = bytes,
    slot: Callable[[int, int], int] = lambda n, value: value,
) -> str:
    """The vector on blocks of one's own: every receipt as `receipt` makes it, `state` above the state's root, the tail
    as `slot` makes it, and all tries, headers and hashes made anew. Who has no key of the robot can go so far.
    """
    e = Evidence.read((VECTORS / "span.json").read_bytes())
    old, last, tk = proofs.Nodes(e.nodes), proofs.Header.parse(e.blocks[-1].header), keccak(NAME.encode())
    storage, slots = proofs.State(old, last, e.contract), proofs.robot_slots(tk)
    tries, blocks = dict[bytes, bytes](), []

    def trie(values: dict[bytes, bytes]) -> tuple[bytes, dict[bytes, bytes]]:
        made = HexaryTrie({}, prune=True)
        for key, value in values.items():
            made[key] = value
        return made.root_hash, made.db

    for block in e.blocks:
        header, *fields = proofs.Header.parse(block.header), *map(bytes, proofs.items(block.header))
        receipts = {index: proofs.receipt_of(old, header, index) for index in block.receipts}
        for value in receipts.values():
            events = proofs.events_of(value, e.contract, tk, header.number)
            slots += [proofs.batch_slot(tk, one.first) for one in events if isinstance(one, DataEvent)]
        changed = {rlp.encode(n): one[:1] + rlp.encode(receipt(rlp.decode(one[1:]))) for n, one in receipts.items()}
        fields[5], made = trie(changed)
        tries |= made
        if header == last:
            words = {keccak(n.to_bytes(32)): rlp.encode(slot(n == slots[1], storage[n])) for n in set(slots)}
            (root, made), code = trie(words), proofs.code_hash()
            account = keccak(rlp.encode([b"\x20" + keccak(e.contract), rlp.encode([b"", b"", root, code])]))
            tries |= made | {account: rlp.encode([b"\x20" + keccak(e.contract), rlp.encode([b"", b"", root, code])])}
            above = state(account)
            fields[3] = keccak(above) if above != account else account
            tries |= {keccak(above): above} if above != account else {}
        encoded = rlp.encode(fields)
        blocks.append(block.model_copy(update={"header": encoded, "hash": keccak(encoded)}))
    tries.pop(keccak(b"\x80"), None)
    return e.model_copy(update={"blocks": blocks, "nodes": [*tries.values()]}).encode()


def with_log(n: int, part: Any) -> Callable[[list[Any]], Any]:
    """The receipt with another n-th part of its first log: address, topics, data."""
    return lambda fields: [*fields[:3], [[*fields[3][0][:n], part(fields[3][0][n]), *fields[3][0][n + 1 :]]]]


def in_other_bytes(data: bytes) -> bytes:
    """The first registration, a bit of the CA's signature said to be unused: another certificate, signed alike."""
    found = re.search(rb"\x03[\x46-\x4a]\x00\x30", data)
    if data[32:96] != bytes(63) + b"\x60" or not found:  # no registration, or one that follows another
        return data
    return data[: found.start() + 2] + b"\1" + data[found.start() + 3 :]


INVENTED = {
    "logs as a string": lambda: invented(lambda fields: [*fields[:3], rlp.encode(fields[3])]),
    "a topic of 33 bytes": lambda: invented(with_log(1, lambda topics: [*topics[:2], b"\1" + topics[2], *topics[3:]])),
    "another place of the array": lambda: invented(
        with_log(2, lambda data: data[:63] + bytes([data[63] ^ 32 * (data[32:64] == (64).to_bytes(32))]) + data[64:])
    ),
    "events of what failed": lambda: invented(lambda fields: [b"", *fields[1:]]),
    "a signature in other bytes": lambda: invented(with_log(2, in_other_bytes)),
    "a receipt of five fields": lambda: invented(lambda fields: [*fields, b""]),
    "a slot of 33 bytes": lambda: invented(slot=lambda n, value: value | n << 256),
    "an extension without nibbles": lambda: invented(state=lambda account: rlp.encode([b"\0", account])),
}  # fmt: skip


@pytest.mark.parametrize("what", INVENTED)
def test_what_no_chain_would_write_is_refused_in_both_languages(what: str, javascript):
    roots = read_certificates((VECTORS / "ca.crt.pem").read_bytes())
    assert len(check(invented(), roots).records) == 5
    with pytest.raises(VerificationError):
        check(INVENTED[what](), roots)
    good, bad = javascript([invented(), INVENTED[what]()])
    assert len(good["lines"]) == 5 and isinstance(bad, str)


def test_more_registrations_than_anybody_checks_are_refused(javascript):
    """Each costs two signatures of the CA: 25,000 in a file would take a browser ten minutes."""
    registered = keccak(b"Registered(bytes32,address,uint256,uint256,bytes)")
    text = invented(lambda fields: [*fields[:3], fields[3] * (1_001 if fields[3][0][1][0] == registered else 1)])
    with pytest.raises(VerificationError, match="more than 1,000 registrations"):
        check(text, read_certificates((VECTORS / "ca.crt.pem").read_bytes()))
    assert "more than 1,000 registrations" in javascript([text])[0]


def test_a_proof_takes_no_more_steps_than_its_key_has_nibbles():
    """Else a node of megabytes that holds itself a million times, or a leaf for all keys, keeps a verifier for days."""
    leaf = rlp.encode([b"\x20", b"value"])
    embedded: Any = [b"\x20", b"value"]
    for _ in range(200):
        embedded = [b"\0", embedded]
    branch = rlp.encode([*[keccak(leaf)] * 16, b""])
    for nodes, keys in (
        ([leaf, rlp.encode([b"\0", keccak(leaf)])], [b""]), ([rlp.encode(embedded)], [b""]),
        ([rlp.encode([b"\x2f", b"value"])], [b""]), ([rlp.encode([b"\x20", [b"value"]])], [b""]),
        ([leaf, branch, rlp.encode([b"\x16", keccak(branch)])], [b"\x61", b"\x62"]),
        ([leaf, rlp.encode([*[keccak(leaf)] * 16, bytes(600)]), rlp.encode([b"\x16", keccak(branch)])], [b"\x61"]),
        ([rlp.encode([b""] * 18)], [b""]),
    ):  # fmt: skip
        trie = proofs.Nodes(nodes)
        with pytest.raises(VerificationError):
            for key in keys:
                assert trie.value(keccak(nodes[-1]), key, "what is proven") == b"value"
    assert proofs.Nodes([leaf]).value(keccak(leaf), b"", "what is proven") == b"value"


GOOD_LINE = odometry(1)
LINES = {
    "a name twice": GOOD_LINE.replace(b'"data":{', b'"data":{"pose":1,'), "half a character": message(1, text="?"),
    "beyond a double": GOOD_LINE.replace(b'"z":0.0', b'"z":1e400'),
    "a zero before a number": GOOD_LINE.replace(b'"z":0.0', b'"z":00000000000000001'),
    "a zero before a time": GOOD_LINE.replace(b'"received_ns":', b'"received_ns":0'),
    "a time below zero": GOOD_LINE.replace(b'"received_ns":', b'"received_ns":-'),
    "a space": GOOD_LINE.replace(b'"z":', b'"z": '), "an escape too many": GOOD_LINE.replace(b'"z"', b'"\\u007a"'),
    "a time as text": re.sub(rb'"received_ns":(\d+)', rb'"received_ns":"\1"', GOOD_LINE),
    "too deep": message(1, a=0).replace(b'"a":0', b'"a":' + b"[" * 99 + b"]" * 99),
    "no object": re.sub(rb'"data":.*', b'"data":[]}', GOOD_LINE),
    "too long": message(1, text="x" * 61_440),
}  # fmt: skip


def test_lines_that_only_a_lying_robot_writes_are_refused_in_both_languages(node: Anvil, javascript):
    made = Recorded(Ledger.deploy(node.url, KEYS.operator)[0])
    LINES["half a character"] = LINES["half a character"].replace(b"?", b"\\ud800")
    minus_zero = re.sub(rb'"captured_ns":\d+', b'"captured_ns":-0', GOOD_LINE)  # an integer of JSON, and none below 0
    lines = [message(at(0.1), text="\ufffd"), minus_zero, *LINES.values()]
    chunk = made.pen.write(*lines)
    made.write(chunk)
    text = made.evidence(Choice(to_ns=at(0.2))).encode()
    assert len(both(text, javascript).records) == 2
    key, texts = content_key(chunk.header, reader().encryption_key), [text.replace("\\ufffd", "\\ud800")]
    for n in range(2, len(lines)):
        proof, value = next(record_proofs(lines, key, [n])), json.loads(text)
        path = [each.hex() for each in proof.path]
        shown = {"chunk": 0, "record": n, "line": lines[n].decode(), "salt": proof.salt.hex(), "path": path}
        value["records"] = [shown]
        texts.append(json.dumps(value, separators=(",", ":")))
    answers = javascript(texts)
    for what, one_text, answer in zip(["half a character in the file", *LINES], texts, answers, strict=True):
        with pytest.raises(VerificationError):
            check(one_text)
            pytest.fail(what)
        assert isinstance(answer, str), what


@pytest.mark.parametrize("values", [b"0," * 3_000_000, b"[]," * 2_000_000, b'"",' * 5_000_000, b'"' * 9_000_000])
def test_values_that_would_fill_the_memory_are_counted_before_they_are_made(values: bytes):
    with pytest.raises(VerificationError, match="more values than any could have"):
        Evidence.read(b'{"format":"rosbridge-eth evidence 1","nodes":[' + values + b"0]}")


# ---------------------------------------------------------------------- the node


def test_the_chain_is_asked_whether_the_blocks_are_its_own(one: str, recorded: Recorded, node: Anvil, require):
    found = check(one)
    ask(found, node.url)
    last = found.blocks[-1]
    with pytest.raises(VerificationError, match=f"another block {last.number}"):
        ask(found._replace(blocks=(*found.blocks[:-1], last._replace(hash=bytes(32)))), node.url)
    with start("--chain-id", "99") as other, pytest.raises(ChainError, match="another chain"):
        ask(found, other.url)


def test_a_node_that_gives_no_proofs_is_told():
    chain = EmbeddedChain({KEYS.operator.address: 10**21, KEYS.robot(1).address: 10**18})
    made = Recorded(Ledger.deploy(chain, KEYS.operator)[0])
    made.write(made.pen.write(odometry(1)))
    with pytest.raises(ChainError):
        made.evidence(Choice("/robot_1/odom"))


def test_no_more_slots_are_asked_for_at_once_than_nodes_prove():
    asked: list[Any] = []

    class Node:
        contract = "0x"

        def ask(self, requests: list[Any], form: Callable[[list[Any]], proofs.Nodes]) -> proofs.Nodes:
            asked.extend(parameters[1] for _, parameters in requests)
            proof = [{"accountProof": ["0x80"], "storageProof": [{"proof": [one]} for one in page]} for page in asked]
            return form(proof)

    header = proofs.Header(7, 0, b"", b"", b"", b"")
    nodes = proofs.prove_state(Node(), header, range(2_002))  # type: ignore[arg-type]
    assert len(nodes) == 2_003
    assert max(map(len, asked)) <= 1_000
    assert [int(one, 16) for page in asked for one in page] == [*range(2_002)]


def test_what_no_file_could_hold_is_refused(recorded: Recorded, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("rosbridge_eth.reading.evidence.MAX_FILE", 2**20 + 10_000)
    with pytest.raises(ConfigError, match="choose fewer"):
        recorded.evidence(Choice("/robot_1/odom"))
    monkeypatch.setattr("rosbridge_eth.reading.evidence.MAX_CHOSEN", 3)
    with pytest.raises(ConfigError, match="choose fewer"):
        recorded.evidence(Choice("/robot_1/odom"))


# ---------------------------------------------------------------------- evidence.js against the standards


@pytest.fixture
def computed(require: Callable[[str], str]) -> Callable[[str, Any], Any]:
    """What an expression of `evidence` and `given` gives under Node.js."""
    node = require("node")

    def run(expression: str, given: Any) -> Any:
        program = f"""
const evidence = require({str(JAVASCRIPT)!r})
const given = JSON.parse(require('fs').readFileSync(0, 'utf8'))
process.stdout.write(JSON.stringify({expression}))
"""
        done = subprocess.run([node, "-e", program], input=json.dumps(given).encode(), capture_output=True, timeout=60)
        assert done.returncode == 0, done.stderr.decode()
        return json.loads(done.stdout)

    return run


def test_sm3_and_keccak_of_any_length(computed):
    texts = [bytes(n % 251 for n in range(length)).hex() for length in range(300)]
    both = "[evidence.sm3, evidence.keccak].map((digest) => evidence.hex(digest(evidence.unhex(one))))"
    made = computed(f"given.map((one) => {both})", texts)
    assert made == [[sm3.digest(bytes.fromhex(text)).hex(), keccak(bytes.fromhex(text)).hex()] for text in texts]


def test_sm3_of_the_standard(computed):
    vectors = [case.values[0] for case in load("standards/sm3.json")]
    texts = [each.msg.hex() for each in vectors]
    made = computed("given.map((one) => evidence.hex(evidence.sm3(evidence.unhex(one))))", texts)
    assert made == [each.digest.hex() for each in vectors]


def test_sm2_signatures_of_the_standard_hold_and_no_other(computed):
    every = [case.values[0] for case in load("standards/sm2_sign.json", curve="sm2p256v1")]
    vectors = [each for each in every if each.uid == b"1234567812345678"]
    assert len(vectors) > 12
    n = 0xFFFFFFFEFFFFFFFFFFFFFFFFFFFFFFFF7203DF6B21C6052B53BBF40939D54123
    cases = []
    for each in vectors:
        key = each.public_key.hex()
        r, s = (int.from_bytes(value, "big") for value in (each.r, each.s))
        bad = [(r ^ 1, s), (r, s ^ 1), (r + n, s), (r, s + n), (0, s), (r, 0), (r, n - r), (s, r)]
        for good, (a, b) in [(True, (r, s)), *((False, pair) for pair in bad)]:
            cases.append((good, [key, each.msg.hex(), str(a), str(b)]))
    made = computed(
        "given.map(([k, m, r, s]) => evidence.signed(evidence.unhex(k), evidence.unhex(m), BigInt(r), BigInt(s)))",
        [given for _, given in cases],
    )
    assert made == [good for good, _ in cases]


def test_a_key_off_the_curve_verifies_nothing(computed):
    key = "evidence.unhex('04' + '01'.repeat(64))"
    assert computed(f"[evidence.signed({key}, evidence.unhex('00'), 1n, 1n)]", []) == [False]


def test_the_script_knows_the_contracts_code():
    assert f"const CODE = '{proofs.code_hash().hex()}'" in JAVASCRIPT.read_text()
    page = Path(__file__).resolve().parents[3] / "docs" / "evidence.md"
    assert f"CODE = {proofs.code_hash().hex()}\n" in page.read_text(encoding="utf-8")

"""Evidence: what a file shows without a node, and that nothing of it is altered unnoticed; in Python and JavaScript."""

from __future__ import annotations

import json
import re
import subprocess
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from eth_hash.auto import keccak

import geth_network
from bridge.reading.certificates import CAS, cases
from bridge.reading.recorded import EVIL, KEYS, ROOTS, Recorded, at, odometry, record
from bridge.reading.world import NAME, START, Pen, authority, message, reader, robot
from conftest import unavailable
from ports import free_port
from rosbridge_eth.cli import run
from rosbridge_eth.errors import ChainError, ConfigError, VerificationError
from rosbridge_eth.identity import Role, Trust, create_ca, enrol, read_certificates
from rosbridge_eth.ledger import Ledger
from rosbridge_eth.ledger.contract import DataEvent
from rosbridge_eth.ledger.nodes import Anvil, EmbeddedChain
from rosbridge_eth.log.chunk import Chunk, Log, content_key, ledger_id, robot_id
from rosbridge_eth.log.chunk import proofs as record_proofs
from rosbridge_eth.reading import Choice
from rosbridge_eth.reading import evidence as evidence_of
from rosbridge_eth.reading.evidence import MAX_FILE, Asked, Evidence, Record, Statement, Written, ask, verify
from rosbridge_eth.reading.outputs import json_line, proof
from smcrypto import sm3
from vectors_json import load

VECTORS = Path(__file__).resolve().parents[2] / "vectors" / "evidence"
JAVASCRIPT = Path(evidence_of.__file__).with_name("evidence.js")


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
    """The file of five records in four chunks, under both certificates."""
    made = recorded.evidence(Choice("/robot_1/odom", from_ns=at(13.8))).encode()
    assert made.count('"chunk":') == 4 + 5
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
    const {{ robot, contract, genesis, chain, signers, authorities, records }} = evidence.verify(text, () => {{}})
    const lines = records.map((one) =>
      [one.chunk, one.record, one.line, one.sealed, one.written.block, one.written.transaction])
    return {{ robot, contract, genesis, chain, signers, authorities, lines }}
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
        "authorities": list(found.authorities), "signers": list(found.certificates),
        "lines": [
            [each.place.chunk, each.number, each.line.decode(), each.place.sealed_ms, each.place.block,
             each.place.transaction.hex()]
            for each in found.records
        ],
    }  # fmt: skip
    return found


def batch(made: Recorded, first: int) -> DataEvent:
    """The batch on the chain that begins with this chunk."""
    found = made.ledger.data_events(made.pen.log.tk, 0, made.ledger.block_number())
    return next(event for event in found if event.first == first)


pytestmark = pytest.mark.service


# ---------------------------------------------------------------------- what it shows


def test_the_chosen_record_and_no_other_is_shown(recorded: Recorded, one: str, javascript):
    found = both(one, javascript)
    assert [each.line for each in found.records] == [odometry(50)]
    data = batch(recorded, 2)
    assert proof(found.records[0]) == {
        "chunk": 2, "record": 10, "stream": b"a".hex() * 16, "number": 2,
        "digest": Chunk.parse(data.chunks[0]).header.digest.hex(), "sealed": "2026-11-22T10:06:43.000Z",
        "block": data.block, "block_time": None, "transaction": "0x" + data.transaction.hex(),
    }  # fmt: skip
    assert (found.robot, found.contract, found.chain_id) == (NAME, recorded.ledger.contract.lower(), 31337)
    assert found.certificates == (sm3.digest(robot().signing_certificate.to_der()).hex(),)
    for text in ("not shown", "/secret", "robot_2", odometry(49).decode()):
        assert text not in one
    data = next(iter(recorded.ledger.data_events(recorded.pen.log.tk, 0, recorded.ledger.block_number())))
    keys = [content_key(Chunk.parse(chunk).header, reader().encryption_key) for chunk in data.chunks]
    assert not any(key.hex() in one for key in keys)


def test_a_span_goes_over_chunks_blocks_and_certificates(span: str, javascript):
    found = both(span, javascript)
    assert [each.line for each in found.records] == [odometry(n) for n in (138, 139, 140, 150, 151)]
    assert [each.place.chunk for each in found.records] == [6, 6, 7, 8, 9]
    assert found.certificates == tuple(
        sm3.digest(identity.signing_certificate.to_der()).hex() for identity in (robot(), robot(1))
    )


def test_the_vector_holds(javascript):
    """Made by an earlier version: what was given to somebody once can be checked for good."""
    text = (VECTORS / "span.json").read_text()
    roots = read_certificates((VECTORS / "ca.crt.pem").read_bytes())
    found, [there] = check(text, roots), javascript([text])
    assert [each.line.decode() for each in found.records] == [line for _, _, line, *_ in there["lines"]]
    assert [each.line for each in found.records] == [odometry(n) for n in (138, 139, 140, 150, 151)]


def test_a_moment_is_the_last_record_of_each_topic(recorded: Recorded, javascript):
    found = both(recorded.evidence(Choice(at_ns=at(14))).encode(), javascript)
    assert sorted(each.content.topic for each in found.records) == ["/evil", "/robot_1/odom", "/secret"]
    [evil] = [each for each in found.records if each.content.topic == "/evil"]
    assert evil.content.data["text"] == EVIL
    shown = json_line(evil)
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


def test_what_it_proves_and_what_not_is_said_in_words(one: str, span: str, node: Anvil):
    found = check(one)
    said = " ".join(found.proves())
    assert "robot_1 signed 1 record as given here" in said and "no other record can stand at that place" in said
    assert "sealed 2026-11-22T10:0" in (said := " ".join(check(span).proves())) and "Z to 2026-11-22T10:0" in said
    limits = " ".join(found.proves_not())
    assert f"in block {found.records[0].place.block} as the file says: ask a node (--node)" in limits
    assert "no other records" in limits and "its clock was right" in limits and found.genesis in limits
    asked = ask_about(one, node.url)
    said, limits = " ".join(found.proves(asked)), " ".join(found.proves_not(asked))
    assert f"has this since block {found.records[0].place.block} (2" in said and "not revoked now" in said
    assert "--node" not in limits and f"{node.url} is a node of the right chain" in limits


def ask_about(text: str, url: str, roots: Any = ROOTS) -> Asked:
    return ask(Evidence.read(text.encode()), check(text, roots), roots, url)


def test_on_a_network_with_proof_of_authority(tmp_path: Path, javascript):
    rich = {key.address: 10**21 for key in (KEYS.operator, KEYS.account(1))}
    try:
        chain = geth_network.Network(tmp_path, rich, nodes=1, period=1)
    except geth_network.Unavailable as reason:
        unavailable(str(reason))
    with chain:
        made = Recorded(Ledger.deploy(chain.nodes[0].url, KEYS.operator)[0])
        made.write(made.pen.write(odometry(1), odometry(2)))
        text = made.evidence(Choice("/robot_1/odom", at_ns=at(0.1))).encode()
        both(text, javascript)
        assert ask_about(text, chain.nodes[0].url).chunks == 1


def test_a_body_that_was_cut_off_makes_no_dropped_chunk(one: str, javascript):
    """Whoever has the robot's account, the server, can write a header without the body that belongs to it."""
    value = json.loads(one)
    written = value["chunks"][0]
    bare = replace(Chunk.parse(bytes.fromhex(written["encoded"])), body=b"").encoded
    written["encoded"] = bare.hex()
    written["hashes"][written["chunk"] - written["first"]] = keccak(bare).hex()
    text = json.dumps(value, separators=(",", ":"))
    with pytest.raises(VerificationError, match="signature of chunk 2 of stream 61616161 does not hold"):
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
    text = made.evidence(Choice("/robot_1/odom")).encode()
    found, asked = both(text, javascript), ask_about(text, node.url)
    assert asked.revoked and "REVOKED" in " ".join(found.proves(asked))


# ---------------------------------------------------------------------- certificates


def test_certificates_are_judged_by_the_table_of_the_page(javascript):
    """The same cases as `read` and docs/verify.mjs judge in test_javascript.py."""
    texts, known = {}, list(cases())
    for case in known:
        genesis, contract = bytes(32), bytes(20)
        pen = Pen(identity=case.identity, log=Log(ledger_id(1, genesis, contract), robot_id(NAME)))
        chunk = pen.write(odometry(1))
        [shown] = record_proofs([odometry(1)], content_key(chunk.header, reader().encryption_key), [0])
        texts[case.name] = Evidence(
            robot=NAME, tk=robot_id(NAME), chain_id=1, genesis=genesis, contract=contract,
            certificates=[case.registered],
            authorities=sorted(ca.certificate.to_der() for ca in CAS),
            chunks=[Written(
                chunk=0, certificate=0, encoded=chunk.encoded, first=0, hashes=[keccak(chunk.encoded)], block=1,
                transaction=bytes(32),
            )],
            records=[Record(chunk=0, record=0, line=odometry(1).decode(), salt=shown.salt, path=list(shown.path))],
        ).encode()  # fmt: skip
    here = {}
    for name, text in texts.items():
        with suppress(VerificationError):
            here[name] = len(check(text, [ca.certificate for ca in CAS]).records)
    answers = javascript(list(texts.values()))
    there = [name for name, answer in zip(texts, answers, strict=True) if isinstance(answer, dict)]
    assert list(here) == there == [case.name for case in known if case.good]


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


def test_every_leaf_member_and_list_that_is_altered_is_found(span: str, node: Anvil, javascript):
    value = json.loads(span)
    texts = {where: json.dumps(other, separators=(",", ":")).replace("<", "\\u003c") for where, other in altered(value)}
    # Another choice of the robot's records of a chunk is another file, and as good: it says so much less.
    fewer = {".records-[0]", ".records-[1]"}
    held = set()
    for where, text in texts.items():
        try:
            assert len(check(text).records) == (4 if where in fewer else 5), where
            held.add(where)
        except VerificationError:
            pass
    # What only names where the chain has it says the node.
    named = {where for where in held - fewer if re.search(r"\]\.(first|hashes|block|transaction)[^.]*$", where)}
    assert held == fewer | named and len(texts) > 400
    for where in {re.sub(r"\d+", "0", where): where for where in named}.values():
        with pytest.raises((VerificationError, ChainError)):
            ask_about(texts[where], node.url)
            pytest.fail(where)
    assert ask_about(texts[".records-[0]"], node.url).chunks == 10
    some = sorted({*list(texts)[::8], *held})
    answers = dict(zip(some, javascript([texts[where] for where in some]), strict=True))
    assert {where for where, answer in answers.items() if not isinstance(answer, str)} == held & {*some}


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
        "a certificate more": json.dumps(value | {"certificates": value["certificates"] * 2}, separators=(",", ":")),
        "no certificate": json.dumps(value | {"certificates": []}, separators=(",", ":")),
        "another certificate": json.dumps(
            value | {"certificates": [robot(1).public.certificates.hex()]}, separators=(",", ":")),
        "swapped robot": json.dumps(value | {"robot": "robot_2"}, separators=(",", ":")),
        "swapped contract": json.dumps(value | {"contract": "11" * 20}, separators=(",", ":")),
        "swapped chain": json.dumps(value | {"chain_id": 1}, separators=(",", ":")),
    }  # fmt: skip
    for what, text in texts.items():
        with pytest.raises(VerificationError):
            check(text)
            pytest.fail(what)
    assert all(isinstance(answer, str) for answer in javascript(list(texts.values())))


def test_what_the_file_says_of_the_chain_is_told_by_the_node_alone(span: str, node: Anvil, javascript):
    """The limit of what can be known offline: a chunk that the robot signed and that is not there, or elsewhere."""
    for member, other in (("block", 1), ("block", 10**9), ("transaction", "11" * 32), ("first", 5)):
        value = json.loads(span)
        for written in value["chunks"][:1]:
            written[member] = other
            if member == "first":
                written["hashes"] = ["00" * 32, *written["hashes"]]
        text = json.dumps(value, separators=(",", ":")).replace("<", "\\u003c")
        both(text, javascript)
        with pytest.raises(VerificationError, match="says http"):
            ask_about(text, node.url)


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
    with pytest.raises(VerificationError, match="no certificate of this robot that is to be trusted"):
        check(text)
    [answer] = javascript([text])
    assert "a certificate" in answer


def test_certificates_that_are_none_hide_none_that_follow(node: Anvil, javascript):
    """The contract takes whatever the operator registers: here the beginning of a certificate, of nothing."""
    made = Recorded(Ledger.deploy(node.url, KEYS.operator)[0])
    nothing = bytes.fromhex("3011" "300aa0030201020201013000" "3000" "030100") * 2
    for account, certificates in ((KEYS.account(3), nothing), (KEYS.account(1), robot().public.certificates)):
        made.ledger.replace_registration(KEYS.operator, made.pen.log.tk, account.address, certificates)
    made.write(made.pen.write(odometry(1)))
    text = made.evidence(Choice("/robot_1/odom")).encode()
    assert len(both(text, javascript).certificates) == 1
    assert ask_about(text, node.url).chunks == 1
    value = json.loads(text)
    value["certificates"].append(nothing.hex())
    with pytest.raises(VerificationError, match="no certificate of this robot"):
        check(json.dumps(value, separators=(",", ":")))
    assert isinstance(javascript([json.dumps(value, separators=(",", ":"))])[0], str)


def test_who_signs_with_the_key_of_a_certificate_that_is_replaced_is_told_by_the_node(node: Anvil, javascript):
    """Offline the chunk is the robot's, whenever that was; the contract knows which certificate held when."""
    made = Recorded(Ledger.deploy(node.url, KEYS.operator)[0])
    made.write(made.pen.write(odometry(1)))
    text = made.evidence(Choice("/robot_1/odom")).encode()
    made.ledger.replace_registration(
        KEYS.operator, made.pen.log.tk, KEYS.account(2).address, robot(1).public.certificates
    )
    assert ask_about(text, node.url).chunks == 1
    made.account = KEYS.account(2)
    made.write(made.pen.write(odometry(2)))  # under the old certificate still
    data = batch(made, 1)
    chunk = Chunk.parse(data.chunks[0])
    proof = next(record_proofs([odometry(2)], content_key(chunk.header, reader().encryption_key), [0]))
    value = json.loads(text)
    value["chunks"] = [value["chunks"][0] | {
        "chunk": 1, "encoded": chunk.encoded.hex(), "first": 1, "hashes": [keccak(chunk.encoded).hex()],
        "block": data.block, "transaction": data.transaction.hex(),
    }]  # fmt: skip
    value["records"] = [{"chunk": 1, "record": 0, "line": odometry(2).decode(), "salt": proof.salt.hex(), "path": []}]
    text = json.dumps(value, separators=(",", ":"))
    both(text, javascript)
    with pytest.raises(VerificationError, match="forged"):
        ask_about(text, node.url)


def test_more_of_the_cas_than_a_file_may_have_is_refused_in_both_languages(javascript):
    value = json.loads((VECTORS / "span.json").read_text())
    more = [create_ca(f"CA {n}", at=START).certificate for n in range(16)]
    value["authorities"] = sorted([*value["authorities"], *(one.to_der().hex() for one in more)])
    text = json.dumps(value, separators=(",", ":"))
    with pytest.raises(VerificationError, match="at most 16"):
        check(text, [*read_certificates((VECTORS / "ca.crt.pem").read_bytes()), *more])
    assert "authorities is not in its form" in javascript([text])[0]


def test_a_page_that_this_version_did_not_write_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    page, file = Evidence.read((VECTORS / "span.json").read_bytes()).page(), tmp_path / "page.html"
    for text, told in ((page, False), (page.replace("The record", "The only record"), True)):
        file.write_text(text, encoding="utf-8")
        assert run(["verify", str(file), "--ca", str(VECTORS / "ca.crt.pem")]) == 0
        said = capsys.readouterr()
        assert ("The page differs from the one that this version writes" in said.err) == told
        assert len(said.out.splitlines()) == 5 and "What it does not prove:" in said.err


# ---------------------------------------------------------------------- files from anybody


@pytest.mark.parametrize("data", [
    b"", b"{}", b"[]", b"null", b"[" * 200_000, b'{"a":' * 100_000, b"\xff\xfe", b"<html></html>", b'"' * 9,
    b"1" * 5_000, b'{"format":"rosbridge-eth evidence 1"}', b'{"format":"rosbridge-eth evidence 2"}',
    b'<script type="application/json" id="evidence">{}</script>', b"0" * (MAX_FILE + 1), b'{"format":"\\ud800"}',
], ids=range(15))  # fmt: skip
def test_what_is_no_evidence_is_told_in_a_sentence(data: bytes):
    with pytest.raises(VerificationError) as told:
        Evidence.read(data)
    assert len(str(told.value)) < 400 and str(told.value).isprintable()


def test_more_certificates_than_anybody_checks_are_refused(javascript):
    """Each costs two signatures of the CA: 25,000 in a file would take a browser ten minutes."""
    value = json.loads((VECTORS / "span.json").read_text())
    value["certificates"] *= 501
    text = json.dumps(value, separators=(",", ":"))
    with pytest.raises(VerificationError, match="at most 1000"):
        check(text, read_certificates((VECTORS / "ca.crt.pem").read_bytes()))
    assert "certificates is not in its form" in javascript([text])[0]


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
        Evidence.read(b'{"format":"rosbridge-eth evidence 2","chunks":[' + values + b"0]}")


# ---------------------------------------------------------------------- the node


def test_the_contract_is_asked_whether_it_has_it(span: str, recorded: Recorded, node: Anvil, require):
    asked = ask_about(span, node.url)
    assert (asked.chunks, asked.revoked) == (10, False)
    assert asked.times == {
        each.place.block: recorded.ledger.block_time(each.place.block) for each in check(span).records
    }
    with start("--chain-id", "99") as other, pytest.raises(ChainError, match="another chain"):
        ask_about(span, other.url)


def test_it_is_made_and_checked_with_nothing_that_a_node_may_lack():
    chain = EmbeddedChain({KEYS.operator.address: 10**21, KEYS.account(1).address: 10**18})
    made = Recorded(Ledger.deploy(chain, KEYS.operator)[0])
    made.write(made.pen.write(odometry(1)))
    assert len(check(made.evidence(Choice("/robot_1/odom")).encode()).records) == 1


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


def test_sm3_of_any_length(computed):
    texts = [bytes(n % 251 for n in range(length)).hex() for length in range(300)]
    made = computed("given.map((one) => evidence.hex(evidence.sm3(evidence.unhex(one))))", texts)
    assert made == [sm3.digest(bytes.fromhex(text)).hex() for text in texts]


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

"""Grants: what they open, for whom, and everything that is none."""

from __future__ import annotations

import json
import os
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest

from bridge.reading.test_fetch import Chain, chain, numbers
from bridge.reading.world import NAME, START, authority, reader, robot
from rosbridge_eth import identity
from rosbridge_eth.errors import BridgeError, VerificationError
from rosbridge_eth.identity import Role, Trust, create_ca, enrol
from rosbridge_eth.log.chunk import NoGrant
from rosbridge_eth.reading import Choice, Reading, read_robot
from rosbridge_eth.reading.grant import Keys, keys_of, make, open_folder, open_grant

__all__ = ["chain"]

INSURER, NOW = reader("insurer"), START.timestamp() + 90_000
TRUST = Trust([authority().certificate])


def read(chain: Chain, who: Any = INSURER, **more: Any) -> Reading:
    return read_robot([chain.ledger], NAME, trust=TRUST, reader=who.encryption_key, now=NOW, **more)


def grant(keys: Keys, ledger: bytes, *, by: Any = None, to: Any = INSURER, robot: str = NAME) -> bytes:
    when = datetime.fromtimestamp(NOW, UTC)
    return make(keys, ledger=ledger, robot=robot, begin="4", end="12", by=by or reader(), to=to.public, now=when)


def opened(chain: Chain, data: bytes, who: Any = INSURER) -> Keys:
    name, keys = open_grant(data, ledger=chain.ledger.ledger, reader=who, trust=TRUST)
    assert name == NAME
    return keys


def span(chain: Chain, begin: int = 4, end: int = 12, **more: Any) -> Keys:
    reading = chain.read(**more)
    try:
        return keys_of(reading, Choice(from_ns=begin, to_ns=end))
    finally:
        reading.close()


def test_a_grant_opens_the_chunks_of_its_span_and_no_other(chain: Chain):
    for _ in range(2):
        chain.write(chain.pen.chunks(5, records=2))
    reading = read(chain)
    assert numbers(reading) == [] and reading.verdict().counts == {"no-grant": 20}
    keys = opened(chain, grant(span(chain), chain.ledger.ledger))
    assert len(keys) == 4
    reading = read(chain, granted=keys)
    assert numbers(reading) == list(range(4, 12))
    assert reading.verdict().sound and reading.verdict().counts == {"no-grant": 12}
    with pytest.raises(NoGrant):
        read(chain, granted=keys).verifier.key_of(chain.pen.write(b"{}").header)


def test_a_grant_opens_what_was_read_without_it_and_closes_it_when_it_is_removed(chain: Chain, tmp_path: Path):
    chain.write(chain.pen.chunks(10, records=2))
    keys = Keys()
    for granted, given in (({}, []), (keys, [*range(4, 12)]), (keys, [*range(4, 12)]), ({}, [])):
        reading = read(chain, memo=tmp_path / "proven", granted=granted)
        assert numbers(reading) == given
        assert reading.verdict().sound and reading.verdict().chunks == 10
        reading.close()
        if not keys:  # of a reader that has all of it kept
            for _ in range(2):
                keys |= span(chain, memo=tmp_path / "owner")


def test_who_was_granted_may_grant_on(chain: Chain):
    chain.write(chain.pen.chunks(10, records=2))
    given = span(chain)
    third = keys_of(read(chain, granted=given), Choice(from_ns=6, to_ns=8))
    court = reader("court")
    keys = opened(chain, grant(third, chain.ledger.ledger, to=court), court)
    assert numbers(read(chain, court, granted=keys)) == [6, 7]


def test_an_empty_span_has_no_keys(chain: Chain):
    chain.write(chain.pen.chunks(2))
    assert span(chain, 100, 200) == {}


def test_a_wrong_key_is_the_giver_s_fault_and_not_the_robot_s(chain: Chain):
    chain.write(chain.pen.chunks(10, records=2))
    one, two, *_ = keys = span(chain)
    swapped = keys | {one: keys[two], two: keys[one]}
    reading = read(chain, granted=opened(chain, grant(swapped, chain.ledger.ledger)))
    with pytest.raises(VerificationError, match=r"a wrong key was granted for chunk 2 of stream .*: remove that grant"):
        numbers(reading)
    assert "unopenable" not in reading.verdict().counts
    whole = read(chain, reader(), granted=swapped)
    assert numbers(whole) == list(range(20)), "with a key of one's own no grant is used"


MEMBERS = ("ledger", "robot", "begin", "end", "reader", "made", "by", "key", "sealed", "signature")


@pytest.mark.parametrize("member", MEMBERS)
def test_a_grant_with_anything_altered_is_refused(chain: Chain, member: str):
    data = json.loads(grant({b"d" * 32: b"k" * 16}, chain.ledger.ledger))
    other = json.loads(grant({b"d" * 32: b"k" * 16}, b"e" * 32, by=reader("other"), to=reader("a"), robot="robot_2"))
    values = [other[member], "", None, data[member].swapcase(), data[member][:-2], 7, [], "x" * 200]
    if member == "made":
        values = ["2026-01-02T01:00:01Z", "2031-01-01T00:00:00Z", "2026-01-02T01:00:00", ""]
    for value in values:
        if value == data[member]:
            continue
        with pytest.raises(BridgeError) as refused:
            opened(chain, json.dumps(data | {member: value}).encode())
        assert str(refused.value).isprintable() and len(str(refused.value)) < 300
    with pytest.raises(BridgeError):
        opened(chain, json.dumps({name: value for name, value in data.items() if name != member}).encode())


def forged(chain: Chain) -> bytes:
    """Signed by a robot of the same CA."""
    return grant({}, chain.ledger.ledger, by=robot())


def of_another_ca(chain: Chain) -> bytes:
    stranger = enrol(create_ca("Other CA", at=START), Role.READER, "owner", at=START)
    return grant({}, chain.ledger.ledger, by=stranger)


def half_a_key(chain: Chain) -> bytes:
    return grant({b"d" * 32: b"k" * 15}, chain.ledger.ledger)


@pytest.mark.parametrize("data, why", [
    (forged, "robot robot_1 was met where a reader is expected"),
    (of_another_ca, "not to be trusted"),
    (half_a_key, "does not hold whole keys"),
    (lambda chain: grant({}, b"e" * 32), "for another chain or contract"),
    (lambda chain: grant({}, chain.ledger.ledger, to=reader("a")), "it is for reader a, whose keys are not here"),
    (lambda chain: b"", "no grant of this program"), (lambda chain: b"[" * 100_000, "no grant of this program"),
    (lambda chain: b"\xff{}", "no grant of this program"), (lambda chain: b"{}", "no grant of this program"),
])  # fmt: skip
def test_what_is_no_grant_for_this_reader_is_refused_with_a_sentence(chain: Chain, tmp_path: Path, data: Any, why: str):
    (tmp_path / "a.grant").write_bytes(data(chain))
    with pytest.raises(BridgeError, match=why) as refused:
        open_folder(tmp_path, ledger=chain.ledger.ledger, reader=INSURER, trust=TRUST)
    assert str(refused.value).startswith(f"the grant {tmp_path / 'a.grant'} cannot be used: ")


def test_what_is_no_file_or_too_large_is_named_and_not_waited_for(chain: Chain, tmp_path: Path, monkeypatch: Any):
    def use(folder: Path) -> None:
        open_folder(folder, ledger=chain.ledger.ledger, reader=INSURER, trust=TRUST)

    for name, made in (("fifo", os.mkfifo), ("folder", os.mkdir), ("loop", lambda path: os.symlink(path, path))):
        (tmp_path / name).mkdir()
        made(tmp_path / name / "a.grant")
        with pytest.raises(VerificationError, match=r"a\.grant cannot be used: it is no file"):
            use(tmp_path / name)
    (tmp_path / "b").mkdir()
    (tmp_path / "b" / "b.grant").write_bytes(grant({b"d" * 32: b"k" * 16}, chain.ledger.ledger))
    use(tmp_path / "b")
    monkeypatch.setattr("rosbridge_eth.reading.grant.MAX_FILE", 1_000)
    with pytest.raises(VerificationError, match="or has more than"):
        use(tmp_path / "b")
    with pytest.raises(BridgeError, match="grant parts"):
        grant({b"d" * 32: b"k" * 16}, chain.ledger.ledger)


def test_all_grants_of_a_folder_are_used_each_for_its_robot(chain: Chain, tmp_path: Path):
    ledger = chain.ledger.ledger
    assert open_folder(tmp_path / "none", ledger=ledger, reader=INSURER, trust=TRUST) == {}
    for name, keys in (("a", {b"a" * 32: b"1" * 16}), ("b", {b"b" * 32: b"2" * 16})):
        (tmp_path / name).write_bytes(grant(keys, ledger))
    (tmp_path / "c").write_bytes(grant({}, ledger, robot="robot_2"))
    found = open_folder(tmp_path, ledger=ledger, reader=INSURER, trust=TRUST)
    assert found == {NAME: {b"a" * 32: b"1" * 16, b"b" * 32: b"2" * 16}, "robot_2": {}}


def test_nobody_but_the_reader_sees_a_key_or_which_chunks_they_are_of(chain: Chain):
    data = grant({b"d" * 32: b"k" * 16}, chain.ledger.ledger)
    for secret in (b"d" * 32, b"k" * 16):
        assert secret.hex().encode() not in data and secret not in data
    document = json.loads(data)
    signed = json.dumps({name: value for name, value in document.items() if name != "signature"}, separators=(",", ":"))
    key = reader().signing_certificate.public_key
    identity.verify(key, "grant", signed.encode(), bytes.fromhex(document["signature"]))  # as docs/log.md says it

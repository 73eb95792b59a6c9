"""What was read once cannot be taken back unseen, and need not be read again."""

from __future__ import annotations

import json
import os
import threading
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bridge.reading.world import (
    LOG,
    STREAM_LINE,
    Pen,
    Read,
    events,
    line,
    message,
    read,
    registration,
    revocation,
    robot,
    standing,
)
from rosbridge_eth.errors import BridgeError, ConfigError
from rosbridge_eth.files import write_atomically
from rosbridge_eth.log.chunk import Log
from rosbridge_eth.reading import verdict
from rosbridge_eth.reading.verdict import Bookmark, Bookmarks, Kind

TYPE_LINE = line({"type": "pkg/msg/Type", "wire": "ros1", "format": "msg", "definition": "int64 x\n"})


def history(count: int = 9) -> list:
    """Definitions first, then what a log may hold: a drop, a loss, a restart."""
    pen = Pen()
    chunks = [pen.write(STREAM_LINE, TYPE_LINE, message(0))]
    chunks += pen.chunks(2)
    chunks.append(pen.drop(pen.write(message(9), message(10))))
    pen.new_stream(b"b" * 16)
    chunks.append(pen.write(line({"lost": 2, "topic": "/t", "why": "dropped"}), message(3)))
    return (chunks + pen.chunks(count, goodbye=True))[:count]


# --- going on


@pytest.mark.parametrize("at", range(10))
@pytest.mark.parametrize("per_event", [1, 4])
def test_reading_on_ends_as_reading_everything(at, per_event):
    chunks = history()
    whole = read(chunks)
    first = read(chunks[:at])
    data = events(chunks, per_event)
    needed = [event for event in data if event.first + len(event.chunks) > at]
    second = read(data=needed, stands=standing(data, [registration()]), mark=first.mark, **first.at)
    assert first.numbers + second.numbers == whole.numbers
    assert second.verdict == whole.verdict
    assert second.verdict.sound
    assert (second.mark, second.verifier.progress()) == (whole.mark, whole.verifier.progress())


@settings(max_examples=60, deadline=None)
@given(st.data())
def test_reading_a_broken_log_on_ends_as_reading_it_whole(data):
    """Chunks left out, doubled, reordered, altered: what was told stays told, and nothing is given twice."""
    chunks = history()
    order = data.draw(st.lists(st.integers(0, len(chunks) - 1), max_size=12))
    spoiled = [chunks[n].encoded[:-1] + b"?" if data.draw(st.integers(0, 9)) == 0 else chunks[n] for n in order]
    whole = read(spoiled)
    first = read(spoiled[: data.draw(st.integers(0, len(order)))])
    second = read(spoiled, mark=first.mark, **first.at)
    assert first.numbers + second.numbers == whole.numbers
    assert second.verdict == whole.verdict


def test_definitions_that_came_before_are_known():
    chunks = history()
    second = read(chunks, **read(chunks[:2]).at)
    definitions = {record.definition.definition for record in second.records}
    assert definitions == {"int64 x\n"}


def test_what_was_wrong_before_stays_wrong():
    chunks = Pen().chunks(6)
    del chunks[1]
    first = read(chunks[:3])
    second = read(chunks, mark=first.mark, **first.at)
    assert not second.verdict.sound
    assert second.found == first.found == [("missing", 1, 1, 1)]
    assert "missing" in "\n".join(second.verdict.lines())


def test_a_last_chunk_that_the_contract_has_another_hash_of_is_told_when_nothing_is_new():
    chunks = Pen().chunks(3)
    first = read(chunks)
    stands = standing(events(chunks), [registration()])._replace(tail=b"x" * 32)
    assert read(data=[], stands=stands, **first.at).only(Kind.ALTERED).places[0][0] == 2


@pytest.mark.parametrize("broken", [b"junk", None])
def test_a_bookmark_may_lie_on_what_is_no_chunk_of_the_robot(broken):
    chunks = Pen().chunks(4)
    spoiled = [*chunks[:1], broken or chunks[1].encoded[:-1] + b"?", *chunks[2:]]
    first = read(spoiled[:2])
    assert read(spoiled, mark=first.mark).verdict == read(spoiled).verdict


# --- taking back


@pytest.mark.parametrize("at", [None, 3, 5])
def test_a_shorter_log_is_rolled_back(at):
    chunks = history()
    mark = read(chunks).mark
    result = read(chunks[:5], mark=mark, **(read(chunks[:at]).at if at else {}))
    assert "rolled-back" in {kind for kind, *_ in result.found}
    assert not result.verdict.sound
    assert result.verifier.bookmark() == mark, "the old one is kept"


@pytest.mark.parametrize("at", [0, 2])
def test_another_chunk_in_the_bookmarks_place_is_rolled_back(at):
    chunks = Pen().chunks(5)
    other = Pen().chunks(3)
    result = read([*other, *chunks[3:]], mark=read(chunks[:3]).mark, **read(other[:at]).at)
    assert ("rolled-back", 2, 2, 1) in result.found


def test_the_same_chunks_in_other_batches_are_not_rolled_back():
    chunks = Pen().chunks(7)
    mark = read(data=events(chunks[:4], 3)).mark
    assert read(data=events(chunks, 2), mark=mark).found == []


def test_a_node_that_does_not_show_the_bookmarks_chunk():
    chunks = Pen().chunks(6)
    data = events(chunks)
    stands = standing(data, [registration()])
    result = read(data=data[1:], stands=stands, mark=read(data=data[:1]).mark)
    assert ("withheld", 2, 2, 1) in result.found


def test_what_is_withheld_moves_no_bookmark():
    chunks = Pen().chunks(9)
    data = events(chunks)
    stands = standing(data, [registration()])
    mark = read(data=data[:1]).mark
    assert read(data=data[:2], stands=stands, mark=mark).verifier.bookmark() == mark


# --- certificates


def test_a_certificate_that_is_new_since_is_told_until_it_is_confirmed():
    old, new = Pen(), Pen(identity=robot(1), stream=b"b" * 16)
    chunks = old.chunks(3, goodbye=True)
    mark = read(chunks).mark
    new.previous, new.sealed_ms = old.previous, old.sealed_ms
    chunks += new.chunks(3)
    registered = [registration(), revocation(3, 5), registration(robot(1), 3, 5, 5)]

    def again(mark: Bookmark) -> Read:
        return read(chunks, registrations=registered, mark=mark, **(read(chunks[:4], registrations=registered).at))

    for _ in range(2):
        result = again(mark)
        found = result.only(Kind.NEW_CERTIFICATE)
        assert found.detail == result.verdict.certificates[2].fingerprint
        assert "NEW to this reader" in "\n".join(result.verdict.lines())
        assert result.verdict.sound
        assert result.verdict.counts == {"new-certificate": 1}
        mark = result.mark
    confirmed = result.verifier.bookmark(confirm=True)
    assert confirmed is not None
    assert again(confirmed).found == []


def test_the_first_reading_takes_the_certificates_as_known_and_shows_their_fingerprints():
    result = read(Pen().chunks(2))
    assert result.mark.fingerprints == tuple(one.fingerprint for one in result.verdict.certificates)


# --- the file


def test_bookmarks_are_kept_by_ledger_and_robot(tmp_path):
    mark, other = read(history()).mark, replace(read(history(3)).mark, fingerprints=("a", "b"))
    elsewhere = Log(b"M" * 32, LOG.tk)
    bookmarks = Bookmarks(tmp_path / "bookmarks.json")
    assert bookmarks.get(LOG) is None
    bookmarks.put(LOG, mark)
    bookmarks.put(elsewhere, other)
    again = Bookmarks(tmp_path / "bookmarks.json")
    assert again.get(LOG) == mark
    assert again.get(elsewhere) == other


def test_two_commands_at_once_lose_no_bookmark(tmp_path, monkeypatch):
    path, mark, elsewhere = tmp_path / "bookmarks.json", read(history()).mark, Log(b"M" * 32, LOG.tk)
    second = threading.Thread(target=lambda: Bookmarks(path).put(elsewhere, mark))

    def write(path: Path, content: bytes) -> None:
        if second.ident is None:
            second.start()
            second.join(0.3)  # it has come in between, or waits
        write_atomically(path, content)

    monkeypatch.setattr(verdict, "write_atomically", write)
    Bookmarks(path).put(LOG, mark)
    second.join()
    assert Bookmarks(path).get(LOG) == Bookmarks(path).get(elsewhere) == mark


def test_a_bookmark_that_another_command_has_moved_further_stays_there(tmp_path):
    bookmarks = Bookmarks(tmp_path / "bookmarks.json")
    bookmarks.put(LOG, Bookmark(9, "ab" * 32, ("a",)))
    bookmarks.put(LOG, Bookmark(4, "cd" * 32, ("a", "b")))
    assert bookmarks.get(LOG) == Bookmark(9, "ab" * 32, ("a", "b"))


def test_a_crash_while_writing_leaves_the_old_bookmark(tmp_path, monkeypatch):
    path = tmp_path / "bookmarks.json"
    mark = read(history()).mark
    Bookmarks(path).put(LOG, mark)

    def crash(*_: object) -> None:
        raise OSError("power cut")

    monkeypatch.setattr(os, "replace", crash)
    with pytest.raises(OSError, match="power cut"):
        Bookmarks(path).put(LOG, replace(mark, count=99))
    monkeypatch.undo()
    assert Bookmarks(path).get(LOG) == mark
    assert os.listdir(tmp_path) == ["bookmarks.json"]


NONE = [b"", b"{", b"[]", b'{"format": 2, "logs": {}}', b'{"format": 1, "logs": {"a": {}}}', b"\xff"]


@pytest.mark.parametrize("content", NONE)
def test_a_file_that_is_no_bookmark_is_not_taken_for_an_empty_one(tmp_path, content):
    (tmp_path / "bookmarks.json").write_bytes(content)
    with pytest.raises(ConfigError, match=r"cannot be used \([^_]*\); bring"):
        Bookmarks(tmp_path / "bookmarks.json")


@settings(max_examples=200)
@given(st.data())
def test_a_damaged_bookmark_is_refused_or_read_never_a_traceback(tmp_path_factory, data):
    path = tmp_path_factory.mktemp("b") / "bookmarks.json"
    Bookmarks(path).put(LOG, Bookmark(4, "cd" * 32, ("ef" * 32,)))
    value = json.loads(path.read_bytes())
    target = value["logs"][f"{LOG.ledger.hex()}/{LOG.tk.hex()}"]
    anything = data.draw(st.none() | st.booleans() | st.integers() | st.text(max_size=8) | st.just([]))
    target[data.draw(st.sampled_from([*target]))] = anything
    path.write_text(json.dumps(value))
    with suppress(BridgeError):
        read(Pen().chunks(5), mark=Bookmarks(path).get(LOG))

"""The live page: what its server refuses, and what a real browser shows of robots that are followed on a contract."""

from __future__ import annotations

import http.client
import json
import re
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest

from bridge.browser import Browser
from bridge.reading.test_fetch import Chain, chain
from bridge.reading.test_follow import Follow
from bridge.reading.world import NAME, line
from rosbridge_eth.capture import MessageLine, parse_line
from rosbridge_eth.config.values import Address
from rosbridge_eth.errors import NetworkError
from rosbridge_eth.reading import Choice, Place, ProvenRecord, live
from rosbridge_eth.reading.live import MAX_CONNECTIONS, MAX_FIELDS, MAX_POINTS, MAX_TOPICS, Page, View

__all__ = ["chain"]

EVIL = "<img src=x onerror=alert(1)>\u202e"


def odometry(n: int, topic: str = "/odom", **more: Any) -> bytes:
    data = {"pose": {"pose": {"position": {"x": n / 2, "y": -n / 4, "z": 0.0}}}} | more
    return line({"topic": topic, "type": "nav_msgs/msg/Odometry", "source": "sim", "received_ns": 10**18 + n * 10**9,
                 "captured_ns": n, "clock": True, "data": data})  # fmt: skip


class Watch:
    """A contract that is followed and shown."""

    def __init__(self, chain: Chain, folder: Path, port: int = 0) -> None:
        self.chain, self.follow = chain, Follow(folder, chain.ledger)
        chain.pen.sealed_ms = time.time_ns() // 10**6 - 60_000
        self.view = View(["http://127.0.0.1:8545"], 1, [NAME])
        self.page = Page(Address("127.0.0.1", port), self.view)
        self.url = f"http://{self.page.address}/"

    def write(self, *lines: bytes, **more: Any) -> None:
        self.chain.write([self.chain.pen.write(*lines, **more)])
        self.look()

    def look(self) -> None:
        for name, record in self.follow.following.new(Choice(), time.time):
            self.view.write(name, record)
        self.view.show(self.follow.robots)

    def ask(self, path: str = "/", host: str | None = None, method: str = "GET") -> http.client.HTTPResponse:
        connection = http.client.HTTPConnection(*self.page.address, timeout=20)
        connection.request(method, path, headers={"Host": host or str(self.page.address)})
        return connection.getresponse()


@pytest.fixture
def watch(chain: Chain, tmp_path: Path) -> Iterator[Watch]:
    made = Watch(chain, tmp_path)
    yield made
    made.page.close()


# --- the server


def test_only_this_machine_s_own_names_are_answered_and_nothing_may_be_loaded_from_elsewhere(watch: Watch):
    port = watch.page.address.port
    for host in ("127.0.0.1", "localhost", f"localhost:{port}", "LOCALHOST:1", "[::1]:80"):
        assert watch.ask(host=host).status == 200
    for host in ("evil.example", f"evil.example:{port}", "127.0.0.1.evil.example", "0.0.0.0", "127.0.0.1@evil", "["):
        for path in ("/", "/events", "/live.js"):
            assert watch.ask(path, host).status == 403, host
    answer = watch.ask()
    policy = answer.headers["Content-Security-Policy"]
    assert policy.startswith("default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'")
    assert "unsafe" not in policy and "frame-ancestors 'none'" in policy
    assert not any(name.lower().startswith("access-control") for name in answer.headers)
    assert (answer.headers["Cache-Control"], answer.headers["X-Content-Type-Options"]) == ("no-store", "nosniff")
    assert watch.ask("/../../etc/passwd").status == watch.ask("/live.py").status == 404
    assert watch.ask(method="POST").status == 501


def test_connections_that_send_a_byte_now_and_then_do_not_keep_others_out(watch: Watch, monkeypatch: Any):
    """Each byte was in time; the request as a whole is not."""
    monkeypatch.setattr(live._Handler, "timeout", 0.5)
    dripping = [socket.create_connection(watch.page.address) for _ in range(MAX_CONNECTIONS)]
    for one in dripping:
        one.sendall(b"GET / HTTP/1.0\r\nX: ")
    end, answered = time.monotonic() + 15, False
    while not answered and time.monotonic() < end:
        for one in dripping:
            with suppress(OSError):
                one.sendall(b"a")
        with suppress(OSError, http.client.HTTPException):
            answered = watch.ask().status == 200
    assert answered
    for one in dripping:
        one.close()


def test_an_address_that_is_given_is_served_and_one_that_is_taken_is_a_sentence(watch: Watch):
    with pytest.raises(NetworkError, match="choose another"):
        Page(watch.page.address, watch.view)
    page = Page(Address("0.0.0.0", 0), watch.view)
    connection = http.client.HTTPConnection("127.0.0.1", page.address.port, timeout=20)
    connection.request("GET", "/", headers={"Host": "0.0.0.0"})
    assert connection.getresponse().status == 200
    page.close()


def test_an_address_may_be_written_in_capitals(watch: Watch, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("rosbridge_eth.reading.live.OWN_NAMES", frozenset())
    page = Page(Address("LOCALHOST", 0), watch.view)
    connection = http.client.HTTPConnection(*page.address, timeout=20)
    connection.request("GET", "/", headers={"Host": f"localhost:{page.address.port}"})
    assert connection.getresponse().status == 200
    page.close()


def events(answer: Any) -> Iterator[dict[str, Any]]:
    for row in answer:
        if row.startswith(b"data: "):
            yield json.loads(row[6:])


def test_each_event_is_all_there_is_to_show_and_bounded(watch: Watch):
    watch.write(*(odometry(n, EVIL if n == 3 else "/odom", **{f"f{i}": i for i in range(100)}) for n in range(9)))
    seen = events(watch.ask("/events"))
    [robot] = next(seen)["robots"]
    assert (robot["sound"], robot["chunks"], robot["records"], robot["trouble"]) == (True, 1, 9, "")
    counts = {track["topic"]: track["count"] for track in robot["tracks"]}
    assert counts == {"/odom": 8, EVIL.replace("\u202e", "\\u202e"): 1}
    assert robot["tracks"][0]["points"][-1] == [4.0, -2.0]
    for topic in robot["latest"]:
        assert topic["topic"].isprintable()
        assert (len(topic["fields"]), topic["more"]) == (MAX_FIELDS, 103 - MAX_FIELDS)
    watch.write(*(odometry(n, f"/t{n}") for n in range(300)))
    for n in range(3):
        watch.write(*(odometry(n) for n in range(900 * n, 900 * n + 900)))
    [robot] = next(one for one in seen if one["robots"][0]["records"] == 3009)["robots"]
    [track] = [one for one in robot["tracks"] if one["topic"] == "/odom"]
    assert track["count"] == 2708 and MAX_POINTS / 2 <= len(track["points"]) <= MAX_POINTS + 1
    assert track["points"][-1] == [2699 / 2, -2699 / 4]
    assert len(robot["latest"]) == MAX_TOPICS and len(robot["tracks"]) <= 32


def test_a_track_far_from_the_origin_is_no_staircase(watch: Watch):
    """Coordinates of a map, such as UTM, are millions of metres."""
    for n in range(3):
        where = {"pose": {"position": {"x": 691_607.25 + n / 100, "y": 5_334_764.125 + n / 100}}}
        watch.view.write(NAME, proven(odometry(n, pose=where)))
    [robot] = json.loads(watch.view.state()[1])["robots"]
    assert [y for _, y in robot["tracks"][0]["points"][:3]] == [5_334_764.125, 5_334_764.135, 5_334_764.145]


def proven(line: bytes) -> ProvenRecord:
    content = parse_line(line)
    assert isinstance(content, MessageLine)
    return ProvenRecord(Place(0, b"", 0, b"", 0, 0, b"", 0), 0, line, content, None)


def test_of_a_large_record_its_beginning_is_shown(watch: Watch):
    watch.view.write(NAME, proven(odometry(1, image="x" * 50_000)))
    [robot] = json.loads(watch.view.state()[1])["robots"]
    assert dict(robot["latest"][0]["fields"])["image"] == "x" * 77 + "..."


def test_another_site_s_page_takes_no_room(watch: Watch):
    """A browser says who asks; such a page could not read the events, but keep them from others."""
    for site, status in (("cross-site", 403), ("same-site", 403), ("same-origin", 200), ("none", 200)):
        connection = http.client.HTTPConnection(*watch.page.address, timeout=20)
        connection.request("GET", "/events", headers={"Sec-Fetch-Site": site})
        assert connection.getresponse().status == status, site
        connection.close()


def test_connections_beyond_the_bound_are_closed_and_hold_nothing_up(watch: Watch, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("rosbridge_eth.reading.live.MAX_CONNECTIONS", 4)
    page = Page(Address("127.0.0.1", 0), watch.view)
    before = threading.active_count()
    idle = [socket.create_connection(tuple(page.address), timeout=20) for _ in range(20)]
    assert idle[-1].recv(1) == b"", "closed at once"
    assert threading.active_count() <= before + 4
    for one in idle:
        one.close()
    deadline = time.monotonic() + 60
    while time.monotonic() < deadline:
        with suppress(OSError, http.client.HTTPException):
            connection = http.client.HTTPConnection(*page.address, timeout=20)
            connection.request("GET", "/")
            assert connection.getresponse().status == 200
            break
    else:
        pytest.fail("no room again")
    page.close()


def test_what_is_shown_is_made_once_for_all_pages_and_names_are_bounded(watch: Watch):
    watch.write(*(odometry(n, f"/{n}" + "x" * 20_000) for n in range(3)))
    _, state = watch.view.state()
    assert len(state) < 10_000 and len(json.loads(state)["robots"][0]["latest"]) == 3
    watch.view.show([])
    assert watch.view.state()[1] is state, "sixteen pages do not hold the reading up sixteen times"
    [*_, robot] = json.loads(state)["robots"]
    assert all(len(one["topic"]) == 255 for one in (*robot["latest"], *robot["tracks"]))


def test_closing_ends_the_events(watch: Watch):
    answer = watch.ask("/events")
    threading.Timer(0.1, watch.page.close).start()
    assert b"retry:" in answer.read()


# --- in a browser


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    with Browser(tmp_path_factory.mktemp("browser")) as made:
        yield made


def text(of: str) -> str:
    return f"document.querySelector({json.dumps(of)})?.textContent"


@pytest.mark.service
def test_records_are_drawn_as_they_are_proven(watch: Watch, browser: Browser, tmp_path: Path):
    browser.looks()
    browser.open(watch.url)
    browser.until(f"{text('#link')} === 'Live'")
    assert browser.run(text(".sound")) == "not read yet"
    assert browser.run(text("svg text")) == "no positions yet"
    watch.write(odometry(0), odometry(1, topic="/other"), odometry(2, note=EVIL, ranges=[1.5] * 40))
    browser.until(f"{text('.sound')} === 'sound'")
    label = browser.run("document.querySelector('figure > svg').getAttribute('aria-label')")
    assert label == f"Trajectory of {NAME}. /odom: 2 positions, now at x 1 m, y -0.5 m; " + (
        "/other: 1 positions, now at x 0.5 m, y -0.25 m"
    )
    shown = browser.run("document.body.innerText")
    assert EVIL.replace("\u202e", "\\u202e") in shown, "what a robot wrote is text"
    assert "[1.5, 1.5, 1.5, 1.5, 1.5, 1.5, … 40 in all]" in shown
    assert re.search(r"Read up to block\n\d+, made \d+ s ago\n", shown)
    for words in ("Chunks on the chain", "Records proven", "Last sealed, by the robot's clock", "goes on"):
        assert words in shown
    drawn = "document.querySelector('polyline').getAttribute('points').split(' ').length"
    before = browser.run(drawn)
    watch.write(odometry(3), odometry(4))
    browser.until(f"{drawn} > {before}")
    browser.until("document.body.innerText.includes('5')")
    assert browser.run("document.querySelectorAll('img, article script').length") == 0
    browser.picture(tmp_path / "page.png")
    assert (tmp_path / "page.png").stat().st_size > 10_000
    assert set(browser.requests) == {watch.url + path for path in ("", "live.css", "live.js", "drawing.js", "events")}
    assert browser.said == []


@pytest.mark.service
def test_what_is_wrong_is_seen_and_a_node_that_is_away_is_said(watch: Watch, browser: Browser):
    browser.open(watch.url)
    watch.write(odometry(0))
    browser.until(f"{text('.sound')} === 'sound'")
    assert not browser.run("document.querySelector('.verdict').open")
    watch.chain.pen.number += 3
    watch.write(odometry(1))
    browser.until(f"{text('.sound')} === 'NOT SOUND'")
    assert browser.run("document.querySelector('.verdict').open"), "the findings come forward"
    assert "forked" in browser.run(text(".verdict"))
    watch.follow.robots[0].trouble = "http://127.0.0.1:8545 does not answer"
    watch.view.show(watch.follow.robots)
    browser.until("document.querySelector('[role=alert]').innerText.includes('does not answer. It is asked again')")


@pytest.mark.service
def test_a_page_goes_on_when_its_server_is_back(chain: Chain, browser: Browser, tmp_path: Path):
    first = Watch(chain, tmp_path)
    first.write(odometry(0))
    browser.open(first.url)
    browser.until(f"{text('.sound')} === 'sound'")
    first.page.close()
    browser.until(f"{text('#link')}.includes('trying again')")
    assert browser.run(text(".sound")) == "sound", "what was shown stays"
    second = Watch(chain, tmp_path, first.page.address.port)
    second.write(odometry(1))
    browser.until(f"{text('#link')} === 'Live'")
    browser.until("document.body.innerText.includes('2 positions')")
    assert browser.run("document.querySelectorAll('article').length") == 1
    second.page.close()
    third = Page(first.page.address, View([], 1, ["robot_9"]))
    browser.until("document.querySelector('article .name').textContent === 'robot_9'")
    assert browser.run("document.querySelectorAll('article').length") == 1, "the one that is not read now is gone"
    third.close()


@pytest.mark.service
def test_it_is_for_keyboards_narrow_screens_the_dark_and_who_wants_no_motion(watch: Watch, browser: Browser):
    watch.write(odometry(0, a_name_of_a_field_that_is_long="x" * 70), odometry(1, topic="/" + "long_" * 30))
    browser.looks(360, 640, dark=True, still=True)
    browser.open(watch.url)
    browser.until("document.querySelectorAll('td').length > 3")
    assert browser.run("document.documentElement.scrollWidth") <= 360
    style = "getComputedStyle(document.querySelector('.now')).transitionDuration"
    assert browser.run(style) == "0s"
    assert browser.run("getComputedStyle(document.body).backgroundColor") == "rgb(14, 17, 22)"
    watch.write(odometry(2))
    browser.until("document.body.textContent.includes('proven in chunk 1')")
    browser.looks(1280, 900)
    assert browser.run(style) == "0.4s, 0.4s"
    assert browser.run("getComputedStyle(document.body).backgroundColor") == "rgb(246, 247, 249)"
    reached = []
    for _ in range(3):
        browser.press("Tab", 9)
        reached.append(browser.run("document.activeElement.tagName + ' ' + document.activeElement.innerText"))
        assert browser.run("getComputedStyle(document.activeElement).outlineStyle") == "solid"
    assert [one.split()[0] for one in reached] == ["SUMMARY"] * 3 and reached[-1] == "SUMMARY Verdict"
    assert not browser.run("document.querySelector('.verdict').open")
    browser.press(" ", 32)
    browser.until("document.querySelector('.verdict').open")
    watch.write(odometry(3))
    browser.until("document.body.textContent.includes('proven in chunk 2')")
    assert browser.run("document.activeElement.innerText") == "Verdict", "news do not take the focus away"

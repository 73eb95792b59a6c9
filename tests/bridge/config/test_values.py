"""Durations, times, sizes, addresses."""

from __future__ import annotations

import tomllib
from datetime import UTC, datetime

import pytest

from rosbridge_eth.config import Address
from rosbridge_eth.config.values import parse_address, parse_duration, parse_seconds, parse_size, parse_time

MS, S = 10**6, 10**9


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("250ms", 250 * MS),
        ("2s", 2 * S),
        ("2 s", 2 * S),
        ("0.5s", S // 2),
        ("1.5h", 5400 * S),
        ("5m", 300 * S),
        ("1h30m", 5400 * S),
        ("1h 30m 5s", 5405 * S),
        ("7d", 7 * 86400 * S),
    ],
)
def test_durations(text, expected):
    assert parse_duration(text) == expected
    assert parse_seconds(text) == expected / 1e9


@pytest.mark.parametrize("value", ["", "2", "s", "2x", "-2s", "2s3", "0s", "1e3s", "2S", 2, 2.0, True, None, [], "²s",
                                   "0.0000001ms"])
def test_what_is_no_duration(value):
    with pytest.raises(ValueError, match=r'such as "250ms"|longer than nothing'):
        parse_duration(value)


@pytest.mark.parametrize(
    "text",
    [
        '"2026-11-21T10:00:00Z"',
        '"2026-11-21T18:00:00+08:00"',
        '"2026-11-21 10:00:00.000Z"',
        "2026-11-21T10:00:00Z",
        "2026-11-21T05:00:00-05:00",
    ],
)
def test_times_are_moments_whatever_the_offset(text):
    value = tomllib.loads(f"t = {text}")["t"]
    assert parse_time(value) == round(datetime(2026, 11, 21, 10, tzinfo=UTC).timestamp()) * S


def test_times_keep_microseconds():
    assert parse_time("1970-01-01T00:00:01.000001Z") == 1_000_001_000
    assert parse_time("1969-12-31T23:59:59.5Z") == -500_000_000


@pytest.mark.parametrize(
    "text", ['"noon"', '"2026-11-21T10:00:00"', "2026-11-21T10:00:00", "2026-11-21", "10:00:00", "5"]
)
def test_what_is_no_moment(text):
    with pytest.raises(ValueError, match=r"write a time such as|say in which time zone"):
        parse_time(tomllib.loads(f"t = {text}")["t"])


@pytest.mark.parametrize(
    ("value", "expected"),
    [("64 MiB", 64 * 2**20), ("500 kB", 500_000), ("1.5GiB", 3 * 2**29), ("10B", 10), (4096, 4096)],
)
def test_sizes(value, expected):
    assert parse_size(value) == expected


@pytest.mark.parametrize("value", ["", "64", "64 mib", "64 MB/s", "-1 MiB", "0 B", 0, -5, 1.5, True, None, []])
def test_what_is_no_size(value):
    with pytest.raises(ValueError, match='such as "64 MiB"'):
        parse_size(value)


@pytest.mark.parametrize(
    ("text", "host", "port"),
    [
        ("192.0.2.7:7410", "192.0.2.7", 7410),
        ("robots.example:1", "robots.example", 1),
        ("[2001:db8::7]:7410", "2001:db8::7", 7410),
        ("0.0.0.0:0", "0.0.0.0", 0),
    ],
)
def test_addresses(text, host, port):
    assert parse_address(text) == Address(host, port)
    assert str(parse_address(text)) == text


@pytest.mark.parametrize(
    "value", ["", "host", ":7410", "host:", "host:65536", "host:-1", "2001:db8::7:7410", "a b:1", 7410,
              "a..b:1", ".a:1", f"{'a' * 64}.example:1", f"{'a.' * 127}:1"]
)
def test_what_is_no_address(value):
    with pytest.raises(ValueError, match="write HOST:PORT"):
        parse_address(value)

"""When a topic's messages are due, and which rule a topic has."""

from __future__ import annotations

from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rosbridge_eth.capture.rules import NamePattern, Schedule, TopicRule, rule_for

S = 10**9


def taken(rule: TopicRule, times: list[int]) -> list[int]:
    schedule = Schedule(rule)
    kept = []
    for moment in times:
        if schedule.due(moment):
            schedule.captured(moment)
            kept.append(moment)
    return kept


TEN_HZ = [tick * S // 10 for tick in range(100)]  # ten seconds


def test_without_a_rule_everything_is_due():
    assert taken(TopicRule("/a"), TEN_HZ) == TEN_HZ


@pytest.mark.parametrize(("rate", "count"), [(1, 10), (2, 20), (5, 50), (10, 100), (1000, 100), (0.5, 5)])
def test_a_rate_thins_out_evenly(rate, count):
    kept = taken(TopicRule("/a", rate=rate), TEN_HZ)
    assert len(kept) == count
    gaps = [after - before for before, after in pairwise(kept)]
    assert max(gaps) - min(gaps) <= S // 10


@given(st.lists(st.integers(-3 * S // 100, 3 * S // 100), min_size=100, max_size=100))
def test_jitter_does_not_thin_out_a_topic_at_its_own_rate(jitter):
    # Up to 30 ms either way on a period of 100 ms; until the interval is known a few may be lost.
    times = [moment + shift for moment, shift in zip(TEN_HZ, jitter, strict=True)]
    assert len(taken(TopicRule("/a", rate=10), times)) >= 95


@given(st.lists(st.integers(0, 10 * S), min_size=1, max_size=300).map(sorted), st.sampled_from([1, 3, 10, 50]))
def test_no_window_has_more_than_the_rate_allows(times, rate):
    kept = taken(TopicRule("/a", rate=rate), times)
    for first in range(len(kept)):
        for last in range(first, len(kept)):
            seconds = (kept[last] - kept[first]) / S
            assert last - first + 1 <= rate * seconds + 1.5 + 1e-6


def test_a_clock_that_steps_back_does_not_silence_a_topic():
    times = [100 * S, 101 * S, 1 * S, 2 * S, 3 * S]
    assert taken(TopicRule("/a", rate=1), times) == times


def test_a_moment_is_the_first_message_at_it_or_after():
    assert taken(TopicRule("/a", at_ns=35 * S // 10 + 1), TEN_HZ) == [36 * S // 10]
    assert taken(TopicRule("/a", at_ns=35 * S // 10), TEN_HZ) == [35 * S // 10]
    assert taken(TopicRule("/a", at_ns=100 * S), TEN_HZ) == []


def test_once_is_the_first_message():
    assert taken(TopicRule("/a", once=True), TEN_HZ) == [0]
    assert taken(TopicRule("/a", once=True, from_ns=S), TEN_HZ) == [S]


def test_a_period_includes_its_beginning_and_not_its_end():
    assert taken(TopicRule("/a", from_ns=S, until_ns=2 * S), TEN_HZ) == TEN_HZ[10:20]
    assert taken(TopicRule("/a", from_ns=S, for_ns=2 * S), TEN_HZ) == TEN_HZ[10:30]
    assert taken(TopicRule("/a", for_ns=2 * S), TEN_HZ[5:]) == TEN_HZ[5:25]
    assert taken(TopicRule("/a", until_ns=S), TEN_HZ) == TEN_HZ[:10]
    assert taken(TopicRule("/a", from_ns=S, for_ns=5 * S, until_ns=2 * S), TEN_HZ) == TEN_HZ[10:20]


def test_a_rate_within_a_period():
    assert taken(TopicRule("/a", from_ns=S, for_ns=2 * S, rate=1), TEN_HZ) == [S, 2 * S]


def test_what_was_due_and_not_captured_stays_due():
    schedule = Schedule(TopicRule("/a", once=True))
    assert schedule.due(1)  # could not be decoded
    assert schedule.due(2)
    schedule.captured(2)
    assert not schedule.due(3)


@pytest.mark.parametrize(
    ("pattern", "name", "matches"),
    [
        ("/robot_1/odom", "/robot_1/odom", True),
        ("robot_1/odom", "/robot_1/odom", True),
        ("/robot_1/odom", "/robot_1/odom2", False),
        ("/robot_*/odom", "/robot_12/odom", True),
        ("/robot_*/odom", "/robot_/odom", True),
        ("/*/odom", "/a/b/odom", False),
        ("/**/odom", "/a/b/odom", True),
        ("**/odom", "/a/b/odom", True),
        ("**/odom", "/odom", True),
        ("/robot_?/odom", "/robot_1/odom", True),
        ("/robot_?/odom", "/robot_12/odom", False),
        ("/robot_?odom", "/robot_/odom", False),
        ("/robot_[12]/odom", "/robot_2/odom", True),
        ("/robot_[1-3]/odom", "/robot_4/odom", False),
        ("**", "/anything/at/all", True),
        ("*", "/odom", True),
        ("*", "/a/odom", False),
        ("/a.b", "/axb", None),
        ("/a b", "", None),
        ("", "", None),
        ("/a//b", "", None),
        ("/a[", "", None),
        ("/a[]", "", None),
        ("/a[3-1]", "", None),
        ("/a{b}", "", None),
        ("/a\n", "", None),
        ("/é", "", None),
    ],
)
def test_patterns(pattern, name, matches):
    if matches is None:
        with pytest.raises(ValueError, match="is not a"):
            NamePattern(pattern)
    else:
        assert NamePattern(pattern).matches(name) is matches


def test_a_name_goes_before_patterns_and_patterns_in_order():
    rules = [(NamePattern(text), TopicRule(text)) for text in ("/a/*", "/**", "/a/b")]
    assert rule_for("/a/b", rules).topic == "/a/b"
    assert rule_for("/a/c", rules).topic == "/a/*"
    assert rule_for("/d", rules).topic == "/**"
    assert rule_for("/d", rules[:1]) is None

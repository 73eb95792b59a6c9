"""Field paths: what is one."""

from __future__ import annotations

import pytest

from rosbridge_eth.capture.rules import parse_path, parse_paths


def test_paths_are_steps():
    assert parse_path("pose.pose.position.x") == ("pose", "pose", "position", "x")
    assert parse_path("ranges[0]") == ("ranges", 0)
    assert parse_path("poses[*].position") == ("poses", "*", "position")


@pytest.mark.parametrize(
    "path", ["", ".", "a.", ".a", "a..b", "a b", "a[", "a[]", "a[-1]", "a[x]", "[0]", "a[0][1]", "1a", "a.*", "**", "é"]
)
def test_what_is_no_path_is_refused(path):
    with pytest.raises(ValueError, match="is not a field path"):
        parse_paths([path])


def test_an_array_is_selected_by_index_or_by_star():
    with pytest.raises(ValueError, match="choose one"):
        parse_paths(["a[*].x", "a[0].y"])
    assert parse_paths(["a[*].x", "a[0]", "a"]) == {"a": None}

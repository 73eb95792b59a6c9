"""features.md, beside this file, names tests that exist."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

TESTS = Path(__file__).parent
PAGE = (TESTS / "features.md").read_text("utf-8")
NAMED = re.findall(r"`([a-z0-9_/]+\.py)::(test_\w+)`", PAGE)


def test_every_row_names_a_test() -> None:
    heads = ("| what | test |", "| what went wrong | test |", "| ---")
    rows = [line for line in PAGE.splitlines() if line.startswith("| ") and not line.startswith(heads)]
    assert [row for row in rows if len(re.findall(r"::test_\w+`", row)) != 1] == []
    assert len(rows) == len(NAMED) > 150


@pytest.mark.parametrize(("file", "name"), NAMED)
def test_the_named_test_exists(file: str, name: str) -> None:
    assert re.search(rf"^def {name}\(", (TESTS / file).read_text("utf-8"), re.MULTILINE)

"""benchmarks/size.py counts what is code, in each language."""

from __future__ import annotations

from pathlib import Path

import pytest

from size import code_lines


@pytest.mark.parametrize(("name", "text", "lines"), [
    ("a.py", '"""What it is."""\n\n# a comment\nx = [\n    1,\n]\n', 3),
    ("a.js", "// a comment\n\n/* and\n   another */\nconst x = {\n  a: 1, // with one behind it\n}\n", 3),
    ("a.html", "<p>\n<script>\nlet x = 1\n</script>\n<script type='application/json'>\n{}\n</script>\n", 1),
    ("a.lua", "-- a comment\n\nlocal x = 1\nreturn x\n", 2),
])  # fmt: skip
def test_lines_without_comments_and_blank_ones_are_counted(name: str, text: str, lines: int, tmp_path: Path) -> None:
    (tmp_path / name).write_text(text)
    assert code_lines(tmp_path / name) == lines

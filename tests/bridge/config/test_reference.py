"""docs/configuration.md says what the models say, and its examples are valid."""

from __future__ import annotations

import re
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path

import pytest

from rosbridge_eth.config import parse_config
from rosbridge_eth.config.values import duration_text, parse_seconds, parse_size

DOCS = Path(__file__).parents[3] / "docs"
DOCUMENT = (DOCS / "configuration.md").read_text(encoding="utf-8")
SCRIPT = spec_from_file_location("make_configuration", DOCS / "make_configuration.py")
reference = module_from_spec(SCRIPT)
SCRIPT.loader.exec_module(reference)
ROOTS, described, tables = reference.ROOTS, reference.described, reference.tables


def test_the_reference_is_up_to_date():
    assert reference.rewritten(DOCUMENT) == DOCUMENT, "run: python docs/make_configuration.py"


@pytest.mark.parametrize("file", ROOTS)
def test_every_key_is_described_and_nothing_else(file):
    schema = ROOTS[file].model_json_schema()
    for section in [schema, *schema.get("$defs", {}).values()]:
        words = described(section)
        assert set(words) - {""} == set(section["properties"]), section["title"]
        assert all(len(text) > 4 for text in words.values())
    assert tables(file).count("#### ") == len(schema.get("$defs", {}))


@pytest.mark.parametrize(("seconds", "text"), [(1.0, "1s"), (0.05, "50ms"), (3600, "1h"), (90, "90s"), (604800, "7d")])
def test_durations_are_shown_as_they_are_written(seconds, text):
    assert duration_text(seconds) == text and parse_seconds(text) == seconds


@pytest.mark.parametrize(("size", "text"), [(16384, "16 KiB"), (2**30, "1 GiB"), (1000, "1000 B"), (1536, "1536 B")])
def test_sizes_are_shown_as_they_are_written(size, text):
    assert reference.size_text(size) == text and parse_size(text) == size


@pytest.mark.parametrize("heading", ROOTS)
def test_the_examples_are_valid(heading):
    part = DOCUMENT[DOCUMENT.index(f"`{heading}`") :]
    part = part[: part.index("<!-- end -->")]
    examples = re.findall(r"```toml\n(.*?)```", part, re.DOTALL)
    assert examples
    for example in examples:
        parse_config(ROOTS[heading], example, Path(heading))

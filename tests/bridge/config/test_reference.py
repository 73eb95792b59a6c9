"""docs/configuration.md says what the models say, and its examples are valid."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from rosbridge_eth.config import ReaderConfig, RobotConfig, ServerConfig, parse_config
from rosbridge_eth.config.models import ROOTS, Section
from rosbridge_eth.config.reference import rewritten, tables

DOCUMENT = (Path(__file__).parents[3] / "docs" / "configuration.md").read_text(encoding="utf-8")
MODELS = {"robot.toml": RobotConfig, "server.toml": ServerConfig, "reader.toml": ReaderConfig}


def test_the_reference_is_up_to_date():
    assert rewritten(DOCUMENT) == DOCUMENT, "run: python -m rosbridge_eth.config.reference docs/configuration.md"


def sections(model: type[Section]) -> set[type[Section]]:
    found = {model}
    for field in model.model_fields.values():
        names = set(re.findall(r"\w+Config", repr(field.annotation)))
        found |= {known for known in Section.__subclasses__() if known.__name__ in names}
    return found


@pytest.mark.parametrize("model", ROOTS)
def test_every_key_is_described(model):
    file = next(name for name, root in MODELS.items() if root is model)
    for section in sections(model):
        for name, field in section.model_fields.items():
            assert field.description, f"{section.__name__}.{name}"
            assert f"| `{field.alias or name}` |" in tables(file)


@pytest.mark.parametrize("heading", MODELS)
def test_the_examples_are_valid(heading):
    part = DOCUMENT[DOCUMENT.index(f"`{heading}`") :]
    part = part[: part.index("<!-- end -->")]
    examples = re.findall(r"```toml\n(.*?)```", part, re.DOTALL)
    assert examples
    for example in examples:
        parse_config(MODELS[heading], example, Path(heading))

"""The reference of every key, from the models: the lists in docs/configuration.md, which a test compares.

python docs/make_configuration.py     writes them anew, between their markers
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from inspect import cleandoc
from pathlib import Path
from typing import Any

from rosbridge_eth.config import ReaderConfig, RobotConfig, ServerConfig
from rosbridge_eth.config.values import duration_text

ROOTS = {"robot.toml": RobotConfig, "server.toml": ServerConfig, "reader.toml": ReaderConfig}


def size_text(size: int) -> str:
    """As a person writes it."""
    units = ((2**30, "GiB"), (2**20, "MiB"), (2**10, "KiB"), (1, "B"))
    return next(f"{size // unit} {name}" for unit, name in units if size % unit == 0)


_WORDS = {"string": "string", "integer": "whole number", "number": "number", "boolean": "true or false"}
_BOUNDS = {"exclusiveMinimum": "above", "minimum": "from", "exclusiveMaximum": "below", "maximum": "to"}
_AS_WRITTEN: dict[str, Callable[[Any], Any]] = {
    "size": size_text, "duration": duration_text, "address": lambda parts: f"{parts[0]}:{parts[1]}"
}


def tables(file: str) -> str:
    """The reference of one file in Markdown: its own keys, then the table of each of its sections."""
    schema = ROOTS[file].model_json_schema()
    parts = [_table(schema)]
    for name in dict.fromkeys(re.findall(r"#/\$defs/(\w+)\"", json.dumps(schema["properties"]))):
        section = schema["$defs"][name]
        purpose = described(section)[""]
        parts.append(f"#### `{_title(schema, section)}`\n\n{purpose}\n\n{_table(section)}")
    return "\n\n".join(parts) + "\n"


def described(section: dict[str, Any]) -> dict[str, str]:
    """The paragraphs of a section's docstring by key; the first, its purpose, under ""."""
    first, *others = (" ".join(text.split()) for text in cleandoc(section["description"]).split("\n\n"))
    return {"": first} | {key: text for key, _, text in (other.partition(": ") for other in others)}


def _title(schema: dict[str, Any], section: dict[str, Any]) -> str:
    """How a file opens this section."""
    if "kind" in section["properties"]:
        return f'[source] with kind = "{section["properties"]["kind"]["const"]}"'
    used = f'#/$defs/{section["title"]}"'
    key, value = next((key, value) for key, value in schema["properties"].items() if used in json.dumps(value))
    return f"[[{key}]]" if value.get("type") == "array" else f"[{key}]"


def _table(section: dict[str, Any]) -> str:
    lines, words = [], described(section)
    for key, value in section["properties"].items():
        if key == "kind":  # the heading has it
            continue
        default = "required" if key in section.get("required", ()) else _default(value)
        told = ", ".join(filter(None, (_kind(value), default)))
        lines.append(f"- `{key}` ({told}): {words[key]}")
    return "\n".join(lines)


def _kind(value: dict[str, Any]) -> str:
    if "const" in value or "enum" in value:
        return ", ".join(f'`"{choice}"`' for choice in value.get("enum", [value.get("const")]))
    if "anyOf" in value:
        return " or ".join(_kind(one) for one in value["anyOf"] if one.get("type") != "null")
    if value.get("type") == "array":
        tables = "names or tables" if value["items"].get("$ref", "").endswith("TopicConfig") else "tables"
        return tables if "$ref" in value["items"] else f"list of {_kind(value['items'])}"
    bounds = [f"{words} {value[name]}" for name, words in _BOUNDS.items() if name in value]
    return ", ".join([_WORDS.get(value.get("type", "table"), value.get("type", "table")), *bounds])


def _default(value: dict[str, Any]) -> str:
    default = value.get("default")
    if default in (None, []) or isinstance(default, dict):
        return ""
    return f"default `{json.dumps(_AS_WRITTEN.get(value.get('type', ''), lambda known: known)(default))}`"


def rewritten(document: str) -> str:
    """The document with every block between `<!-- FILE -->` and `<!-- end -->` made anew."""
    return re.sub(
        r"(<!-- (\S+\.toml) -->\n).*?(<!-- end -->)",
        lambda match: f"{match[1]}{tables(match[2])}{match[3]}",
        document,
        flags=re.DOTALL,
    )


if __name__ == "__main__":
    document = Path(__file__).with_name("configuration.md")
    document.write_text(rewritten(document.read_text(encoding="utf-8")), encoding="utf-8")

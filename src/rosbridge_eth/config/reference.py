"""The reference of every key, from the models: the tables of docs/configuration.md, which a test compares.

python -m rosbridge_eth.config.reference docs/configuration.md     writes them anew, between their markers
"""

from __future__ import annotations

import re
import sys
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Literal, Union, get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined

from rosbridge_eth.config.models import (
    SOURCE_KINDS,
    BatchConfig,
    CaptureConfig,
    ChainConfig,
    FundsConfig,
    LimitsConfig,
    ReaderConfig,
    RobotConfig,
    Section,
    ServerConfig,
    SpoolConfig,
    StoreConfig,
    StreamConfig,
    TopicConfig,
)
from rosbridge_eth.config.values import (
    Address,
    duration_text,
    parse_address,
    parse_duration,
    parse_path,
    parse_seconds,
    parse_size,
    size_text,
)
from rosbridge_eth.config.values import parse_time as parse_moment

_SECTIONS: dict[str, tuple[tuple[str, type[Section]], ...]] = {
    "robot.toml": (
        ("", RobotConfig),
        ("[[topics]]", TopicConfig),
        ("[capture]", CaptureConfig),
        *((f'[source] with kind = "{kind}"', model) for kind, model in SOURCE_KINDS.items()),
        ("[spool]", SpoolConfig),
        ("[stream]", StreamConfig),
    ),
    "server.toml": (
        ("", ServerConfig),
        ("[chain]", ChainConfig),
        ("[store]", StoreConfig),
        ("[batch]", BatchConfig),
        ("[funds]", FundsConfig),
        ("[limits]", LimitsConfig),
    ),
    "reader.toml": (("", ReaderConfig),),
}
_WORDS = {
    parse_duration: "duration",
    parse_seconds: "duration",
    parse_moment: "time",
    parse_size: "size",
    parse_address: "address",
    parse_path: "path",
}


def tables(file: str) -> str:
    """The reference of one file in Markdown."""
    parts = []
    for title, model in _SECTIONS[file]:
        lines = [f"#### `{title}`", "", " ".join((model.__doc__ or "").split()), ""] if title else []
        lines += ["| key | value | default | |", "| --- | --- | --- | --- |"]
        for name, field in model.model_fields.items():
            cells = (f"`{field.alias or name}`", _kind(field), _default(field), field.description or "")
            lines.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
        parts.append("\n".join(lines))
    return "\n\n".join(parts) + "\n"


def rewritten(document: str) -> str:
    """The document with every block between `<!-- FILE -->` and `<!-- end -->` made anew."""
    return re.sub(
        r"(<!-- (\S+\.toml) -->\n).*?(<!-- end -->)",
        lambda match: f"{match[1]}{tables(match[2])}{match[3]}",
        document,
        flags=re.DOTALL,
    )


def _kind(field: FieldInfo) -> str:
    bounds = []
    for constraint in field.metadata:
        for name, words in (("gt", "above"), ("ge", "from"), ("lt", "below"), ("le", "to")):
            value = getattr(constraint, name, None)
            if value is not None:
                bounds.append(f"{words} {_bound(value, _word(field))}")
    kind = _word(field) or _type(field.annotation)
    return ", ".join([kind, *bounds])


def _bound(value: Any, word: str) -> str:
    if word == "size":
        return size_text(value)
    if word == "duration":
        return duration_text(value)
    return "2^63" if value == 2**63 else "2^32" if value == 2**32 else str(value)


def _word(field: FieldInfo) -> str:
    for constraint in field.metadata:
        word = _WORDS.get(getattr(constraint, "func", None))  # type: ignore[arg-type]
        if word:
            return word
    return _word_in(field.annotation)


def _word_in(annotation: Any) -> str:
    for argument in get_args(annotation):
        word = _WORDS.get(getattr(argument, "func", None))  # type: ignore[arg-type]
        if word:
            return word
        if get_origin(annotation) in (Union, UnionType) and (word := _word_in(argument)):
            return word
    return ""


def _type(annotation: Any) -> str:
    origin, arguments = get_origin(annotation), get_args(annotation)
    if origin is Literal:
        return ", ".join(f'`"{value}"`' for value in arguments)
    if origin is list:
        inner = _word_in(arguments[0]) or _type(arguments[0])
        return f"list of {inner}" + ("" if inner.endswith(("s", "`")) else "s")
    if origin in (Union, UnionType):
        kinds = [_type(argument) for argument in arguments if argument is not NoneType]
        return " or ".join(dict.fromkeys(kinds))
    if arguments:
        return _type(arguments[0])
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return "name or table" if annotation is TopicConfig else "table"
    return {bool: "true or false", int: "whole number", float: "number", str: "string"}.get(annotation, "value")


def _default(field: FieldInfo) -> str:
    value = field.default
    if value is PydanticUndefined:
        return "required"
    if value is None or isinstance(value, Section):
        return ""
    word = _word(field)
    if word == "duration":
        seconds = value if isinstance(value, float) else value / 1e9
        return f'`"{duration_text(seconds)}"`'
    if word == "size":
        return f'`"{size_text(value)}"`'
    if isinstance(value, bool):
        return f"`{str(value).lower()}`"
    if isinstance(value, str | Address):
        return f'`"{value}"`'
    if isinstance(value, list):
        return "`[" + ", ".join(f'"{item}"' for item in value) + "]`"
    return f"`{value}`"


def main() -> None:
    """Rewrite the documents named on the command line."""
    for name in sys.argv[1:]:
        path = Path(name)
        path.write_text(rewritten(path.read_text(encoding="utf-8")), encoding="utf-8")


if __name__ == "__main__":
    main()

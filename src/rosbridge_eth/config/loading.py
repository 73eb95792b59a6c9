"""From a TOML file to a checked configuration, or to a sentence that says what to change.

Every problem of a file is told at once, each with key, what was given and what is allowed.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any, TypeVar

from pydantic import ValidationError
from pydantic_core import ErrorDetails

from rosbridge_eth.config.models import SOURCE_KINDS, ReaderConfig, RobotConfig, Section, ServerConfig
from rosbridge_eth.errors import ConfigError

_Config = TypeVar("_Config", bound=Section)


def load_robot_config(path: Path) -> RobotConfig:
    """robot.toml. Raises ConfigError."""
    return parse_config(RobotConfig, _read(path, 'topics = ["/robot_1/odom"]'), path)


def load_server_config(path: Path) -> ServerConfig:
    """server.toml. Raises ConfigError."""
    return parse_config(ServerConfig, _read(path, 'listen = "0.0.0.0:7410"'), path)


def load_reader_config(path: Path) -> ReaderConfig:
    """reader.toml. Raises ConfigError."""
    return parse_config(ReaderConfig, _read(path, 'contract = "0x..."'), path)


def parse_config(model: type[_Config], text: str, file: Path) -> _Config:
    """The configuration in `text`; `file` is named in errors, and relative paths start at its folder."""
    try:
        values = tomllib.loads(text)
    except (ValueError, RecursionError) as error:  # also of a number with more digits than Python reads
        raise ConfigError(f"{file} is not TOML: {_decapitalised(str(error))}") from None
    try:
        return model.model_validate(values, context={"folder": file.parent})
    except ValidationError as error:
        problems = "; ".join(_problem(detail) for detail in error.errors(include_url=False))
        raise ConfigError(f"{file}: {problems}") from None


def reread(running: _Config, new: _Config, keys: Collection[str]) -> tuple[_Config, str]:
    """The configuration of a running process after a reload: these keys are as in `new`; and a sentence about it."""
    kept = running.model_copy(update={key: getattr(new, key) for key in keys})
    waits = [key for key in type(running).model_fields if getattr(new, key) != getattr(kept, key)]
    rest = f"; changed, but not before the next start: {', '.join(waits)}" if waits else ""
    return kept, f"reloaded: {', '.join([*keys, 'readers'])}{rest}"


def _read(path: Path, example: str) -> str:
    try:
        return path.read_bytes().decode("utf-8-sig")  # some editors begin every file with a byte order mark
    except FileNotFoundError:
        raise ConfigError(f"{path} does not exist; create it, for instance with the line {example}") from None
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path} is not UTF-8 (byte {error.start})") from None
    except OSError as error:
        raise ConfigError(f"{path} cannot be read: {error.strerror}") from error


# Sentences


def _problem(detail: ErrorDetails) -> str:
    path = detail["loc"]
    if path[:1] == ("source",):
        path = path[:1] + path[2:]  # without the kind that pydantic puts there
    key = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in path).removeprefix(".")
    match detail["type"]:
        case "extra_forbidden":
            return f"unknown key {key!r}; docs/configuration.md has every key"
        case "missing":
            return f"{key} is missing"
        case "union_tag_not_found" | "union_tag_invalid":
            return f"{key} needs a kind: {', '.join(map(repr, SOURCE_KINDS))}"
        case "value_error":
            # A validator of ours: its text continues a sentence that begins with the key, or stands for itself.
            words = str(detail["ctx"]["error"])
            return f"{key or 'it'} {words}" if re.match(r"(is|has|names|ends) ", words) else f"{key}: {words}"
    return f"{key} is {_shown(detail['input'])}; {_decapitalised(detail['msg'])}"


def _shown(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, Mapping):
        return "a table"
    words = repr(value)
    return words if len(words) <= 60 else words[:57] + "..."


def _decapitalised(sentence: str) -> str:
    return sentence[:1].lower() + sentence[1:]

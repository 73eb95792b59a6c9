"""From a TOML file to a checked configuration, or to a sentence that says what to change.

Every problem of a file is told at once, each with line, key, what was given and
what is allowed.
"""

from __future__ import annotations

import difflib
import re
import tomllib
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar, get_args

from pydantic import ValidationError
from pydantic_core import ErrorDetails

from rosbridge_eth.config.models import SOURCE_KINDS, ReaderConfig, RobotConfig, Section, ServerConfig
from rosbridge_eth.errors import ConfigError

_Config = TypeVar("_Config", bound=Section)
MAX_FILE = 1 << 20
MAX_PROBLEMS = 8


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
        problems = [_problem(model, detail, text) for detail in error.errors(include_url=False)]
        shown = "; ".join(problems[:MAX_PROBLEMS])
        more = f"; and {len(problems) - MAX_PROBLEMS} more" if len(problems) > MAX_PROBLEMS else ""
        raise ConfigError(f"{file}: {shown}{more}") from None


def reread(running: _Config, new: _Config, keys: Collection[str]) -> tuple[_Config, str]:
    """What a process that goes by `running` goes by after it has read `new`: these keys of it; and a sentence."""
    kept = running.model_copy(update={key: getattr(new, key) for key in keys})
    waits = [key for key in type(running).model_fields if getattr(new, key) != getattr(kept, key)]
    rest = f"; what changed besides holds from the next start on: {', '.join(waits)}" if waits else ""
    return kept, f"taken up: {', '.join(keys)}{rest}"


def _read(path: Path, example: str) -> str:
    try:
        size = path.stat().st_size
        if size > MAX_FILE:
            raise ConfigError(f"{path} has {size} bytes; a configuration has at most {MAX_FILE}")
        return path.read_bytes().decode("utf-8-sig")  # some editors begin every file with a byte order mark
    except FileNotFoundError:
        raise ConfigError(f"{path} does not exist; create it, for instance with the line {example}") from None
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path} is not UTF-8 (byte {error.start})") from None
    except OSError as error:
        raise ConfigError(f"{path} cannot be read: {error.strerror}") from error


# Sentences

_EXPECTED = {
    "string_type": "a string in quotes", "int_type": "a whole number", "int_from_float": "a whole number",
    "float_type": "a number", "finite_number": "a finite number", "bool_type": "true or false",
    "list_type": "a list in [ ]", "dict_type": "a table", "model_type": "a table",
    "greater_than": "more than {gt}", "greater_than_equal": "at least {ge}",
    "less_than": "less than {lt}", "less_than_equal": "at most {le}",
}  # fmt: skip
REMOVED = {
    "delivery": "every record is kept in the log; `rate` makes fewer of them",
    "acknowledge": "every chunk is kept until it is confirmed on the chain",
    "stream": "a new stream begins at every start, and each chunk has a key of its own; [log] has its period",
    "commit": "[log] period says what a power cut costs",
    "from_block": "a robot's log is read from its registration on",
    "max_records": "max_size bounds it",
    "batch": "the submitter fills transactions by itself; a robot's [log] period makes chunks larger",
}
"""Keys of the first edition, and what does their work now."""


def _problem(model: type[Section], detail: ErrorDetails, text: str) -> str:
    location = _without_tags(detail["loc"])
    key = _key(location)
    kind, given, context = detail["type"], detail["input"], detail.get("ctx", {})
    if kind == "extra_forbidden":
        sentence = _unknown(model, detail["loc"])
    elif kind == "missing":
        sentence = f"{key} is missing"
    elif kind == "literal_error":
        allowed = re.findall(r"'(.*?)'", context["expected"])
        sentence = f"{key} is {_shown(given)}; {_choose(given, allowed)}"
    elif kind == "union_tag_not_found":
        sentence = f"{key} has no kind; {_choose(None, SOURCE_KINDS)}"
    elif kind == "union_tag_invalid":
        sentence = f"{key} has kind {given['kind']!r}; {_choose(given['kind'], SOURCE_KINDS)}"
    elif kind == "model_attributes_type":
        sentence = f'{key} is {_shown(given)}; write a table, such as [source] with kind = "bag"'
    elif kind in _EXPECTED:
        topic = len(location) == 2 and location[0] == "topics"
        expected = "a name in quotes, or a table" if topic else _EXPECTED[kind].format(**context)
        sentence = f"{key} is {_shown(given)}; it should be {expected}"
    elif kind == "too_short":
        sentence = f"{key} is empty"
    elif kind == "value_error":
        # A validator of ours: its text continues a sentence that begins with the key, or stands for itself.
        words = str(context["error"])
        sentence = f"{key or 'it'} {words}" if re.match(r"(is|has|names|ends) ", words) else f"{key}: {words}"
    else:
        sentence = f"{key} is {_shown(given)}; {_decapitalised(detail['msg'])}"
    line = _line(text, location)
    return f"line {line}: {sentence}" if line and location else sentence


def _choose(given: Any, allowed: Collection[str]) -> str:
    near = difflib.get_close_matches(str(given), allowed, 1)
    hint = f"; did you mean {near[0]!r}?" if near else ""
    return f"allowed: {', '.join(map(repr, allowed))}{hint}"


def _unknown(model: type[Section], location: Sequence[str | int]) -> str:
    name, table, holder = str(location[-1]), _key(_without_tags(location[:-1])), model
    if len(location) > 1:  # no table holds another, but for those of a list, and a source is of one kind
        of_field = _models_in(model.model_fields[str(location[0])].annotation)
        holder = SOURCE_KINDS[str(location[1])] if location[0] == "source" else of_field[0]
    allowed = sorted(field.alias or key for key, field in holder.model_fields.items())
    near = difflib.get_close_matches(name, allowed, 1)
    if name in REMOVED:
        hint = f"it is gone since the second edition: {REMOVED[name]}"
    else:
        hint = f"did you mean {near[0]!r}?" if near else f"allowed: {', '.join(allowed)}"
    return f"unknown key {name!r}{f' in {table}' if table else ''}; {hint}"


def _without_tags(location: Sequence[str | int]) -> tuple[str | int, ...]:
    """The path of keys; pydantic puts the kind of a source between `source` and its keys."""
    if len(location) > 1 and location[0] == "source" and location[1] in SOURCE_KINDS:
        return (location[0], *location[2:])
    return tuple(location)


def _key(location: Sequence[str | int]) -> str:
    """`topics[1].rate`."""
    words = ""
    for part in location:
        words += f"[{part}]" if isinstance(part, int) else f".{part}" if words else part
    return words


def _models_in(annotation: Any) -> list[type[Section]]:
    if isinstance(annotation, type) and issubclass(annotation, Section):
        return [annotation]
    return [model for argument in get_args(annotation) for model in _models_in(argument)]


_HEADER = re.compile(r"\s*(\[\[?)\s*([A-Za-z0-9_\-.\s]+?)\s*\]")
_DOT = re.compile(r"\s*\.\s*")
_SETTING = re.compile(r"\s*([A-Za-z0-9_\-]+(?:\s*\.\s*[A-Za-z0-9_\-]+)*)\s*=")


def _line(text: str, location: tuple[str | int, ...]) -> int | None:
    """The line on which the key at `location` is set, or of the nearest table or key around it that is found."""
    lines: dict[tuple[str | int, ...], int] = {}
    counts: Counter[tuple[str | int, ...]] = Counter()
    table: tuple[str | int, ...] = ()
    for number, line in enumerate(text.splitlines(), 1):
        if header := _HEADER.match(line):
            path = table = tuple(re.split(_DOT, header[2]))
            if header[1] == "[[":
                counts[path] += 1
                path = table = (*path, counts[path] - 1)
        elif setting := _SETTING.match(line):
            path = (*table, *re.split(_DOT, setting[1]))
        else:
            continue
        for end in range(1, len(path) + 1):
            lines.setdefault(path[:end], number)
    return next((lines[location[:end]] for end in range(len(location), 0, -1) if location[:end] in lines), None)


def _shown(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, Mapping):
        return "a table"
    words = repr(value)
    return words if len(words) <= 60 else words[:57] + "..."


def _decapitalised(sentence: str) -> str:
    return sentence[:1].lower() + sentence[1:]

"""Durations, times, sizes and addresses as a person writes them in TOML.

    duration   "250ms"  "2s"  "5m"  "1h30m"  "24h"  "7d"
    time       "2026-11-21T10:00:00Z", quoted or not (RFC 3339; the offset is required)
    size       "64 MiB"  "500 kB"  or a number of bytes
    address    "192.0.2.7:7410"  "robots.example:7410"  "[2001:db8::7]:7410"

Each parser takes the value TOML gave and raises ValueError with the rest of a sentence that begins with the key.
`Written` makes a parser, its bounds and its word in the reference one annotation of a model's field.
"""

from __future__ import annotations

import re
import socket
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from ipaddress import ip_address
from pathlib import Path
from typing import Annotated, Any, NamedTuple

from pydantic import BeforeValidator, GetCoreSchemaHandler, GetJsonSchemaHandler, ValidationInfo, WithJsonSchema
from pydantic_core import CoreSchema, core_schema

_UNITS_NS = {"ms": 10**6, "s": 10**9, "m": 60 * 10**9, "h": 3600 * 10**9, "d": 86400 * 10**9}
_PART = re.compile(r"(\d{1,9}(?:\.\d{1,9})?) ?(ms|s|m|h|d)", re.ASCII)
_DURATION = re.compile(rf"{_PART.pattern}(?: ?{_PART.pattern})*", re.ASCII)
_SIZES = {"B": 1, "kB": 10**3, "MB": 10**6, "GB": 10**9, "KiB": 2**10, "MiB": 2**20, "GiB": 2**30}
_SIZE = re.compile(r"(\d{1,12}(?:\.\d{1,6})?) ?(B|kB|MB|GB|KiB|MiB|GiB)", re.ASCII)
_LABEL = r"[A-Za-z0-9_\-]{1,63}"  # of a name; a longer or an empty one is a defect to the resolver, not an answer
_HOST_PORT = re.compile(rf"(\[[0-9A-Fa-f:.]+\]|(?=.{{1,253}}:){_LABEL}(?:\.{_LABEL})*\.?):(\d{{1,5}})", re.ASCII)
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)


def parse_duration(value: Any) -> int:
    """Nanoseconds."""
    if not isinstance(value, str) or not _DURATION.fullmatch(value):
        raise ValueError(f'is {value!r}; write a duration with its unit, such as "250ms", "2s", "5m", "1h30m", "7d"')
    total = round(sum(float(number) * _UNITS_NS[unit] for number, unit in _PART.findall(value)))
    if not total:
        raise ValueError(f"is {value!r}; it has to be longer than nothing")
    return total


def parse_seconds(value: Any) -> float:
    """As parse_duration, in seconds."""
    return parse_duration(value) / 1e9


def parse_time(value: Any) -> int:
    """Nanoseconds since 1970."""
    try:
        moment = datetime.fromisoformat(str(value))
    except ValueError:
        raise ValueError(f'is {str(value)!r}; write a time such as "2026-11-21T10:00:00Z"') from None
    if moment.tzinfo is None:
        raise ValueError(f'is {str(value)!r}; say in which time zone: end it with "Z" or an offset such as "+08:00"')
    passed = moment - _EPOCH
    return (passed.days * 86400 + passed.seconds) * 10**9 + passed.microseconds * 1000


def parse_size(value: Any) -> int:
    """Bytes."""
    if isinstance(value, int) and not isinstance(value, bool) and value > 0:
        return value
    match = _SIZE.fullmatch(value) if isinstance(value, str) else None
    size = round(float(match[1]) * _SIZES[match[2]]) if match else 0
    if size < 1:
        raise ValueError(f'is {value!r}; write a size such as "64 MiB", "500 kB" or a number of bytes')
    return size


class Address(NamedTuple):
    """Where a socket listens or connects to. `host` has no brackets."""

    host: str
    port: int

    def __str__(self) -> str:
        return f"[{self.host}]:{self.port}" if ":" in self.host else f"{self.host}:{self.port}"

    def next(self, count: int) -> Address:
        """The same host, `count` ports on."""
        return self._replace(port=self.port + count if self.port else 0)

    @property
    def nowhere(self) -> bool:
        """Whether nothing can be sent there: port 0, or any address (0.0.0.0 or ::, in whatever form)."""
        try:
            if ":" in self.host:
                return self.port == 0 or int(ip_address(self.host)) in (0, 0xFFFF << 32)
            return self.port == 0 or socket.inet_aton(self.host) == bytes(4)  # of "0" and "0x0", too
        except (OSError, ValueError):  # a name
            return False

    @property
    def family(self) -> socket.AddressFamily:
        """Of a socket that listens there."""
        return socket.AF_INET6 if ":" in self.host else socket.AF_INET


def parse_address(value: Any) -> Address:
    """Host and port; port 0 lets the system choose."""
    match = _HOST_PORT.fullmatch(value) if isinstance(value, str) else None
    if match is None or int(match[2]) > 65535:
        raise ValueError(f'is {value!r}; write HOST:PORT, such as "192.0.2.7:7410" or "[2001:db8::7]:7410"')
    return Address(match[1].strip("[]"), int(match[2]))


def counted(count: int, what: str) -> str:
    """`1 chunk`, `2,000 chunks`."""
    return f"{count:,} {what}{'' if count == 1 else 's'}"


def duration_text(seconds: float) -> str:
    """As a person writes it."""
    units = ((86_400, "d"), (3600, "h"), (60, "m"), (1, "s"))
    fits = [f"{round(seconds / unit)}{name}" for unit, name in units if seconds >= unit and seconds % unit == 0]
    return fits[0] if fits else f"{round(seconds * 1000)}ms"


def time_text(nanoseconds: int) -> str:
    """As a person writes it, to the millisecond."""
    moment = _EPOCH + timedelta(milliseconds=nanoseconds // 10**6)
    return moment.isoformat(timespec="milliseconds").replace("+00:00", "Z")


@dataclass(frozen=True, slots=True)
class Written:
    """How pydantic reads a value with a unit: its word in the reference, its parser, bounds as a person writes them."""

    word: str
    parse: Callable[[Any], Any]
    low: str = ""
    high: str = ""

    def read(self, value: Any) -> Any:
        found = self.parse(value)
        if self.low and found < self.parse(self.low):
            raise ValueError(f"is {value!r}; it should be at least {self.low!r}")
        if self.high and found > self.parse(self.high):
            raise ValueError(f"is {value!r}; it should be at most {self.high!r}")
        return found

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        return core_schema.no_info_plain_validator_function(self.read)

    def __get_pydantic_json_schema__(self, schema: CoreSchema, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        bounds = {"minimum": self.low, "maximum": self.high}
        return {"type": self.word, **{name: bound for name, bound in bounds.items() if bound}}


def seconds(low: str = "", high: str = "") -> Written:
    """A duration in seconds."""
    return Written("duration", parse_seconds, low, high)


def size(low: str = "1 B", high: str = "") -> Written:
    """A number of bytes."""
    return Written("size", parse_size, low, high)


def to_path(value: Any, info: ValidationInfo) -> Path:
    """A relative path starts at the folder of the configuration file."""
    if not isinstance(value, str) or not value or "\0" in value:
        raise ValueError(f"is {value!r}; write a path in quotes")
    folder = info.context.get("folder") if info.context else None
    path = Path(value).expanduser()
    return folder / path if isinstance(folder, Path) else path


DurationNs = Annotated[int, Written("duration", parse_duration)]
TimeNs = Annotated[int, Written("time", parse_time)]
HostPort = Annotated[Address, Written("address", parse_address)]
FilePath = Annotated[Path, BeforeValidator(to_path), WithJsonSchema({"type": "path"})]
"""A relative path starts at the folder of the configuration file."""

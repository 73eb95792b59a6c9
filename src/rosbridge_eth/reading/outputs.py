"""What a reader makes of proven records: JSON lines, a table, a bag that ROS tools open, a picture.

Each output takes records one by one, so that one pass over a log fills them all, and stands under its name only when
it is whole; or it grows there (.mcap), and others can read what there is after every `flush`.

A bag says no more than what was recorded:

    on topic          type             what
    TOPIC             the original     records of which every field was captured
    TOPIC/partial     the original     records of which fields were not captured; these are zero
    TOPIC/json        std_msgs/String  records of which no message can be made: the record's JSON

The definitions of the types come from the log itself; a ROS 2 bag has one of each type, the first, and records under
another are JSON. A ROS 1 record in a ROS 2 bag is a message, too, and the other way round.
"""

from __future__ import annotations

import csv
import json
import os
import re
import struct
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import lru_cache
from importlib import import_module
from importlib.util import find_spec
from itertools import chain, islice
from math import isfinite
from pathlib import Path
from typing import Any, Final, TypeAlias

import numpy

from rosbridge_eth.capture import Restoration, TypeLine, Wire, decoder_for_known
from rosbridge_eth.capture.restoration import NOT_FINITE
from rosbridge_eth.config.values import time_text
from rosbridge_eth.errors import ConfigError, SourceError, VerificationError
from rosbridge_eth.reading.verdict import printable, shown
from rosbridge_eth.reading.verify import MAX_TYPES, ProvenRecord

MAX_COLUMNS: Final = 4_096
MAX_NAME: Final = 255
"""Characters of a column's name; what has more is left out. Else a path could stand again for each field below it."""
MAX_TRACKS: Final = 32
"""Topics in one picture; what is on further ones is left out."""
MAX_POINTS: Final = 1 << 13
_BATCH: Final = 4_096  # rows of a table that are made at once
_FARTHEST: Final = 1e12
"""Metres from the origin; a position beyond is no position."""
_HIGHEST: Final = 1e300
"""Of a number that is drawn; matplotlib needs some room above."""
_STRING: Final = "std_msgs/msg/String"
_MCAP_END: Final = struct.pack("<BQI BQQQI", 0x0F, 4, 0, 0x02, 20, 0, 0, 0) + b"\x89MCAP0\r\n"
"""Data End without a checksum, Footer without a summary, magic (mcap.dev/spec)."""
_LAST_TIME: Final = {Wire.ROS1: 2**32 * 10**9 - 1, Wire.CDR: 2**63 - 1}
_BAGS: Final = "NAME.bag (ROS 1), NAME.mcap or NAME.db3 (ROS 2, one file), or NAME (ROS 2, a folder)"


# JSON lines


def proof(record: ProvenRecord) -> dict[str, Any]:
    """Which record this is and where the chain has it."""
    place = record.place
    return {
        "chunk": place.chunk, "record": record.number, "stream": place.stream.hex(), "number": place.number,
        "digest": place.digest.hex(), "sealed": time_text(place.sealed_ms * 10**6), "block": place.block,
        "block_time": None if place.block_time is None else time_text(place.block_time * 10**9),
        "transaction": "0x" + place.transaction.hex(),
    }  # fmt: skip


def json_line(record: ProvenRecord) -> str:
    """The captured line as the robot wrote it, with `proof` as its last member; nothing in it acts on a terminal."""
    line = printable(record.line.decode())
    return f'{line[:-1]},"proof":{json.dumps(proof(record), separators=(",", ":"))}}}\n'


# Files that stand under their name when they are whole


@contextmanager
def _whole(path: Path) -> Iterator[Path]:
    """A path to write to; what is there afterwards takes the place of `path`, unless something failed."""
    with tempfile.TemporaryDirectory(dir=path.parent, prefix=f".{path.name}.") as folder:
        within = Path(folder, path.name)
        yield within
        within.rename(path)


def _new(path: Path, kind: str) -> None:
    if path.exists():
        raise ConfigError(f"{path} is there already; name a {kind} that is not")
    if not path.parent.is_dir():
        raise ConfigError(f"{path.parent} is no folder; make it first")


# Tables


def check_table(path: Path) -> None:
    """ConfigError unless a table can be written there."""
    if path.suffix not in (".csv", ".parquet"):
        raise ConfigError(f"{path}: a table is a .csv or a .parquet file")
    if path.suffix == ".parquet" and not find_spec("pyarrow"):
        raise ConfigError(f"{path}: a Parquet file takes pyarrow: pip install 'pysmcrypto[table]', or name a .csv file")
    _new(path, "table")


_FIXED: Final = (
    "topic", "type", "source", "received_ns", "captured_ns", "clock", "stream", "number", "chunk", "record", "block",
    "transaction",
)
"""Columns of every table; after them those of the messages' fields, a dot between the levels.

A field that has the name of one of these begins with a dot.
"""


class Table:
    """Rows wait in a file until all columns, and what kinds of values they have, are known."""

    def __init__(self, rows: Any) -> None:
        self._waiting = rows
        self._columns: dict[str, set[str]] = {name: set() for name in _FIXED}

    def write(self, record: ProvenRecord) -> None:
        content = record.content
        known = content._asdict() | {"type": content.type_name} | proof(record)
        row = {name: known[name] for name in _FIXED}
        for name, value in flattened(content.data, ""):
            column = printable(name)
            if len(column) <= MAX_NAME:
                row[f".{column}" if column.lstrip(".") in _FIXED else column] = value
        for column, value in row.items():
            if column in self._columns or len(self._columns) < MAX_COLUMNS + len(_FIXED):
                self._columns.setdefault(column, set()).add(_kind(value))
        self._waiting.write(json.dumps(row) + "\n")

    def _rows(self) -> Iterator[list[Any]]:
        """The cells of each row, one for each column."""
        self._waiting.seek(0)
        for line in self._waiting:
            row = json.loads(line)
            yield [row.get(name) for name in self._columns]

    def write_csv(self, path: Path) -> None:
        with path.open("w", encoding="utf-8", newline="") as file:
            writer = csv.writer(file, lineterminator="\n")
            for cells in chain([self._columns], self._rows()):
                writer.writerow(map(_cell, cells))

    def write_parquet(self, path: Path) -> None:
        pyarrow = import_module("pyarrow")
        types = [_arrow(pyarrow, name, kinds) for name, kinds in self._columns.items()]
        schema = pyarrow.schema([(name, type_) for name, (type_, _) in zip(self._columns, types, strict=True)])
        rows = self._rows()
        with import_module("pyarrow.parquet").ParquetWriter(path, schema, compression="zstd") as writer:
            while batch := list(islice(rows, _BATCH)):
                columns = [
                    [None if cell is None else value(cell) for cell in cells]
                    for (_, value), cells in zip(types, zip(*batch, strict=True), strict=True)
                ]
                writer.write_table(pyarrow.table(columns, schema))


def flattened(data: Mapping[str, Any], path: str) -> Iterator[tuple[str, Any]]:
    """The fields that are no messages, a dot between the levels; a path beyond MAX_NAME characters goes no deeper."""
    for name, value in data.items():
        if isinstance(value, dict) and len(path) + len(name) <= MAX_NAME:
            yield from flattened(value, f"{path}{name}.")
        else:
            yield path + name, value


def _kind(value: Any) -> str:
    """Of a cell: bool, int, float, nan (text that may stand for a float), text, list (of numbers), json."""
    if isinstance(value, list):
        return "list" if {*map(_kind, value)} <= _NUMBERS else "json"
    if isinstance(value, str):
        return "nan" if value in NOT_FINITE else "text"
    if type(value) is int:
        return "int" if -(2**63) <= value < 2**63 else "json"
    return {bool: "bool", float: "float"}.get(type(value), "json")


_NUMBERS: Final = {"int", "float", "nan"}


def _arrow(pyarrow: Any, name: str, kinds: set[str]) -> tuple[Any, Callable[[Any], Any]]:
    """The type of a column whose cells are of these kinds, and what makes its value of a cell."""
    if name in ("received_ns", "captured_ns"):
        return pyarrow.timestamp("ns", tz="UTC"), int
    if kinds == {"bool"}:
        return pyarrow.bool_(), bool
    if kinds == {"int"}:
        return pyarrow.int64(), int
    if kinds <= _NUMBERS:
        return pyarrow.float64(), float
    if kinds == {"list"}:
        return pyarrow.list_(pyarrow.float64()), lambda cell: list(map(float, cell))
    return pyarrow.string(), str if kinds <= {"text", "nan"} else json.dumps


_FORMULA: Final = re.compile(r"(^|[;,|])(?=\s*[=+\-@\uff1d\uff0b\uff0d\uff20])")
"""Where a spreadsheet may take text for a formula: at its beginning, also in full-width signs, and behind what another
country's spreadsheets divide cells by."""


def _cell(value: Any) -> Any:
    """Text without what acts on a terminal, and not to be taken for a formula by a spreadsheet."""
    if isinstance(value, list | dict):
        return json.dumps(value)
    if not isinstance(value, str) or value in NOT_FINITE:
        return value
    return _FORMULA.sub(r"\1'", printable(value))


@contextmanager
def table(path: Path) -> Iterator[Table]:
    """A row each record, a column each field that is no message; arrays as JSON in one cell, in Parquet as lists."""
    check_table(path)
    with _whole(path) as within, tempfile.TemporaryFile("w+", dir=within.parent) as rows:
        made = Table(rows)
        yield made
        (made.write_csv if path.suffix == ".csv" else made.write_parquet)(within)


# Bags


def check_bag(path: Path) -> Wire:
    """The wire format of a bag of this name: .bag is ROS 1; .mcap and .db3 are single files, no ending a folder.

    ConfigError for any other ending, and if the path exists.
    """
    if path.suffix not in ("", ".bag", ".mcap", ".db3"):
        raise ConfigError(f"{path}: a bag cannot be a {path.suffix} file; name it {_BAGS}")
    _new(path, "bag")
    return Wire.ROS1 if path.suffix == ".bag" else Wire.CDR


@contextmanager
def bag(path: Path, *, grows: bool = False) -> Iterator[Bag]:
    """A bag of the kind that `check_bag` finds the name to say. Messages bear the time at which they were received.

    grows: the file is there from the beginning; of bags, only an .mcap file can be read while it is written.
    """
    from rosbags import rosbag1, rosbag2

    wire = check_bag(path)
    with _whole(path) as within:
        if wire is Wire.ROS1:
            with rosbag1.Writer(within) as writer:
                yield Bag(writer, wire)
            return
        plugin = rosbag2.StoragePlugin.MCAP if path.suffix == ".mcap" else rosbag2.StoragePlugin.SQLITE3
        # A ROS 2 bag is written as a folder; its one storage file has the definitions too and stands by itself.
        folder = within.with_name("bag") if path.suffix else within
        with rosbag2.Writer(folder, version=9, storage_plugin=plugin) as two:
            if grows:
                storage: Any = two.storage
                os.link(storage.path, path)
            yield Bag(two, wire)
        if path.suffix:
            [storage] = folder.glob(f"*{path.suffix}")
            storage.rename(within)


class Bag:
    """Makes messages of records again and writes them as they come. whole, partial, as_json: how many, by topic."""

    def __init__(self, writer: Any, wire: Wire) -> None:
        self._writer, self._wire = writer, wire
        self._connections: dict[tuple[str, ...], Any] = {}
        self._definitions: dict[str, str] = {}  # of a ROS 2 bag, which has one of each type
        self._restoration = lru_cache(MAX_TYPES)(self._restoration_of)
        self._string: Any = self._restoration(_STRING, None)
        self.whole = self.partial = self.as_json = 0

    def flush(self) -> None:
        """Bring an MCAP file to an end, as one without a summary; what follows is written over that end."""
        storage = self._writer.storage
        if storage.chunk.msgs:
            storage.close_chunk()
        at = storage.bio.tell()
        storage.bio.write(_MCAP_END)
        storage.bio.flush()
        storage.bio.seek(at)

    def write(self, record: ProvenRecord) -> None:
        content = record.content
        topic, restoration = printable(content.topic) or "/", self._restoration(content.type_name, record.definition)
        try:
            if restoration is None:
                raise VerificationError(f"no message of {content.type_name} can be made here")
            message, missing = restoration.restore(content.data)
        except VerificationError:
            restoration = self._string
            message, _ = restoration.restore({"data": record.line.decode()})
            topic += "/json"
            self.as_json += 1
        else:
            topic += "/partial" if missing else ""
            self.partial += bool(missing)
            self.whole += not missing
        type_name, of = restoration.decoder.type_name, restoration.connection
        key = topic, type_name, of.get("md5sum", "")
        if key not in self._connections:
            self._connections[key] = self._writer.add_connection(topic, type_name, **of)
        time = max(0, min(content.received_ns, _LAST_TIME[self._wire]))
        self._writer.write(self._connections[key], time, restoration.decoder.encode(message))

    def _restoration_of(self, type_name: str, line: TypeLine | None) -> Restoration | None:
        """By the log's definition; without one, by the one that rosbags knows. None where no message can be made."""
        try:
            decoder = decoder_for_known(self._wire, type_name) if line is None else line.decoder()
            made = None if decoder is None else Restoration(decoder, self._wire)
        except (SourceError, VerificationError):
            return None
        if made is not None:
            known = made.connection.get("rihs01", "")
            if self._definitions.setdefault(made.decoder.type_name, known) != known:
                return None
        return made


# Pictures


def check_picture(path: Path) -> None:
    """ConfigError unless a picture can be drawn there."""
    if not find_spec("matplotlib"):
        raise ConfigError(f"{path}: a picture needs matplotlib: pip install 'pysmcrypto[plot]'")
    if path.suffix.lower() not in (".png", ".svg", ".pdf"):
        raise ConfigError(f"{path}: a picture is a .png, .svg or .pdf file")
    if not path.parent.is_dir():
        raise ConfigError(f"{path.parent} is no folder; make it first")


_Point: TypeAlias = tuple[float, float, float]


class _Points:
    """Any number of points as `most` of them: neighbours become one by `merge`, all over the length alike."""

    def __init__(self, merge: Callable[[_Point, _Point], _Point], most: int = MAX_POINTS) -> None:
        self._merge, self._most, self._each = merge, most, 1
        self.count, self.kept = 0, list[_Point]()

    def add(self, point: _Point) -> None:
        self.last = point
        if self.count % self._each:
            self.kept[-1] = self._merge(self.kept[-1], point)
        else:
            if len(self.kept) == self._most:
                self.kept = list(map(self._merge, self.kept[::2], self.kept[1::2]))
                self._each *= 2
            self.kept.append(point)
        self.count += 1


class Trajectory:
    """Where the robot was, as seen from above. tracks: of each topic that has positions, (received_ns, x, y)."""

    def __init__(self, most: int = MAX_POINTS) -> None:
        self._most = most
        self.tracks: dict[str, _Points] = {}

    def write(self, record: ProvenRecord) -> None:
        content = record.content
        point = _position(content.data)
        if point is not None and (content.topic in self.tracks or len(self.tracks) < MAX_TRACKS):
            track = self.tracks.setdefault(content.topic, _Points(lambda kept, _: kept, self._most))
            track.add((content.received_ns, *point))

    def draw(self, path: Path) -> int:
        """Draw, in the format of the name's ending; how many positions there are. Without any, the picture says so."""
        with _figure(path, 7, 6) as figure:
            if not self.tracks:
                figure.text(0.5, 0.5, "no positions in these records", ha="center", va="center")
                return 0
            axes = figure.add_subplot(aspect="equal", adjustable="datalim", xlabel="x in m", ylabel="y in m")
            axes.set_title("a dot is the beginning, a square the end", fontsize="small")
            for topic, points in self.tracks.items():
                times, xs, ys = zip(*sorted({*points.kept, points.last}), strict=True)
                seconds = (times[-1] - times[0]) / 1e9
                (line,) = axes.plot(xs, ys, label=f"{_label(topic)}: {points.count:,} positions, {seconds:,.1f} s")
                for at, marker in ((0, "o"), (-1, "s")):
                    axes.plot(xs[at], ys[at], marker=marker, color=line.get_color())
            axes.grid(alpha=0.3)
            axes.legend(loc="best", fontsize="small")
        return sum(points.count for points in self.tracks.values())


class Curves:
    """Numbers over time: an axis for each of the fields (`pose.pose.position.x`, `ranges[0]`), a curve each topic.

    curves: by field and topic; of (received_ns, lowest, highest), since a curve of very many values is drawn as the
    range between them.
    """

    def __init__(self, fields: Sequence[str]) -> None:
        """ConfigError for what names no field."""
        if wrong := [field for field in fields if not re.fullmatch(r"\w+(\[\d+\]|\.\w+)*", field)]:
            raise ConfigError(f"{wrong[0]} names no field; write it like pose.pose.position.x or ranges[0]")
        self._paths = {field: re.findall(r"\w+", field) for field in fields}
        self.curves: dict[tuple[str, str], _Points] = {}

    def write(self, record: ProvenRecord) -> None:
        for field_, path in self._paths.items():
            value = _at(record.content.data, path)
            key = field_, record.content.topic
            drawn = type(value) in (int, float, bool) and abs(value) <= _HIGHEST
            if drawn and (key in self.curves or len(self.curves) < MAX_TRACKS):
                curve = self.curves.setdefault(key, _Points(lambda a, b: (a[0], min(a[1], b[1]), max(a[2], b[2]))))
                curve.add((record.content.received_ns, float(value), float(value)))

    def draw(self, path: Path) -> int:
        """Draw, in the format of the name's ending; how many values there are."""
        with _figure(path, 9, 1.5 + 2.5 * len(self._paths)) as figure:
            every = figure.subplots(len(self._paths), sharex=True, squeeze=False)[:, 0]
            for axes, field_ in zip(every, self._paths, strict=True):
                for (_, topic), points in (item for item in self.curves.items() if item[0][0] == field_):
                    times = numpy.array([time for time, _, _ in points.kept for _ in range(2)], "datetime64[ns]")
                    values = [value for _, *both in points.kept for value in both]
                    label = f"{_label(topic)}: {points.count:,} values"
                    axes.plot(times, values, linewidth=1, label=label, marker="." if points.count == 1 else None)
                    axes.legend(loc="best", fontsize="small")
                axes.set_ylabel(shown(field_, 40))
                axes.grid(alpha=0.3)
            every[-1].set_xlabel("time of receipt, UTC")
        return sum(points.count for points in self.curves.values())


@contextmanager
def _figure(path: Path, width: float, height: float) -> Iterator[Any]:
    """An empty figure, inches, which is saved at the end. What a topic is called is not taken for a formula."""
    import matplotlib
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    check_picture(path)
    with matplotlib.rc_context({"text.parse_math": False, "text.usetex": False, "date.converter": "concise"}):
        figure = Figure(figsize=(width, height), layout="constrained")
        FigureCanvasAgg(figure)
        yield figure
        with _whole(path) as within:
            figure.savefig(within, format=path.suffix[1:].lower(), dpi=150)


def _position(data: Mapping[str, Any]) -> tuple[float, float] | None:
    """Of Odometry, PoseStamped, Pose, Point and what is built like them."""
    for path in (("pose", "pose", "position"), ("pose", "position"), ("position",), ("point",), ()):
        value = _at(data, path)
        if isinstance(value, dict) and _is_distance(value.get("x")) and _is_distance(value.get("y")):
            return float(value["x"]), float(value["y"])
    return None


def _at(value: Any, path: Sequence[str]) -> Any:
    """What is there in a record's data, or None; an array's element by its number."""
    for name in path:
        if isinstance(value, list):
            value = value[int(name)] if name.isdecimal() and int(name) < len(value) else None
        else:
            value = value.get(name) if isinstance(value, dict) else None
    return value


def _is_distance(value: Any) -> bool:
    return type(value) in (int, float) and abs(value) < _FARTHEST and isfinite(value)


def _label(topic: str) -> str:
    """In a legend; one that began with "_" would be left out."""
    return f"\u200b{shown(topic, 60)}"

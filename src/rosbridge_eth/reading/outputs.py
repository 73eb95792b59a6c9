"""What a reader makes of proven records: JSON lines, CSV, a bag that ROS tools open, a picture of the trajectory.

Each output takes records one by one, so that one pass over a log fills them all, and stands under its name only when
it is whole. A bag says no more than what was recorded:

    on topic          type             what
    TOPIC             the original     records of which every field was captured
    TOPIC/partial     the original     records of which fields were left out; these are zero
    TOPIC/json        std_msgs/String  records of which no message can be made: the record's JSON
    /rosbridge_eth/notes  std_msgs/String  once for each topic that is not whole: which fields are zero, or why JSON

The definitions of the types come from the log itself. A ROS 1 record in a ROS 2 bag is a message, too, and the other
way round.
"""

from __future__ import annotations

import csv
import json
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from math import isfinite
from pathlib import Path
from typing import Any, Final

from rosbridge_eth.capture import Restoration, TypeLine, Wire, decoder_for_known
from rosbridge_eth.config.values import time_text
from rosbridge_eth.errors import ConfigError, SourceError, VerificationError
from rosbridge_eth.reading.verdict import printable, shown
from rosbridge_eth.reading.verify import ProvenRecord

NOTES: Final = "/rosbridge_eth/notes"
MAX_NOTES: Final = 1_000
MAX_COLUMNS: Final = 4_096
MAX_TRACKS: Final = 32
"""Topics in one picture; what is on further ones is left out."""
_FARTHEST: Final = 1e12
"""Metres from the origin; a position beyond is no position."""
_STRING: Final = "std_msgs/msg/String"
_LAST_TIME: Final = {Wire.ROS1: 2**32 * 10**9 - 1, Wire.CDR: 2**63 - 1}
_BAGS: Final = "NAME.bag (ROS 1), NAME.mcap or NAME.db3 (ROS 2, one file), or NAME (ROS 2, a folder)"
_PICTURES: Final = "name it .png, .svg or .pdf"


@dataclass(frozen=True, slots=True)
class Choice:
    """Which records are wanted: a topic, and times (nanoseconds since 1970, by the robot's receive time)."""

    topic: str | None = None
    from_ns: int | None = None
    to_ns: int | None = None
    at_ns: int | None = None

    def choose(self, records: Iterable[ProvenRecord]) -> Iterator[ProvenRecord]:
        """The chosen ones as they come; with `at_ns` the last one of each topic up to then, when all have come."""
        last: dict[str, ProvenRecord] = {}
        for record in records:
            if self._wants(record.content.topic, record.content.received_ns):
                if self.at_ns is None:
                    yield record
                else:
                    last[record.content.topic] = record
        yield from last.values()

    def _wants(self, topic: str, time: int) -> bool:
        return (
            (self.topic is None or topic == self.topic)
            and (self.from_ns is None or time >= self.from_ns)
            and (self.to_ns is None or time < self.to_ns)
            and (self.at_ns is None or time <= self.at_ns)
        )


# JSON lines


def proof(record: ProvenRecord) -> dict[str, Any]:
    """Which record this is and where the chain has it."""
    place = record.place
    return {
        "chunk": place.chunk,
        "record": record.number,
        "stream": place.stream.hex(),
        "number": place.number,
        "digest": place.digest.hex(),
        "block": place.block,
        "block_time": time_text(place.block_time * 10**9),
        "transaction": "0x" + place.transaction.hex(),
    }


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


# CSV


def check_table(path: Path) -> None:
    """ConfigError unless a table can be written there."""
    if path.suffix != ".csv":
        raise ConfigError(f"{path}: a table is a .csv file")
    _new(path, "table")


_FIXED: Final = (
    "topic", "type", "source", "received_ns", "captured_ns", "clock", "chunk", "record", "block", "transaction",
)  # fmt: skip
"""Columns of every table; after them those of the messages' fields, a dot between the levels."""


class Table:
    """Rows are kept in a file until all columns are known."""

    def __init__(self, rows: Any) -> None:
        self._rows = rows
        self._columns: dict[str, None] = {}

    def write(self, record: ProvenRecord) -> None:
        content, place = record.content, record.place
        cells = dict(_cells(content.data, ""))
        for column in cells:
            if len(self._columns) < MAX_COLUMNS:
                self._columns.setdefault(column)
        row = [
            content.topic, content.type_name, content.source, content.received_ns, content.captured_ns, content.clock,
            place.chunk, record.number, place.block, "0x" + place.transaction.hex(), cells,
        ]  # fmt: skip
        self._rows.write(json.dumps(row) + "\n")

    def copy_to(self, file: Any) -> None:
        writer = csv.writer(file)
        writer.writerow([*_FIXED, *(_cell(column) for column in self._columns)])
        self._rows.seek(0)
        for row in self._rows:
            *fixed, cells = json.loads(row)
            writer.writerow(map(_cell, [*fixed, *(cells.get(column, "") for column in self._columns)]))


def _cells(data: Mapping[str, Any], path: str) -> Iterator[tuple[str, Any]]:
    for name, value in data.items():
        if isinstance(value, dict):
            yield from _cells(value, f"{path}{name}.")
        else:
            yield path + name, json.dumps(value) if isinstance(value, list) else value


def _cell(value: Any) -> Any:
    """Text without what acts on a terminal, and not to be taken for a formula by a spreadsheet."""
    if not isinstance(value, str):
        return value
    text = printable(value)
    return "'" + text if text.startswith(("=", "+", "-", "@")) else text


@contextmanager
def table(path: Path) -> Iterator[Table]:
    """A CSV file: a row each record, a column each field that is no message; arrays as JSON in one cell."""
    check_table(path)
    with _whole(path) as within, tempfile.TemporaryFile("w+", dir=within.parent) as rows:
        made = Table(rows)
        yield made
        with within.open("w", newline="", encoding="utf-8") as file:
            made.copy_to(file)


# Bags


def check_bag(path: Path) -> Wire:
    """The wire format of a bag of this name: .bag is ROS 1; .mcap and .db3 are single files, no ending a folder.

    ConfigError for any other ending, and if the path exists.
    """
    if path.suffix not in ("", ".bag", ".mcap", ".db3"):
        raise ConfigError(f"{path}: a bag cannot be a {path.suffix} file; name it {_BAGS}")
    _new(path, "bag")
    return Wire.ROS1 if path.suffix == ".bag" else Wire.CDR


@dataclass(slots=True)
class BagSummary:
    """Messages written by kind of topic, and the notes that stand in the bag."""

    whole: int = 0
    partial: int = 0
    as_json: int = 0
    notes: list[str] = field(default_factory=list)


@contextmanager
def bag(path: Path) -> Iterator[Bag]:
    """A bag of the kind that `check_bag` finds the name to say. Messages bear the time at which they were received."""
    from rosbags import rosbag1, rosbag2

    wire = check_bag(path)
    with _whole(path) as within:
        if wire is Wire.ROS1:
            with rosbag1.Writer(within) as writer:
                made = Bag(writer, wire)
                yield made
                made.write_notes()
            return
        plugin = rosbag2.StoragePlugin.MCAP if path.suffix == ".mcap" else rosbag2.StoragePlugin.SQLITE3
        # A ROS 2 bag is written as a folder; its one storage file has the definitions too and stands by itself.
        folder = within.with_name("bag") if path.suffix else within
        with rosbag2.Writer(folder, version=9, storage_plugin=plugin) as two:
            made = Bag(two, wire)
            yield made
            made.write_notes()
        if path.suffix:
            [storage] = folder.glob(f"*{path.suffix}")
            storage.rename(within)


class Bag:
    """Makes messages of records again and writes them as they come."""

    def __init__(self, writer: Any, wire: Wire) -> None:
        self._writer, self._wire = writer, wire
        self._connections: dict[tuple[str, Restoration], Any] = {}
        self._restorations: dict[tuple[str, TypeLine | None], Restoration | str] = {}
        self._notes: dict[str, None] = {}
        self._last = 0
        self._string = self._restoration(_STRING, None)
        self.summary = BagSummary()

    def write(self, record: ProvenRecord) -> None:
        content = record.content
        topic = printable(content.topic)
        time = max(0, min(content.received_ns, _LAST_TIME[self._wire]))
        key = content.type_name, record.definition
        if key not in self._restorations:
            try:
                self._restorations[key] = self._restoration(*key)
            except (SourceError, VerificationError) as error:
                self._restorations[key] = shown(str(error))
        restoration = self._restorations[key]
        try:
            if isinstance(restoration, str):
                raise VerificationError(restoration)
            restored = restoration.restore(content.data)
        except VerificationError as error:
            self._note(f"{topic}: as JSON: {shown(str(error))}")
            self.summary.as_json += 1
            self._put_string(topic + "/json", record.line.decode(), time)
            return
        if restored.missing:
            topic += "/partial"
            self.summary.partial += 1
            self._note(f"{topic}: zero because not captured: {', '.join(restored.missing)}")
        else:
            self.summary.whole += 1
        self._put(topic, restoration, restored.message, time)

    def _restoration(self, type_name: str, line: TypeLine | None) -> Restoration:
        """By the log's definition; without one, by the one that rosbags knows. SourceError, VerificationError."""
        decoder = decoder_for_known(self._wire, type_name) if line is None else line.decoder()
        if decoder is None:
            raise VerificationError(f"{type_name} is not known here")
        return Restoration(decoder, self._wire)

    def _put(self, topic: str, restoration: Restoration, message: Any, time: int) -> None:
        key = topic, restoration
        if key not in self._connections:
            of = restoration.connection()
            self._connections[key] = self._writer.add_connection(topic, restoration.decoder.type_name, **of)
        self._writer.write(self._connections[key], time, restoration.decoder.encode(message))
        self._last = max(self._last, time)

    def _put_string(self, topic: str, text: str, time: int) -> None:
        self._put(topic, self._string, self._string.restore({"data": text}).message, time)

    def _note(self, text: str) -> None:
        if len(self._notes) < MAX_NOTES:
            self._notes[text] = None

    def write_notes(self) -> None:
        self.summary.notes = list(self._notes)
        for text in self._notes:
            self._put_string(NOTES, text, self._last)


# The trajectory


def check_picture(path: Path) -> str:
    """The format that the name's ending says, in capitals or not. ConfigError where it says none that can be drawn."""
    from matplotlib.backend_bases import FigureCanvasBase

    kind = path.suffix.removeprefix(".").lower()
    if not kind:
        raise ConfigError(f"{path}: the ending says which kind of picture it is; {_PICTURES}")
    if kind not in FigureCanvasBase.get_supported_filetypes():
        raise ConfigError(f"{path}: a picture cannot be a .{kind} file; {_PICTURES}")
    return kind


class Trajectory:
    """Where the robot was, as seen from above. tracks: of each topic that has positions, (received_ns, x, y)."""

    def __init__(self) -> None:
        self.tracks: dict[str, list[tuple[int, float, float]]] = {}

    def write(self, record: ProvenRecord) -> None:
        content = record.content
        point = _position(content.data)
        if point is not None and (content.topic in self.tracks or len(self.tracks) < MAX_TRACKS):
            self.tracks.setdefault(content.topic, []).append((content.received_ns, *point))

    def draw(self, path: Path) -> int:
        """Draw, in the format of the name's ending; how many positions there are. Without any, the picture says so."""
        import matplotlib
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure

        kind = check_picture(path)
        # What a topic is called is not to be taken for a formula.
        with matplotlib.rc_context({"text.parse_math": False, "text.usetex": False}):
            figure = Figure(figsize=(7, 6), layout="constrained")
            FigureCanvasAgg(figure)
            axes = figure.add_subplot()
            for topic, track in self.tracks.items():
                _draw_track(axes, shown(topic, 60), sorted(track))
            if self.tracks:
                axes.set_aspect("equal", adjustable="datalim")
                axes.set_xlabel("x in m")
                axes.set_ylabel("y in m")
                axes.grid(alpha=0.3)
                axes.legend(loc="best", fontsize="small")
            else:
                axes.set_axis_off()
                text = "no positions in these records"
                axes.text(0.5, 0.5, text, ha="center", va="center", transform=axes.transAxes)
            figure.savefig(path, format=kind, dpi=150)
        return sum(map(len, self.tracks.values()))


def _position(data: Mapping[str, Any]) -> tuple[float, float] | None:
    """Of Odometry, PoseStamped, Pose, Point and what is built like them."""
    for path in (("pose", "pose", "position"), ("pose", "position"), ("position",), ("point",), ()):
        value: Any = data
        for name in path:
            value = value.get(name) if isinstance(value, dict) else None
        if isinstance(value, dict) and _is_distance(value.get("x")) and _is_distance(value.get("y")):
            return float(value["x"]), float(value["y"])
    return None


def _is_distance(value: Any) -> bool:
    return type(value) in (int, float) and abs(value) < _FARTHEST and isfinite(value)


def _draw_track(axes: Any, label: str, track: list[tuple[int, float, float]]) -> None:
    xs, ys = [x for _, x, _ in track], [y for _, _, y in track]
    seconds = (track[-1][0] - track[0][0]) / 1e9
    # A label that begins with "_" would be left out of the legend.
    (line,) = axes.plot(xs, ys, linewidth=1.4, label=f"\u200b{label}: {len(track)} positions, {seconds:.1f} s")
    axes.plot(xs[:1], ys[:1], marker="o", color=line.get_color(), linestyle="none")
    axes.plot(xs[-1:], ys[-1:], marker="s", color=line.get_color(), linestyle="none")
    axes.annotate("start", (xs[0], ys[0]), textcoords="offset points", xytext=(6, 6), fontsize="small")
    axes.annotate("end", (xs[-1], ys[-1]), textcoords="offset points", xytext=(6, -10), fontsize="small")

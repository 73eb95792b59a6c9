"""What a reader makes of proven records: JSON lines, a bag that ROS tools open, a picture of the trajectory.

A bag says no more than what was recorded:

    on topic          type             what
    TOPIC             the original     records of which every field was captured
    TOPIC/partial     the original     records of which fields were left out; these are zero
    TOPIC/json        std_msgs/String  records of types that this program has no definition of: the record's JSON
    /rosbridge_eth/notes  std_msgs/String  once for each topic that is not whole: which fields are zero, or why JSON
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime
from math import isfinite
from pathlib import Path
from typing import Any, Final, TypeGuard

from rosbridge_eth.capture import CapturedRecord, Decoder, Restoration, Wire, decoder_for_known
from rosbridge_eth.errors import ConfigError, VerificationError
from rosbridge_eth.reading.history import ProvenRecord

NOTES: Final = "/rosbridge_eth/notes"
_STRING: Final = "std_msgs/msg/String"
_BAGS: Final = "NAME.bag (ROS 1), NAME.mcap or NAME.db3 (ROS 2, one file), or NAME (ROS 2, a folder)"
_PICTURES: Final = "name it .png, .svg or .pdf"


def as_json(record: ProvenRecord) -> dict[str, Any]:
    """The captured content, and under "proof" which record it is and where the chain has it."""
    item = record.item
    return record.content() | {
        "proof": {
            "stream": record.id.stream.hex(),
            "seq": record.id.seq,
            "signature": record.opened.signature.hex(),
            "block": item.block_number,
            "block_time": datetime.fromtimestamp(item.block_timestamp, UTC).isoformat().replace("+00:00", "Z"),
            "transaction": "0x" + item.tx_hash.hex(),
            "sender": item.sender,
        }
    }


def json_line(record: ProvenRecord) -> str:
    """`as_json` as one line, with its end."""
    return json.dumps(as_json(record), ensure_ascii=False, separators=(",", ":")) + "\n"


@dataclass(slots=True)
class BagSummary:
    """Messages written by kind of topic, and the notes that stand in the bag."""

    whole: int = 0
    partial: int = 0
    as_json: int = 0
    notes: list[str] = field(default_factory=list)


def write_bag(path: Path, records: Iterable[ProvenRecord]) -> BagSummary:
    """Write a bag of the kind that `check_bag` finds the name to say.

    Messages bear the time at which they were received. ConfigError as `check_bag` raises it.
    """
    wire = check_bag(path)
    captured = [(record, _captured(record)) for record in records]
    captured.sort(key=lambda pair: pair[1].received_ns)
    with ExitStack() as stack:
        bag = _Bag(stack.enter_context(_writer(path)), wire)
        for record, content in captured:
            bag.write(record, content)
        bag.write_notes(captured[-1][1].received_ns if captured else 0)
        return bag.summary


def _captured(record: ProvenRecord) -> CapturedRecord:
    try:
        return CapturedRecord.from_json(record.payload)
    except VerificationError as error:
        raise VerificationError(f"record {record.id}: {error}") from None


def check_bag(path: Path) -> Wire:
    """The wire format of a bag of this name: .bag is ROS 1; .mcap and .db3 are single files, no ending a folder.

    ConfigError for any other ending, and if the path exists.
    """
    if path.suffix not in ("", ".bag", ".mcap", ".db3"):
        raise ConfigError(f"{path}: a bag cannot be a {path.suffix} file; name it {_BAGS}")
    if path.exists():
        raise ConfigError(f"{path} is there already; name a bag that is not")
    return Wire.ROS1 if path.suffix == ".bag" else Wire.CDR


@contextmanager
def _writer(path: Path) -> Iterator[Any]:
    from rosbags import rosbag1, rosbag2

    if path.suffix == ".bag":
        with rosbag1.Writer(path) as writer:
            yield writer
    elif path.suffix == "":
        with rosbag2.Writer(path, version=9) as folder:
            yield folder
    else:
        plugin = rosbag2.StoragePlugin.MCAP if path.suffix == ".mcap" else rosbag2.StoragePlugin.SQLITE3
        # A ROS 2 bag is written as a folder; its one storage file has the definitions too and stands by itself.
        with tempfile.TemporaryDirectory(dir=path.parent, prefix=f".{path.name}.") as within:
            with rosbag2.Writer(Path(within, path.stem), version=9, storage_plugin=plugin) as single:
                yield single
            [storage] = Path(within, path.stem).glob(f"*{path.suffix}")
            storage.rename(path)


class _Bag:
    def __init__(self, writer: Any, wire: Wire) -> None:
        self._writer, self._wire = writer, wire
        self._connections: dict[tuple[str, str], Any] = {}
        self._restorations: dict[str, Restoration | None] = {}
        self._decoders: dict[str, Decoder] = {}
        self._noted: dict[str, dict[str, None]] = {}
        self.summary = BagSummary()
        string = decoder_for_known(wire, _STRING)
        if string is None:
            raise ConfigError("this installation of rosbags has no std_msgs/String")
        self._string = string

    def write(self, record: ProvenRecord, content: CapturedRecord) -> None:
        restoration = self._restoration(content.type_name)
        if restoration is not None:
            try:
                restored = restoration.restore(content.data)
            except VerificationError as error:
                self._note(content.topic, f"as JSON: {error}")
            else:
                decoder = self._decoders[content.type_name]
                topic = content.topic
                if restored.missing:
                    topic += "/partial"
                    self.summary.partial += 1
                    self._note(topic, "zero because not captured: " + ", ".join(restored.missing))
                else:
                    self.summary.whole += 1
                self._put(topic, decoder, restored.message, content.received_ns)
                return
        else:
            self._note(content.topic, f"as JSON: {content.type_name} is not known here")
        self.summary.as_json += 1
        self._put_string(content.topic + "/json", record.payload.decode(), content.received_ns)

    def _restoration(self, type_name: str) -> Restoration | None:
        if type_name not in self._restorations:
            decoder = decoder_for_known(self._wire, type_name)
            self._restorations[type_name] = None if decoder is None else Restoration(decoder)
            if decoder is not None:
                self._decoders[type_name] = decoder
        return self._restorations[type_name]

    def _put(self, topic: str, decoder: Decoder, message: Any, time_ns: int) -> None:
        key = topic, decoder.type_name
        if key not in self._connections:
            self._connections[key] = self._writer.add_connection(
                topic, decoder.type_name, typestore=decoder.typestore
            )
        self._writer.write(self._connections[key], time_ns, decoder.encode(message))

    def _put_string(self, topic: str, text: str, time_ns: int) -> None:
        self._put(topic, self._string, self._string.typestore.types[_STRING](text), time_ns)

    def _note(self, topic: str, text: str) -> None:
        self._noted.setdefault(topic, {})[text] = None

    def write_notes(self, time_ns: int) -> None:
        for topic, texts in self._noted.items():
            for text in texts:
                self.summary.notes.append(f"{topic}: {text}")
                self._put_string(NOTES, f"{topic}: {text}", time_ns)


def positions(records: Iterable[ProvenRecord]) -> dict[str, list[tuple[int, float, float]]]:
    """Of each topic that has positions: (received_ns, x, y). Where they are: Odometry, PoseStamped, Pose, Point."""
    found: dict[str, list[tuple[int, float, float]]] = {}
    for record in records:
        content = _captured(record)
        point = _position(content.data)
        if point is not None:
            found.setdefault(content.topic, []).append((content.received_ns, *point))
    return found


def _position(data: Mapping[str, Any]) -> tuple[float, float] | None:
    for path in (("pose", "pose", "position"), ("pose", "position"), ("position",), ("point",), ()):
        value: Any = data
        for name in path:
            value = value.get(name) if isinstance(value, Mapping) else None
        if isinstance(value, Mapping):
            x, y = value.get("x"), value.get("y")
            if _is_number(x) and _is_number(y):
                return float(x), float(y)
    return None


def _is_number(value: Any) -> TypeGuard[float]:
    return isinstance(value, int | float) and not isinstance(value, bool) and isfinite(value)


def check_picture(path: Path) -> str:
    """The format that the name's ending says, in capitals or not. ConfigError where it says none that can be drawn."""
    from matplotlib.backend_bases import FigureCanvasBase

    kind = path.suffix.removeprefix(".").lower()
    if not kind:
        raise ConfigError(f"{path}: the ending says which kind of picture it is; {_PICTURES}")
    if kind not in FigureCanvasBase.get_supported_filetypes():
        raise ConfigError(f"{path}: a picture cannot be a .{kind} file; {_PICTURES}")
    return kind


def draw_trajectory(path: Path, records: Iterable[ProvenRecord]) -> int:
    """Draw where the robot was, as seen from above, in the format of the name's ending; how many positions there are.

    Without any, the picture says so. ConfigError for an ending that cannot be drawn.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    kind = check_picture(path)
    tracks = positions(records)
    figure = Figure(figsize=(7, 6), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    for topic, track in tracks.items():
        _draw_track(axes, topic, sorted(track))
    if tracks:
        axes.set_aspect("equal", adjustable="datalim")
        axes.set_xlabel("x in m")
        axes.set_ylabel("y in m")
        axes.grid(alpha=0.3)
        axes.legend(loc="best", fontsize="small")
    else:
        axes.set_axis_off()
        axes.text(0.5, 0.5, "no positions in these records", ha="center", va="center", transform=axes.transAxes)
    figure.savefig(path, format=kind, dpi=150)
    return sum(len(track) for track in tracks.values())


def _draw_track(axes: Any, topic: str, track: Sequence[tuple[int, float, float]]) -> None:
    xs, ys = [x for _, x, _ in track], [y for _, _, y in track]
    seconds = (track[-1][0] - track[0][0]) / 1e9
    (line,) = axes.plot(xs, ys, linewidth=1.4, label=f"{topic}: {len(track)} positions, {seconds:.1f} s")
    axes.plot(xs[:1], ys[:1], marker="o", color=line.get_color(), linestyle="none")
    axes.plot(xs[-1:], ys[-1:], marker="s", color=line.get_color(), linestyle="none")
    axes.annotate("start", (xs[0], ys[0]), textcoords="offset points", xytext=(6, 6), fontsize="small")
    axes.annotate("end", (xs[-1], ys[-1]), textcoords="offset points", xytext=(6, -10), fontsize="small")

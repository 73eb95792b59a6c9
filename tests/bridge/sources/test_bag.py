"""Bags of every format, written here by rosbags with definitions of our own, and what happens when they are damaged."""

from __future__ import annotations

import sqlite3
import threading
from pathlib import Path
from struct import pack

import numpy
import pytest
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from rosbridge_eth.capture import Capture, RawMessage, TopicRule, parse_line
from rosbridge_eth.errors import SourceError
from rosbridge_eth.robot.sources import BagSource, Offer, Selection

S = 10**9
START = 1_700_000_000 * S
CUSTOM = (
    "std_msgs/Header header\nReading[] readings\nuint8[] blob\nfloat64[3] vector\nbool ok\nstring MODE=fast # x\n"
    "================================================================================\n"
    "MSG: my_pkg/Reading\nstring name\nfloat32 value\n"
)
MAX_SPEED = None


class FakeClock:
    """Time passes only by waiting."""

    def __init__(self) -> None:
        self.now = 0
        self.stop_at: int | None = None

    def wall_ns(self) -> int:
        return START + self.now

    def monotonic_ns(self) -> int:
        return self.now

    def wait_until(self, monotonic_ns: int, stop: threading.Event) -> bool:
        self.now = max(self.now, monotonic_ns)
        if self.stop_at is not None and self.now >= self.stop_at:
            stop.set()
        return stop.is_set()


def custom_store(base: Stores):
    store = get_typestore(base)
    store.register(get_types_from_msg(CUSTOM, "my_pkg/msg/Custom"))
    return store


def custom_message(store, number: int):
    header = store.types["std_msgs/msg/Header"]
    time = store.types["builtin_interfaces/msg/Time"](number, 5)
    reading = store.types["my_pkg/msg/Reading"]
    return store.types["my_pkg/msg/Custom"](
        header(number, time, "map") if "seq" in header.__annotations__ else header(time, "map"),
        [reading("a", 0.5), reading("b", float("inf"))],
        numpy.frombuffer(b"\x00\x01\xff", numpy.uint8),
        numpy.array([1.0, float("nan"), number]),
        True,
    )


EXPECTED = {
    "header": {"stamp": 5, "frame_id": "map"},
    "readings": [{"name": "a", "value": 0.5}, {"name": "b", "value": "Infinity"}],
    "blob": "AAH/",
    "vector": [1.0, "NaN", 0.0],
    "ok": True,
}


def write_ros1(path: Path, compression=None) -> None:
    store = custom_store(Stores.ROS1_NOETIC)
    bag = Writer1(path)
    if compression:
        bag.set_compression(compression)
    with bag as writer:
        custom = writer.add_connection("/custom", "my_pkg/msg/Custom", typestore=store, callerid="/camera")
        text = writer.add_connection("/names", "std_msgs/msg/String", typestore=store, callerid="/talker")
        for number in range(5):
            raw = store.serialize_ros1(custom_message(store, number), "my_pkg/msg/Custom")
            writer.write(custom, START + number * S, raw)
            writer.write(text, START + number * S + S // 2, pack("<I", 2) + b"hi")


def write_ros2(path: Path, plugin: StoragePlugin, **options) -> None:
    store = custom_store(Stores.ROS2_HUMBLE)
    with Writer2(path, version=9, storage_plugin=plugin, **options) as writer:
        custom = writer.add_connection("/custom", "my_pkg/msg/Custom", typestore=store)
        text = writer.add_connection("/names", "std_msgs/msg/String", typestore=store)
        for number in range(5):
            raw = store.serialize_cdr(custom_message(store, number), "my_pkg/msg/Custom")
            writer.write(custom, START + number * S, raw)
            writer.write(text, START + number * S + S // 2, b"\x00\x01\x00\x00" + pack("<I", 3) + b"hi\x00")


@pytest.fixture(params=["ros1", "ros1-bz2", "ros1-lz4", "sqlite3", "mcap", "mcap-file"])
def bag(request, tmp_path: Path) -> Path:
    kind = request.param
    if kind.startswith("ros1"):
        path = tmp_path / "some.bag"
        compression = {"ros1-bz2": Writer1.CompressionFormat.BZ2, "ros1-lz4": Writer1.CompressionFormat.LZ4}
        write_ros1(path, compression.get(kind))
        return path
    path = tmp_path / "some"
    write_ros2(path, StoragePlugin.SQLITE3 if kind == "sqlite3" else StoragePlugin.MCAP)
    return next(path.glob("*.mcap")) if kind == "mcap-file" else path


def replayed(path: Path, *topics: str, **settings) -> list[RawMessage]:
    source = BagSource(path, Selection(topics), speed=MAX_SPEED, **settings)
    emitted: list[RawMessage] = []
    source.run(emitted.append, threading.Event())
    source.close()
    return emitted


def test_every_format_gives_the_same_messages(bag):
    messages = replayed(bag, "**")
    assert [message.topic for message in messages] == ["/custom", "/names"] * 5
    assert [message.received_ns for message in messages] == [START + tick * S // 2 for tick in range(10)]
    assert {message.type_name for message in messages} == {"my_pkg/msg/Custom", "std_msgs/msg/String"}
    capture = Capture([TopicRule("**")], source_kind="bag")
    records = [parse_line(capture.process(message, 0).line) for message in messages]
    custom = records[0].data
    assert custom["header"].pop("seq", 0) == 0  # ROS 1 alone has it
    assert custom == EXPECTED
    assert records[1].data == {"data": "hi"}


def test_a_selection_is_all_that_is_read(bag):
    assert {message.topic for message in replayed(bag, "/names")} == {"/names"}
    assert len(replayed(bag, "/nam*")) == 5


@pytest.mark.parametrize(("speed", "seconds"), [(1.0, 4.5), (2.0, 2.25), (0.5, 9.0)])
def test_the_pace_is_the_recorded_one_times_the_speed(bag, speed, seconds):
    clock = FakeClock()
    source = BagSource(bag, Selection(["**"]), clock, speed=speed)
    at = []
    source.run(lambda _: at.append(clock.now / S), threading.Event())
    assert at == pytest.approx([tick * 0.5 / speed for tick in range(10)])
    assert at[-1] == pytest.approx(seconds)


def test_a_replay_stops_when_told(bag):
    for speed in (1.0, None):
        clock, stop, emitted = FakeClock(), threading.Event(), []
        source = BagSource(bag, Selection(["**"]), clock, speed=speed)

        def emit(message, emitted=emitted, stop=stop):
            emitted.append(message)
            if len(emitted) == 3:
                stop.set()

        source.run(emit, stop)
        assert len(emitted) == 3
        stop.clear()
        source.run(emitted.append, stop)
        assert len(emitted) == 13, "it can be run again, from the start"


def test_what_a_bag_offers(bag):
    source = BagSource(bag, Selection(["**"]))
    nodes = (("/camera",), ("/talker",)) if bag.suffix == ".bag" else ((), ())
    assert source.offers() == (
        Offer("/custom", "my_pkg/msg/Custom", nodes[0]),
        Offer("/names", "std_msgs/msg/String", nodes[1]),
    )
    assert len(list(source.messages())) == 10
    assert set(source.decoders()) == {"/custom", "/names"}
    source.close()
    source.close()
    with pytest.raises(SourceError, match="is closed"):
        next(source.messages())


def test_a_bag_that_is_closed_while_it_is_replayed_ends(bag):
    """As a robot does it that is stopped: another thread closes the source while this one reads on."""
    source = BagSource(bag, Selection(["**"]), speed=MAX_SPEED)
    emitted: list[RawMessage] = []

    def emit(message: RawMessage) -> None:
        emitted.append(message)
        source.close()

    source.run(emit, threading.Event())
    assert 1 <= len(emitted) <= 10


def test_a_node_means_what_it_publishes(tmp_path):
    path = tmp_path / "some.bag"
    write_ros1(path)
    source = BagSource(path, Selection(nodes=["/cam*"]), speed=None)
    assert {message.topic for message in source.messages()} == {"/custom"}
    folder = tmp_path / "folder"
    write_ros2(folder, StoragePlugin.MCAP)
    with pytest.raises(SourceError, match="does not say which nodes published"):
        BagSource(folder, Selection(nodes=["/camera"]))


def test_a_name_that_is_not_there_is_told_with_what_is(bag):
    with pytest.raises(
        SourceError, match=r"no topic or node /nmes; did you mean /names\? It has .*/custom \(my_pkg/msg/Custom"
    ):
        BagSource(bag, Selection(["/custom", "/nmes"]))
    with pytest.raises(SourceError, match=r"no topic or node /robot/\*\*"):
        BagSource(bag, Selection(["/robot/**"]))
    # A pattern that means nothing is no error as long as something is watched.
    assert len(replayed(bag, "/custom", "/robot/**")) == 5


def test_definitions_of_old_ros_2_bags_come_from_the_distribution(tmp_path):
    store = get_typestore(Stores.ROS2_FOXY)
    path = tmp_path / "old"
    with Writer2(path, version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        text = writer.add_connection("/names", "std_msgs/msg/String", typestore=store)
        writer.write(text, START, b"\x00\x01\x00\x00" + pack("<I", 3) + b"hi\x00")
    database = next(path.glob("*.db3"))
    with sqlite3.connect(database) as connection:
        connection.execute("DROP TABLE IF EXISTS message_definitions")
        connection.execute("DROP TABLE IF EXISTS schema")
    connection.close()
    (message,) = replayed(path, "**")
    assert message.decoder.decode(message.raw).data == "hi"
    with sqlite3.connect(database) as connection:
        connection.execute("UPDATE topics SET type = 'my_pkg/msg/Own'")
    connection.close()
    metadata = path / "metadata.yaml"
    metadata.write_text(metadata.read_text().replace("std_msgs/msg/String", "my_pkg/msg/Own"))
    with pytest.raises(SourceError, match="does not define my_pkg/msg/Own"):
        replayed(path, "**")


def test_what_is_not_a_bag_is_a_sentence(tmp_path):
    for name, content in {
        "empty.bag": b"",
        "text.bag": b"hello\n",
        "old.bag": b"#ROSBAG V1.2\n",
        "binary.bag": bytes(range(256)) * 10,
        "header.bag": b"#ROSBAG V2.0\n" + b"\xff" * 100,
        "empty.db3": b"",
        "text.db3": b"hello",
        "empty.mcap": b"",
        "text.mcap": b"\x89MCAP0\r\n" + b"x" * 100,
    }.items():
        file = tmp_path / name
        file.write_bytes(content)
        with pytest.raises(SourceError, match=r"is damaged or not a bag: \S"):
            BagSource(file, Selection(["**"]))
    with pytest.raises(SourceError, match="does not exist"):
        BagSource(tmp_path / "nowhere.bag", Selection(["**"]))
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "metadata.yaml").write_text("rosbag2_bagfile_information: [1, 2")
    with pytest.raises(SourceError, match="is damaged or not a bag"):
        BagSource(tmp_path / "folder", Selection(["**"]))


def attempt(path: Path) -> int:
    """How many messages a damaged bag gives before the SourceError; anything else fails the test."""
    emitted: list[RawMessage] = []
    try:
        source = BagSource(path, Selection(["**"]), speed=None)
        try:
            source.run(emitted.append, threading.Event())
        finally:
            source.close()
    except SourceError:
        pass
    return len(emitted)


def data_file(bag: Path) -> Path:
    return bag if bag.is_file() else next(file for file in bag.iterdir() if file.suffix in (".db3", ".mcap"))


def test_a_truncated_bag_is_a_source_error_at_every_length(bag):
    file = data_file(bag)
    content = file.read_bytes()
    for length in [*range(0, len(content), max(1, len(content) // 60)), len(content) - 1]:
        file.write_bytes(content[:length])
        assert attempt(bag) <= 10
    if bag.suffix == ".bag":
        file.write_bytes(content[: len(content) // 2])
        with pytest.raises(SourceError):
            BagSource(bag, Selection(["**"]))


def test_a_bag_with_flipped_bytes_gives_messages_or_a_source_error(bag):
    file = data_file(bag)
    content = file.read_bytes()
    for position in range(0, len(content), max(1, len(content) // 150)):
        file.write_bytes(content[:position] + bytes([content[position] ^ 0xFF]) + content[position + 1 :])
        attempt(bag)


def test_a_recording_that_was_cut_off_names_the_fix(bag):
    file = data_file(bag)
    content = file.read_bytes()
    fix = {".bag": "`rosbag reindex`", ".mcap": "`mcap recover`", ".db3": "`sqlite3 FILE .recover`"}[file.suffix]
    for length in (len(content) // 2, len(content) - 1000):
        file.write_bytes(content[:length])
        with pytest.raises(SourceError, match=fix):
            list(BagSource(bag, Selection(["**"])).messages())


def test_a_recording_without_an_index_names_the_fix(tmp_path):
    path = tmp_path / "cut.bag"
    write_ros1(path)
    content = bytearray(path.read_bytes())
    at = content.index(b"index_pos=") + len(b"index_pos=")
    content[at : at + 8] = bytes(8)  # what a recorder leaves that did not come to write the index
    path.write_bytes(content)
    with pytest.raises(SourceError, match="rosbag reindex"):
        BagSource(path, Selection(["**"]))


def test_a_hostile_definition_in_a_bag_is_refused_with_its_topic(tmp_path, caplog):
    path = tmp_path / "hostile.bag"
    write_ros1(path)
    content = path.read_bytes()
    path.write_bytes(content.replace(b"bool ok", b"bool o'"))
    for selection in (Selection(["/custom"]), Selection(["/cust*"]), Selection(nodes=["/camera"])):
        with pytest.raises(SourceError, match=r"topic /custom: the definition of my_pkg/msg/Custom cannot be read"):
            BagSource(path, selection)
    # Other topics are not affected, and a pattern that means it among others says so and goes on.
    assert len(replayed(path, "/names")) == 5
    caplog.clear()
    assert {message.topic for message in replayed(path, "**")} == {"/names"}
    assert "/custom" in caplog.text
    assert "left out" in caplog.text


def test_a_message_that_cannot_be_decoded_does_not_end_the_replay(tmp_path, caplog):
    path = tmp_path / "bad.bag"
    store = get_typestore(Stores.ROS1_NOETIC)
    with Writer1(path) as writer:
        text = writer.add_connection("/names", "std_msgs/msg/String", typestore=store)
        for number, raw in enumerate([pack("<I", 2) + b"hi", pack("<I", 99), pack("<I", 2) + b"ho"]):
            writer.write(text, START + number, raw)
    capture = Capture([TopicRule("/names")], source_kind="bag")
    records = [capture.process(message, 0) for message in replayed(path, "/names")]
    assert [record and parse_line(record.line).data["data"] for record in records] == ["hi", None, "ho"]
    assert caplog.text.count("it cannot be decoded") == len(caplog.records) == 1


@pytest.mark.parametrize("name", ["folder", "notes.md"])
def test_what_is_no_bag_is_told_with_what_a_bag_is(tmp_path, name):
    (tmp_path / "folder").mkdir()
    (tmp_path / "notes.md").write_text("no bag")
    with pytest.raises(SourceError, match=r"is no bag; name a \.bag, \.mcap or \.db3 file or the folder"):
        BagSource(tmp_path / name, Selection(("/**",)))

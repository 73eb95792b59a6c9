"""Bags: ROS 1 (.bag) and ROS 2 (a folder with metadata.yaml, .db3, .mcap), by rosbags, without ROS.

Messages come in the order of their receive times, at the recorded pace, faster,
slower, or as fast as they are taken. Definitions come out of the bag and are
checked like those of a live publisher; a ROS 2 bag without definitions (before
Iron, sqlite3) is read with those that its distribution ships.
"""

from __future__ import annotations

import logging
import threading
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib.resources import files
from pathlib import Path

from rosbags.interfaces import Connection, ConnectionExtRosbag1, MessageDefinitionFormat
from rosbags.rosbag1 import Reader as Rosbag1Reader
from rosbags.rosbag2 import Reader as Rosbag2Reader

from rosbridge_eth.capture import Decoder, RawMessage, Wire, decoder_for, decoder_for_known, normalised_type_name
from rosbridge_eth.errors import SourceError
from rosbridge_eth.robot.sources.protocol import Clock, Emit, Offer, Selection, Source

log = logging.getLogger(__name__)

MAX_WAIT_NS = 3600 * 10**9
"""A pause longer than this in a recording is a broken time stamp; it is replayed as this."""
_REINDEX = "if its recording was cut off, run `rosbag reindex` on it"
_RECOVER = (
    "if its recording was cut off, repair an .mcap file by `mcap recover`, a .db3 file by `sqlite3 FILE .recover`, and"
    " the folder's metadata.yaml by `ros2 bag reindex`"
)


class BagSource(Source):
    """What of a bag is replayed, and how fast; it can be run again and then starts again.

    speed: 1.0 is the recorded pace; None is as fast as messages are taken.
    """

    kind = "bag"
    live = False

    def __init__(
        self, path: Path, selection: Selection, clock: Clock | None = None, *, speed: float | None = 1.0
    ) -> None:
        """Opens the bag and resolves the selection. Raises SourceError."""
        self._speed, self._clock = speed, clock or Clock()
        self._where = f"bag {path}"
        self._wire = Wire.ROS1 if path.suffix == ".bag" else Wire.CDR
        self._reader: Rosbag1Reader | Rosbag2Reader | None = None
        if not path.exists():
            raise SourceError(f"{self._where} does not exist")
        if not ((path / "metadata.yaml").exists() if path.is_dir() else path.suffix in (".bag", ".mcap", ".db3")):
            raise SourceError(
                f"{self._where} is no bag; name a .bag, .mcap or .db3 file or the folder of a ROS 2 bag with its"
                " metadata.yaml, which `ros2 bag reindex` restores"
            )
        with self._translated():
            reader = Rosbag1Reader(path) if self._wire is Wire.ROS1 else Rosbag2Reader(path)
            reader.open()
            self._reader = reader
            connections = [  # old recorders left the topic's leading slash out
                (connection, f"/{connection.topic.removeprefix('/')}", normalised_type_name(connection.msgtype))
                for connection in reader.connections
            ]
        self.span = reader.start_time, reader.end_time - 1
        """When the first and the last message were received (ns since 1970); of an empty bag the first is the later."""
        nodes = defaultdict[tuple[str, str], set[str]](set)
        for connection, topic, name in connections:
            caller = connection.ext.callerid if isinstance(connection.ext, ConnectionExtRosbag1) else None
            nodes[topic, name].update([caller] if caller else [])
        self._offers = tuple(Offer(topic, name, tuple(sorted(nodes[topic, name]))) for topic, name in sorted(nodes))
        try:
            watched = {offer.topic for offer in selection.resolve_all(self._offers, self._where)}
            self._watched = self._decoded([each for each in connections if each[1] in watched], selection)
        except SourceError:
            self.close()
            raise
        if self.span[1] < self.span[0]:
            log.warning("%s holds no message", self._where)

    def offers(self) -> Sequence[Offer]:
        """Every topic in the bag; a ROS 1 bag knows the nodes that published."""
        return self._offers

    def decoders(self) -> Mapping[str, Sequence[Decoder]]:
        """The decoders of each watched topic, to check a configuration before the replay."""
        found = defaultdict[str, list[Decoder]](list)
        for _, topic, _, decoder in self._watched.values():
            found[topic].append(decoder)
        return found

    def messages(self) -> Iterator[RawMessage]:
        """The watched messages, in order, without waiting, until the end or `close`. Raises SourceError."""
        if self._reader is None:
            raise SourceError(f"{self._where} is closed")
        try:
            with self._translated():
                for connection, received_ns, raw in self._reader.messages([each[0] for each in self._watched.values()]):
                    _, topic, name, decoder = self._watched[connection.id]
                    yield RawMessage(topic, name, received_ns, bytes(raw), decoder)
        except SourceError:
            if self._reader is not None:  # else it was closed meanwhile, and is over
                raise

    def run(self, emit: Emit, stop: threading.Event) -> None:
        """Replay at the set speed until the end or `stop`. Raises SourceError."""
        due, last = self._clock.monotonic_ns(), None
        for message in self.messages():
            if self._speed is not None:
                passed = 0 if last is None else min(max(message.received_ns - last, 0), MAX_WAIT_NS)
                due, last = due + round(passed / self._speed), message.received_ns
                self._clock.wait_until(due, stop)
            if stop.is_set():
                return
            emit(message)

    def close(self) -> None:
        """Close the file."""
        reader, self._reader = self._reader, None
        if reader is not None:
            with self._translated():
                reader.close()

    def _decoded(
        self, connections: Sequence[tuple[Connection, str, str]], selection: Selection
    ) -> dict[int, tuple[Connection, str, str, Decoder]]:
        """By number. A topic that is only matched by a pattern is left out if it cannot be decoded."""
        decoded: dict[int, tuple[Connection, str, str, Decoder]] = {}
        for connection, topic, name in connections:
            try:
                decoded[connection.id] = connection, topic, name, self._decoder(connection)
            except SourceError as error:
                if topic in selection.named_topics or len(connections) == 1:
                    raise
                log.warning("%s; the topic is left out", error)
        if connections and not decoded:
            raise SourceError(f"{self._where} has no topic that can be decoded")
        return decoded

    def _decoder(self, connection: Connection) -> Decoder:
        definition = connection.msgdef
        if definition.format is MessageDefinitionFormat.NONE:
            distribution = getattr(self._reader, "ros_distro", None)
            known = decoder_for_known(self._wire, connection.msgtype, distribution)
            if known is None:
                raise SourceError(
                    f"{self._where} does not define {connection.msgtype} of {connection.topic}, which ROS does not "
                    "ship; record it as mcap, which stores definitions, or leave the topic out"
                )
            return known
        form = "idl" if definition.format is MessageDefinitionFormat.IDL else "msg"
        try:
            return decoder_for(self._wire, connection.msgtype, definition.data, form)
        except SourceError as error:
            raise SourceError(f"{self._where}, topic {connection.topic}: {error}") from None

    @contextmanager
    def _translated(self) -> Iterator[None]:
        """Whatever reading a damaged bag runs into is one SourceError."""
        try:
            yield
        except (SourceError, GeneratorExit):
            raise
        except PermissionError:
            raise SourceError(f"{self._where} cannot be read: permission denied") from None
        except Exception as error:
            # rosbags passes on what its parts raise (struct, sqlite, YAML, decompressors, assertions):
            # the set is open, and each of them means that the file is not what it should be.
            detail = str(error).strip().rstrip(".").partition("\n")[0] or type(error).__name__
            fix = _REINDEX if self._wire is Wire.ROS1 else _RECOVER
            raise SourceError(f"{self._where} is damaged or not a bag: {detail}; {fix}") from error


def sample_bag() -> Path:
    """The bag that ships with the package: /robot_1/odom and /robot_1/imu of a robot that drives a figure eight.

    How it was recorded is told in samples/README.md of the repository.
    """
    return Path(str(files("rosbridge_eth.robot.sources") / "samples" / "robot_1.bag"))

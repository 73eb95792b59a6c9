"""What can be configured, key by key. The descriptions are the reference's text (docs/configuration.md).

A robot's whole configuration may be `topics = ["/robot_1/odom"]`.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, TypeAlias
from urllib.parse import urlsplit

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Discriminator, Field, model_validator

from rosbridge_eth.capture import NamePattern, TopicRule
from rosbridge_eth.capture.paths import parse_paths
from rosbridge_eth.config.values import Address, DurationNs, FilePath, HostPort, Seconds, Size, TimeNs
from rosbridge_eth.errors import ConfigError, SourceError
from rosbridge_eth.sources import BagSettings, Selection, SimSettings
from rosbridge_eth.sources.ros1 import Ros1Settings
from rosbridge_eth.sources.ros1.addressing import MASTER_PORT, is_graph_name, is_host, read_uri
from rosbridge_eth.sources.ros2 import Ros2Settings

KIB, MIB, GIB = 2**10, 2**20, 2**30
SECOND_NS = 10**9


class Section(BaseModel):
    """A table of the file: unknown keys are refused, nothing is converted behind one's back."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, allow_inf_nan=False)


def _pattern(value: str) -> str:
    return NamePattern(value).text


def _speed(value: Any) -> float | None:
    if value == "max":
        return None
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0 < value <= 1000:
        raise ValueError(f'is {value!r}; write a factor above 0, such as 1.0 or 10, or "max"')
    return float(value)


def _table_of_name(value: Any) -> Any:
    return {"topic": value} if isinstance(value, str) else value


def _field_path(value: str) -> str:
    parse_paths([value])
    return value


def _name(value: str) -> str:
    if not re.fullmatch(r"[a-z0-9][a-z0-9_.\-]{0,62}", value, re.ASCII):
        raise ValueError(f"is {value!r}; a name has 1 to 63 of a-z, 0-9, _ . - and begins with a letter or digit")
    return value


def _topic_part(value: str) -> str:
    if not re.fullmatch(r"[A-Za-z][A-Za-z0-9_]{0,62}", value, re.ASCII):
        raise ValueError(f"is {value!r}; it becomes part of a topic's name: letters, digits and _")
    return value


def _ros_name(value: str) -> str:
    if not re.fullmatch(r"[A-Za-z_](?:_?[A-Za-z0-9])*_?", value, re.ASCII) or len(value) > 255:
        raise ValueError(f"is {value!r}; a node's name has letters, digits and single _, and no digit in front")
    return value


def _contract(value: str) -> str:
    if not re.fullmatch(r"0x[0-9a-fA-F]{40}", value, re.ASCII):
        raise ValueError(f"is {value!r}; an address is 0x and 40 hexadecimal digits")
    return value


def _master(value: str) -> str:
    try:
        read_uri(value, MASTER_PORT)
    except SourceError:
        raise ValueError(f'is {value!r}; write the master\'s URI, such as "http://192.0.2.7:11311"') from None
    return value


def _host(value: str) -> str:
    if not is_host(value):
        raise ValueError(f"is {value!r}; write a name or an address, without a port")
    return value


def _node(value: str) -> str:
    name = value if value.startswith("/") else f"/{value}"
    if not is_graph_name(name):
        raise ValueError(f'is {value!r}; a node\'s name has letters, digits, _ and /, such as "/robot_1/recorder"')
    return name


Pattern: TypeAlias = Annotated[str, AfterValidator(_pattern)]
Speed: TypeAlias = Annotated[float | None, BeforeValidator(_speed)]
FieldPath: TypeAlias = Annotated[str, AfterValidator(_field_path)]
Name: TypeAlias = Annotated[str, AfterValidator(_name)]
Mode: TypeAlias = Literal["exchange", "transport"]


# The robot


class TopicConfig(Section):
    """A topic, or a pattern of topics, with how it is captured. A plain string is the same with nothing else set."""

    topic: Pattern = Field(
        description="Name, or pattern: `*` and `?` within one part of the name, `**` across parts, `[ab]`."
    )
    fields: list[FieldPath] = Field(
        default=[],
        description='What is captured: `"pose.pose.position.x"`, `"ranges[0]"`, `"poses[*].position"`, `"*"` for all. '
        "Without it, all of the message; of Odometry, the pose and twist without their covariances.",
    )
    rate: float | None = Field(default=None, gt=0, le=10_000, description="Records per second, at most.")
    at: TimeNs | None = Field(default=None, description="A moment: only the first message at that time or after it.")
    once: bool = Field(default=False, description="Only the first message (of the period, if there is one).")
    from_: TimeNs | None = Field(default=None, alias="from", description="A period: only messages from then on.")
    until: TimeNs | None = Field(default=None, description="A period: only messages before then.")
    for_: DurationNs | None = Field(
        default=None, alias="for", description="Length of the period, from `from` or from the first message."
    )
    delivery: Literal["reliable", "latest"] | None = Field(
        default=None,
        description="`reliable`: every record arrives. `latest`: a newer one may take the place of one that waits. "
        "Without it, that of `[capture]`.",
    )
    oversize: Literal["digest", "refuse"] | None = Field(
        default=None, description="As in `[capture]`, for this topic alone."
    )

    @model_validator(mode="after")
    def _consistent(self) -> TopicConfig:
        parse_paths(self.fields)
        period = [
            key for key, value in (("from", self.from_), ("until", self.until), ("for", self.for_)) if value is not None
        ]
        if self.at is not None and (period or self.once or self.rate is not None):
            also = ", ".join([*period, *(["once"] if self.once else []), *(["rate"] if self.rate else [])])
            raise ValueError(f"has both `at` and {also}; a moment is one message, choose one")
        if self.until is not None and self.for_ is not None:
            raise ValueError("has both `until` and `for`; choose one")
        if self.from_ is not None and self.until is not None and self.until <= self.from_:
            raise ValueError("has a period that ends before it begins: `until` is not after `from`")
        return self


class CaptureConfig(Section):
    """What holds for every topic that does not say otherwise."""

    delivery: Literal["reliable", "latest"] = Field(default="reliable", description="See `topics`.")
    oversize: Literal["digest", "refuse"] = Field(
        default="digest",
        description="What becomes of a field above `field_limit`: its SM3 digest and length are captured instead, "
        "or the message is left out. Both are counted, and said once per topic.",
    )
    field_limit: Size = Field(default=KIB, le=16 * KIB, description="Largest field that is captured as it is.")


class BagConfig(Section):
    """Replay a bag: ROS 1 `.bag`, ROS 2 folder, `.db3` or `.mcap`."""

    kind: Literal["bag"] = Field(description="`bag`")
    path: FilePath = Field(description="The bag. A relative path starts at the folder of this file.")
    speed: Speed = Field(
        default=1.0, description='Factor on the recorded pace, or `"max"`: as fast as records are taken.'
    )
    start: DurationNs | None = Field(default=None, description="Skip so much of the recording.")
    stop: DurationNs | None = Field(default=None, description="End so long after the beginning of the recording.")

    @model_validator(mode="after")
    def _consistent(self) -> BagConfig:
        if self.start is not None and self.stop is not None and self.stop <= self.start:
            raise ValueError("ends before it begins: `stop` is not after `start`")
        return self

    def settings(self) -> BagSettings:
        """For sources.open_source."""
        return BagSettings(self.path, self.speed, self.start or 0, self.stop)


class Ros1Config(Section):
    """A live ROS 1 master, with no ROS installed here (docs/howto-ros1.md)."""

    kind: Literal["ros1"] = Field(description="`ros1`")
    master: Annotated[str, AfterValidator(_master)] | None = Field(
        default=None,
        description="The master's URI; without it, that of `ROS_MASTER_URI`, otherwise `http://localhost:11311`.",
    )
    hostname: Annotated[str, AfterValidator(_host)] | None = Field(
        default=None,
        description="Name or address under which the master reaches this machine; without it, `ROS_HOSTNAME`, "
        "`ROS_IP`, or the address that this machine uses towards the master.",
    )
    node: Annotated[str, AfterValidator(_node)] | None = Field(
        default=None,
        description="The name under which the robot appears in the graph; without it, one of its own for each "
        "process, `/rosbridge_eth_MACHINE_PID`.",
    )
    max_message: Size = Field(
        default=32 * MIB,
        ge=KIB,
        le=64 * MIB,
        description="A larger message is not read, but counted. Messages that wait or are arriving take at most "
        "four times as much memory.",
    )
    waiting: int = Field(
        default=4096,
        ge=16,
        le=1_000_000,
        description="Messages that wait to be captured, at most; the topic that has most of them then loses its "
        "oldest, which is counted. Publishers are never made to wait.",
    )
    timeout: Seconds = Field(
        default=5.0, ge=0.1, le=60, description="For a call to the master or a publisher, and for a publisher's header."
    )

    def settings(self) -> Ros1Settings:
        """For sources.open_source."""
        return Ros1Settings(self.master, self.hostname, self.node, self.max_message, self.waiting, self.timeout)


class Ros2Config(Section):
    """The live ROS 2 graph, through the rclpy of the Python that runs the robot."""

    kind: Literal["ros2"] = Field(description="`ros2`")
    domain: int | None = Field(
        default=None, ge=0, le=232, description="The graph's domain; without it, that of `ROS_DOMAIN_ID`, or 0."
    )
    node: Annotated[str, AfterValidator(_ros_name)] = Field(
        default="rosbridge_eth", description="The name under which the robot appears in the graph."
    )
    depth: int = Field(
        default=256, ge=1, le=65_536, description="Messages of a topic that the middleware keeps until they are taken."
    )

    def settings(self) -> Ros2Settings:
        """For sources.open_source."""
        return Ros2Settings(self.domain, self.node, self.depth)


class SimConfig(Section):
    """A simulated robot that publishes `/NAME/odom` and `/NAME/imu`, so that anything can be tried."""

    kind: Literal["sim"] = Field(description="`sim`")
    robot: Annotated[str, AfterValidator(_topic_part)] = Field(default="robot_1", description="The NAME in its topics.")
    seed: int = Field(default=1, ge=0, lt=2**63, description="The same seed drives the same way.")
    rate: float = Field(default=10.0, gt=0, le=10_000, description="Odometry and IMU messages per second.")
    duration: DurationNs | None = Field(default=None, description="End after so long; without it, never.")
    speed: Speed = Field(default=1.0, description="As of a bag.")

    def settings(self) -> SimSettings:
        """For sources.open_source."""
        return SimSettings(self.robot, self.seed, self.rate, self.duration, self.speed)


SOURCE_KINDS: dict[str, type[BagConfig | Ros1Config | Ros2Config | SimConfig]] = {
    "bag": BagConfig,
    "ros1": Ros1Config,
    "ros2": Ros2Config,
    "sim": SimConfig,
}


def _known_kind(value: Any) -> Any:
    if isinstance(value, dict):
        kind = value.get("kind")
        if kind is None:
            raise ValueError(f"has no kind; allowed: {', '.join(map(repr, SOURCE_KINDS))}")
        if kind not in SOURCE_KINDS:
            near = difflib.get_close_matches(str(kind), SOURCE_KINDS, 1)
            hint = f"; did you mean {near[0]!r}?" if near else ""
            raise ValueError(f"has kind {kind!r}; allowed: {', '.join(map(repr, SOURCE_KINDS))}{hint}")
    elif value is not None and not isinstance(value, Section):
        raise ValueError(f'is {value!r}; write a table, such as [source] with kind = "bag"')
    return value


AnySource: TypeAlias = BagConfig | Ros1Config | Ros2Config | SimConfig
SourceConfig: TypeAlias = Annotated[AnySource, Discriminator("kind")]
_ROS1_DISTRIBUTIONS = frozenset({"noetic", "melodic", "lunar", "kinetic", "jade", "indigo"})


def source_of_environment(environment: Mapping[str, str]) -> tuple[AnySource, str]:
    """The source of a robot that is configured with none: the ROS that is set up there, or a simulation; and why."""
    version, distribution = environment.get("ROS_VERSION"), environment.get("ROS_DISTRO")
    if version in ("1", "2"):
        kind, why = f"ros{version}", f"ROS_VERSION is {version}"
    elif master := environment.get("ROS_MASTER_URI"):
        kind, why = "ros1", f"ROS_MASTER_URI is {master}"
    elif distribution:
        kind, why = "ros1" if distribution in _ROS1_DISTRIBUTIONS else "ros2", f"ROS_DISTRO is {distribution}"
    else:
        kind, why = "sim", "there is no [source] and no ROS in the environment: nothing real is recorded"
    return SOURCE_KINDS[kind].model_validate({"kind": kind}), why


class SpoolConfig(Section):
    """Records that the server has not acknowledged; sealed before they get there. When there is no room, `latest`
    records are dropped first, then the oldest; what was dropped is declared on the chain."""

    max_records: int = Field(default=1_000_000, ge=16, description="Records kept, at most.")
    max_size: Size = Field(default=256 * MIB, ge=MIB, description="Bytes kept, at most.")
    commit: Seconds = Field(
        default=0.05, le=10, description="Group commit: a power failure loses what was captured within so long."
    )


class StreamConfig(Section):
    """When a new stream, that is, a new key, begins."""

    records: int = Field(default=2**20, ge=16, le=2**32, description="After so many records.")
    age: DurationNs = Field(default=86_400 * SECOND_NS, description="After so long.")


class RobotConfig(Section):
    """A robot's configuration, `robot.toml`."""

    topics: Annotated[list[Annotated[TopicConfig, BeforeValidator(_table_of_name)]], Field()] = Field(
        default=[], description="Topics to watch: names, patterns, or tables (below)."
    )
    nodes: list[Pattern] = Field(
        default=[],
        description="Nodes to watch, by name or pattern: the topics they publish, resolved again every few seconds.",
    )
    name: Name | None = Field(
        default=None, description="The robot's name; without it, the one that it was registered under."
    )
    server: HostPort | None = Field(
        default=None, description="The server's HOST:PORT; without it, the one in the bundle the robot joined with."
    )
    channel: Mode = Field(
        default="exchange",
        description="How session keys come about: SM2 key exchange, or the paper's transport of a key. No fallback.",
    )
    readers: list[FilePath] | None = Field(
        default=None,
        description="Certificates (PEM) of those who may read the records; without it, those the robot joined with.",
    )
    acknowledge: Literal["stored", "confirmed"] = Field(
        default="stored",
        description="When a reliable record may leave the spool: stored durably by the server, or confirmed on chain.",
    )
    monitor: HostPort | None = Field(
        default=None,
        description="HTTP address of `/metrics`, `/healthz` and `/readyz`, such as `127.0.0.1:9465`; without it there "
        "are none. Keep it on the machine or a private network.",
    )
    source: Annotated[SourceConfig | None, BeforeValidator(_known_kind)] = Field(
        default=None,
        description="Where messages come from (below). Without it, the ROS that the environment speaks of "
        "(`ROS_VERSION`, `ROS_MASTER_URI`, `ROS_DISTRO`), and where it speaks of none, a simulated robot.",
    )
    capture: CaptureConfig = Field(default=CaptureConfig(), description="Defaults for all topics (below).")
    spool: SpoolConfig = Field(default=SpoolConfig(), description="Records not acknowledged yet (below).")
    stream: StreamConfig = Field(default=StreamConfig(), description="Change of keys (below).")

    @model_validator(mode="after")
    def _consistent(self) -> RobotConfig:
        if not self.topics and not self.nodes:
            raise ValueError('names nothing to watch; write topics = ["/robot_1/odom"] or nodes = ["/robot_1/base"]')
        seen: set[str] = set()
        for topic in self.topics:
            if topic.topic in seen:
                raise ValueError(f"names topic {topic.topic} twice")
            seen.add(topic.topic)
        if self.readers is not None and not self.readers:
            raise ValueError(
                "has no reader: nobody could open the records; name a certificate in `readers` or leave the key out"
            )
        return self

    def rules(self) -> list[TopicRule]:
        """For capture.Capture. What a node publishes is captured by the defaults."""
        topics = list(self.topics)
        if self.nodes:
            topics.append(TopicConfig(topic="**"))
        return [
            TopicRule(
                topic.topic,
                tuple(topic.fields),
                topic.rate,
                topic.at,
                topic.once,
                topic.from_,
                topic.until,
                topic.for_,
                topic.delivery or self.capture.delivery,
                topic.oversize or self.capture.oversize,
                self.capture.field_limit,
            )
            for topic in topics
        ]

    def source_and_why(self, environment: Mapping[str, str]) -> tuple[AnySource, str]:
        """Where messages come from, as configured or else as `environment` says, and the reason for a person."""
        if self.source is not None:
            return self.source, "as configured"
        return source_of_environment(environment)

    def selection(self) -> Selection:
        """For sources.open_source."""
        return Selection([topic.topic for topic in self.topics], self.nodes)

    def reader_files(self, joined: Path) -> list[Path]:
        """The readers' certificates: as configured, or those in the folder `joined`. ConfigError if there is none."""
        if self.readers is not None:
            for file in self.readers:
                if not file.is_file():
                    raise ConfigError(f"reader certificate {file} does not exist; correct `readers`")
            return list(self.readers)
        files = sorted(joined.glob("*.pem"))
        if not files:
            raise ConfigError(
                f"no reader: there is no certificate in {joined} and `readers` names none, so nobody could open the "
                "records; join again with the bundle, or name a certificate in `readers`"
            )
        return files


# The server


def _chain_url(value: str) -> str:
    if value == "embedded":
        return value
    parts = urlsplit(value)
    if parts.scheme not in ("http", "https", "ws", "wss") or not parts.hostname:
        # Not shown: a node's URL often carries a key.
        raise ValueError('is not a node\'s URL; write "http://127.0.0.1:8545", "wss://...", or "embedded"')
    return value


def _store_url(value: str) -> str:
    if value == "sqlite":
        return value
    parts = urlsplit(value)
    if parts.scheme not in ("redis", "rediss", "unix"):
        raise ValueError('is not a store; write "sqlite" or "redis://127.0.0.1:6379/0"')
    return value


ChainUrl: TypeAlias = Annotated[str, AfterValidator(_chain_url)]
ContractAddress: TypeAlias = Annotated[str, AfterValidator(_contract)]


class ChainConfig(Section):
    """The node and how long to wait before a record counts."""

    url: ChainUrl = Field(
        default="embedded",
        description='JSON-RPC URL of a node, or `"embedded"`: an EVM in the process, for trying out; it ends with it.',
        repr=False,
    )
    confirmations: int = Field(
        default=1, ge=1, le=10_000, description="Blocks, its own included, after which a transaction is confirmed."
    )
    poll: Seconds = Field(default=0.5, le=60, description="How often the node is asked about what is pending.")
    bump_after: Seconds = Field(
        default=30.0,
        le=86_400,
        description="A transaction that no block holds after so long is sent with a higher fee.",
    )
    max_fee_gwei: float = Field(default=500.0, gt=0, description="No transaction offers more per unit of gas.")
    keep: Seconds = Field(
        default=3 * 86_400.0, description="Confirmed batches are kept so long, to be sent again after a reorganisation."
    )


class StoreConfig(Section):
    """The inbox between the sockets and the chain."""

    url: Annotated[str, AfterValidator(_store_url)] = Field(
        default="sqlite", description='`"sqlite"`, in the server\'s folder, or the URL of a Redis.', repr=False
    )
    max_records: int = Field(default=1_000_000, ge=100, description="Records kept, dead letters included.")
    max_size: Size = Field(default=GIB, ge=MIB, description="Bytes kept, dead letters included.")
    remember: Seconds = Field(
        default=30 * 86_400.0,
        ge=3600,
        description="The names of finished records are remembered so long: a record that comes again within it, from a "
        "robot that never learnt that it was taken, is not written twice.",
    )


class BatchConfig(Section):
    """One batch is one transaction of one robot; it is closed at whichever limit comes first."""

    records: int = Field(default=100, ge=1, le=1000, description="Records.")
    size: Size = Field(default=96 * KIB, ge=33 * KIB, le=120 * KIB, description="Bytes of calldata.")
    gas: int = Field(default=8_000_000, ge=200_000, description="Gas.")
    age: Seconds = Field(default=2.0, le=3600, description="How long the first record waits for others.")


class FundsConfig(Section):
    """Robots' accounts are topped up by the operator's."""

    below: float = Field(default=0.05, gt=0, lt=5, description="Top up when an account has less ETH than this.")
    by: float = Field(default=0.5, gt=0, le=5, description="By so much ETH. The contract refuses above 5 ETH.")


class LimitsConfig(Section):
    """Bounds on what strangers and robots can make the server do; per worker process."""

    connections: int = Field(default=4096, ge=1, description="Sessions.")
    half_open: int = Field(default=1024, ge=1, description="Handshakes that are under way.")
    handshake_share: float = Field(default=0.5, gt=0, le=1, description="Share of time that handshakes may take.")
    source_rate: float = Field(default=10.0, gt=0, description="Handshakes per second that one address may fail.")
    source_burst: float = Field(default=400.0, ge=1, description="And at once.")
    unanswered: int = Field(default=256, ge=1, description="Messages of one session that wait for their answer.")
    memory: Size = Field(default=64 * MIB, ge=MIB, description="Bytes of messages under way, all sessions together.")


class ServerConfig(Section):
    """The server's configuration, `server.toml`."""

    listen: HostPort = Field(default=Address("0.0.0.0", 7410), description="UDP address of the robots' door.")  # noqa: S104 - a server's default
    public: HostPort | None = Field(
        default=None, description="The address that robots are given in their bundles; without it, `listen`."
    )
    name: Name = Field(default="server", description="The name in the server's certificate.")
    workers: int = Field(default=1, ge=1, le=64, description="Processes that share the port.")
    channel: list[Mode] = Field(
        default=["exchange"],
        min_length=1,
        description='Handshake modes that are taken: `"exchange"`, and `"transport"` where it is wanted.',
    )
    monitor: HostPort | None = Field(
        default=None,
        description="HTTP address of `/metrics`, `/healthz` and `/readyz`, such as `127.0.0.1:9464`; without it there "
        "are none. Whoever reaches it reads names, balances and counts: keep it on the machine or a private network.",
    )
    chain: ChainConfig = Field(default=ChainConfig(), description="The node (below).")
    store: StoreConfig = Field(default=StoreConfig(), description="The inbox (below).")
    batch: BatchConfig = Field(default=BatchConfig(), description="Records per transaction (below).")
    funds: FundsConfig = Field(default=FundsConfig(), description="Robots' accounts (below).")
    limits: LimitsConfig = Field(default=LimitsConfig(), description="Bounds (below).")


# The reader


class ReaderConfig(Section):
    """A reader's configuration, `reader.toml`: all it takes to read, the server is not asked."""

    contract: ContractAddress = Field(description="The contract's address.")
    ca: FilePath = Field(description="The operator's CA certificate (PEM).")
    identity: FilePath = Field(description="Folder of the reader's keys and certificates.")
    chain: ChainUrl = Field(
        default="http://127.0.0.1:8545", description="JSON-RPC URL of any node of the chain.", repr=False
    )
    from_block: int = Field(
        default=0, ge=0,
        description="The block of the contract's deployment, or later; what a robot wrote before it is not read.",
    )


ROOTS: tuple[type[Section], ...] = (RobotConfig, ServerConfig, ReaderConfig)

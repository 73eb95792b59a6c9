"""What can be configured. The docstrings are the text of docs/configuration.md: what a table is for, then one
paragraph for each key.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Annotated, Any, Literal, TypeAlias

from pydantic import (  # isort: skip
    AfterValidator, BaseModel, BeforeValidator, ConfigDict, Discriminator, Field, WithJsonSchema,
)  # fmt: skip
from pydantic import model_validator as validator

from rosbridge_eth.capture import NamePattern, TopicRule
from rosbridge_eth.capture.rules import parse_paths
from rosbridge_eth.config.home import ledger_of
from rosbridge_eth.config.values import Address, DurationNs, FilePath, HostPort, TimeNs, seconds, size
from rosbridge_eth.errors import ConfigError
from rosbridge_eth.robot.blackbox import Condition, TriggerRule

KIB, MIB, GIB = 2**10, 2**20, 2**30


class Section(BaseModel):
    """A table of the file: unknown keys are refused, nothing is converted behind one's back."""

    model_config = ConfigDict(
        extra="forbid", strict=True, frozen=True, allow_inf_nan=False, validate_by_name=True, validate_by_alias=True
    )


def _matching(pattern: str, words: str, *, secret: bool = False) -> AfterValidator:
    """A string of this form. secret: a value that does not fit is not shown, since a URL often carries a key."""

    def check(value: str) -> str:
        if not re.fullmatch(pattern, value, re.ASCII):
            raise ValueError(f"is not {words}" if secret else f"is {value!r}; {words}")
        return value

    return AfterValidator(check)


def _pattern(value: str) -> str:
    return NamePattern(value).text


def _field_path(value: str) -> str:
    parse_paths([value])
    return value


def _condition(value: str) -> str:
    Condition.parse(value)
    return value


def _speed(value: Any) -> float | None:
    if value == "max":
        return None
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0 < value <= 1000:
        raise ValueError(f'is {value!r}; write a factor above 0, such as 1.0 or 10, or "max"')
    return float(value)


def _table_of_name(value: Any) -> Any:
    if not isinstance(value, str | dict):
        raise ValueError(f"is {value!r}; write a name in quotes, or a table")
    return {"topic": value} if isinstance(value, str) else value


def _listed(value: Any) -> Any:
    return [value] if isinstance(value, str) else value


_HOST = r"(?:\[[0-9A-Fa-f:.]+\]|[A-Za-z0-9_.\-]+)"
_PORT = r"(?::(?:\d{1,4}|[1-5]\d{4}|6[0-4]\d{3}|65[0-4]\d\d|655[0-2]\d|6553[0-5]))?"  # up to 65535
_PART = "[A-Za-z][A-Za-z0-9_]*"
Pattern = Annotated[str, AfterValidator(_pattern)]
FieldPath = Annotated[str, AfterValidator(_field_path)]
Speed = Annotated[float | None, BeforeValidator(_speed), WithJsonSchema({"type": 'number or `"max"`'})]
Mode = Literal["exchange", "transport"]
Name = Annotated[str, _matching(
    r"[a-z0-9][a-z0-9_.\-]{0,62}", "a name has 1 to 63 of a-z, 0-9, _ . - and begins with a letter or digit")]
MasterUri = Annotated[str, _matching(
    rf"http://{_HOST}{_PORT}/?", 'write the master\'s URI, such as "http://192.0.2.7:11311"')]
Host = Annotated[str, _matching(
    r"[A-Za-z0-9_.\-]+|[0-9A-Fa-f]*:[0-9A-Fa-f]*:[0-9A-Fa-f:.]*", "write a name or an address, without a port")]
Ros1Node = Annotated[str, _matching(
    rf"/?{_PART}(?:/{_PART})*", 'a node\'s name has letters, digits, _ and /, such as "/robot_1/recorder"')]
Ros2Node = Annotated[str, _matching(
    r"(?=.{1,255}\Z)[A-Za-z_](?:_?[A-Za-z0-9])*_?", "a node's name has letters, digits, single _, and no digit first")]
TopicPart = Annotated[str, _matching(
    r"[A-Za-z][A-Za-z0-9_]{0,62}", "it becomes part of a topic's name: letters, digits and _")]
NodeUrl = Annotated[str, _matching(
    rf"https?://(?:[^\s@/]+@)?{_HOST}{_PORT}(?:[/?]\S*)?",
    'a node\'s URL; write "http://127.0.0.1:8545" or "https://..."', secret=True)]
StoreUrl = Annotated[str, _matching(
    r"sqlite|rediss?://\S+|unix://\S+", 'a store; write "sqlite" or "redis://127.0.0.1:6379/0"', secret=True)]
ContractAddress = Annotated[str, _matching("0x[0-9a-fA-F]{40}", "an address is 0x and 40 hexadecimal digits")]
Hash = Annotated[str, _matching("0x[0-9a-fA-F]{64}", "a hash is 0x and 64 hexadecimal digits")]


# The robot


class TopicConfig(Section):
    """A topic, or a pattern of topics. A plain string is a table with this topic alone.

    topic: Name or pattern.

    fields: Paths such as `"pose.pose.position.x"`, `"ranges[0]"`, `"poses[*].position"`; without it, all.

    rate: Records per second, at most.

    at: Only the first message at that time or after it.

    once: Only the first message.

    from: Only messages from then on.

    until: Only messages before then.

    for: Length of the period, from `from` or the first message.

    trigger: Keep records in memory until this `[[trigger]]` fires.
    """

    topic: Pattern
    fields: list[FieldPath] = []
    rate: Annotated[float, Field(ge=1e-6, le=10_000)] | None = None
    at: TimeNs | None = None
    once: bool = False
    from_: TimeNs | None = Field(default=None, alias="from")
    until: TimeNs | None = None
    for_: DurationNs | None = Field(default=None, alias="for")
    trigger: Name | None = None

    @validator(mode="after")
    def _consistent(self) -> TopicConfig:
        parse_paths(self.fields)
        given = {"from": self.from_, "until": self.until, "for": self.for_, "once": self.once, "rate": self.rate}
        if self.at is not None and (also := [key for key, value in given.items() if value]):
            raise ValueError(f"has both `at` and {', '.join(also)}; a moment is one message, choose one")
        if self.trigger is not None and (self.at is not None or self.once):
            raise ValueError("has `trigger` and one message only (`at`, `once`): it would be gone before the event")
        if self.until is not None and self.for_ is not None:
            raise ValueError("has both `until` and `for`; choose one")
        if self.from_ is not None and self.until is not None and self.until <= self.from_:
            raise ValueError("has a period that ends before it begins: `until` is not after `from`")
        return self


class TriggerConfig(Section):
    """An event: when it fires, the records of the last `before` and of the next `after` go into the log.

    name: Used by topics, `rosbridge-eth trigger NAME`, the log and `/metrics`.

    before: How long records are kept.

    after: For so long records are written as they come; another event starts it again.

    memory: Bytes kept: the records' JSON, and 256 bytes for each.

    when: Conditions, any of which fires: a watched topic, a field, `==` `!=` `<` `<=` `>` `>=`, and a number, `true`,
    `false` or a `"string"`. Without one, only the command and SIGUSR1 fire.
    """

    name: Name
    before: Annotated[float, seconds("1ms", "1h")] = 10.0
    after: Annotated[float, seconds("1ms", "1h")] = 10.0
    memory: Annotated[int, size("64 KiB", "4 GiB")] = 16 * MIB
    when: Annotated[list[Annotated[str, AfterValidator(_condition)]], BeforeValidator(_listed)] = []


class BagConfig(Section):
    """A bag: ROS 1 `.bag`, ROS 2 folder, `.db3` or `.mcap`.

    kind: `bag`

    path: The bag.

    speed: Factor on the recorded pace, or `"max"`: as fast as records are taken.
    """

    kind: Literal["bag"]
    path: FilePath
    speed: Speed = 1.0


class Ros1Config(Section):
    """A live ROS 1 master; needs no ROS here ([howto-ros1.md](howto-ros1.md)).

    kind: `ros1`

    master: The master's URI; without it `ROS_MASTER_URI`, or `http://localhost:11311`.

    hostname: This machine as the master reaches it; without it `ROS_HOSTNAME`, `ROS_IP`, or its address towards the
    master.

    node: The robot's name in the graph; without it `/rosbridge_eth_MACHINE_PID`.

    max_message: A larger message is counted and not read. Up to twice as many bytes wait in memory.
    """

    kind: Literal["ros1"]
    master: MasterUri | None = None
    hostname: Host | None = None
    node: Ros1Node | None = None
    max_message: Annotated[int, size("1 KiB", "64 MiB")] = 32 * MIB


class Ros2Config(Section):
    """The live ROS 2 graph, through rclpy.

    kind: `ros2`

    domain: The graph's domain; without it `ROS_DOMAIN_ID`, or 0.

    node: The robot's name in the graph.

    depth: Messages of a topic that the middleware keeps until they are taken.
    """

    kind: Literal["ros2"]
    domain: Annotated[int, Field(ge=0, le=232)] | None = None
    node: Ros2Node = "rosbridge_eth"
    depth: int = Field(default=256, ge=1, le=65_536)


class SimConfig(Section):
    """A simulated robot that publishes `/NAME/odom` and `/NAME/imu`. Every record says that it is simulated.

    kind: `sim`

    robot: NAME.


    rate: Messages per second.

    duration: End after so long; without it, never.

    speed: As of a bag.
    """

    kind: Literal["sim"]
    robot: TopicPart = "robot_1"
    rate: float = Field(default=10.0, ge=1e-6, le=10_000)
    duration: DurationNs | None = None
    speed: Speed = 1.0


AnySource: TypeAlias = BagConfig | Ros1Config | Ros2Config | SimConfig
SOURCE_KINDS: dict[str, type[AnySource]] = {"bag": BagConfig, "ros1": Ros1Config, "ros2": Ros2Config, "sim": SimConfig}


class LogConfig(Section):
    """The robot's log.

    period: A chunk holds what was captured in so long. A longer one costs less gas a record; a power cut loses up to
    one.

    heartbeat: After so long without records an empty chunk is written.

    compress: If false, a chunk's size does not tell how alike its records are.
    """

    period: Annotated[float, seconds("50ms", "1h")] = 1.0
    heartbeat: Annotated[float, seconds("10s", "7d")] = 3600.0
    compress: bool = True


class SpoolConfig(Section):
    """The log on the robot's disk, until it is confirmed. When it is full, chunks that the server has go first, then
    the bodies of the oldest; the log says so.

    max_size: Bytes.
    """

    max_size: Annotated[int, size("1 MiB")] = 256 * MIB


class RobotConfig(Section):
    """A robot's configuration, `robot.toml`.

    topics: Names, patterns, or tables (below).

    nodes: Nodes, by name or pattern: all topics that they publish.

    server: A shard of the server; without it, those that the bundle names.

    channel: How session keys are made: SM2 key exchange, or the paper's transport of a key. No fallback.

    monitor: HTTP address of `/metrics`, such as `127.0.0.1:9465`; keep it private.

    source: Where messages come from (below); without it, what `ROS_VERSION` or `ROS_MASTER_URI` says.

    log: Below.

    spool: Below.

    trigger: Events for which records are kept in memory, at most 16 (below).
    """

    topics: list[Annotated[TopicConfig, BeforeValidator(_table_of_name)]] = []
    nodes: list[Pattern] = []
    server: HostPort | None = None
    channel: Mode = "exchange"
    monitor: HostPort | None = None
    source: Annotated[AnySource, Discriminator("kind")] | None = None
    log: LogConfig = LogConfig()
    spool: SpoolConfig = SpoolConfig()
    trigger: Annotated[list[TriggerConfig], Field(max_length=16)] = []

    @validator(mode="after")
    def _consistent(self) -> RobotConfig:
        if not self.topics and not self.nodes:
            raise ValueError('names nothing to watch; write topics = ["/robot_1/odom"] or nodes = ["/robot_1/base"]')
        names = [topic.topic for topic in self.topics]
        if twice := [name for number, name in enumerate(names) if name in names[:number]]:
            raise ValueError(f"names topic {twice[0]} twice")
        self._check_triggers()
        return self

    def _check_triggers(self) -> None:
        events, used = [trigger.name for trigger in self.trigger], {topic.trigger for topic in self.topics} - {None}
        if twice := [name for number, name in enumerate(events) if name in events[:number]]:
            raise ValueError(f"names trigger {twice[0]} twice")
        if unknown := used - {*events}:
            raise ValueError(f"has a topic with trigger = {unknown.pop()!r}, and no [[trigger]] of that name")
        if idle := [name for name in events if name not in used]:
            raise ValueError(f"has a trigger {idle[0]!r} for which no topic is kept; say trigger = {idle[0]!r} at one")
        watched = [NamePattern(topic.topic) for topic in self.topics]
        for condition in (condition for rule in self.triggers() for condition in rule.when):
            if not self.nodes and not any(pattern.matches(condition.topic) for pattern in watched):
                raise ValueError(f"has a condition on {condition.topic}, which is not watched; add it to `topics`")

    def triggers(self) -> list[TriggerRule]:
        """For blackbox.BlackBox."""
        return [
            TriggerRule(each.name, round(each.before * 1e9), round(each.after * 1e9), each.memory,
                        tuple(map(Condition.parse, each.when)))
            for each in self.trigger
        ]  # fmt: skip

    def rules(self) -> list[TopicRule]:
        """For capture.Capture. What a node publishes is captured by the defaults."""
        return [
            TopicRule(
                topic.topic, tuple(topic.fields), topic.rate, topic.at, topic.once, topic.from_, topic.until,
                topic.for_, trigger=topic.trigger,
            )
            for topic in [*self.topics, *([TopicConfig(topic="**")] if self.nodes else [])]
        ]

    def source_and_why(self, environment: Mapping[str, str]) -> tuple[AnySource, str]:
        """Where messages come from, as configured or else from the ROS that is set up there; and how that is known.

        ConfigError where no ROS is: a simulation in its place would sign invented records.
        """
        if self.source is not None:
            return self.source, "as configured"
        if (version := environment.get("ROS_VERSION")) in ("1", "2"):
            kind, why = f"ros{version}", f"ROS_VERSION is {version}"
        elif master := environment.get("ROS_MASTER_URI"):
            kind, why = "ros1", f"ROS_MASTER_URI is {master}"
        else:
            raise ConfigError(
                "robot.toml has no [source] and the environment speaks of no ROS (ROS_VERSION, ROS_MASTER_URI): set ROS"
                ' up in this shell, or write [source] with kind = "ros1", "ros2", "bag" or, to try it out with invented'
                ' messages, "sim"'
            )
        return SOURCE_KINDS[kind].model_validate({"kind": kind}), why


# The server


class ChainConfig(Section):
    """The chain.

    url: JSON-RPC URL of a node.

    confirmations: Blocks, its own included, after which a chunk is confirmed.

    max_fee_gwei: Highest price of a unit of gas that is offered.
    """

    url: NodeUrl = Field(default="http://127.0.0.1:8545", repr=False)
    confirmations: int = Field(default=1, ge=1, le=100)
    max_fee_gwei: float = Field(default=500.0, gt=0)


class StoreConfig(Section):
    """The robots' logs at the server, until they are confirmed.

    url: `"sqlite"`, a file for each shard, or the URL of a Redis for all of them.

    max_size: Bytes of a shard's file, without dead letters. A Redis has its own `maxmemory`.

    share: Bytes of one robot; above it, that robot waits.
    """

    url: StoreUrl = Field(default="sqlite", repr=False)
    max_size: Annotated[int, size("1 MiB")] = GIB
    share: Annotated[int, size("1 MiB")] = 64 * MIB


class FundsConfig(Section):
    """ETH of the robots' accounts, from the operator's.

    below: Top up when an account has less ETH.

    by: By so much ETH.

    gas_per_day: Gas that a robot may use in 24 hours, and an hour's worth at once; the rest waits. The default is
    about 40 records a second (`topics` tells what a robot's take).
    """

    below: float = Field(default=0.05, ge=1e-6, lt=5)
    by: float = Field(default=0.5, ge=1e-6, le=5)
    gas_per_day: int = Field(default=10_000_000_000, ge=1_000_000)


class ServerConfig(Section):
    """The server's configuration, `server.toml`.

    listen: UDP address of the first shard; each further one has the next port.

    public: The first shard's address as robots reach it; without it, `listen`. A list has each shard's.

    shards: Processes, each with its port, store and submitter ([howto-shards.md](howto-shards.md)).

    channel: Handshake modes that are taken: `"exchange"`, `"transport"`.

    monitor: HTTP address of the first shard's `/metrics`, such as `127.0.0.1:9464`, and the next port for each further
    one; keep it private.

    chain: Below.

    store: Below.

    funds: Below.
    """

    listen: HostPort = Address("0.0.0.0", 7410)  # noqa: S104 - a server's default
    public: Annotated[list[HostPort], BeforeValidator(_listed)] = []
    shards: int = Field(default=1, ge=1, le=64)
    channel: list[Mode] = Field(default=["exchange"], min_length=1)
    monitor: HostPort | None = None
    chain: ChainConfig = ChainConfig()
    store: StoreConfig = StoreConfig()
    funds: FundsConfig = FundsConfig()

    @validator(mode="after")
    def _consistent(self) -> ServerConfig:
        if len(self.public) not in (0, 1, self.shards):
            raise ValueError(f"has {len(self.public)} addresses in `public`; write one, or one for each of the shards")
        for first in filter(None, [self.listen, self.monitor, *(self.public if len(self.public) == 1 else ())]):
            if self.shards > 1 and not 0 < first.port <= 65536 - self.shards:
                raise ValueError(f"has shards = {self.shards}, for which there are no ports from {first} on")
        return self

    def addresses(self) -> list[Address]:
        """Of each shard, as robots reach it; ConfigError where that is no address that a robot could send to."""
        first, *others = self.public or [self.listen]
        if lost := [address for address in (first, *others) if address.nowhere]:
            raise ConfigError(
                f"robots would be told to send to {lost[0]}, which no machine can have: write into server.toml"
                ' public = "HOST:PORT", as robots reach the server'
            )
        return [first, *others] if others else [first.next(shard) for shard in range(self.shards)]


# The reader


class ReaderConfig(Section):
    """A reader's configuration, `reader.toml`, as `deploy` writes it.

    contract: The contract's address.

    chain_id: The chain's id.

    genesis: The hash of the chain's first block.

    chain: JSON-RPC URL of a node, or a list: where nodes disagree, the log is not sound.
    """

    contract: ContractAddress
    chain_id: int = Field(ge=1)
    genesis: Hash
    chain: Annotated[list[NodeUrl], BeforeValidator(_listed)] = Field(
        default=["http://127.0.0.1:8545"], min_length=1, repr=False
    )

    @property
    def ledger(self) -> bytes:
        """What every signature of a log covers, 32 bytes (chunk.ledger_id)."""
        return ledger_of(self.chain_id, self.genesis, self.contract)

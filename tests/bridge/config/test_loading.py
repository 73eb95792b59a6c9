"""Every kind of mistake in a configuration, and the sentence that says how to fix it."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from pydantic import BaseModel

from rosbridge_eth import config as config_package
from rosbridge_eth.capture import TopicRule
from rosbridge_eth.config import (
    ReaderConfig,
    RobotConfig,
    ServerConfig,
    load_reader_config,
    load_robot_config,
    load_server_config,
    parse_config,
)
from rosbridge_eth.config.models import SOURCE_KINDS
from rosbridge_eth.errors import ConfigError
from rosbridge_eth.log.chunk import ledger_id

S = 10**9
FILE = Path("/etc/rosbridge/robot.toml")


def robot(text: str) -> RobotConfig:
    return parse_config(RobotConfig, text, FILE)


def server(text: str) -> ServerConfig:
    return parse_config(ServerConfig, text, Path("server.toml"))


def test_one_line_is_a_whole_configuration():
    config = robot('topics = ["/robot_1/odom"]')
    assert config.rules() == [TopicRule("/robot_1/odom", limit=16 * 1024)]
    assert config.source is None
    assert config.channel == "exchange"


@pytest.mark.parametrize(
    ("environment", "kind", "reason"),
    [
        ({"ROS_VERSION": "1"}, "ros1", "ROS_VERSION is 1"),
        ({"ROS_VERSION": "2", "ROS_MASTER_URI": "http://robot:11311"}, "ros2", "ROS_VERSION is 2"),
        ({"ROS_MASTER_URI": "http://robot:11311"}, "ros1", "ROS_MASTER_URI is http://robot:11311"),
    ],
)
def test_without_a_source_the_environment_says_which(environment, kind, reason):
    source, why = robot('topics = ["/robot_1/odom"]').source_and_why(environment)
    assert source.kind == kind
    assert reason in why


def test_without_a_source_and_without_ros_nothing_is_invented():
    with pytest.raises(ConfigError, match=r'no \[source\] .* write \[source\] with kind = .* "sim"'):
        robot('topics = ["/robot_1/odom"]').source_and_why({"PATH": "/bin"})


def test_a_source_that_is_configured_is_not_overruled_by_the_environment():
    config = robot('topics = ["/a"]\n[source]\nkind = "sim"')
    assert config.source_and_why({"ROS_VERSION": "2"}) == (config.source, "as configured")
    assert config.source.kind == "sim"


def test_topics_are_names_or_tables():
    config = robot(
        """
nodes = ["/robot_1/base"]
topics = [
    "robot_1/imu",
    { topic = "/robot_1/odom", fields = ["pose.pose.position"], rate = 2 },
    { topic = "/a", from = 1970-01-01T00:00:01Z, until = "1970-01-01T00:00:02Z" },
    { topic = "/b", for = "2s", once = true },
    { topic = "/c/*", at = 1970-01-01T00:00:03Z },
]
"""
    )
    rules = {rule.topic: rule for rule in config.rules()}
    assert list(rules) == ["/robot_1/imu", "/robot_1/odom", "/a", "/b", "/c/*", "**"]
    odom = rules["/robot_1/odom"]
    assert (odom.fields, odom.rate) == (("pose.pose.position",), 2)
    assert (rules["/a"].from_ns, rules["/a"].until_ns) == (S, 2 * S)
    assert (rules["/b"].for_ns, rules["/b"].once) == (2 * S, True)
    assert rules["/c/*"].at_ns == 3 * S
    assert rules["**"].fields == (), "what a node publishes, whole"


def test_a_bag_stands_relative_to_the_file():
    bag = 'topics = ["/a"]\n[source]\nkind = "bag"\n'
    config = robot(bag + 'path = "x/y.bag"\nspeed = "max"')
    told = config.source.model_dump(exclude={"kind"})
    assert told == {"path": Path("/etc/rosbridge/x/y.bag"), "speed": None}
    config = robot(bag + 'path = "/x/y.bag"\nspeed = 2')
    told = config.source.model_dump(exclude={"kind"})
    assert told == {"path": Path("/x/y.bag"), "speed": 2.0}


KINDS = ", ".join(map(repr, SOURCE_KINDS))
MISTAKES = {
    # The line, and the key, what was given and what is allowed.
    'topcs = ["/a"]': "unknown key 'topcs'; docs/configuration.md has every key",
    'topics = ["/a"]\n\n[spool]\nmax_sise = 5': "unknown key 'spool.max_sise'",
    'topics = [{topic = "/a", rat = 1}]': "unknown key 'topics[0].rat'",
    # Of a source the keys of its kind, not those of another.
    'topics = ["/a"]\nsource = {kind = "sim", path = "x"}': "unknown key 'source.path'",
    "": 'it names nothing to watch; write topics = ["/robot_1/odom"]',
    "topics = []": "it names nothing to watch",
    'topics = "/a"': "topics is '/a'; input should be a valid list",
    "topics = [5]": "topics[0] is 5; write a name in quotes, or a table",
    'topics = ["/a", "/a"]': "it names topic /a twice",
    'topics = ["/a b"]': "topics[0].topic: '/a b' is not a name or pattern",
    'nodes = ["/["]': "nodes[0]: '/[' is not a name or pattern",
    "topics = [{rate = 1}]": "topics[0].topic is missing",
    'topics = [{topic = "/a", rate = 0}]': "topics[0].rate is 0; input should be greater than or equal to 0.000001",
    'topics = [{topic = "/a", rate = "2"}]': "topics[0].rate is '2'; input should be a valid number",
    'topics = [{topic = "/a", rate = inf}]': "topics[0].rate is inf; input should be a finite number",
    'topics = [{topic = "/a", once = 1}]': "topics[0].once is 1; input should be a valid boolean",
    'topics = [{topic = "/a", fields = ["x..y"]}]': "topics[0].fields[0]: 'x..y' is not a field path, such as",
    'topics = [{topic = "/a", fields = ["x[*]", "x[0]"]}]': "one array is selected by [*] and by an index",
    'topics = ["/a"]\n[log]\nperiod = "2h"': "log.period is '2h'; it should be at most '1h'",
    'topics = ["/a"]\n[log]\nperiod = "49ms"': "log.period is '49ms'; it should be at least '50ms'",
    'topics = ["/a"]\n[log]\nperiod = 1': "log.period is 1; write a duration with its unit, such as",
    'topics = ["/a"]\n[log]\ncompress = "no"': "log.compress is 'no'; input should be a valid boolean",
    'topics = ["/a"]\n[source]\nkind = "ros1"\nmaster = "robot:11311"': "source.master is 'robot:11311'; write the",
    'topics = ["/a"]\n[source]\nkind = "ros1"\nhostname = "a:1"': "source.hostname is 'a:1'; write a name or an",
    'topics = [{topic = "/a", at = 2026-01-01T00:00:00Z, rate = 1, for = "2s"}]': (
        "topics[0] has both `at` and for, rate; a moment is one message, choose one"
    ),
    'topics = [{topic = "/a", until = 2026-01-01T00:00:00Z, for = "2s"}]': "has both `until` and `for`",
    'topics = [{topic = "/a", from = 2026-01-02T00:00:00Z, until = 2026-01-01T00:00:00Z}]': (
        "topics[0] has a period that ends before it begins"
    ),
    'topics = [{topic = "/a", from = 2026-01-02T00:00:00}]': "say in which time zone",
    'topics = [{topic = "/a", for = 5}]': 'topics[0].for is 5; write a duration with its unit, such as "250ms"',
    'topics = ["/a"]\nsource = 3': "source is 3; input should be a valid dictionary",
    'topics = ["/a"]\n[source]\nkind = "bog"': f"source needs a kind: {KINDS}",
    'topics = ["/a"]\n[source]\nspeed = "max"': f"source needs a kind: {KINDS}",
    'topics = ["/a"]\n[source]\nkind = "ros2"\nnode = "a/b"': "source.node is 'a/b'; a node's name has letters",
    'topics = ["/a"]\n[source]\nkind = "ros2"\ndomain = 233': "source.domain is 233; input should be less than",
    'topics = ["/a"]\n[source]\nkind = 1': f"source needs a kind: {KINDS}",
    'topics = ["/a"]\n[source]\nkind = "bag"': "source.path is missing",
    'topics = ["/a"]\n[source]\nkind = "bag"\npath = 5': "source.path is 5; write a path in quotes",
    'topics = ["/a"]\n[source]\nkind = "bag"\npath = "x"\nspeed = 0': (
        'source.speed is 0; write a factor above 0, such as 1.0 or 10, or "max"'
    ),
    'topics = ["/a"]\n[source]\nkind = "sim"\nrobot = "a/b"': "source.robot is 'a/b'; it becomes part of a topic's",
    'topics = ["/a"]\n[spool]\nmax_size = "64 mib"': "spool.max_size is '64 mib'; write a size such as",
    'topics = ["/a"]\n[source]\nkind = "ros2"\ndepth = 1.5': "source.depth is 1.5; input should be a valid integer",
    'topics = ["/a"]\n[spool]\nmax_size = 5': "spool.max_size is 5; it should be at least '1 MiB'",
    'topics = ["/a"]\nchannel = "transprot"': "channel is 'transprot'; input should be 'exchange' or 'transport'",
    'topics = ["/a"]\nserver = "host"': "server is 'host'; write HOST:PORT",
    "topics = [": "is not TOML: ",
    "topics = 1\ntopics = 2": "is not TOML: cannot overwrite a value",
    "\x00": "is not TOML: ",
    f"topics = {'1' * 5000}": "is not TOML: exceeds the limit",
}


@pytest.mark.parametrize("text", MISTAKES, ids=range(len(MISTAKES)))
def test_a_mistake_in_robot_toml_is_told(text):
    with pytest.raises(ConfigError) as failure:
        robot(text)
    assert str(failure.value).startswith(str(FILE))
    assert MISTAKES[text] in str(failure.value)
    assert "\n" not in str(failure.value)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("shards = 0", "shards is 0; input should be greater than or equal to 1"),
        ("channel = []", "channel is []; list should have at least 1 item"),
        ('channel = ["foo"]', "channel[0] is 'foo'; input should be 'exchange' or 'transport'"),
        ('[chain]\ncontract = "0x12"', "unknown key 'chain.contract'"),
        ("[chain]\nconfirmations = true", "chain.confirmations is true; input should be a valid integer"),
        ("[chain]\nconfirmations = 101", "chain.confirmations is 101; input should be less than or equal to 100"),
        ('[chain]\nurl = "embedded"', "chain.url is not a node's URL"),
        ('[chain]\nurl = "http://127.0.0.1:65536"', "chain.url is not a node's URL"),
        ('listen = "a..b:7410"', "listen is 'a..b:7410'; write HOST:PORT"),
        ('[chain]\nurl = "ws://127.0.0.1:8546"', "chain.url is not a node's URL"),
        ('[store]\nshare = "1 kB"', "store.share is '1 kB'; it should be at least '1 MiB'"),
        ("[funds]\ngas_per_day = 5", "funds.gas_per_day is 5; input should be greater than or equal to 1000000"),
        ("[funds]\nby = 6", "funds.by is 6; input should be less than or equal to 5"),
        ("[funds]\nby = 4e-19", "funds.by is 4e-19; input should be greater than or equal to 0.000001"),
        ("[funds]\nbelow = 4e-19", "funds.below is 4e-19; input should be greater than or equal to 0.000001"),
        ("[store]\nurl = 3", "store.url is 3; input should be a valid string"),
        ("[stroe]\nshare = 10", "unknown key 'stroe'"),
    ],
)
def test_a_mistake_in_server_toml_is_told(text, sentence):
    with pytest.raises(ConfigError) as failure:
        server(text)
    assert sentence in str(failure.value)


def test_a_url_with_a_password_is_not_shown():
    for text in ('[chain]\nurl = "htps://me:secretkey@node"', '[store]\nurl = "mysql://me:secretkey@host"'):
        with pytest.raises(ConfigError) as failure:
            server(text)
        assert "secretkey" not in str(failure.value)
    config = server('[chain]\nurl = "https://node/secretkey"\n[store]\nurl = "redis://:secretkey@host"')
    assert "secretkey" not in repr(config)


def test_all_mistakes_of_a_file_are_told_at_once():
    with pytest.raises(ConfigError) as failure:
        robot('topics = ["/a"]\nservr = "x:1"\nchannel = "y"\n[spool]\nmax_size = "big"\n')
    for part in ("", "'servr'", "", "channel", "", "spool.max_size"):
        assert part in str(failure.value)


READER = """
contract = "0x00000000000000000000000000000000000000aa"
chain_id = 31337
genesis = "0x1111111111111111111111111111111111111111111111111111111111111111"
"""


def test_a_reader_says_which_ledger_and_by_which_nodes():
    config = parse_config(ReaderConfig, READER, Path("/r/reader.toml"))
    assert config.ledger == ledger_id(31337, b"\x11" * 32, bytes(19) + b"\xaa")
    assert config.chain == ["http://127.0.0.1:8545"]
    one = parse_config(ReaderConfig, READER + 'chain = "https://a.example/key"', Path("reader.toml"))
    many = parse_config(ReaderConfig, READER + 'chain = ["https://a.example/key", "http://[::1]:1"]', Path("r.toml"))
    assert (len(one.chain), len(many.chain)) == (1, 2) and "key" not in repr(many)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("", "contract is missing; chain_id is missing; genesis is missing"),
        ('contract = "0x12"', "contract is '0x12'; an address is 0x and 40 hexadecimal digits"),
        ('genesis = "0x12"', "genesis is '0x12'; a hash is 0x and 64 hexadecimal digits"),
        ("chain = []", "chain is []; list should have at least 1 item"),
        ('chain = ["http://a", "ftp://secretkey@b"]', "chain[1] is not a node's URL"),
    ],
)
def test_a_mistake_in_reader_toml_is_told(text, sentence):
    with pytest.raises(ConfigError) as failure:
        parse_config(ReaderConfig, text, Path("reader.toml"))
    assert sentence in str(failure.value) and "secretkey" not in str(failure.value)


@pytest.mark.parametrize("text", ["", 'listen = "127.0.0.1:0"', 'listen = "[::]:7410"', 'public = "0.0.0.0:7410"'])
def test_robots_are_never_given_an_address_that_is_none(text):
    with pytest.raises(ConfigError, match='public = "HOST:PORT"'):
        server(text).addresses()


def test_robots_are_given_the_public_address_or_the_one_that_is_listened_on():
    assert server('public = "robots.example:7410"').addresses() == [("robots.example", 7410)]
    assert server('listen = "192.0.2.7:7410"').addresses() == [("192.0.2.7", 7410)]


def test_each_shard_has_the_next_port_or_an_address_of_its_own():
    next_ones = server('listen = "192.0.2.7:7410"\nshards = 3').addresses()
    assert next_ones == [("192.0.2.7", 7410), ("192.0.2.7", 7411), ("192.0.2.7", 7412)]
    assert server('shards = 2\npublic = ["a.example:7410", "b.example:9"]').addresses()[1] == ("b.example", 9)


@pytest.mark.parametrize("text", [
    'shards = 3\npublic = ["a.example:7410", "b.example:7411"]', 'shards = 2\nlisten = "127.0.0.1:65535"',
    'shards = 2\nlisten = "127.0.0.1:0"', 'shards = 2\nmonitor = "127.0.0.1:65535"',
])  # fmt: skip
def test_every_shard_needs_ports_and_an_address(text):
    with pytest.raises(ConfigError, match="shards"):
        server(text)


def sections(root):
    found = [root]
    for field in root.model_fields.values():
        if isinstance(field.annotation, type) and issubclass(field.annotation, BaseModel):
            found += sections(field.annotation)
    return found


@pytest.mark.parametrize("root", [ServerConfig, ReaderConfig])
def test_every_key_has_an_effect(root):
    """A key that nothing reads is a promise to the operator that is not kept."""
    package = Path(config_package.__file__).parent
    program = "".join(path.read_text() for path in package.parent.rglob("*.py") if path.parent != package)
    unread = [(section.__name__, name) for section in sections(root) for name in section.model_fields
              if not re.search(rf"(?<!home)(?<!place)(?<!self)\.{name}\b", program)]
    assert unread == []


def test_files_that_cannot_be_read(tmp_path):
    for load in (load_robot_config, load_server_config, load_reader_config):
        with pytest.raises(ConfigError, match=r"nowhere\.toml does not exist; create it"):
            load(tmp_path / "nowhere.toml")
        with pytest.raises(ConfigError, match="cannot be read: Is a directory"):
            load(tmp_path)
        latin = tmp_path / "latin.toml"
        latin.write_bytes("name = 'é'".encode("latin-1"))
        with pytest.raises(ConfigError, match=r"is not UTF-8 \(byte 8\)"):
            load(latin)
    good = tmp_path / "robot.toml"
    good.write_text('topics = ["/a"]')
    assert load_robot_config(good).topics[0].topic == "/a"


def test_a_byte_order_mark_is_no_part_of_the_file(tmp_path):
    (tmp_path / "robot.toml").write_bytes(b"\xef\xbb\xbf" + b'topics = ["/a"]\n')
    assert [topic.topic for topic in load_robot_config(tmp_path / "robot.toml").topics] == ["/a"]


@pytest.mark.parametrize("given", ["1", '["/a"]', "true"])
def test_a_topic_may_be_a_name_or_a_table(tmp_path, given):
    (tmp_path / "robot.toml").write_text(f"topics = [{given}]\n")
    with pytest.raises(ConfigError, match=r"topics\[0\] is .*; write a name in quotes, or a table$"):
        load_robot_config(tmp_path / "robot.toml")

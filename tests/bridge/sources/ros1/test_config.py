"""[source] kind = "ros1" in robot.toml."""

from __future__ import annotations

from pathlib import Path

import pytest

from rosbridge_eth.config import RobotConfig, parse_config
from rosbridge_eth.config.models import Ros1Config
from rosbridge_eth.errors import ConfigError
from rosbridge_eth.robot.sources import Selection, open_source
from rosbridge_eth.robot.sources.ros1.source import Ros1Source


def source(text: str) -> Ros1Config:
    config = parse_config(RobotConfig, f'topics = ["/a"]\n[source]\nkind = "ros1"\n{text}', Path("robot.toml"))
    return config.source


def test_nothing_more_need_be_said():
    opened = open_source(source(""), Selection.of(parse_config(RobotConfig, 'topics = ["/a"]', Path("robot.toml"))))
    assert isinstance(opened, Ros1Source)


def test_every_key_arrives():
    text = """
        master = "http://192.0.2.7:11311"
        hostname = "192.0.2.8"
        node = "fleet/recorder"
        max_message = "1 MiB"
    """
    assert source(text).model_dump() == {
        "kind": "ros1", "master": "http://192.0.2.7:11311", "hostname": "192.0.2.8", "node": "fleet/recorder",
        "max_message": 2**20,
    }  # fmt: skip


@pytest.mark.parametrize(
    ("line", "why"),
    [
        ('master = "robot:11311"', "source.master is 'robot:11311'; write the master's URI, such as"),
        ('hostname = "robot:5"', "source.hostname is 'robot:5'; write a name or an address, without a port"),
        ('node = "a b"', "source.node is 'a b'; a node's name has letters, digits"),
        ('max_message = "65 MiB"', "source.max_message"),
        ('mastr = "http://robot:11311"', "unknown key 'source.mastr'"),
    ],
)
def test_mistakes_are_told(line, why):
    with pytest.raises(ConfigError) as error:
        source(line)
    assert why in str(error.value)

"""Configuration: TOML files to checked values, with errors that say what to change."""

from rosbridge_eth.config.loading import load_reader_config, load_robot_config, load_server_config, parse_config, reread
from rosbridge_eth.config.models import ReaderConfig, RobotConfig, ServerConfig, TopicConfig
from rosbridge_eth.config.values import Address

__all__ = [
    "Address", "ReaderConfig", "RobotConfig", "ServerConfig", "TopicConfig", "load_reader_config",
    "load_robot_config", "load_server_config", "parse_config", "reread",
]  # fmt: skip

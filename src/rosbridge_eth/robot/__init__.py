"""The user end: watches topics, seals what it captures, and hands it to the server until the server has it."""

from rosbridge_eth.robot.recorder import Recorder
from rosbridge_eth.robot.sender import Sender, SenderStatistics

__all__ = ["Recorder", "Sender", "SenderStatistics"]

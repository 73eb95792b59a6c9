"""Every message type that Debian ships for ROS 1, serialised by genpy, ROS 1's own implementation, and read by us."""

from __future__ import annotations

import json
import subprocess
from base64 import b64decode
from pathlib import Path

import orjson
import pytest

from rosbridge_eth.capture import Conversion, Restoration, Wire, decoder_for, definition_line, parse_line

SYSTEM_PYTHON = "/usr/bin/python3"  # where Debian's ROS packages are, whatever environment this runs in
SEEDS = (1, 2, 3)


@pytest.fixture(scope="module")
def messages(require):
    require("rosmaster")
    found = []
    for seed in SEEDS:
        script = Path(__file__).with_name("genpy_messages.py")
        run = subprocess.run([SYSTEM_PYTHON, "-B", script, str(seed)], capture_output=True, text=True, check=True)
        found += [json.loads(line) for line in run.stdout.splitlines()]
    return found


@pytest.mark.service
def test_every_message_has_the_values_that_ros_reads(messages):
    assert len({message["type"] for message in messages}) > 100
    for message in messages:
        decoder = decoder_for(Wire.ROS1, message["type"], message["definition"])
        raw = b64decode(message["raw"])
        data = Conversion(decoder, limit=1 << 20).convert(decoder.decode(raw))
        # As text, so that 1 is not 1.0, -0.0 is not 0.0, and the order counts.
        assert orjson.dumps(data) == orjson.dumps(message["values"]), message["type"]
        # Back from the line of the type alone, as a reader has it.
        restoration = Restoration(parse_line(definition_line(decoder)).decoder())
        assert restoration.decoder.encode(restoration.restore(data).message) == raw, message["type"]
        assert restoration.connection["md5sum"] == message["md5"], message["type"]

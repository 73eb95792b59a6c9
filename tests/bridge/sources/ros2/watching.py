"""Run by the Python that has rclpy: a source as `robot.toml` describes it, its captured records on stdout.

watching.py robot.toml [hold]     with "hold", no message is taken before stdin ends: a robot that is slow

Every line is a JSON object: {"record": ...}, or at the end {"statistics": ...}. SIGTERM ends it, as it does a robot.
"""

from __future__ import annotations

import json
import logging
import signal
import sys
import threading
import time
from dataclasses import asdict
from pathlib import Path

from rosbridge_eth.capture import Capture, RawMessage
from rosbridge_eth.config import load_robot_config
from rosbridge_eth.errors import SourceError
from rosbridge_eth.sources import open_source

logging.basicConfig(level=logging.INFO, stream=sys.stderr, format="%(levelname)s %(message)s")
stop = threading.Event()
signal.signal(signal.SIGTERM, lambda number, frame: stop.set())
before = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]
config = load_robot_config(Path(sys.argv[1]))
capture = Capture(config.rules())


def say(value: dict[str, object]) -> None:
    print(json.dumps(value), flush=True)


def emit(raw: RawMessage) -> None:
    if "hold" in sys.argv:
        sys.stdin.read()
    record = capture.process(raw, time.time_ns(), time.monotonic_ns())
    if record is not None:
        say({"record": json.loads(record.to_json())})


try:
    source = open_source(config.source_and_why({})[0].settings(), config.selection())
    say(
        {
            "opened": type(source).__name__,
            "handlers_kept": before == [signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM)],
        }
    )
    source.run(emit, stop)
except SourceError as error:
    say({"error": str(error)})
    sys.exit(error.exit_code)
say({"statistics": {topic: asdict(counts) for topic, counts in source.statistics().items()}})
say({"threads": [thread.name for thread in threading.enumerate()]})

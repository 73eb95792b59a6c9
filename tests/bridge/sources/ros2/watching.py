"""Run by the Python that has rclpy: a source as `robot.toml` describes it, its captured records on stdout.

watching.py robot.toml [hold]     with "hold", no message is taken before stdin ends: a robot that is slow

Every line is a JSON object: {"record": ..., "rebuilt": ...}, or at the end {"statistics": ...}. SIGTERM ends it, as it
does a robot.
"""

from __future__ import annotations

import json
import logging
import signal
import sys
import threading
import time
from collections import Counter
from pathlib import Path

from rosbridge_eth.capture import (
    Capture,
    Conversion,
    RawMessage,
    Record,
    Restoration,
    parse_line,
)
from rosbridge_eth.config import load_robot_config
from rosbridge_eth.errors import SourceError
from rosbridge_eth.robot.sources import Selection, open_source
from rosbridge_eth.robot.sources.queue import Queue

logging.basicConfig(level=logging.INFO, stream=sys.stderr, format="%(levelname)s %(message)s")
stop, taken = threading.Event(), Counter[str]()
signal.signal(signal.SIGTERM, lambda number, frame: stop.set())
before = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]
config = load_robot_config(Path(sys.argv[1]))


def say(value: dict[str, object]) -> None:
    print(json.dumps(value), flush=True)


def rebuilt(record: Record) -> bool:
    """Whether a reader who has the lines alone gets this message from them, as far as it was captured."""
    data = parse_line(record.line).data
    restoration = Restoration(parse_line(record.definition[1]).decoder())
    restored = restoration.restore(data)
    again = restoration.decoder.decode(restoration.decoder.encode(restored.message))
    return bool(restored.missing) or Conversion(restoration.decoder).convert(again) == data


def emit(raw: RawMessage) -> None:
    taken[raw.topic] += 1
    captured = capture.process(raw, time.time_ns())
    if captured is not None:
        say({"record": json.loads(captured.line), "rebuilt": rebuilt(captured)})


try:
    source = open_source(config.source_and_why({})[0], Selection.of(config))
    capture = Capture(config.rules(), source_kind=source.kind, live=source.live)
    say(
        {
            "opened": type(source).__name__,
            "handlers_kept": before == [signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM)],
        }
    )
    queue = Queue(2 << 20 if "hold" in sys.argv else 128 << 20, waits=False)
    ended = threading.Event()

    def run() -> None:
        try:
            source.run(queue.put, stop)
        finally:
            ended.set()

    threading.Thread(target=run, name="source").start()
    if "hold" in sys.argv:
        sys.stdin.read()
    while queue or not ended.wait(0.01):
        if (raw := queue.take()) is not None:
            emit(raw)
    source.close()
except SourceError as error:
    say({"error": str(error)})
    sys.exit(error.exit_code)
for line in capture.loss_lines({**source.lost, **queue.lost}):
    say({"declared": json.loads(line)})
lost_here = {**source.lost, **queue.lost}
statistics: dict[str, dict[str, int]] = {}
for topic in {*taken, *(topic for topic, _ in lost_here)}:
    lost = {what: lost_here.get((topic, what), 0) for what in ("lost", "foreign", "dropped")}
    statistics[topic] = {"received": taken[topic] + lost["dropped"], **lost}
say({"statistics": statistics})
say({"threads": [thread.name for thread in threading.enumerate()]})

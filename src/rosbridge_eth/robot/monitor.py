"""What a robot shows of itself: a snapshot a second, over HTTP where that is configured, and to the service manager."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rosbridge_eth.operations.board import Board, Pace
from rosbridge_eth.operations.endpoint import channel_samples
from rosbridge_eth.operations.figures import Condition, Snapshot, sample
from rosbridge_eth.operations.notify import Notifier
from rosbridge_eth.operations.web import Web
from rosbridge_eth.robot.process import Robot

NAME = "robot"


def robot_snapshot(robot: Robot) -> Snapshot:
    """The robot's figures; to be called in the thread of its loop."""
    times, sender, spool = robot.recorder.times, robot.sender.statistics, robot.spool.statistics
    why = "" if sender.connected else sender.trouble or "none yet"
    return Snapshot.of(
        NAME,
        [
            *channel_samples(robot.client.statistics(), robot.loop.socket, robot.loop.lost_sends),
            sample("source_dropped", robot.dropped),
            sample("captured", times.records),
            sample("too_large", robot.recorder.too_large),
            sample("stage_seconds", times.capture, "capture"),
            sample("stage_seconds", times.seal, "seal"),
            sample("stage_seconds", times.spool, "spool"),
            sample("sent", sender.sent),
            sample("acknowledged", sender.stored, "stored"),
            sample("acknowledged", sender.confirmed, "confirmed"),
            sample("acknowledged", sender.conflicts, "conflict"),
            sample("acknowledged", sender.refused, "refused"),
            sample("acknowledged", sender.busy, "busy"),
            sample("sessions_begun", sender.sessions),
            sample("connected", sender.connected),
            sample("spool_records", spool.records),
            sample("spool_bytes", spool.bytes),
            sample("spool_removed", spool.superseded, "superseded"),
            sample("spool_removed", spool.dropped, "dropped"),
            sample("spool_removed", spool.refused, "refused"),
            sample("spool_undeclared", spool.undeclared),
        ],
        [
            Condition("robot has a session", sender.connected, why),
            Condition("spool is writable", spool.trouble is None, spool.trouble or ""),
        ],
    )


@contextmanager
def monitored(robot: Robot, address: tuple[str, int] | None) -> Iterator[Callable[[], None]]:
    """Serve the robot's figures at `address` meanwhile; what is yielded is for Robot.run's on_turn.

    NetworkError if the port cannot be had.
    """
    board, pace, notifier = Board([NAME]), Pace(), Notifier()
    web = None if address is None else Web(address, board)
    if web is not None:
        web.start()

    def on_turn() -> None:
        if pace.due(time.monotonic()):
            notifier.say("WATCHDOG=1")
            if web is not None:
                board.put(robot_snapshot(robot))

    notifier.say("READY=1")
    try:
        yield on_turn
    finally:
        notifier.say("STOPPING=1")
        if web is not None:
            web.stop()

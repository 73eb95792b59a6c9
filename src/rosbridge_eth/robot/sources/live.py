"""What live sources have in common: what they lost, and what a person is told once."""

from __future__ import annotations

import logging
import threading
from collections import Counter
from collections.abc import Mapping

from rosbridge_eth.robot.sources.protocol import Clock, Emit, Selection, Source

log = logging.getLogger(__name__)


class LiveSource(Source):
    """A graph of publishers that come and go. It runs once, until `stop` is set or it is closed."""

    live = True
    _emit: Emit

    def __init__(self, selection: Selection, clock: Clock | None) -> None:
        self._selection, self._clock = selection, clock or Clock()
        self._losses = Counter[tuple[str, str]]()  # by topic and why
        self._stop = threading.Event()
        self._said: set[str] = set()

    def watch(self, selection: Selection) -> None:
        self._selection = selection

    @property
    def lost(self) -> Mapping[tuple[str, str], int]:
        return dict(self._losses)

    def _say(self, key: str, text: str) -> None:
        """For the log, once for each key."""
        if key not in self._said:
            self._said.add(key)
            log.warning("%s", text)

    def _well_again(self, key: str) -> None:
        """What was said under this key is over; it is said again the next time."""
        if key in self._said:
            self._said.discard(key)
            log.info("%s: in order again", key)

"""What live sources have in common: a thread that receives, the queue, and what a person is told once."""

from __future__ import annotations

import logging
import threading
from abc import abstractmethod
from collections import Counter
from collections.abc import Mapping
from typing import Final

from rosbridge_eth.robot.sources.protocol import Clock, Emit, Selection, Source
from rosbridge_eth.robot.sources.queue import Queue

log = logging.getLogger(__name__)

TAKE_PATIENCE: Final = 0.1
"""Seconds after which the emitting thread looks whether it is to stop."""


class LiveSource(Source):
    """A graph of publishers that come and go. It runs once.

    size: bytes of the queue.
    """

    live = True

    def __init__(self, selection: Selection, clock: Clock | None, size: int) -> None:
        self._selection, self._clock = selection, clock or Clock()
        self._queue = Queue(size)
        self._losses = Counter[tuple[str, str]]()  # by topic and why; what the queue dropped is counted there
        self._ending = threading.Event()
        self._failure: BaseException | None = None
        self._receiving = threading.Thread(target=self._receive_until_the_end, name=self.kind, daemon=True)
        self._said: set[str] = set()

    def watch(self, selection: Selection) -> None:
        self._selection = selection

    @abstractmethod
    def _receive(self) -> None:
        """Put what arrives into the queue until `_ending` is set; in the thread that receives."""

    def _receive_until_the_end(self) -> None:
        try:
            self._receive()
        except BaseException as error:  # handed to the thread that runs the source, which raises it
            if not self._ending.is_set():
                self._failure = error
        finally:
            self._queue.close()

    def run(self, emit: Emit, stop: threading.Event) -> None:
        """Emit what arrives until `stop` is set or the source is closed. Raises SourceError.

        `emit` may block for as long as it likes: what then finds no room is dropped.
        """
        self._receiving.start()
        try:
            while not stop.is_set():
                receiving = self._receiving.is_alive()  # asked first: then nothing comes after a take in vain
                message = self._queue.take(TAKE_PATIENCE)
                if message is not None:
                    emit(message)
                elif not receiving:
                    break
        finally:
            self.close()
        if self._failure is not None:
            raise self._failure

    @property
    def lost(self) -> Mapping[tuple[str, str], int]:
        dropped = {(topic, "dropped"): count for topic, count in dict(self._queue.dropped).items()}
        return {**self._losses, **dropped}

    def _say(self, key: str, text: str) -> None:
        """For the log, once for each key."""
        if key not in self._said:
            self._said.add(key)
            log.warning("%s", text)

    def _well_again(self, key: str) -> None:
        """What was said under this key is over; it is said anew the next time."""
        if key in self._said:
            self._said.discard(key)
            log.info("%s: in order again", key)

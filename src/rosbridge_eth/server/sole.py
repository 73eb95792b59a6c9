"""One submitter for a home: a lock that the kernel lets go of when its process ends, however it ends.

With it, whoever starts next may take over the accounts and records of the one
before at once, instead of waiting until its leases run out.
"""

from __future__ import annotations

import fcntl
import logging
import os
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from rosbridge_eth.errors import StoreError

log = logging.getLogger(__name__)

LOOK_EVERY = 0.1  # seconds


@contextmanager
def sole_submitter(lock: Path, stopped: Callable[[], bool]) -> Iterator[str | None]:
    """Wait until no other process holds `lock`, and hold it; gives the name for leases, None if stopped meanwhile.

    The name is the same in every life on this machine. Raises StoreError.
    """
    try:
        file = os.open(lock, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
    except OSError as error:
        raise StoreError(f"{lock} cannot be opened: {error.strerror}") from error
    try:
        yield f"{socket.gethostname()}:{lock.resolve()}" if _wait(file, lock, stopped) else None
    finally:
        os.close(file)  # and unlocks


def _wait(file: int, lock: Path, stopped: Callable[[], bool]) -> bool:
    said = False
    while not stopped():
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return True
        except BlockingIOError:
            if not said:
                log.warning("another submitter holds %s; this one waits until it has ended", lock)
                said = True
            time.sleep(LOOK_EVERY)
        except OSError as error:
            raise StoreError(f"{lock} cannot be locked: {error.strerror}") from error
    return False

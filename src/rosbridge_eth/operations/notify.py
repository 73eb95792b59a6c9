"""Telling the service manager that a service is ready and alive: sd_notify(3), where NOTIFY_SOCKET is set."""

from __future__ import annotations

import os
import socket
from collections.abc import Mapping


class Notifier:
    """Sends states such as READY=1, WATCHDOG=1, STOPPING=1; does nothing without a service manager."""

    def __init__(self, environment: Mapping[str, str] = os.environ) -> None:
        address = environment.get("NOTIFY_SOCKET", "")
        # A leading @ is the abstract namespace, written as a zero byte.
        self._address = "\0" + address[1:] if address.startswith("@") else address

    def say(self, state: str) -> None:
        """Send one state. A service manager that is gone is not this process's concern."""
        if not self._address:
            return
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as sock:
            try:
                sock.sendto(state.encode(), self._address)
            except OSError:
                self._address = ""

"""When a process that ended is started again, and when not any more. No clock and no process here."""

from __future__ import annotations

from rosbridge_eth.errors import ExitCode

FIRST_PAUSE, LONGEST_PAUSE = 1.0, 30.0  # seconds
SHORT_LIFE = 5.0  # seconds; a process that lived longer began its work
GIVE_UP_AFTER = 6  # short lives in a row: half a minute of trying
PATIENT = frozenset({ExitCode.CHAIN, ExitCode.STORE})
"""Ends for which one waits as long as it takes: the node, the disk or Redis is away, and people mend that.

Meanwhile the figures go on telling so, and robots are answered or keep their records.
"""


class Restarts:
    """Keeps count for each process by name."""

    def __init__(self) -> None:
        self._short: dict[str, int] = {}
        self.total: dict[str, int] = {}

    def ended(self, name: str, exit_code: int | None, lived: float, *, vital: bool = True) -> float | None:
        """Seconds to wait before it is started again; None: it will not come up, give up.

        vital: without it the server is no server; what is not vital is tried for ever.
        """
        short = self._short[name] = self._short.get(name, 0) + 1 if lived < SHORT_LIFE else 0
        if vital and short >= GIVE_UP_AFTER and exit_code not in PATIENT:
            return None
        self.total[name] = self.total.get(name, 0) + 1
        return float(min(LONGEST_PAUSE, FIRST_PAUSE * 2 ** max(0, short - 1)))

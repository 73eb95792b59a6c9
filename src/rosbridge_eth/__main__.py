"""`python -m rosbridge_eth`, and the script `rosbridge-eth`."""

from __future__ import annotations

import os
import signal
import sys
from types import FrameType


def main() -> int:
    """Run the command line; without the packages of the extra [bridge], say how to get them."""
    # What was closed before Python came (None): without these, a database would be opened under its number.
    sys.stdin, sys.stdout = sys.stdin or open(os.devnull), sys.stdout or open(os.devnull)  # noqa: SIM115 - to the end
    sys.stderr = sys.stderr or open(os.devnull, "w")  # noqa: SIM115 - of the process
    ours = signal.getsignal(signal.SIGINT) is signal.default_int_handler  # a shell's background job ignores it
    if ours:
        signal.signal(signal.SIGINT, _leave)
    try:
        from rosbridge_eth.cli import run
    except ModuleNotFoundError as error:
        if error.name is None or error.name.split(".")[0] in ("rosbridge_eth", "smcrypto"):
            raise
        print(
            f"rosbridge-eth: the bridge needs the package {error.name}; install it with:"
            " pip install '.[bridge]' in a checkout, or with 'WHEEL[bridge]'",
            file=sys.stderr,
        )
        return 1
    if ours:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    return run()


def _leave(number: int, frame: FrameType | None) -> None:
    """Ctrl-C while the packages load, when nothing is begun yet: an exception would show where in them it struck."""
    os.write(2, b"rosbridge-eth: interrupted\n")
    os._exit(128 + number)


if __name__ == "__main__":
    sys.exit(main())

"""`python -m rosbridge_eth`, and the script `rosbridge-eth`."""

from __future__ import annotations

import sys


def main() -> int:
    """Run the command line; without the packages of the extra [bridge], say how to get them."""
    try:
        from rosbridge_eth.cli import run
    except ModuleNotFoundError as error:
        if error.name is None or error.name.split(".")[0] in ("rosbridge_eth", "smcrypto"):
            raise
        print(
            f"rosbridge-eth: the bridge needs the package {error.name}; install it with:"
            " pip install 'pysmcrypto[bridge]' (in a checkout: pip install '.[bridge]')",
            file=sys.stderr,
        )
        return 1
    return run()


if __name__ == "__main__":
    sys.exit(main())

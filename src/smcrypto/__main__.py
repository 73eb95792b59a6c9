"""`python -m smcrypto`; the commands are in smcrypto.cli."""

import sys

from smcrypto.cli import main

if __name__ == "__main__":
    sys.exit(main())

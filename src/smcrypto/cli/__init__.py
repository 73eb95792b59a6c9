"""`python -m smcrypto`: hashing, keys, signatures, encryption and certificates from the command line.

Built on argparse alone. Data goes to stdout or `-o`, talk and progress to
stderr. Exit codes: 0 done, 1 refused (a signature that does not hold, a
wrong password, an unreadable file), 2 a command line that makes no sense,
130 interrupted.
"""

from __future__ import annotations

import argparse
import io
import os
import sys
from collections.abc import Sequence

from smcrypto import __version__
from smcrypto.cli import ca, diagnosis, digest, encryption, keys, signature, tls
from smcrypto.errors import SMCryptoError

__all__ = ["build_parser", "main"]

EXAMPLES = """\
examples:
  python -m smcrypto hash firmware.bin
  python -m smcrypto keygen -o key.pem --public pub.pem
  python -m smcrypto sign --key key.pem -o message.sig message.txt
  python -m smcrypto verify --public pub.pem --signature message.sig message.txt
  python -m smcrypto encrypt --to pub.pem -o message.sm2 message.txt
  python -m smcrypto decrypt --key key.pem message.sm2
  python -m smcrypto encrypt --password-file pass.txt -o backup.enc backup.tar
  python -m smcrypto tls bank.example:443 --ca root.pem < request.txt
  python -m smcrypto diagnose --key key.pem whatever.txt
"""


def build_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m smcrypto",
        description="SM2, SM3 and SM4 on files and pipes; '-' or no file is stdin.",
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"smcrypto {__version__}")
    subparsers = parser.add_subparsers(required=True, metavar="command")
    for module in (digest, keys, signature, encryption, ca, tls, diagnosis):
        module.add_parser(subparsers)
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; every failure the user can act on is one line on stderr, never a traceback."""
    # Python has None for a stream that was closed before it came; what stands in its place refuses all but to be there.
    sys.stdin, sys.stdout = sys.stdin or open(os.devnull, "w"), sys.stdout or open(os.devnull)  # noqa: SIM115
    sys.stderr = sys.stderr or open(os.devnull, "w")  # noqa: SIM115
    if isinstance(sys.stdout, io.TextIOWrapper):  # names of files and people go to terminals that cannot write them
        sys.stdout.reconfigure(errors="backslashreplace")
    options = build_parser().parse_args(arguments)
    try:
        code: int = options.run(options)
        sys.stdout.flush()
    except BrokenPipeError:
        # Who reads our output has seen enough; what Python would flush at its end goes nowhere.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except io.UnsupportedOperation:
        print("smcrypto: stdin or stdout is closed", file=sys.stderr)
        return 1
    except (SMCryptoError, OSError, MemoryError) as error:
        name = getattr(error, "filename", None)
        text = f"{name}: {error.strerror}" if isinstance(error, OSError) and name else str(error)
        print(f"smcrypto: {text or type(error).__name__}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        return 130
    return code

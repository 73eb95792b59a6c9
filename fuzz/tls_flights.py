"""Handshakes of smcrypto.tls with one change each to the bytes on their way: nothing but TLSError, no hang, no growth.

    python fuzz/tls_flights.py [--runs 100000] [--seed 0]

What is changed and what must hold is in tests/tls_mutation.py; a run can be repeated by its number, which is printed
where it fails. Prints how often each outcome came: the alerts, "held" for a change that made no difference (the
version in a record's header of TLS 1.3), "waits" where the rest of a message never came.
"""

from __future__ import annotations

import argparse
import resource
import sys
import time
from collections import Counter
from pathlib import Path
from random import Random

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT / "src"), str(ROOT / "tests")]

SETTLED = 10_000  # runs after which caches (sessions, tables of keys) are full


def memory() -> int:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def main() -> None:
    from smcrypto.tls import SUITES
    from tls_mutation import mutated_handshake

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=100_000)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    outcomes: Counter[str] = Counter()
    longest, start, suites = 0.0, time.perf_counter(), list(SUITES)
    for number in range(arguments.runs):
        suite, began = suites[number % len(suites)], time.perf_counter()
        try:
            outcomes[mutated_handshake(suite, Random(f"{arguments.seed} {number}"))] += 1  # noqa: S311
        except BaseException:
            print(f"run {number} of seed {arguments.seed}, {suite}", file=sys.stderr)
            raise
        longest = max(longest, time.perf_counter() - began)
        if number <= SETTLED:
            settled = memory()
    for outcome, count in outcomes.most_common():
        print(f"{count:8,}  {outcome}")
    seconds = time.perf_counter() - start
    print(f"{seconds:.0f} s; the longest {1000 * longest:.0f} ms")
    print(f"most memory of the process: {memory():,} KiB, after {SETTLED:,} runs {settled:,} KiB")


if __name__ == "__main__":
    main()

"""Draw the tables of docs/ledger.md: gas, measured on the EVM.

    python contracts/document.py            rewrites what stands between the markers
    python contracts/document.py --check    compares instead; exit code 1 if they differ
"""

from __future__ import annotations

import random
import re
import sys
from pathlib import Path

from eth.vm.forks.cancun import CancunVM
from eth.vm.forks.prague import PragueVM

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT / "src"))

from rosbridge_eth.ledger import Keyring, Ledger  # noqa: E402
from rosbridge_eth.ledger.nodes import EmbeddedChain  # noqa: E402
from rosbridge_eth.log.chunk import robot_id  # noqa: E402

PAGE = ROOT / "docs" / "ledger.md"
PAPER = 268_924  # gas of one record of 256 bytes in the paper's contract
ROBOT, OTHER = robot_id("robot_1"), robot_id("robot_2")
CERTIFICATES = 1_200  # bytes; two certificates in DER
ETH = 10**18
BATCHES = [  # records in a chunk, its bytes, chunks in a batch: the sample's Odometry, whole
    (1, 788, 1), (1, 788, 120), (10, 1_428, 1), (10, 1_428, 68), (100, 7_508, 1), (100, 7_508, 4), (100, 7_508, 13),
]  # fmt: skip


class Measurement:
    """A deployed contract, one robot, and what calls cost there."""

    def __init__(self, rules: type) -> None:
        keyring = Keyring.from_mnemonic("test " * 11 + "junk")
        self.operator, self.robot, self.other = keyring.operator, keyring.account(1), keyring.account(2)
        self.random = random.Random(1)  # noqa: S311 - chunks for measuring, the same each time
        wealth = {account.address: 1000 * ETH for account in (self.operator, self.robot)}
        self.ledger, receipt = Ledger.deploy(EmbeddedChain(wealth, rules=rules), self.operator)
        self.calls = {"deployment": receipt.gas_used}
        certificates = self.random.randbytes(CERTIFICATES)
        self.calls["`registration`"] = self.do("registration", ROBOT, self.robot.address, certificates)
        self.write(1, 1)  # the first write sets slots that later ones only change

    def do(self, function: str, *arguments: object, value: int = 0) -> int:
        return self.ledger.transact(self.operator, function, *arguments, value=value).gas_used

    def write(self, count: int, size: int) -> int:
        return self.ledger.set_data(self.robot, ROBOT, [self.random.randbytes(size) for _ in range(count)]).gas_used


def gas_tables() -> str:
    prague, before = Measurement(PragueVM), Measurement(CancunVM)
    lines = [
        "| records in a chunk | bytes of a chunk | chunks in a batch | gas a record | before Prague | the paper's |",
        "| ---: | ---: | ---: | ---: | ---: | ---: |",
    ]
    for records, size, count in BATCHES:
        now, then = (measured.write(count, size) / records / count for measured in (prague, before))
        row = (records, f"{size:,}", count, f"{now:,.0f}", f"{then:,.0f}", f"{PAPER:,}")
        lines.append(f"| {' | '.join(map(str, row))} |")
    calls = prague.calls
    calls["`replaceRegistration`"] = prague.do(
        "replaceRegistration", ROBOT, prague.other.address, prague.random.randbytes(CERTIFICATES)
    )
    calls["`allocETH`"] = prague.do("allocETH", prague.other.address, value=ETH)
    calls["`revokeRobot`"] = prague.do("revokeRobot", ROBOT)
    lines += ["", "| call | gas |", "| --- | ---: |", *(f"| {name} | {gas:,} |" for name, gas in calls.items())]
    return "\n".join(lines)


def drawn(page: str) -> str:
    text = gas_tables()
    between = re.compile(r"(<!-- gas -->\n).*?(<!-- /gas -->)", re.DOTALL)
    page, found = between.subn(lambda m: f"{m[1]}{text}\n{m[2]}", page)
    if found != 1:
        raise SystemExit(f"{PAGE.name} needs one pair of markers <!-- gas --> <!-- /gas -->")
    return page


def main(arguments: list[str]) -> int:
    page = PAGE.read_text("utf-8")
    new = drawn(page)
    if arguments == ["--check"]:
        print("the page shows the code as it is" if new == page else "the page differs: run contracts/document.py")
        return int(new != page)
    PAGE.write_text(new, "utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

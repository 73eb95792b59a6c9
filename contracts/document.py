"""Draw the tables and the diagram of docs/ledger.md from the code: gas measured on the EVM, states from TRANSITIONS.

    python contracts/document.py            rewrites what stands between the markers
    python contracts/document.py --check    compares instead; exit code 1 if they differ
"""

from __future__ import annotations

import random
import re
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT / "src"))

from rosbridge_eth import ledger  # noqa: E402
from rosbridge_eth.ledger import packing  # noqa: E402
from rosbridge_eth.ledger.accounts import Keyring  # noqa: E402
from rosbridge_eth.ledger.chain import Call  # noqa: E402
from rosbridge_eth.ledger.contract import Contract, calldata  # noqa: E402
from rosbridge_eth.ledger.embedded import EmbeddedChain  # noqa: E402
from rosbridge_eth.ledger.states import TRANSITIONS, Event, State  # noqa: E402
from rosbridge_eth.records import RecordId, SealedRecord, robot_id  # noqa: E402

PAGE = ROOT / "docs" / "ledger.md"
PAPER = {256: 268_924, 1024: 813_415}  # gas of one record in the paper's contract
ROBOT = robot_id("robot_1")
CERTIFICATES = 1_200  # bytes; two certificates in DER
ETH = 10**18


class Measurement:
    """A deployed contract, one robot, and what calls cost there."""

    def __init__(self) -> None:
        keyring = Keyring.from_mnemonic("test " * 11 + "junk")
        self.operator, self.robot = keyring.operator, keyring.robot(1)
        self.chain = EmbeddedChain(fund={self.operator.address: 100 * ETH}, clock=lambda: 1_700_000_000)
        self.random = random.Random(1)  # noqa: S311 - ciphertexts for measuring, the same each time
        self.contract: Contract = ledger.deploy(self.chain, self.operator)
        self.deployment = self.last_gas()
        self.calls: dict[str, int] = {}
        self.do("registration", ROBOT, self.robot.address, self.random.randbytes(CERTIFICATES))
        self.do("allocETH", self.robot.address, value=ETH)
        self.write(1, 256)  # the first write sets slots that later ones only change

    def do(self, function: str, *arguments: object, value: int = 0) -> None:
        receipt = self.contract.transact(self.operator, function, *arguments, value=value)
        self.calls[function] = receipt.gas_used

    def last_gas(self) -> int:
        contract_block = self.chain.head().number
        return sum(r.gas_used for r in self.chain.receipts_of(contract_block))

    def records(self, count: int, size: int) -> list[SealedRecord]:
        stream = self.random.randbytes(16)
        return [SealedRecord(RecordId(ROBOT, stream, 1000 + i), self.random.randbytes(size)) for i in range(count)]

    def write(self, count: int, size: int) -> tuple[int, int]:
        """Gas of a batch: as charged under Prague, and what executing it takes."""
        index = self.contract.robot(ROBOT).batches
        data = calldata("setBatch", ROBOT, index, packing.pack(self.records(count, size)))
        executed = self.chain.execution_gas(Call(self.contract.address, data, self.robot.address))
        receipt = self.contract.transact(
            self.robot, "setBatch", ROBOT, index, packing.pack(self.records(count, size))
        )
        return receipt.gas_used, executed


def gas_tables() -> str:
    measured = Measurement()
    lines = [
        "| records in a batch | bytes each | gas per record | of it execution | the paper's storage | ratio |",
        "| ---: | ---: | ---: | ---: | ---: | ---: |",
    ]
    for size in (256, 1024):
        for count in (1, 10, 100) if size == 256 else (1, 10, 80):
            charged, executed = measured.write(count, size)
            each, paper = charged / count, PAPER[size]
            row = (count, size, f"{each:,.0f}", f"{executed / count:,.0f}", f"{paper:,}", f"{paper / each:.1f}")
            lines.append(f"| {' | '.join(map(str, row))} |")
    measured.do("revokeRobot", ROBOT)
    lines += ["", "| call | gas |", "| --- | ---: |", f"| deployment | {measured.deployment:,} |"]
    lines += [f"| `{name}` | {gas:,} |" for name, gas in measured.calls.items()]
    return "\n".join(lines)


def state_table() -> str:
    lines = ["| state | event | becomes |", "| --- | --- | --- |"]
    order = {state: i for i, state in enumerate(State)}
    for (state, event), target in sorted(TRANSITIONS.items(), key=lambda item: order[item[0][0]]):
        lines.append(f"| {state} | {event} | {target} |")
    return "\n".join(lines)


def diagram() -> str:
    """The ordinary way and what leads back to it; what concerns halves is in the table alone."""
    rare = {State.SPLIT, State.VOID, State.DEAD}
    lines = ["```mermaid", "stateDiagram-v2", "    [*] --> sealed"]
    for (state, event), target in TRANSITIONS.items():
        if not {state, target} & rare and event is not Event.SUPERSEDED:
            lines.append(f"    {state} --> {target}: {event}")
    return "\n".join([*lines, "    acknowledged --> [*]", "```"])


def drawn(page: str) -> str:
    for name, text in (("gas", gas_tables()), ("diagram", diagram()), ("states", state_table())):
        page, found = re.subn(
            rf"(<!-- {name} -->\n).*?(<!-- /{name} -->)", lambda m, t=text: f"{m[1]}{t}\n{m[2]}", page, flags=re.DOTALL
        )
        if found != 1:
            raise SystemExit(f"{PAGE.name} needs one pair of markers <!-- {name} --> <!-- /{name} -->")
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

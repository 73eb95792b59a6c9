"""A robot's log on a real node, for evidence: two robots, batches, a block with many transactions, a replacement."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from bridge.reading.world import NAME, START, Pen, authority, message, reader, robot
from rosbridge_eth.identity import Role, Trust, enrol
from rosbridge_eth.ledger import Keyring, Ledger
from rosbridge_eth.ledger.contract import Fees
from rosbridge_eth.ledger.nodes import Anvil
from rosbridge_eth.log.chunk import Chunk, Log, robot_id
from rosbridge_eth.reading import Choice, read_robot
from rosbridge_eth.reading.evidence import Evidence, make
from smcrypto.x509 import Certificate

KEYS = Keyring.from_mnemonic("test " * 11 + "junk")  # the accounts to which anvil gives ETH
T = 1_795_342_000 * 10**9
ROOTS = [authority().certificate]
EVIL = "</script><script>document.title='owned'</script><!-- \u202e gnp.exe <img src=x onerror=x()> \\u003c é\U0001f916"


def odometry(n: int, topic: str = "/robot_1/odom") -> bytes:
    """The n-th of a robot that drives in a spiral, ten a second."""
    position = {"x": 3 * math.cos(n / 20) + n / 80, "y": 3 * math.sin(n / 20), "z": 0.0}
    return message(T + n * 10**8, topic, pose={"pose": {"position": position}, "covariance": [0.1] * 36})


@dataclass
class Recorded:
    """The contract on a node, and robot_1's log there."""

    ledger: Ledger
    pen: Pen = field(default_factory=Pen)
    account: Any = field(default_factory=lambda: KEYS.account(1))

    def __post_init__(self) -> None:
        self.pen.log = Log(self.ledger.ledger, robot_id(NAME))
        self.pen.sealed_ms = T // 10**6
        certificates = self.pen.identity.public.certificates
        self.ledger.registration(KEYS.operator, self.pen.log.tk, self.account.address, certificates)

    def write(self, *chunks: Chunk, on_chain: Sequence[bytes] = ()) -> None:
        self.ledger.set_data(self.account, self.pen.log.tk, on_chain or [chunk.encoded for chunk in chunks])

    def evidence(self, choice: Choice, roots: Sequence[Certificate] = ROOTS, **more: Any) -> Evidence:
        """As the command makes it: of a log that was read to its end."""
        reading = read_robot(
            [self.ledger], NAME, trust=Trust(roots), reader=reader().encryption_key, now=time.time(), **more
        )
        return make(reading, list(reading.records(choice)))


def at(seconds: float) -> int:
    return T + round(seconds * 10**9)


def in_a_crowd(node: Anvil, recorded: Recorded, chunks: Sequence[Chunk], crowd: int) -> None:
    """A batch in one block behind so many transactions of somebody else."""
    ledger, other, data = recorded.ledger, KEYS.account(9), [chunk.encoded for chunk in chunks]
    node.ask("evm_setAutomine", False)
    fees = ledger.fees(ledger.block())
    [(nonce, _)] = ledger.nonces([other.address])
    dear = Fees(fees.highest * 20, None if fees.tip is None else fees.tip * 10)
    calls = [ledger.sign(other, b"", nonce=nonce + n, gas=30_000, fees=dear).raw for n in range(crowd)]
    [standing] = ledger.standings([recorded.pen.log.tk])
    call = ledger.calldata("setData", recorded.pen.log.tk, standing.chunks, standing.tail, data)
    [(mine, _)] = ledger.nonces([recorded.account.address])
    calls.append(ledger.sign(recorded.account, call, nonce=mine, gas=3_000_000, fees=fees).raw)
    assert ledger.send(calls) == [None] * len(calls)
    node.ask("evm_mine")
    node.ask("evm_setAutomine", True)


def record(node: Anvil) -> Recorded:
    """Two robots, eight chunks of robot_1 under its first certificate, two under the next."""
    ledger, _ = Ledger.deploy(node.url, KEYS.operator)
    made = Recorded(ledger)
    other = enrol(authority(), Role.ROBOT, "robot_2", at=START)
    ledger.registration(KEYS.operator, robot_id("robot_2"), KEYS.account(5).address, other.public.certificates)
    for batch in range(3):
        first = batch * 40
        made.write(*(
            made.pen.write(
                *(odometry(n) for n in range(begin, begin + 20)), message(at(begin / 10), "/secret", text="not shown"),
            ) for begin in (first, first + 20)
        ))  # fmt: skip
        ledger.set_data(KEYS.account(5), robot_id("robot_2"), [f"another robot's {batch}".encode()])
    in_a_crowd(node, made, [made.pen.write(*(odometry(n) for n in range(120, 140)))], 130)
    made.write(made.pen.write(message(at(14), "/evil", text=EVIL, big=2**62), odometry(140)))
    account = KEYS.account(2)
    ledger.replace_registration(KEYS.operator, made.pen.log.tk, account.address, robot(1).public.certificates)
    made.pen.identity, made.account = robot(1), account
    made.pen.new_stream(b"b" * 16)
    made.write(*(made.pen.write(odometry(n)) for n in (150, 151)))
    return made

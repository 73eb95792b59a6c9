"""The same records into an ordinary replicated log with an anchor on the chain, beside the bridge, in one run.

    python -m benchmarks.paper --only baseline

The ordinary way: a robot adds each captured line to a stream of a Redis with a replica (XADD, WAIT 1; both fsync every
write), and an anchorer reads the stream, keeps SHA-256 over what it has read, and writes that hash to the chain once a
batch (a transaction with 32 bytes). The bridge: bridge_costs.py's stages, with as many records to a chunk as the other
has to a batch. Captured are the sample bag's Odometry, pose and twist. Costs are processor time; Redis' own is what it
says of itself. What each of the two gives stands in docs/evaluation.md.
"""

from __future__ import annotations

import hashlib
import shutil
import subprocess
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from itertools import islice
from pathlib import Path
from typing import Any

import redis
from eth_account.signers.local import LocalAccount
from web3 import Web3

import bridge_costs
from geth_network import Unavailable
from load import DURABLE
from ports import free_port
from rosbridge_eth.capture import Capture
from rosbridge_eth.ledger import Keyring
from rosbridge_eth.ledger.nodes import EmbeddedChain

STREAM = "records"
PER_BATCH = 100
SETTLED = 10.0  # seconds that a replica has to connect


@contextmanager
def replicated(folder: Path) -> Iterator[tuple[redis.Redis, redis.Redis]]:
    """A Redis and its replica, both of which fsync every write."""
    program = shutil.which("redis-server")
    if program is None:
        raise Unavailable("the program 'redis-server' is not installed")
    ports, clients = [free_port(), free_port()], list[redis.Redis]()
    with ExitStack() as stack:
        for port in ports:
            home = folder / str(port)
            home.mkdir()
            command = [program, "--port", str(port), "--bind", "127.0.0.1", "--dir", str(home), *DURABLE]
            if port != ports[0]:
                command += ["--replicaof", "127.0.0.1", str(ports[0])]
            process = subprocess.Popen(command, stdout=subprocess.DEVNULL)
            stack.callback(process.wait)
            stack.callback(process.terminate)
            clients.append(stack.enter_context(redis.Redis(port=port, retry_on_error=[redis.ConnectionError])))
        deadline = time.monotonic() + SETTLED
        while not _replicates(clients[0]):
            if time.monotonic() > deadline:
                raise Unavailable("the replica does not connect")
            time.sleep(0.05)
        yield clients[0], clients[1]


def _replicates(first: redis.Redis) -> bool:
    try:
        return bool(first.ping()) and first.wait(1, 100) == 1
    except redis.ConnectionError:
        return False


def _processor(client: redis.Redis) -> float:
    """Seconds of the processor that a Redis has used."""
    used: Any = client.info("cpu")
    return float(used["used_cpu_user"] + used["used_cpu_sys"])


def ordinary(folder: Path, records: int, per_batch: int) -> dict[str, float]:
    """Capture, add, replicate and anchor; milliseconds a record of each part, gas a record, records a second."""
    watch = bridge_costs.Stopwatch()
    capture = Capture([bridge_costs.rule(False)], source_kind="bag")
    messages, digest, anchors, size, place = iter(bridge_costs.Odometry(records)), hashlib.sha256(), 0, 0, "0"
    keys = Keyring.create()
    chain, gas = Web3(EmbeddedChain(fund={keys.operator.address: 10**21})), 0
    with replicated(folder) as (first, second):
        before = [_processor(one) for one in (first, second)]
        while taken := list(islice(messages, per_batch)):
            with watch("capture"):
                captured = [capture.process(raw, time.time_ns(), True) for raw in taken]
            with watch("add"):
                adding = first.pipeline(transaction=False)
                for record in captured:
                    assert record is not None
                    adding.xadd(STREAM, {"robot_1": record.line})
                adding.execute()
                if first.wait(1, 5000) != 1:
                    raise SystemExit("the replica did not acknowledge")
            with watch("anchor"):
                read: Any = first.xread({STREAM: place}, count=per_batch)
                [(_, entries)] = read
                for place_, fields in entries:
                    line = fields[b"robot_1"]
                    digest.update(len(line).to_bytes(4, "big") + line)
                    place, size = place_, size + len(line)
                anchors += 1
            gas += anchor(chain, keys.operator, anchors - 1, digest.digest())
        used = [_processor(one) - then for one, then in zip((first, second), before, strict=True)]
        stored = first.xlen(STREAM)
    if stored != records:
        raise SystemExit(f"{stored} of {records} records are there")
    each = {stage: seconds / records * 1000 for stage, seconds in watch.seconds.items()}
    return {
        "robot_ms": each["capture"] + each["add"], "server_ms": sum(used) / records * 1000 + each["anchor"],
        "gas": gas / records, "bytes": size / records,
        "records_per_second": records / (watch.wall["capture"] + watch.wall["add"]),
    }  # fmt: skip


def anchor(chain: Web3, account: LocalAccount, nonce: int, digest: bytes) -> int:
    """Write a hash to the chain, from the account to itself; the gas it takes."""
    raw = account.sign_transaction({
        "to": account.address, "value": 0, "data": digest, "gas": 30_000, "nonce": nonce,
        "chainId": chain.eth.chain_id, "maxFeePerGas": 10**10, "maxPriorityFeePerGas": 1,
    }).raw_transaction  # fmt: skip
    return int(chain.eth.wait_for_transaction_receipt(chain.eth.send_raw_transaction(raw))["gasUsed"])


def bridge(records: int, per_batch: int) -> dict[str, float]:
    """The same figures of the bridge."""
    who = bridge_costs.Identities()
    with tempfile.TemporaryDirectory() as folder:
        found = bridge_costs.stage_costs(who, Path(folder), records, per_batch, False)
        rate, _, _, _ = bridge_costs.throughput(who, Path(folder), records, False)
    costs, chunks = found["costs"], found["chunks"]
    return {
        "robot_ms": sum(processor for processor, _ in costs["robot"].values()),
        "server_ms": sum(processor for processor, _ in costs["server"].values()),
        "gas": bridge_costs.gas(chunks) / records, "bytes": sum(len(chunk.encoded) for chunk in chunks) / records,
        "records_per_second": rate,
    }  # fmt: skip


def measure(quick: bool) -> dict[str, Any]:
    """Both, one after the other; the figures of docs/evaluation.md."""
    records = 500 if quick else 20_000
    with tempfile.TemporaryDirectory() as folder:
        plain = ordinary(Path(folder), records, PER_BATCH)
    return {"records": records, "per_batch": PER_BATCH, "ordinary": plain, "bridge": bridge(records, PER_BATCH)}

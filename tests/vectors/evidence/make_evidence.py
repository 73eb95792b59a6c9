"""Makes span.json and ca.crt.pem beside this file: evidence of five records, of a log recorded on anvil.

    PYTHONPATH=src:tests:benchmarks python tests/vectors/evidence/make_evidence.py

Keys, times and blocks are new every time; docs/evidence.md says what the file is.
"""

from __future__ import annotations

from pathlib import Path

from bridge.reading.recorded import ROOTS, at, record
from ports import free_port
from rosbridge_eth.ledger.nodes import Anvil
from rosbridge_eth.reading import Choice

FOLDER = Path(__file__).parent

if __name__ == "__main__":
    with Anvil.start(free_port()) as node:
        text = record(node).evidence(Choice("/robot_1/odom", from_ns=at(13.8))).encode()
    (FOLDER / "span.json").write_text(text + "\n")
    (FOLDER / "ca.crt.pem").write_bytes(ROOTS[0].to_pem())

"""docs/ledger.md shows the code as it is, and a record costs what was promised."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import pytest

from bridge.ledger.world import ACCOUNT, ROBOT, Ledger, Records
from rosbridge_eth.ledger import packing
from rosbridge_eth.ledger.contract import artifact

DOCUMENT = Path(__file__).resolve().parents[3] / "contracts" / "document.py"


@pytest.fixture(scope="module")
def document():
    spec = importlib.util.spec_from_file_location("contracts_document", DOCUMENT)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_tables_and_diagram_are_those_of_the_code(document):
    page = document.PAGE.read_text("utf-8")
    assert document.drawn(page) == page


def test_every_call_event_and_error_is_described():
    page = (DOCUMENT.parents[1] / "docs" / "ledger.md").read_text("utf-8")
    for item in artifact()["abi"]:
        if item["type"] in ("function", "event", "error") and item["name"] not in ("BALANCE_LIMIT", "offeredOperator"):
            assert f"`{item['name']}" in page, item["name"]


def test_a_record_of_256_bytes_costs_at_most_15_000_gas_in_a_batch_of_100(made: Ledger, records: Records):
    receipt = made.contract.transact(ACCOUNT, "setBatch", ROBOT, 0, packing.pack(records.run(100)))
    assert receipt.gas_used / 100 <= 15_000
    assert receipt.gas_used / 100 <= 10_800  # what it is; a change for the worse should be noticed

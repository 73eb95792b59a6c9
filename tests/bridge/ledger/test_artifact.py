"""The committed artifact is what the compiler makes of the source."""

from __future__ import annotations

import importlib.util
import shutil
from pathlib import Path

import pytest

from conftest import unavailable
from rosbridge_eth.ledger.contract import artifact

CONTRACTS = Path(__file__).resolve().parents[3] / "contracts"


def load_build():
    spec = importlib.util.spec_from_file_location("contracts_build", CONTRACTS / "build.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.service
def test_the_artifact_is_that_of_the_source():
    pytest.importorskip("solcx")
    build = load_build()
    if not shutil.which("solc") and not (shutil.which("node") and shutil.which("npm")):
        unavailable("neither solc nor node and npm are installed")
    try:
        compiled = build.build()
    except build.CompilerMissing as error:
        unavailable(str(error))
    assert build.rendered(compiled) == build.ARTIFACT.read_text("utf-8")


def test_the_artifact_says_how_it_was_made():
    made = artifact()
    assert made["compiler"] == "solc 0.8.37"
    assert made["settings"]["evmVersion"] == "paris"
    assert made["settings"]["optimizer"]["enabled"] is True


def test_the_code_fits_a_contract_and_needs_no_opcode_after_paris():
    code = bytes.fromhex(artifact()["deployedBytecode"])
    assert len(code) <= 24_576  # EIP-170
    position = 0
    while position < len(code):
        opcode = code[position]
        assert opcode not in (0x5F, 0x5C, 0x5D, 0x5E, 0x49, 0x4A)  # PUSH0, TLOAD, TSTORE, MCOPY, BLOBHASH, BLOBBASEFEE
        position += 1 + (opcode - 0x5F if 0x60 <= opcode <= 0x7F else 0)


def test_the_page_has_the_gas_of_this_code():
    spec = importlib.util.spec_from_file_location("contracts_document", CONTRACTS / "document.py")
    assert spec is not None
    assert spec.loader is not None
    document = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(document)
    page = document.PAGE.read_text("utf-8")
    assert document.drawn(page) == page

"""Compile RobotLedger.sol into the artifact that the package carries.

    python contracts/build.py            writes src/rosbridge_eth/ledger/artifact/RobotLedger.json
    python contracts/build.py --check    compares instead; exit code 1 if they differ

The compiler is asked through py-solc-x. A native solc of exactly VERSION is used where there is
one (installed by py-solc-x or in PATH); otherwise npm's build of the same compiler, which is the
same source compiled to WebAssembly, behind solc.js. Both give the same bytecode.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
SOURCE = HERE / "RobotLedger.sol"
ARTIFACT = HERE.parent / "src/rosbridge_eth/ledger/artifact/RobotLedger.json"
VERSION = "0.8.37"
SETTINGS: dict[str, Any] = {
    "optimizer": {"enabled": True, "runs": 10_000},
    "evmVersion": "paris",  # no PUSH0: the bytecode runs on networks that stopped there
    # The hash of the metadata would change with every comment; without it the bytecode is the code.
    "metadata": {"bytecodeHash": "none", "appendCBOR": False},
    "outputSelection": {"*": {"*": ["abi", "evm.bytecode.object", "evm.deployedBytecode.object"]}},
}


class CompilerMissing(RuntimeError):
    """Neither a native solc of the right version nor npm with its solc package can be had."""


def _run(command: list[str]) -> subprocess.CompletedProcess[str]:
    return subprocess.run(command, capture_output=True, text=True)  # noqa: S603 - fixed programs, no shell


def compiler() -> Path:
    """A program that answers py-solc-x as solc VERSION does."""
    import solcx  # type: ignore[import-not-found, import-untyped, unused-ignore]

    native = shutil.which("solc")
    if native and VERSION in _run([native, "--version"]).stdout:
        return Path(native)
    if any(str(version) == VERSION for version in solcx.get_installed_solc_versions()):
        return Path(solcx.install.get_executable(VERSION))
    if not (shutil.which("node") and shutil.which("npm")):
        raise CompilerMissing(f"solc {VERSION} needs either a native solc of that version or node and npm")
    folder = Path(os.environ.get("SOLC_JS_FOLDER", Path(tempfile.gettempdir()) / f"rosbridge-eth-solc-{VERSION}"))
    module = folder / "node_modules" / "solc"
    if not (module / "soljson.js").exists():
        folder.mkdir(parents=True, exist_ok=True)
        done = _run(["npm", "install", "--silent", "--no-save", "--prefix", str(folder), f"solc@{VERSION}"])
        if done.returncode or not (module / "soljson.js").exists():
            raise CompilerMissing(f"npm could not install solc@{VERSION}: {done.stderr.strip()}")
    os.environ["SOLC_JS"] = str(module)
    return HERE / "solc.js"


def build() -> dict[str, Any]:
    """The artifact: abi, creation and runtime bytecode, and what they were compiled from and with."""
    import solcx

    request = {
        "language": "Solidity",
        "sources": {SOURCE.name: {"content": SOURCE.read_text("utf-8")}},
        "settings": SETTINGS,
    }
    answer = solcx.compile_standard(request, solc_binary=compiler())
    for problem in answer.get("errors", []):
        print(problem["formattedMessage"], file=sys.stderr)
    contract = answer["contracts"][SOURCE.name]["RobotLedger"]
    return {
        "contract": "RobotLedger",
        "compiler": f"solc {VERSION}",
        "settings": {key: SETTINGS[key] for key in ("optimizer", "evmVersion", "metadata")},
        "abi": contract["abi"],
        "bytecode": contract["evm"]["bytecode"]["object"],
        "deployedBytecode": contract["evm"]["deployedBytecode"]["object"],
    }


def rendered(artifact: dict[str, Any]) -> str:
    return json.dumps(artifact, indent=1, sort_keys=True) + "\n"


def main(arguments: list[str]) -> int:
    text = rendered(build())
    if arguments == ["--check"]:
        same = ARTIFACT.read_text("utf-8") == text
        print("the artifact is that of the source" if same else "the artifact differs: run contracts/build.py")
        return 0 if same else 1
    ARTIFACT.parent.mkdir(parents=True, exist_ok=True)
    ARTIFACT.write_text(text, "utf-8")
    print(f"{ARTIFACT.name}: {len(json.loads(text)['deployedBytecode']) // 2} bytes of code")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

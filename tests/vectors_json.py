"""Reading the JSON vector files: hex fields become bytes, each case keeps its source as test id.

`standards/` lies beside the tests. `third_party/` belongs to other projects
and is read from SM_THIRD_PARTY_VECTORS, or from ../shared/vectors/third_party
beside the checkout; where neither is there, those tests skip and say so.
"""

from __future__ import annotations

import json
import os
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

STANDARDS = Path(__file__).parent / "vectors" / "standards"
_SHARED = Path(__file__).resolve().parents[2] / "shared" / "vectors" / "third_party"
# Kept as text: everything else in a vector file is hex.
_TEXT = {"source", "comment", "result", "mode", "padding", "standard", "curve", "format", "flags", "kind",
         "verified_with", "pem", "issuer_pem", "openssl_3_0_19", "openssl_3_0_19_load_and_pubcheck", "name"}


def _third_party() -> Path:
    return Path(os.environ.get("SM_THIRD_PARTY_VECTORS", _SHARED))


def _decode(key: str, value: Any) -> Any:
    if isinstance(value, str) and key not in _TEXT:
        return bytes.fromhex(value.rjust(len(value) + len(value) % 2, "0"))  # numbers may have an odd digit
    if key == "msg_repeat":
        return bytes.fromhex(value["unit"]) * value["count"]
    return value


def case(raw: dict[str, Any]) -> SimpleNamespace:
    fields = {key: _decode(key, value) for key, value in raw.items()}
    if "msg_repeat" in fields:
        fields["msg"] = fields.pop("msg_repeat")
    return SimpleNamespace(**fields)


def load(name: str, section: str = "tests", **where: Any) -> list[Any]:
    """Cases of `standards/NAME` or `third_party/NAME` whose fields equal `where`, as pytest params.

    A missing third-party file gives one case that skips with the reason
    (fails where REQUIRE_SERVICES=1, as CI has the files).
    """
    folder, _, file = name.partition("/")
    path = {"standards": STANDARDS, "third_party": _third_party()}[folder] / file
    if not path.exists():
        reason = f"third-party vectors not found: {file} (set SM_THIRD_PARTY_VECTORS)"
        if os.environ.get("REQUIRE_SERVICES") == "1":
            raise FileNotFoundError(reason)
        return [pytest.param(None, marks=pytest.mark.skip(reason=reason))]
    cases = []
    for index, raw in enumerate(json.loads(path.read_text())[section]):
        if all(raw.get(key) == value for key, value in where.items()):
            label = " ".join(str(raw[k]) for k in ("source", "comment") if raw.get(k))
            cases.append(pytest.param(case(raw), id=f"{index}-{label}"))
    if not cases:
        raise LookupError(f"{name}: no case in {section!r} with {where}")
    return cases

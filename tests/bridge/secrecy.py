"""Asking whether bytes that others can see betray what was captured."""

from __future__ import annotations

import base64
import json
from collections.abc import Iterable, Iterator
from typing import Any

SHORTEST = 4
"""Bytes. Shorter values (0, true, "x") are found in any random bytes by chance."""


def secrets_of(payload: bytes) -> set[bytes]:
    """Everything of a captured record that may not be seen: member names, strings, numbers as text."""
    return {text for text in _texts(json.loads(payload)) if len(text) >= SHORTEST}


def _texts(value: Any) -> Iterator[bytes]:
    if isinstance(value, dict):
        for name, below in value.items():
            yield name.encode()
            yield from _texts(below)
    elif isinstance(value, list):
        for below in value:
            yield from _texts(below)
    else:
        text = value if isinstance(value, str) else json.dumps(value)
        yield text.encode()
        if isinstance(value, str):
            yield from (part.encode() for part in value.split("/"))


def assert_hidden(seen: bytes, secrets: Iterable[bytes]) -> None:
    """Fail if a secret is in `seen`: as it is, in hex, or in base64 at any of its three alignments."""
    lowered = seen.lower()
    for secret in secrets:
        assert secret not in seen, f"{secret!r} is in the clear"
        assert secret.hex().encode() not in lowered, f"{secret!r} is there in hex"
        for shift in range(3):
            # The characters that depend on what stands before and after are left out.
            code = base64.b64encode(b"\0" * shift + secret)[4 if shift else 0 : -4]
            assert len(code) < 2 * SHORTEST or code not in seen, f"{secret!r} is there in base64"

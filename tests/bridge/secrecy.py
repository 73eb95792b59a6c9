"""Asking whether bytes that others can see betray what was captured."""

from __future__ import annotations

import base64
from collections.abc import Iterable, Iterator
from typing import Any

SHORTEST = 4
"""Bytes. Shorter values (0, true, "x") are found in any random bytes by chance."""
_GRAM, _FEW = 8, 2000


def leaves(value: Any) -> Iterator[Any]:
    """All strings, numbers and booleans of a JSON value, and the names of its members."""
    if isinstance(value, dict):
        for name, part in value.items():
            yield name
            yield from leaves(part)
    elif isinstance(value, list):
        for part in value:
            yield from leaves(part)
    else:
        yield value


def forms(secret: bytes) -> Iterator[tuple[str, bytes]]:
    """How a secret may stand somewhere: as it is, in hex, in base64 at each of its three alignments."""
    yield "as it is", secret
    yield "in hex", secret.hex().encode()
    yield "in hex", secret.hex().upper().encode()
    for shift in range(3):
        # The characters that depend on what stands before and after are left out.
        code = base64.b64encode(b"\0" * shift + secret)[4 if shift else 0 : -4]
        if len(code) >= 2 * SHORTEST:
            yield "in base64", code


def betrayed(seen: bytes, secrets: Iterable[bytes]) -> list[str]:
    """What of `secrets` stands in `seen`, and how."""
    sought = [(how, form, secret) for secret in set(secrets) for how, form in forms(secret)]
    few = sought if len(sought) < _FEW else [one for one in sought if len(one[1]) < _GRAM]
    found = {f"{secret!r} {how}" for how, form, secret in few if form in seen}
    if len(few) < len(sought):
        # One pass over what is seen for thousands of secrets: their first bytes lead to them.
        by_gram: dict[bytes, list[tuple[str, bytes, bytes]]] = {}
        for one in sought:
            by_gram.setdefault(one[1][:_GRAM], []).append(one)
        for start in range(len(seen) - _GRAM + 1):
            for how, form, secret in by_gram.get(seen[start : start + _GRAM], ()):
                if seen.startswith(form, start):
                    found.add(f"{secret!r} {how}")
    return sorted(found)

"""Packages of others that compute faster what this library computes as well: chosen at once, imported late.

A package is chosen when the module that uses it is imported, by looking whether it is installed; SMCRYPTO_PURE=1 in
the environment chooses none. The package itself is imported later, since that takes 25 to 35 ms: when so much has been
computed in Python that this would have paid, or at once if the program has imported it anyway.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from importlib.util import find_spec
from typing import Generic, TypeVar

__all__ = ["OptionalEngine"]

_T = TypeVar("_T")


class OptionalEngine(Generic[_T]):
    """One package. load: imports it and gives what is used of it, or None if it does not work here.

    worth: after so much work, in units of the caller's, it is imported.
    name: the package's, or "python" where that is not there, not wanted, or has proved not to work.
    """

    def __init__(self, package: str, load: Callable[[], _T | None], worth: int) -> None:
        self._package, self._load, self._missing = package, load, worth
        self._loaded: _T | None = None
        self.name = package if os.environ.get("SMCRYPTO_PURE") != "1" and _installed(package) else "python"

    def after(self, work: int) -> _T | None:
        """What was loaded, for the next `work` units; None while Python is to do them."""
        if self._loaded is None and self.name != "python":
            self._missing -= work
            if self._missing <= 0 or self._package in sys.modules:
                self._loaded = self._load()
                if self._loaded is None:
                    self.name = "python"
        return self._loaded


def _installed(package: str) -> bool:
    try:
        return find_spec(package) is not None
    except ValueError:  # a module of that name without a specification stands in sys.modules
        return False

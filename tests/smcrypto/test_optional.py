"""Optional packages: chosen by what is installed and by the environment, imported late, left where they do not work."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
from types import SimpleNamespace

import pytest

from conftest import unavailable
from smcrypto import optional
from smcrypto.optional import OptionalEngine
from smcrypto.sm2 import points
from smcrypto.sm4 import foreign

CHOSEN = """
from smcrypto.sm2.points import ENGINE as sm2
from smcrypto.sm4.foreign import ENGINE as sm4
print(sm2.name, sm4.name)
"""
USED = {  # what makes the package worth its import, and what makes it nearly so
    "cryptography": """
from smcrypto import sm4
from smcrypto.sm4.foreign import ENGINE
cipher = sm4.SM4(bytes(16))
def use(): return cipher.decrypt_block(cipher.encrypt_block(bytes(16)))
use()
sm4.encrypt(bytes(16), sm4.CBC(bytes(16)), bytes(16 * 3997))
""",
    "gmpy2": """
from smcrypto.sm2 import SM2P256V1 as C
from smcrypto.sm2.points import ENGINE, naf_multiple, secret_sum, to_affine
def use(): return to_affine(secret_sum(C, (77, C.G)), C)
for _ in range(63): use()
""",
}


def python(code: str, **environment: str) -> list[str]:
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True,
                          env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)} | environment)  # fmt: skip
    return done.stdout.split()


def require_both() -> None:
    for engine in (points.ENGINE, foreign.ENGINE):
        if engine._load() is None:
            unavailable(f"{engine._package} is not installed")


def test_the_engines_are_chosen_by_what_is_installed_and_by_the_environment() -> None:
    require_both()
    assert python(CHOSEN, SMCRYPTO_PURE="1") == ["python", "python"]
    for value in ("", "0", "no"):
        assert python(CHOSEN, SMCRYPTO_PURE=value) == ["gmpy2", "cryptography"]
    for module in ("None", "types.ModuleType('gmpy2')"):  # not to be had, and not what it seems
        hidden = f"import sys, types; sys.modules['gmpy2'] = {module}\n"
        assert python(hidden + CHOSEN, SMCRYPTO_PURE="") == ["python", "cryptography"]


@pytest.mark.parametrize("package", USED)
def test_a_package_is_imported_where_that_has_paid_and_not_before(package: str) -> None:
    require_both()
    code = f"""
import sys
{USED[package]}
print({package!r} in sys.modules)
first = use()
print({package!r} in sys.modules)
assert use() == first
print(ENGINE.name)
"""
    assert python(code, SMCRYPTO_PURE="") == ["False", "True", package]
    assert python(code, SMCRYPTO_PURE="1") == ["False", "False", "python"]


@pytest.mark.parametrize("package", USED)
def test_it_is_used_at_once_where_the_program_has_imported_it(package: str) -> None:
    require_both()
    lines = [line for line in USED[package].splitlines() if not line.startswith(("for", "sm4.", "use()"))]
    code = "\n".join([f"import {package}", *lines, "use()", "print(ENGINE._loaded is not None)"])
    assert python(code, SMCRYPTO_PURE="") == ["True"]


def test_a_package_that_does_not_work_is_left() -> None:
    engine: OptionalEngine[str] = OptionalEngine("pytest", lambda: None, 10)
    assert engine.name == ("python" if os.environ.get("SMCRYPTO_PURE") == "1" else "pytest")
    engine.name = "pytest"
    assert engine.after(1) is None and engine.name == "python"
    assert engine.after(100) is None


def test_gmpy2_that_cannot_be_imported_is_left(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "gmpy2", None)
    assert points._load() is None


def test_where_it_is_not_installed_it_is_not_missed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(optional, "find_spec", lambda name: None)
    assert OptionalEngine("cryptography", lambda: "loaded", 0).name == "python"
    monkeypatch.setattr(optional, "find_spec", importlib.util.find_spec)
    monkeypatch.setitem(sys.modules, "cryptography", SimpleNamespace(__spec__=None))
    assert OptionalEngine("cryptography", lambda: "loaded", 0).name == "python"

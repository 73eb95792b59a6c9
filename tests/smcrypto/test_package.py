"""What the package promises as a whole: nothing but Python, nothing imported before its time, errors by family."""

from __future__ import annotations

import ast
import importlib.metadata
import json
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import smcrypto
from smcrypto import sm3

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = Path(smcrypto.__file__).parent
SOURCES = sorted(PACKAGE.rglob("*.py"))
FORBIDDEN = {"ctypes", "_ctypes", "cffi", "subprocess", "multiprocessing", "numpy", "random"}
# Code generated at import, from text in the same file: unrolled rounds, a circuit with its registers reused.
GENERATED = {"_sm3_compression.py", "sm4/bitslice.py", "sm4/tables.py"}
# Third-party modules, imported where they are needed and nowhere else: AES and 3DES of others' files; fast engines.
OPTIONAL = {"cbc.py": {"cryptography"}, "sm4/foreign.py": {"cryptography"}, "sm2/points.py": {"gmpy2"}}
# A module that serves another package alone, and that no other of ours imports.
EXTENSIONS = {"tls/adapter.py": {"requests", "urllib3"}}

SMOKE = """
import hmac
from datetime import datetime, timedelta, timezone
from smcrypto import kdf, sm2, sm3, sm4, x509
hmac.new(kdf.hkdf(b"k", 16), b"m", sm3.SM3).digest()
for aead in (sm4.SM4GCM(bytes(16)), sm4.SM4CCM(bytes(16))):
    assert aead.decrypt(bytes(12), aead.encrypt(bytes(12), b"m")) == b"m"
assert sm4.decrypt(bytes(16), sm4.CTR(bytes(16)), sm4.encrypt(bytes(16), sm4.CTR(bytes(16)), b"m" * 99)) == b"m" * 99
key = sm2.PrivateKey.generate()
key.public_key.verify(key.sign(b"m"), b"m")
assert key.decrypt(key.public_key.encrypt(b"m")) == b"m"
assert sm2.PrivateKey.from_pem(key.to_pem()) == key
now = datetime(2026, 1, 1, tzinfo=timezone.utc)
root = x509.self_signed(key, subject={"CN": "root"}, not_before=now, not_after=now + timedelta(1))
x509.verify_chain(root, roots=[root], at=now)
"""


def python(code: str, *options: str, **environment: str) -> str:
    """What `code` prints in a Python of its own that finds this package."""
    return subprocess.run(
        [sys.executable, *options, "-c", f"import sys; sys.path.insert(0, {str(PACKAGE.parent)!r})\n{code}"],
        capture_output=True, check=True, text=True, env=os.environ | environment,
    ).stdout  # fmt: skip


def imported_by(code: str, **environment: str) -> set[str]:
    """Modules that `code` adds to those of a bare interpreter."""
    printed = python(
        f"import json\nbefore = set(sys.modules)\n{code}\nprint(json.dumps(sorted(set(sys.modules) - before)))",
        **environment,
    )  # fmt: skip
    return set(json.loads(printed))


def ours(modules: set[str]) -> set[str]:
    return {name for name in modules if name.partition(".")[0] == "smcrypto"}


def third_party(modules: set[str]) -> set[str]:
    tops = {name.partition(".")[0] for name in modules}
    return tops - set(sys.stdlib_module_names) - {"smcrypto", "__main__"}


def test_importing_the_package_loads_its_errors_and_nothing_else() -> None:
    assert ours(imported_by("import smcrypto")) == {"smcrypto", "smcrypto.errors"}


@pytest.mark.parametrize("name, absent", [
    ("sm3", {"sm4", "sm2", "x509", "kdf", "der"}),
    ("kdf", {"sm4", "sm2", "x509", "der"}),
    ("sm4", {"sm2", "x509", "kdf", "sm3", "sm4.aead"}),
    ("sm2", {"sm4", "x509", "pem", "sm2.keyfiles"}),
])
def test_a_module_brings_only_what_it_stands_on(name: str, absent: set[str]) -> None:
    loaded = ours(imported_by(f"from smcrypto import {name}"))
    assert f"smcrypto.{name}" in loaded and not loaded & {f"smcrypto.{other}" for other in absent}


@pytest.mark.parametrize("pure", ["0", "1"])
def test_no_third_party_module_is_imported(pure: str) -> None:
    assert third_party(imported_by(SMOKE, SMCRYPTO_PURE=pure)) == set()


def test_the_library_works_where_nothing_is_installed() -> None:
    python(SMOKE, "-I", "-S")


def test_modules_of_the_package_are_attributes_that_arrive_when_asked_for() -> None:
    printed = python("import smcrypto\nprint(dir(smcrypto), smcrypto.sm3.digest(b'').hex()[:8])\nprint(smcrypto.sm2)")
    assert all(repr(name) in printed for name in smcrypto.__all__) and "1ab21d83" in printed
    with pytest.raises(AttributeError, match="sm9"):
        smcrypto.sm9  # noqa: B018
    assert set(smcrypto.__all__) <= set(dir(smcrypto))


def test_star_import_gives_the_public_names() -> None:
    names: dict[str, object] = {}
    exec("from smcrypto import *", names)
    assert set(smcrypto.__all__) <= set(names)


@pytest.mark.parametrize("name", ["SM4GCM", "SM4CCM"])
def test_the_aead_classes_arrive_with_their_first_use(name: str) -> None:
    assert ours(imported_by(f"from smcrypto.sm4 import {name}")) >= {"smcrypto.sm4.aead"}
    with pytest.raises(AttributeError, match="SM4XYZ"):
        smcrypto.sm4.SM4XYZ  # noqa: B018


# --- engines ---


def test_the_pure_engine_can_be_chosen() -> None:
    code = "from smcrypto import sm3; print(sm3.ENGINE, sm3.digest(b'abc').hex()[:8])"
    assert python(code, SMCRYPTO_PURE="1").split() == ["python", "66c7f0f4"]
    loaded = imported_by(f"{SMOKE}\nassert sm3.ENGINE == 'python'", SMCRYPTO_PURE="1")
    assert "smcrypto._sm3_compression" in loaded


def test_otherwise_the_standard_librarys_is_used_where_it_has_one() -> None:
    if sm3._choose(pure=False)[0] == "python":
        pytest.skip("this Python's hashlib offers no SM3")
    for value in ("", "0", "no"):
        assert python("from smcrypto import sm3; print(sm3.ENGINE)", SMCRYPTO_PURE=value).strip() == "openssl"
    assert "smcrypto._sm3_compression" not in imported_by("from smcrypto import sm3", SMCRYPTO_PURE="")


# --- pure ---


def imports(tree: ast.AST) -> Iterator[tuple[str, ast.stmt]]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from ((alias.name, node) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield ("." * node.level + (node.module or "")) if node.level else str(node.module), node


def run_at_import(tree: ast.Module) -> Iterator[ast.stmt]:
    """Statements that run when the module is imported: outside functions and outside `if TYPE_CHECKING`."""
    waiting: list[ast.AST] = [tree]
    while waiting:
        for child in ast.iter_child_nodes(waiting.pop()):
            if isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda):
                continue
            if isinstance(child, ast.If) and ast.unparse(child.test) == "TYPE_CHECKING":
                waiting += child.orelse
                continue
            if isinstance(child, ast.stmt):
                yield child
            waiting.append(child)


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_sources_are_pure_python_and_know_nothing_of_the_bridge(path: Path) -> None:
    tree = ast.parse(path.read_bytes())
    early = set(map(id, run_at_import(tree)))
    optional = OPTIONAL.get(str(path.relative_to(PACKAGE)), set())
    extended = EXTENSIONS.get(str(path.relative_to(PACKAGE)), set())
    for name, node in imports(tree):
        top = name.partition(".")[0]
        assert name.replace(".", "/").removeprefix("smcrypto/") + ".py" not in EXTENSIONS
        if top in extended:
            continue
        assert top not in FORBIDDEN and top != "rosbridge_eth", f"line {node.lineno}: {name}"
        if top in ("", "smcrypto"):
            continue
        if top == "typing_extensions":
            assert id(node) not in early, "for type checkers only"
        elif top not in sys.stdlib_module_names:
            assert top in optional and id(node) not in early, f"line {node.lineno}: {name}"
    called = {ast.unparse(node.func) for node in ast.walk(tree) if isinstance(node, ast.Call)}
    assert not called & {"eval", "__import__", "os.system", "os.popen"}
    assert not called & {"exec", "compile"} or str(path.relative_to(PACKAGE)) in GENERATED


def test_sm3_is_the_only_algorithm_taken_from_hashlib() -> None:
    asked = set()
    for path in SOURCES:
        for node in ast.walk(ast.parse(path.read_bytes())):
            if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "hashlib":
                asked.add((str(path.relative_to(PACKAGE)), node.attr))
    assert asked == {
        ("sm3.py", "new"), ("kdf.py", "pbkdf2_hmac"),
        ("pkcs12.py", "new"),  # the MAC of others' files
        ("cms.py", "sha1"),  # by which CFCA names a recipient's key
        ("ocsp.py", "sha1"), ("ocsp.py", "sha256"),  # by which other responders name issuers
        ("diagnosis.py", "sha256"),  # that somebody hashed with it instead of SM3
        # Others' key files: PBKDF2 with SHA-1 and SHA-2, and scrypt.
        ("sm2/keyfiles.py", "pbkdf2_hmac"), ("sm2/keyfiles.py", "scrypt"),
    }  # fmt: skip


def test_no_check_is_an_assertion() -> None:
    """`python -O` removes those."""
    for path in SOURCES:
        assert not [n.lineno for n in ast.walk(ast.parse(path.read_bytes())) if isinstance(n, ast.Assert)], path


# --- errors ---

FROM_INPUT = [
    "CertificateError", "ConfirmationError", "InvalidCiphertext", "InvalidEncoding", "InvalidKey", "InvalidLength",
    "InvalidOption", "InvalidPadding", "InvalidSignature", "InvalidTag",
]  # fmt: skip
FROM_USE = ["AlreadyFinalized", "MissingDependency", "OutOfOrder"]


def test_every_error_is_of_one_family_and_value_errors_are_the_inputs_fault() -> None:
    for name in FROM_INPUT:
        assert issubclass(getattr(smcrypto, name), smcrypto.SMCryptoError) and issubclass(
            getattr(smcrypto, name), ValueError
        )
    for name in FROM_USE:
        assert issubclass(getattr(smcrypto, name), smcrypto.SMCryptoError)
        assert not issubclass(getattr(smcrypto, name), ValueError)
    exported = {name for name in smcrypto.__all__ if isinstance(getattr(smcrypto, name), type)}
    assert exported == {*FROM_INPUT, *FROM_USE, "SMCryptoError"}


def test_errors_of_the_package_have_no_other_home() -> None:
    """Every exception class in the sources derives from SMCryptoError."""
    for path in SOURCES:
        for node in ast.walk(ast.parse(path.read_bytes())):
            if isinstance(node, ast.ClassDef) and any("Error" in ast.unparse(base) for base in node.bases):
                names = {ast.unparse(base) for base in node.bases}
                assert names & {"SMCryptoError", "CertificateError"} or node.name == "SMCryptoError", node.name


# --- distribution ---


def test_the_library_requires_nothing() -> None:
    tomllib = pytest.importorskip("tomllib")  # Python 3.11
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert project["dependencies"] == [] and "dependencies" not in project.get("dynamic", [])
    assert project["version"] == smcrypto.__version__


def test_what_is_installed_requires_nothing_either() -> None:
    try:
        required = importlib.metadata.distribution("pysmcrypto").requires or []
    except importlib.metadata.PackageNotFoundError:
        pytest.skip("the distribution is not installed, its sources are on the path")
    assert [requirement for requirement in required if "extra ==" not in requirement] == []


def test_every_folder_of_the_package_is_shipped() -> None:
    """setuptools finds packages by their __init__.py."""
    assert {path.parent for path in SOURCES} == {path.parent for path in PACKAGE.rglob("__init__.py")}
    assert (PACKAGE / "py.typed").exists()
    tomllib = pytest.importorskip("tomllib")
    data = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["package-data"]
    assert "py.typed" in data["smcrypto"]


@pytest.mark.parametrize("page", ["PACKAGE.md", "README.md", "docs/smcrypto.md"])
def test_no_example_has_a_key_or_nonce_of_zeros(page: str) -> None:
    text = (Path(__file__).resolve().parents[2] / page).read_text("utf-8")
    assert not re.search(r"(SM4\w*|Cipher|encrypt|decrypt|seal|open|CBC|CTR|GCM)\(bytes\(\d", text)

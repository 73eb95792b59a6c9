"""Mutation testing of smcrypto: does some test fail when the code is wrong?

One small change at a time (a comparison, an operator, a number, a condition, a statement left out) is made to a copy of
the package, and the tests of the changed module run against it until the first fails. A change that no test
notices *survives*: a test is missing, or the change makes no difference that can be seen. CONTRIBUTING.md
says what the last samples gave.

    nice -n 10 python fuzz/mutate.py --sample 45 --seed 1 [--only sm3] [--report FILE]
    nice -n 10 python fuzz/mutate.py --sample 120 --seed 2 --only all

The sample is drawn with the seed from all changes that are possible in the module's files, so that a run can be
repeated; one that --minutes cut short is a sample all the same. Needs what the tests need, and a shell that knows
`ulimit -t`; runs one process at a time, and leaves the working copy alone.
"""

from __future__ import annotations

import argparse
import ast
import copy
import os
import random
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "src" / "smcrypto"
TESTS = ROOT / "tests" / "smcrypto"

# The files of each module, and the tests that are about them, the likeliest to fail first.
SUITES: dict[str, dict[str, list[str]]] = {
    "sm2": {
        "sm2/curve.py": ["sm2/test_curve.py", "sm2/test_points.py", "sm2/test_signature.py"],
        "sm2/points.py": ["sm2/test_points.py", "sm2/test_signature.py", "sm2/test_encryption.py", "test_optional.py"],
        "sm2/known_keys.py": ["sm2/test_known_keys.py", "sm2/test_signature.py"],
        "sm2/nonces.py": ["sm2/test_nonces.py"],
        "sm2/signature.py": ["sm2/test_signature.py", "test_contract.py"],
        "sm2/encryption.py": ["sm2/test_encryption.py", "test_contract.py"],
        "sm2/exchange.py": ["sm2/test_exchange.py", "test_contract.py"],
        "sm2/keys.py": ["sm2/test_keys.py", "test_contract.py", "sm2/test_signature.py", "sm2/test_encryption.py",
                        "test_cms.py"],
        "sm2/keyfiles.py": ["sm2/test_keyfiles.py", "sm2/test_keyfiles_gmssl.py", "test_contract.py"],
        "sm2/envelope.py": ["test_cms.py"],
    },
    "sm3": {
        "sm3.py": ["test_sm3.py", "test_contract.py"],
        "_sm3_python.py": ["test_sm3.py"],
        "_sm3_compression.py": ["test_sm3.py"],
        "kdf.py": ["test_kdf.py", "test_contract.py"],
    },
    "sm4": {
        "sm4/block.py": ["sm4/test_block.py", "sm4/test_engines.py"],
        "sm4/tables.py": ["sm4/test_block.py", "sm4/test_engines.py", "sm4/test_foreign.py"],
        "sm4/cipher.py": ["sm4/test_block.py", "sm4/test_foreign.py", "test_contract.py"],
        "sm4/engine.py": ["sm4/test_engines.py", "sm4/test_modes.py"],
        "sm4/byteplanes.py": ["sm4/test_engines.py", "sm4/test_modes.py"],
        "sm4/bitslice.py": ["sm4/test_engines.py", "sm4/test_modes.py"],
        "sm4/foreign.py": ["sm4/test_foreign.py", "test_optional.py", "sm4/test_modes.py"],
        "optional.py": ["test_optional.py"],
        "sm4/modes.py": ["sm4/test_modes.py", "test_contract.py", "sm4/test_gcm_stream.py", "sm4/test_mac.py"],
        "sm4/xts.py": ["sm4/test_xts.py", "test_contract.py"],
        "sm4/mac.py": ["sm4/test_mac.py"],
        "sm4/ghash.py": ["sm4/test_ghash.py", "sm4/test_aead.py"],
        "sm4/aead.py": ["sm4/test_aead.py", "test_contract.py"],
        "sm4/gcmstream.py": ["sm4/test_gcm_stream.py", "sm4/test_aead.py"],
    },
    "der": {"der.py": ["test_der.py", "x509/test_certificates.py", "sm2/test_keyfiles.py"]},
    "x509": {
        f"x509/{name}.py": [f"x509/test_{first}.py", *(f"x509/test_{t}.py" for t in others), "test_contract.py"]
        for name, first, *others in (
            ("certificate", "certificates", "chain", "foreign", "hostnames"),
            ("hostnames", "hostnames"),
            ("chain", "chain", "revocation"),
            ("extensions", "certificates", "revocation", "chain"),
            ("issuing", "certificates", "chain"),
            ("names", "names", "certificates"),
            ("request", "certificates"),
            ("revocation", "revocation"),
            ("signed", "certificates", "revocation"),
        )
    },
    "messages": {
        "ber.py": ["test_ber.py", "test_cms.py", "test_pkcs12.py"],
        "cbc.py": ["sm2/test_keyfiles.py", "test_cms.py", "test_pkcs12.py"],
        "cfca.py": ["test_cfca.py"],
        "cms.py": ["test_cms.py", "test_timestamp.py", "test_contract.py"],
        "diagnosis.py": ["test_diagnosis.py"],
        "ocsp.py": ["test_ocsp.py"],
        "pem.py": ["test_pem.py", "sm2/test_keyfiles.py"],
        "pkcs12.py": ["test_pkcs12.py"],
        "timestamp.py": ["test_timestamp.py"],
    },
    "tls": {
        f"tls/{name}.py": [f"tls/test_{test}.py" for test in tests]
        for name, *tests in (
            ("schedule", "schedule", "suites"),
            ("record", "record", "suites", "streams"),
            ("messages", "suites", "hostile", "negotiation", "streams"),
            ("handshake", "suites", "hostile", "negotiation", "streams"),
            ("tls13", "suites", "hostile", "negotiation", "streams"),
            ("tlcp", "suites", "hostile", "negotiation", "streams"),
            ("connection", "suites", "streams", "negotiation", "hostile"),
        )
    },
}  # fmt: skip

SUITES["all"] = {file: tests for module in sorted(SUITES.keys() - {"tls"}) for file, tests in SUITES[module].items()}
"""For a sample over everything but TLS, in which a large module has the larger part."""

_SLOW = "memory_stays or at_the_edges or vectors_in_python or openssl_agrees"
"""Tests that take seconds, as an expression for pytest: they run only where all others passed."""
_SECONDS = 120
"""Of processor time for one run of tests, several times what any takes; a mutant may loop for ever."""

_COMPARISONS: dict[type[ast.cmpop], type[ast.cmpop]] = {
    ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq,
    ast.In: ast.NotIn, ast.NotIn: ast.In, ast.Is: ast.IsNot, ast.IsNot: ast.Is,
}  # fmt: skip
_OPERATORS: dict[type[ast.operator], type[ast.operator]] = {
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Add, ast.FloorDiv: ast.Mult, ast.Mod: ast.Add, ast.Pow: ast.Mult,
    ast.LShift: ast.RShift, ast.RShift: ast.LShift, ast.BitAnd: ast.BitOr, ast.BitOr: ast.BitAnd, ast.BitXor: ast.BitOr,
}  # fmt: skip


class Mutant(NamedTuple):
    file: str
    line: int
    what: str
    source: str
    """The whole file with the change."""


class _Place(NamedTuple):
    line: int
    what: str
    index: int
    """The node's place in the walk, the same in every copy of the tree."""
    variant: int


def _beside_the_point(node: ast.AST) -> list[ast.AST | None]:
    """Parts that do not compute: annotations, docstrings, messages of errors, imports, how things print."""
    match node:
        case ast.FunctionDef(name="__repr__" | "__str__") | ast.Import() | ast.ImportFrom() | ast.JoinedStr():
            return [node]
        case ast.FunctionDef():
            return [node.returns, *node.decorator_list]
        case ast.ClassDef():
            return [*node.bases, *node.decorator_list]
        case ast.arg() | ast.AnnAssign():
            return [node.annotation]
        case ast.Raise(exc=ast.Call()):
            return [node.exc, node.cause]
        case ast.Expr(value=ast.Constant()) | ast.If(test=ast.Name("TYPE_CHECKING")):
            return [node]
    return []


def _code(tree: ast.Module) -> Iterator[tuple[int, ast.AST]]:
    """The nodes that compute, each with its place in the walk."""
    skipped: set[ast.AST] = set()
    for node in ast.walk(tree):
        for part in _beside_the_point(node):
            if part is not None:
                skipped.update(ast.walk(part))
    return ((index, node) for index, node in enumerate(ast.walk(tree)) if node not in skipped)


def _variants(node: ast.AST) -> list[str]:
    """What can be changed at a node, in words."""
    if isinstance(node, ast.Compare):
        return [f"{_name(op)} becomes {_name(_COMPARISONS[type(op)]())}" for op in node.ops]
    if isinstance(node, ast.BinOp | ast.AugAssign) and type(node.op) in _OPERATORS:
        return [f"{_name(node.op)} becomes {_name(_OPERATORS[type(node.op)]())}"]
    if isinstance(node, ast.BoolOp):
        return ["and becomes or" if isinstance(node.op, ast.And) else "or becomes and"]
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not):
        return ["not left out"]
    if isinstance(node, ast.If | ast.IfExp | ast.While) and not isinstance(node.test, ast.Compare | ast.UnaryOp):
        return ["condition turned round"]
    if isinstance(node, ast.Constant) and isinstance(node.value, bool):
        return [f"{node.value} becomes {not node.value}"]
    if isinstance(node, ast.Constant) and isinstance(node.value, int):
        return [f"{node.value} becomes {node.value + 1}"]
    if isinstance(node, ast.Expr) and isinstance(node.value, ast.Call):
        return ["call left out"]
    if isinstance(node, ast.Raise):
        return ["raise left out"]
    if isinstance(node, ast.AugAssign):
        return ["assignment left out"]
    if isinstance(node, ast.Return) and node.value is not None:
        return ["None returned"]
    return []


def _name(operator: ast.AST) -> str:
    return type(operator).__name__


class _Change(ast.NodeTransformer):
    def __init__(self, target: ast.AST, variant: int) -> None:
        self.target, self.variant = target, variant

    def visit(self, node: ast.AST) -> ast.AST:
        if node is not self.target:
            return self.generic_visit(node)
        if isinstance(node, ast.Compare):
            node.ops[self.variant] = _COMPARISONS[type(node.ops[self.variant])]()
        elif isinstance(node, ast.BinOp | ast.AugAssign) and type(node.op) in _OPERATORS:
            node.op = _OPERATORS[type(node.op)]()
        elif isinstance(node, ast.BoolOp):
            node.op = ast.Or() if isinstance(node.op, ast.And) else ast.And()
        elif isinstance(node, ast.UnaryOp):
            return node.operand
        elif isinstance(node, ast.If | ast.IfExp | ast.While):
            node.test = ast.UnaryOp(ast.Not(), node.test)
        elif isinstance(node, ast.Constant) and isinstance(node.value, bool):
            node.value = not node.value
        elif isinstance(node, ast.Constant) and isinstance(node.value, int):
            node.value += 1
        elif isinstance(node, ast.Return):
            node.value = ast.Constant(None)
        else:
            return ast.copy_location(ast.Pass(), node)
        return node


def places(source: str) -> list[_Place]:
    """Every change that can be made to a file."""
    return [
        _Place(getattr(node, "lineno", 0), what, index, variant)
        for index, node in _code(ast.parse(source))
        for variant, what in enumerate(_variants(node))
    ]


def mutated(source: str, place: _Place) -> str:
    """`source` with the one change, as Python prints it."""
    tree = copy.deepcopy(ast.parse(source))
    target = next(node for index, node in enumerate(ast.walk(tree)) if index == place.index)
    return ast.unparse(ast.fix_missing_locations(_Change(target, place.variant).visit(tree)))


def sample(module: str, count: int, seed: int) -> list[Mutant]:
    """`count` mutants of a module, each of its possible changes as likely as any other."""
    found = [
        (file, place) for file in SUITES[module] for place in places((PACKAGE / file).read_text("utf-8"))
    ]  # fmt: skip
    chosen = random.Random(f"{seed} {module}").sample(found, min(count, len(found)))  # noqa: S311 - a draw of tests
    return [
        Mutant(file, place.line, place.what, mutated((PACKAGE / file).read_text("utf-8"), place))
        for file, place in chosen
    ]


def run(package: Path, tests: list[str], chosen: str) -> bool:
    """Do the tests pass against the copy in `package`? What takes too much of the processor counts as failed."""
    environment = os.environ | {
        "PYTHONPATH": f"{package.parent}{os.pathsep}{ROOT / 'tests'}", "PYTHONDONTWRITEBYTECODE": "1",
        "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1",  # starting takes a third of the time
    }  # fmt: skip
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "pytest_timeout", "-p", "no:cacheprovider",
               "-k", chosen, *(str(TESTS / name) for name in tests)]  # fmt: skip
    limited = ["sh", "-c", f'ulimit -t {_SECONDS}; exec "$@"', "sh", *command]
    done = subprocess.run(limited, cwd=ROOT, env=environment, capture_output=True, check=False)  # noqa: S603 - pytest
    return done.returncode in (0, 5)  # 5: none of the tests was chosen


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--sample", type=int, default=45, help="mutants of each module (45)")
    parser.add_argument("--seed", type=int, default=1, help="of the draw (1)")
    parser.add_argument("--only", choices=sorted(SUITES), action="append", help="this module only; may be repeated")
    parser.add_argument("--minutes", type=float, default=60, help="when to stop (60)")
    parser.add_argument("--report", type=Path, help="write the survivors there as well, a line each")
    options = parser.parse_args()
    end, survivors = time.monotonic() + 60 * options.minutes, []
    with tempfile.TemporaryDirectory() as folder:
        package = Path(folder) / "smcrypto"
        shutil.copytree(PACKAGE, package, ignore=shutil.ignore_patterns("__pycache__"))
        for module in options.only or sorted(SUITES.keys() - {"all"}):
            killed = done = 0
            mutants = sample(module, options.sample, options.seed)
            needed = sorted({test for mutant in mutants for test in SUITES[module][mutant.file]})
            if not run(package, needed, f"not ({_SLOW})"):
                print(f"{module}: its tests fail without any change", file=sys.stderr)
                return 2
            for mutant in mutants:
                if time.monotonic() > end:
                    print(f"{module}: stopped after {options.minutes:g} minutes")
                    break
                tests = SUITES[module][mutant.file]
                original = (package / mutant.file).read_text("utf-8")
                (package / mutant.file).write_text(mutant.source, "utf-8")
                survived = run(package, tests, f"not ({_SLOW})") and run(package, tests, _SLOW)
                (package / mutant.file).write_text(original, "utf-8")
                done, killed = done + 1, killed + (not survived)
                print(f"{module} {done}", end="\r", file=sys.stderr, flush=True)
                if survived:
                    line = (PACKAGE / mutant.file).read_text("utf-8").splitlines()[mutant.line - 1].strip()
                    survivors.append(f"{mutant.file}:{mutant.line}: {mutant.what}: {line}")
                    print("survived", survivors[-1], flush=True)
            print(f"{module}: {killed} of {done} killed", flush=True)
    if options.report:
        options.report.write_text("".join(f"{line}\n" for line in survivors), "utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())

"""The documents and docstrings of smcrypto, run as they are written; links; and the README's two commands.

Examples under one heading of a page belong together: they run in order, Python in
one namespace, shell commands in one folder. The page on the fleet's CA has a test of its own.
"""

from __future__ import annotations

import ast
import doctest
import importlib.util
import inspect
import os
import pkgutil
import re
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import NamedTuple

import pytest

import smcrypto
from conftest import unavailable

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
EXAMPLES = [ROOT / "README.md", ROOT / "PACKAGE.md", DOCS / "smcrypto.md", DOCS / "security.md",
            ROOT / "README.zh.md", DOCS / "zh" / "quickstart.md"]  # fmt: skip
PAGES = sorted([ROOT / "README.md", ROOT / "README.zh.md", ROOT / "PACKAGE.md", ROOT / "CHANGELOG.md",
                ROOT / "SECURITY.md", ROOT / "CONTRIBUTING.md", *DOCS.rglob("*.md"), *(ROOT / "tests").rglob("*.md")])
MODULES = [
    importlib.import_module(module.name)
    for module in pkgutil.walk_packages(smcrypto.__path__, "smcrypto.")
    if not module.name.endswith("__main__")
]
PUBLIC = [
    smcrypto, *(importlib.import_module(f"smcrypto.{name}") for name in
                ("errors", "inputs", "sm3", "kdf", "sm4", "sm2", "x509", "der", "pem", "diagnosis",
                 "cms", "ocsp", "pkcs12", "timestamp")),
]  # fmt: skip


# --- examples ---


class Example(NamedTuple):
    language: str
    text: str
    line: int


def examples(page: Path) -> Iterator[tuple[str, list[Example]]]:
    """(heading, its fenced examples) for each heading that has some. "sh main" and the like are not examples."""
    heading, found, fence = page.stem, [], None
    for number, line in enumerate(page.read_text("utf-8").splitlines(), 1):
        if fence is not None:
            if line == "```":
                if fence.language in ("python", "sh"):
                    found.append(fence)
                fence = None
            else:
                fence = fence._replace(text=f"{fence.text}{line}\n")
        elif line.startswith("```"):
            fence = Example(line[3:], "", number + 1)
        elif line.startswith("## "):
            if found:
                yield heading, found
            heading, found = line[3:], []
    assert fence is None, f"{page.name}: the example at line {fence.line} does not end"
    if found:
        yield heading, found


def required(code: str) -> set[str]:
    """The third-party packages that an example imports."""
    names = {
        name.partition(".")[0]
        for node in ast.walk(ast.parse(code)) if isinstance(node, ast.Import | ast.ImportFrom)
        for name in ([node.module or ""] if isinstance(node, ast.ImportFrom) else [alias.name for alias in node.names])
    }  # fmt: skip
    return names - set(sys.stdlib_module_names) - {"smcrypto"}


@pytest.mark.parametrize("page, blocks", [
    pytest.param(page, blocks, id=f"{page.name}: {heading}") for page in EXAMPLES for heading, blocks in examples(page)
])  # fmt: skip
def test_examples_run_as_they_are_written(
    page: Path, blocks: list[Example], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    environment = os.environ | {
        "PYTHONPATH": str(Path(smcrypto.__file__).parents[1]),
        "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}",
    }
    namespace: dict[str, object] = {"__name__": "example"}
    for block in blocks:
        if block.language == "sh":
            if "openssl" in block.text and shutil.which("openssl") is None:
                unavailable("the program 'openssl' is not installed")
            done = subprocess.run(["bash", "-euo", "pipefail", "-c", block.text], env=environment, capture_output=True,
                                  text=True, check=False)  # fmt: skip
            assert done.returncode == 0, f"{page.name}, line {block.line}:\n{done.stdout}{done.stderr}"
            continue
        for package in sorted(required(block.text)):
            if importlib.util.find_spec(package) is None:
                unavailable(f"the package {package!r} is not installed")
        code = "\n" * (block.line - 1) + block.text  # so that a traceback names the page's line
        exec(compile(code, str(page), "exec"), namespace)


def test_the_readme_shows_every_part_of_the_library() -> None:
    code = "\n".join(block.text for _, blocks in examples(ROOT / "README.md") for block in blocks)
    for name in ("sm3.digest", "sm3.hmac", "sm4.SM4GCM", ".sign(", ".verify(", ".encrypt(", ".decrypt(",
                 ".to_pem("):  # fmt: skip
        assert name in code


def test_the_guide_explains_every_error() -> None:
    table = re.findall(r"^\| `(\w+)` \|", (DOCS / "smcrypto.md").read_text("utf-8").split("## Errors")[1], re.MULTILINE)
    errors = {name for name in smcrypto.__all__ if isinstance(getattr(smcrypto, name), type)} - {"SMCryptoError"}
    assert sorted(table) == sorted(errors)
    no_value_errors = {name for name in errors if not issubclass(getattr(smcrypto, name), ValueError)}
    assert set(table[-3:]) == no_value_errors  # as the sentence above the table says


@pytest.mark.parametrize("module", MODULES, ids=lambda module: module.__name__)
def test_docstrings_run(module: ModuleType) -> None:
    outcome = doctest.testmod(module, optionflags=doctest.IGNORE_EXCEPTION_DETAIL, verbose=False)
    assert outcome.failed == 0


# --- docstrings ---


def public_things() -> Iterator[tuple[str, object]]:
    """Every public function, class, method and property of the public modules, once."""
    seen = set()
    for module in PUBLIC:
        for name in module.__all__:
            thing = getattr(module, name)
            if isinstance(thing, ModuleType):
                yield thing.__name__, thing
            elif (inspect.isfunction(thing) or inspect.isclass(thing)) and thing not in seen:
                seen.add(thing)
                yield f"{module.__name__}.{name}", thing
                if inspect.isclass(thing):
                    for attribute, value in vars(thing).items():
                        value = getattr(value, "__func__", value)
                        if not attribute.startswith("_") and (inspect.isfunction(value) or isinstance(value, property)):
                            yield f"{module.__name__}.{name}.{attribute}", value


@pytest.mark.parametrize("thing", [pytest.param(thing, id=name) for name, thing in public_things()])
def test_everything_public_has_a_docstring(thing: object) -> None:
    text = vars(thing).get("__doc__") if inspect.isclass(thing) else thing.__doc__
    made = inspect.isclass(thing) and (text or "").startswith(f"{thing.__name__}(")  # by dataclass, of the fields
    assert text and not made


@pytest.mark.parametrize("module", MODULES, ids=lambda module: module.__name__)
def test_every_module_says_what_it_is_for(module: ModuleType) -> None:
    assert module.__doc__


# --- pages ---


def anchor(heading: str) -> str:
    """The fragment by which a heading is linked to: lower case, hyphens for blanks, no other signs."""
    return re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-")


def anchors(page: Path) -> set[str]:
    return {anchor(heading) for heading in re.findall(r"^#+ (.+)$", page.read_text("utf-8"), re.MULTILINE)}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_somewhere(page: Path) -> None:
    for target in re.findall(r"\]\(([^)\s]+)\)", page.read_text("utf-8")):
        if re.match(r"[a-z]+:", target):
            continue
        name, _, fragment = target.partition("#")
        path = (page.parent / name).resolve() if name else page
        assert path.exists(), target
        assert not fragment or fragment in anchors(path), target


def test_the_text_for_a_package_index_has_no_link_into_the_repository() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    text = (ROOT / project["readme"]).read_text("utf-8")
    assert all(re.match("https:", target) for target in re.findall(r"\]\(([^)\s]+)\)", text))


def test_the_index_names_every_page() -> None:
    index = (DOCS / "README.md").read_text("utf-8")
    linked = {(DOCS / target).resolve() for target in re.findall(r"\]\(([^)#\s]+)", index)}
    assert set(DOCS.rglob("*.md")) - {DOCS / "README.md"} <= linked


@pytest.mark.parametrize("name, says", [("main", "rosbridge_eth demo"), ("test", "pytest")])
def test_the_readme_has_its_two_commands(name: str, says: str) -> None:
    """Continuous integration takes both from there."""
    text = (ROOT / "README.md").read_text("utf-8")
    found = re.findall(rf"^```sh {name}\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)
    assert len(found) == 1 and says in found[0]
    subprocess.run(["bash", "-n", "-c", found[0]], check=True)
    assert f"readme_command {name}" in (ROOT / ".ci" / "run").read_text()


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_pages_have_one_title_and_end_with_a_line(page: Path) -> None:
    text = page.read_text("utf-8")
    prose = re.sub(r"^```.*?^```$", "", text, flags=re.MULTILINE | re.DOTALL)
    assert text.startswith("# ") and len(re.findall(r"^# ", prose, re.MULTILINE)) == 1
    assert text.endswith("\n") and not text.endswith("\n\n")

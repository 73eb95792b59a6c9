"""How large the bridge is and how its files hang together; benchmarks/size.py counts what is code, in each language."""

from __future__ import annotations

import ast
from collections.abc import Iterator, Mapping
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

from size import LARGEST_FILE, SOURCES, code_lines, files_of

PACKAGE = SOURCES / "rosbridge_eth"


@pytest.mark.parametrize(("name", "text", "lines"), [
    ("a.py", '"""What it is."""\n\n# a comment\nx = [\n    1,\n]\n', 3),
    ("a.js", "// a comment\n\n/* and\n   another */\nconst x = {\n  a: 1, // with one behind it\n}\n", 3),
    ("a.html", "<p>\n<script>\nlet x = 1\n</script>\n<script type='application/json'>\n{}\n</script>\n", 1),
    ("a.lua", "-- a comment\n\nlocal x = 1\nreturn x\n", 2),
])  # fmt: skip
def test_lines_without_comments_and_blank_ones_are_counted(name: str, text: str, lines: int, tmp_path: Path) -> None:
    (tmp_path / name).write_text(text)
    assert code_lines(tmp_path / name) == lines


def test_no_file_is_too_long_to_be_read_at_once():
    assert {path.name: lines for path, lines in files_of(PACKAGE).items() if lines > LARGEST_FILE} == {}


def test_the_top_of_the_package_is_seen_at_a_glance():
    entries = {path.name for path in PACKAGE.iterdir() if not path.name.startswith("_")} - {"py.typed"}
    assert len(entries) <= 14, sorted(entries)


# Imports


def module_of(path: Path, package: Path) -> str:
    parts = path.relative_to(package.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def run_time_nodes(tree: ast.AST) -> Iterator[ast.AST]:
    """All but what is imported for types alone."""
    if isinstance(tree, ast.If) and isinstance(tree.test, ast.Name) and tree.test.id == "TYPE_CHECKING":
        return
    yield tree
    for child in ast.iter_child_nodes(tree):
        yield from run_time_nodes(child)


def imports_of(package: Path) -> dict[str, set[str]]:
    """Of each module, the modules of the package that it names, also within functions."""
    files = {module_of(path, package): path for path in package.rglob("*.py")}
    found: dict[str, set[str]] = {}
    for module, path in files.items():
        named = set[str]()
        for node in run_time_nodes(ast.parse(path.read_text())):
            if isinstance(node, ast.Import):
                named |= {alias.name for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.module is not None:
                for alias in node.names:
                    inner = f"{node.module}.{alias.name}"
                    named.add(inner if inner in files else node.module)
        found[module] = (named & files.keys()) - {module}
    return found


def circle(imports: Mapping[str, set[str]]) -> list[str]:
    """The modules of one circle, empty if there is none."""
    try:
        TopologicalSorter(imports).prepare()
    except CycleError as error:
        return list(error.args[1])
    return []


def test_no_two_files_import_each_other_directly_or_in_a_round():
    imports = imports_of(PACKAGE)
    assert len(imports) > 50 and any(imports.values())
    assert circle(imports) == []


def test_a_circle_is_found_also_within_functions_and_not_where_it_is_for_types_alone(tmp_path: Path):
    package = tmp_path / "made"
    package.mkdir()
    (package / "__init__.py").write_text("")
    (package / "a.py").write_text("from made.b import x\n")
    (package / "b.py").write_text("from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from made import a\n")
    assert circle(imports_of(package)) == []
    (package / "b.py").write_text("def x():\n    from made import a\n")
    assert sorted(set(circle(imports_of(package)))) == ["made.a", "made.b"]

"""How many lines of code the packages have, without blank lines, comments and docstrings.

    python benchmarks/size.py [--files] [SOURCE_FOLDER]

Counted are the lines on which a token of the program stands, so that a statement over five lines is five
lines; a docstring is any string that stands alone. JavaScript (files, the scripts within pages, and the reader in
docs/verify.mjs) and Lua are lines without blank ones and comments, told apart and in the sum. The contract, style
sheets, markup and generated files (JSON) are not counted.
"""

from __future__ import annotations

import argparse
import ast
import io
import re
import tokenize
from collections import Counter
from pathlib import Path

SOURCES = Path(__file__).resolve().parent.parent / "src"
LARGEST_FILE = 400
BESIDE = {".js": "JavaScript", ".mjs": "JavaScript", ".html": "JavaScript", ".lua": "Lua"}
"""Languages that are counted beside Python, by a file's ending."""

PARTS = {
    "cli": ("__main__.py", "cli", "terminal.py"),
    "operator, config, identity, errors": ("operator", "config", "identity.py", "files.py", "errors.py", "__init__.py"),
    "capture": ("capture",),
    "log": ("log",),
    "channel": ("channel",),
    "ledger": ("ledger",),
    "robot, sources": ("robot",),
    "server": ("server",),
    "reading": ("reading",),
}
"""The rows of the design's table, by the first part of a file's path in the bridge's package."""

_NO_CODE = {
    tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENCODING,
    tokenize.ENDMARKER,
}  # fmt: skip


def _docstring_lines(source: str) -> set[int]:
    """The lines of strings that stand alone: docstrings of modules, classes, functions and of what is assigned."""
    lines: set[int] = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
            lines.update(range(node.lineno, (node.end_lineno or node.lineno) + 1))
    return lines


def code_lines(path: Path) -> int:
    """Lines of code of one file, by its ending."""
    source = path.read_text()
    if path.suffix == ".html":
        source = "\n".join(re.findall(r"<script>(.*?)</script>", source, re.DOTALL))
    if path.suffix != ".py":
        comment = "--" if path.suffix == ".lua" else "//"
        if comment == "//":
            source = re.sub(r"^\s*/\*.*?\*/", "", source, flags=re.DOTALL | re.MULTILINE)
        return sum(1 for line in source.splitlines() if line.strip() and not line.strip().startswith(comment))
    lines: set[int] = set()
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type not in _NO_CODE:
            lines.update(range(token.start[0], token.end[0] + 1))
    return len(lines - _docstring_lines(source))


def files_of(package: Path) -> dict[Path, int]:
    """Of each Python file of a package, its lines of code."""
    return {path: code_lines(path) for path in sorted(package.rglob("*.py"))}


def part_of(path: Path) -> str:
    """The row of the design's table to which a file (relative to the bridge's package) belongs."""
    return next((part for part, names in PARTS.items() if path.parts[0] in names), "other")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sources", nargs="?", type=Path, default=SOURCES)
    parser.add_argument("--files", action="store_true", help="every file, too")
    arguments = parser.parse_args()
    bridge, library = (files_of(arguments.sources / name) for name in ("rosbridge_eth", "smcrypto"))
    package = arguments.sources / "rosbridge_eth"
    parts: Counter[str] = Counter()
    for path, lines in bridge.items():
        parts[part_of(path.relative_to(package))] += lines
        if arguments.files or lines > LARGEST_FILE:
            print(f"{lines:7,}  {path.relative_to(package)}")
    for part in [*PARTS, "other"]:
        if parts[part]:
            print(f"{parts[part]:7,}  {part}")
    print(f"{sum(bridge.values()):7,}  rosbridge_eth, {len(bridge)} files")
    beside = {path: code_lines(path) for path in [*package.rglob("*"), arguments.sources.parent / "docs/verify.mjs"]
              if path.suffix in BESIDE and path.exists()}  # fmt: skip
    for path, lines in sorted(beside.items()):
        if arguments.files and lines:
            print(f"{lines:7,}  {path.relative_to(arguments.sources.parent)}")
    for name in sorted({*BESIDE.values()}):
        print(f"{sum(lines for path, lines in beside.items() if BESIDE[path.suffix] == name):7,}  {name}")
    print(f"{sum(bridge.values()) + sum(beside.values()):7,}  all of the bridge")
    print(f"{sum(library.values()):7,}  smcrypto, {len(library)} files")


if __name__ == "__main__":
    main()

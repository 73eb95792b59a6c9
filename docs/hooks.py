"""What mkdocs does not do by itself to make a site of docs/ and the docstrings (mkdocs.yml).

- The navigation is read off the tables of docs/README.md, so that there is one list of pages.
- README, changelog and what else lies outside docs/ become pages; so do the scripts of examples/ and the docstrings
  of each public module.
- Links are written for the repository. Those to a page are made to lead there, those to any other file of the
  repository become plain text, and one to nothing is an error.
- Docstrings are plain text with doctests; the doctests become code.
"""

from __future__ import annotations

import re
from pathlib import Path
from posixpath import relpath

import griffe
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).resolve().parents[1]
PAGES = {
    "README.md": "index.md",
    "docs/README.md": "contents.md",
    "README.zh.md": "zh/index.md",
    "CHANGELOG.md": "changelog.md",
    "SECURITY.md": "reporting.md",
    "CONTRIBUTING.md": "contributing.md",
    "tests/vectors/README.md": "vectors.md",
    "examples": "examples.md",
}
"""A file or folder of the repository, and its page; those in docs/ keep their names."""
MODULES = ("smcrypto", *(f"smcrypto.{name}" for name in
           ("sm2", "sm3", "sm4", "kdf", "x509", "cms", "tls", "pkcs12", "pem", "der")))  # fmt: skip
_LINK = re.compile(r"\]\(([^)\s]+)\)")
_FENCE = re.compile(r"(?m)^```(\w+) +(.+)$")


def _page(path: str) -> str | None:
    """The page that shows a path of the repository."""
    if path in PAGES:
        return PAGES[path]
    return path.removeprefix("docs/") if path.startswith("docs/") else None


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """The navigation: a section for each of docs/README.md, in its order."""
    sections: list[dict[str, object]] = [{"Home": ["index.md", "contents.md"]}]
    for section in (ROOT / "docs" / "README.md").read_text("utf-8").split("\n## ")[1:]:
        pages = [_page(_in_repository("docs/README.md", target)) for target in _LINK.findall(section)]
        sections.append({section.splitlines()[0]: [p for p in dict.fromkeys(pages) if p and p.endswith(".md")]})
    sections.insert(2, {"smcrypto, module by module": [{name: f"api/{name}.md"} for name in MODULES]})
    config.nav = sections
    return config


def _in_repository(page: str, target: str) -> str:
    """A relative link of a file as a path from the root of the repository."""
    path = (ROOT / page).parent.joinpath(target.partition("#")[0]).resolve()
    if not path.exists():
        raise PluginError(f"{page} links to {target}, which is not there")
    return path.relative_to(ROOT).as_posix()


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Adds the pages that are not files of docs/."""
    readme = files.get_file_from_path("README.md")
    if readme is not None:
        files.remove(readme)
    for path, page in PAGES.items():
        if path == "examples":
            files.append(File.generated(config, page, content=_examples()))
        else:
            files.append(File.generated(config, page, content=(ROOT / path).read_text("utf-8")))
    for name in MODULES:
        files.append(File.generated(config, f"api/{name}.md", content=f"# {name}\n\n::: {name}\n"))
    return files


def _examples() -> str:
    parts = ["# Examples\n\nThree scripts that run; the tests run them.\n"]
    for script in sorted((ROOT / "examples").glob("*.py")):
        parts.append(f"\n## {script.name}\n\n```python\n{script.read_text('utf-8')}```\n")
    return "".join(parts)


def _unmarked(fence: re.Match[str]) -> str:
    """A fence without the mark for those who run the page (tests/bridge/pages.py); a file's name becomes its title."""
    language, mark = fence.groups()
    file = re.fullmatch(r"(>> )?(\S+[./]\S+)", mark)
    return f"```{language}" + (f' title="{"at the end of " if file[1] else ""}{file[2]}"' if file else "")


def on_page_markdown(markdown: str, *, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Links as they lead from this page of the site."""
    markdown = _FENCE.sub(_unmarked, markdown)
    here = page.file.src_uri
    source = next((path for path, name in PAGES.items() if name == here), f"docs/{here}")

    def lead(match: re.Match[str]) -> str:
        text, target = match.groups()
        if re.match(r"[a-z]+:|#", target):
            return match[0]
        path = _in_repository(source, target)
        shown = _page(path)
        if shown is None:
            return text.removeprefix("../")
        fragment = target.partition("#")[1:]
        return f"[{text}]({relpath(shown, Path(here).parent.as_posix())}{''.join(fragment)})"

    if here.startswith("api/") or here == "examples.md":
        return markdown
    return re.sub(r"(?<!!)\[([^\[\]]*)\]\(([^)\s]+)\)", lead, markdown)


def on_page_content(html: str, *, page: Page, config: MkDocsConfig, files: Files) -> str:
    """A fence that is none turns text and code around for the rest of its page."""
    if "<p>```" in html:
        raise PluginError(f"{page.file.src_uri}: what begins with ``` is not shown as code")
    return html


class Doctests(griffe.Extension):
    """Puts the doctests of docstrings into fences."""

    def on_instance(self, *, obj: griffe.Object, **_: object) -> None:
        """Called by griffe for every object that has been read."""
        if obj.docstring is not None:
            obj.docstring.value = re.sub(r"(?m)^>>> (?:.+\n?)+", lambda m: f"```pycon\n{m[0].rstrip()}\n```\n",
                                         obj.docstring.value)  # fmt: skip

"""Hooks of mkdocs: README on the first page, the reference from the packages' public names, and links out of docs/.

A page has a line ``<!-- readme -->`` or ``<!-- reference PACKAGE -->``, which is replaced.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from os.path import relpath
from pathlib import Path, PurePosixPath
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
FOLDERS = {"ufmstar_torch.models": "models", "ufmstar_torch.eval": "eval", "ufmstar_torch.train": "train"}
_LINK = re.compile(r"(!?)\[((?:[^\[\]]|\[[^\]]*\])*)\]\(([^)\s]+)\)")
_README, _REFERENCE = "<!-- readme -->", re.compile(r"<!-- reference (\S+) -->")


def on_page_markdown(markdown: str, *, page: Any, **_: Any) -> str:
    """The page's text with README, reference and links filled in (called by mkdocs)."""
    source = PurePosixPath(page.file.src_uri)
    text = in_site(markdown, PurePosixPath("docs") / source.parent)
    text = text.replace(_README, in_site(readme(), PurePosixPath()))
    return _REFERENCE.sub(lambda found: "\n\n".join(f"::: {name}" for name in public_names(found[1])), text)


def readme() -> str:
    """README without its title and picture, which the first page has."""
    text = (ROOT / "README.md").read_text(encoding="utf-8").partition("\n")[2]
    return re.sub(r"^!\[.*\]\(.*\)\n", "", text, count=1, flags=re.MULTILINE)


def in_site(text: str, folder: PurePosixPath) -> str:
    """Text of a page in ``folder`` of the repository, whose links to files outside docs/ become their names, and whose
    links into docs/ are relative to the page in the site."""

    def link(found: re.Match[str]) -> str:
        picture, words, target = found.groups()
        if re.match(r"[a-z]+:|#", target):
            return found[0]
        path, hash_, anchor = target.partition("#")
        file = (ROOT / folder / path).resolve()
        if file == ROOT / "README.md":
            file = ROOT / "docs" / "index.md"
        if not file.is_relative_to(ROOT / "docs"):
            name = file.relative_to(ROOT).as_posix()
            return words if words.strip("`") in (name, file.name) else f"{words} (`{name}`)"
        start = ROOT / (folder if folder.parts[:1] == ("docs",) else "docs")
        return f"{picture}[{words}]({Path(relpath(file, start)).as_posix()}{hash_}{anchor})"

    parts = re.split(r"(^```.*?^```)", text, flags=re.MULTILINE | re.DOTALL)  # code at odd positions
    return "".join(part if i % 2 else _LINK.sub(link, part) for i, part in enumerate(parts))


def public_names(package: str) -> Iterator[str]:
    """The names that a package imports for type checkers, which are its public ones, each with its module."""
    prefix = max((name for name in FOLDERS if package.startswith(name)), key=len, default="ufmstar_torch")
    folder = ROOT / FOLDERS.get(prefix, "ufmstar_torch") / Path(*package.removeprefix(prefix).split("."))
    for node in ast.parse((folder / "__init__.py").read_text(encoding="utf-8")).body:
        if isinstance(node, ast.If):
            imports = (inner for inner in node.body if isinstance(inner, ast.ImportFrom))
            yield from (f"{each.module}.{alias.name}" for each in imports for alias in each.names)

"""Where pages are kept: files named by their content, and a journal of which were out after how many frames.

A page holds the float64 numbers of its components, row by row, and never changes. The journal has a line for every
frame that changed which pages are out, so that a saved state finds its own pages as long as the folder is kept, and a
frame writes no more than its change. Pages count from 0 in the order of the journal. The journal's first line has the
version of this format; a journal of version 2 may lack it.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from ufmstar_torch.spill_index import Page

VERSION = 2  # 1 had a list of all pages for every frame (pages-*.json)
_HEAD = json.dumps({"version": VERSION}).encode() + b"\n"


@dataclass(frozen=True)
class Change:
    """What a frame changed.

    Attributes:
        frames: how many the stream had taken in, this one included.
        out: pages written.
        back: numbers of the pages read back.
    """

    frames: int
    out: tuple[Page, ...]
    back: tuple[int, ...]


class Memory:
    """Pages in memory, for as long as the process lives."""

    def __init__(self) -> None:
        self._pages: dict[str, bytes] = {}
        self._changes: list[Change] = []

    def read(self, name: str) -> bytes:
        """The content of a page."""
        return self._pages[name]

    def write(self, name: str, content: bytes) -> None:
        """Keep a page."""
        self._pages[name] = content

    def changes(self) -> tuple[Change, ...]:
        """The journal."""
        return tuple(self._changes)

    def append(self, change: Change) -> None:
        """One more line of the journal."""
        self._changes.append(change)

    def rewrite(self, changes: Iterable[Change]) -> None:
        """Replace the journal."""
        self._changes = list(changes)


class Folder:
    """Pages in a folder, as files that are either missing or whole; what :class:`Memory` has.

    A line of the journal counts once it ends: what a killed process or a full disk left behind it is overwritten.

    Raises:
        ValueError: the folder holds pages of another version.
    """

    def __init__(self, path: str) -> None:
        self._path, self._journal, self._end = path, os.path.join(path, "pages.jsonl"), 0
        os.makedirs(path, exist_ok=True)
        if any(name.startswith("pages-") and name.endswith(".json") for name in os.listdir(path)):
            raise _other_version(path, 1)
        self.changes()

    def read(self, name: str) -> bytes:
        """The content of a page."""
        with open(os.path.join(self._path, name), "rb") as file:
            return file.read()

    def write(self, name: str, content: bytes) -> None:
        """Keep a page. Its name is a hash of its content, so that a page that exists is not written again."""
        path = os.path.join(self._path, name)
        if not os.path.exists(path):
            self._replace(path, content)

    def changes(self) -> tuple[Change, ...]:
        """The journal."""
        content = self.read(self._journal) if os.path.exists(self._journal) else b""
        self._end = content.rfind(b"\n") + 1
        lines = [json.loads(line) for line in content[: self._end].splitlines()]
        version = lines[0].get("version", VERSION) if lines else VERSION
        if version != VERSION:
            raise _other_version(self._path, version)
        return tuple(_change(line) for line in lines if "version" not in line)

    def append(self, change: Change) -> None:
        """One more line of the journal, behind those that :meth:`changes` or :meth:`rewrite` saw."""
        line = _line(change) if self._end else _HEAD + _line(change)
        with open(self._journal, "r+b" if os.path.exists(self._journal) else "wb") as file:
            file.truncate(self._end)
            file.seek(self._end)
            file.write(line)
        self._end += len(line)

    def rewrite(self, changes: Iterable[Change]) -> None:
        """Replace the journal."""
        content = _HEAD + b"".join(map(_line, changes))
        self._replace(self._journal, content)
        self._end = len(content)

    def _replace(self, path: str, content: bytes) -> None:
        with open(f"{path}.partial", "wb") as file:
            file.write(content)
        os.replace(f"{path}.partial", path)


def _other_version(path: str, version: object) -> ValueError:
    return ValueError(
        f"spill={path!r} holds pages of version {version}, this release reads version {VERSION}: use an "
        "empty folder, or the release that wrote them"
    )


def _line(change: Change) -> bytes:
    out = [{"name": p.name, "count": p.count, "boxes": p.boxes.tolist()} for p in change.out]
    return json.dumps({"frames": change.frames, "out": out, "back": change.back}).encode() + b"\n"


def _change(line: dict[str, Any]) -> Change:
    pages = (Page(p["name"], p["count"], np.array(p["boxes"])) for p in line["out"])
    return Change(line["frames"], tuple(pages), tuple(line["back"]))

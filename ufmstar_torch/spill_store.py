"""Where pages are kept: files named by their content, and a journal of which were out after how many frames.

Pages never change. The journal has a line for every frame that changed which pages are out, so that a saved state finds
its own pages as long as the folder is kept, and a frame writes no more than its change. Pages count from 0 in the order
of the journal.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from ufmstar_torch.spill_index import Page


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
    """

    def __init__(self, path: Path) -> None:
        self._path, self._journal = path, path / "pages.jsonl"
        self._path.mkdir(parents=True, exist_ok=True)
        self._end = 0

    def read(self, name: str) -> bytes:
        """The content of a page."""
        return (self._path / name).read_bytes()

    def write(self, name: str, content: bytes) -> None:
        """Keep a page; its name says its content, so that one that is there needs no second write."""
        if not (self._path / name).exists():
            self._replace(self._path / name, content)

    def changes(self) -> tuple[Change, ...]:
        """The journal."""
        content = self._journal.read_bytes() if self._journal.exists() else b""
        self._end = content.rfind(b"\n") + 1
        return tuple(_change(json.loads(line)) for line in content[: self._end].splitlines())

    def append(self, change: Change) -> None:
        """One more line of the journal, behind those that :meth:`changes` or :meth:`rewrite` saw."""
        line = _line(change)
        with open(self._journal, "r+b" if self._journal.exists() else "wb") as file:
            file.truncate(self._end)
            file.seek(self._end)
            file.write(line)
        self._end += len(line)

    def rewrite(self, changes: Iterable[Change]) -> None:
        """Replace the journal."""
        content = b"".join(map(_line, changes))
        self._replace(self._journal, content)
        self._end = len(content)

    def _replace(self, path: Path, content: bytes) -> None:
        partial = path.with_name(f"{path.name}.partial")
        partial.write_bytes(content)
        os.replace(partial, path)


def _line(change: Change) -> bytes:
    return json.dumps(asdict(change)).encode() + b"\n"


def _change(line: dict[str, Any]) -> Change:
    pages = (Page(p["name"], p["count"], _box(p["means"]), _box(p["reach"])) for p in line["out"])
    return Change(line["frames"], tuple(pages), tuple(line["back"]))


def _box(corners: list[list[float]]) -> Any:
    return tuple(map(tuple, corners))

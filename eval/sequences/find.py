"""The sequences below a folder, whatever their layouts: what ``ufmstar eval --root`` runs over."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from ufmstar_torch.eval.sequences.layout import LAYOUTS, layouts_of, parts_of

# Folders within one another have one name: ROOT/chess/seq-01 is "chess__seq-01".
_BETWEEN = "__"


class Found(NamedTuple):
    """A sequence on disk, not opened yet: its place below the root, "/" as "__" (unique), and the arguments of
    ``open_sequence``."""

    name: str
    path: Path
    layout: str


def find_sequences(root: str | Path, max_depth: int = 4, layout: str = "auto") -> list[Found]:
    """All sequences at or below ``root``, sorted by name.

    A folder that is a sequence is not looked into, so that its own folders of images are none. Each folder on disk
    counts once, whatever links lead to it (a folder before a link to it), so that links in a circle end too. Hidden
    folders and those that may not be read are left out.

    Args:
        root: folder, or the file of one sequence.
        max_depth: levels of folders below ``root`` that are looked at, at least 0.
        layout: the only layout to look for; "auto": any.

    Returns:
        The sequences; empty where there is none.

    Raises:
        FileNotFoundError: no such root.
        ValueError: ``max_depth`` is negative, an unknown layout, or a folder that fits several layouts.
    """
    root = Path(root)
    if not root.exists():
        raise FileNotFoundError(f"root: no such file or folder: {root}")
    if max_depth < 0:
        raise ValueError(f"max_depth must be at least 0, got {max_depth}")
    if layout not in LAYOUTS:
        raise ValueError(f"layout must be one of {', '.join(LAYOUTS)}, got {layout!r}")
    return sorted(_below(root, root, max_depth, layout, set()), key=lambda result: result.name)


def _below(path: Path, root: Path, depth: int, layout: str, seen: set[Path]) -> Iterator[Found]:
    """The sequences at or below ``path``; ``seen`` gets every folder that was looked at."""
    real = path.resolve()
    if real in seen:
        return
    seen.add(real)
    fitting = [name for name in layouts_of(path) if layout in ("auto", name)]
    if len(fitting) > 1:
        raise ValueError(f"{path} fits the layouts {', '.join(fitting)}: pass layout")
    if fitting:
        for part in parts_of(path, fitting[0]):
            if part == path or part.resolve() not in seen:
                seen.add(part.resolve())
                yield Found(_name(part, root), part, fitting[0])
        return
    if depth > 0:
        for folder in _folders(path):
            yield from _below(folder, root, depth - 1, layout, seen)


def _folders(path: Path) -> list[Path]:
    """The folders in a folder, links last; none where it may not be read."""
    try:
        folders = [p for p in path.iterdir() if not p.name.startswith(".") and p.is_dir()] if path.is_dir() else []
    except PermissionError:  # "lost+found" at the top of a disk
        return []
    return sorted(folders, key=lambda p: (p.is_symlink(), p.name))


def _name(path: Path, root: Path) -> str:
    if path == root:
        return path.resolve().stem if path.is_file() else path.resolve().name
    return _BETWEEN.join(path.relative_to(root).parts)

"""Files of recordings: listing, order of names, and the file that another one names."""

from __future__ import annotations

import os
import re
from functools import lru_cache
from pathlib import Path

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".ppm", ".pgm", ".tif", ".tiff", ".webp")
DEPTH_SUFFIXES = (".png", ".exr", ".npy", ".npz", ".tif", ".tiff")
_ELSEWHERE = re.compile(r"[A-Za-z]:|file:")  # a drive of Windows, a scheme


def list_files(folder: Path, suffixes: tuple[str, ...] = IMAGE_SUFFIXES) -> list[Path]:
    """The folder's files with one of the suffixes, numbers in names sorted by value (2 before 10). Broken links are
    included, so that their frames are skipped and counted."""
    named = (path for path in folder.iterdir() if path.suffix.lower() in suffixes and not is_hidden(path))
    return sorted((p for p in named if p.is_file() or (p.is_symlink() and not p.exists())), key=natural_key)


def is_hidden(path: Path) -> bool:
    """True if the name begins with a dot, as that of an unfinished download, and ._NAME, in which macOS stores the
    attributes of NAME."""
    return path.name.startswith(".")


def listed_path(text: str) -> Path:
    """The path that a text file states, also if a program on Windows wrote it with backslashes."""
    return Path(text.replace("\\", "/"))


def listed_file(folder: Path, text: str | Path) -> Path:
    """The file below ``folder`` that a text file names; it need not exist.

    A path outside of the folder is never used. Where another computer's path is listed (absolute, with a drive or a
    scheme, or with ".."), the longest end of it that is a file below the folder counts.
    """
    path = listed_path(str(text))
    parts = [part for part in path.parts if part not in ("/", "//", "..") and not _ELSEWHERE.fullmatch(part)]
    if len(parts) == len(path.parts):
        return on_disk(folder / path)
    ends = (on_disk(folder.joinpath(*parts[start:])) for start in range(len(parts)))
    return next((end for end in ends if end.is_file()), folder.joinpath(*parts[-1:]))


def on_disk(path: Path) -> Path:
    """The path; if nothing has it, the one path that differs from it in upper and lower case alone, as that of a file
    copied from Windows."""
    if os.path.exists(path) or path == path.parent:  # False for names that no file can have
        return path
    folder = on_disk(path.parent)
    if not os.path.isdir(folder):
        return path
    return folder / _by_lower_case(folder, folder.stat().st_mtime_ns).get(path.name.lower(), path.name)


@lru_cache(maxsize=16)
def _by_lower_case(folder: Path, _changed: int) -> dict[str, str]:
    """The names in a folder by their lower case, without names that differ in case alone."""
    names: dict[str, list[str]] = {}
    for name in os.listdir(folder):
        names.setdefault(name.lower(), []).append(name)
    return {lower: same[0] for lower, same in names.items() if len(same) == 1}


def natural_key(path: Path) -> list[tuple[int, int, str]]:
    """Sort key of a file name: digit groups by value, the rest as text."""
    parts = re.split(r"(\d+)", path.name)
    return [(0, int(part), part) if part.isdigit() else (1, 0, part) for part in parts]

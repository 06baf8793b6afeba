"""Pairing of files by name: frames with depth maps that some other program named."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from pathlib import Path


def pair_by_name(names: Sequence[str], files: Iterable[Path]) -> dict[str, Path]:
    """The file of each frame name, where there is one.

    A file belongs to a name if their stems are equal, or else if all numbers in them are
    (``frame-000012.color`` and ``000012_depth``; leading zeros do not count, decimals do). Numbers that
    occur twice among the files or among the names pair nothing.
    """
    files = list(files)
    by_stem = {file.stem: file for file in files}
    file_of = _unique({file: _numbers(file.stem) for file in files})
    name_of = _unique({name: _numbers(name) for name in names})
    pairs = {name_of[key]: file for key, file in file_of.items() if key in name_of}
    return {name: by_stem.get(name) or pairs[name] for name in names if name in by_stem or name in pairs}


def _numbers(stem: str) -> tuple[int | str, ...]:
    """Digit groups by value; those behind a decimal point as text, since 1.05 is not 1.5."""
    groups = re.findall(r"((?<=\d)\.)?(\d+)", stem)
    return tuple(digits if point else int(digits) for point, digits in groups)


def _unique(numbers_of: dict) -> dict:
    """The inverse of a mapping, without the keys () and those that several items share."""
    inverse: dict = {}
    for item, key in numbers_of.items():
        inverse.setdefault(key, []).append(item)
    return {key: items[0] for key, items in inverse.items() if len(items) == 1 and key}

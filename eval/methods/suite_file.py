"""A user's own suite, from a TOML file.

```toml
title = "Smoothing"                        # name: the file's, unless given
datasets = ["scannet"]                     # a hint for readers
sweep = ["ema_alpha"]                      # settings that vary, for a figure

[[rows]]
methods = ["Ensemble", "UfM*-Ensemble"]    # as the paper names them

[[rows]]
methods = ["UfM*-Ensemble"]
setting = { "segment.min_pixels" = 2000 }  # of UfM*, or of ``Setting``: rotation_noise [deg], skip, anchors ...
each = { ema_alpha = [0.1, 0.25, 1.0] }    # one row for every value
```
"""

from __future__ import annotations

import itertools
import tomllib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from ufmstar_torch.eval.methods.row import Row
from ufmstar_torch.eval.methods.suite import Suite, rows_of, setting_from

_KEYS = {"name": str, "title": str, "datasets": list, "sweep": list, "rows": list}
_ROW_KEYS = {"methods": list, "setting": dict, "each": dict}


def suite_from_file(path: Path) -> Suite:
    """Read a suite.

    Raises:
        FileNotFoundError: no such file.
        ValueError: not TOML, an unknown key, a value of the wrong kind, or an impossible row; the message names the
            file.
    """
    try:
        with path.open("rb") as file:
            values = tomllib.load(file)
        _check(values, _KEYS, "the suite")
        rows = [row for n, part in enumerate(values.get("rows", [])) for row in _rows(part, f"rows {n + 1}")]
        return Suite(
            name=values.get("name", path.stem),
            title=values.get("title", path.stem),
            rows=tuple(rows),
            sweep=_words(values, "sweep"),
            datasets=_words(values, "datasets"),
        )
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, ValueError) as error:
        raise ValueError(f"{path}: {error}") from error


def _rows(part: Any, where: str) -> Iterator[Row]:
    """The rows of one [[rows]]: every method at every point."""
    _check(part, _ROW_KEYS, where)
    methods, each = _words(part, "methods"), part.get("each", {})
    if not methods:
        raise ValueError(f'{where}: methods must name at least one, as ["UfM*-Ensemble"]')
    for name, points in each.items():
        if not isinstance(points, list) or not points:
            raise ValueError(f"{where}: each.{name} must be a list of values, got {points!r}")
    for point in itertools.product(*each.values()):
        values = {**part.get("setting", {}), **dict(zip(each, point, strict=True))}
        try:
            yield from rows_of(methods, setting_from(values))
        except ValueError as error:
            raise ValueError(f"{where}: {error}") from error


def _check(values: Any, kinds: Mapping[str, type], where: str) -> None:
    """Raises ValueError for an unknown key, or a value of the wrong kind."""
    if not isinstance(values, dict):
        raise ValueError(f"{where} must be a table, got {values!r}")
    unknown = sorted(values.keys() - kinds.keys())
    if unknown:
        raise ValueError(f"{where}: unknown key {unknown[0]!r}, expected {', '.join(kinds)}")
    for name, value in values.items():
        if not isinstance(value, kinds[name]):
            raise ValueError(f"{where}: {name} must be a {kinds[name].__name__}, got {value!r}")


def _words(values: Mapping[str, Any], name: str) -> tuple[str, ...]:
    words = values.get(name, [])
    if not all(isinstance(word, str) for word in words):
        raise ValueError(f"{name} must be a list of words, got {words!r}")
    return tuple(words)

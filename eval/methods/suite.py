"""Suites: the rows of a table or figure. Each is a TOML file, in ``suites/`` or of a user.

```toml
title = "Smoothing"                        # ``name`` is the file's by default
base = "ensemble"                          # the suite's network, unless --base names another one; or
bases = ["ensemble", "aleatoric"]          # several: the rows of each in turn
efficiency = true                          # also measure time, energy and memory
separate = true                            # no means over data sets, which differ on purpose
include = ["ablation-eta"]                 # also the rows of other suites of the package

[[rows]]
methods = ["{alone}", "UfM*-{behind}"]     # the paper's names: "Ensemble", "UfM*-Ensemble"; or by the base

[[rows]]
bases = ["ensemble"]                       # only for these bases
methods = ["UfM*-{behind}"]
setting = { "segment.min_pixels" = 2000 }  # of UfM*, or of ``Setting``: ufm_preset, preprocess, rotation_noise ...
each = { ema_alpha = [0.1, 0.25, 1.0] }    # one row for every value
```

A row that occurs several times is used once.
"""

from __future__ import annotations

import itertools
import re
import tomllib
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from importlib.resources import files
from importlib.resources.abc import Traversable
from pathlib import Path, PurePath
from typing import Any

from ufmstar_torch.eval.methods.method import BASES, UFM_STAR, Method
from ufmstar_torch.eval.methods.row import Row
from ufmstar_torch.eval.methods.setting import setting_from
from ufmstar_torch.files.limits import read_settings

_NAME = re.compile(r"[a-z0-9]+(-[a-z0-9]+)*")
_SHIPPED = files("ufmstar_torch.eval.methods") / "suites"
_KEYS = {
    "name": str, "title": str, "base": str, "bases": list, "include": list, "rows": list, "efficiency": bool,
    "separate": bool,
}  # fmt: skip
_WORDS = ("bases", "include", "methods")
_MOST_ROWS = 1000  # each takes minutes
_ROW_KEYS = {"methods": list, "bases": list, "setting": dict, "each": dict, "label": str}


@dataclass(frozen=True)
class Suite:
    """Rows, in the order of the table.

    Raises:
        ValueError: a field is impossible.
    """

    name: str  # small letters, digits and single dashes
    title: str  # one line
    rows: tuple[Row, ...]  # without duplicates
    efficiency: bool = False  # True if time, energy and memory are measured
    separate: bool = False  # True if the report has no means over data sets

    def __post_init__(self) -> None:
        if not _NAME.fullmatch(self.name):
            raise ValueError(f"name of a suite must be small letters, digits and single dashes, got {self.name!r}")
        if not self.rows:
            raise ValueError(f"suite {self.name} needs at least one row")
        slugs = [row.slug for row in self.rows]
        twice = sorted({slug for slug in slugs if slugs.count(slug) > 1})
        if twice:
            raise ValueError(f"suite {self.name} has a row twice: {', '.join(twice)}")

    @property
    def bases(self) -> tuple[str, ...]:
        """The bases of the rows, in order."""
        return tuple(dict.fromkeys(row.method.base for row in self.rows))

    def with_bases(self, bases: Iterable[str]) -> Suite:
        """The suite with the rows of some bases only. Raises ValueError: no row remains."""
        available = set(bases)
        rows = tuple(row for row in self.rows if row.method.base in available)
        if not rows:
            raise ValueError(
                f"suite {self.name} has rows of {', '.join(self.bases)}, but there are networks of "
                f"{', '.join(sorted(available)) or 'none'} only: give --network BASE=MODEL:FILES for one of them"
            )
        return replace(self, rows=rows)


def names() -> tuple[str, ...]:
    """The names of the suites that come with the package, the paper's tables first."""
    stems = [file.name.removesuffix(".toml") for file in _SHIPPED.iterdir() if file.name.endswith(".toml")]
    return tuple(
        sorted(stems, key=lambda name: (not name.startswith("paper-table"), not name.startswith("paper"), name))
    )


def listing() -> str:
    """A line for each suite: name, number of rows, title."""
    suites = [suite_named(name) for name in names()]
    return "\n".join(f"{suite.name:26}{len(suite.rows):3} rows  {suite.title}" for suite in suites)


def suite_named(name: str, base: str | None = None, preset: str | None = None) -> Suite:
    r"""Read a suite.

    Args:
        name: one of ``names()``, or a TOML file (\*.toml).
        base: network of a figure or ablation, a key of ``method.BASES``; None = the suite's.
        preset: of UfM*'s settings in all rows of UfM*, "paper" or "default"; None = the suite's. Other changes of the
            rows stay.

    Raises:
        FileNotFoundError: no such file.
        ValueError: no such suite or base, or the suite's rows name their networks; the file is not TOML, or has an
            unknown key, a value of the wrong type or an impossible row. The message names the file.
    """
    _file(name)
    if base is not None:
        _require_base(base, "--base")
    try:
        values = _read(name)
        if base is not None and "base" not in values:
            raise ValueError("--base goes with figures and ablations of one network, the suite names its own")
        every = itertools.islice(_rows_of(values, base or values.get("base"), preset), _MOST_ROWS + 1)
        if len(rows := tuple(every)) > _MOST_ROWS:
            raise ValueError(f"the suite has more than {_MOST_ROWS} rows")
        rows = tuple(dict.fromkeys(rows))
        stem = Path(name).stem
        if base is not None and not rows:
            raise ValueError(f"the suite has no rows of {base}")
        flags = {name: values.get(name, False) for name in ("efficiency", "separate")}
        return Suite(values.get("name", stem), values.get("title", stem), rows, **flags)
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from error


def _file(name: str) -> Traversable:
    """The file of a suite. Raises ValueError: no such suite."""
    if name.endswith(".toml"):
        return Path(name)
    if name not in names():
        raise ValueError(f"no suite is called {name!r}: there are {', '.join(names())}, and TOML files (*.toml)")
    return _SHIPPED / f"{name}.toml"


def _read(name: str) -> dict[str, Any]:
    """The content of a suite's file. Raises ValueError: unknown keys or bases."""
    file = _file(name)
    values = read_settings(file) if isinstance(file, Path) else tomllib.loads(file.read_text(encoding="utf-8"))
    _check(values, _KEYS, "the suite")
    for base in (*values.get("bases", []), values.get("base", "ensemble")):
        _require_base(base)
    return values


def _rows_of(values: Mapping[str, Any], base: str | None, preset: str | None) -> Iterator[Row]:
    """The rows of a suite and of the suites that it includes, for a base or for the suite's ``bases``."""
    for network in values.get("bases", [base]):
        for n, part in enumerate(values.get("rows", [])):
            _check(part, _ROW_KEYS, f"rows {n + 1}")
            try:
                yield from _expanded(part, network, preset)
            except ValueError as error:
                raise ValueError(f"rows {n + 1}: {error}") from error
    for name in dict.fromkeys(values.get("include", [])):
        if name not in names():
            raise ValueError(f"include: no suite of the package is called {name!r}")
        yield from _rows_of(_read(name), base, preset)


def _expanded(part: Any, base: str | None, preset: str | None) -> Iterator[Row]:
    """The rows of one [[rows]]: every method at every point of ``each``."""
    methods = part.get("methods")
    if not methods:
        raise ValueError('methods must name at least one, as ["UfM*-Ensemble"]')
    if base is not None:
        alone, behind = BASES[base]
        methods = [name.replace("{alone}", alone).replace("{behind}", behind) for name in methods]
    ranges = part.get("each", {})
    for name, points in ranges.items():
        if not isinstance(points, list) or not points:
            raise ValueError(f"each.{name} must be a list of values, got {points!r}")
    if base is not None and base not in part.get("bases", (base,)):
        return
    label = part.get("label", "")
    if label and (ranges or (len(methods) > 1 and "{method}" not in label)):
        raise ValueError(f"label {label!r} names one row: of several methods, write {{method}} in it; not with each")
    for point in itertools.product(*ranges.values()):
        setting = {**part.get("setting", {}), **dict(zip(ranges, point, strict=True))}
        if ".." in (path := PurePath(str(setting.get("anchors", "")))).parts or path.is_absolute():
            raise ValueError(f"anchors must be a file in the folder of each sequence, got {str(path)!r}")
        for method in map(Method.parse, methods):
            started = {"ufm_preset": preset} if preset is not None and method.fusion == UFM_STAR else {}
            yield Row(method, setting_from(setting | started), label.replace("{method}", method.name))


def _require_base(base: str, name: str = "base") -> None:
    if base not in BASES:
        raise ValueError(f"{name} must be one of {', '.join(BASES)}, got {base!r}")


def _check(values: Any, kinds: Mapping[str, type], where: str) -> None:
    """Raises ValueError: an unknown key, or a value of the wrong type."""
    if not isinstance(values, dict):
        raise ValueError(f"{where} must be a table, got {values!r}")
    unknown = sorted(values.keys() - kinds.keys())
    if unknown:
        raise ValueError(f"{where}: unknown key {unknown[0]!r}, expected {', '.join(kinds)}")
    for name, value in values.items():
        if not isinstance(value, kinds[name]):
            raise ValueError(f"{where}: {name} must be a {kinds[name].__name__}, got {value!r}")
        if name in _WORDS and not all(isinstance(word, str) for word in values[name]):
            raise ValueError(f"{where}: {name} must be a list of words, got {value!r}")

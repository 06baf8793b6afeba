"""A suite: the rows that make a table or figure, and what it is drawn over."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Any

from ufmstar_torch.config import UfMStarConfig
from ufmstar_torch.eval.methods.method import UFM_STAR, Method
from ufmstar_torch.eval.methods.row import Row
from ufmstar_torch.eval.methods.setting import DEFAULT, Setting

_NAME = re.compile(r"[a-z0-9]+(-[a-z0-9]+)*")
_OWN = tuple(f.name for f in fields(Setting) if f.name != "overrides")


@dataclass(frozen=True)
class Suite:
    """Rows, in the order of the table.

    Attributes:
        name: small letters, digits and single dashes.
        title: one line for people.
        rows: each of them once.
        sweep: settings that vary, by the names of ``Setting.to_dict``; () = a table of methods.
        datasets: that the paper takes.
        sequences: how many it samples of each; None = all.
        network: that it judges.
        size: (h, w) of the network's input there [px].
        efficiency: whether time, energy and memory are what it is about.

    Raises:
        ValueError: a field is impossible.
    """

    name: str
    title: str
    rows: tuple[Row, ...]
    sweep: tuple[str, ...] = ()
    datasets: tuple[str, ...] = ()
    sequences: int | None = None
    network: str = ""
    size: tuple[int, int] | None = None
    efficiency: bool = False

    def __post_init__(self) -> None:
        if not _NAME.fullmatch(self.name):
            raise ValueError(f"name of a suite must be small letters, digits and single dashes, got {self.name!r}")
        if not self.rows:
            raise ValueError(f"suite {self.name} needs at least one row")
        slugs = [row.slug for row in self.rows]
        twice = sorted({slug for slug in slugs if slugs.count(slug) > 1})
        if twice:
            raise ValueError(f"suite {self.name} has a row twice: {', '.join(twice)}")
        for name in self.sweep:
            default_of(name)
        for row in self.rows:
            check_row(row)

    @property
    def bases(self) -> tuple[str, ...]:
        """What networks the rows need, in their order."""
        return tuple(dict.fromkeys(row.method.base for row in self.rows))

    def with_bases(self, bases: Iterable[str]) -> Suite:
        """The rows whose networks are there.

        Raises:
            ValueError: none is left.
        """
        there = set(bases)
        kept = tuple(row for row in self.rows if row.method.base in there)
        if not kept:
            raise ValueError(
                f"suite {self.name} has rows of {', '.join(self.bases)}, but there are networks of "
                f"{', '.join(sorted(there)) or 'none'} only: give --network BASE=MODEL:FILES for one of them"
            )
        return replace(self, rows=kept)


def setting_from(values: Mapping[str, Any]) -> Setting:
    """A setting from the flat form of ``Setting.to_dict``.

    Values that UfM* has anyway are left out, so that such a row is the default one.

    Raises:
        ValueError: an unknown name, or a value that it does not take.
    """
    own = {name: value for name, value in values.items() if name in _OWN}
    overrides = {name: value for name, value in values.items() if name not in _OWN}
    changed = {name: value for name, value in overrides.items() if value != default_of(name)}
    setting = Setting(overrides=changed, **own)
    configured(setting)
    return setting


def value_of(setting: Mapping[str, Any], name: str) -> Any:
    """The value that a setting (``Setting.to_dict``, as in a record) gives a name, UfM*'s own if it says nothing.

    Raises:
        ValueError: an unknown name.
    """
    return setting[name] if name in setting else default_of(name)


def default_of(name: str) -> Any:
    """The value that a row has as the paper runs it.

    Raises:
        ValueError: there is no such setting.
    """
    if name in _OWN:
        return getattr(DEFAULT, name)
    value: Any = UfMStarConfig()
    for part in name.split("."):
        if not is_dataclass(value) or part not in {f.name for f in fields(value)}:
            known = ", ".join(own for own in _OWN if own != "seed")
            raise ValueError(f"no setting is called {name!r}: expected {known}, or UfM*'s own, as ema_alpha")
        value = getattr(value, part)
    if is_dataclass(value):
        raise ValueError(f"setting {name!r} is a group: name one of its values, as {name}.min_pixels")
    return value


def configured(setting: Setting) -> UfMStarConfig:
    """UfM*'s configuration under a setting.

    Raises:
        ValueError: an unknown name, or a value that it does not take.
    """
    nested: dict[str, Any] = {}
    for name, value in setting.overrides.items():
        default_of(name)
        group, _, field = name.rpartition(".")
        (nested.setdefault(group, {}) if group else nested)[field] = value
    config = UfMStarConfig(anchored=bool(setting.anchors))
    groups = {group: replace(getattr(config, group), **values) for group, values in nested.items() if _group(values)}
    return config.replace(**{name: value for name, value in nested.items() if not _group(value)}, **groups)


def check_row(row: Row) -> None:
    """Raises ValueError unless the setting changes something of the method, in a way that it takes."""
    if row.setting.overrides and row.method.fusion != UFM_STAR:
        told = ", ".join(row.setting.overrides)
        raise ValueError(f"row {row.method.name}: {told} is of UfM*, which the row does without")
    if row.setting.anchors and row.method.fusion != UFM_STAR:
        raise ValueError(f"row {row.method.name}: anchors are of UfM*, which the row does without")
    configured(row.setting)


def rows_of(methods: Iterable[Method | str], setting: Setting = DEFAULT) -> tuple[Row, ...]:
    """A row for each method (or its name) under one setting.

    Raises:
        ValueError: no method is called so.
    """
    parsed = [Method.parse(method) if isinstance(method, str) else method for method in methods]
    return tuple(Row(method, setting) for method in parsed)


def _group(value: Any) -> bool:
    return isinstance(value, dict)

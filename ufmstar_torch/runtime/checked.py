"""Frozen settings that are checked on construction and convert to and from JSON.

A field's metadata describe it: ``symbol`` (the paper's letter), ``unit`` and ``range``, ``choices``, or ``section``
(nested settings). An unknown name raises ``TypeError`` as in any dataclass, an invalid value a ``ValueError`` that
names the field.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping
from dataclasses import MISSING, Field, asdict, field, fields, replace
from pathlib import Path
from typing import Any, ClassVar, Self, get_args, get_type_hints

import numpy as np

from ufmstar_torch.files.limits import read_json


def number(
    default: float | None,
    symbol: str,
    unit: str,
    low: float,
    high: float = math.inf,
    *,
    open_low: bool = False,
    open_high: bool = False,
    optional: bool = False,
) -> Any:
    """A numeric field with the allowed range [low, high], where ``open_low`` and ``open_high`` exclude an end. An
    integer default requires whole numbers; ``optional``, or the default None, allows None."""
    metadata = {"symbol": symbol, "unit": unit, "range": (low, high, open_low), "open_high": open_high}
    return field(default=default, metadata=metadata | {"optional": optional or default is None})


def choice(default: str | int, *others: str | int) -> Any:
    """A field that takes one of a few values."""
    return field(default=default, metadata={"choices": (default, *others)})


def section(kind: type[Checked], *, optional: bool = False, on: bool = True) -> Any:
    """A field with nested settings: ``kind()`` by default, None unless ``on``; ``optional`` allows None."""
    metadata = {"section": kind, "optional": optional}
    return field(default_factory=kind, metadata=metadata) if on else field(default=None, metadata=metadata)


class Checked:
    """Base of a frozen dataclass: checks the values, and converts to and from plain values."""

    __dataclass_fields__: ClassVar[dict[str, Field[Any]]]

    def __post_init__(self) -> None:
        owner = type(self).__name__
        for f in fields(self):
            value = getattr(self, f.name)
            if isinstance(value, np.generic):
                object.__setattr__(self, f.name, value := value.item())
            if "range" in f.metadata and not (value is None and f.metadata["optional"]):
                _check_number(f"{owner}.{f.name}", value, f.metadata)
                if isinstance(f.default, int) and not isinstance(value, int):
                    raise ValueError(f"{owner}.{f.name} must be a whole number, got {value!r}")
            if "choices" in f.metadata and not (isinstance(value, str | int | None) and value in f.metadata["choices"]):
                raise ValueError(f"{owner}.{f.name} must be one of {f.metadata['choices']}, got {value!r}")
            kind = f.metadata.get("section")
            if kind is not None and not isinstance(value, kind) and not (value is None and f.metadata["optional"]):
                raise ValueError(f"{owner}.{f.name} must be settings {kind.__name__}, got {value!r}")
            if isinstance(f.default, bool) and not isinstance(value, bool):
                raise ValueError(f"{owner}.{f.name} must be True or False, got {value!r}")

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Self:
        """From plain values, as in JSON: lists become tuples, mappings become the settings of a field's type.

        Raises:
            ValueError: an unknown key, a missing field without a default, or an invalid value.
        """
        by_name = _named_fields(cls, values)
        needed = [n for n, f in by_name.items() if f.default is MISSING and f.default_factory is MISSING]
        if missing := [name for name in needed if name not in values]:
            raise ValueError(f"{cls.__name__} needs {missing}")
        return cls(**{name: _rich(cls, name, value) for name, value in values.items()})

    @classmethod
    def from_json(cls, path: str | Path) -> Self:
        """From a JSON file.

        Raises:
            FileNotFoundError: there is no such file.
            ValueError: the file holds no JSON object, or as :meth:`from_dict`; the message names the file.
        """
        if not isinstance(path, str | Path):
            raise TypeError(f"path must be a file name or path, got {type(path).__name__}")
        try:
            values = read_json(path)
        except ValueError as error:
            raise ValueError(f"{path} is not JSON: {error}") from error
        if not isinstance(values, dict):
            raise ValueError(f"{path} must hold a JSON object, got {type(values).__name__}")
        try:
            return cls.from_dict(values)
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from error

    @classmethod
    def read(cls, spec: Self | Mapping[str, Any] | str | Path) -> Self:
        """From settings, plain values or a JSON file; errors as :meth:`from_json`."""
        if isinstance(spec, str | Path):
            return cls.from_json(spec)
        return cls.from_dict(spec) if isinstance(spec, Mapping) else spec

    def with_values(self, values: Mapping[str, Any]) -> Self:
        """A copy with values changed by dotted name, as {"ema_alpha": 1.0, "merge.loss": 0.5}. A section that is None
        starts from its defaults.

        Raises:
            ValueError: an unknown name, or an invalid value.
        """
        by_name = _named_fields(type(self), values, dotted=True)
        changes: dict[str, Any] = {}
        within: dict[str, dict[str, Any]] = {}
        for name, value in values.items():
            group, _, field_name = name.partition(".")
            if field_name:
                within.setdefault(group, {})[field_name] = value
            else:
                changes[name] = value
        for group, inner in within.items():
            kind = by_name[group].metadata.get("section")
            if kind is None:
                raise ValueError(f"{type(self).__name__}.{group} is no section, got {group}.{next(iter(inner))}")
            start = changes.get(group, getattr(self, group))
            changes[group] = (kind() if start is None else start).with_values(inner)
        return replace(self, **changes)

    def to_dict(self) -> dict[str, Any]:
        """The settings as plain nested values, ready for JSON."""
        sections = {f.name: value for f in fields(self) if isinstance(value := getattr(self, f.name), Checked)}
        return {**asdict(self), **{name: value.to_dict() for name, value in sections.items()}}


def _named_fields(owner: type[Checked], values: object, *, dotted: bool = False) -> dict[str, Field[Any]]:
    """The fields of settings by name. Raises ValueError unless ``values`` is a mapping of such names, which may be
    ``dotted`` (SECTION.NAME)."""
    if not isinstance(values, Mapping) or not all(isinstance(name, str) for name in values):
        raise ValueError(f"values must be a mapping of {owner.__name__}'s fields by name, got {values!r:.60}")
    by_name = {f.name: f for f in fields(owner)}
    if unknown := sorted({name.partition(".")[0] if dotted else name for name in values} - by_name.keys()):
        raise ValueError(f"{owner.__name__} has no {unknown}; it has {list(by_name)}")
    return by_name


def _rich(owner: type, name: str, value: Any) -> Any:
    """Convert a JSON value to the field's type."""
    if isinstance(value, list):
        return tuple(value)
    if not isinstance(value, Mapping):
        return value
    hint = get_type_hints(owner)[name]
    nested = [kind for kind in (hint, *get_args(hint)) if isinstance(kind, type) and issubclass(kind, Checked)]
    return nested[0].from_dict(value) if nested else value


def _check_number(name: str, value: object, metadata: Mapping[str, Any]) -> None:
    low, high, open_low = metadata["range"]
    if isinstance(value, int) and abs(value) > sys.float_info.max:
        raise ValueError(f"{name} must be within the range of floats, got a number of {value.bit_length()} bits")
    if isinstance(value, bool) or not isinstance(value, (int, float)) or math.isnan(value):
        raise ValueError(f"{name} must be a number, got {value!r}")
    outside = value < low or value > high or (open_low and value == low) or (metadata["open_high"] and value == high)
    if outside:
        interval = f"{'(' if open_low else '['}{low}, {high}{')' if metadata['open_high'] else ']'}"
        raise ValueError(f"{name} must lie in {interval}, got {value!r}")


def flat(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested values by dotted name, for example segment.min_pixels; lists of mappings by number."""
    by_name: dict[str, Any] = {}
    for name, value in values.items():
        if isinstance(value, list) and value and isinstance(value[0], Mapping):
            value = {str(number): item for number, item in enumerate(value)}
        by_name |= flat(value, f"{prefix}{name}.") if isinstance(value, Mapping) and value else {prefix + name: value}
    return by_name

"""The rows of an evaluation as lines over the values of one setting, one for whatever else is fixed."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from ufmstar_torch.anchors.tracker import TrackerConfig
from ufmstar_torch.eval.engine.anchors import TRUTH_COUNT
from ufmstar_torch.eval.methods.method import Method
from ufmstar_torch.eval.methods.row import Row
from ufmstar_torch.eval.methods.setting import DEFAULTS, DENSE, TRACKED, TRUTH, default_of
from ufmstar_torch.eval.report.data import Results
from ufmstar_torch.eval.report.names import setting_label
from ufmstar_torch.eval.results.record import Record

COUNT = "anchor_count"
Rest = tuple[tuple[str, Any], ...]
# Rows without a number of anchors have at most so many.
_COUNTS = {"": 0, TRACKED: TrackerConfig().max_points, TRUTH: TRUTH_COUNT}
# What a row without anchors cannot have, beside what begins with "anchor_".
_OF_ANCHORS = ("anchors", "track_noise", "corrected", "posterior")
_ANCHORED = {TRACKED: "anchored", DENSE: "dense anchors", TRUTH: "truth anchors"}


@dataclass(frozen=True)
class Point:
    """A value of a setting, the rows that have it (several where noise was drawn with several seeds), their records."""

    value: float
    rows: tuple[Row, ...]
    records: tuple[Record, ...]


@dataclass(frozen=True)
class SweepLine:
    """A method over the values of a setting, nothing else being changed along it.

    Attributes:
        method: which.
        rest: what all its rows change beside that setting, sorted by name; () for the method as it is.
        points: in rising order of the values.
    """

    method: Method
    rest: Rest
    points: tuple[Point, ...]

    @property
    def words(self) -> str:
        """What is fixed, for people: "", "anchored", "truth anchors, shrinkage κ 1 anchors"."""
        values = dict(self.rest)
        anchors = _ANCHORED.get(kind := values.pop("anchors", ""), kind)
        return ", ".join(filter(None, (anchors, setting_label(values))))

    def at(self, value: float) -> Point | None:
        """The point of a value; of a line with one point, which does not depend on it, that one."""
        if len(self.points) == 1:
            return self.points[0]
        return next((point for point in self.points if point.value == value), None)


def sweeps(results: Results) -> list[tuple[str, str]]:
    """(base, setting) of every setting of which some line has at least three numbers, the default among them or not."""
    varied = dict.fromkeys((row.method.base, name) for row in results.rows for name in _changed(row))
    return [
        (base, name) for base, name in varied if any(len(line.points) >= 3 for line in sweep_lines(results, base, name))
    ]


def sweep_lines(results: Results, base: str, name: str) -> list[SweepLine]:
    """The lines of a base over the values of a setting, those of one point too, in the order of the rows. How images
    are prepared is no difference where it is the same of all rows."""
    groups: dict[tuple[Method, Rest], dict[float, list[Row]]] = {}
    rows = [row for row in results.rows if row.method.base == base]
    left_out = {name} if len({row.setting.preprocess for row in rows}) > 1 else {name, "preprocess"}
    for row in rows:
        value, values = _value(row, name), row.setting.to_dict()
        if _is_number(value):
            rest = tuple(sorted((other, values[other]) for other in _changed(row) if other not in left_out))
            groups.setdefault((row.method, rest), {}).setdefault(float(value), []).append(row)
    if name == COUNT:  # lines over several numbers of anchors begin with the rows that do without
        for (method, rest), by_value in groups.items():
            without = tuple(i for i in rest if i[0] not in _OF_ANCHORS and not i[0].startswith("anchor_"))
            plain = groups.get((method, without), {})
            if len(by_value) > 1 and 0.0 in plain:
                by_value.setdefault(0.0, plain[0.0])

    def point(value: float, rows: Sequence[Row]) -> Point:
        return Point(value, tuple(rows), tuple(record for row in rows for record in results.of(row)))

    return [
        SweepLine(method, rest, tuple(point(value, by_value[value]) for value in sorted(by_value)))
        for (method, rest), by_value in groups.items()
    ]


def default_value(name: str, preset: str = DEFAULTS) -> float:
    """The value that a row of a preset has where nothing is changed, NaN where it is no number."""
    try:
        value = default_of(name, preset)
    except ValueError:  # a setting of another version: without a default, its rows stand alone
        return math.nan
    return float(value) if _is_number(value) else math.nan


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _value(row: Row, name: str) -> Any:
    if name == COUNT and row.setting.anchor_count is None:
        return _COUNTS.get(row.setting.anchors, math.nan)
    return row.setting.to_dict().get(name, default_value(name, row.setting.ufm_preset))


def _changed(row: Row) -> list[str]:
    """What a row's setting changes, the noise's seed aside."""
    return [name for name in row.setting.to_dict() if name != "seed"]

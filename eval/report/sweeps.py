"""The rows of an evaluation as lines over the values of one setting, one for whatever else is fixed."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from ufmstar_torch.anchors.tracker import TrackerConfig
from ufmstar_torch.eval.engine.anchors import TRUTH_COUNT
from ufmstar_torch.eval.methods.method import Method
from ufmstar_torch.eval.methods.row import Row
from ufmstar_torch.eval.methods.setting import DEFAULTS, DENSE, TRACKED, TRUTH, default_of
from ufmstar_torch.eval.report.data import Results
from ufmstar_torch.eval.report.means import Mean, mean_over, value_of
from ufmstar_torch.eval.report.names import Quantity, setting_label

COUNT = "anchor_count"
Rest = tuple[tuple[str, Any], ...]
# Rows that say no number of anchors have at most so many.
_COUNTS = {"": 0, TRACKED: TrackerConfig().max_points, TRUTH: TRUTH_COUNT}
# What a row without anchors cannot have, beside what begins with "anchor_".
_OF_ANCHORS = ("anchors", "track_noise", "corrected", "posterior")
_ANCHORED = {TRACKED: "anchored", DENSE: "dense anchors", TRUTH: "truth anchors"}


@dataclass(frozen=True)
class Point:
    """A value of a setting, and the rows that have it (several where noise was drawn with several seeds)."""

    value: float
    rows: tuple[Row, ...]


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
    prepared = {row.setting.preprocess for row in rows}
    for row in rows:
        value = _value(row, name)
        if _is_number(value):
            rest = tuple(item for item in _rest(row, name) if item[0] != "preprocess" or len(prepared) > 1)
            groups.setdefault((row.method, rest), {}).setdefault(float(value), []).append(row)
    if name == COUNT:
        _begin_without_anchors(groups)
    return [
        SweepLine(method, rest, tuple(Point(value, tuple(rows[value])) for value in sorted(rows)))
        for (method, rest), rows in groups.items()
    ]


def points(results: Results, method: Method, name: str) -> list[Point]:
    """The values of a setting tried with a method, nothing else being changed, in rising order."""
    lines = sweep_lines(results, method.base, name)
    return [point for line in lines if line.method == method and not line.rest for point in line.points]


def level(results: Results, point: Point, quantity: Quantity) -> Mean:
    """Mean over sequences at a point; seeds of one sequence are averaged first."""
    return mean_over(list(_by_sequence(results, point, quantity).values()))


def change(results: Results, point: Point, reference: Point, quantity: Quantity) -> Mean:
    """Mean over sequences of the difference to a reference."""
    theirs, mine = (_by_sequence(results, one, quantity) for one in (reference, point))
    return mean_over([value - theirs.get(where, math.nan) for where, value in mine.items()])


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


def _begin_without_anchors(groups: dict[tuple[Method, Rest], dict[float, list[Row]]]) -> None:
    """Give lines over several numbers of anchors a point at 0, in place: the rows that do without."""
    for (method, rest), rows in groups.items():
        plain = groups.get((method, _without_anchors(rest)), {})
        if len(rows) > 1 and 0.0 in plain:
            rows.setdefault(0.0, plain[0.0])


def _without_anchors(rest: Iterable[tuple[str, Any]]) -> Rest:
    return tuple((n, value) for n, value in rest if n not in _OF_ANCHORS and not n.startswith("anchor_"))


def _rest(row: Row, name: str) -> Rest:
    values = row.setting.to_dict()
    return tuple(sorted((other, values[other]) for other in _changed(row) if other != name))


def _changed(row: Row) -> Sequence[str]:
    """What a row's setting changes, the noise's seed aside."""
    return [name for name in row.setting.to_dict() if name != "seed"]


def _by_sequence(results: Results, point: Point, quantity: Quantity) -> Mapping[tuple[str, str], float]:
    """The figure of each sequence, the mean over the point's rows (the seeds of a noise)."""
    by_sequence: dict[tuple[str, str], list[float]] = {}
    for row in point.rows:
        for record in results.of(row):
            value = quantity.factor * value_of(record, quantity.key)
            by_sequence.setdefault((record.dataset, record.sequence), []).append(value)
    return {where: math.fsum(values) / len(values) for where, values in by_sequence.items()}

"""Ablations: the rows of an evaluation as lines over the values of one setting, and figures over these."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import cycle
from typing import Any

import numpy as np

from ufmstar_torch.anchors.tracker import TrackerConfig
from ufmstar_torch.eval.engine.anchors import TRUTH_COUNT
from ufmstar_torch.eval.methods.method import ALONE, BASES, Method
from ufmstar_torch.eval.methods.row import Row
from ufmstar_torch.eval.methods.setting import CORNERS, DEFAULTS, DENSE, TRUTH, default_of
from ufmstar_torch.eval.report import names, style
from ufmstar_torch.eval.report.data import Results
from ufmstar_torch.eval.report.means import mean_of
from ufmstar_torch.eval.report.style import Look
from ufmstar_torch.eval.run.colours import FAINT
from ufmstar_torch.eval.suite.record import Record

COUNT = "anchor_count"
Rest = tuple[tuple[str, Any], ...]
# Rows without a number of anchors have at most so many.
_COUNTS = {"": 0, CORNERS: TrackerConfig().max_points, TRUTH: TRUTH_COUNT}
# Beginnings of settings that a row without anchors cannot have.
_OF_ANCHORS = ("anchor", "track_noise", "posterior")
_ANCHORED = {CORNERS: "anchored", DENSE: "dense anchors", TRUTH: "truth anchors"}


@dataclass(frozen=True, eq=False)
class SweepLine:
    """A method over the values of a setting, nothing else being changed along it."""

    method: Method
    rest: Rest  # what all its rows change beside that setting, sorted by name; () for the method as it is
    # Values of the setting in rising order, each with its records (of several rows where noise has several seeds).
    points: Mapping[float, Sequence[Record]]

    @property
    def words(self) -> str:
        """The settings that are the same along the line: "", "anchored", "truth anchors, shrinkage κ 1 anchors"."""
        values = dict(self.rest)
        anchors = _ANCHORED.get(kind := values.pop("anchors", ""), kind)
        return ", ".join(filter(None, (anchors, names.setting_label(values))))


def sweeps(results: Results) -> list[tuple[str, str]]:
    """(base, setting) of every setting of which some line has at least three numbers."""
    varied = dict.fromkeys((row.method.base, name) for row in results.rows for name in _changed(row))
    return [key for key in varied if any(len(line.points) >= 3 for line in sweep_lines(results, *key))]


def sweep_lines(results: Results, base: str, name: str) -> list[SweepLine]:
    """The lines of a base over the values of a setting, those of one point too, in the order of the rows. How images
    are prepared is no difference where it is the same of all rows."""
    groups: dict[tuple[Method, Rest], dict[float, list[Row]]] = {}
    rows = [row for row in results.rows if row.method.base == base]
    left_out = {name} if len({row.setting.preprocess for row in rows}) > 1 else {name, "preprocess"}
    for row in rows:
        if not math.isnan(value := _value(row, name)):
            rest = tuple(sorted((other, v) for other, v in _changed(row).items() if other not in left_out))
            groups.setdefault((row.method, rest), {}).setdefault(value, []).append(row)
    if name == COUNT:  # lines over several numbers of anchors begin with the rows that do without
        for (method, rest), by_value in groups.items():
            without = tuple(item for item in rest if not item[0].startswith(_OF_ANCHORS))
            plain = groups.get((method, without), {})
            if len(by_value) > 1 and 0.0 in plain:
                by_value.setdefault(0.0, plain[0.0])
    return [
        SweepLine(
            method, rest, {value: [r for row in by_value[value] for r in results.of(row)] for value in sorted(by_value)}
        )
        for (method, rest), by_value in groups.items()
    ]


def default_value(name: str, preset: str = DEFAULTS) -> float:
    """The value that a row of a preset has where nothing is changed, NaN where it is no number."""
    try:
        value = default_of(name, preset)
    except ValueError:  # a setting of another version: without a default, its rows stand alone
        return math.nan
    return 0.0 if value is None and name == "merge.loss" else _number(value)  # 0: components are never merged


def _number(value: Any) -> float:
    """The value, NaN where it is no finite number."""
    is_number = isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
    return float(value) if is_number else math.nan


def _value(row: Row, name: str) -> float:
    if name == COUNT and row.setting.anchor_count is None:
        return _COUNTS.get(row.setting.anchors, math.nan)
    values = _changed(row)
    return _number(values[name]) if name in values else default_value(name, row.setting.ufm_preset)


def _changed(row: Row) -> dict[str, Any]:
    """The settings that a row changes, without the seed."""
    return {name: value for name, value in row.setting.to_dict().items() if name != "seed"}


# ---- figures ----

SHOWN = (names.NLL, names.ECE_DELTA, names.ECE_Q)
# Colours and marks of lines of the same method by what is fixed; they differ from all of ``look_of``'s.
_FIXED: dict[Rest, tuple[str, str]] = {
    (("anchors", CORNERS),): ("#882255", "d"),
    (("anchors", TRUTH),): ("#222222", "*"),
}
_OTHERS = (("#117733", "h"), ("#88CCEE", "p"), ("#999933", "<"), ("#AA4499", ">"))
# Beyond this an axis of NLLs is logarithmic: pixels of nearly no variance take their mean to any height.
_HIGH = 50.0


def draw_sweep(results: Results, base: str, name: str) -> Any:
    """The figures over the values, with their confidence intervals."""
    lines = [line for line in sweep_lines(results, base, name) if len(line.points) > 1 or not line.rest]
    alone = [line for line in lines if line.method == Method(base)][:1]
    drawn = [line for line in lines if line.method.fusion != ALONE]
    looks, others = {line: style.look_of(line.method) for line in [*alone, *drawn]}, cycle(_OTHERS)
    for line in drawn:
        if line.rest:
            looks[line] = Look(line.words or looks[line].name, *(_FIXED.get(line.rest) or next(others)))
    shown = (*SHOWN, names.SPEARMAN) if any("anchors" in dict(line.rest) for line in drawn) else SHOWN
    values = sorted({value for line in drawn if len(line.points) > 1 for value in line.points})
    word, unit = names.SETTINGS.get(name, (names.setting_name(name), ""))
    title = f"{word[:1].upper()}{word[1:]}: {BASES[base][0]}, {names.count(len(results.sequences()), 'sequence')}"
    figure = style.new_figure(4.0 * len(shown), 3.4, title)
    for panel, quantity in zip(figure.subplots(1, len(shown)), shown, strict=True):
        reached = [y for line, look in looks.items() for y in _draw_line(panel, line, look, quantity)]
        x_words = f"{word} [{unit}]" if unit else word
        style.finish(panel, title=f"{quantity.heading}, mean over sequences", x=x_words)
        _scale(panel, values)
        # Values so high that the others would lie on one line; intervals of such means reach as far beyond 0.
        if max(map(abs, reached), default=0.0) > _HIGH:
            panel.set_yscale("symlog", linthresh=1.0)
            panel.set_ylim(3 * min(-0.1, *reached), 3 * max(0.1, *reached))
        if not math.isnan(default := default_value(name)):
            panel.axvline(default, color=FAINT, linewidth=0.8, linestyle=":", zorder=0)
        style.name_lines(panel)
    return figure


def _draw_line(axes: Any, line: SweepLine, look: Look, quantity: names.Quantity) -> list[float]:
    """Means over the values of a setting with their band; dashed without a band for reference. Returns the means."""
    means = {value: mean_of(records, quantity) for value, records in line.points.items()}
    known = [(x, mean.value, mean.half) for x, mean in means.items() if math.isfinite(mean.value)]
    if not known:
        return []
    x, y, half = np.array(known).T
    dashed: dict[str, Any] = {"color": look.colour, "linestyle": "--", "linewidth": 1.4, "label": look.name}
    if len(means) == 1:
        axes.axhline(y[0], **dashed)
    elif line.method.fusion == ALONE:
        axes.plot(x, y, **dashed)
    else:
        axes.plot(x, y, **look.line)
        axes.fill_between(x, y - half, y + half, color=look.colour, alpha=0.15, linewidth=0)
    return list(y.tolist())


def _scale(axes: Any, values: Sequence[float]) -> None:
    """Logarithmic where values span a factor of 20 or more, with a linear piece about 0 where 0 is among them; a tick
    for every value of a few."""
    positive = [value for value in values if value > 0]
    if positive and max(positive) >= 20 * min(positive):
        about_zero = {} if values[0] > 0 else {"linthresh": min(positive), "linscale": 0.5}
        axes.set_xscale("symlog" if about_zero else "log", **about_zero)
    if len(values) <= 9:
        axes.set_xticks(values, [f"{value:g}" for value in values])
        axes.minorticks_off()

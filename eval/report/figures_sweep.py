"""Ablations: the rows of an evaluation as lines over the values of one setting, and their figures."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import cycle
from typing import Any

import numpy as np

from ufmstar_torch.eval.engine.record import Record
from ufmstar_torch.eval.methods.method import ALONE, BASES, Method
from ufmstar_torch.eval.methods.row import Row
from ufmstar_torch.eval.methods.setting import DEFAULTS, default_of
from ufmstar_torch.eval.report import quantities, style
from ufmstar_torch.eval.report.data import Results
from ufmstar_torch.eval.report.quantities import Mean, difference, mean_of
from ufmstar_torch.eval.report.style import LineStyle
from ufmstar_torch.eval.run.colours import FAINT

SKIP = "skip"
Rest = tuple[tuple[str, Any], ...]
# Units of the axes.
UNITS = {
    "rotation_noise": "°", "translation_noise": "m", "rotation_drift": "°/√frame", "translation_drift": "m/√frame",
    "track_noise": "px", "prior_weight": "px/m³", "prior_mean": "m²", "segment.min_pixels": "px",
}  # fmt: skip


@dataclass(frozen=True, eq=False)
class SweepLine:
    """A method over the values of one setting, with all other settings fixed."""

    method: Method
    rest: Rest  # other changed settings, which all its rows share, sorted by name; () for the default
    # Values of the setting in rising order, each with its records (of several rows if noise has several seeds).
    points: Mapping[float, Sequence[Record]]

    @property
    def words(self) -> str:
        """The fixed settings of the line, "" for the default: "anchors corners"."""
        return ", ".join(f"{name} {value}" for name, value in self.rest)


def sweeps(results: Results) -> list[tuple[str, str]]:
    """(base, setting) of every setting with a line of at least three values."""
    varied = dict.fromkeys((row.method.base, name) for row in results.rows for name in _changed(row))
    return [key for key in varied if any(len(line.points) >= 3 for line in sweep_lines(results, *key))]


def sweep_lines(results: Results, base: str, name: str) -> list[SweepLine]:
    """The lines of a base over the values of a setting, in the order of the rows, lines of one point included. The
    preprocessing is not part of ``rest`` if all rows share it."""
    groups: dict[tuple[Method, Rest], dict[float, list[Row]]] = {}
    rows = [row for row in results.rows if row.method.base == base]
    left_out = {name} if len({row.setting.preprocess for row in rows}) > 1 else {name, "preprocess"}
    for row in rows:
        if not math.isnan(value := _value(row, name)):
            rest = tuple(sorted((other, v) for other, v in _changed(row).items() if other not in left_out))
            groups.setdefault((row.method, rest), {}).setdefault(value, []).append(row)
    return [
        SweepLine(
            method, rest, {value: [r for row in by_value[value] for r in results.of(row)] for value in sorted(by_value)}
        )
        for (method, rest), by_value in groups.items()
    ]


def default_value(name: str, preset: str = DEFAULTS) -> float:
    """The default value of a setting in a preset, NaN if it is no number."""
    try:
        value = default_of(name, preset)
    except ValueError:  # a setting of another version has no default
        return math.nan
    return 0.0 if value is None and name == "merge.loss" else _number(value)  # 0: components are never merged


def _number(value: Any) -> float:
    """The value, NaN if it is no finite number."""
    is_number = isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
    return float(value) if is_number else math.nan


def _value(row: Row, name: str) -> float:
    values = _changed(row)
    return _number(values[name]) if name in values else default_value(name, row.setting.ufm_preset)


def _changed(row: Row) -> dict[str, Any]:
    """The settings that a row changes, without the seed."""
    return {name: value for name, value in row.setting.to_dict().items() if name != "seed"}


# ---- figures ----

SHOWN = (quantities.NLL, quantities.ECE_DELTA, quantities.ECE_Q)
# Colours and markers of lines with other settings; they differ from all of ``line_style``'s.
_OTHERS = (("#882255", "d"), ("#222222", "*"), ("#117733", "h"), ("#88CCEE", "p"), ("#999933", "<"), ("#AA4499", ">"))
_DASHED: Mapping[str, Any] = {"linestyle": "--", "linewidth": 1.4}
# Beyond this mean NLL an axis is logarithmic: pixels with nearly no variance make the mean arbitrarily large.
_HIGH = 50.0


def draw_sweep(results: Results, base: str, name: str) -> Any:
    """The figures over the values, with their confidence intervals. Over skipped images, the first panel is the
    paper's: the improvement in NLL over the network alone, with its zero line."""
    lines = [line for line in sweep_lines(results, base, name) if len(line.points) > 1 or not line.rest]
    alone = [line for line in lines if line.method == Method(base)][:1]
    fused = [line for line in lines if line.method.fusion != ALONE]
    styles, spare = {line: style.line_style(line.method) for line in [*alone, *fused]}, cycle(_OTHERS)
    for line in fused:
        if line.rest:
            styles[line] = LineStyle(line.words or styles[line].name, *next(spare))
    shown = (*SHOWN, quantities.SPEARMAN) if any("anchors" in dict(line.rest) for line in fused) else SHOWN
    values = sorted({value for line in fused if len(line.points) > 1 for value in line.points})
    label, unit = name.replace("_", " "), UNITS.get(name)
    title = f"{label.capitalize()}: {BASES[base][0]}, {quantities.count(len(results.sequences()), 'sequence')}"
    gains = {line: _gains(alone[0], line) for line in fused if len(line.points) > 1} if name == SKIP and alone else {}
    figure = style.new_figure(4.0 * (len(shown) + bool(gains)), 3.4, title)
    panels = list(figure.subplots(1, len(shown) + bool(gains)))
    x_label = f"{label} [{unit}]" if unit else label
    if gains:
        panel = panels.pop(0)
        for line, means in gains.items():
            _draw_means(panel, means, styles[line])
        panel.axhline(0, **_DASHED, color=FAINT, label=styles[alone[0]].name)
        style.finish(panel, title=f"NLL of {styles[alone[0]].name} – NLL: improvement {quantities.HIGHER}", x=x_label)
        _scale(panel, values)
        style.name_lines(panel)
    for panel, quantity in zip(panels, shown, strict=True):
        reached = [y for line, line_style in styles.items() for y in _draw_line(panel, line, line_style, quantity)]
        style.finish(panel, title=f"{quantity.heading}, mean over sequences", x=x_label)
        _scale(panel, values)
        # On a linear axis all other values would be on one line. Intervals of such means extend as far below 0.
        if max(map(abs, reached), default=0.0) > _HIGH:
            panel.set_yscale("symlog", linthresh=1.0)
            panel.set_ylim(3 * min(-0.1, *reached), 3 * max(0.1, *reached))
        if not math.isnan(default := default_value(name)):
            panel.axvline(default, color=FAINT, linewidth=0.8, linestyle=":", zorder=0)
        style.name_lines(panel)
    return figure


def _gains(alone: SweepLine, line: SweepLine) -> dict[float, Mean]:
    """NLL of the network alone minus NLL of a line, by the values that both have, paired by sequence."""
    return {
        value: difference(alone.points[value], records, quantities.NLL)
        for value, records in line.points.items()
        if value in alone.points
    }


def _draw_means(axes: Any, means: Mapping[float, Mean], line_style: LineStyle) -> list[float]:
    """Draw means over the values of a setting with their band. Returns the means."""
    finite = [(x, mean.value, mean.half) for x, mean in means.items() if math.isfinite(mean.value)]
    if not finite:
        return []
    x, y, half = np.array(finite).T
    axes.plot(x, y, **line_style.line)
    axes.fill_between(x, y - half, y + half, color=line_style.colour, alpha=0.15, linewidth=0)
    return list(y.tolist())


def _draw_line(axes: Any, line: SweepLine, line_style: LineStyle, quantity: quantities.Quantity) -> list[float]:
    """Draw means over the values of a setting with their band; references are dashed, without a band. Returns the
    means."""
    means = {value: mean_of(records, quantity) for value, records in line.points.items()}
    if len(means) > 1 and line.method.fusion != ALONE:
        return _draw_means(axes, means, line_style)
    finite = {x: mean.value for x, mean in means.items() if math.isfinite(mean.value)}
    dashed = {**_DASHED, "color": line_style.colour, "label": line_style.name}
    if len(means) == 1 and finite:
        axes.axhline(*finite.values(), **dashed)
    elif finite:
        axes.plot(*zip(*finite.items(), strict=True), **dashed)
    return list(finite.values())


def _scale(axes: Any, values: Sequence[float]) -> None:
    """Scale the x axis: logarithmic if values span a factor of 20 or more, linear around 0 if 0 is a value; few values
    all get a tick."""
    positive = [value for value in values if value > 0]
    if positive and max(positive) >= 20 * min(positive):
        about_zero = {} if values[0] > 0 else {"linthresh": min(positive), "linscale": 0.5}
        axes.set_xscale("symlog" if about_zero else "log", **about_zero)
    if len(values) <= 9:
        axes.set_xticks(values, [f"{value:g}" for value in values])
        axes.minorticks_off()

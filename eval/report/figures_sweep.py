"""Ablations: figures over the values of a setting, and what each setting changes, sequence by sequence."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ufmstar_torch.eval.plots import FAINT, INK
from ufmstar_torch.eval.report.aggregate import Mean, difference, mean_over, value_of
from ufmstar_torch.eval.report.figure_style import (
    ALONE_STYLE,
    LABEL,
    TICK,
    counted,
    finish,
    label_ends,
    new_figure,
    short_name,
    style_of,
)
from ufmstar_torch.eval.report.load import Results
from ufmstar_torch.eval.report.names import (
    DIFFERENCES,
    ECE_DELTA,
    ECE_Q,
    NLL,
    SETTINGS,
    Quantity,
    setting_label,
    setting_name,
)
from ufmstar_torch.eval.suite.method import ALONE, BASES, Method
from ufmstar_torch.eval.suite.row import Row
from ufmstar_torch.eval.suite.setting import DEFAULT
from ufmstar_torch.eval.suite.suite import default_of

SHOWN = (NLL, ECE_DELTA, ECE_Q)


@dataclass(frozen=True)
class Point:
    """A value of a setting, and the rows that have it (several where noise was drawn with several seeds)."""

    value: float
    rows: tuple[Row, ...]


def sweeps(results: Results) -> list[tuple[str, str]]:
    """(base, setting) of every setting of which at least three numbers were tried, the default among them or not."""
    found = dict.fromkeys((row.method.base, name) for row in results.rows for name in _varied(row))
    return [
        (base, name) for base, name in found if any(len(points(results, m, name)) >= 3 for m in _methods(results, base))
    ]


def points(results: Results, method: Method, name: str) -> list[Point]:
    """The values of a setting tried with a method, nothing else being changed, in rising order."""
    groups: dict[float, list[Row]] = {}
    for row in results.rows:
        if row.method != method or not set(_varied(row)) <= {name}:
            continue
        value = row.setting.to_dict().get(name, _default(name))
        if isinstance(value, int | float) and not isinstance(value, bool):
            groups.setdefault(float(value), []).append(row)
    return [Point(value, tuple(groups[value])) for value in sorted(groups)]


def level(results: Results, point: Point, quantity: Quantity) -> Mean:
    """Mean over sequences at a point; seeds of one sequence are averaged first."""
    return mean_over(list(_by_sequence(results, point, quantity).values()))


def change(results: Results, point: Point, reference: Row, quantity: Quantity) -> Mean:
    """Mean over sequences of the difference to a reference row."""
    theirs = _by_sequence(results, Point(0.0, (reference,)), quantity)
    mine = _by_sequence(results, point, quantity)
    return mean_over([value - theirs.get(where, math.nan) for where, value in mine.items()])


def draw_sweep(results: Results, base: str, name: str) -> Any:
    """Above, the figures over the values with their confidence intervals; below, the change from the default."""
    methods = [m for m in _methods(results, base) if m.fusion != ALONE and len(points(results, m, name)) > 1]
    paired = any(Row(method) in results.rows for method in methods)
    word, unit = SETTINGS.get(name, (setting_name(name), ""))
    title = f"{word[:1].upper()}{word[1:]}: {BASES[base][0]}, {counted(len(results.sequences()))}"
    figure = new_figure(4.0 * len(SHOWN), 6.0 if paired else 3.4, title)
    axes = figure.subplots(1 + paired, len(SHOWN), squeeze=False, sharex=True)
    for column, quantity in enumerate(SHOWN):
        _draw_levels(axes[0][column], results, base, name, methods, quantity)
        if paired:
            _draw_changes(axes[1][column], results, name, methods, quantity)
        axes[-1][column].set_xlabel(f"{word} [{unit}]" if unit else word, size=LABEL, color=INK)
    return figure


def _draw_levels(
    axes: Any, results: Results, base: str, name: str, methods: Sequence[Method], quantity: Quantity
) -> None:
    ends = []
    alone = points(results, Method(base), name)
    means = [level(results, point, quantity) for point in alone]
    if any(not math.isnan(mean.value) for mean in means):
        dashed = {"color": ALONE_STYLE.colour, "linestyle": "--", "linewidth": 1.4, "label": "alone"}
        if len(alone) == 1:
            axes.axhline(means[0].value, **dashed)
        else:
            axes.plot([p.value for p in alone], [m.value for m in means], **dashed)
        ends.append((means[-1].value, "alone", ALONE_STYLE.colour))
    for method in methods:
        found = points(results, method, name)
        ends += _line(axes, found, [level(results, point, quantity) for point in found], method)
    finish(axes, title=f"{quantity.heading}, mean over sequences")
    _scale(axes, [p.value for method in methods for p in points(results, method, name)])
    _mark_default(axes, name)
    label_ends(axes, ends)


def _draw_changes(axes: Any, results: Results, name: str, methods: Sequence[Method], quantity: Quantity) -> None:
    """Against the base alone on the same images where these change with the value, else against the default."""
    ends = []
    axes.axhline(0, color=FAINT, linewidth=0.8)
    for method in methods:
        found = points(results, method, name)
        alone = {point.value: point.rows[0] for point in points(results, Method(method.base), name)}
        references = alone if len(alone) > 1 else dict.fromkeys((p.value for p in found), Row(method))
        pairs = [(point, references[point.value]) for point in found if point.value in references]
        means = [change(results, point, reference, quantity) for point, reference in pairs]
        ends += _line(axes, [point for point, _ in pairs], means, method)
    other = "alone" if len(alone) > 1 else "the default"
    finish(axes, title=f"difference to {other} in {quantity.name}, in pairs")
    _mark_default(axes, name)
    label_ends(axes, ends)


def _line(axes: Any, found: Sequence[Point], means: Sequence[Mean], method: Method) -> list[tuple[float, str, str]]:
    """A line with its band; what to write at its end."""
    kept = [(point.value, mean) for point, mean in zip(found, means, strict=True) if not math.isnan(mean.value)]
    if not kept:
        return []
    x = np.array([value for value, _ in kept])
    y, half = (np.array([getattr(mean, what) for _, mean in kept]) for what in ("value", "half"))
    style = style_of(method)
    axes.plot(x, y, label=method.name, **style.line)
    axes.fill_between(x, y - half, y + half, color=style.colour, alpha=0.15, linewidth=0)
    return [(float(y[-1]), short_name(method), style.colour)]


def _scale(axes: Any, values: Sequence[float]) -> None:
    """Logarithmic where values span more than a factor of 20, with a linear piece about 0 where 0 is among them."""
    positive = [value for value in values if value > 0]
    if positive and max(positive) > 20 * min(positive):
        if min(values) > 0:
            axes.set_xscale("log")
        else:
            axes.set_xscale("symlog", linthresh=min(positive), linscale=0.5)
    ticks = sorted(set(values))
    if len(ticks) <= 9:
        axes.set_xticks(ticks, [f"{value:g}" for value in ticks])
        axes.minorticks_off()


def _mark_default(axes: Any, name: str) -> None:
    axes.axvline(float(_default(name)), color=FAINT, linewidth=0.8, linestyle=":", zorder=0)


def draw_changes(results: Results, base: str) -> Any | None:
    """What each setting changes, as intervals about the paired difference; None where there is no ablation."""
    lines = list(_variants(results, base))
    if not lines:
        return None
    shown = [q for q in DIFFERENCES if q.key not in ("ause_rmse",)]
    title = f"What each setting changes: {BASES[base][0]}, in pairs on {counted(len(results.sequences()))}"
    figure = new_figure(2.8 + 2.3 * len(shown), 1.3 + 0.24 * len(lines), title)
    axes = figure.subplots(1, len(shown), squeeze=False, sharey=True)[0]
    for place, quantity in zip(axes, shown, strict=True):
        place.axvline(0, color=FAINT, linewidth=0.8)
        for y, (row, reference) in enumerate(lines):
            mean = difference(results, row, reference, quantity)
            if math.isnan(mean.value):
                continue
            half = 0.0 if math.isnan(mean.half) else mean.half
            style = style_of(row.method)
            sure = mean.beyond
            place.errorbar(
                mean.value, y, xerr=half, color=style.colour, marker=style.marker, markersize=4.5, linewidth=1.4,
                markerfacecolor=style.colour if sure else "white", capsize=0,
            )  # fmt: skip
        finish(place, title=f"Δ {quantity.heading}", x="less the default")
    axes[0].set_ylim(len(lines) - 0.5, -0.5)
    axes[0].set_yticks(range(len(lines)), _variant_names([row for row, _ in lines]), size=TICK)
    figure.supxlabel("filled: the 95 % interval leaves out 0", size=TICK, color=FAINT, x=0.99, ha="right")
    return figure


def _variants(results: Results, base: str) -> Iterator[tuple[Row, Row]]:
    """Rows of an ablation with the default of the same method."""
    for row in results.rows:
        if row.method.base == base and row.method.fusion != ALONE and row.setting != DEFAULT:
            default = Row(row.method)
            if default in results.rows:
                yield row, default


def _variant_names(rows: Sequence[Row]) -> list[str]:
    """Their settings, with the method where there are several."""
    one = len({row.method for row in rows}) == 1
    return [("" if one else f"{short_name(row.method)}, ") + setting_label(row.setting.to_dict()) for row in rows]


def _methods(results: Results, base: str) -> list[Method]:
    return list(dict.fromkeys(row.method for row in results.rows if row.method.base == base))


def _varied(row: Row) -> list[str]:
    """What a row's setting changes, the noise's seed aside."""
    return [name for name in row.setting.to_dict() if name != "seed"]


def _default(name: str) -> Any:
    try:
        return default_of(name)
    except ValueError:  # a setting of another version: without a default, its rows stand alone
        return math.nan


def _by_sequence(results: Results, point: Point, quantity: Quantity) -> Mapping[tuple[str, str], float]:
    """The figure of each sequence, the mean over the point's rows (the seeds of a noise)."""
    found: dict[tuple[str, str], list[float]] = {}
    for row in point.rows:
        for record in results.of(row):
            value = quantity.factor * value_of(record, quantity.key)
            found.setdefault((record.dataset, record.sequence), []).append(value)
    return {where: math.fsum(values) / len(values) for where, values in found.items()}

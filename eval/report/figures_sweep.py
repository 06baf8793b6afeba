"""Ablations: figures over the values of a setting, and what each setting changes, sequence by sequence."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from itertools import cycle
from typing import Any, NamedTuple

import numpy as np

from ufmstar_torch.eval.methods.method import ALONE, BASES, Method
from ufmstar_torch.eval.methods.row import Row
from ufmstar_torch.eval.methods.setting import TRACKED, TRUTH
from ufmstar_torch.eval.report.colours import FAINT, INK, plain
from ufmstar_torch.eval.report.data import Results
from ufmstar_torch.eval.report.means import Mean, difference, mean_of
from ufmstar_torch.eval.report.names import (
    DIFFERENCES,
    ECE_DELTA,
    ECE_Q,
    NLL,
    SETTINGS,
    SPEARMAN,
    count,
    setting_label,
    setting_name,
)
from ufmstar_torch.eval.report.style import (
    ALONE_STYLE,
    LABEL,
    TICK,
    Style,
    finish,
    label_ends,
    new_figure,
    short_name,
    stretch,
    style_of,
)
from ufmstar_torch.eval.report.sweeps import Point, Rest, SweepLine, default_value, sweep_lines

SHOWN = (NLL, ECE_DELTA, ECE_Q)
# Lines of the same method by what is fixed; they differ from all of ``style_of``'s.
_FIXED: dict[Rest, Style] = {
    (("anchors", TRACKED),): Style("#882255", "d"),
    (("anchors", TRUTH),): Style("#222222", "*"),
}
_OTHERS = (Style("#117733", "h"), Style("#88CCEE", "p"), Style("#999933", "<"), Style("#AA4499", ">"))
# Beyond this an axis of NLLs is logarithmic: pixels of nearly no variance take their mean to any height.
_HIGH = 50.0

# A line with, for each of its points, the point that it is compared with.
_Pairs = list[tuple[SweepLine, list[tuple[Point, Point]]]]


class _Curve(NamedTuple):
    """Means over the values of a setting; ``end`` is the name at the right."""

    x: Sequence[float]
    means: Sequence[Mean]
    label: str
    end: str
    style: Style
    dashed: bool = False


def draw_sweep(results: Results, base: str, name: str) -> Any:
    """Above, the figures over the values with their confidence intervals; below, the change from the default, or where
    lines differ in what else is fixed, from the method without that."""
    lines = [line for line in sweep_lines(results, base, name) if len(line.points) > 1 or not line.rest]
    alone = next((line for line in lines if line.method == Method(base)), None)
    drawn = [line for line in lines if line.method.fusion != ALONE]
    others = cycle(_OTHERS)
    styles = {
        (line.method, line.rest): style_of(line.method) if not line.rest else _FIXED.get(line.rest) or next(others)
        for line in drawn
    }
    to, below = _compared(drawn, alone, name)
    anchored = any("anchors" in dict(line.rest) for line in drawn)
    shown = (*SHOWN, SPEARMAN) if anchored else SHOWN
    word, unit = SETTINGS.get(name, (setting_name(name), ""))
    title = f"{word[:1].upper()}{word[1:]}: {BASES[base][0]}, {count(len(results.sequences()), 'sequence')}"
    figure = new_figure(4.0 * len(shown), 6.0 if below else 3.4, title)
    axes = figure.subplots(1 + bool(below), len(shown), squeeze=False, sharex=True)

    def curve(line: SweepLine, points: Sequence[Point], means: Sequence[Mean]) -> _Curve:
        x, dashed = [point.value for point in points], line is alone or len(line.points) == 1
        if line is alone:
            return _Curve(x, means, short_name(line.method), short_name(line.method), ALONE_STYLE, dashed)
        label = " ".join(filter(None, (line.method.name, line.words)))
        return _Curve(x, means, label, line.words or short_name(line.method), styles[line.method, line.rest], dashed)

    for column, quantity in enumerate(shown):
        panel = axes[0][column]
        levels = [
            curve(line, line.points, [mean_of(point.records, quantity) for point in line.points])
            for line in [*filter(None, [alone]), *drawn]
        ]
        reached, ends = _draw(panel, levels)
        finish(panel, title=f"{quantity.heading}, mean over sequences")
        _scale(panel, [point.value for line in drawn if len(line.points) > 1 for point in line.points])
        _tame(panel, name, reached, ends)
        if below:
            panel = axes[1][column]
            changes = [
                curve(line, [one for one, _ in pairs], [difference(a.records, b.records, quantity) for a, b in pairs])
                for line, pairs in below
            ]
            panel.axhline(0, color=FAINT, linewidth=0.8)
            reached, ends = _draw(panel, changes)
            finish(panel, title=f"difference to {to} in {quantity.name}, in pairs")
            _tame(panel, name, reached, ends)
        panel.set_xlabel(plain(f"{word} [{unit}]" if unit else word), size=LABEL, color=INK)
    return figure


def _compared(drawn: Sequence[SweepLine], alone: SweepLine | None, name: str) -> tuple[str, _Pairs]:
    """What the differences are to, in words, and the pairs of points.

    To the base alone on the same images where these change with the value; else of lines with something fixed to those
    without it, at the same value where that matters; else to the default.
    """
    plain = {line.method: line for line in drawn if not line.rest}
    swept = [line for line in drawn if len(line.points) > 1]
    reference: Callable[[SweepLine, float], Point | None]
    if alone is not None and len(alone.points) > 1:
        to, reference = "alone", lambda line, value: alone.at(value)
    elif fixed := [line for line in swept if line.rest and line.method in plain]:
        methods, swept = {short_name(line.method) for line in fixed}, fixed
        words = methods.pop() if len(methods) == 1 else "the method as it is"
        to, reference = words, lambda line, value: plain[line.method].at(value)
    else:
        to, reference = "the default", lambda line, value: line.at(default_value(name))
    pairs = [(line, [(p, other) for p in line.points if (other := reference(line, p.value))]) for line in swept]
    return to, [(line, points) for line, points in pairs if points]


def _draw(axes: Any, curves: Sequence[_Curve]) -> tuple[list[float], list[tuple[float, str, str]]]:
    """Lines with their bands, dashed and level those for reference; the values reached and what stands at the ends."""
    reached: list[float] = []
    ends = []
    for curve in curves:
        kept = [(x, mean) for x, mean in zip(curve.x, curve.means, strict=True) if not math.isnan(mean.value)]
        if not kept:
            continue
        x, y, half = np.array([(x, mean.value, mean.half) for x, mean in kept]).T
        look: dict[str, Any] = {"color": curve.style.colour, "linestyle": "--", "linewidth": 1.4, "label": curve.label}
        if not curve.dashed:
            axes.plot(x, y, label=curve.label, **curve.style.line)
            axes.fill_between(x, y - half, y + half, color=curve.style.colour, alpha=0.15, linewidth=0)
        elif len(curve.x) == 1:
            axes.axhline(y[0], **look)
        else:
            axes.plot(x, y, **look)
        reached += [value for value in y.tolist() if math.isfinite(value)]
        ends.append((float(y[-1]), curve.end, curve.style.colour))
    return reached, ends


def _tame(axes: Any, name: str, reached: Sequence[float], ends: Sequence[tuple[float, str, str]]) -> None:
    """Mark the default, and name the lines.

    Logarithmic beyond 1 where values are so high that the others would lie on one line, and cut to the values:
    intervals of such means reach as far to the other side of 0.
    """
    if max(map(abs, reached), default=0.0) > _HIGH:
        axes.set_yscale("symlog", linthresh=1.0)
        axes.set_ylim(3 * min(-0.1, *reached), 3 * max(0.1, *reached))
    value = default_value(name)
    if not math.isnan(value):
        axes.axvline(value, color=FAINT, linewidth=0.8, linestyle=":", zorder=0)
    label_ends(axes, ends)


def _scale(axes: Any, values: Sequence[float]) -> None:
    """Logarithmic where values span a factor of 20 or more, with a tick for every value of a few."""
    stretch(axes, values, 20, linthresh=1.0, linscale=0.5)
    ticks = sorted(set(values))
    if len(ticks) <= 9:
        axes.set_xticks(ticks, [f"{value:g}" for value in ticks])
        axes.minorticks_off()


def draw_changes(results: Results, base: str) -> Any | None:
    """What each setting changes, as intervals about the paired difference; None where there is no ablation."""
    lines = list(_variants(results, base))
    if not lines:
        return None
    shown = [q for q in DIFFERENCES if q.key != "ause_rmse"]
    title = f"What each setting changes: {BASES[base][0]}, in pairs on {count(len(results.sequences()), 'sequence')}"
    figure = new_figure(2.8 + 2.3 * len(shown), 1.3 + 0.24 * len(lines), title)
    axes = figure.subplots(1, len(shown), squeeze=False, sharey=True)[0]
    for place, quantity in zip(axes, shown, strict=True):
        place.axvline(0, color=FAINT, linewidth=0.8)
        for y, (row, reference) in enumerate(lines):
            mean = difference(results.of(row), results.of(reference), quantity)
            if not math.isnan(mean.value):
                style = style_of(row.method)
                place.errorbar(
                    mean.value, y, xerr=np.nan_to_num(mean.half), color=style.colour, marker=style.marker,
                    markersize=4.5, linewidth=1.4, markerfacecolor=style.colour if mean.beyond else "white", capsize=0,
                )  # fmt: skip
        finish(place, title=f"Δ {quantity.heading}", x="less the default")
    axes[0].set_ylim(len(lines) - 0.5, -0.5)
    one = len({row.method for row, _ in lines}) == 1  # the method is named where there are several
    names = [("" if one else f"{short_name(r.method)}, ") + setting_label(r.setting.to_dict()) for r, _ in lines]
    axes[0].set_yticks(range(len(lines)), map(plain, names), size=TICK)
    figure.supxlabel("filled: the 95 % interval leaves out 0", size=TICK, color=FAINT, x=0.99, ha="right")
    return figure


def _variants(results: Results, base: str) -> Iterator[tuple[Row, Row]]:
    """Rows of an ablation with the default of the same method."""
    for row in results.rows:
        varied = row.method.base == base and row.method.fusion != ALONE and not row.setting.plain
        if varied and row.base_line in results.rows:
            yield row, row.base_line

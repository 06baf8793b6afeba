"""Ablations: figures over the values of a setting, and what each setting changes, sequence by sequence."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import cycle
from typing import Any

import numpy as np

from ufmstar_torch.eval.methods.method import ALONE, BASES, Method
from ufmstar_torch.eval.methods.row import Row
from ufmstar_torch.eval.methods.setting import TRACKED, TRUTH
from ufmstar_torch.eval.report.colours import FAINT, INK, plain
from ufmstar_torch.eval.report.data import Results
from ufmstar_torch.eval.report.means import Mean, difference
from ufmstar_torch.eval.report.names import (
    DIFFERENCES,
    ECE_DELTA,
    ECE_Q,
    NLL,
    SETTINGS,
    SPEARMAN,
    Quantity,
    setting_label,
    setting_name,
)
from ufmstar_torch.eval.report.style import (
    ALONE_STYLE,
    LABEL,
    TICK,
    Style,
    counted,
    finish,
    label_ends,
    new_figure,
    short_name,
    style_of,
)
from ufmstar_torch.eval.report.sweeps import Point, Rest, SweepLine, change, default_value, level, sweep_lines

SHOWN = (NLL, ECE_DELTA, ECE_Q)
# Lines of the same method by what is fixed; they differ from all of ``style_of``'s.
_TRACKED, _TRUTH = Style("#882255", "d"), Style("#222222", "*")
_OTHERS = (Style("#117733", "h"), Style("#88CCEE", "p"), Style("#999933", "<"), Style("#AA4499", ">"))
# Beyond this an axis of NLLs is logarithmic: pixels of nearly no variance take their mean to any height.
_HIGH = 50.0


def draw_sweep(results: Results, base: str, name: str) -> Any:
    """Above, the figures over the values with their confidence intervals; below, the change from the default, or where
    lines differ in what else is fixed, from the method without that."""
    lines = [line for line in sweep_lines(results, base, name) if len(line.points) > 1 or not line.rest]
    alone = next((line for line in lines if line.method == Method(base)), None)
    drawn = [line for line in lines if line.method.fusion != ALONE]
    styles = dict(zip(((line.method, line.rest) for line in drawn), _styles(drawn), strict=True))
    below = _Below.of(drawn, alone, name)
    anchored = any("anchors" in dict(line.rest) for line in drawn)
    shown = (*SHOWN, SPEARMAN) if anchored else SHOWN
    word, unit = SETTINGS.get(name, (setting_name(name), ""))
    title = f"{word[:1].upper()}{word[1:]}: {BASES[base][0]}, {counted(len(results.sequences()))}"
    figure = new_figure(4.0 * len(shown), 6.0 if below.pairs else 3.4, title)
    axes = figure.subplots(1 + bool(below.pairs), len(shown), squeeze=False, sharex=True)
    for column, quantity in enumerate(shown):
        _draw_levels(axes[0][column], results, drawn, alone, styles, name, quantity)
        if below.pairs:
            _draw_changes(axes[1][column], results, below, styles, name, quantity)
        axes[-1][column].set_xlabel(plain(f"{word} [{unit}]" if unit else word), size=LABEL, color=INK)
    return figure


@dataclass(frozen=True)
class _Below:
    """Which differences are drawn.

    Attributes:
        to: what they are to, in words.
        pairs: lines with the points that theirs are compared with.
    """

    to: str
    pairs: tuple[tuple[SweepLine, tuple[tuple[Point, Point], ...]], ...]

    @classmethod
    def of(cls, drawn: Sequence[SweepLine], alone: SweepLine | None, name: str) -> _Below:
        """To the base alone on the same images where these change with the value; else of lines with something fixed
        to those without it, at the same value where that matters; else to the default."""
        plain = {line.method: line for line in drawn if not line.rest}
        swept = [line for line in drawn if len(line.points) > 1]
        if alone is not None and len(alone.points) > 1:
            return cls("alone", _paired(swept, lambda line, value: alone.at(value)))
        fixed = [line for line in swept if line.rest and line.method in plain]
        if fixed:
            methods = {short_name(line.method) for line in fixed}
            to = methods.pop() if len(methods) == 1 else "the method as it is"
            return cls(to, _paired(fixed, lambda line, value: plain[line.method].at(value)))
        default = default_value(name)
        return cls("the default", _paired(swept, lambda line, value: line.at(default)))


def _paired(
    lines: Iterable[SweepLine], reference: Callable[[SweepLine, float], Point | None]
) -> tuple[tuple[SweepLine, tuple[tuple[Point, Point], ...]], ...]:
    paired = []
    for line in lines:
        pairs = ((point, reference(line, point.value)) for point in line.points)
        kept = tuple((point, other) for point, other in pairs if other is not None)
        paired += [(line, kept)] if kept else []
    return tuple(paired)


def _draw_levels(
    axes: Any,
    results: Results,
    drawn: Sequence[SweepLine],
    alone: SweepLine | None,
    styles: Mapping[tuple[Method, Rest], Style],
    name: str,
    quantity: Quantity,
) -> None:
    ends, reached = [], []
    for line in [*filter(None, [alone]), *drawn]:
        means = [level(results, point, quantity) for point in line.points]
        reached += [mean.value for mean in means if math.isfinite(mean.value)]
        label = short_name(line.method) if line is alone else " ".join(filter(None, (line.method.name, line.words)))
        style = ALONE_STYLE if line is alone else styles[line.method, line.rest]
        if line is alone or len(line.points) == 1:
            ends += _dashed(axes, line, means, label, style)
        else:
            ends += _line(axes, line.points, means, label, style, _end(line))
    finish(axes, title=f"{quantity.heading}, mean over sequences")
    _scale(axes, [point.value for line in drawn if len(line.points) > 1 for point in line.points])
    _tame(axes, reached)
    _mark_default(axes, name)
    label_ends(axes, ends)


def _draw_changes(
    axes: Any,
    results: Results,
    below: _Below,
    styles: Mapping[tuple[Method, Rest], Style],
    name: str,
    quantity: Quantity,
) -> None:
    ends, reached = [], []
    axes.axhline(0, color=FAINT, linewidth=0.8)
    for line, pairs in below.pairs:
        means = [change(results, point, reference, quantity) for point, reference in pairs]
        reached += [mean.value for mean in means if math.isfinite(mean.value)]
        label = " ".join(filter(None, (line.method.name, line.words)))
        style = styles[line.method, line.rest]
        ends += _line(axes, [point for point, _ in pairs], means, label, style, _end(line))
    finish(axes, title=f"difference to {below.to} in {quantity.name}, in pairs")
    _tame(axes, reached)
    _mark_default(axes, name)
    label_ends(axes, ends)


def _dashed(
    axes: Any, line: SweepLine, means: Sequence[Mean], label: str, style: Style
) -> list[tuple[float, str, str]]:
    """A line for reference, level where it has one point; what to write at its end."""
    if all(math.isnan(mean.value) for mean in means):
        return []
    look: dict[str, Any] = {"color": style.colour, "linestyle": "--", "linewidth": 1.4, "label": label}
    if len(means) == 1:
        axes.axhline(means[0].value, **look)
    else:
        axes.plot([point.value for point in line.points], [mean.value for mean in means], **look)
    return [(means[-1].value, _end(line), style.colour)]


def _line(
    axes: Any, points: Sequence[Point], means: Sequence[Mean], label: str, style: Style, end: str
) -> list[tuple[float, str, str]]:
    """A line with its band; what to write at its end."""
    kept = [(point.value, mean) for point, mean in zip(points, means, strict=True) if not math.isnan(mean.value)]
    if not kept:
        return []
    x = np.array([value for value, _ in kept])
    y, half = (np.array([getattr(mean, what) for _, mean in kept]) for what in ("value", "half"))
    axes.plot(x, y, label=label, **style.line)
    axes.fill_between(x, y - half, y + half, color=style.colour, alpha=0.15, linewidth=0)
    return [(float(y[-1]), end, style.colour)]


def _end(line: SweepLine) -> str:
    """What stands at a line's end: "UfM*", "anchored", "UfM-100K, overlap threshold η 0.3"."""
    return line.words or short_name(line.method)


def _styles(lines: Iterable[SweepLine]) -> Iterator[Style]:
    """The method's own look, or one that states what is fixed."""
    others = cycle(_OTHERS)
    for line in lines:
        known = {(): style_of(line.method), (("anchors", TRACKED),): _TRACKED, (("anchors", TRUTH),): _TRUTH}
        yield known[line.rest] if line.rest in known else next(others)


def _tame(axes: Any, reached: Sequence[float]) -> None:
    """Logarithmic beyond 1 where values are so high that the others would lie on one line, and cut to the values:
    intervals of such means reach as far to the other side of 0."""
    if max(map(abs, reached), default=0.0) > _HIGH:
        axes.set_yscale("symlog", linthresh=1.0)
        axes.set_ylim(3 * min(-0.1, *reached), 3 * max(0.1, *reached))


def _scale(axes: Any, values: Sequence[float]) -> None:
    """Logarithmic where values span a factor of 20 or more, with a linear piece about 0 where 0 is among them."""
    positive = [value for value in values if value > 0]
    if positive and max(positive) >= 20 * min(positive):
        if min(values) > 0:
            axes.set_xscale("log")
        else:
            axes.set_xscale("symlog", linthresh=min(positive), linscale=0.5)
    ticks = sorted(set(values))
    if len(ticks) <= 9:
        axes.set_xticks(ticks, [f"{value:g}" for value in ticks])
        axes.minorticks_off()


def _mark_default(axes: Any, name: str) -> None:
    value = default_value(name)
    if not math.isnan(value):
        axes.axvline(value, color=FAINT, linewidth=0.8, linestyle=":", zorder=0)


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
    axes[0].set_yticks(
        range(len(lines)), [plain(name) for name in _variant_names([row for row, _ in lines])], size=TICK
    )
    figure.supxlabel("filled: the 95 % interval leaves out 0", size=TICK, color=FAINT, x=0.99, ha="right")
    return figure


def _variants(results: Results, base: str) -> Iterator[tuple[Row, Row]]:
    """Rows of an ablation with the default of the same method."""
    for row in results.rows:
        varied = row.method.base == base and row.method.fusion != ALONE and not row.setting.plain
        if varied and row.base_line in results.rows:
            yield row, row.base_line


def _variant_names(rows: Sequence[Row]) -> list[str]:
    """Their settings, with the method where there are several."""
    one = len({row.method for row in rows}) == 1
    return [("" if one else f"{short_name(row.method)}, ") + setting_label(row.setting.to_dict()) for row in rows]

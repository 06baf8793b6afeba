"""The paper's figures of NLL by size of the error, where a reference method is confident, and of predictive entropy."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ufmstar_torch.eval.engine.judge import BY_ERROR
from ufmstar_torch.eval.methods.method import ALONE, BASES, UFM_STAR, Method
from ufmstar_torch.eval.methods.row import Row
from ufmstar_torch.eval.report.colours import FAINT, INK
from ufmstar_torch.eval.report.data import Merged, Results
from ufmstar_torch.eval.report.style import (
    LABEL,
    TICK,
    finish,
    hidden_panels,
    label_ends,
    new_figure,
    short_name,
    style_of,
)

# Entropy [nats] of a Gaussian with a standard deviation of 1 m.
ONE_METRE = 0.5 * math.log(2 * math.pi * math.e)
_DECADES = (0.001, 0.01, 0.1, 1.0, 10.0, 100.0)


def draw_error(results: Results, dataset: str) -> Any | None:
    """The mean NLL of each tenth of the pixels, from a row's smallest errors to its largest: a line of panels per
    network, a panel per reference; None where no row was judged so."""
    panels = {base: of_base for base in results.bases if (of_base := _error_curves(results, dataset, base))}
    if not panels:
        return None
    columns = max(map(len, panels.values()))
    figure = new_figure(0.6 + 4.3 * columns, 0.5 + 3.1 * len(panels), f"NLL by size of the error on {dataset}")
    for line, (base, by_reference) in zip(hidden_panels(figure, len(panels), columns), panels.items(), strict=True):
        for axes, (reference, curves) in zip(line, by_reference.items(), strict=False):
            axes.set_visible(True)
            for row, values in sorted(curves.items(), key=lambda item: item[0].method.fusion == UFM_STAR):
                x = (np.arange(len(values)) + 0.5) * 100 / len(values)
                axes.plot(x, np.array(values, float), label=row.method.name, **style_of(row.method).line)
            axes.set(xlim=(0, 100), xticks=[0, 25, 50, 75, 100])
            method = Method.parse(reference)
            title = f"{BASES[base][0]}: where {'it' if method.fusion == ALONE else short_name(method)} is confident"
            finish(axes, title=title, x="percentile of the row's error", y="mean NLL [nats]")
            # At the last group that had a pixel.
            ends = {row: next(value for value in reversed(values) if value == value) for row, values in curves.items()}
            label_ends(axes, [(y, short_name(row.method), style_of(row.method).colour) for row, y in ends.items()])
    return figure


def _error_curves(results: Results, dataset: str, base: str) -> dict[str, dict[Row, Sequence[float]]]:
    """Curves by row, by reference: the base alone first, then UfM."""
    curves: dict[str, dict[Row, Sequence[float]]] = {}
    for row in results.default_rows(base):
        merged = results.merged.get((dataset, row))
        for name, values in (merged.curves if merged else {}).items():
            reference = name.removeprefix(f"{BY_ERROR}:")
            if reference != name and np.isfinite(values).any() and Method.parse(reference).base == base:
                curves.setdefault(reference, {})[row] = values
    return dict(sorted(curves.items(), key=lambda item: (item[0].startswith("UfM"), item[0])))


# ---- the paper's figure of predictive entropy ----


def draw_entropy(results: Results, base: str) -> Any | None:
    """Data sets below each other on one axis; None where no row of the base has a variance."""
    panels: dict[str, dict[Row, Merged]] = {}
    for dataset in results.datasets:
        for row in results.default_rows(base):
            merged = results.merged.get((dataset, row))
            if merged is not None and sum(merged.curves.get("entropy_counts", ())) > 0:
                panels.setdefault(dataset, {})[row] = merged
    if not panels:
        return None
    figure = new_figure(7.6, 1.0 + 2.1 * len(panels), f"Predictive entropy by data set, {BASES[base][0]}")
    axes = figure.subplots(len(panels), 1, squeeze=False, sharex=True)[:, 0]
    low, high = entropy_range([merged for rows in panels.values() for merged in rows.values()])
    for panel, (dataset, rows) in zip(axes, panels.items(), strict=True):
        panel.set_xlim(low, high)
        _draw_histograms(panel, rows)
        finish(panel, title=dataset, y="share of pixels per nat")
    axes[-1].set_xlabel("entropy ½ ln(2πeV) [nats]", size=LABEL, color=INK)
    _sigma_axis(axes[0], low, high)
    return figure


def entropy_range(merged: Sequence[Merged]) -> tuple[float, float]:
    """Where 99.8 % of every histogram lie, and a margin of half a nat [nats]."""
    lows, highs = [], []
    for one in merged:
        counts, edges = np.array(one.curves["entropy_counts"]), np.array(one.curves["entropy_edges"])
        share = counts.cumsum() / counts.sum()
        # share[k] is what lies below edges[k]; the last one has no edge above it.
        lows.append(edges[max(int(np.searchsorted(share[:-1], 0.001, side="right")) - 1, 0)])
        highs.append(edges[min(int(np.searchsorted(share[:-1], 0.999)), len(edges) - 1)])
    low, high = float(min(lows)) - 0.5, float(max(highs)) + 0.5
    return max(low, float(edges[0])), min(high, float(edges[-1]))


def density(merged: Merged) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """[bins] share of all pixels per nat, and [bins + 1] the bins' edges [nats]."""
    counts, edges = np.array(merged.curves["entropy_counts"]), np.array(merged.curves["entropy_edges"])
    return counts[1:-1] / counts.sum() / np.diff(edges), edges


def _draw_histograms(axes: Any, rows: Mapping[Row, Merged]) -> None:
    """Histograms, and the mean of each as a dashed line with its name beside."""
    for number, (row, merged) in enumerate(rows.items()):
        colour = style_of(row.method).colour
        heights, edges = density(merged)
        axes.stairs(heights, edges, color=colour, linewidth=1.5, label=short_name(row.method))
        if row.method.fusion == UFM_STAR and not row.method.full:
            axes.stairs(heights, edges, color=colour, alpha=0.15, fill=True)
        mean, counts = merged.figures["entropy"], merged.curves["entropy_counts"]
        axes.axvline(mean, color=colour, linestyle="--", linewidth=1.1)
        # Pixels below the histogram: V = 0 above all.
        below = counts[0] / sum(counts)
        remark = "" if below < 0.005 else f"\n({100 * below:.0f} % with hardly any V)"
        words = f"{short_name(row.method)}: mean {mean:.2f}{remark}"
        axes.text(1.02, 0.95 - 0.13 * number, words, color=colour, size=TICK, va="top", transform=axes.transAxes)
    axes.set_ylim(bottom=0)


def _sigma_axis(axes: Any, low: float, high: float) -> None:
    """The same axis in metres of a standard deviation, above."""
    twin = axes.secondary_xaxis("top", functions=(lambda h: h - ONE_METRE, lambda s: s + ONE_METRE))
    decades = [sigma for sigma in _DECADES if low <= math.log(sigma) + ONE_METRE <= high]
    finer = [factor * sigma for sigma in _DECADES for factor in (1, 2, 5)]
    within = [sigma for sigma in finer if low <= math.log(sigma) + ONE_METRE <= high]
    shown = decades if len(decades) > 2 else within
    twin.set_xticks([math.log(sigma) for sigma in shown], [f"σ = {sigma:g} m" for sigma in shown])
    twin.tick_params(labelsize=TICK - 1, color=FAINT, labelcolor=INK)
    twin.spines["top"].set_visible(False)

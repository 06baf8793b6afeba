"""The paper's figure of predictive entropy: how uncertain each method is, data set by data set."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ufmstar_torch.eval.methods.method import BASES, UFM_STAR
from ufmstar_torch.eval.methods.row import Row
from ufmstar_torch.eval.methods.setting import DEFAULT
from ufmstar_torch.eval.report.figure_style import LABEL, TICK, finish, new_figure, short_name, style_of
from ufmstar_torch.eval.report.data import Results
from ufmstar_torch.eval.report.plots import FAINT, INK
from ufmstar_torch.eval.report.sums import Merged

# Entropy [nats] of a Gaussian with a standard deviation of 1 m.
ONE_METRE = 0.5 * math.log(2 * math.pi * math.e)
_DECADES = (0.001, 0.01, 0.1, 1.0, 10.0, 100.0)


def draw_entropy(results: Results, base: str) -> Any | None:
    """Data sets below each other on one axis; None where no row of the base has a variance."""
    panels = {dataset: rows for dataset in results.datasets if (rows := _rows(results, dataset, base))}
    if not panels:
        return None
    figure = new_figure(7.6, 1.0 + 2.1 * len(panels), f"Predictive entropy by data set, {BASES[base][0]}")
    axes = figure.subplots(len(panels), 1, squeeze=False, sharex=True)[:, 0]
    low, high = entropy_range([merged for rows in panels.values() for merged in rows.values()])
    for place, (dataset, rows) in zip(axes, panels.items(), strict=True):
        place.set_xlim(low, high)
        _draw(place, rows)
        finish(place, title=dataset, y="share of pixels per nat")
    axes[-1].set_xlabel("entropy ½ ln(2πeV) [nats]", size=LABEL, color=INK)
    _sigma_axis(axes[0], low, high)
    return figure


def entropy_range(found: list[Merged]) -> tuple[float, float]:
    """Where 99.8 % of every histogram lie, and a margin of half a nat [nats]."""
    lows, highs = [], []
    for merged in found:
        counts, edges = np.array(merged.curves["entropy_counts"]), np.array(merged.curves["entropy_edges"])
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


def _draw(axes: Any, rows: Mapping[Row, Merged]) -> None:
    """Histograms, and the mean of each as a dashed line with its name on top."""
    for number, (row, merged) in enumerate(rows.items()):
        colour = style_of(row.method).colour
        heights, edges = density(merged)
        axes.stairs(heights, edges, color=colour, linewidth=1.5, label=short_name(row.method))
        if row.method.fusion == UFM_STAR and not row.method.full:
            axes.stairs(heights, edges, color=colour, alpha=0.15, fill=True)
        mean = merged.figures["entropy"]
        axes.axvline(mean, color=colour, linestyle="--", linewidth=1.1)
        told = f"{short_name(row.method)}: mean {mean:.2f}{_below(merged)}"
        axes.text(1.02, 0.95 - 0.13 * number, told, color=colour, size=TICK, va="top", transform=axes.transAxes)
    axes.set_ylim(bottom=0)


def _below(merged: Merged) -> str:
    """Words for the pixels that fall below the histogram, V = 0 above all, where there are many."""
    share = merged.curves["entropy_counts"][0] / sum(merged.curves["entropy_counts"])
    return "" if share < 0.005 else f"\n({100 * share:.0f} % with hardly any V)"


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


def _rows(results: Results, dataset: str, base: str) -> dict[Row, Merged]:
    """The default rows of a base with a histogram."""
    found = {}
    for row in results.rows:
        merged = results.merged.get((dataset, row))
        if merged is None or row.method.base != base or row.setting != DEFAULT:
            continue
        if sum(merged.curves.get("entropy_counts", ())) > 0:
            found[row] = merged
    return found

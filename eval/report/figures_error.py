"""Figures over all pixels of errors and their prediction: NLL by size of the error, gates on sigma, entropy."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ufmstar_torch.eval.engine.judge import BY_ERROR
from ufmstar_torch.eval.engine.record import Record
from ufmstar_torch.eval.methods.method import ALONE, BASES, UFM_STAR, Method
from ufmstar_torch.eval.methods.row import Row
from ufmstar_torch.eval.report import style
from ufmstar_torch.eval.report.data import Results
from ufmstar_torch.eval.report.quantities import row_labels, value_of
from ufmstar_torch.eval.report.style import LineStyle
from ufmstar_torch.eval.run.colours import FAINT, INK

Curves = Mapping[str, Sequence[float]]
# The groups of the paper's figure of entropy, by the first letters of words in the names of data sets and sequences, as
# TartanAir's environments. Every other data set is a group.
ENVIRONMENTS = {
    "indoor": ("indoor", "scannet", "7scenes", "scenes", "tum", "nyu", "tour", "office", "hospital"),
    "forest": ("forest", "seasonsforest", "gascola"),
    "driving": ("driving", "kitti"),
    "city": ("city", "soulcity", "neighborhood", "oldtown", "japanesealley"),
}
# Gates that are written at the curve.
_NAMED = (0.05, 0.1, 0.2)


# ---- NLL by size of the error ----


def draw_error(results: Results, dataset: str) -> Any | None:
    """The mean NLL of each tenth of the pixels, from a row's smallest errors to its largest: a line of panels per
    network, a panel per reference (its confident pixels of each frame); None if no row has these curves."""
    panels = {base: of_base for base in results.bases if (of_base := _error_curves(results, dataset, base))}
    if not panels:
        return None
    columns = max(map(len, panels.values()))
    figure = style.new_figure(0.6 + 4.3 * columns, 0.5 + 3.1 * len(panels), f"NLL by size of the error on {dataset}")
    axes = style.hidden_panels(figure, len(panels), columns)
    for line, (base, by_reference) in zip(axes, panels.items(), strict=True):
        for panel, (reference, curves) in zip(line, by_reference.items(), strict=False):
            panel.set_visible(True)
            for row, values in sorted(curves.items(), key=lambda item: item[0].method.fusion == UFM_STAR):
                x = (np.arange(len(values)) + 0.5) * 100 / len(values)
                panel.plot(x, np.array(values, float), **style.line_style(row.method).line)
            panel.set(xlim=(0, 100), xticks=[0, 25, 50, 75, 100])
            method = Method.parse(reference)
            judge = "it" if method.fusion == ALONE else style.line_style(method).name
            title = f"{BASES[base][0]}: where {judge} is confident in each frame"
            style.finish(panel, title=title, x="percentile of the row's error", y="mean NLL [nats]")
            style.name_lines(panel)
    return figure


def _error_curves(results: Results, dataset: str, base: str) -> dict[str, dict[Row, Sequence[float]]]:
    """Curves by row, by reference: the base alone first, then UfM."""
    curves: dict[str, dict[Row, Sequence[float]]] = {}
    for row in results.default_rows(base):
        for name, values in results.merged.get((dataset, row), {}).items():
            kind, _, reference = name.partition(":")
            if kind == BY_ERROR and np.isfinite(values).any() and Method.parse(reference).base == base:
                curves.setdefault(reference, {})[row] = values
    return dict(sorted(curves.items(), key=lambda item: (item[0].startswith("UfM"), item[0])))


# ---- what a gate on sigma / depth keeps ----


def draw_gates(results: Results, dataset: str) -> Any | None:
    """Median error and coverage of the pixels that a gate on sigma / d keeps, against their share; None without a row
    that has a variance."""
    return gates_figure(_lines(results, dataset), f"Gates on sigma / depth on {dataset}")


def _lines(results: Results, dataset: str) -> dict[str, Curves]:
    """Curves over all pixels of a data set, by the row's label: of rows with intervals, then of each method's first
    row, at most as many as there are styles."""
    labels, plain = row_labels(results.rows), results.default_rows()
    found = {row: results.merged.get((dataset, row), {}) for row in results.rows}
    rows = [row for row, curves in found.items() if "coverage_found" in curves]
    rows += [row for row in plain if row not in rows]
    lines = {labels[row]: found[row] for row in rows if np.isfinite(_values(found[row], "gate_kept")).any()}
    return dict(list(lines.items())[: len(style.BY_ORDER)])


def gates_figure(lines: Mapping[str, Curves], title: str) -> Any | None:
    """Median error, share within 25 % and coverage of a gate's pixels against their share, by the name in the legend
    (``SequenceMetrics.curves()``)."""
    if not lines:
        return None
    figure = style.new_figure(12.6, 4.6, title)
    panels = figure.subplots(1, 3)
    styled = [(LineStyle(name, *how), lines[name]) for name, how in zip(lines, style.BY_ORDER, strict=False)]
    names = {"error": "median relative error", "delta1": "share within 25 %", "coverage": "share in the 90 % interval"}
    for axes, (name, label) in zip(panels, names.items(), strict=True):
        for line_style, curves in styled:
            share, values, gates = (_values(curves, f"gate_{key}") for key in ("kept", name, "threshold"))
            shown = share > 0.001
            axes.plot(share[shown], values[shown], markevery=10, **line_style.line)
            for gate in _NAMED if name == "error" else ():
                at = int(np.abs(gates - gate).argmin())
                if shown[at]:
                    axes.annotate(f"{gate:g}", (share[at], values[at]), size=style.TICK, color=line_style.colour)
        axes.set_xlim(0, 1)
        axes.set_ylim(bottom=0, top=None if name == "error" else 1)
        style.finish(axes, title="numbers: largest sigma / depth" if name == "error" else "", x="share kept", y=label)
    panels[2].axhline(0.9, linestyle="--", linewidth=1.0, color=FAINT)
    style.legend_below(figure)
    return figure


def _values(curves: Curves, name: str) -> Any:
    return np.array(curves.get(name, ()), float)


# ---- the paper's figure of predictive entropy ----


class Histogram(NamedTuple):
    """Pixels by their entropy: ``counts`` [bins + 2], those below and above ``edges`` [bins + 1] first and last [nats],
    and the mean entropy over V > 0."""

    counts: NDArray[np.float64]
    edges: NDArray[np.float64]
    mean: float

    @property
    def density(self) -> NDArray[np.float64]:
        """[bins] share of all pixels per nat."""
        return np.asarray(self.counts[1:-1] / self.counts.sum() / np.diff(self.edges))


def entropies(results: Results, base: str) -> dict[str, dict[Row, Histogram]]:
    """The histogram of each row over the sequences of an environment, in the paper's order of environments."""
    records: dict[str, dict[Row, list[Record]]] = {}
    for row in results.default_rows(base):
        for record in results.of(row):
            if sum(record.curves.get("entropy_counts", ())) > 0:
                records.setdefault(_environment(record), {}).setdefault(row, []).append(record)
    order = [*ENVIRONMENTS, *sorted(records.keys() - ENVIRONMENTS.keys())]
    return {name: {row: _histogram(r) for row, r in records[name].items()} for name in order if name in records}


def _environment(record: Record) -> str:
    """A key of ``ENVIRONMENTS``, or the data set."""
    words = re.split("[^a-z0-9]+", f"{record.dataset}/{record.sequence}".lower())
    fitting = (name for name, begins in ENVIRONMENTS.items() if any(word.startswith(begins) for word in words))
    return next(fitting, record.dataset)


def _histogram(records: Sequence[Record]) -> Histogram:
    counts = np.array([record.curves["entropy_counts"] for record in records], np.float64)
    pixels, means = counts[:, 1:].sum(1), np.array([value_of(record, "entropy") for record in records])
    mean = float(np.nansum(pixels * means) / pixels.sum()) if pixels.any() else math.nan
    return Histogram(counts.sum(0), np.array(records[0].curves["entropy_edges"]), mean)


def draw_entropy(results: Results, base: str) -> Any | None:
    """Environments (indoor, forest, driving, city) below each other on one axis, the mean of each row as a dashed line
    with its name at the right; None if no row of the base has a variance."""
    panels = entropies(results, base)
    if not panels:
        return None
    figure = style.new_figure(7.6, 1.0 + 2.1 * len(panels), f"Predictive entropy by environment, {BASES[base][0]}")
    axes = figure.subplots(len(panels), 1, squeeze=False, sharex=True)[:, 0]
    for panel, (environment, rows) in zip(axes, panels.items(), strict=True):
        for number, (row, histogram) in enumerate(rows.items()):
            line_style, density, edges = style.line_style(row.method), histogram.density, histogram.edges
            panel.stairs(density, edges, color=line_style.colour, linewidth=1.5, label=line_style.name)
            if row.method.fusion == UFM_STAR and not row.method.full:
                panel.stairs(density, edges, color=line_style.colour, alpha=0.15, fill=True)
            panel.axvline(histogram.mean, color=line_style.colour, linestyle="--", linewidth=1.1)
            below = histogram.counts[0] / histogram.counts.sum()  # mostly V = 0
            remark = "" if below < 0.005 else f"\n({100 * below:.0f} % with hardly any V)"
            how = {"color": line_style.colour, "size": style.TICK, "va": "top", "transform": panel.transAxes}
            panel.text(1.02, 0.95 - 0.13 * number, f"{line_style.name}: mean {histogram.mean:.2f}{remark}", **how)
        panel.set_ylim(bottom=0)
        style.finish(panel, title=environment, y="share of pixels per nat")
    axes[0].set_xlim(*_entropy_range([histogram for rows in panels.values() for histogram in rows.values()]))
    axes[-1].set_xlabel("entropy ½ ln(2πeV) [nats]", size=style.LABEL, color=INK)
    return figure


def _entropy_range(histograms: Sequence[Histogram]) -> tuple[float, float]:
    """From the first to the last bin with more than 0.1 % of a row's pixels, plus half a nat on each side."""
    edges = histograms[0].edges
    shares = np.array([histogram.counts / histogram.counts.sum() for histogram in histograms])
    filled = np.flatnonzero(shares[:, 1:-1].max(0) > 0.001)
    first, last = (filled[0], filled[-1] + 1) if len(filled) else (0, -1)
    return max(edges[first] - 0.5, float(edges[0])), min(edges[last] + 0.5, float(edges[-1]))

"""Figures of curves over all pixels: calibration, sparsification, NLL by size of the error, predictive entropy."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ufmstar_torch.eval.engine.judge import BY_ERROR
from ufmstar_torch.eval.methods.method import ALONE, BASES, UFM_STAR, Method
from ufmstar_torch.eval.methods.row import Row
from ufmstar_torch.eval.report import style
from ufmstar_torch.eval.report.data import Results
from ufmstar_torch.eval.report.means import value_of
from ufmstar_torch.eval.report.names import count
from ufmstar_torch.eval.report.style import LineStyle
from ufmstar_torch.eval.run.colours import FAINT, INK
from ufmstar_torch.eval.suite.record import Record

Curves = Mapping[str, Sequence[float]]
PER_LINE, MOST_SEQUENCES = 4, 12
# Axis labels of the two calibration diagrams.
DELTA, QUANTILE = ("predicted share within 25 %", "true share"), ("predicted quantile", "share of truth below")
# Colours and markers, in order, for methods without a ``Method``.
_BY_ORDER = (("#6b6b6b", "^"), ("#E69F00", "s"), ("#0072B2", "o"), ("#009E73", "D"), ("#CC79A7", "v"), ("#D55E00", "P"))
# The groups of the paper's figure of entropy, by the first letters of words in the names of data sets and sequences, as
# TartanAir's environments. Every other data set is a group.
ENVIRONMENTS = {
    "indoor": ("indoor", "scannet", "7scenes", "scenes", "tum", "nyu", "tour", "office", "hospital"),
    "forest": ("forest", "seasonsforest", "gascola"),
    "driving": ("driving", "kitti"),
    "city": ("city", "soulcity", "neighborhood", "oldtown", "japanesealley"),
}


# ---- calibration ----


def draw_calibration(results: Results, dataset: str) -> Any | None:
    """Both curves over all pixels of a data set, one column per network; None if no row has a variance."""
    panels: dict[str, dict[Row, Curves]] = {}
    for row in (*results.default_rows(), *results.posterior_rows()):
        if _has_curves(values := results.merged.get((dataset, row), {})):
            panels.setdefault(row.method.base, {})[row] = values
    title = f"Calibration on {dataset}, {count(len(results.sequences(dataset)), 'sequence')}"
    return _draw_columns(title, [((BASES[base][0], ""), curves) for base, curves in panels.items()])


def draw_sequence_calibration(results: Results, dataset: str, base: str) -> Any | None:
    """Both curves of at most ``MOST_SEQUENCES`` sequences, evenly spaced in the order of the ECE_delta of UfM* (or of
    the last row), the smallest and the largest included; None for a single sequence."""
    by_row = {row: [r for r in results.of(row, dataset) if _has_curves(r.curves)] for row in results.default_rows(base)}
    rows = [row for row, records in by_row.items() if records]
    if len(results.sequences(dataset)) < 2:
        return None  # equal to the data set's
    ordered = sorted(by_row[_ours(rows)] if rows else [], key=lambda r: (value_of(r, "ece_delta"), r.sequence))
    chosen = np.linspace(0, len(ordered) - 1, min(len(ordered), MOST_SEQUENCES)).round().astype(int)
    panels = []
    for name in (ordered[i].sequence for i in chosen):
        shown = {row: record for row in rows for record in by_row[row] if record.sequence == name}
        titles = (f"{name}\n{_errors(shown, 'ece_delta', 'δ')}", _errors(shown, "ece_q", "q"))
        panels.append((titles, {row: record.curves for row, record in shown.items()}))
    title = f"Calibration on single sequences of {dataset}, {BASES[base][0]}\nerrors alone → UfM*, from best to worst"
    return _draw_columns(title, panels)


def _ours(rows: Sequence[Row]) -> Row:
    """UfM*, or the last row."""
    return next((row for row in rows if row.method.fusion == UFM_STAR and not row.method.full), rows[-1])


def _errors(records: Mapping[Row, Record], key: str, letter: str) -> str:
    """The calibration errors of the base alone and of UfM*, or of the first and the last row."""
    rows = list(records)
    values = (f"{value_of(records[row], key):.3f}" for row in dict.fromkeys((rows[0], _ours(rows))))
    return f"ECE_{letter} {' → '.join(values)}"


def _has_curves(curves: Mapping[str, Any]) -> bool:
    """True if at least one pixel had a variance and ground truth (else the curve is NaN, None in a record)."""
    levels = curves.get("ece_q_observed") or ()
    return len(levels) > 0 and all(value is not None and value == value for value in levels)


def _draw_columns(title: str, panels: Sequence[tuple[tuple[str, str], Mapping[Row, Curves]]]) -> Any | None:
    """Delta calibration above quantile calibration in each column, ``PER_LINE`` columns side by side. ``panels`` has
    the titles of both, and curves by row; UfM* is drawn last, on top."""
    if not panels:
        return None
    columns = min(len(panels), PER_LINE)
    lines = -(-len(panels) // columns)
    # A single column needs width for the title and the legend.
    figure = style.new_figure(max(5.0, 0.4 + 2.6 * columns), 0.7 + 5.2 * lines, title)
    axes = style.hidden_panels(figure, 2 * lines, columns)
    for n, (titles, curves) in enumerate(panels):
        rows = sorted(curves, key=lambda row: (row.method.fusion == UFM_STAR, row.setting.posterior, row.method.full))
        drawn = {style.row_style(row): curves[row] for row in rows}
        for below, words in enumerate((DELTA, QUANTILE)):
            panel = axes[2 * (n // columns) + below, n % columns]
            _draw_shares(panel, words, drawn, titles[below], named=n % columns == 0)
    style.legend_below(figure)
    return figure


def _draw_shares(
    axes: Any, words: tuple[str, str], lines: Mapping[LineStyle, Curves], title: str, *, named: bool = True
) -> None:
    """Draw confidence that the depth is within 25 % against its frequency (``DELTA``), or predicted quantiles against
    the share of truth below them (``QUANTILE``), in the unit square with its diagonal."""
    axes.set_visible(True)
    axes.plot([0, 1], [0, 1], linestyle="--", linewidth=1.0, color=FAINT, label="exactly right")
    for line_style, values in lines.items():
        x, y = (np.array(values[f"ece_q_{name}"], float) for name in ("levels", "observed"))
        if words is DELTA:
            names = ("confidence", "accuracy", "pixels")
            x, y, pixels = (np.array(values[f"ece_delta_{name}"], float) for name in names)
            filled = pixels > 0.001 * pixels.sum()  # bins with more than 0.1 % of the pixels
            x, y = x[filled], y[filled]
        axes.plot(x, y, clip_on=False, **line_style.line)
    axes.set(xlim=(0, 1), ylim=(0, 1), aspect="equal", xticks=[0, 0.5, 1], yticks=[0, 0.5, 1])
    style.finish(axes, title=title, x=words[0], y=words[1] if named else "")


def write_curves(path: Path, curves: Mapping[str, Curves], *, title: str = "") -> None:
    """Draw delta calibration, quantile calibration and sparsification (``SequenceMetrics.curves()`` by the name in the
    legend) side by side, and write the picture (PNG). Raises ValueError: there are no curves, or more than line
    styles."""
    if not 1 <= len(curves) <= len(_BY_ORDER):
        raise ValueError(f"curves must hold 1 to {len(_BY_ORDER)} methods, got {len(curves)}")
    figure = style.new_figure(12.6, 4.6, title)
    delta, quantiles, sparse = figure.subplots(1, 3)
    lines = {LineStyle(name, *line_style): curves[name] for name, line_style in zip(curves, _BY_ORDER, strict=False)}
    _draw_shares(delta, DELTA, lines, "δ calibration")
    _draw_shares(quantiles, QUANTILE, lines, "quantile calibration")
    for line_style, values in lines.items():
        x = np.arange(len(values["sparsification_rmse"])) / len(values["sparsification_rmse"])
        sparse.plot(x, values["sparsification_rmse"], markevery=10, **line_style.line)
        sparse.plot(x, values["sparsification_oracle_rmse"], linewidth=1.0, linestyle=":", color=line_style.colour)
    sparse.set_xlim(0, 1)
    sparse.set_ylim(bottom=0)
    title, x_label = "sparsification (dotted: best possible)", "share of pixels left out, largest σ first"
    style.finish(sparse, title=title, x=x_label, y="RMSE [m]")
    style.legend_below(figure)
    style.save_figure(figure, path)


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

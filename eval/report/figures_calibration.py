"""Calibration diagrams over all pixels: confidence, quantiles, intervals, outliers; for training, sparsification."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ufmstar_torch.eval.engine.record import Record
from ufmstar_torch.eval.methods.method import BASES, UFM_STAR
from ufmstar_torch.eval.methods.row import Row
from ufmstar_torch.eval.report import style
from ufmstar_torch.eval.report.data import Results
from ufmstar_torch.eval.report.quantities import count, value_of
from ufmstar_torch.eval.report.style import LineStyle
from ufmstar_torch.eval.run.colours import FAINT

Curves = Mapping[str, Sequence[float]]
PER_LINE, MOST_SEQUENCES = 4, 12


class Shares(NamedTuple):
    """A calibration diagram: the curves of stated and found shares, the labels of its axes, and the curve of the bins'
    pixels, "" = all are shown."""

    stated: str
    found: str
    x: str
    y: str
    pixels: str = ""


DELTA = Shares(
    "ece_delta_confidence", "ece_delta_accuracy", "predicted share within 25 %", "true share", "ece_delta_pixels"
)
QUANTILE = Shares("ece_q_levels", "ece_q_observed", "predicted quantile", "share of truth below")
INTERVAL = Shares("coverage_levels", "coverage_found", "stated probability of the interval", "share of truth in it")
OUTLIER = Shares(
    "outlier_stated", "outlier_found", "stated share beyond 3 σ of inliers", "true share", "outlier_pixels"
)
KINDS = DELTA, QUANTILE, INTERVAL, OUTLIER


def draw_calibration(results: Results, dataset: str) -> Any | None:
    """The curves over all pixels of a data set, one column per network; None if no row has a variance."""
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
    """Delta calibration above quantile calibration in each column, above central intervals and outliers if a row has
    some; ``PER_LINE`` columns side by side. ``panels`` has the titles of the first two, and curves by row; UfM* is
    drawn last, on top."""
    if not panels:
        return None
    columns = min(len(panels), PER_LINE)
    lines = -(-len(panels) // columns)
    every = [curves for _, by_row in panels for curves in by_row.values()]
    kinds = [kind for kind in KINDS if any(kind.found in curves for curves in every)]
    # A single column needs width for the title and the legend.
    figure = style.new_figure(max(5.0, 0.4 + 2.6 * columns), 0.7 + 2.6 * len(kinds) * lines, title)
    axes = style.hidden_panels(figure, len(kinds) * lines, columns)
    for n, (titles, curves) in enumerate(panels):
        rows = sorted(curves, key=lambda row: (row.method.fusion == UFM_STAR, row.setting.posterior, row.method.full))
        drawn = {style.row_style(row): curves[row] for row in rows}
        for below, (kind, words) in enumerate(zip(kinds, (*titles, "", ""), strict=False)):
            panel = axes[len(kinds) * (n // columns) + below, n % columns]
            draw_shares(panel, kind, drawn, words, named=n % columns == 0)
    style.legend_below(figure)
    return figure


def draw_shares(axes: Any, kind: Shares, lines: Mapping[LineStyle, Curves], title: str, *, named: bool = True) -> None:
    """Draw found against stated shares of the lines that have them, in the unit square with its diagonal."""
    axes.set_visible(True)
    axes.plot([0, 1], [0, 1], linestyle="--", linewidth=1.0, color=FAINT, label="exactly right")
    for line_style, values in lines.items():
        if kind.found in values:
            x, y = (np.array(values[name], float) for name in (kind.stated, kind.found))
            if kind.pixels:
                pixels = np.array(values[kind.pixels], float)
                filled = pixels > 0.001 * pixels.sum()  # bins with more than 0.1 % of the pixels
                x, y = x[filled], y[filled]
            axes.plot(x, y, clip_on=False, markevery=max(1, len(x) // 10), **line_style.line)
    axes.set(xlim=(0, 1), ylim=(0, 1), aspect="equal", xticks=[0, 0.5, 1], yticks=[0, 0.5, 1])
    style.finish(axes, title=title, x=kind.x, y=kind.y if named else "")


def write_curves(path: Path, curves: Mapping[str, Curves], *, title: str = "") -> None:
    """Draw delta calibration, quantile calibration and sparsification (``SequenceMetrics.curves()`` by the name in the
    legend) side by side, and write the picture (PNG). Raises ValueError: there are no curves, or more than line
    styles."""
    if not 1 <= len(curves) <= len(style.BY_ORDER):
        raise ValueError(f"curves must hold 1 to {len(style.BY_ORDER)} methods, got {len(curves)}")
    figure = style.new_figure(12.6, 4.6, title)
    delta, quantiles, sparse = figure.subplots(1, 3)
    lines = {
        LineStyle(name, *line_style): curves[name] for name, line_style in zip(curves, style.BY_ORDER, strict=False)
    }
    draw_shares(delta, DELTA, lines, "δ calibration")
    draw_shares(quantiles, QUANTILE, lines, "quantile calibration")
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

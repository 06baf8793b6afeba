"""Figures of intervals and gates: coverage stated against found, and what is left of an image under a gate on sigma."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ufmstar_torch.eval.report import style
from ufmstar_torch.eval.report.data import Results
from ufmstar_torch.eval.report.names import row_labels
from ufmstar_torch.eval.report.style import LineStyle
from ufmstar_torch.eval.run.colours import FAINT

Curves = Mapping[str, Sequence[float]]
# Colours and markers of the lines, in order. Rows of one method differ in their settings, so each has a line.
_STYLES = (("#0072B2", "o"), ("#D55E00", "s"), ("#009E73", "D"), ("#E69F00", "^"), ("#CC79A7", "v"), ("#6b6b6b", "P"))
# Gates that are written at the curve.
_NAMED = (0.05, 0.1, 0.2)


def draw_intervals(results: Results, dataset: str) -> Any | None:
    """The share of the pixels with ground truth in central intervals, against the stated level; None without rows that
    have intervals."""
    return intervals_figure(_lines(results, dataset, "coverage_found"), f"Central intervals on {dataset}")


def draw_gates(results: Results, dataset: str) -> Any | None:
    """Median error and coverage of the pixels that a gate on sigma / d keeps, against their share; None without a row
    that has a variance."""
    return gates_figure(_lines(results, dataset, "gate_kept"), f"Gates on sigma / depth on {dataset}")


def _lines(results: Results, dataset: str, curve: str) -> dict[str, Curves]:
    """Curves over all pixels of a data set, by the row's label: of rows with intervals, then of each method's first row
    with the curve, at most as many as there are styles."""
    labels, plain = row_labels(results.rows), results.default_rows()
    found = {row: results.merged.get((dataset, row), {}) for row in results.rows}
    rows = [row for row, curves in found.items() if "coverage_found" in curves]
    rows += [row for row in plain if row not in rows]
    lines = {labels[row]: found[row] for row in rows if np.isfinite(_values(found[row], curve)).any()}
    return dict(list(lines.items())[: len(_STYLES)])


def intervals_figure(lines: Mapping[str, Curves], title: str) -> Any | None:
    """Coverage against the stated level, by the name in the legend (``SequenceMetrics.curves()``)."""
    if not lines:
        return None
    figure = style.new_figure(5.0, 5.0, title)
    axes = figure.subplots()
    axes.plot([0, 1], [0, 1], linestyle="--", linewidth=1.0, color=FAINT, label="exactly right")
    for line_style, curves in _styled(lines):
        stated, found = (_values(curves, f"coverage_{name}") for name in ("levels", "found"))
        axes.plot(stated, found, markevery=10, **line_style.line)
    axes.set(xlim=(0, 1), ylim=(0, 1), aspect="equal")
    style.finish(axes, title="", x="stated probability of the interval", y="share of truth in it")
    style.legend_below(figure)
    return figure


def gates_figure(lines: Mapping[str, Curves], title: str) -> Any | None:
    """Median error, share within 25 % and coverage of a gate's pixels against their share, by the name in the legend
    (``SequenceMetrics.curves()``)."""
    if not lines:
        return None
    figure = style.new_figure(12.6, 4.6, title)
    panels = figure.subplots(1, 3)
    names = {"error": "median relative error", "delta1": "share within 25 %", "coverage": "share in the 90 % interval"}
    for axes, (name, label) in zip(panels, names.items(), strict=True):
        for line_style, curves in _styled(lines):
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


def _styled(lines: Mapping[str, Curves]) -> list[tuple[LineStyle, Curves]]:
    """Lines with their styles, in order."""
    return [(LineStyle(name, *how), lines[name]) for name, how in zip(lines, _STYLES, strict=False)]


def _values(curves: Curves, name: str) -> Any:
    return np.array(curves.get(name, ()), float)

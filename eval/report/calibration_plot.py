"""Calibration and sparsification curves of several methods in one picture."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ufmstar_torch.eval.report.colours import require_matplotlib
from ufmstar_torch.eval.report.plots import FAINT, INK
from ufmstar_torch.eval.results.files import write_atomic

# Okabe and Ito's colours, which the colour-blind tell apart, and marks for print in grey.
_LINES = (("#6b6b6b", "^"), ("#E69F00", "s"), ("#0072B2", "o"), ("#009E73", "D"), ("#CC79A7", "v"), ("#D55E00", "P"))


def draw_calibration(
    path: str | Path, curves: Mapping[str, Mapping[str, Sequence[float]]], *, title: str = "", dpi: int = 110
) -> None:
    """Draw delta calibration, quantile calibration and sparsification side by side and write the picture (PNG).

    On the dashed diagonals a variance is exactly right. Matplotlib's global state is left alone.

    Args:
        path: the file; its folder must exist.
        curves: ``SequenceMetrics.curves()`` by the name that the legend shows.
        title: over the picture.
        dpi: pixels per inch.

    Raises:
        ValueError: there are no curves, or more than can be told apart.
        ImportError: matplotlib is missing.
    """
    if not 1 <= len(curves) <= len(_LINES):
        raise ValueError(f"curves must hold 1 to {len(_LINES)} methods, got {len(curves)}")
    require_matplotlib()
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12.6, 4.6), dpi=dpi, facecolor="white", layout="constrained")
    canvas = FigureCanvasAgg(figure)
    if title:
        figure.suptitle(title, size=12, weight="bold", color=INK, x=0.01, ha="left")
    left, middle, right = figure.subplots(1, 3)
    styles = {name: {"color": c, "marker": m} for name, (c, m) in zip(curves, _LINES, strict=False)}
    _draw_delta(left, curves, styles)
    _draw_quantiles(middle, curves, styles)
    _draw_sparsification(right, curves, styles)
    for axes in (left, middle, right):
        axes.tick_params(labelsize=8, color=FAINT, labelcolor=INK)
        axes.grid(color="#e6e6e6", linewidth=0.6)
        axes.set_axisbelow(True)
        for side in ("top", "right"):
            axes.spines[side].set_visible(False)
    figure.legend(*left.get_legend_handles_labels(), loc="outside lower center", ncols=len(curves) + 1, frameon=False)
    write_atomic(Path(path), lambda file: canvas.print_png(file))


def _draw_delta(axes: Any, curves: Mapping[str, Mapping[str, Sequence[float]]], styles: Mapping[str, Any]) -> None:
    """Confidence that the depth is within 25 %, and how often it is."""
    _diagonal(axes)
    for name, values in curves.items():
        x, y, pixels = (np.array(values[f"ece_delta_{what}"]) for what in ("confidence", "accuracy", "pixels"))
        shown = pixels > 0.001 * pixels.sum()  # a handful of pixels in a bin say nothing
        axes.plot(x[shown], y[shown], label=name, markersize=4.5, linewidth=1.6, **styles[name])
    _label(axes, "δ calibration", "predicted: share of pixels within 25 %", "true share")


def _draw_quantiles(axes: Any, curves: Mapping[str, Mapping[str, Sequence[float]]], styles: Mapping[str, Any]) -> None:
    """Predicted quantiles of the depth, and the share of the truth below them."""
    _diagonal(axes)
    for name, values in curves.items():
        axes.plot(values["ece_q_levels"], values["ece_q_observed"], markersize=4.5, linewidth=1.6, **styles[name])
    _label(axes, "quantile calibration", "predicted quantile", "share of true depths below")


def _draw_sparsification(
    axes: Any, curves: Mapping[str, Mapping[str, Sequence[float]]], styles: Mapping[str, Any]
) -> None:
    """The error that is left after the most uncertain pixels are gone; dotted, by the true error itself."""
    for name, values in curves.items():
        y = np.array(values["sparsification_rmse"])
        x = np.arange(len(y)) / len(y)
        axes.plot(x, y, linewidth=1.6, markevery=10, markersize=4.5, **styles[name])
        best = values["sparsification_oracle_rmse"]
        axes.plot(x, best, linewidth=1.0, linestyle=":", color=styles[name]["color"])
    axes.set_xlim(0, 1)
    axes.set_ylim(bottom=0)
    _label(axes, "sparsification (dotted: best possible)", "share of pixels left out, largest σ first", "RMSE [m]")


def _diagonal(axes: Any) -> None:
    axes.plot([0, 1], [0, 1], linestyle="--", linewidth=1.0, color=FAINT, label="exactly right")
    axes.set_xlim(0, 1)
    axes.set_ylim(0, 1)
    axes.set_aspect("equal")


def _label(axes: Any, title: str, x: str, y: str) -> None:
    axes.set_title(title, size=10, color=INK)
    axes.set_xlabel(x, size=9, color=INK)
    axes.set_ylabel(y, size=9, color=INK)

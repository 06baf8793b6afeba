"""Strips as in the paper's qualitative figures: error, standard deviation and NLL, and what the variance is made of."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ufmstar_torch.eval.report.colours import DEPTH_MAP, ERROR_MAP, ColourScale, robust_range
from ufmstar_torch.eval.report.example import Example, Map, RowMaps, deviation
from ufmstar_torch.eval.report.grid import Bar, GridRow, Panel, draw_grid

# Neither depth's map nor that of lengths, and without grey.
NLL_MAP = "plasma"
# [nats] The same in all strips, so that they can be compared. 6 is an error of some 3.5 sigma (of sigma = .3 m): beyond
# it a row is simply wrong there, and how much more so would only flatten the rest of the map.
NLL_SCALE = ColourScale(-2.0, 6.0, NLL_MAP)


@dataclass(frozen=True)
class StripScales:
    """Colours that all rows of a strip share: depth with truth, and error with standard deviations [m]."""

    depth: ColourScale
    length: ColourScale


def fit_scales(example: Example, rows: Sequence[str]) -> StripScales:
    """Scales over the truth and these rows of a frame: depth between percentiles 1 and 99, lengths from 0 to 99."""
    truth = example.truth > 0
    depths = [(example.truth, truth), *((example.rows[row].depth, example.rows[row].valid) for row in rows)]
    lengths = [(value, None) for row in rows for value in (example.error(row), example.rows[row].sigma)]
    depth, length = robust_range(depths, from_zero=False), robust_range(lengths, from_zero=True)
    return StripScales(ColourScale(*depth, DEPTH_MAP), ColourScale(*length, ERROR_MAP))


def draw_strip(path: Path, example: Example, rows: Sequence[str], title: str = "") -> StripScales:
    """Image and truth, then depth, error, standard deviation and NLL of each row, on common scales.

    Args:
        path: the picture (PNG).
        example: the frame.
        rows: keys of ``example.rows``, at least one.
        title: over it.

    Returns:
        The scales that were used.

    Raises:
        ValueError: there is no row.
        ImportError: matplotlib is missing.
    """
    scales = fit_scales(example, rows)
    body = []
    for row in rows:
        maps = example.rows[row]
        panels = [
            Panel(scales.depth.rgb(maps.depth, maps.valid)),
            *error_panels(example, row, scales),
        ]
        body.append(GridRow(example.label(row), figures_of(example, row), panels))
    captions = ("predicted depth", "|error|", "σ = √V", "NLL")
    bars = [
        Bar("depth [m]", scales.depth, 0, extend="both"),
        Bar("|error| and σ [m]", scales.length, 1, span=2),
        Bar("NLL [nats]", NLL_SCALE, 3, extend="both"),
    ]
    draw_grid(path, [frame_row(example, scales), *_captioned(body, captions)], bars, aspect=example.aspect, title=title)
    return scales


def draw_breakdown(path: Path, example: Example, rows: Sequence[str], title: str = "") -> StripScales:
    """What the variance of each row is made of: sqrt of A, E, M and V beside the error and the NLL.

    Raises:
        ValueError: there is no row.
        ImportError: matplotlib is missing.
    """
    scales = fit_scales(example, rows)
    body = []
    for row in rows:
        maps = example.rows[row]
        parts = (maps.aleatoric, maps.epistemic, maps.disagreement)
        panels = [_part_panel(part, maps, scales.length) for part in parts]
        error, sigma, nll = error_panels(example, row, scales)
        body.append(GridRow(example.label(row), figures_of(example, row), [*panels, sigma, error, nll]))
    captions = ("√A, aleatoric", "√E, epistemic", "√M, between views", "σ = √V, V = A + E + M", "|error|", "NLL")
    bars = [
        Bar("√A, √E, √M, σ and |error| [m]", scales.length, 0, span=5),
        Bar("NLL [nats]", NLL_SCALE, 5, extend="both"),
    ]
    draw_grid(path, _captioned(body, captions), bars, aspect=example.aspect, title=title)
    return scales


def frame_row(example: Example, scales: StripScales) -> GridRow:
    """Image and ground truth of a frame."""
    truth = Panel(scales.depth.rgb(example.truth, example.truth > 0), "ground truth")
    return GridRow(example.sequence, [f"frame {example.frame}"], [Panel(example.image, "image"), truth])


def error_panels(example: Example, row: str, scales: StripScales) -> tuple[Panel, Panel, Panel]:
    """|error|, sigma and NLL of a row."""
    error, sigma = example.error(row), example.rows[row].sigma
    return Panel(scales.length.rgb(error)), Panel(scales.length.rgb(sigma)), Panel(NLL_SCALE.rgb(example.nll(row)))


def figures_of(example: Example, row: str) -> list[str]:
    """The row's figures on this frame, a line each: mean NLL, root-mean-square error, and what the row expected."""
    error, sigma = example.error(row).astype(np.float64), example.rows[row].sigma
    known = np.isfinite(error)
    if not known.any():
        return ["no ground truth"]
    rms_sigma = np.sqrt(np.mean(np.square(sigma[known], dtype=np.float64)))
    nll = mean_nll(example, row)
    told = "no NLL: V = 0" if nll is None else f"mean NLL {nll:.2f}"
    return [told, f"RMSE {np.sqrt(np.mean(error[known] ** 2)):.2f} m", f"rms σ {rms_sigma:.2f} m"]


def mean_nll(example: Example, row: str) -> float | None:
    """The row's mean NLL on this frame [nats]; None without a pixel that has one."""
    nll = example.nll(row)
    judged = np.isfinite(nll)
    return float(nll[judged].mean()) if judged.any() else None


def _part_panel(part: Map | None, maps: RowMaps, scale: ColourScale) -> Panel:
    if part is None:
        return Panel(None, absent="none")
    usable = maps.valid & np.isfinite(part) & (part >= 0)
    return Panel(scale.rgb(deviation(part, usable)))


def _captioned(rows: Sequence[GridRow], captions: Sequence[str]) -> list[GridRow]:
    """The rows, with captions over the first of them."""
    first = [
        Panel(panel.rgb, caption, panel.box, panel.absent)
        for panel, caption in zip(rows[0].panels, captions, strict=True)
    ]
    return [GridRow(rows[0].title, rows[0].lines, first), *rows[1:]]

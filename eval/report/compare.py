"""UfM* against UfM on one frame: both standard deviations, their difference, and the place where they differ most."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ufmstar_torch.eval.report.colours import ColourScale, robust_range
from ufmstar_torch.eval.report.example import Example
from ufmstar_torch.eval.report.grid import Bar, Box, GridRow, Panel, draw_grid
from ufmstar_torch.eval.report.strips import figures_of, fit_scales

DIFFERENCE_MAP = "RdBu_r"
# Side of the zoomed part by that of the map.
ZOOM = 1 / 3


def draw_comparison(path: Path, example: Example, ufm: str, ufm_star: str, title: str = "") -> Box:
    """Image, error, sigma by UfM and by UfM*, and UfM* minus UfM; below, the part where they differ most.

    Args:
        path: the picture (PNG).
        example: the frame.
        ufm: key of ``example.rows``.
        ufm_star: the other one.
        title: over it.

    Returns:
        The part, (left, top, width, height) in pixels of the maps.

    Raises:
        ImportError: matplotlib is missing.
    """
    scales = fit_scales(example, [ufm, ufm_star])
    old, new = example.rows[ufm].sigma, example.rows[ufm_star].sigma
    difference = new - old
    box = largest_difference(difference, ZOOM)
    reach = robust_range([(np.abs(difference), None)], from_zero=True)[1]
    signed = ColourScale(-reach, reach, DIFFERENCE_MAP)
    maps = (scales.length.rgb(example.error(ufm_star)), scales.length.rgb(old), scales.length.rgb(new))
    captions = (
        f"|error| of {example.label(ufm_star)}",
        f"σ, {example.label(ufm)}",
        f"σ, {example.label(ufm_star)}",
        "difference of σ",
    )
    pictures = [example.image, *maps, signed.rgb(difference)]
    whole = [
        Panel(picture, caption, _scaled(box, old.shape, picture.shape))
        for picture, caption in zip(pictures, ("image", *captions), strict=True)
    ]
    zoomed = [Panel(_cut(picture, _scaled(box, old.shape, picture.shape))) for picture in pictures]
    lines = [line for row in (ufm, ufm_star) for line in (f"{example.label(row)}:", *figures_of(example, row))]
    rows = [
        GridRow(example.sequence, [f"frame {example.frame}"], whole),
        GridRow("where they differ most", lines, zoomed),
    ]
    bars = [
        Bar("|error| and σ [m]", scales.length, 1, span=3),
        Bar("UfM* minus UfM [m]", signed, 4, extend="both"),
    ]
    draw_grid(path, rows, bars, aspect=example.aspect, title=title)
    return box


def largest_difference(difference: NDArray[Any], share: float) -> Box:
    """The box with the largest mean |difference|, missing values (NaN) counting as none.

    Args:
        difference: [h, w].
        share: side of the box by that of the map, in (0, 1].

    Returns:
        (left, top, width, height) [px]; the first such box from the top left.

    Raises:
        ValueError: share is out of range.
    """
    if not 0 < share <= 1:
        raise ValueError(f"share must lie in (0, 1], got {share}")
    h, w = difference.shape
    height, width = max(1, round(share * h)), max(1, round(share * w))
    size = np.where(np.isfinite(difference), np.abs(difference), 0).astype(np.float64)
    sums = np.zeros((h + 1, w + 1))
    sums[1:, 1:] = size.cumsum(0).cumsum(1)
    boxes = sums[height:, width:] - sums[:-height, width:] - sums[height:, :-width] + sums[:-height, :-width]
    # Sums of rounded sums differ in the last bits where the boxes' own do not.
    top, left = np.unravel_index(int(np.argmax(boxes.round(9))), boxes.shape)
    return int(left), int(top), width, height


def _scaled(box: Box, shape: tuple[int, ...], picture: tuple[int, ...]) -> Box:
    """A box of a map in a picture of another size."""
    y, x = picture[0] / shape[0], picture[1] / shape[1]
    left, top, width, height = box
    return round(left * x), round(top * y), max(1, round(width * x)), max(1, round(height * y))


def _cut(picture: NDArray[np.uint8], box: Box) -> NDArray[np.uint8]:
    left, top, width, height = box
    return picture[top : top + height, left : left + width]

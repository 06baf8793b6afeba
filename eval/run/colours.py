"""Colours of pictures: perceptually uniform maps, ranges by percentile, grey for unknown values; writing of PNGs."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ufmstar_torch.eval.engine.files import write_atomic
from ufmstar_torch.runtime.optional import optional

# Depth and uncertainty have different maps, so that their pictures cannot be confused.
DEPTH_MAP = "viridis"
ERROR_MAP = "magma"
INK, FAINT = "#1a1a1a", "#6b6b6b"  # of text
# Grey is in neither map.
INVALID_GREY = 150
PERCENTILES = (1.0, 99.0)


@dataclass(frozen=True)
class ColourScale:
    """A matplotlib map and the values [m] at its dark and its bright end, low < high. Values beyond an end have its
    colour. ``logarithmic``: the colour is linear in the logarithm of the value, and 0 < low.
    """

    low: float
    high: float
    colour_map: str
    logarithmic: bool = False

    def rgb(self, values: NDArray[Any]) -> NDArray[np.uint8]:
        """[..., 3] the colours of ``values`` [...] [m]; grey where not finite."""
        finite = np.isfinite(values)
        shown = np.clip(np.where(finite, values, self.low).astype(np.float64), self.low, self.high)
        low, high = self.low, self.high
        if self.logarithmic:
            shown, low, high = np.log(shown), np.log(low), np.log(high)
        index = (shown - low) / (high - low) * 255
        colours = colour_table(self.colour_map)[np.rint(index).astype(np.intp)]
        return np.where(finite[..., None], colours, np.uint8(INVALID_GREY))


@cache
def colour_table(name: str) -> NDArray[np.uint8]:
    """[256, 3] the sRGB colours of a matplotlib map, read-only."""
    table: NDArray[np.uint8] = require_matplotlib().colormaps[name](np.linspace(0, 1, 256), bytes=True)[:, :3].copy()
    table.setflags(write=False)
    return table


def require_matplotlib() -> Any:
    """The matplotlib package, without pyplot and its global state. Raises ImportError: it is missing; the message names
    the extra to install."""
    return optional("matplotlib", "pictures need matplotlib", "'ufmstar-torch[viz]'")


def plain(text: str) -> str:
    """Text for matplotlib with escaped dollar signs: a pair of them would enclose a formula."""
    return text.replace("$", r"\$")


def save_png(figure: Any, path: Path) -> None:
    """Write a matplotlib figure as PNG, atomically; the same figure gives the same bytes."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    write_atomic(path, FigureCanvasAgg(figure).print_png)


def known_where(condition: NDArray[np.bool_], values: NDArray[Any]) -> NDArray[np.float32]:
    """The values in float32, NaN where the condition is False."""
    return np.where(condition, values, np.nan).astype(np.float32)


def striped(rgb: NDArray[np.uint8], where: NDArray[np.bool_] | None) -> NDArray[np.uint8]:
    """A picture [h, w, 3] with diagonal grey stripes over a third of the pixels ``where`` [h, w]; None = nowhere."""
    if where is None:
        return rgb
    third = max(2, len(rgb) // 110)
    across = np.add.outer(np.arange(where.shape[0]), np.arange(where.shape[1])) // third % 3 == 0
    return np.where((where & across)[..., None], np.uint8(INVALID_GREY), rgb)


def robust_range(maps: Iterable[NDArray[Any]], *, from_zero: bool) -> tuple[float, float]:
    """The 1st to 99th percentile [m] over all finite pixels of several maps, low < high; (0, 1) without a pixel.

    ``from_zero`` starts the range at 0, as for a sigma or an error.
    """
    finite = [values[np.isfinite(values)] for values in maps]
    pixels = np.concatenate(finite) if finite else np.zeros(0)
    if pixels.size == 0:
        return 0.0, 1.0
    low, high = (float(x) for x in np.percentile(pixels, PERCENTILES))
    if from_zero:
        low = 0.0
    # A constant map, as a disagreement of 0 in the first frame, still needs a range.
    return (low, high) if high > low else (low, low + max(1e-3, 1e-3 * abs(low)))

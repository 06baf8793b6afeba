"""Colours of pictures: perceptually uniform maps, ranges by percentile, grey for invalid pixels; writing of PNGs."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ufmstar_torch.eval.results.files import write_atomic

# Depth and uncertainty get different maps, so that the two pictures cannot be confused.
DEPTH_MAP = "viridis"
ERROR_MAP = "magma"
INK, FAINT = "#1a1a1a", "#6b6b6b"  # of words
# In neither map: both are coloured at medium lightness.
INVALID_GREY = 150
PERCENTILES = (1.0, 99.0)


@dataclass(frozen=True)
class ColourScale:
    """How lengths become colours.

    Attributes:
        low: value [m] of the map's dark end; what lies below gets the same colour.
        high: value [m] of the bright end, > low.
        colour_map: name of a matplotlib map.
    """

    low: float
    high: float
    colour_map: str

    def __post_init__(self) -> None:
        if not self.low < self.high:
            raise ValueError(f"low must be less than high, got {self.low} and {self.high}")

    def rgb(self, values: NDArray[Any], valid: NDArray[np.bool_] | None = None) -> NDArray[np.uint8]:
        """[..., 3] the colours of ``values`` [...] [m]; grey where not finite or not ``valid``."""
        usable = np.isfinite(values) if valid is None else valid & np.isfinite(values)
        # The mean of low and high is harmless where nothing is shown.
        shown = np.where(usable, values, self.low).astype(np.float64)
        index = np.clip((shown - self.low) / (self.high - self.low), 0, 1) * 255
        colours = colour_table(self.colour_map)[np.rint(index).astype(np.intp)]
        return np.where(usable[..., None], colours, np.uint8(INVALID_GREY))


@cache
def colour_table(name: str) -> NDArray[np.uint8]:
    """[256, 3] the sRGB colours of a matplotlib map, read-only.

    Raises:
        ImportError: matplotlib is missing; names the extra that brings it.
        KeyError: there is no such map.
    """
    colormaps = require_matplotlib().colormaps
    table: NDArray[np.uint8] = colormaps[name](np.linspace(0, 1, 256), bytes=True)[:, :3].copy()
    table.setflags(write=False)
    return table


def require_matplotlib() -> Any:
    """The matplotlib package, without pyplot and so without a global state or a window system.

    Raises:
        ImportError: it is missing; names the extra that brings it.
    """
    try:
        import matplotlib
    except ImportError as error:
        raise ImportError("pictures need matplotlib: pip install 'ufmstar-torch[viz]'") from error
    return matplotlib


def plain(text: str) -> str:
    """Text for matplotlib as it stands: a pair of dollar signs would make a formula of what lies between."""
    return text.replace("$", r"\$")


def save_png(figure: Any, path: Path) -> None:
    """Write a matplotlib figure as PNG, atomically; the same figure gives the same bytes.

    Raises:
        OSError: see ``write_atomic``.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    write_atomic(path, FigureCanvasAgg(figure).print_png)


def robust_range(
    maps: Iterable[tuple[NDArray[Any], NDArray[np.bool_] | None]], *, from_zero: bool
) -> tuple[float, float]:
    """The 1st to 99th percentile over all valid pixels of several maps [m].

    Args:
        maps: pairs (values [...], valid [...] or None).
        from_zero: start the range at 0, as for a sigma or an error.

    Returns:
        (low, high), low < high always; (0, 1) where there is no valid pixel.
    """
    kept = [values[np.isfinite(values) & (True if valid is None else valid)] for values, valid in maps]
    pixels = np.concatenate([k.ravel() for k in kept]) if kept else np.zeros(0)
    if pixels.size == 0:
        return 0.0, 1.0
    low, high = (float(x) for x in np.percentile(pixels, PERCENTILES))
    if from_zero:
        low = 0.0
    # One value everywhere, as a disagreement of 0 in the first frame, still needs a range to draw.
    return (low, high) if high > low else (low, low + max(1e-3, 1e-3 * abs(low)))

"""The offset of a world whose origin is far away, as UTM's, for files that store positions in float32."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

# Largest coordinate without an offset [m]; float32 has steps of .06 mm there. Offsets are multiples of it.
_NEAR = 1000.0


def world_offset(position: NDArray[np.float64]) -> NDArray[np.float64]:
    """[3] whole kilometres near a ``position`` [3] [m], which are subtracted from all positions of a file and written
    into it; 0 within a kilometre of the origin."""
    if not (np.abs(position) > _NEAR).any():
        return np.zeros(3)
    return np.asarray(np.round(position / _NEAR) * _NEAR)


def offset_text(offset: NDArray[np.float64]) -> str:
    """The sentence that a file states; "" for 0."""
    if not offset.any():
        return ""
    return f"offset {' '.join(f'{x:.0f}' for x in offset)} m: add it to positions for the world of the poses"

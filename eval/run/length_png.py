"""Depth and sigma as 16-bit PNGs, of runs and exports: 0 = none; metres per count in the PNG's text."""

from __future__ import annotations

import io
from typing import Any

import numpy as np
from numpy.typing import NDArray

# Metres per count that an export may choose from, finest first: up to 65.5 m, 256 m (KITTI's), 655 m, 6.6 km.
DEPTH_UNITS = (0.001, 1 / 256, 0.01, 0.1)
FULL = 65535
# zlib's level of the PNGs. Level 6 takes 3-5 times as long for 10 % less. One filter for all rows, the difference to
# the row above, takes six tenths of the time of a choice for every row, and the files are as large.
PNG_LEVEL = 1
_AFTER_HEADER = 33  # bytes: signature and IHDR


def fitting_unit(depth: NDArray[Any]) -> float:
    """The finest of ``DEPTH_UNITS`` whose range is twice the 99th percentile of the depths [m].

    Twice, since later frames may look farther; a percentile, since a sky at 10 km would otherwise cost
    all resolution. Without a depth: the finest.
    """
    finite = depth[np.isfinite(depth)]
    far = 2 * float(np.percentile(finite, 99)) if finite.size else 0.0
    return next((unit for unit in DEPTH_UNITS if far <= FULL * unit), DEPTH_UNITS[-1])


def encode_length_png(values: NDArray[Any], unit: float, quantity: str) -> bytes:
    """Lengths [H, W] [m] as a 16-bit PNG with its scale ``unit`` [m per count] as text; the file's content.

    count = round(value / unit), 0 = not finite or negative. A value below half a unit becomes 1, so that it is not
    taken for none; one beyond the range becomes 65535. Text keys: ``depth_scale`` = metres per count (also for
    sigma: it is a depth's), ``unit``, ``quantity``, ``invalid``, ``saturated`` = number of values beyond the range.
    """
    import cv2
    from PIL.PngImagePlugin import PngInfo, putchunk

    usable = (values >= 0) & (values < np.inf)
    counts = np.rint(np.where(usable, values, 0).astype(np.float64) / unit)
    # Clipped in float64: a cast of larger values to 16 bits would wrap around.
    coded = np.where(usable, np.clip(counts, 1, FULL), 0).astype(np.uint16)
    how = (cv2.IMWRITE_PNG_COMPRESSION, PNG_LEVEL, cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_UP)
    pixels = cv2.imencode(".png", coded, how)[1].tobytes()
    text, content = PngInfo(), io.BytesIO()
    entries = {"depth_scale": repr(float(unit)), "unit": "metres per count", "quantity": quantity}
    entries |= {"invalid": "0", "saturated": str(np.count_nonzero(counts > FULL))}
    for key, value in entries.items():
        text.add_text(key, value)
    content.write(pixels[:_AFTER_HEADER])
    for chunk in text.chunks:
        putchunk(content, *chunk[:2])
    content.write(pixels[_AFTER_HEADER:])
    return content.getvalue()

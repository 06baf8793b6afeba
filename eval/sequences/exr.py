"""Depth maps in OpenEXR files: any compression, scan lines or tiles, one part or several (OpenEXR's library)."""

from __future__ import annotations

from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path

import numpy as np

from ufmstar_torch.eval.sequences.frame import FrameError

# Names of a depth channel, best first; Blender prefixes its layer ("ViewLayer.Depth.Z").
_DEPTH_NAMES = ("Z", "depth", "V", "Y", "R")


def read_exr(path: str | Path) -> np.ndarray:
    """The depth channel of an OpenEXR file as [H, W] float32, values as stored.

    It is the only channel, or the first one called Z, depth, V, Y or R (after a layer prefix).

    Raises:
        FrameError: not an OpenEXR file, truncated, a deep image, or no such channel.
        ModuleNotFoundError: OpenEXR is not installed.
    """
    try:
        import OpenEXR
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError("EXR files need OpenEXR: pip install 'ufmstar-torch[eval]'") from error
    try:
        with redirect_stdout(StringIO()):  # the library prints a remark on damaged files
            parts = OpenEXR.File(str(path), separate_channels=True).parts
        if not parts:
            raise ValueError("no pixels can be decoded")
        channels = {name: channel for part in parts for name, channel in part.channels.items()}
        channel = channels[_depth_channel(list(channels))]
    except (RuntimeError, TypeError, ValueError) as error:
        raise FrameError(path, f"cannot be decoded as OpenEXR: {error}") from error
    pixels = channel.pixels
    if pixels.ndim != 2 or pixels.dtype == object or (channel.xSampling, channel.ySampling) != (1, 1):
        raise FrameError(path, "cannot be decoded as OpenEXR: the depth channel is deep or subsampled")
    return np.asarray(pixels, dtype=np.float32)


def _depth_channel(names: list[str]) -> str:
    if len(names) == 1:
        return names[0]
    for wanted in _DEPTH_NAMES:
        matching = [name for name in names if name.rsplit(".", 1)[-1].lower() == wanted.lower()]
        if len(matching) == 1:
            return matching[0]
    raise ValueError(f"no channel is the depth: expected one of {_DEPTH_NAMES}, got {names}")

"""The files of every frame of ``ufmstar run``: OUT/frames/NAME.npz, and 16-bit PNGs of depth and sigma.

The npz has depth [m], variance [m^2], disagreement [m^2], measured (the share of the disagreement that rests on two
views or more) float32 and valid bool, each [H, W]; with anchors also anchored [m^2] (B) and bias (r: depth (1 + r) is
the depth corrected), with a posterior also posterior_depth [m] and posterior_variance [m^2]; T_world_cam [4, 4]
camera-to-world [m] and intrinsics [3, 3] of the maps [px]; with anchors also anchors [N, 4]: u, v in the maps [px],
depth and its standard deviation [m]. depth/NAME.png and sigma/NAME.png are the posterior's where there is one; the
network's own are in network_depth/ and network_sigma/ then.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from ufmstar_torch.array_files import read_npz_whole
from ufmstar_torch.eval.run.files import write_atomic
from ufmstar_torch.eval.run.length_png import encode_length_png, fitting_unit

FRAMES = "frames"
PNGS = ("depth", "sigma", "network_depth", "network_sigma")
_NO_CAMERA: Mapping[str, NDArray[Any]] = MappingProxyType({})


def frame_file(out: Path, name: str) -> Path:
    """The file of a frame. Raises ValueError: the name is not usable as a file name."""
    if not name or name.startswith(".") or any(c in name for c in "/\\\0"):
        raise ValueError(f"name must be a plain file name without its ending, got {name!r}")
    return out / FRAMES / f"{name}.npz"


def write_frame(
    file: Path, valid: Tensor, camera: Mapping[str, NDArray[Any]] = _NO_CAMERA, **given: Tensor | None
) -> dict[str, NDArray[Any]]:
    """Write one frame's npz, whole or not at all, and return its maps. They are [H, W]; those that are None are left
    out, ``valid`` is True where the pixel was used, and ``camera`` has the arrays of its pose, intrinsics and anchors.

    Raises:
        ValueError: shapes or types disagree.
        OSError: the disk is full, say; earlier frames are untouched.
    """
    maps: dict[str, NDArray[Any]] = {name: _float_map(x, name) for name, x in given.items() if x is not None}
    maps["valid"], shape = valid.cpu().numpy(), maps["depth"].shape
    for label, value in maps.items():
        if value.shape != shape:
            raise ValueError(f"{label} must have the depth's shape {shape}, got {value.shape}")
    if maps["valid"].dtype != np.bool_:
        raise ValueError(f"valid must be a bool mask (True = use), got {maps['valid'].dtype}")
    # Not compressed: float noise shrinks by a quarter only and takes 40 times as long (224x224: 0.65 MB in 0.6 ms
    # against 0.50 MB in 27 ms).
    write_atomic(file, lambda opened: np.savez(opened, allow_pickle=False, **maps, **camera))
    return maps


def write_pngs(out: Path, name: str, maps: Mapping[str, NDArray[Any]], unit: float | None) -> float:
    """Write the PNGs of a frame's maps: 0 = not valid; sigma's scale is a tenth of depth's.

    Args:
        unit: metres per count of depth, one for a whole run; None: it is chosen from this frame.

    Returns:
        The unit.
    """
    posterior = "posterior_depth" in maps
    for source, folder in (("posterior_", ""), ("", "network_")) if posterior else (("", ""),):
        depth = np.where(maps["valid"], maps[f"{source}depth"], np.nan)
        with np.errstate(invalid="ignore"):
            sigma = np.sqrt(np.where(maps["valid"], maps[f"{source}variance"], np.nan))
        unit = unit or fitting_unit(depth)
        for kind, values, metres in (("depth", depth, unit), ("sigma", sigma, unit / 10)):
            content, file = encode_length_png(values, metres, kind), out / f"{folder}{kind}" / f"{name}.png"
            file.parent.mkdir(exist_ok=True)
            write_atomic(file, partial(_write, content))
    assert unit is not None
    return unit


def _write(content: bytes, file: BinaryIO) -> None:
    file.write(content)


def read_frame(path: str | Path) -> dict[str, NDArray[Any]]:
    """The arrays of a frame's file. Errors as ``read_npz_whole``."""
    return read_npz_whole(path)


def _float_map(value: Tensor, name: str) -> NDArray[np.float32]:
    if value.dim() != 2 or not value.is_floating_point():
        raise ValueError(f"{name} must be a floating-point map [H, W], got {value.dtype} {tuple(value.shape)}")
    return value.detach().cpu().numpy().astype(np.float32, copy=False)

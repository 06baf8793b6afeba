"""The files of every frame: OUT/frames/NAME.npz of ``ufmstar run``, OUT/STAMP.npz of ``ufmstar live``, and 16-bit PNGs.

The npz has

- depth [m] and its variance [m^2] float32, the posterior's unless the run is plain, and valid bool, each [H, W];
- with a posterior network_depth [m], which it corrects, and ufm_variance [m^2], V of UfM* for that depth;
  posterior_outlier (a probability) and posterior_inlier_variance [m^2];
- disagreement [m^2] (M) and measured, the share of M from views of different places;
- with anchors anchored [m^2] (B), bias (r: the network's depth times 1 + r is to be expected), and anchors [N, 4]: u, v
  in the maps [px], depth and its standard deviation [m];
- T_world_cam [4, 4] camera-to-world [m] and intrinsics [3, 3] of the maps [px].

depth/NAME.png and sigma/NAME.png are depth and the root of variance; with a posterior, network_depth/ and ufm_sigma/
are network_depth and the root of ufm_variance.
"""

from __future__ import annotations

import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from zipfile import BadZipFile, ZipFile

import numpy as np
from numpy.typing import NDArray

from ufmstar_torch.eval.engine.files import write_atomic, write_bytes_atomic
from ufmstar_torch.files.read import read_npz_whole
from ufmstar_torch.frames.output import MAPS, UncertaintyOutput

FRAMES = "frames"
# Folders of the PNGs, and the arrays of the npz with a frame's depth and variance for them.
_RESULT = ("depth", "sigma"), ("depth", "variance")
_BEFORE = ("network_depth", "ufm_sigma"), ("network_depth", "ufm_variance")
PNGS = (*_RESULT[0], *_BEFORE[0])
_OF_NETWORK = ("aleatoric", "epistemic", "confidence")  # maps that are not stored
# Arrays of every frame, and the texts of every PNG.
_NEEDED = ("depth", "variance", "disagreement", "valid", "T_world_cam", "intrinsics")
_TEXTS = {"depth_scale", "unit", "quantity", "invalid", "saturated"}


def frame_file(out: Path, name: str) -> Path:
    """The file of a frame. Raises ValueError: the name is not usable as a file name."""
    if not name or name.startswith(".") or any(c in name for c in "/\\\0"):
        raise ValueError(f"name must be a plain file name without its ending, got {name!r}")
    return out / FRAMES / f"{name}.npz"


def output_arrays(out: UncertaintyOutput, T_world_cam: NDArray[np.float64]) -> dict[str, NDArray[Any]]:
    """The maps of an output of one stream, its pose and its intrinsics, by name."""
    left_out = _OF_NETWORK if out.posterior_outlier is not None else (*_OF_NETWORK, *_BEFORE[1])
    maps = {name: value for name in MAPS if name not in left_out and (value := getattr(out, name)) is not None}
    arrays = {name: value[0].cpu().numpy().astype(np.float32, copy=False) for name, value in maps.items()}
    camera = {"T_world_cam": T_world_cam, "intrinsics": out.intrinsics[0].cpu().double().numpy()}
    return {**arrays, "valid": out.valid[0].cpu().numpy(), **camera}


def write_frame(file: Path, arrays: Mapping[str, NDArray[Any]]) -> None:
    """Write one frame's npz, atomically."""
    # Not compressed: that saves a quarter only and takes 40 times as long (224x224: 0.50 MB in 27 ms instead of 0.65 MB
    # in 0.6 ms).
    write_atomic(file, lambda opened: np.savez(opened, allow_pickle=False, **arrays))


def write_pngs(out: Path, name: str, maps: Mapping[str, NDArray[Any]], unit: float | None) -> float:
    """Write the PNGs of a frame's maps (0 = not valid). ``unit`` is the metres per count of depth, equal in a whole
    run; None = chosen from this frame. Sigma's unit is a tenth of it. Returns ``unit``."""
    for folders, names in (_RESULT, _BEFORE) if _BEFORE[1][0] in maps else (_RESULT,):
        depth, variance = (np.where(maps["valid"], maps[key], np.nan) for key in names)
        with np.errstate(invalid="ignore"):
            sigma = np.sqrt(variance)
        unit = unit or fitting_unit(depth)
        for folder, values, metres in zip(folders, (depth, sigma), (unit, unit / 10), strict=True):
            kind = "sigma" if values is sigma else "depth"
            content, file = encode_length_png(values, metres, kind), out / folder / f"{name}.png"
            file.parent.mkdir(exist_ok=True)
            write_bytes_atomic(file, content)
    assert unit is not None
    return unit


def read_frame(path: str | Path) -> dict[str, NDArray[Any]]:
    """The arrays of a frame's file. Errors as ``read_npz_whole``; also ValueError: an array is missing, or has another
    form; the message names file and array."""
    arrays = read_npz_whole(path)
    corrected = any(name.startswith("posterior_") for name in arrays)
    if missing := [name for name in (*_NEEDED, *(_BEFORE[1] if corrected else ())) if name not in arrays]:
        raise ValueError(f"{path} is no frame of `ufmstar run`: it has no array {missing[0]}")
    size = arrays["depth"].shape
    for name, values in arrays.items():
        shape: tuple[int | None, ...] = {"T_world_cam": (4, 4), "intrinsics": (3, 3), "anchors": (None, 4)}.get(
            name, size
        )
        fits = len(values.shape) == len(shape) and all(b in (None, a) for a, b in zip(values.shape, shape, strict=True))
        numbers = values.dtype.kind == ("b" if name == "valid" else "f")
        if not (fits and numbers and len(size) == 2):
            raise ValueError(
                f"{path} is no frame of `ufmstar run`: array {name} is {values.dtype} {list(values.shape)}"
            )
    if not (np.isfinite(arrays["T_world_cam"]).all() and np.isfinite(arrays["intrinsics"]).all()):
        raise ValueError(f"{path} is no frame of `ufmstar run`: its pose or intrinsics are not finite")
    return arrays


def is_frame(path: Path) -> bool:
    """True if a file is an npz with the arrays of every frame."""
    try:
        with ZipFile(path) as archive:
            return {f"{name}.npy" for name in _NEEDED} <= set(archive.namelist())
    except (OSError, BadZipFile, ValueError):
        return False


def is_length_png(path: Path) -> bool:
    """True if a file is a PNG of :func:`encode_length_png`, by its texts."""
    from PIL import Image, UnidentifiedImageError

    try:
        with Image.open(path) as image:
            return set(image.info) >= _TEXTS
    except (UnidentifiedImageError, OSError, SyntaxError, ValueError, Image.DecompressionBombError):
        return False


# Metres per count, finest first, with ranges of 65.5 m, 256 m (KITTI's), 655 m and 6.6 km.
DEPTH_UNITS = (0.001, 1 / 256, 0.01, 0.1)
FULL = 65535
PNG_STRATEGY = 3  # zlib's Z_RLE, which looks for runs alone: as small as its level 1 in .7 of the time


def fitting_unit(depth: NDArray[Any]) -> float:
    """The finest of ``DEPTH_UNITS`` whose range is at least twice the 99th percentile of the depths [m], because depths
    of later frames may be larger; a maximum would be dominated by a sky at 10 km. Without a depth: the finest."""
    finite = depth[np.isfinite(depth)]
    far = 2 * float(np.percentile(finite, 99)) if finite.size else 0.0
    return next((unit for unit in DEPTH_UNITS if far <= FULL * unit), DEPTH_UNITS[-1])


def encode_length_png(values: NDArray[Any], unit: float, quantity: str) -> bytes:
    """The content of a 16-bit PNG of lengths [H, W] [m], with the scale ``unit`` [m per count] as text.

    count = round(value / unit), 0 = not finite or negative. A value below half a unit becomes 1, because 0 means none;
    a value beyond the range becomes 65535. Text keys: ``depth_scale`` = metres per count (also for sigma), ``unit``,
    ``quantity``, ``invalid``, ``saturated`` = number of values beyond the range.
    """
    from PIL import Image
    from PIL.PngImagePlugin import PngInfo

    usable = (values >= 0) & (values < np.inf)
    counts = np.rint(np.where(usable, values, 0).astype(np.float64) / unit)
    # Clipped in float64: a cast of larger values to 16 bits would wrap around.
    coded = np.where(usable, np.clip(counts, 1, FULL), 0).astype(np.uint16)
    text, content = PngInfo(), io.BytesIO()
    entries = {"depth_scale": repr(float(unit)), "unit": "metres per count", "quantity": quantity}
    entries |= {"invalid": "0", "saturated": str(np.count_nonzero(counts > FULL))}
    for key, value in entries.items():
        text.add_text(key, value)
    Image.fromarray(coded).save(content, "PNG", compress_type=PNG_STRATEGY, pnginfo=text)
    return content.getvalue()

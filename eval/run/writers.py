"""The files of every frame of ``ufmstar run``: an npz and 16-bit PNGs.

```
OUT/frames/NAME.npz   depth [m], variance [m^2], disagreement [m^2], measured (the share of the disagreement that
                      rests on two views or more) float32 and valid bool, each [H, W]; with anchors also anchored
                      [m^2] (B) and bias (r: depth (1 + r) is the depth corrected), with a posterior also
                      posterior_depth [m] and posterior_variance [m^2]; T_world_cam [4, 4] camera-to-world [m] and
                      intrinsics [3, 3] of the maps [px]
OUT/depth/NAME.png    depth, the posterior's if there is one; 16 bit, 0 = invalid; metres per count in the PNG's text
OUT/sigma/NAME.png    its standard deviation, likewise; the text "unmeasured" counts pixels that no two views compared
```
Every file is complete or absent. Nothing here keeps more than one frame in memory.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from ufmstar_torch import unmeasured
from ufmstar_torch.array_files import read_npz_whole
from ufmstar_torch.eval.run.files import write_together

# Metres per count that a run may choose from, finest first: up to 65.5 m, 256 m (KITTI's), 655 m, 6.6 km.
DEPTH_UNITS = (0.001, 1 / 256, 0.01, 0.1)
FULL = 65535
# zlib's level of the PNGs. Level 6 takes 3-5 times as long for 10 % less. One filter for all rows, the difference to
# the row above, takes six tenths of the time of a choice for every row, and the files are as large.
PNG_LEVEL = 1
_AFTER_HEADER = 33  # bytes: signature and IHDR
_NO_CAMERA: Mapping[str, NDArray[Any]] = MappingProxyType({})


class FrameWriter:
    """Writes frames so that a run can be stopped at any moment and continued.

    The PNG scale is one for the whole run, so that a program that reads it once is right for all frames. It is chosen
    from the first frame (see ``fitting_unit``); sigma's is a tenth of it. Pixels beyond the range are counted, and
    exact in the npz.

    Args:
        out_dir: the run's folder.
        unit: of the depth PNGs of a run that is continued [m per count].
    """

    def __init__(self, out_dir: str | Path, unit: float | None = None) -> None:
        self.out_dir, self.unit = Path(out_dir), unit
        for folder in ("frames", "depth", "sigma"):
            (self.out_dir / folder).mkdir(parents=True, exist_ok=True)

    def paths(self, name: str) -> dict[str, Path]:
        """The files of every frame by kind (depth, sigma, frames), in the order in which they are written. Raises
        ValueError: the name is not usable as a file name."""
        if not name or name.startswith(".") or any(c in name for c in "/\\\0"):
            raise ValueError(f"name must be a plain file name without its ending, got {name!r}")
        kinds = {"depth": "png", "sigma": "png", "frames": "npz"}
        return {kind: self.out_dir / kind / f"{name}.{ending}" for kind, ending in kinds.items()}

    def finished(self, name: str) -> bool:
        """True if all files of the frame are there, and so complete."""
        return all(path.is_file() for path in self.paths(name).values())

    def write(
        self, name: str, *, valid: Tensor, camera: Mapping[str, NDArray[Any]] = _NO_CAMERA, **given: Tensor | None
    ) -> dict[str, int]:
        """Write one frame; none of its files appears before all are written. The maps are [H, W]; those that are None
        are left out, ``valid`` is True where the pixel was used, and ``camera`` has the arrays of its pose and
        intrinsics. Returns how many valid pixels of "depth" and "sigma" lie beyond the PNGs' range and are stored as
        its largest value.

        Raises:
            ValueError: shapes or types disagree.
            OSError: the disk is full, say; earlier frames are untouched.
        """
        maps: dict[str, NDArray[Any]] = {n: _float_map(x, n) for n, x in given.items() if x is not None}
        d, v, used = maps["depth"], maps["variance"], valid.cpu().numpy()
        maps["valid"] = used
        for label, value in maps.items():
            if value.shape != d.shape:
                raise ValueError(f"{label} must have the depth's shape {d.shape}, got {value.shape}")
        if used.dtype != np.bool_:
            raise ValueError(f"valid must be a bool mask (True = use), got {used.dtype}")
        prefix = "posterior_" if "posterior_depth" in maps else ""
        d, v = maps[f"{prefix}depth"], maps[f"{prefix}variance"]
        paths, unit = self.paths(name), self.unit or fitting_unit(d[used])
        self.unit = unit
        files: dict[Path, Callable[[BinaryIO], object]] = {}
        saturated = {}
        blind = np.count_nonzero(maps["measured"] < unmeasured.HALF) if "measured" in maps else 0
        notes = {"depth": {}, "sigma": {"unmeasured": str(blind)}}
        sigma = np.sqrt(np.where(v >= 0, v, np.nan))
        for kind, values, counts in (("depth", d, unit), ("sigma", sigma, unit / 10)):
            content, saturated[kind] = encode_length_png(values, used, counts, quantity=kind, **notes[kind])
            files[paths[kind]] = partial(_write, content)
        # Not compressed: float noise shrinks by a quarter only and takes 40 times as long (224x224: 0.65 MB in 0.6 ms
        # against 0.50 MB in 27 ms).
        files[paths["frames"]] = lambda file: np.savez(file, allow_pickle=False, **maps, **camera)
        write_together(files)
        return saturated


def _write(content: bytes, file: BinaryIO) -> None:
    file.write(content)


def read_frame(path: str | Path) -> dict[str, NDArray[Any]]:
    """The maps of a frame's npz: depth [m], variance [m^2], disagreement [m^2], valid, each [H, W]; with anchors
    also anchored [m^2] and bias, with a posterior its depth and variance; and T_world_cam [4, 4] [m] and intrinsics
    [3, 3] [px]. Errors as ``read_npz_whole``."""
    return read_npz_whole(path)


def fitting_unit(depth: NDArray[Any]) -> float:
    """The finest of ``DEPTH_UNITS`` whose range is twice the 99th percentile of the depths [m].

    Twice, since later frames may look farther; a percentile, since a sky at 10 km would otherwise cost
    all resolution. Without a depth: the finest.
    """
    finite = depth[np.isfinite(depth)]
    far = 2 * float(np.percentile(finite, 99)) if finite.size else 0.0
    return next((unit for unit in DEPTH_UNITS if far <= FULL * unit), DEPTH_UNITS[-1])


def encode_length_png(values: NDArray[Any], valid: NDArray[np.bool_], unit: float, **notes: str) -> tuple[bytes, int]:
    """Lengths [H, W] [m] as a 16-bit PNG with its scale ``unit`` [m per count] as text: the file's content, and the
    number of saturated pixels.

    count = round(value / unit), 0 = invalid or not finite. A valid value below half a unit becomes 1, so that it is not
    taken for invalid; one beyond the range becomes 65535. Text keys: ``depth_scale`` = metres per count (also for
    sigma: it is a depth's), ``unit``, ``invalid``, ``saturated``, and the ``notes`` for the reader.
    """
    import cv2
    from PIL.PngImagePlugin import PngInfo, putchunk

    usable = valid & (values >= 0) & (values < np.inf)
    counts = np.rint(np.where(usable, values, 0).astype(np.float64) / unit)
    saturated = int(np.count_nonzero(counts > FULL))
    # Clipped in float64: a cast of larger values to 16 bits would wrap around.
    coded = np.where(usable, np.clip(counts, 1, FULL), 0).astype(np.uint16)
    how = (cv2.IMWRITE_PNG_COMPRESSION, PNG_LEVEL, cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_UP)
    pixels = cv2.imencode(".png", coded, how)[1].tobytes()
    text, content = PngInfo(), io.BytesIO()
    entries = {"depth_scale": repr(float(unit)), "unit": "metres per count", **notes}
    for key, value in {**entries, "invalid": "0", "saturated": str(saturated)}.items():
        text.add_text(key, value)
    content.write(pixels[:_AFTER_HEADER])
    for chunk in text.chunks:
        putchunk(content, *chunk[:2])
    content.write(pixels[_AFTER_HEADER:])
    return content.getvalue(), saturated


def _float_map(value: Tensor, name: str) -> NDArray[np.float32]:
    if value.dim() != 2 or not value.is_floating_point():
        raise ValueError(f"{name} must be a floating-point map [H, W], got {value.dtype} {tuple(value.shape)}")
    return value.detach().cpu().numpy().astype(np.float32, copy=False)

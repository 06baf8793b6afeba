"""What ``ufmstar run`` leaves on disk: per frame an npz and two 16-bit PNGs, and summary.json.

```
OUT/frames/NAME.npz   depth [m], variance [m^2], disagreement [m^2] float32 and valid bool, each [H, W]; with
                      anchors also anchored [m^2] (B) and bias (r: depth (1 + r) is the depth corrected), with a
                      posterior also posterior_depth [m] and posterior_variance [m^2]
OUT/depth/NAME.png    depth, 16 bit, 0 = invalid; metres per count in the PNG's text
OUT/sigma/NAME.png    standard deviation, likewise
OUT/summary.json
```
Every file is complete or absent. Nothing here keeps more than one frame in memory.
"""

from __future__ import annotations

import io
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from ufmstar_torch.eval.results.files import write_atomic, write_json_atomic, write_together

# Metres per count that a run may choose from, finest first: up to 65.5 m, 256 m (KITTI's), 655 m, 6.6 km.
DEPTH_UNITS = (0.001, 1 / 256, 0.01, 0.1)
FULL = 65535
# zlib's level of the PNGs. Level 6 takes 3-5 times as long for 10 % less. One filter for all rows, the difference to
# the row above, takes six tenths of the time of a choice for every row, and the files are as large.
PNG_LEVEL = 1
_AFTER_HEADER = 33  # bytes: signature and IHDR


@dataclass(frozen=True)
class WrittenFrame:
    """What became of a frame.

    Attributes:
        depth_saturated: valid pixels beyond the depth PNG's range, stored as its largest value.
        sigma_saturated: the same for sigma.
    """

    depth_saturated: int
    sigma_saturated: int


class FrameWriter:
    """Writes frames so that a run can be stopped at any moment and continued.

    The PNG scale is one for the whole run, so that a program that reads it once is right for all
    frames. It is chosen from the first frame (see ``fitting_unit``), read back from the frames on disk
    when a run is continued, or given. Pixels beyond the range are counted, and exact in the npz.

    Args:
        out_dir: created if missing.
        depth_unit: metres per count of the depth PNG; None = chosen.
        sigma_unit: metres per count of the sigma PNG; None = a tenth of ``depth_unit``.

    Raises:
        ValueError: a unit is not positive.
        OSError: the folders cannot be made.
    """

    def __init__(
        self, out_dir: str | Path, *, depth_unit: float | None = None, sigma_unit: float | None = None
    ) -> None:
        for name, unit in (("depth_unit", depth_unit), ("sigma_unit", sigma_unit)):
            if unit is not None and not unit > 0:
                raise ValueError(f"{name} must be positive metres per count or None, got {unit}")
        self.out_dir = Path(out_dir)
        self.depth_unit, self.sigma_unit = depth_unit, sigma_unit
        for folder in ("frames", "depth", "sigma"):
            (self.out_dir / folder).mkdir(parents=True, exist_ok=True)

    def paths(self, name: str) -> dict[str, Path]:
        """The files of a frame by kind (depth, sigma, frames), in the order in which they are written.

        Raises:
            ValueError: the name is not usable as a file name.
        """
        if not name or name.startswith(".") or any(c in name for c in "/\\\0"):
            raise ValueError(f"name must be a plain file name without its ending, got {name!r}")
        kinds = {"depth": "png", "sigma": "png", "frames": "npz"}
        return {kind: self.out_dir / kind / f"{name}.{ending}" for kind, ending in kinds.items()}

    def finished(self, name: str) -> bool:
        """True if all files of the frame are there, and so complete."""
        return all(path.is_file() for path in self.paths(name).values())

    def finished_frames(self) -> list[str]:
        """The names of all finished frames, sorted."""
        names = sorted(path.stem for path in (self.out_dir / "frames").glob("[!.]*.npz"))
        return [name for name in names if self.finished(name)]

    def write(
        self,
        name: str,
        *,
        depth: Any,
        variance: Any,
        disagreement: Any,
        anchored: Any = None,
        bias: Any = None,
        posterior_depth: Any = None,
        posterior_variance: Any = None,
        valid: Any = None,
    ) -> WrittenFrame:
        """Write one frame; none of its files appears before all are written.

        Args:
            name: file name without its ending, unique in the run.
            depth: [H, W] [m], tensor or array.
            variance: [H, W] total variance [m^2].
            disagreement: [H, W] multiview disagreement [m^2].
            anchored: [H, W] what anchors add to the variance [m^2], or None.
            bias: [H, W] relative error that anchors lead to expect, or None.
            posterior_depth: [H, W] of the posterior [m], or None.
            posterior_variance: [H, W] likewise [m^2].
            valid: [H, W] bool, True where the pixel was used; None = where depth is finite and positive.

        Raises:
            ValueError: shapes disagree.
            OSError: the disk is full, say; earlier frames are untouched.
        """
        given = {
            "depth": depth, "variance": variance, "disagreement": disagreement, "anchored": anchored, "bias": bias,
            "posterior_depth": posterior_depth, "posterior_variance": posterior_variance,
        }  # fmt: skip
        maps: dict[str, NDArray[Any]] = {n: _float_map(x, n) for n, x in given.items() if x is not None}
        d, v = maps["depth"], maps["variance"]
        used = np.isfinite(d) & (d > 0) if valid is None else _array(valid)
        maps["valid"] = used
        for label, value in maps.items():
            if value.shape != d.shape:
                raise ValueError(f"{label} must have the depth's shape {d.shape}, got {value.shape}")
        if used.dtype != np.bool_:
            raise ValueError(f"valid must be a bool mask (True = use), got {used.dtype}")
        depth_unit, sigma_unit = self._units(d, used)
        paths = self.paths(name)
        sigma = np.sqrt(np.where(v >= 0, v, np.nan))
        depth_png, lost_d = encode_length_png(d, used, depth_unit, quantity="depth")
        sigma_png, lost_s = encode_length_png(sigma, used, sigma_unit, quantity="sigma")
        write_together(
            {
                paths["depth"]: lambda file: file.write(depth_png),
                paths["sigma"]: lambda file: file.write(sigma_png),
                # Not compressed: float noise shrinks by a quarter only and takes 40 times as long (224x224:
                # 0.65 MB in 0.6 ms against 0.50 MB in 27 ms).
                paths["frames"]: lambda file: np.savez(file, allow_pickle=False, **maps),
            }
        )
        return WrittenFrame(lost_d, lost_s)

    def write_summary(self, summary: Mapping[str, Any]) -> None:
        """Replace summary.json; the one before stays if that fails. See ``write_json_atomic``."""
        write_json_atomic(self.out_dir / "summary.json", summary)

    def _units(self, depth: NDArray[np.float32], valid: NDArray[np.bool_]) -> tuple[float, float]:
        """Metres per count of both PNGs, settled by the first frame of the run."""
        if self.depth_unit is None:
            done = self.finished_frames()
            self.depth_unit = read_scale(self.paths(done[0])["depth"]) if done else fitting_unit(depth[valid])
        if self.sigma_unit is None:
            self.sigma_unit = self.depth_unit / 10
        return self.depth_unit, self.sigma_unit


def read_frame(path: str | Path) -> dict[str, NDArray[Any]]:
    """The maps of a frame's npz: depth [m], variance [m^2], disagreement [m^2], valid, each [H, W]; with anchors
    also anchored [m^2] and bias, with a posterior its depth and variance."""
    with np.load(path, allow_pickle=False) as stored:
        return {name: stored[name] for name in stored.files}


def fitting_unit(depth: NDArray[Any]) -> float:
    """The finest of ``DEPTH_UNITS`` whose range is twice the 99th percentile of the depths [m].

    Twice, since later frames may look farther; a percentile, since a sky at 10 km would otherwise cost
    all resolution. Without a depth: the finest.
    """
    finite = depth[np.isfinite(depth)]
    far = 2 * float(np.percentile(finite, 99)) if finite.size else 0.0
    return next((unit for unit in DEPTH_UNITS if far <= FULL * unit), DEPTH_UNITS[-1])


def encode_length_png(
    values: NDArray[Any], valid: NDArray[np.bool_], unit: float, *, quantity: str
) -> tuple[bytes, int]:
    """Lengths as a 16-bit PNG with its scale as text.

    count = round(value / unit), 0 = invalid or not finite. A valid value below half a unit becomes 1,
    so that it is not taken for invalid; one beyond the range becomes 65535.
    Text keys: ``depth_scale`` = metres per count (also for sigma: it is a depth's), ``unit``,
    ``quantity``, ``invalid``, ``saturated`` = number of pixels beyond the range.

    Args:
        values: [H, W] [m].
        valid: [H, W] bool.
        unit: metres per count.
        quantity: "depth" or "sigma", a note for the reader.

    Returns:
        (the file's content, the number of saturated pixels).
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
    entries = {"depth_scale": repr(float(unit)), "unit": "metres per count", "quantity": quantity}
    for key, value in {**entries, "invalid": "0", "saturated": str(saturated)}.items():
        text.add_text(key, value)
    content.write(pixels[:_AFTER_HEADER])
    for chunk in text.chunks:
        putchunk(content, *chunk[:2])
    content.write(pixels[_AFTER_HEADER:])
    return content.getvalue(), saturated


def write_length_png(path: Path, values: NDArray[Any], valid: NDArray[np.bool_], unit: float, *, quantity: str) -> int:
    """``encode_length_png`` into a file, atomically; returns the number of saturated pixels."""
    content, saturated = encode_length_png(values, valid, unit, quantity=quantity)
    write_atomic(path, lambda file: file.write(content))
    return saturated


def read_depth_png(
    path: str | Path, *, metres_per_count: float | None = None
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Read a 16-bit PNG of lengths, the scale being that of its text.

    Args:
        path: a file from ``write_length_png``, or any 16-bit PNG if ``metres_per_count`` is given.
        metres_per_count: overrides the text.

    Returns:
        (values [H, W] [m], valid [H, W]); values are 0 where invalid.

    Raises:
        ValueError: the PNG is not 16 bit, or has no scale and none was given.
    """
    from PIL import Image

    scale = read_scale(path) if metres_per_count is None else metres_per_count
    with Image.open(path) as image:
        # Counts above 32767 survive as they are: nothing here passes through int16.
        counts = np.asarray(image)
    if counts.dtype != np.uint16:
        raise ValueError(f"path must be a 16-bit greyscale PNG, {path} holds {counts.dtype}")
    return (counts * np.float64(scale)).astype(np.float32), counts > 0


def read_scale(path: str | Path) -> float:
    """Metres per count from the PNG's text.

    Raises:
        ValueError: there is none.
    """
    from PIL import Image

    with Image.open(path) as image:
        text = image.info.get("depth_scale")
    if text is None:
        raise ValueError(f"{path} has no depth_scale in its PNG text; give metres_per_count")
    return float(text)


def _array(value: Any) -> NDArray[Any]:
    return value.detach().cpu().numpy() if isinstance(value, torch.Tensor) else np.asarray(value)


def _float_map(value: Any, name: str) -> NDArray[np.float32]:
    array = _array(value)
    if array.ndim != 2 or not np.issubdtype(array.dtype, np.floating):
        raise ValueError(f"{name} must be a floating-point map [H, W], got {array.dtype} {array.shape}")
    return array.astype(np.float32, copy=False)

"""Maps of a few frames for the pictures of a report.

They are written while a sequence is evaluated, below its folder::

    examples/FRAME.npz      image [h, w, 3] uint8, truth [h, w] float32 [m] (0 = none), K [3, 3] [px], index
    examples/FRAME@ROW.npz  depth [m], and if the row has them variance, aleatoric, epistemic, disagreement [m^2],
                            measured (share of the disagreement from two places) and posterior_outlier, each [h, w]
                            float32; also image, truth and K if the row's differ from the frame's
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ufmstar_torch.eval.engine.rows import RowResult
from ufmstar_torch.eval.engine.stream import FrameResult
from ufmstar_torch.eval.sequences.frame import Frame, Size
from ufmstar_torch.eval.sequences.ground_truth import resample_nearest
from ufmstar_torch.eval.sequences.intrinsics import scale_intrinsics
from ufmstar_torch.files.write import write_atomic

_EXAMPLES = 3  # frames, evenly spaced
_POINTS = 4  # along each side of a pixel, for the picture
_MAPS = ("depth", "variance", "aleatoric", "epistemic", "disagreement", "measured", "posterior_outlier")


class ExampleWriter:
    """Writes evenly spaced frames, of ``total``, to the "examples" in the ``folder`` of a sequence."""

    def __init__(self, folder: Path, total: int) -> None:
        self._folder = folder / "examples"
        self._due = [math.ceil((n + 0.5) / _EXAMPLES * total) for n in range(_EXAMPLES)]

    def add(self, result: FrameResult) -> None:
        """Store a frame that is due. If no row used the frame, the next one is stored instead. Raises OSError, see
        ``write_atomic``."""
        coming = [number for number in self._due if number > result.number + 1]
        if result.rows and result.frame is not None and len(coming) < len(self._due):
            self._due = coming
            self._write(result, result.frame)

    def _write(self, result: FrameResult, frame: Frame) -> None:
        scenes = {key: _scene(frame, row) for key, row in result.rows.items()}
        first = next(iter(scenes.values()))
        self._save(frame.name, {**first, "index": np.array(frame.index)})
        for key, row in result.rows.items():
            maps = {part: row.map(part) for part in _MAPS}
            arrays = {part: value.float().numpy() for part, value in maps.items() if value is not None}
            scene = scenes[key]
            same_camera = scene["truth"].shape == first["truth"].shape and np.array_equal(scene["K"], first["K"])
            self._save(f"{frame.name}@{key}", arrays if same_camera else {**arrays, **scene})

    def _save(self, name: str, arrays: Mapping[str, NDArray]) -> None:
        self._folder.mkdir(parents=True, exist_ok=True)
        write_atomic(self._folder / f"{name}.npz", lambda file: np.savez(file, allow_pickle=False, **arrays))


def _scene(frame: Frame, row: RowResult) -> dict[str, NDArray]:
    """The image and the ground truth at the pixels of a row's maps."""
    size, K = row.size, row.intrinsics
    truth = np.zeros(size, np.float32) if row.truth is None else row.truth
    image = np.zeros((*size, 3), np.uint8) if frame.image is None else _seen(frame.image, frame.intrinsics, K, size)
    return {"image": image, "truth": truth, "K": K}


def _seen(image: NDArray[np.uint8], K_image: NDArray, K: NDArray, size: Size) -> NDArray[np.uint8]:
    """[h, w, 3] an image resampled to a camera K with ``size`` (h, w): the mean of several points in every pixel."""
    fine = (_POINTS * size[0], _POINTS * size[1])
    points = resample_nearest(image, K_image, scale_intrinsics(K, size, fine), fine)
    blocks = points.reshape(size[0], _POINTS, size[1], _POINTS, 3)
    return np.rint(blocks.mean(axis=(1, 3))).astype(np.uint8)

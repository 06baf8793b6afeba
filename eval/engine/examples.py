"""Maps and mixtures of a few frames for the pictures of a report.

They are written while a sequence is evaluated, below its folder::

    examples/FRAME.npz      image [h, w, 3] uint8, truth [h, w] float32 [m] (0 = none), K [3, 3] [px], index
    examples/FRAME@ROW.npz  depth [m], and if the row has them variance, aleatoric, epistemic, disagreement [m^2] and
                            measured (share of the disagreement from two places), each [h, w] float32;
                            also image, truth and K if the row's differ from the frame's
    room/ROW_FRAME.npz      UfM*'s mixture after the frame in the world: mean_world [K, 3] [m], covariance_world
                            [K, 3, 3] [m^2], weight [K] [px], disagreement [K] [m^2], count [K]; T_world_cam
                            [4, 4]; path [n, 3], the camera's positions up to the frame [m]
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ufmstar_torch.eval.engine.estimators import Gaussians
from ufmstar_torch.eval.engine.rows import RowResult, RowRunner
from ufmstar_torch.eval.engine.stream import FrameResult
from ufmstar_torch.eval.sequences.frame import Frame, Size
from ufmstar_torch.eval.sequences.ground_truth import resample_nearest
from ufmstar_torch.eval.sequences.intrinsics import scale_intrinsics
from ufmstar_torch.files.write import write_atomic

# Shares of the frames after which the mixture is stored; it is stored again at the end.
ROOM_SHARES = (0.25, 0.5)
_EXAMPLES = 3  # frames, evenly spaced
_POINTS = 4  # along each side of a pixel, for the picture
_MAPS = ("depth", "variance", "aleatoric", "epistemic", "disagreement", "measured")


class ExampleWriter:
    """Writes examples of a sequence, and UfM*'s mixtures after a quarter, half and all of the frames.

    Args:
        folder: of the sequence, in which "examples" and "room" are created.
        total: number of frames.
        rows: that process them.
    """

    def __init__(self, folder: Path, total: int, rows: Sequence[RowRunner]) -> None:
        self._folder = folder
        self._frames = _moments([(n + 0.5) / _EXAMPLES for n in range(_EXAMPLES)], total)
        self._rooms = _moments(ROOM_SHARES, total)
        self._gaussians = {row.key: row.estimator for row in rows if isinstance(row.estimator, Gaussians)}
        self._paths: dict[str, list[NDArray[np.float64]]] = {}
        self._last: dict[str, tuple[str, NDArray[np.float64]]] = {}

    def add(self, result: FrameResult) -> None:
        """Store a frame that is due. If no row used the frame, the next one is stored instead. Raises OSError, see
        ``write_atomic``."""
        if not result.rows or result.frame is None:
            return
        for key in self._gaussians:
            if key in result.rows:
                self._last[key] = result.name, result.rows[key].T_world_cam
            if key in self._last:
                self._paths.setdefault(key, []).append(self._last[key][1][:3, 3].copy())
        if _due(self._frames, result.number + 1):
            self._write_frame(result, result.frame)
        if _due(self._rooms, result.number + 1):
            self._write_rooms()

    def end(self) -> None:
        """Store the last mixtures. Raises OSError, see ``write_atomic``."""
        self._write_rooms()

    def _write_frame(self, result: FrameResult, frame: Frame) -> None:
        folder = self._folder / "examples"
        scenes = {key: _scene(frame, row) for key, row in result.rows.items()}
        first = next(iter(scenes.values()))
        _write(folder / f"{frame.name}.npz", {**first, "index": np.array(frame.index)})
        for key, row in result.rows.items():
            maps = {part: row.map(part) for part in _MAPS}
            arrays = {part: value.float().numpy() for part, value in maps.items() if value is not None}
            scene = scenes[key]
            same_camera = scene["truth"].shape == first["truth"].shape and np.array_equal(scene["K"], first["K"])
            _write(folder / f"{frame.name}@{key}.npz", arrays if same_camera else {**arrays, **scene})

    def _write_rooms(self) -> None:
        for key, (name, T_world_cam) in self._last.items():
            arrays = {**_room(self._gaussians[key]), "T_world_cam": T_world_cam, "path": np.array(self._paths[key])}
            _write(self._folder / "room" / f"{key}_{name}.npz", arrays)


def _moments(shares: Iterable[float], total: int) -> list[int]:
    """Counts of frames at rising shares in (0, 1] of ``total``."""
    return [max(1, math.ceil(share * total)) for share in shares]


def _due(moments: list[int], done: int) -> bool:
    """True if one of ``moments`` is at most ``done`` frames; removes these moments from the list."""
    coming = [moment for moment in moments if moment > done]
    due = len(coming) < len(moments)
    moments[:] = coming
    return due


def _room(estimator: Gaussians) -> dict[str, NDArray]:
    """UfM*'s mixture in the world's frame."""
    world = estimator.mixture_world()
    named = {
        "mean_world": world.mean,
        "covariance_world": world.covariance,
        "weight": world.weight,
        "disagreement": world.disagreement,
        "views": world.views,
    }
    return {name: value[0][world.valid[0]].cpu().numpy() for name, value in named.items()}


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


def _write(path: Path, arrays: Mapping[str, NDArray]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomic(path, lambda file: np.savez(file, allow_pickle=False, **arrays))

"""Maps and mixtures of a few frames, from which the pictures of a report are drawn.

Written while a sequence is evaluated, below its folder::

    examples/FRAME.npz      image [h, w, 3] uint8, truth [h, w] float32 [m] (0 = none), K [3, 3] [px], index
    examples/FRAME@ROW.npz  depth [m], and where the row has them variance, aleatoric, epistemic, disagreement [m^2],
                            each [h, w] float32; image, truth and K too where the row's are others than the frame's
    room/ROW_FRAME.npz      UfM*'s mixture after the frame in the world: mean_world [K, 3] [m], covariance_world
                            [K, 3, 3] [m^2], weight [K] [px], disagreement [K] [m^2]; T_world_cam [4, 4]; path [n, 3]
                            where the camera has been until then [m]
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from ufmstar_torch.eval.engine.estimator import Estimate, Gaussians
from ufmstar_torch.eval.engine.row_run import RowRun
from ufmstar_torch.eval.methods.row import Row
from ufmstar_torch.eval.results.files import write_atomic
from ufmstar_torch.eval.sequences.frame import Frame, Size
from ufmstar_torch.eval.sequences.ground_truth import resample_nearest
from ufmstar_torch.eval.sequences.intrinsics import scale_intrinsics

# Of the frames, after which the mixture is kept; and again at the end.
ROOM_SHARES = (0.25, 0.5)
_POINTS = 4  # along each side of a pixel, for the picture
_MAPS = ("depth", "variance", "aleatoric", "epistemic", "disagreement")


@dataclass(frozen=True)
class Examples:
    """Where pictures are made from.

    Attributes:
        folder: of the sequence; "examples" and "room" are made within it.
        frames: how many, evenly spaced over the frames.
        room: whether to leave UfM*'s mixtures as well, after a quarter, half and all of the frames.

    Raises:
        ValueError: a negative number of frames.
    """

    folder: Path
    frames: int = 3
    room: bool = True

    def __post_init__(self) -> None:
        if self.frames < 0:
            raise ValueError(f"frames must be at least 0, got {self.frames}")


@dataclass(frozen=True, eq=False)
class FinishedFrame:
    """A frame that all rows have taken in.

    Attributes:
        frame: as it was read.
        estimates: by row.
        truths: ground truth at the rows' pixels, [h, w] float32 [m], 0 = none.
        intrinsics: [3, 3] float64 of the rows' maps [px].
    """

    frame: Frame
    estimates: Mapping[Row, Estimate]
    truths: Mapping[Row, NDArray[np.float32]]
    intrinsics: Mapping[Row, NDArray[np.float64]]


class ExampleWriter:
    """Writes what ``Examples`` asks for while a sequence is evaluated.

    Args:
        examples: where and what.
        total: number of frames to be judged.
    """

    def __init__(self, examples: Examples, total: int) -> None:
        self._examples = examples
        self._frames = _Schedule([(n + 0.5) / examples.frames for n in range(examples.frames)], total)
        self._rooms = _Schedule(ROOM_SHARES if examples.room else (), total)
        self._paths: dict[str, list[NDArray[np.float64]]] = {}

    def after(self, done: int, finished: FinishedFrame | None, runs: Sequence[RowRun]) -> None:
        """After each frame.

        Args:
            done: frames so far.
            finished: the last one; None if no row has taken it in.
            runs: all rows.

        Raises:
            OSError: see ``write_atomic``.
        """
        if finished is None:
            return
        for run in runs:
            if self._examples.room and isinstance(run.estimator, Gaussians) and run.last is not None:
                self._paths.setdefault(run.row.slug, []).append(np.asarray(run.last[1])[:3, 3].copy())
        if self._frames.due(done):
            self._write_frame(finished)
        if self._rooms.due(done):
            self._write_rooms(runs)

    def end(self, runs: Sequence[RowRun]) -> None:
        """After the last frame.

        Raises:
            OSError: see ``write_atomic``.
        """
        if self._examples.room:
            self._write_rooms(runs)

    def _write_frame(self, finished: FinishedFrame) -> None:
        folder = self._examples.folder / "examples"
        folder.mkdir(parents=True, exist_ok=True)
        name, scenes = finished.frame.name, {row: _scene(finished, row) for row in finished.estimates}
        first = next(iter(scenes.values()))
        _write(folder / f"{name}.npz", {**first, "index": np.array(finished.frame.index)})
        for row, estimate in finished.estimates.items():
            maps = {part: getattr(estimate, part) for part in _MAPS}
            arrays = {part: value.float().numpy() for part, value in maps.items() if value is not None}
            scene = scenes[row]
            alike = scene["truth"].shape == first["truth"].shape and np.array_equal(scene["K"], first["K"])
            _write(folder / f"{name}@{row.slug}.npz", arrays if alike else {**arrays, **scene})

    def _write_rooms(self, runs: Sequence[RowRun]) -> None:
        folder = self._examples.folder / "room"
        folder.mkdir(parents=True, exist_ok=True)
        for run in runs:
            if isinstance(run.estimator, Gaussians) and run.last is not None:
                name, T_world_cam = run.last
                path = np.array(self._paths[run.row.slug])
                arrays = {**_room(run.estimator), "T_world_cam": T_world_cam, "path": path}
                _write(folder / f"{run.row.slug}_{name}.npz", arrays)


class _Schedule:
    """When something is due: after some shares of the frames, or as soon after as there is a frame that can be used.

    Args:
        shares: in (0, 1], rising.
        total: number of frames.
    """

    def __init__(self, shares: Sequence[float], total: int) -> None:
        self._moments = [max(1, math.ceil(share * total)) for share in shares]

    def due(self, done: int) -> bool:
        """Whether something is due after ``done`` frames; every time once."""
        passed = [moment for moment in self._moments if moment <= done]
        self._moments = [moment for moment in self._moments if moment > done]
        return bool(passed)


def _room(estimator: Gaussians) -> dict[str, NDArray]:
    """UfM*'s mixture in the world's frame."""
    T = estimator.ufm.T_world_first.double()
    world = estimator.ufm.mixture.to(torch.float64).rigid(T[:, :3, :3], T[:, :3, 3])
    named = {
        "mean_world": world.mean,
        "covariance_world": world.covariance,
        "weight": world.weight,
        "disagreement": world.disagreement,
    }
    return {name: value[0][world.valid[0]].cpu().numpy() for name, value in named.items()}


def _scene(finished: FinishedFrame, row: Row) -> dict[str, NDArray]:
    """What was to be seen, at the pixels of a row's maps."""
    frame, truth, K = finished.frame, finished.truths[row], finished.intrinsics[row]
    size = (truth.shape[0], truth.shape[1])
    image = np.zeros((*size, 3), np.uint8) if frame.image is None else _seen(frame.image, frame.intrinsics, K, size)
    return {"image": image, "truth": truth, "K": K}


def _seen(image: NDArray[np.uint8], K_image: NDArray, K: NDArray, size: Size) -> NDArray[np.uint8]:
    """[h, w, 3] an image as a camera K with ``size`` (h, w) sees it: in every pixel the mean of several points."""
    fine = (_POINTS * size[0], _POINTS * size[1])
    points = resample_nearest(image, K_image, scale_intrinsics(K, size, fine), fine)
    blocks = points.reshape(size[0], _POINTS, size[1], _POINTS, 3)
    return np.rint(blocks.mean(axis=(1, 3))).astype(np.uint8)


def _write(path: Path, arrays: Mapping[str, NDArray]) -> None:
    write_atomic(path, lambda file: np.savez(file, allow_pickle=False, **arrays))

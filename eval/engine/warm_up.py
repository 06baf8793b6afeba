"""Compiles the kernels that a command needs before its first frame (``ufmstar_torch.warm_up``)."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ufmstar_torch.anchors.dense import DenseEvidence
from ufmstar_torch.config import UfMStarConfig
from ufmstar_torch.eval.engine.progress import Progress
from ufmstar_torch.ufmstar import UfMStar
from ufmstar_torch.warm_up import warm_up

_WALL, _FOCAL = (96, 128), 100.0  # [px] of the images of a wall
_STEP, _FRAMES = 4, 8  # motion of the wall [px per frame], and number of frames


def warm_up_command(config: UfMStarConfig, show: Callable[[Progress], object], *, dense: bool = False) -> None:
    """Compile UfM* and, if ``dense``, the search of :class:`DenseEvidence`, or load them from disk."""
    also, ufm = [dense_anchors] if dense else [], UfMStar(config)
    warm_up(ufm, (32, 32), 1, lambda done, total: show(Progress("kernels", done, total)), also)


def dense_anchors() -> None:
    """Run the depth search of :class:`DenseEvidence` on images of a textured wall along which the camera moves."""
    height, width = _WALL
    wall = np.random.default_rng(0).integers(0, 256, (height, width + _STEP * _FRAMES, 3), dtype=np.uint8)
    evidence, K = DenseEvidence(), np.array([[_FOCAL, 0, width / 2], [0, _FOCAL, height / 2], [0, 0, 1]])
    for frame in range(_FRAMES):
        T_world_cam = np.eye(4)
        T_world_cam[0, 3] = frame * _STEP / _FOCAL * evidence.config.start_depth
        evidence.update(wall[:, frame * _STEP : frame * _STEP + width].copy(), T_world_cam, K)

"""Two frames of a wall, so that no frame of a user's waits for a compiler."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from typing import TYPE_CHECKING

import torch

from ufmstar_torch.anchors.hook import Anchors
from ufmstar_torch.kernels.select import compile_triangulation

if TYPE_CHECKING:
    from ufmstar_torch.ufmstar import UfMStar

_DISTANCE = 2.0  # [m]
_TOTAL = 3 * 7  # stages of a step, for two frames and an image average


class _Stages:
    """Counts the stages of the frames (``ufmstar_torch.step.StepObserver``), at whose first a stage compiles."""

    def __init__(self, progress: Callable[[int, int], object]) -> None:
        self._progress, self._done = progress, 0

    def stage(self, name: str) -> None:
        """One more is done; at most ``_TOTAL`` are reported, whatever a step counts as a stage."""
        self._done += 1
        self._progress(min(self._done, _TOTAL), _TOTAL)

    def kernel(self, name: str) -> AbstractContextManager[object]:
        """Nothing is counted within a stage."""
        return nullcontext()


def warm_up(
    module: UfMStar, size: tuple[int, int], streams: int, progress: Callable[[int, int], object] | None = None
) -> None:
    """Take a module through two frames of ``size`` (H, W) and an image average; see ``UfMStar.warm_up``.

    Raises:
        ValueError: a size or number of streams that is not positive.
    """
    height, width = size
    if min(height, width, streams) < 1:
        raise ValueError(f"size and streams must be positive, got {size} and {streams}")
    config, device = module.config, module.mean.device
    if progress is not None:
        progress(0, _TOTAL)
        module.observer = _Stages(progress)
    distance = min(_DISTANCE, config.segment.depth_limit)
    depth = torch.full((streams, height, width), distance, device=device)
    pose = torch.eye(4)
    K = torch.tensor([[float(width), 0, width / 2], [0, float(width), height / 2], [0, 0, 1]])
    features = depth.new_zeros(streams, config.features, height, width) if config.features else None
    corner = depth[:, 0, :1]
    anchors = None
    if config.anchored:
        anchors = Anchors(torch.zeros(streams, 1, 2, device=device), corner, 1e-4 * corner)
        compile_triangulation()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # a small image has no segment
        for _ in range(2):  # the fusion meets a mixture from the second on
            module(depth, pose, K, features=features, anchors=anchors)
        module.mean_uncertainty(depth, pose, K, features=features, pixels=1)

"""Two frames of a wall, so that no frame of a user's waits for a compiler."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import Any, Protocol

import numpy as np
import torch

from ufmstar_torch.anchors.given import Anchors
from ufmstar_torch.config import UfMStarConfig
from ufmstar_torch.kernels.select import compile_triangulation, select_beside
from ufmstar_torch.mixture import GaussianMixture

_DISTANCE = 2.0  # [m]
_TOTAL = 3 * 7  # stages of a step, for two frames and an image average


_REGRESSION = "append"  # the stage before it


class Module(Protocol):
    """A ``UfMStar``."""

    config: UfMStarConfig
    observer: Any

    @property
    def mean(self) -> torch.Tensor:
        """Of the mixture [B, K, 3]."""
        ...

    def __call__(self, *frame: Any, **options: Any) -> Any:
        """Process a frame."""
        ...

    def mean_uncertainty(self, *frame: Any, **options: Any) -> Any:
        """Process a frame and average its variance."""
        ...


class _Stages:
    """Counts the stages of the frames (``ufmstar_torch.step_parts.StepObserver``), at whose first a stage compiles.

    Args:
        progress: see :func:`warm_up`.
        total: steps to report at most, whatever a step counts as a stage.
        before_regression: called before every regression.
    """

    def __init__(
        self, progress: Callable[[int, int], object], total: int, before_regression: Callable[[], object]
    ) -> None:
        self._progress, self._total, self._before_regression = progress, total, before_regression
        self._done = -1
        self.step()

    def step(self) -> None:
        """One more is done."""
        self._done += 1
        self._progress(min(self._done, self._total), self._total)

    def stage(self, name: str) -> None:
        """A stage has ended."""
        self.step()
        if name == _REGRESSION:
            self._before_regression()

    def kernel(self, name: str) -> AbstractContextManager[object]:
        """Nothing is counted within a stage."""
        return nullcontext()


def warm_up(
    module: Module,
    size: tuple[int, int],
    streams: int,
    progress: Callable[[int, int], object] | None = None,
    also: Sequence[Callable[[], object]] = (),
) -> None:
    """Take a module through two frames of ``size`` (H, W) and an image average; see ``UfMStar.warm_up``.

    On a machine's very first call the description of the segments, the regression, the image average and ``also`` are
    compiled in a process beside this one, where there are two cores.

    Args:
        module: without frames so far; it is changed.
        size, streams, progress: see there.
        also: functions of modules, which call further kernels that the caller will need.

    Raises:
        ValueError: a size or number of streams that is not positive.
    """
    height, width = size
    if min(height, width, streams) < 1:
        raise ValueError(f"size and streams must be positive, got {size} and {streams}")
    config, device = module.config, module.mean.device
    distance = min(_DISTANCE, config.segment.depth_limit)
    depth = torch.full((streams, height, width), distance, device=device)
    pose = torch.eye(4)
    K = _camera(height, width)
    features = depth.new_zeros(streams, config.features, height, width) if config.features else None
    corner = depth[:, 0, :1]
    anchors = None
    if config.anchors is not None:
        anchors = Anchors(torch.zeros(streams, 1, 2, device=device), corner, 1e-4 * corner)
    jobs: list[tuple[str, str, dict[str, Any]]] = [
        (__name__, "description", {}),  # first: this process needs it soonest
        (__name__, "regression", {"kind": config.regression}),
        (__name__, "sampling", {}),
    ]
    jobs += [(function.__module__, function.__qualname__, {}) for function in also]
    with warnings.catch_warnings(), select_beside(config.backend, device.type, jobs) as wait:
        warnings.simplefilter("ignore", UserWarning)  # a small image has no segment
        stages = _Stages(progress or _unseen, _TOTAL + len(also), wait)
        module.observer = stages
        for _ in range(2):  # the fusion meets a mixture from the second on
            module(depth, pose, K, features=features, **({} if anchors is None else {"anchors": anchors}))
        module.mean_uncertainty(depth, pose, K, features=features, pixels=1)
        if config.anchors is not None:
            compile_triangulation()
        for function in also:
            function()
            stages.step()


def description() -> None:
    """Compile what turns segments of single-precision maps into Gaussians, on the CPU."""
    from ufmstar_torch.kernels.stream_cpu import describe

    none, index = np.empty(0), np.empty(0, np.int64)
    rounded = np.empty((0, 3), np.float32), np.empty((0, 3, 3), np.float32), np.empty(0, np.float32)
    segments = index, np.empty((0, 1)), index[:, None]
    describe(segments, rounded, 1.0, 1.0, 1.0, 1.0, np.empty((0, 3)), np.empty((0, 3, 3)), none, index)


def regression(kind: str) -> None:
    """Compile the regression of single-precision maps, and at some pixels, on the CPU; ``kind`` as
    ``config.regression``."""
    from ufmstar_torch.kernels.regress_cpu import regress_image

    mixture = GaussianMixture.empty(1, 1, dtype=torch.float64, device="cpu")
    depth = torch.full((1, 8, 8), _DISTANCE)
    for pixels in (None, torch.zeros(1, 1, dtype=torch.int64)):
        regress_image(mixture, depth, _camera(8, 8)[None], depth > 0, UfMStarConfig(regression=kind), pixels)


def sampling() -> None:
    """Compile the average over a sample of pixels of single-precision maps, on the CPU."""
    from ufmstar_torch.kernels.sample_cpu import sample_mean, sample_pixels

    valid = torch.ones(1, 8, 8, dtype=torch.bool)
    _, used = sample_pixels(valid, 1, 0)
    sample_mean(torch.zeros(1, 1), used, used, valid.sum((1, 2)))


def _camera(height: int, width: int) -> torch.Tensor:
    return torch.tensor([[float(width), 0, width / 2], [0, float(width), height / 2], [0, 0, 1]])


def _unseen(done: int, total: int) -> None:
    """Nobody follows the progress."""

"""Compile all kernels by running two synthetic frames."""

from __future__ import annotations

import gc
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, Protocol

import torch

from ufmstar_torch.anchors.anchors import Anchors
from ufmstar_torch.config import UfMStarConfig
from ufmstar_torch.kernels.select import compile_triangulation

_DISTANCE = 2.0  # [m]
_TOTAL = 3 * 7  # stages of a step, for two frames and an image average


class Module(Protocol):
    """A ``UfMStar``."""

    config: UfMStarConfig
    observer: Any

    @property
    def mean(self) -> torch.Tensor:
        """The mixture's means [B, K, 3]."""
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
    """

    def __init__(self, progress: Callable[[int, int], object], total: int) -> None:
        self._progress, self._total = progress, total
        self._done = -1
        self.step()

    def step(self) -> None:
        """Report one more step."""
        self._done += 1
        self._progress(min(self._done, self._total), self._total)

    def stage(self, name: str) -> None:
        """A stage has ended."""
        self.step()


def warm_up(
    module: Module,
    size: tuple[int, int],
    streams: int,
    progress: Callable[[int, int], object] | None = None,
    also: Sequence[Callable[[], object]] = (),
) -> None:
    """Take a module through two frames of ``size`` (H, W) and an image average; see ``UfMStar.warm_up``.

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
    aleatoric = depth if config.aleatoric_in_h else None
    corner = depth[:, 0, :1]
    anchors = None
    if config.anchors is not None:
        anchors = Anchors(torch.zeros(streams, 1, 2, device=device), corner, 1e-4 * corner)
    with warnings.catch_warnings(), _no_collection():
        warnings.simplefilter("ignore", UserWarning)  # a small image has no segment
        stages = _Stages(progress or _unseen, _TOTAL + len(also))
        module.observer = stages
        for _ in range(2):  # the fusion meets a mixture from the second on
            module(depth, pose, K, aleatoric, features=features, **({} if anchors is None else {"anchors": anchors}))
        module.mean_uncertainty(depth, pose, K, aleatoric, features=features, pixels=1)
        if config.anchors is not None:
            compile_triangulation()
        for function in also:
            function()
            stages.step()


@contextmanager
def _no_collection() -> Iterator[None]:
    """Collect no garbage, which takes a tenth of a compilation's time; then all of it, or a later frame would wait half
    a second for that."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()
            gc.collect()


def _camera(height: int, width: int) -> torch.Tensor:
    return torch.tensor([[float(width), 0, width / 2], [0, float(width), height / 2], [0, 0, 1]])


def _unseen(done: int, total: int) -> None:
    """Nobody follows the progress."""

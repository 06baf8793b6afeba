"""Compile all kernels by running two synthetic frames. A second process compiles those of the search for anchors."""

from __future__ import annotations

import gc
import os
import subprocess
import sys
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ufmstar_torch.anchors.anchors import Anchors
from ufmstar_torch.anchors.dense import DenseEvidence
from ufmstar_torch.anchors.kernels.bundle import refine
from ufmstar_torch.anchors.tracker import LandmarkTracker
from ufmstar_torch.frames.arguments import require_size, require_whole
from ufmstar_torch.gaussians.camera import camera_of
from ufmstar_torch.kernels.compile_cpu import on_disk

_DISTANCE = 2.0  # [m]
_WALL, _SQUARE = (96, 128), 4  # [px] images of a wall, and its squares, by one of which the camera moves
_FRAMES = 8  # of the wall
_TOTAL = 3 * 7  # stages of a step, for two frames and an image average
Source = LandmarkTracker | DenseEvidence
# Program of the second process. It has this one's search path for modules and does not run the main file again.
_SECOND = """import sys; sys.path[:] = {path}
from ufmstar_torch.runtime import warm_up as w
for kind in ({kinds}): w.along_wall(kind())"""


class _Stages:
    """Reports the stages of a step (``ufmstar_torch.steps.step.StepObserver``) to ``progress``, as in
    :func:`warm_up`, with their ``total`` number."""

    def __init__(self, progress: Callable[[int, int], object] | None, total: int) -> None:
        self._progress, self._total, self._done = progress, total, -1
        self.stage("")

    def stage(self, name: str) -> None:
        """Report another completed stage, at most ``total``."""
        self._done += 1
        if self._progress is not None:
            self._progress(min(self._done, self._total), self._total)


def warm_up(
    module: Any,
    size: tuple[int, int],
    streams: int,
    progress: Callable[[int, int], object] | None = None,
    sources: Sequence[type[Source]] = (),
) -> None:
    """Run a module on two frames of ``size`` (H, W) and an image average; see ``UfMStar.warm_up``.

    Args:
        module: a ``UfMStar`` before its first frame; its state changes.
        size, streams, progress: see ``UfMStar.warm_up``.
        sources: of landmarks, whose kernels are compiled, too.

    Raises:
        ValueError: a size or number of streams that is not positive.
    """
    require_size("size", size)
    require_whole("streams", streams, 1)
    if progress is not None and not callable(progress):
        raise TypeError(f"progress must be a function of two numbers or None, got {type(progress).__name__}")
    height, width = size
    config, device = module.config, module.mean.device
    distance = min(_DISTANCE, config.segment.depth_limit)
    depth = torch.full((streams, height, width), distance, device=device)
    pose = torch.eye(4)
    K = camera_of(size)
    aleatoric = depth if config.variances_in_h else None
    corner = depth[:, 0, :1]
    anchors = None
    if config.anchors is not None:
        anchors = Anchors(torch.zeros(streams, 1, 2, device=device), corner, 1e-4 * corner)
    with warnings.catch_warnings(), _no_collection(), _second_process(sources) as finish:
        warnings.simplefilter("ignore", UserWarning)  # a small image has no segment
        stages = _Stages(progress, _TOTAL + len(sources))
        module.observer = stages
        for _ in range(2):  # the fusion needs a mixture, from the second frame on
            module(depth, pose, K, aleatoric, **({} if anchors is None else {"anchors": anchors}))
        module.mean_uncertainty(depth, pose, K, aleatoric, pixels=1)
        finish()
        for kind in sources:
            along_wall(kind())
            stages.stage("")


def along_wall(evidence: Source) -> None:
    """Compile the kernels of a new source of landmarks: run it on a camera's way along a textured wall."""
    height, width = _WALL
    squares = np.random.default_rng(0).integers(0, 256, (height // _SQUARE, width // _SQUARE + _FRAMES, 3), np.uint8)
    wall, K = squares.repeat(_SQUARE, 0).repeat(_SQUARE, 1), camera_of(_WALL).double().numpy()
    for frame in range(_FRAMES):
        T_world_cam = np.eye(4)
        T_world_cam[0, 3] = frame * _SQUARE / width * evidence.config.start_depth
        evidence.update(wall[:, frame * _SQUARE :][:, :width].copy(), T_world_cam, K)


@contextmanager
def _second_process(sources: Sequence[type[Source]]) -> Iterator[Callable[[], None]]:
    """Compile the kernels of sources of landmarks in a second process while this one compiles others, unless they are
    on disk or there is one core. Yields a function that waits for the second process, at most as long as it has run.
    After that this process loads the kernels. It compiles those that the second process has not compiled."""
    process, started = None, time.monotonic()
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    # A frozen program, or one with Python inside, has no interpreter to start.
    python = Path(sys.executable or "").stem.startswith("python") and not hasattr(sys, "frozen")
    if sources and cores > 1 and python and not on_disk(refine):
        code = _SECOND.format(path=sys.path, kinds="".join(f"w.{kind.__name__}, " for kind in sources))
        nothing = subprocess.DEVNULL
        with suppress(OSError):  # without a second process, this one compiles all kernels
            process = subprocess.Popen([sys.executable, "-c", code], stdin=nothing, stdout=nothing, stderr=nothing)

    def finish() -> None:
        if process is not None:
            with suppress(subprocess.TimeoutExpired):
                process.wait(time.monotonic() - started)
            process.kill()

    try:
        yield finish
    finally:
        if process is not None:
            process.kill()
            process.wait()


@contextmanager
def _no_collection() -> Iterator[None]:
    """Disable garbage collection, which takes a tenth of a compilation's time. Afterwards collect what was made
    meanwhile, 3 million objects after a compilation, before a frame has to; older objects would take .2 s more."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()
            gc.collect(1)

"""Compares the depth of a stream with that of corners tracked in its images, for commands that store no frames."""

from __future__ import annotations

import numpy as np

from ufmstar_torch.eval.check.image_fit import DepthFit, depth_at_pixels, depth_fit
from ufmstar_torch.eval.engine.judge import UFM
from ufmstar_torch.eval.engine.stream import FrameResult
from ufmstar_torch.eval.run.job import RunJob


class DepthCheck:
    """Keeps the depth maps of the few frames in which tracked corners of a job begin."""

    def __init__(self, job: RunJob) -> None:
        self._job, self._first = job, {one.first for one in job.corners}
        self._maps: dict[int, tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]] = {}

    def add(self, result: FrameResult) -> None:
        """Keep the depth map if corners begin in this frame."""
        row = result.rows.get(UFM)
        if row is not None and result.frame is not None and result.index in self._first:
            depth, valid = row.prediction.depth[0].numpy(), row.valid.numpy()
            self._maps[result.index] = depth, valid, row.intrinsics, result.frame.intrinsics

    def fit(self) -> DepthFit | None:
        """Compare; None if the motion is too small, or if the poses contradict the images."""
        if self._job.image_fit is None or self._job.image_fit.problem:
            return None

        def depth_at(index: int, pixel: np.ndarray) -> np.ndarray | None:
            return depth_at_pixels(*self._maps[index], pixel) if index in self._maps else None

        return depth_fit(self._job.sequence, self._job.corners, depth_at)

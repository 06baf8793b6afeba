"""One row in the middle of a sequence: which frames it uses, at which poses, and what it makes of them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ufmstar_torch.eval.engine.anchors import AnchorSource, FrameAnchors
from ufmstar_torch.eval.engine.clock import StageTimer
from ufmstar_torch.eval.engine.estimators import Estimate, Estimator
from ufmstar_torch.eval.engine.predictions import DepthSource, Prediction
from ufmstar_torch.eval.methods.perturb import Drift, perturbed
from ufmstar_torch.eval.methods.setting import DEFAULT, Setting
from ufmstar_torch.eval.sequences.frame import Frame, FrameError
from ufmstar_torch.frame import FRAME_FAULTS

# Prefixes of the tensors of a row's state, as files of ``ufmstar run`` have them since its first version.
_IMAGES, _ESTIMATOR, _TRACKER, _DRIFT = "image_index", "ufm.", "tracker.", "drift."


@dataclass(frozen=True, eq=False)
class RowFrame:
    """A frame as a row sees it, and its estimate."""

    prediction: Prediction  # the depth map, on the estimator's device
    # [h, w] ground truth at the prediction's pixels [m], 0 = none; None without a depth map.
    truth: NDArray[np.float32] | None
    T_world_cam: NDArray[np.float64]  # [4, 4] the pose as the row sees it [m]
    member: int | None  # which network predicted; None where all did, and of maps
    anchors: FrameAnchors | None  # of the frame; None of a row without anchors
    ms: dict[str, float]  # "network" where one ran, "anchors" where some were tracked, and "uncertainty" [ms]
    estimate: Estimate  # what the row makes of the frame, on the CPU


class RowRunner:
    """A row in the middle of a sequence.

    Args:
        key: its name, unique in its stream.
        source: of its depth.
        estimator: of its variance, in its initial state.
        every: all members (or samples) predict on every image, instead of one in turn.
        setting: which images it leaves out, and how poses and anchors are disturbed.
        anchors: None = it has none.
        skips_faults: the estimator decides by its own config whether pose and intrinsics can be used. A frame that it
            refuses is skipped, and counts as an image for the turns all the same.
        device: of the estimator, whose work is timed.

    Attributes:
        images: that the estimator was given so far.
    """

    def __init__(
        self,
        key: str,
        source: DepthSource,
        estimator: Estimator,
        *,
        every: bool = False,
        setting: Setting = DEFAULT,
        anchors: AnchorSource | None = None,
        skips_faults: bool = False,
        device: torch.device | None = None,
    ) -> None:
        self.key, self.source, self.estimator, self.every, self.setting = key, source, estimator, every, setting
        self.anchors, self._skips_faults = anchors, skips_faults
        self._tracks = None if anchors is None else anchors.tracks
        self.images = 0
        self._timer = StageTimer(device or torch.device("cpu"))
        self._drift = Drift(setting)

    def update(self, frame: Frame, prediction: Prediction, truth: NDArray[np.float32] | None) -> RowFrame:
        """Process the next frame. Its ground truth [h, w] is only for anchors that are drawn from it.

        Raises:
            FrameError: the estimator refuses the pose or the intrinsics, and the row skips such frames.
            RuntimeError, ValueError: as the estimator.
        """
        T = perturbed(self._drift.of(frame.T_world_cam, frame.index), self.setting, frame.index)
        anchors = None if self.anchors is None else self.anchors.of(frame, T, prediction, truth)
        member = self.source.turn(self.images) if self.source.networks and not self.every else None
        with self._timer.stage("uncertainty"):
            found = None if anchors is None else anchors.anchors
            estimate = self.estimator.update(prediction, torch.from_numpy(T), found)
        times = {"network": prediction.ms, "anchors": None if anchors is None else anchors.ms, **self._timer.take()}
        ms = {stage: time for stage, time in times.items() if time is not None}
        self.images += 1
        fault = 0 if estimate.statistics is None else int(estimate.statistics.fault[0])
        if self._skips_faults and fault:
            if self._tracks is not None:
                self._tracks.undo()
            raise FrameError(frame.name, FRAME_FAULTS[fault])
        return RowFrame(prediction, truth, T, member, anchors, ms, estimate)

    def state(self) -> dict[str, Tensor]:
        """All tensors on which the next frame depends, networks left aside: they remember nothing."""
        anchors = {} if self._tracks is None else self._tracks.state()
        parts = ((_ESTIMATOR, self.estimator.state()), (_TRACKER, anchors), (_DRIFT, self._drift.state()))
        kept = {prefix + name: value for prefix, state in parts for name, value in state.items()}
        return {_IMAGES: torch.tensor(self.images), **kept}

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        """Continue where ``state`` was taken. Raises ValueError: it is the state of another kind of row."""

        def part(prefix: str) -> dict[str, Tensor]:
            return {name.removeprefix(prefix): value for name, value in state.items() if name.startswith(prefix)}

        self.images = int(state[_IMAGES])
        self.estimator.load_state(part(_ESTIMATOR))
        if self._tracks is not None:
            self._tracks.load_state(part(_TRACKER))
        self._drift.load_state(part(_DRIFT))

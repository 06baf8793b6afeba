"""One row on a sequence: its poses, its anchors, its estimator, and the result for each frame."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ufmstar_torch.anchors.landmarks import Landmarks
from ufmstar_torch.eval.engine.anchors import AnchorSource
from ufmstar_torch.eval.engine.estimators import Estimator
from ufmstar_torch.eval.engine.predictions import DepthSource
from ufmstar_torch.eval.engine.progress import timed
from ufmstar_torch.eval.methods.perturb import Drift, perturbed
from ufmstar_torch.eval.methods.setting import DEFAULT, Setting
from ufmstar_torch.eval.sequences.frame import Frame
from ufmstar_torch.eval.sequences.ground_truth import moving_at
from ufmstar_torch.frames.output import UncertaintyOutput
from ufmstar_torch.frames.prediction import DepthPrediction


@dataclass(frozen=True, eq=False, kw_only=True)
class RowResult:
    """One row's result for a frame, on the CPU."""

    out: UncertaintyOutput  # maps [1, h, w] of the method, with the network's prediction
    states_variance: bool  # False if the variance is NaN because the network predicts depth alone
    # [h, w] ground truth at the maps' pixels [m], 0 = none; None without a depth map, or if it serves as anchors
    truth: NDArray[np.float32] | None
    moving: NDArray[np.bool_] | None = None  # [h, w] True on things that move; None = unknown
    T_world_cam: NDArray[np.float64]  # [4, 4] the row's pose, with noise [m]
    landmarks: Landmarks | None  # from which the frame's anchors were made; None for a row without anchors
    ms: Mapping[str, float]  # "network" if one ran, "anchors" if some were tracked, and "uncertainty" [ms]

    def map(self, name: str) -> Tensor | None:
        """[h, w] a map of ``ufmstar_torch.frames.output.MAPS``; None if the method does not compute it."""
        if name == "variance" and not self.states_variance:
            return None
        value: Tensor | None = getattr(self.out, name)
        return None if value is None else value[0]

    @property
    def depth(self) -> Tensor:
        """[h, w] the method's depth [m]."""
        return self.out.depth[0]

    @property
    def variance(self) -> Tensor | None:
        """[h, w] of that depth [m^2], NaN where not valid; None if the method states none."""
        return self.map("variance")

    @property
    def valid(self) -> Tensor:
        """[h, w] bool, True where the depth is positive and finite and every variance that is used is valid."""
        return self.out.valid[0]

    @property
    def prediction(self) -> DepthPrediction:
        """The network's."""
        assert self.out.prediction is not None
        return self.out.prediction

    @property
    def network_variance(self) -> Tensor | None:
        """[h, w] A + E of the prediction, even if the row ignores them [m^2]; None without both."""
        variance = self.prediction.variance
        return None if variance is None else variance[0]

    @property
    def intrinsics(self) -> NDArray[np.float64]:
        """[3, 3] of the maps [px]."""
        return self.prediction.K[0].numpy()

    @property
    def corrected(self) -> bool:
        """True if depth and variance are a posterior's."""
        return "posterior_outlier" in self.out.maps

    @property
    def mixture(self) -> tuple[Tensor, Tensor] | None:
        """The posterior's variance of inliers [m^2] and probability of an outlier, or None."""
        inlier_variance, outlier = self.map("posterior_inlier_variance"), self.map("posterior_outlier")
        return None if inlier_variance is None or outlier is None else (inlier_variance, outlier)

    @property
    def parts(self) -> dict[str, Tensor]:
        """[h, w] bool masks of what moves and what stands still, by name; {} where this is unknown."""
        if self.moving is None:
            return {}
        moving = torch.from_numpy(self.moving)
        return {"moving": moving, "still": ~moving}

    @cached_property
    def level(self) -> Tensor | None:
        """[h, w] level of the smallest central interval with the ground truth in it, NaN without one; None without
        ground truth or intervals."""
        if self.truth is None or not self.out.has_intervals:
            return None
        truth = torch.from_numpy(self.truth)[None]
        level = self.out.distribution().central_level(truth.double())[0]
        return torch.where(truth[0] > 0, level, torch.nan)

    @property
    def size(self) -> tuple[int, int]:
        """(h, w)."""
        return self.prediction.size

    @cached_property
    def confident(self) -> Tensor:
        """[h, w] bool, True where there is ground truth and the variance is at or below the frame's median."""
        assert self.variance is not None
        assert self.truth is not None
        judged = self.valid & torch.from_numpy(self.truth > 0)
        if not judged.any():
            return judged
        return judged & (torch.where(judged, self.variance, torch.inf) <= self.variance[judged].median())


class RowRunner:
    """A row on a sequence; ``images`` is the number of images that its estimator has processed.

    Args:
        key: unique name in its stream.
        source: of its depth.
        estimator: of its variance, in its initial state.
        every: True if all members (or samples) predict on every image, instead of alternating.
        setting: skipped images, noise on poses and anchors.
        anchors: their source; None = no anchors.
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
    ) -> None:
        self.key, self.source, self.estimator, self.every, self.setting = key, source, estimator, every, setting
        self.anchors = anchors
        self.images = 0
        self._drift = Drift(setting) if setting.pose_noise else None

    def selects(self, number: int) -> bool:
        """True if the row uses image ``number`` of the stream, from 0; it skips ``setting.skip`` after each of them."""
        return number % (self.setting.skip + 1) == 0

    def update(self, frame: Frame, prediction: DepthPrediction, truth: NDArray[np.float32] | None) -> RowResult:
        """Process the next frame. Ground truth [h, w] is used for anchors alone."""
        T = frame.T_world_cam
        if self._drift is not None:
            T = perturbed(self._drift.of(T, frame.index), self.setting, frame.index)
        landmarks, anchors, tracking_ms = (
            (None, None, None) if self.anchors is None else self.anchors.of(frame, T, prediction, truth, self.setting)
        )
        member = self.source.turn(self.images) if self.source.networks and not self.every else None
        ms = {"network": prediction.ms, "anchors": tracking_ms}
        times = {stage: time for stage, time in ms.items() if time is not None}
        with timed(times, "uncertainty", prediction.depth.device):
            out = on_cpu(self.estimator.update(prediction, torch.from_numpy(T), anchors))
        self.images += 1
        prediction = prediction.to(out.depth.device)
        return RowResult(
            out=replace(out, prediction=prediction, member=member),
            states_variance=self.estimator.states_variance(prediction),
            truth=None if self.anchors is not None and self.anchors.sensor else truth,
            moving=moving_at(frame, prediction.K[0].numpy(), prediction.size),
            T_world_cam=T,
            landmarks=landmarks,
            ms=times,
        )

    def memory(self) -> dict[str, float]:
        """``Estimator.memory``, with the bytes of the anchors' tracks or evidence."""
        memory = self.estimator.memory()
        if self.anchors is not None:
            memory["bytes"] += self.anchors.bytes
        return memory


def on_cpu(out: UncertaintyOutput) -> UncertaintyOutput:
    """The output with its maps and quantiles on the CPU."""
    if out.depth.device.type == "cpu":
        return out
    maps = {name: value.cpu() for name, value in out.maps.items()}
    quantiles = None if out.quantiles is None else out.quantiles.cpu()
    depth, variance, valid = out.depth.cpu(), out.variance.cpu(), out.valid.cpu()
    return replace(out, depth=depth, variance=variance, valid=valid, maps=maps, quantiles=quantiles)

"""One row on a sequence: its poses, its anchors, its estimator, and the result for each frame."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ufmstar_torch.anchors.landmarks import Landmarks
from ufmstar_torch.eval.engine.anchors import AnchorSource
from ufmstar_torch.eval.engine.clock import timed
from ufmstar_torch.eval.engine.estimators import Estimator
from ufmstar_torch.eval.engine.predictions import DepthSource
from ufmstar_torch.eval.methods.perturb import Drift, perturbed
from ufmstar_torch.eval.methods.setting import DEFAULT, Setting
from ufmstar_torch.eval.sequences.frame import Frame, FrameError
from ufmstar_torch.eval.sequences.ground_truth import moving_at
from ufmstar_torch.frames.frame import FRAME_FAULTS
from ufmstar_torch.frames.output import FrameStatistics
from ufmstar_torch.frames.prediction import DepthPrediction
from ufmstar_torch.posterior.distribution import DepthDistribution

# Prefixes of the tensors of a row's state.
_IMAGES, _ESTIMATOR, _TRACKER, _DRIFT = "image_index", "ufm.", "tracker.", "drift."


@dataclass(frozen=True, eq=False, kw_only=True)
class RowResult:
    """One row's result for a frame: its maps [h, w] on the CPU, its prediction and its anchors."""

    depth: Tensor  # predicted, or the posterior's if the row is its evaluation [m]
    variance: Tensor | None  # total [m^2], NaN where not valid; None if the network predicts depth alone
    valid: Tensor  # bool, True where the depth is positive and finite and every variance that is used is valid
    # A and E as far as the row uses them [m^2], or None.
    aleatoric: Tensor | None = None
    epistemic: Tensor | None = None
    disagreement: Tensor | None = None  # M of UfM* [m^2], or None
    measured: Tensor | None = None  # share of M from views of different places, of UfM*, NaN where not valid, or None
    anchored: Tensor | None = None  # B of UfM* with anchors [m^2], or None
    bias: Tensor | None = None  # r of UfM* with anchors, or None
    posterior_depth: Tensor | None = None  # of UfM* with anchors and a posterior [m], or None
    posterior_variance: Tensor | None = None  # likewise [m^2]
    posterior_inlier_variance: Tensor | None = None  # variance of pixels on the surface of their evidence [m^2]
    posterior_outlier: Tensor | None = None  # probability that a pixel is not on that surface
    distribution: DepthDistribution | None = None  # [1, h, w] of the depth, on its device; None = no evidence
    statistics: FrameStatistics | None = None  # of UfM*, [1] per count, or None
    confidence: Tensor | None = None  # of the prediction, in the network's unit, if UfM* used it; or None
    network_variance: Tensor | None  # A + E of the prediction, even if the row ignores them [m^2]; None without both
    intrinsics: NDArray[np.float64]  # [3, 3] of the maps [px]
    # [h, w] ground truth at the maps' pixels [m], 0 = none; None without a depth map, or if it serves as anchors
    truth: NDArray[np.float32] | None
    moving: NDArray[np.bool_] | None = None  # [h, w] True on things that move; None = unknown
    T_world_cam: NDArray[np.float64]  # [4, 4] the row's pose, with noise [m]
    member: int | None  # index of the network that predicted; None if all predicted, and for maps
    landmarks: Landmarks | None  # from which the frame's anchors were made; None for a row without anchors
    ms: dict[str, float]  # "network" if one ran, "anchors" if some were tracked, and "uncertainty" [ms]

    @property
    def best(self) -> tuple[Tensor, Tensor | None]:
        """Depth [m] and its variance [m^2]: the posterior's if there is one, else ``depth`` and ``variance``."""
        if self.posterior_depth is None:
            return self.depth, self.variance
        return self.posterior_depth, self.posterior_variance

    @property
    def mixture(self) -> tuple[Tensor, Tensor] | None:
        """The posterior's variance of inliers [m^2] and probability of an outlier, or None."""
        if self.posterior_inlier_variance is None or self.posterior_outlier is None:
            return None
        return self.posterior_inlier_variance, self.posterior_outlier

    @property
    def parts(self) -> dict[str, Tensor]:
        """[h, w] bool masks of what moves and what stands still, by name; {} where this is unknown."""
        if self.moving is None:
            return {}
        moving = torch.from_numpy(self.moving)
        return {"moving": moving, "still": ~moving}

    @property
    def level(self) -> Tensor | None:
        """[h, w] level of the smallest central interval with the ground truth in it, NaN without one; None without
        ground truth or intervals."""
        if self.truth is None or self.distribution is None:
            return None
        truth = torch.from_numpy(self.truth)[None].to(self.distribution.mean.device)
        level = self.distribution.central_level(truth.double())[0].cpu()
        return torch.where(torch.from_numpy(self.truth > 0), level, torch.nan)

    @property
    def size(self) -> tuple[int, int]:
        """(h, w)."""
        return self.depth.shape[0], self.depth.shape[1]

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
        skips_faults: True to skip frames with bad poses or intrinsics; they count as images when members alternate.
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
    ) -> None:
        self.key, self.source, self.estimator, self.every, self.setting = key, source, estimator, every, setting
        self.anchors, self._skips_faults = anchors, skips_faults
        self._tracks = None if anchors is None else anchors.tracks
        self.images = 0
        self._drift = Drift(setting)

    def update(self, frame: Frame, prediction: DepthPrediction, truth: NDArray[np.float32] | None) -> RowResult:
        """Process the next frame. Ground truth [h, w] is used for anchors alone. Raises FrameError: ``skips_faults``,
        and the pose or the intrinsics are bad."""
        T = perturbed(self._drift.of(frame.T_world_cam, frame.index), self.setting, frame.index)
        landmarks, anchors, tracking_ms = (
            (None, None, None) if self.anchors is None else self.anchors.of(frame, T, prediction, truth)
        )
        member = self.source.turn(self.images) if self.source.networks and not self.every else None
        ms = {"network": prediction.ms, "anchors": tracking_ms}
        times = {stage: time for stage, time in ms.items() if time is not None}
        with timed(times, "uncertainty", prediction.depth.device):
            answer = self.estimator.update(prediction, torch.from_numpy(T), anchors)
            answer = {name: value[0].cpu() if isinstance(value, Tensor) else value for name, value in answer.items()}
        self.images += 1
        statistics, network_variance = answer.get("statistics"), prediction.variance
        if self._skips_faults and statistics is not None and int(statistics.fault[0]):
            if self._tracks is not None:
                self._tracks.undo()
            raise FrameError(frame.name, FRAME_FAULTS[int(statistics.fault[0])])
        return RowResult(
            **answer,
            network_variance=None if network_variance is None else network_variance[0].cpu(),
            intrinsics=prediction.K[0].numpy(),
            truth=None if self.anchors is not None and self.anchors.sensor else truth,
            moving=moving_at(frame, prediction.K[0].numpy(), prediction.size),
            T_world_cam=T,
            member=member,
            landmarks=landmarks,
            ms=times,
        )

    def memory(self) -> dict[str, float]:
        """``Estimator.memory``, with the bytes of the anchors' tracks or evidence."""
        memory = self.estimator.memory()
        if self._tracks is not None:
            memory["bytes"] += sum(value.nbytes for value in self._tracks.state().values())
        return memory

    def state(self) -> dict[str, Tensor]:
        """All tensors on which the next frame depends; networks have no state."""
        anchors = {} if self._tracks is None else self._tracks.state()
        parts = ((_ESTIMATOR, self.estimator.state()), (_TRACKER, anchors), (_DRIFT, self._drift.state()))
        tensors = {prefix + name: value for prefix, state in parts for name, value in state.items()}
        return {_IMAGES: torch.tensor(self.images), **tensors}

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        """Continue from ``state``. Raises ValueError: it belongs to another kind of row."""

        def part(prefix: str) -> dict[str, Tensor]:
            return {name.removeprefix(prefix): value for name, value in state.items() if name.startswith(prefix)}

        self.images = int(state[_IMAGES])
        self.estimator.load_state(part(_ESTIMATOR))
        if self._tracks is not None:
            self._tracks.load_state(part(_TRACKER))
        self._drift.load_state(part(_DRIFT))

"""Estimators of a row's variance: the network alone, UfM, UfM*, and a share of the depth."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import Any

import torch
from torch import Tensor

from ufmstar_torch.anchors.anchors import Anchors
from ufmstar_torch.config import UfMStarConfig
from ufmstar_torch.eval.engine.predictions import DepthSource
from ufmstar_torch.eval.methods.method import ALONE, RELATIVE, RHO, UFM, UFM_STAR
from ufmstar_torch.eval.methods.row import Row
from ufmstar_torch.eval.methods.setting import configured
from ufmstar_torch.eval.methods.ufm import UfM
from ufmstar_torch.eval.methods.ufm import output_of as output_of
from ufmstar_torch.frames.output import UncertaintyOutput
from ufmstar_torch.frames.prediction import DepthPrediction
from ufmstar_torch.posterior.recalibrate import Recalibration
from ufmstar_torch.ufmstar import UfMStar


class Estimator(ABC):
    """Computes variances from the predictions of a sequence, frame by frame."""

    def __init__(self, *, uses_variances: bool = True) -> None:
        self._uses_variances = uses_variances

    def used(self, prediction: DepthPrediction) -> DepthPrediction:
        """The prediction, without A and E unless the row uses them."""
        if self._uses_variances:
            return prediction
        return replace(prediction, aleatoric_variance=None, epistemic_variance=None)

    def states_variance(self, prediction: DepthPrediction) -> bool:
        """False if the variance is NaN because the method states none for such a prediction."""
        return True

    @abstractmethod
    def update(
        self, prediction: DepthPrediction, T_world_cam: Tensor, anchors: Anchors | None = None
    ) -> UncertaintyOutput:
        """Process the next frame.

        Args:
            prediction: maps [1, h, w] on the estimator's device, with intrinsics.
            T_world_cam: [4, 4] float64 camera-to-world [m], on the CPU.
            anchors: [1, N] of the frame in the map's pixels; None = none.
        """

    def memory(self) -> dict[str, float]:
        """Size of the state: "bytes", "count" of points or components, "smoothing_bytes" of the smoothing map [B]; with
        anchors also "anchors", the number used in the frame. {} without a state."""
        return {}


def make_estimator(
    row: Row, device: torch.device, source: DepthSource | None = None, plugins: Mapping[str, Any] = MappingProxyType({})
) -> Estimator:
    """The estimator of a row on a device, in its initial state.

    Args:
        row, device: of the estimator.
        source: of depth, with its largest depth and whether it has a confidence; None = unknown.
        plugins: the user's methods (``sequences.plugins``), by name.
    """
    method, uses = row.method, row.method.uses_aleatoric
    if method.fusion == ALONE:
        return Alone(uses_variances=uses)
    if method.fusion == UFM:
        return Pointwise(method.max_points, uses_variances=uses)
    if method.fusion == RELATIVE:
        return Relative(uses_variances=False)
    if method.fusion != UFM_STAR:
        estimator: Estimator = plugins[method.fusion](row, device)
        return estimator
    config = ufm_star_config(row)
    config = config if source is None else config.within(source.max_depth, source.states_confidence)
    return Gaussians(config, device, uses_variances=uses)


def ufm_star_config(row: Row) -> UfMStarConfig:
    """The settings of a row's UfM*.

    "fixed-param" is the paper's run on 518 x 518 images with "the same hyperparameters used for 224 x 224 inputs". It
    turns off ``SPGFConfig.scaled_to``: areas, lengths and rows in pixels are not scaled, and the threshold a z^2 / f
    uses the image's focal length. Segments are then smaller and more numerous.
    """
    config = configured(row.setting).replace(on_bad_frame="skip")
    return config.replace(segment=replace(config.segment, scale_with_image=False)) if row.method.fixed_param else config


class Alone(Estimator):
    """The network's variance, A + E as far as it predicts them; none without ``uses_variances``."""

    def states_variance(self, prediction: DepthPrediction) -> bool:
        """See :class:`Estimator`."""
        return self.used(prediction).variance is not None

    def update(
        self, prediction: DepthPrediction, T_world_cam: Tensor, anchors: Anchors | None = None
    ) -> UncertaintyOutput:
        used = self.used(prediction)
        a, e = used.aleatoric_variance, used.epistemic_variance
        valid = (used.depth > 0) & used.depth.isfinite()
        for part in (a, e):
            valid = valid if part is None else valid & part.isfinite() & (part >= 0)
        return output_of(used.depth, used.variance, valid, aleatoric=a, epistemic=e)


class Relative(Estimator):
    """The baseline V = (RHO d)^2, which compares no views."""

    def update(
        self, prediction: DepthPrediction, T_world_cam: Tensor, anchors: Anchors | None = None
    ) -> UncertaintyOutput:
        depth = prediction.depth
        return output_of(depth, (RHO * depth) ** 2, (depth > 0) & depth.isfinite())


class Pointwise(Estimator):
    """UfM. Without ``uses_variances``, A and E are ignored."""

    def __init__(self, max_points: int | None, *, uses_variances: bool = True) -> None:
        super().__init__(uses_variances=uses_variances)
        self.ufm = UfM(max_points)

    def update(
        self, prediction: DepthPrediction, T_world_cam: Tensor, anchors: Anchors | None = None
    ) -> UncertaintyOutput:
        used = self.used(prediction)
        return self.ufm(used.depth, T_world_cam, prediction.K, used.aleatoric_variance, used.epistemic_variance)

    def memory(self) -> dict[str, float]:
        """Bytes and number of the points."""
        counts = [(len(cloud.count), cloud.bytes_per_point) for cloud in self.ufm.clouds]
        return {"bytes": sum(n * each for n, each in counts), "count": sum(n for n, _ in counts), "smoothing_bytes": 0}


class Gaussians(Estimator):
    """UfM*, with the posterior that its configuration has."""

    def __init__(
        self,
        config: UfMStarConfig,
        device: torch.device,
        *,
        uses_variances: bool = True,
        recalibration: Recalibration | None = None,
    ) -> None:
        super().__init__(uses_variances=uses_variances)
        self.ufm = UfMStar(config, recalibration=recalibration, device=device)
        self._anchors = 0

    def update(
        self, prediction: DepthPrediction, T_world_cam: Tensor, anchors: Anchors | None = None
    ) -> UncertaintyOutput:
        maps = self.used(prediction).arguments(confidence=self.ufm.uses_confidence)
        out = self.ufm(pose=T_world_cam, intrinsics=prediction.K, anchors=anchors, **maps)
        used = out.statistics.anchors_used
        self._anchors = 0 if used is None else int(used[0])
        return out

    def memory(self) -> dict[str, float]:
        """Bytes and number of the occupied components, anchor terms included; bytes of the moving average."""
        state, mixture = self.ufm.state, self.ufm.mixture
        count = int(mixture.components.sum())
        component = mixture.bytes_per_component() + sum(sums[:, :1].nbytes for sums in state.by_component.values())
        size = count * component + sum(value.nbytes for value in state.by_stream.values())
        memory: dict[str, float] = {"bytes": size, "count": count, "smoothing_bytes": self.ufm.smoothed.nbytes}
        return memory if self.ufm.config.anchors is None else memory | {"anchors": self._anchors}

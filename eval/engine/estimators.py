"""Estimators of a row's variance: the network alone, UfM, and UfM*."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import Any

import torch
from torch import Tensor, nn

from ufmstar_torch.anchors.anchors import Anchors
from ufmstar_torch.config import UfMStarConfig
from ufmstar_torch.eval.engine.predictions import DepthSource
from ufmstar_torch.eval.methods.method import ALONE, UFM, UFM_STAR
from ufmstar_torch.eval.methods.row import Row
from ufmstar_torch.eval.methods.setting import configured
from ufmstar_torch.eval.methods.ufm import UfM
from ufmstar_torch.frames.prediction import DepthPrediction
from ufmstar_torch.gaussians.mixture import GaussianMixture
from ufmstar_torch.posterior.recalibrate import Recalibration
from ufmstar_torch.ufmstar import UfMStar
from ufmstar_torch.uncertain_depth import maps_of

# Maps [1, h, w] on the estimator's device, by their names in ``RowResult``; UfM* adds "statistics".
Answer = dict[str, Any]
_OF_OUTPUT = (
    "depth", "variance", "valid", "aleatoric", "epistemic", "disagreement", "measured", "anchored", "bias",
    "posterior_depth", "posterior_variance", "posterior_inlier_variance", "posterior_outlier", "statistics",
)  # fmt: skip


class Estimator(ABC):
    """Computes variances from the predictions of a sequence, frame by frame.

    Attributes:
        module: its buffers are the state; without buffers by default.
    """

    module: nn.Module = nn.Identity()

    def __init__(self, *, uses_variances: bool = True) -> None:
        self._uses_variances = uses_variances

    def used(self, prediction: DepthPrediction) -> DepthPrediction:
        """The prediction, without A and E unless the row uses them."""
        if self._uses_variances:
            return prediction
        return replace(prediction, aleatoric_variance=None, epistemic_variance=None)

    @abstractmethod
    def update(self, prediction: DepthPrediction, T_world_cam: Tensor, anchors: Anchors | None = None) -> Answer:
        """Process the next frame: "depth", "variance", "valid" and others of ``RowResult``.

        Args:
            prediction: maps [1, h, w] on the estimator's device, with intrinsics.
            T_world_cam: [4, 4] float64 camera-to-world [m], on the CPU.
            anchors: [1, N] of the frame in the map's pixels; None = none.
        """

    def memory(self) -> dict[str, float]:
        """Size of the state: "bytes", "count" of points or components, "smoothing_bytes" of the smoothing map [B]; with
        anchors also "anchors", the number used in the frame. {} without a state."""
        return {}

    def state(self) -> dict[str, Tensor]:
        """All tensors on which the next frame depends."""
        return dict(self.module.state_dict())

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        """Continue from ``state``. Raises RuntimeError: it belongs to another kind of estimator."""
        self.module.load_state_dict(dict(state))


def make_estimator(
    row: Row, device: torch.device, source: DepthSource | None = None, plugins: Mapping[str, Any] = MappingProxyType({})
) -> Estimator:
    """The estimator of a row on a device, in its initial state.

    Args:
        row, device: of the estimator.
        source: of depth, with its largest depth and whether it has a confidence; None = unknown.
        plugins: the user's methods (``sequences.plugins``), by name.

    Raises:
        ValueError: a recalibration was fitted with other settings.
        FileNotFoundError: the setting's recalibration does not exist.
    """
    method, setting, uses = row.method, row.setting, row.method.uses_aleatoric
    if method.fusion == ALONE:
        return Alone(uses_variances=uses)
    if method.fusion == UFM:
        return Pointwise(method.max_points, uses_variances=uses)
    if method.fusion != UFM_STAR:
        estimator: Estimator = plugins[method.fusion](row, device)
        return estimator
    recalibration = Recalibration.from_json(setting.recalibration) if setting.recalibration else None
    config = ufm_star_config(row)
    config = config if source is None else config.within(source.max_depth, source.states_confidence)
    return Gaussians(config, device, posterior=setting.posterior, uses_variances=uses, recalibration=recalibration)


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

    def update(self, prediction: DepthPrediction, T_world_cam: Tensor, anchors: Anchors | None = None) -> Answer:
        used = self.used(prediction)
        a, e, variance = used.aleatoric_variance, used.epistemic_variance, used.variance
        valid = (used.depth > 0) & used.depth.isfinite()
        for part in (a, e):
            valid = valid if part is None else valid & part.isfinite() & (part >= 0)
        variance = None if variance is None else torch.where(valid, variance, torch.nan)
        return {"depth": used.depth, "variance": variance, "valid": valid, "aleatoric": a, "epistemic": e}


class Pointwise(Estimator):
    """UfM. Without ``uses_variances``, A and E are ignored."""

    def __init__(self, max_points: int | None, *, uses_variances: bool = True) -> None:
        super().__init__(uses_variances=uses_variances)
        self.ufm = UfM(max_points)

    def update(self, prediction: DepthPrediction, T_world_cam: Tensor, anchors: Anchors | None = None) -> Answer:
        used = self.used(prediction)
        a, e = used.aleatoric_variance, used.epistemic_variance
        out = self.ufm(used.depth, T_world_cam, prediction.K, a, e)
        return {"depth": used.depth, "variance": out.variance, "valid": out.valid, "aleatoric": a, "epistemic": e}

    def state(self) -> dict[str, Tensor]:
        """Raises TypeError: the state of UfM cannot be saved."""
        raise TypeError("a row of UfM cannot be continued within a sequence: only UfM* has a state that can be saved")

    def memory(self) -> dict[str, float]:
        """Bytes and number of the points."""
        cloud = self.ufm.cloud
        count, size = (0, 0) if cloud is None else (len(cloud.count), len(cloud.count) * cloud.bytes_per_point)
        return {"bytes": size, "count": count, "smoothing_bytes": 0}


class Gaussians(Estimator):
    """UfM*; with ``posterior``, depth and variance are the posterior's."""

    def __init__(
        self,
        config: UfMStarConfig,
        device: torch.device,
        *,
        posterior: bool = False,
        uses_variances: bool = True,
        recalibration: Recalibration | None = None,
    ) -> None:
        super().__init__(uses_variances=uses_variances)
        extensions = () if recalibration is None else (recalibration,)
        self.module = self.ufm = UfMStar(config, extensions=extensions, device=device)
        self._posterior, self._anchors = posterior, 0

    def update(self, prediction: DepthPrediction, T_world_cam: Tensor, anchors: Anchors | None = None) -> Answer:
        used = self.used(prediction)
        out = self.ufm(pose=T_world_cam, intrinsics=prediction.K, anchors=anchors, **maps_of(used, self.ufm))
        anchors_used = out.statistics.anchors_used
        self._anchors = 0 if anchors_used is None else int(anchors_used[0])
        answer = {name: getattr(out, name) for name in _OF_OUTPUT} | {"confidence": used.confidence}
        answer["distribution"] = out.distribution() if out.has_intervals else None
        if self._posterior:
            answer["depth"], answer["variance"] = out.posterior()
        return answer

    def mixture_world(self) -> GaussianMixture:
        """[1, K] M_i in the world's frame, float64; after a frame."""
        T = self.ufm.T_world_first.double()
        return self.ufm.mixture.to(torch.float64).rigid(T[:, :3, :3], T[:, :3, 3])

    def memory(self) -> dict[str, float]:
        """Bytes and number of the occupied components, anchor terms included; bytes of the moving average."""
        state, mixture = self.ufm.state, self.ufm.mixture
        count = int(mixture.components.sum())
        component = mixture.bytes_per_component() + sum(sums[:, :1].nbytes for sums in state.by_component.values())
        size = count * component + sum(value.nbytes for value in state.by_stream.values())
        memory: dict[str, float] = {"bytes": size, "count": count, "smoothing_bytes": self.ufm.smoothed.nbytes}
        return memory if self.ufm.config.anchors is None else memory | {"anchors": self._anchors}

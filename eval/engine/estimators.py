"""How a row gets its variance: from the network alone, from UfM or from UfM*."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor, nn

from ufmstar_torch.anchors.anchors import Anchors
from ufmstar_torch.config import UfMStarConfig
from ufmstar_torch.eval.engine.predictions import Predicted
from ufmstar_torch.eval.methods.method import ALONE, UFM
from ufmstar_torch.eval.methods.row import Row
from ufmstar_torch.eval.methods.setting import configured
from ufmstar_torch.eval.methods.ufm import UfM, UfMConfig
from ufmstar_torch.mixture import GaussianMixture
from ufmstar_torch.pipeline import UncertainDepth
from ufmstar_torch.prediction import DepthPrediction
from ufmstar_torch.recalibrate import Recalibration
from ufmstar_torch.ufmstar import UfMStar

# The maps of an answer [1, h, w] on the estimator's device, by the names of ``RowResult``; "statistics" of UfM*.
Answer = dict[str, Any]


_OF_OUTPUT = (
    "depth", "variance", "valid", "aleatoric", "epistemic", "disagreement", "measured", "anchored", "bias",
    "posterior_depth", "posterior_variance", "statistics",
)  # fmt: skip


class Estimator(ABC):
    """Turns the predictions of a sequence, one after the other, into variances; this one keeps no state."""

    @abstractmethod
    def update(self, predicted: Predicted, T_world_cam: Tensor, anchors: Anchors | None = None) -> Answer:
        """Process the next frame.

        Args:
            predicted: maps on the estimator's device.
            T_world_cam: [4, 4] float64 camera-to-world [m], on the CPU.
            anchors: [1, N] of the frame in the map's pixels; None = none.

        Returns:
            "depth", "variance", "valid" and others of ``RowResult``.
        """

    def memory(self) -> dict[str, float]:
        """Size of the state: "bytes" and "count" of points or components, "smoothing_bytes" of the map kept for
        smoothing [B]; {} if nothing is. With anchors also "anchors", those used of the frame."""
        return {}

    def state(self) -> dict[str, Tensor]:
        """All tensors on which the next frame depends."""
        return {}

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        """Continue where ``state`` was taken; raises ValueError for that of another kind of estimator."""
        if state:
            raise ValueError(f"the saved state has {sorted(state)} too many")


def make_estimator(row: Row, device: torch.device, max_depth: float | None = None) -> Estimator:
    """The estimator of a row, in its initial state.

    Args:
        row: which.
        device: where it runs.
        max_depth: [m] the largest depth that the row's networks can predict, None where it is not known.

    Raises:
        ValueError: a recalibration that was fitted under other settings.
        FileNotFoundError: the setting's recalibration does not exist.
    """
    method, setting = row.method, row.setting
    if method.fusion == ALONE:
        return Alone(uses_variances=method.uses_aleatoric)
    if method.fusion == UFM:
        points = UfMConfig(max_points=method.max_points, on_bad_frame="skip")
        return Pointwise(points, device, uses_variances=method.uses_aleatoric)
    recalibration = Recalibration.from_json(setting.recalibration) if setting.recalibration else None
    config = ufm_star_config(row).within(max_depth)
    return Gaussians(
        config,
        device,
        uses_variances=method.uses_aleatoric,
        corrected=setting.corrected,
        posterior=setting.posterior,
        recalibration=recalibration,
        aleatoric_in_h=setting.aleatoric_in_h,
    )


def ufm_star_config(row: Row) -> UfMStarConfig:
    """The settings of a row's UfM*.

    "fixed-param" is the paper's run on 518 x 518 images with "the same hyperparameters used for 224 x 224 inputs". Ours
    are stated for 224 x 224 and follow the image (``SPGFConfig.scaled_to``), so it takes them literally: areas, lengths
    and rows in pixels are not scaled, and the threshold a z^2 / f has the image's own focal length, where scaling keeps
    a / f. Segments are then smaller and more. Thresholds in metres, overlaps and radii are alike in both. At 224 x 224
    only the second part makes a difference, as far as the focal length is not 200 px.
    """
    config = configured(row.setting).replace(on_bad_frame="skip")
    return config.replace(segment=replace(config.segment, scale_with_image=False)) if row.method.fixed_param else config


@dataclass(frozen=True)
class Alone(Estimator):
    """The network's own variance, A + E of what it has."""

    uses_variances: bool = True  # False leaves A and E aside, so that there is no variance

    def update(self, predicted: Predicted, T_world_cam: Tensor, anchors: Anchors | None = None) -> Answer:
        depth, a, e = _maps(predicted, self.uses_variances)
        parts = [part for part in (a, e) if part is not None]
        valid = (depth > 0) & depth.isfinite()
        for part in parts:
            valid = valid & part.isfinite() & (part >= 0)
        variance = torch.where(valid, sum(parts[1:], start=parts[0]), torch.nan) if parts else None
        return {"depth": depth, "variance": variance, "valid": valid, "aleatoric": a, "epistemic": e}


class Pointwise(Estimator):
    """UfM. Without ``uses_variances``, A and E are left aside."""

    def __init__(self, config: UfMConfig, device: torch.device, *, uses_variances: bool = True) -> None:
        self.ufm = UfM(config, device=device)
        self._uses_variances = uses_variances

    def update(self, predicted: Predicted, T_world_cam: Tensor, anchors: Anchors | None = None) -> Answer:
        depth, a, e = _maps(predicted, self._uses_variances)
        out = self.ufm(depth, T_world_cam, predicted.intrinsics, a, e)
        return {"depth": depth, "variance": out.variance, "valid": out.valid, "aleatoric": a, "epistemic": e}

    def memory(self) -> dict[str, float]:
        """Bytes and number of the points."""
        cloud = self.ufm.clouds()[0] if len(self.ufm.points) else None
        count = 0 if cloud is None else len(cloud.count)
        return {"bytes": count * (cloud.bytes_per_point if cloud else 0), "count": count, "smoothing_bytes": 0}

    def state(self) -> dict[str, Tensor]:
        return dict(self.ufm.state_dict())

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        _load(self.ufm, state)


class Gaussians(Estimator):
    """UfM*.

    Args:
        config: its settings.
        device: of the mixture.
        uses_variances: False leaves A and E aside.
        corrected: answer with the depth corrected by the anchors' bias, and the variance that remains.
        posterior: answer with the posterior's depth and variance.
        recalibration: of the variance; None = as it is.
        aleatoric_in_h: the config has two features: the aleatoric variance, kept in the mixture, and 1. What is read
            back is added instead of the pixel's own, A'(x) = sum_k w_k(x) a_k + (1 - sum_k w_k(x)) A: the pixel's own
            as far as no component explains it, where the mixture alone would read as 0.
    """

    def __init__(
        self,
        config: UfMStarConfig,
        device: torch.device,
        *,
        uses_variances: bool = True,
        corrected: bool = False,
        posterior: bool = False,
        recalibration: Recalibration | None = None,
        aleatoric_in_h: bool = False,
    ) -> None:
        self.model = UncertainDepth(None, config, recalibration=recalibration).to(device)
        self._uses_variances, self._corrected, self._in_h = uses_variances, corrected, aleatoric_in_h
        self._posterior = posterior
        self._anchors = 0

    def update(self, predicted: Predicted, T_world_cam: Tensor, anchors: Anchors | None = None) -> Answer:
        """See :meth:`Estimator.update`. Raises ValueError: ``aleatoric_in_h`` without an aleatoric variance."""
        depth, a, e = _maps(predicted, self._uses_variances)
        features = None
        if self._in_h:
            if a is None:
                raise ValueError("aleatoric_in_h needs a network that predicts an aleatoric variance")
            features = torch.stack([a, torch.ones_like(a)], dim=1)
        used = DepthPrediction(depth, a, e)
        out = self.model.update(used, T_world_cam, predicted.intrinsics, features=features, anchors=anchors)
        anchors_used = out.statistics.anchors_used
        self._anchors = 0 if anchors_used is None else int(anchors_used[0])
        answer = {name: getattr(out, name) for name in _OF_OUTPUT}
        if self._corrected or self._posterior:
            answer["depth"], answer["variance"] = out.posterior() if self._posterior else out.corrected()
        if self._in_h and a is not None:
            mixed, explained = out.features.unbind(-1)
            a = mixed + (1 - explained) * a
            answer |= {"aleatoric": a, "variance": answer["variance"] + a}
        return answer

    @property
    def ufm(self) -> UfMStar:
        """The module with the mixture."""
        return self.model.ufm

    def mixture_world(self) -> GaussianMixture:
        """[1, K] M_i in the world's frame, float64; after a frame."""
        T = self.ufm.T_world_first.double()
        return self.ufm.mixture.to(torch.float64).rigid(T[:, :3, :3], T[:, :3, 3])

    def memory(self) -> dict[str, float]:
        """Bytes and number of the occupied components, with what anchors added to them; the bytes of the moving
        average beside them."""
        mixture = self.ufm.mixture
        count = int(mixture.components.sum())
        memory: dict[str, float] = {
            "bytes": count * mixture.bytes_per_component(),
            "count": count,
            "smoothing_bytes": self.ufm.smoothed.nbytes,
        }
        if self.ufm.config.anchors is not None:
            state = self.ufm.state
            sums = sum(value[:, :1].nbytes for value in state.by_component.values())
            memory["bytes"] += count * sums + sum(value.nbytes for value in state.by_stream.values())
            memory["anchors"] = self._anchors
        return memory

    def state(self) -> dict[str, Tensor]:
        return dict(self.ufm.state_dict())

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        _load(self.ufm, state)


def _maps(predicted: Predicted, uses_variances: bool) -> tuple[Tensor, Tensor | None, Tensor | None]:
    """Depth, A and E as far as the row uses them."""
    maps = predicted.maps
    return (maps.depth, *((maps.aleatoric_variance, maps.epistemic_variance) if uses_variances else (None, None)))


def _load(module: nn.Module, state: Mapping[str, Tensor]) -> None:
    """Raises ValueError where the state is not the module's."""
    result = module.load_state_dict(dict(state), strict=False)
    if result.missing_keys or result.unexpected_keys:
        raise ValueError(f"the saved state lacks {result.missing_keys} and has {result.unexpected_keys} too many")

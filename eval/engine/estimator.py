"""What judges a row's views: nothing (the network's own variance), UfM or UfM*."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from difflib import get_close_matches
from typing import Any

import torch
from torch import Tensor

from ufmstar_torch.anchors.given import Anchors
from ufmstar_torch.config import UfMStarConfig
from ufmstar_torch.eval.engine.predicted import Predicted
from ufmstar_torch.eval.methods.method import ALONE, UFM, UFM_STAR
from ufmstar_torch.eval.methods.row import Row
from ufmstar_torch.eval.methods.ufm import UfM, UfMConfig
from ufmstar_torch.ufmstar import UfMStar


@dataclass(frozen=True, eq=False)
class Estimate:
    """A row's answer for one frame: maps [h, w] on the CPU.

    Attributes:
        depth: as predicted, or corrected by what anchors say, where the row is about that [m].
        variance: total variance [m^2], NaN where not valid; None for a network that predicts depth alone.
        valid: bool, True where there is a prediction: depth is positive and finite, and so is every variance used.
        aleatoric, epistemic: A and E as far as the row uses them [m^2], or None.
        disagreement: M of UfM* [m^2], or None.
    """

    depth: Tensor
    variance: Tensor | None
    valid: Tensor
    aleatoric: Tensor | None
    epistemic: Tensor | None
    disagreement: Tensor | None


class Estimator(ABC):
    """Turns the predictions of a sequence, one after the other, into variances."""

    @abstractmethod
    def update(self, predicted: Predicted, T_world_cam: Tensor, anchors: Anchors | None = None) -> Estimate:
        """Take in the next frame.

        Args:
            predicted: [h, w] maps on the estimator's device.
            T_world_cam: [4, 4] float64 camera-to-world [m], on the CPU.
            anchors: [1, N] of the frame, where the row's setting has some.
        """

    @abstractmethod
    def state(self) -> dict[str, float]:
        """What is kept for the next frame: "bytes" and "count" of points or components, "smoothing_bytes" of the map
        kept for smoothing [B]; {} if nothing is. With anchors also "anchors", those used of the frame."""


def make_estimator(row: Row, device: torch.device) -> Estimator:
    """The estimator of a row, in its initial state.

    Raises:
        ValueError: the setting changes what UfM* does not have, or what the method does not use.
    """
    method = row.method
    if row.setting.overrides and method.fusion in (ALONE, UFM):
        raise ValueError(f"{row.label}: settings of UfM* go with UfM* only")
    if row.setting.anchors and method.fusion != UFM_STAR:
        raise ValueError(f"{row.label}: anchors go with UfM* only")
    if method.fusion == ALONE:
        return Alone(uses_variances=method.uses_aleatoric)
    if method.fusion == UFM:
        return Pointwise(method.max_points, device, uses_variances=method.uses_aleatoric)
    config = ufm_star_config(row)
    return Gaussians(config, device, uses_variances=method.uses_aleatoric, corrected=row.setting.corrected)


def ufm_star_config(row: Row) -> UfMStarConfig:
    """The settings of a row's UfM*.

    "fixed-param" is the paper's run on 518 x 518 images with "the same hyperparameters used for 224 x 224 inputs". Ours
    are stated for 224 x 224 and follow the image (``SPGFConfig.scaled_to``), so it takes them literally: areas, lengths
    and rows in pixels are not scaled, and the threshold a z^2 / f has the image's own focal length, where scaling keeps
    a / f. Segments are then smaller and more. Thresholds in metres, overlaps and radii are alike in both. At 224 x 224
    only the second part makes a difference, as far as the focal length is not 200 px.

    Raises:
        ValueError: an override has an unknown name or an impossible value; the message names it.
    """
    values: dict[str, Any] = UfMStarConfig(on_bad_frame="skip", anchored=bool(row.setting.anchors)).to_dict()
    if row.method.fixed_param:
        values["segment"]["scale_with_image"] = False
    try:
        for name, value in row.setting.overrides.items():
            _override(values, name, value)
        return UfMStarConfig.from_dict(values)
    except ValueError as error:
        raise ValueError(f"{row.label}: {error}") from error


def _override(values: dict[str, Any], name: str, value: Any) -> None:
    """Set a field by its dotted name, in place.

    Raises:
        ValueError: there is none of that name.
    """
    at, known = values, _names(values)
    if name not in known:
        near = get_close_matches(name, known, n=1) or [", ".join(known)]
        raise ValueError(f"UfM* has no setting {name!r}; did you mean {near[0]}?")
    *folders, field = name.split(".")
    for folder in folders:
        at = at[folder]
    at[field] = value


def _names(values: Mapping[str, Any], prefix: str = "") -> list[str]:
    """The dotted names of all fields that hold a value."""
    names: list[str] = []
    for name, value in values.items():
        names += _names(value, f"{prefix}{name}.") if isinstance(value, Mapping) else [f"{prefix}{name}"]
    return names


@dataclass(frozen=True)
class Alone(Estimator):
    """The network's own variance, A + E of what it has.

    Attributes:
        uses_variances: False leaves A and E aside, so that there is no variance.
    """

    uses_variances: bool

    def update(self, predicted: Predicted, T_world_cam: Tensor, anchors: Anchors | None = None) -> Estimate:
        """See :meth:`Estimator.update`; pose and anchors do not matter."""
        a, e = _variances(predicted, self.uses_variances)
        parts = [part for part in (a, e) if part is not None]
        valid = (predicted.depth > 0) & predicted.depth.isfinite()
        for part in parts:
            valid = valid & part.isfinite() & (part >= 0)
        variance = torch.where(valid, sum(parts[1:], start=parts[0]), torch.nan) if parts else None
        return _estimate(predicted.depth, variance, valid, a, e, None)

    def state(self) -> dict[str, float]:
        """Nothing."""
        return {}


class Pointwise(Estimator):
    """UfM.

    Args:
        max_points: None = unpruned.
        device: of the points.
        uses_variances: False leaves A and E aside.
    """

    def __init__(self, max_points: int | None, device: torch.device, *, uses_variances: bool) -> None:
        self.ufm = UfM(UfMConfig(max_points=max_points, on_bad_frame="skip"), device=device)
        self._uses_variances = uses_variances

    def update(self, predicted: Predicted, T_world_cam: Tensor, anchors: Anchors | None = None) -> Estimate:
        """See :meth:`Estimator.update`."""
        a, e = _variances(predicted, self._uses_variances)
        out = self.ufm(predicted.depth[None], T_world_cam, predicted.intrinsics, _one(a), _one(e))
        return _estimate(predicted.depth, out.variance[0], out.valid[0], a, e, None)

    def state(self) -> dict[str, float]:
        """Bytes and number of the points."""
        cloud = self.ufm.clouds()[0] if len(self.ufm.points) else None
        count = 0 if cloud is None else len(cloud.count)
        return {"bytes": count * (cloud.bytes_per_point if cloud else 0), "count": count, "smoothing_bytes": 0}


class Gaussians(Estimator):
    """UfM*.

    Args:
        config: its settings.
        device: of the mixture.
        uses_variances: False leaves A and E aside.
        corrected: answer with the depth corrected by the anchors' bias, and the variance that remains.
    """

    def __init__(
        self, config: UfMStarConfig, device: torch.device, *, uses_variances: bool, corrected: bool = False
    ) -> None:
        self.ufm = UfMStar(config, device=device)
        self._uses_variances, self._corrected = uses_variances, corrected
        self._anchors = 0

    def update(self, predicted: Predicted, T_world_cam: Tensor, anchors: Anchors | None = None) -> Estimate:
        """See :meth:`Estimator.update`."""
        a, e = _variances(predicted, self._uses_variances)
        K = predicted.intrinsics[None]
        out = self.ufm(predicted.depth[None], T_world_cam[None], K, _one(a), _one(e), anchors=anchors)
        self._anchors = int(out.statistics.anchors_used[0])
        depth, variance = out.corrected() if self._corrected else (predicted.depth[None], out.variance)
        return _estimate(depth[0], variance[0], out.valid[0], a, e, out.disagreement[0])

    def state(self) -> dict[str, float]:
        """Bytes and number of the occupied components, with what anchors taught of them; the bytes of the moving
        average beside them."""
        mixture, smoothed = self.ufm.mixture, self.ufm.smoothed
        count = int(mixture.components.sum())
        smoothing = smoothed.numel() * smoothed.element_size()
        bytes_ = count * mixture.bytes_per_component()
        found: dict[str, float] = {"bytes": bytes_, "count": count, "smoothing_bytes": smoothing}
        if not self.ufm.config.anchored:
            return found
        learnt = (count + 1) * self.ufm.overall_evidence.numel() * self.ufm.overall_evidence.element_size()
        return {**found, "bytes": bytes_ + learnt, "anchors": self._anchors}


def _variances(predicted: Predicted, used: bool) -> tuple[Tensor | None, Tensor | None]:
    return (predicted.aleatoric, predicted.epistemic) if used else (None, None)


def _one(value: Tensor | None) -> Tensor | None:
    """As a batch of one."""
    return None if value is None else value[None]


def _estimate(depth: Tensor, variance: Tensor | None, valid: Tensor, *parts: Tensor | None) -> Estimate:
    """On the CPU."""
    a, e, m = (None if part is None else part.cpu() for part in parts)
    return Estimate(depth.cpu(), None if variance is None else variance.cpu(), valid.cpu(), a, e, m)

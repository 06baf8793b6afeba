"""Which pixels a metric may look at, and how many it had to leave out. Masks: True = use."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class Pixels:
    """The comparable pixels of one or more frames, flat and in float64."""

    depth: Tensor  # [P] predicted depth d [m]
    variance: Tensor  # [P] predicted variance v [m^2], >= 0; empty where a metric does not need it
    target: Tensor  # [P] ground-truth depth [m], > 0
    with_truth: Tensor  # [] int64, pixels with valid ground truth, whatever the prediction there


def select_pixels(depth: Tensor, variance: Tensor | None, target: Tensor, valid: Tensor | None = None) -> Pixels:
    """The pixels with valid ground truth and a usable prediction.

    Args:
        depth: [...] predicted depth d [m], any leading shape, floating point.
        variance: [...] predicted variance v [m^2], or None for metrics of depth alone.
        target: [...] ground-truth depth [m]; NaN, infinite or <= 0 means there is none.
        valid: [...] bool, True = use; None = everywhere.

    Raises:
        ValueError: an argument has another shape than ``depth`` or the wrong type.
    """
    check_maps(depth, variance, target, valid)
    truth = torch.isfinite(target) & (target > 0)
    truth = truth if valid is None else truth & valid
    usable = truth & torch.isfinite(depth)
    if variance is not None:
        usable = usable & torch.isfinite(variance) & (variance >= 0)

    def chosen(value: Tensor) -> Tensor:
        return value.detach()[usable].double()

    d = chosen(depth)
    return Pixels(d, d.new_zeros(0) if variance is None else chosen(variance), chosen(target), truth.sum())


def check_maps(depth: Tensor, variance: Tensor | None, target: Tensor, valid: Tensor | None) -> None:
    """Raise ValueError unless the maps have one shape, are floating point, and ``valid`` is bool."""
    for name, value in (("depth", depth), ("variance", variance), ("target", target), ("valid", valid)):
        if value is None:
            continue
        if value.shape != depth.shape:
            raise ValueError(f"{name} must have the depth's shape {tuple(depth.shape)}, got {tuple(value.shape)}")
        if name == "valid" and value.dtype != torch.bool:
            raise ValueError(f"valid must be a bool mask (True = use), got {value.dtype}")
        if name != "valid" and not torch.is_floating_point(value):
            raise ValueError(f"{name} must be floating point, got {value.dtype}")


def require_variance(variance: Tensor | None, metric: str) -> Tensor:
    """The variance, or a ValueError that names the metric."""
    if variance is None:
        raise ValueError(f"variance must be given: {metric} judges the predicted distribution N(depth, variance)")
    return variance

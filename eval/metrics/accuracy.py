"""Accuracy of the depth: delta1, AbsRel, RMSE over the pixels with valid ground truth."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

import torch
from torch import Tensor

from ufmstar_torch.eval.metrics.base import SumMetric, share
from ufmstar_torch.eval.metrics.pixels import Pixels, select_pixels


def _delta1_update(p: Pixels, tolerance: float) -> Tensor:
    """[] hits of the paper's delta1: |d - g| <= tolerance g."""
    return ((p.depth - p.target).abs() <= tolerance * p.target).sum()


def _delta1_ratio_update(p: Pixels, tolerance: float) -> Tensor:
    """[] hits of the depth literature's delta1: max(d/g, g/d) < 1 + tolerance; d <= 0 is a miss."""
    positive = p.depth > 0
    d = torch.where(positive, p.depth, torch.ones_like(p.depth))
    return (positive & (torch.maximum(d / p.target, p.target / d) < 1 + tolerance)).sum()


class Delta1(SumMetric):
    """delta1, the share of pixels with depth right within 25 % (section "Experimental Setup").

    ``compute()``: ``delta1``, in the paper's words "within 25 % of the ground truth", |d - g| <= .25 g;
    ``delta1_ratio``, as elsewhere in the literature, max(d/g, g/d) < 1.25; ``pixels``, how many were
    judged; ``left_out_share``, of the pixels with ground truth, those whose depth is NaN or infinite.
    Without any pixel the figures are NaN.

    Args:
        tolerance: .25 in both definitions.
    """

    hits: Tensor
    hits_ratio: Tensor
    pixels: Tensor
    with_truth: Tensor

    def __init__(self, tolerance: float = 0.25, **kwargs: Any) -> None:
        if not tolerance > 0:
            raise ValueError(f"tolerance must be positive, got {tolerance}")
        super().__init__({"tolerance": tolerance}, **kwargs)
        self.tolerance = tolerance
        for name in ("hits", "hits_ratio", "pixels", "with_truth"):
            self.add_count(name)

    def update(self, depth: Tensor, variance: Tensor | None, target: Tensor, valid: Tensor | None = None) -> None:
        p = select_pixels(depth, None, target, valid)
        n = torch.tensor(p.depth.numel())
        hits, ratio = _delta1_update(p, self.tolerance), _delta1_ratio_update(p, self.tolerance)
        self.add(hits=hits, hits_ratio=ratio, pixels=n, with_truth=p.with_truth)

    def compute(self) -> dict[str, Tensor]:
        return {
            "delta1": share(self.hits, self.pixels),
            "delta1_ratio": share(self.hits_ratio, self.pixels),
            "pixels": self.pixels.double(),
            "left_out_share": share(self.with_truth - self.pixels, self.with_truth),
        }


class _MeanError(SumMetric, ABC):
    """Mean over all pixels of an error, which a subclass defines."""

    total: Tensor
    pixels: Tensor

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.add_sum("total")
        self.add_count("pixels")

    def update(self, depth: Tensor, variance: Tensor | None, target: Tensor, valid: Tensor | None = None) -> None:
        error = self._error(select_pixels(depth, None, target, valid))
        self.add(total=error.sum(), pixels=torch.tensor(error.numel()))

    @abstractmethod
    def _error(self, p: Pixels) -> Tensor:
        """[N] the error of each pixel."""


class AbsRel(_MeanError):
    """Mean of |d - g| / g; ``compute()`` returns ``abs_rel``, NaN without a pixel."""

    def _error(self, p: Pixels) -> Tensor:
        return (p.depth - p.target).abs() / p.target

    def compute(self) -> dict[str, Tensor]:
        return {"abs_rel": share(self.total, self.pixels)}


class RMSE(_MeanError):
    """Root of the mean of (d - g)^2 over all pixels [m]; ``compute()`` returns ``rmse``, NaN without one."""

    def _error(self, p: Pixels) -> Tensor:
        return (p.depth - p.target).square()

    def compute(self) -> dict[str, Tensor]:
        return {"rmse": share(self.total, self.pixels).sqrt()}

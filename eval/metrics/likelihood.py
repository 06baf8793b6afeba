"""Negative log-likelihood and predictive entropy of N(d, v) (section "Metrics for Uncertainty")."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from ufmstar_torch.eval.metrics.base import SumMetric, share
from ufmstar_torch.eval.metrics.pixels import Pixels, check_maps


def gaussian_nll(depth: Tensor, variance: Tensor, target: Tensor) -> Tensor:
    """[...] (g - d)^2 / (2 v) + 0.5 ln(2 pi v), v > 0 [nats]."""
    return (target - depth).square() / (2 * variance) + 0.5 * (2 * math.pi * variance).log()


def gaussian_entropy(variance: Tensor) -> Tensor:
    """[...] 0.5 ln(2 pi e v) [nats, of a depth in metres]; -inf where v = 0."""
    return 0.5 * (2 * math.pi * math.e * variance).log()


class NLL(SumMetric):
    """Mean negative log-likelihood over the pixels with valid ground truth and v > 0.

    ``compute()``: ``nll`` [nats], NaN without a pixel; ``nll_left_out_share``, of the pixels with valid
    ground truth those without an NLL, because v = 0 there or the prediction is not finite: to be read
    beside the NLL, since a method may leave out its worst pixels.
    """

    OF_VARIANCE = "NLL"

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.add_sums("total")
        self.add_counts("pixels", "with_truth")

    def sums_of(self, p: Pixels) -> dict[str, Tensor]:
        positive = p.variance > 0
        nll = gaussian_nll(p.depth[positive], p.variance[positive], p.target[positive])
        return {"total": nll.sum(), "pixels": positive.sum(), "with_truth": p.with_truth}

    def compute(self) -> dict[str, Tensor]:
        left_out = share(self.with_truth - self.pixels, self.with_truth)
        return {"nll": share(self.total, self.pixels), "nll_left_out_share": left_out}


class EntropyHistogram(SumMetric):
    """Histogram of the predictive entropy 0.5 ln(2 pi e v) over all predicted pixels, with ground truth or without.

    ``compute()``: ``entropy_counts`` [bins + 2], first and last = under and over the range (v = 0 lies
    under it); ``entropy_edges`` [bins + 1] [nats]; ``entropy`` the mean over v > 0.

    Args:
        bins: equal-width bins over ``low`` to ``high``.
        low: [nats]; the default range is sigma = 81 um to 721 m.
        high: [nats].
    """

    OF_VARIANCE = "the entropy"

    def __init__(self, bins: int = 64, low: float = -8.0, high: float = 8.0, **kwargs: Any) -> None:
        if bins < 1 or not low < high:
            raise ValueError(f"bins must be >= 1 and low < high, got bins={bins}, low={low}, high={high}")
        super().__init__({"bins": bins, "low": low, "high": high}, **kwargs)
        self.edges = torch.linspace(low, high, bins + 1, dtype=torch.float64)
        self.add_counts("counts", shape=(bins + 2,))
        self.add_sums("total")
        self.add_counts("pixels")

    def update(self, depth: Tensor, variance: Tensor | None, target: Tensor, valid: Tensor | None = None) -> None:
        """See :meth:`SumMetric.update`; pixels without ground truth count too."""
        check_maps(depth, variance, target, valid)
        super().update(depth, variance, torch.ones_like(depth), valid)

    def sums_of(self, p: Pixels) -> dict[str, Tensor | float]:
        positive = p.variance[p.variance > 0]
        # Bin b is [edges[b - 1], edges[b]); v = 0 has the entropy -inf, which falls below the range by itself.
        index = torch.bucketize(gaussian_entropy(p.variance), self.edges.to(p.variance.device), right=True)
        counts = torch.bincount(index, minlength=self.edges.numel() + 1)
        return {"counts": counts, "total": gaussian_entropy(positive).sum(), "pixels": len(positive)}

    def compute(self) -> dict[str, Tensor]:
        return {
            "entropy": share(self.total, self.pixels),
            "entropy_counts": self.counts.double(),
            "entropy_edges": self.edges.to(self.counts.device),
        }

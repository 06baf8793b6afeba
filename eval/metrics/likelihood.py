"""Negative log-likelihood and predictive entropy of N(d, v) (section "Metrics for Uncertainty")."""

from __future__ import annotations

import math
from collections.abc import Mapping
from types import MappingProxyType

import torch
from torch import Tensor

from ufmstar_torch.eval.metrics.base import COUNT, SUM, Pixels, Selection, SumMetric, share


def gaussian_nll(pixels: Selection) -> Tensor:
    """(g - d)^2 / (2 v) + 0.5 ln(2 pi v), v > 0 [nats]."""
    return (pixels.squared / pixels.map("variance") + pixels.map("log_variance") + math.log(2 * math.pi)) / 2


class NLL(SumMetric):
    """Mean negative log-likelihood (g - d)^2 / (2 v) + 0.5 ln(2 pi v) over the pixels with ground truth and v > 0.

    ``compute()``: ``nll`` [nats], NaN without a pixel; ``nll_left_out_share``, the share of pixels with ground truth
    but without an NLL, because v = 0 or the prediction is not finite. Compare NLLs together with this share: a method
    may exclude its worst pixels.
    """

    OF_VARIANCE = "NLL"
    STATES = (("total", SUM), ("pixels", COUNT), ("with_truth", COUNT))

    def sums(self, pixels: Pixels) -> Mapping[str, Tensor]:
        chosen = pixels.judged.certain
        total = chosen.total(gaussian_nll(chosen))
        return {"total": total, "pixels": chosen.number(), "with_truth": pixels.with_truth.sum()}

    def compute(self) -> dict[str, Tensor]:
        left_out = share(self.with_truth - self.pixels, self.with_truth)
        return {"nll": share(self.total, self.pixels), "nll_left_out_share": left_out}


class EntropyHistogram(SumMetric):
    """Histogram of the predictive entropy 0.5 ln(2 pi e v) over all predicted pixels, with ground truth or without.

    ``compute()``: ``entropy_counts`` [66], first and last = below (v = 0 included) and above the range, which is
    sigma = 81 um to 721 m; ``entropy_edges`` [65] [nats]; ``entropy``, the mean over v > 0.
    """

    OF_VARIANCE = "the entropy"
    CONSTANTS = MappingProxyType({"edges": torch.linspace(-8.0, 8.0, 65, dtype=torch.float64)})
    STATES = (("counts", COUNT, 66), ("total", SUM), ("pixels", COUNT))

    def sums(self, pixels: Pixels) -> Mapping[str, Tensor]:
        every = Selection(pixels, pixels.predicted)
        positive = every.map("variance") > 0
        entropy = 0.5 * (math.log(2 * math.pi) + 1.0 + every.map("log_variance"))
        counts = every.histogram((entropy * 4 + 33).clamp(0, 65).long(), 66)  # edges .25 apart
        return {"counts": counts, "total": every.total(entropy.where(positive, 0.0)), "pixels": every.number(positive)}

    def compute(self) -> dict[str, Tensor]:
        return {
            "entropy": share(self.total, self.pixels),
            "entropy_counts": self.counts.double(),
            "entropy_edges": self.edges,
        }

"""Negative log-likelihood and predictive entropy of N(d, v) (section "Metrics for Uncertainty")."""

from __future__ import annotations

import torch
from torch import Tensor

from ufmstar_torch.eval.metrics.base import COUNT, SUM, SumMetric, share
from ufmstar_torch.eval.metrics.pixel_sums import add_entropy, add_nll


class NLL(SumMetric):
    """Mean negative log-likelihood (g - d)^2 / (2 v) + 0.5 ln(2 pi v) over the pixels with ground truth and v > 0.

    ``compute()``: ``nll`` [nats], NaN without a pixel; ``nll_left_out_share``, of the pixels with valid
    ground truth those without an NLL, because v = 0 there or the prediction is not finite: to be read
    beside the NLL, since a method may leave out its worst pixels.
    """

    OF_VARIANCE = "NLL"
    ADD = add_nll
    STATES = (("total", SUM), ("pixels", COUNT), ("with_truth", COUNT))

    def compute(self) -> dict[str, Tensor]:
        left_out = share(self.with_truth - self.pixels, self.with_truth)
        return {"nll": share(self.total, self.pixels), "nll_left_out_share": left_out}


class EntropyHistogram(SumMetric):
    """Histogram of the predictive entropy 0.5 ln(2 pi e v) over all predicted pixels, with ground truth or without.

    ``compute()``: ``entropy_counts`` [66], first and last = under and over the range (v = 0 lies
    under it), which is sigma = 81 um to 721 m; ``entropy_edges`` [65] [nats]; ``entropy`` the mean over v > 0.
    """

    OF_VARIANCE = "the entropy"
    ADD = add_entropy
    EDGES = torch.linspace(-8.0, 8.0, 65, dtype=torch.float64)
    CONSTANTS = (EDGES.numpy(),)
    STATES = (("counts", COUNT, 66), ("total", SUM), ("pixels", COUNT))

    def compute(self) -> dict[str, Tensor]:
        return {
            "entropy": share(self.total, self.pixels),
            "entropy_counts": self.counts.double(),
            "entropy_edges": self.EDGES.to(self.counts.device),
        }

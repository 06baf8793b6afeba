"""Accuracy of the depth: delta1, AbsRel, RMSE over the pixels with valid ground truth."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from ufmstar_torch.eval.metrics.base import COUNT, SUM, Pixels, SumMetric, share

TOLERANCE = 0.25  # [1] of delta1, in both definitions


class Delta1(SumMetric):
    """delta1, the share of pixels whose depth is right within 25 % (section "Experimental Setup").

    ``compute()``: ``delta1``, in the paper's words "within 25 % of the ground truth", |d - g| <= .25 g;
    ``delta1_ratio``, as elsewhere in the literature, max(d/g, g/d) < 1.25, False for d <= 0; ``pixels``, their number;
    ``left_out_share``, the share of pixels with ground truth whose depth is NaN or infinite.
    Without a pixel the figures are NaN.
    """

    STATES = (("hits", COUNT), ("hits_ratio", COUNT), ("pixels", COUNT), ("with_truth", COUNT))

    def sums(self, pixels: Pixels) -> Mapping[str, Tensor]:
        chosen = pixels.depths
        d, g = chosen
        return {
            "hits": chosen.number((d - g).abs() <= TOLERANCE * g),
            "hits_ratio": chosen.number((d > 0) & (torch.maximum(d / g, g / d) < 1 + TOLERANCE)),
            "pixels": chosen.number(),
            "with_truth": pixels.with_truth.sum(),
        }

    def compute(self) -> dict[str, Tensor]:
        return {
            "delta1": share(self.hits, self.pixels),
            "delta1_ratio": share(self.hits_ratio, self.pixels),
            "pixels": self.pixels.double(),
            "left_out_share": share(self.with_truth - self.pixels, self.with_truth),
        }


class AbsRel(SumMetric):
    """Mean of |d - g| / g; ``compute()`` returns ``abs_rel``, NaN without a pixel."""

    STATES = (("total", SUM), ("pixels", COUNT))

    def sums(self, pixels: Pixels) -> Mapping[str, Tensor]:
        d, g = pixels.depths
        return {"total": pixels.depths.total((d - g).abs() / g), "pixels": pixels.depths.number()}

    def compute(self) -> dict[str, Tensor]:
        return {"abs_rel": share(self.total, self.pixels)}


class RMSE(SumMetric):
    """Root of the mean of (d - g)^2 over all pixels [m]; ``compute()`` returns ``rmse``, NaN without one."""

    STATES = (("total", SUM), ("pixels", COUNT))

    def sums(self, pixels: Pixels) -> Mapping[str, Tensor]:
        d, g = pixels.depths
        return {"total": pixels.depths.total((d - g).square()), "pixels": pixels.depths.number()}

    def compute(self) -> dict[str, Tensor]:
        return {"rmse": share(self.total, self.pixels).sqrt()}

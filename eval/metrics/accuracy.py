"""Accuracy of the depth: delta1, AbsRel, RMSE."""

from __future__ import annotations

from collections.abc import Mapping

from torch import Tensor

from ufmstar_torch.eval.metrics.base import COUNT, SUM, TOLERANCE, Pixels, SumMetric, share


class DepthAccuracy(SumMetric):
    """Accuracy of the depth d over the pixels with ground truth g and a finite depth.

    ``compute()``: ``delta1``, the share of pixels whose depth is right within 25 % (section "Experimental Setup"), in
    the paper's words "within 25 % of the ground truth", |d - g| <= .25 g; ``delta1_ratio``, as elsewhere in the
    literature, max(d/g, g/d) < 1.25, False for d <= 0; ``abs_rel``, the mean of |d - g| / g; ``rmse`` [m], the root of
    the mean of (d - g)^2; ``pixels``, their number; ``left_out_share``, the share of pixels with ground truth whose
    depth is NaN or infinite. Without a pixel the figures are NaN.
    """

    STATES = (
        *((name, COUNT) for name in ("hits", "hits_ratio", "pixels", "with_truth")),
        *((name, SUM) for name in ("relative", "squared")),
    )

    def sums(self, pixels: Pixels) -> Mapping[str, Tensor]:
        chosen = pixels.depths
        d, g = chosen.map("depth"), chosen.map("target")
        most = 1 + TOLERANCE
        return {
            "hits": chosen.number(chosen.within),
            "hits_ratio": chosen.number((d < most * g) & (g < most * d)),
            "pixels": chosen.number(),
            "with_truth": pixels.with_truth.sum(),
            "relative": chosen.total(chosen.relative),
            "squared": chosen.total(chosen.squared),
        }

    def compute(self) -> dict[str, Tensor]:
        return {
            "delta1": share(self.hits, self.pixels),
            "delta1_ratio": share(self.hits_ratio, self.pixels),
            "pixels": self.pixels.double(),
            "left_out_share": share(self.with_truth - self.pixels, self.with_truth),
            "abs_rel": share(self.relative, self.pixels),
            "rmse": share(self.squared, self.pixels).sqrt(),
        }

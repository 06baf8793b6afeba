"""Calibration of N(d, v): ECE_delta and ECE_q with their curves (section "Metrics for Uncertainty")."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from ufmstar_torch.eval.metrics.base import COUNT, SUM, SumMetric, share
from ufmstar_torch.eval.metrics.pixel_sums import add_ece_delta, add_ece_quantile


class ECEDelta(SumMetric):
    """ECE_delta = sum_b |b|/S |acc(b) - conf(b)| and the delta calibration curve.

    Confidence: mass of N(d, v) on [(1 - delta) d, (1 + delta) d]; accuracy: 1 if the ground truth lies
    in that interval; B equal-width bins on [0, 1], of which three sums each are kept.
    ``compute()``: ``ece_delta``, NaN without a pixel; curve [B] ``ece_delta_confidence``,
    ``ece_delta_accuracy`` (NaN in empty bins) and ``ece_delta_pixels``; ``overconfidence`` = mean
    confidence - mean accuracy, positive where the variance is too small.

    A variant in circulation (the helper of the older MIT code) bins between the smallest and largest
    confidence, takes bin centres for conf(b), and tests the accuracy around the ground truth. Its
    figures differ, so do not compare them with these.

    Args:
        delta: half-width of the interval relative to the depth; the paper's .25.
        bins: B; the paper names none, 10 here; the authors' 100.
    """

    OF_VARIANCE = "ECE_delta"
    ADD = add_ece_delta

    def __init__(self, delta: float = 0.25, bins: int = 10, **kwargs: Any) -> None:
        if not 0 < delta < 1 or bins < 1:
            raise ValueError(f"delta must lie in (0, 1) and bins be >= 1, got delta={delta}, bins={bins}")
        self.settings, self.CONSTANTS = {"delta": delta, "bins": bins}, (delta,)
        self.STATES = (("confidence", SUM, bins), ("accurate", COUNT, bins), ("pixels", COUNT, bins))
        super().__init__(**kwargs)

    def compute(self) -> dict[str, Tensor]:
        total = self.pixels.sum()
        gap = self.confidence - self.accurate.double()
        return {
            "ece_delta": share(gap.abs().sum(), total),
            "overconfidence": share(gap.sum(), total),
            "ece_delta_confidence": share(self.confidence, self.pixels),
            "ece_delta_accuracy": share(self.accurate, self.pixels),
            "ece_delta_pixels": self.pixels.double(),
        }


class ECEQuantile(SumMetric):
    """ECE_q = 1/B sum_b |obs(q_b) - q_b| and the quantile calibration curve.

    The predicted quantile is the inverse CDF of N(d, v) at q_b, d itself where v = 0; obs(q_b) is the
    share of pixels whose ground truth lies at or below it.
    ``compute()``: ``ece_q``, NaN without a pixel; curve [B] ``ece_q_levels``, ``ece_q_observed``.

    Args:
        levels: q_b, rising, within [0, 1]; None = .05, .15, ..., .95 (B = 10, which the paper leaves open); the
            authors' 0, .01, ..., 1, of which the ends are right by definition.
    """

    OF_VARIANCE = "ECE_q"
    ADD = add_ece_quantile

    def __init__(self, levels: Sequence[float] | None = None, **kwargs: Any) -> None:
        levels = [(b + 0.5) / 10 for b in range(10)] if levels is None else list(levels)
        q = self.levels = torch.tensor(levels, dtype=torch.float64)
        if q.numel() == 0 or not bool(((q >= 0) & (q <= 1)).all() and (q.diff() > 0).all()):
            raise ValueError(f"levels must rise within [0, 1], got {levels}")
        self.settings, self.CONSTANTS = {"levels": levels}, (torch.special.ndtri(q).numpy(),)
        self.STATES = (("at_or_below", COUNT, len(levels)), ("pixels", COUNT))
        super().__init__(**kwargs)

    def compute(self) -> dict[str, Tensor]:
        levels = self.levels.to(self.pixels.device)
        observed = share(self.at_or_below, self.pixels)
        return {"ece_q": (observed - levels).abs().mean(), "ece_q_levels": levels, "ece_q_observed": observed}

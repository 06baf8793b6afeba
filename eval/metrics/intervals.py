"""Do central intervals hold as much ground truth as they state, and what does a gate on sigma keep?"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ufmstar_torch.eval.metrics.base import COUNT, Pixels, SumMetric, share

LEVELS = (0.5, 0.9, 0.99)
_PERCENT = 100  # classes of levels
# Thresholds of sigma / d, and bounds of the classes of the relative error, 8 % and 17 % apart.
_GATES = np.geomspace(0.01, 10.0, 91)
_ERRORS = np.geomspace(0.001, 10.0, 61)
_DELTA = 0.25
_MIDDLE = LEVELS.index(0.9)


class IntervalCoverage(SumMetric):
    """Coverage of the central intervals of a :class:`~ufmstar_torch.posterior.distribution.DepthDistribution`.

    The pixels are those with ground truth and a level: the level of the smallest interval that holds the ground truth.
    ``compute()``: ``coverage_50``, ``coverage_90``, ``coverage_99``, the shares of the pixels whose interval of 50, 90
    and 99 % holds the ground truth; curves [100] ``coverage_levels`` and ``coverage_found``. {} without a pixel: only a
    distribution with evidence has intervals.
    """

    OF_VARIANCE = "the coverage of intervals"
    STATES = (("levels", COUNT, _PERCENT),)

    def sums(self, pixels: Pixels) -> Mapping[str, Any]:
        if not len(pixels.level):
            return {}
        level = pixels.level[pixels.with_truth & np.isfinite(pixels.level)]
        kind = np.ceil(level * _PERCENT - 1e-9).astype(np.intp) - 1
        return {"levels": np.bincount(kind.clip(0, _PERCENT - 1), minlength=_PERCENT)}

    def compute(self) -> dict[str, Tensor]:
        count = self.levels.sum()
        if not int(count):
            return {}
        found = share(self.levels.cumsum(0), count)
        named = {f"coverage_{level:.0%}".rstrip("%"): found[round(level * _PERCENT) - 1] for level in LEVELS}
        levels = torch.arange(1, _PERCENT + 1, dtype=torch.float64) / _PERCENT
        return {**named, "coverage_levels": levels, "coverage_found": found}


class GatedPixels(SumMetric):
    """The pixels that a gate sigma / d <= threshold keeps, for 91 thresholds from .01 to 10.

    The pixels are those with ground truth g and a valid depth and variance. ``compute()`` has curves [91], NaN where
    nothing is kept: ``gate_threshold``; ``gate_kept``, share of the pixels; of those kept, ``gate_error``, the median
    |d - g|/g, interpolated in classes 17 % wide, ``gate_delta1``, the share with |d - g| <= .25 g, and
    ``gate_coverage``, the share of those with a level whose interval of 90 % holds g.
    """

    OF_VARIANCE = "a gate"
    STATES = (
        ("errors", COUNT, len(_GATES) + 1, len(_ERRORS) + 1),
        *((name, COUNT, len(_GATES) + 1) for name in ("accurate", "with_level", "covered")),
    )

    def sums(self, pixels: Pixels) -> Mapping[str, Any]:
        d, v, g = pixels.judged
        error, gates = np.abs(d - g) / g, len(_GATES) + 1
        with np.errstate(divide="ignore", invalid="ignore"):
            gate = np.searchsorted(_GATES, np.sqrt(v) / d)  # d = 0 is beyond every gate
        joint = gate * (len(_ERRORS) + 1) + np.searchsorted(_ERRORS, error)
        sums = {
            "errors": np.bincount(joint, minlength=gates * (len(_ERRORS) + 1)).reshape(gates, -1),
            "accurate": np.bincount(gate[error <= _DELTA], minlength=gates),
        }
        if len(pixels.level):
            level = pixels.level[pixels.with_truth & pixels.predicted]
            sums["with_level"] = np.bincount(gate[np.isfinite(level)], minlength=gates)
            sums["covered"] = np.bincount(gate[level <= LEVELS[_MIDDLE]], minlength=gates)
        return sums

    def compute(self) -> dict[str, Tensor]:
        errors = self.errors.cumsum(0)[:-1]
        pixels = errors.sum(1)
        median = _median(errors, torch.from_numpy(_ERRORS).log())
        accurate, with_level, covered = (x.cumsum(0)[:-1] for x in (self.accurate, self.with_level, self.covered))
        return {
            "gate_threshold": torch.from_numpy(_GATES),
            "gate_kept": share(pixels, self.errors.sum()),
            "gate_error": median,
            "gate_delta1": share(accurate, pixels),
            "gate_coverage": share(covered, with_level),
        }


def _median(counts: Tensor, edges: Tensor) -> Tensor:
    """[G] exp of the medians of G histograms [G, E + 1] between the logarithms ``edges`` [E], on the CPU; NaN without a
    count. Values below the first and above the last edge count as these."""
    below = counts.cpu().cumsum(1).double()
    half = below[:, -1:] / 2
    kind = (below < half).sum(1, keepdim=True).clamp_max(len(edges))
    start, end = torch.cat([edges[:1], edges]), torch.cat([edges, edges[-1:]])
    before = torch.gather(torch.nn.functional.pad(below, (1, 0)), 1, kind)
    share = (half - before) / (torch.gather(below, 1, kind) - before)
    return torch.lerp(start[kind], end[kind], share)[:, 0].exp()

"""All metrics of one sequence, and their mean and confidence interval over sequences."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from types import MappingProxyType
from typing import Any

from torch import Tensor, nn

from ufmstar_torch.eval.metrics.accuracy import DepthAccuracy
from ufmstar_torch.eval.metrics.base import SumMetric, flat_pixels
from ufmstar_torch.eval.metrics.calibration import ECEDelta, ECEQuantile
from ufmstar_torch.eval.metrics.intervals import GatedPixels, IntervalCoverage
from ufmstar_torch.eval.metrics.likelihood import NLL, EntropyHistogram
from ufmstar_torch.eval.metrics.mixture import Mixture
from ufmstar_torch.eval.metrics.ranking import Sparsification, SpearmanCorrelation
from ufmstar_torch.runtime.kinds import check_kinds

OURS, AUTHORS = "ours", "authors"
BINS = (OURS, AUTHORS)
_PLUGIN_PREFIX = "own_"  # of the names of a user's metrics
_LEVELS = [level / 100 for level in range(101)]
_AUTHORS: dict[type[SumMetric], dict[str, Any]] = {ECEDelta: {"bins": 100}, ECEQuantile: {"levels": _LEVELS}}


class SequenceMetrics(nn.Module):
    """delta1, AbsRel, RMSE and, with a variance, NLL, ECE_delta, ECE_q, entropy, AUSE, AURG, Spearman of one sequence.

    Memory is 2.4 MB for any number of frames. ``state_dict`` saves the sums; ``merge_state`` adds those of another part
    of the sequence.

    Args:
        with_variance: False for a network that predicts depth alone.
        bins: of the calibration errors: "ours", 10 of the confidence and 10 levels, or "authors", 100 and 101.
        gates: False to leave out ``GatedPixels``, which has curves alone.
        plugins: a user's classes of ``SumMetric`` by name; their figures are called "own.FIGURE". Those that need a
            variance are ignored without one.
    """

    @check_kinds
    def __init__(
        self,
        *,
        with_variance: bool = True,
        bins: str = OURS,
        gates: bool = True,
        plugins: Mapping[str, Any] = MappingProxyType({}),
    ) -> None:
        super().__init__()
        if bins not in BINS:
            raise ValueError(f"bins must be one of {', '.join(BINS)}, got {bins!r}")
        self.with_variance = with_variance
        kinds: list[type[SumMetric]] = [DepthAccuracy]
        if with_variance:
            kinds += [NLL, ECEDelta, ECEQuantile, EntropyHistogram, Sparsification, SpearmanCorrelation, Mixture]
            kinds += [IntervalCoverage, *([GatedPixels] if gates else ())]
        finer = _AUTHORS if bins == AUTHORS else {}
        made = {kind.__name__: kind(**finer.get(kind, {})) for kind in kinds}
        usable = {name: kind for name, kind in plugins.items() if with_variance or not kind.OF_VARIANCE}
        made |= {f"{_PLUGIN_PREFIX}{name}": kind() for name, kind in usable.items()}
        self.metrics = nn.ModuleDict(made)

    def update(
        self, depth: Tensor, variance: Tensor | None, target: Tensor, valid: Tensor | None = None,
        mixture: tuple[Tensor, Tensor] | None = None, level: Tensor | None = None,
    ) -> None:  # fmt: skip
        """Add one or more frames.

        Args:
            depth: [...] predicted depth [m].
            variance: [...] predicted variance [m^2]; None only with ``with_variance=False``.
            target: [...] ground truth [m]; NaN or <= 0 means there is none.
            valid: [...] bool, True = use.
            mixture: of a posterior (``Mixture``), the inliers' variance and the probability of an outlier, [...] each.
            level: [...] of the smallest central interval with the ground truth in it (``IntervalCoverage``), or NaN.

        All figures except the entropy use the pixels with ground truth.

        Raises:
            ValueError: shapes or types disagree, or a needed variance is missing.
        """
        pixels = flat_pixels(depth, variance, target, valid, mixture, level)
        for metric in self._all():
            if not metric.NEEDS or len(getattr(pixels, metric.NEEDS)):
                metric.add(pixels)

    def compute(self) -> dict[str, float]:
        """The scalar figures by name: delta1, delta1_ratio, abs_rel, rmse [m], nll, ece_delta, ece_q, ...

        NaN where there was no pixel (``pixels`` is 0 then).
        """
        return {name: float(value) for name, value in self._results().items() if value.dim() == 0}

    def curves(self) -> dict[str, list[float]]:
        """The curves and histograms by name, for plots and JSON."""
        return {name: value.tolist() for name, value in self._results().items() if value.dim() > 0}

    def merge_state(self, other: SequenceMetrics) -> None:
        """Add the sums of another part of the same sequence. Raises ValueError: the other part has other metrics."""
        if other.metrics.keys() != self.metrics.keys():
            raise ValueError(f"other must hold the metrics {list(self.metrics)}, got {list(other.metrics)}")
        for mine, theirs in zip(self._all(), other._all(), strict=True):
            mine.merge_state(theirs)

    def reset(self) -> None:
        """Forget all frames."""
        for metric in self._all():
            metric.reset()

    def _all(self) -> list[SumMetric]:
        return [m for m in self.metrics.values() if isinstance(m, SumMetric)]

    def _results(self) -> dict[str, Tensor]:
        return {
            f"own.{name}" if kind.startswith(_PLUGIN_PREFIX) else name: value
            for kind, metric in zip(self.metrics, self._all(), strict=True)
            for name, value in metric.compute().items()
        }


@check_kinds
def mean_and_ci(values: Iterable[float]) -> tuple[float, float]:
    """Mean over sequences and the half-width of its 95 % confidence interval, t_(n-1) s / sqrt(n).

    Student's t, because sequences are few; at the paper's 100 sequences it is within 1.3 %
    of 1.96 s / sqrt(n). NaN values (a sequence without ground truth) are left out.

    Args:
        values: one figure per sequence.

    Returns:
        (mean, half-width); the half-width is NaN for fewer than two values, both for none.
    """
    finite = [float(v) for v in values if not math.isnan(v)]
    if len(finite) < 2:
        return (finite[0] if finite else math.nan), math.nan
    from scipy.stats import sem, t

    return math.fsum(finite) / len(finite), float(t.ppf(0.975, len(finite) - 1) * sem(finite))

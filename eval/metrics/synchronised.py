"""The metrics as ``torchmetrics.Metric`` classes, whose states are added over processes.

Importing torchmetrics takes seconds and 200 MB, which commands that evaluate in one process do without.
"""

from __future__ import annotations

from typing import Any

from torch import Tensor
from torchmetrics import Metric

from ufmstar_torch.eval.metrics import accuracy, calibration, intervals, likelihood, ranking
from ufmstar_torch.eval.metrics.base import SumMetric


class Synchronised(SumMetric, Metric):
    """Holds the states of a :class:`SumMetric` where torchmetrics finds them: it synchronises them at ``compute``,
    unless ``sync_on_compute=False``. Keywords are those of ``torchmetrics.Metric``."""

    is_differentiable = False
    full_state_update = False
    reset = Metric.reset

    def __init__(self, **kwargs: Any) -> None:
        # torchmetrics keeps a computed value across merge_state and load_state_dict, where it is stale.
        super().__init__(**{"compute_with_cache": False, **kwargs})

    def _hold(self, name: str, zeros: Tensor) -> None:
        self.add_state(name, zeros, dist_reduce_fx="sum", persistent=True)

    def merge_state(self, incoming_state: Any) -> None:
        SumMetric.merge_state(self, incoming_state)

    @property
    def update_called(self) -> bool:
        """True, because loaded or merged sums are valid too, and figures without a frame are NaN."""
        return True


def _synchronised(kind: type[SumMetric]) -> type[SumMetric]:
    """The class with synchronised states, under the same name in this module."""
    return type(kind.__name__, (kind, Synchronised), {"__module__": __name__, "__doc__": kind.__doc__})


DepthAccuracy = _synchronised(accuracy.DepthAccuracy)
ECEDelta, ECEQuantile = map(_synchronised, (calibration.ECEDelta, calibration.ECEQuantile))
Coverage = _synchronised(intervals.Coverage)
NLL, EntropyHistogram = map(_synchronised, (likelihood.NLL, likelihood.EntropyHistogram))
NLLByError = _synchronised(ranking.NLLByError)
Sparsification, SpearmanCorrelation = map(_synchronised, (ranking.Sparsification, ranking.SpearmanCorrelation))

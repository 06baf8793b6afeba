"""Streaming metrics (section "Metrics for Uncertainty"): sums only, so that memory does not grow with frames.

The single metrics below are ``torchmetrics.Metric`` classes (``synchronised``), ``SequenceMetrics`` is not.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from ufmstar_torch.runtime.optional import lazy_names

if TYPE_CHECKING:
    from ufmstar_torch.eval.metrics.accuracy import DepthAccuracy as DepthAccuracy
    from ufmstar_torch.eval.metrics.calibration import ECEDelta as ECEDelta
    from ufmstar_torch.eval.metrics.calibration import ECEQuantile as ECEQuantile
    from ufmstar_torch.eval.metrics.intervals import Coverage as Coverage
    from ufmstar_torch.eval.metrics.likelihood import NLL as NLL
    from ufmstar_torch.eval.metrics.likelihood import EntropyHistogram as EntropyHistogram
    from ufmstar_torch.eval.metrics.ranking import NLLByError as NLLByError
    from ufmstar_torch.eval.metrics.ranking import Sparsification as Sparsification
    from ufmstar_torch.eval.metrics.ranking import SpearmanCorrelation as SpearmanCorrelation
    from ufmstar_torch.eval.metrics.sequence import SequenceMetrics as SequenceMetrics
    from ufmstar_torch.eval.metrics.sequence import mean_and_ci as mean_and_ci
else:
    _SINGLE = ("DepthAccuracy", "ECEDelta", "ECEQuantile", "Coverage", "NLL", "EntropyHistogram", "NLLByError")
    _SINGLE += ("Sparsification", "SpearmanCorrelation")
    __getattr__, __dir__ = lazy_names(__name__, **dict.fromkeys(_SINGLE, "ufmstar_torch.eval.metrics.synchronised"))

"""The figures of a run against ground truth: UfM*'s, and beside them those of the depth network alone."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import torch
from numpy.typing import NDArray
from torch import Tensor

from ufmstar_torch.pipeline import UncertainPrediction

if TYPE_CHECKING:  # torchmetrics takes seconds to import, which a sequence without ground truth need not wait for
    from ufmstar_torch.eval.metrics import SequenceMetrics

UFM, ALONE = "ufm", "network_alone"


class Judge:
    """Metrics by method, made when the first frame with ground truth comes.

    Args:
        sums: of an earlier judge, from :meth:`state`.
    """

    def __init__(self, sums: Mapping[str, Mapping[str, Tensor]] | None = None) -> None:
        self._metrics: dict[str, SequenceMetrics] = {}
        for name, values in (sums or {}).items():
            self._of(name).load_state_dict(dict(values))

    def update(self, result: UncertainPrediction, truth: NDArray | None) -> None:
        """Add a frame.

        Args:
            result: of one stream, [1, h, w].
            truth: [h, w] ground truth [m], 0 = none; or None.
        """
        if truth is None:
            return
        target = torch.from_numpy(truth)
        depth, valid = result.depth[0].cpu(), result.ufm.valid[0].cpu()
        self._of(UFM).update(depth, result.variance[0].cpu(), target, valid)
        own = result.prediction.variance
        if own is not None:
            self._of(ALONE).update(depth, own[0].cpu(), target, valid)

    def state(self) -> dict[str, dict[str, Tensor]]:
        """The sums, by method and name. They are exchanged by updates, never changed in place."""
        return {name: dict(metrics.state_dict()) for name, metrics in self._metrics.items()}

    def figures(self) -> dict[str, dict[str, float]]:
        """delta1, nll, ece_delta, ece_q, spearman, ... by method; without ground truth nothing."""
        return {name: metrics.compute() for name, metrics in self._metrics.items()}

    def curves(self) -> dict[str, dict[str, Any]]:
        """Calibration and sparsification curves and the entropy histogram, by method."""
        return {name: metrics.curves() for name, metrics in self._metrics.items()}

    def _of(self, name: str) -> SequenceMetrics:
        from ufmstar_torch.eval.metrics import SequenceMetrics

        if name not in self._metrics:
            self._metrics[name] = SequenceMetrics()
        return self._metrics[name]

"""Figures against ground truth, as sinks of a stream: of a run, and of the rows of an evaluation.

For the figure of NLL by error, the paper looks at the pixels where the ensemble (left panel) or UfM-Ensemble (right) is
confident and shows the other methods' NLL there. Which pixels these are it leaves open; here, the share ``confident``
of the reference's pixels with the smallest variance, of every frame, and of all sequences with one threshold. All rows
on the same frames are judged on the same pixels.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from ufmstar_torch.eval.engine.rows import RowResult
from ufmstar_torch.eval.engine.stream import FrameResult, FrameSink
from ufmstar_torch.eval.methods import method
from ufmstar_torch.eval.methods.row import Row

if TYPE_CHECKING:  # torchmetrics takes seconds to import, which a sequence without ground truth need not wait for
    from ufmstar_torch.eval.metrics import NLLByError, SequenceMetrics

# Of a run: UfM*, beside it the network alone, and the posterior where there is one.
UFM, ALONE, POSTERIOR = "ufm", "network_alone", "posterior"
# Of a row's sums.
METRICS, BY_ERROR, BY_ERROR_OF_ALL = "metrics", "nll_by_error", "nll_by_error_of_all"
# Of the sums with one threshold: variances within 60 % of each other share a level, errors within 11 % a bin.
OF_ALL = {"levels": 60, "bins": 128}


def metrics_of(metrics: dict[str, SequenceMetrics], key: str, **how: Any) -> SequenceMetrics:
    """The metrics of a key, made now (see ``SequenceMetrics``) if there are none."""
    from ufmstar_torch.eval.metrics import SequenceMetrics

    if key not in metrics:
        metrics[key] = SequenceMetrics(**how)
    return metrics[key]


class RunMetrics(FrameSink):
    """The figures of a run's row, ``UFM``, beside them those of its network alone, ``ALONE``, and of its ``POSTERIOR``.
    All are of the pixels that the row uses; the others are masked. ``sums`` are those of an earlier part of the run."""

    stage: str | None = "metrics"

    def __init__(self, key: str, sums: Mapping[str, Mapping[str, Tensor]]) -> None:
        self._key = key
        self._metrics: dict[str, SequenceMetrics] = {}
        for name, state in sums.items():
            metrics_of(self._metrics, name).load_state_dict(dict(state))

    def sums(self) -> dict[str, dict[str, Tensor]]:
        """By name. They are exchanged by updates, never changed in place."""
        return {name: metrics.sums() for name, metrics in self._metrics.items()}

    def figures(self) -> dict[str, dict[str, float]]:
        """delta1, nll, ece_delta, ece_q, spearman, ... by name; without ground truth nothing."""
        return {name: metrics.compute() for name, metrics in self._metrics.items()}

    def curves(self) -> dict[str, dict[str, Any]]:
        """Calibration and sparsification curves and the entropy histogram, by name."""
        return {name: metrics.curves() for name, metrics in self._metrics.items()}

    def take(self, result: FrameResult) -> None:
        """Add a frame."""
        row = result.rows.get(self._key)
        if row is None or row.truth is None:
            return
        target = torch.from_numpy(row.truth)
        maps: dict[str, tuple[Tensor, Tensor | None]] = {UFM: (row.depth, row.variance)}
        maps |= {} if row.network_variance is None else {ALONE: (row.depth, row.network_variance)}
        if row.posterior_depth is not None:
            maps[POSTERIOR] = row.posterior_depth, row.posterior_variance
        for name, (depth, variance) in maps.items():
            metrics_of(self._metrics, name).update(depth, variance, target, row.valid)


class RowMetrics(FrameSink):
    """The figures of every row of an evaluation.

    Pixels that a row leaves out are NaN, not masked, so that the metrics count them.

    Args:
        references: by row, the rows on whose confident pixels its NLL is binned by error, and their names.
        confident: of the pixels of a frame, the share of which a reference counts as confident.
        bins: of the calibration errors, see ``SequenceMetrics``.

    Attributes:
        judged: frames with ground truth, by row.
    """

    def __init__(self, references: Mapping[str, Mapping[str, str]], confident: float, bins: str = "ours") -> None:
        self._references, self._confident = references, confident
        self._metrics: dict[str, SequenceMetrics] = {}
        self._bins = bins
        self._by_error: dict[str, dict[str, NLLByError]] = {}
        self.judged = dict.fromkeys(references, 0)

    def take(self, result: FrameResult) -> None:
        """Add a frame."""
        targets = {key: torch.from_numpy(row.truth) for key, row in result.rows.items() if row.truth is not None}
        expected = {other for key in targets for other in self._references[key]}
        masks = {other: confident_pixels(result.rows[other], targets[other], self._confident) for other in expected}
        for key, target in targets.items():
            self._judge(key, result, target, masks)

    def _judge(self, key: str, result: FrameResult, target: Tensor, masks: Mapping[str, Tensor]) -> None:
        from ufmstar_torch.eval.metrics import NLLByError

        row = result.rows[key]
        self.judged[key] += 1
        depth = torch.where(row.valid, row.depth, torch.nan)
        metrics = metrics_of(self._metrics, key, with_variance=row.variance is not None, bins=self._bins)
        metrics.update(depth, row.variance, target)
        if row.variance is None:
            return
        binned = self._by_error.setdefault(key, {})
        for other, name in self._references[key].items():
            by_error = binned.setdefault(f"{BY_ERROR}:{name}", NLLByError(sync_on_compute=False))
            by_error.update(depth, row.variance, target, masks[other])
            of_all = binned.setdefault(f"{BY_ERROR_OF_ALL}:{name}", NLLByError(**OF_ALL, sync_on_compute=False))
            reference = result.rows[other]
            assert reference.variance is not None
            of_all.add_levels(depth, row.variance, target, torch.where(reference.valid, reference.variance, torch.nan))

    def figures(self, key: str) -> dict[str, float]:
        """``SequenceMetrics.compute`` of a judged row."""
        return self._metrics[key].compute()

    def curves(self, key: str) -> dict[str, Any]:
        """``SequenceMetrics.curves`` of a judged row, and its NLL and error by reference."""
        curves: dict[str, Any] = self._metrics[key].curves()
        for name, by_error in self._by_error.get(key, {}).items():
            kind, _, reference = name.partition(":")
            if kind == BY_ERROR:
                curves |= {f"{curve}:{reference}": values.tolist() for curve, values in by_error.compute().items()}
        return curves

    def sums(self, key: str) -> dict[str, dict[str, Tensor]]:
        """States of a judged row's metrics on the CPU by name: "metrics", "nll_by_error:REFERENCE" and
        "nll_by_error_of_all:REFERENCE"."""
        named: dict[str, Any] = {METRICS: self._metrics[key], **self._by_error.get(key, {})}
        return {name: {entry: value.cpu() for entry, value in m.state_dict().items()} for name, m in named.items()}


def references(row: Row, rows: Sequence[Row]) -> list[Row]:
    """Whose confidence a row is judged by: its base alone, and behind UfM with the fewest points that are among
    ``rows`` and see the same frames; of several settings the row's own, or else the default."""

    def seen(other: Row) -> tuple[str, int, str]:  # from which frames, and which part of them
        return other.method.base, other.setting.skip, other.setting.preprocess

    def points(other: Row) -> float:
        return math.inf if other.method.max_points is None else other.method.max_points

    same = [other for other in rows if seen(other) == seen(row)]
    alone = [other for other in same if other.method.fusion == method.ALONE and other.method.uses_aleatoric]
    pointwise = [other for other in same if other.method.fusion == method.UFM and not other.method.full]
    fewest = min((points(other) for other in pointwise), default=0)
    chosen = []
    for kind in (alone, [other for other in pointwise if points(other) == fewest]):
        if kind:
            chosen.append(
                min(kind, key=lambda other: (other.setting.pose_noise != row.setting.pose_noise, other.setting.slug))
            )
    return chosen


def confident_pixels(row: RowResult, truth: Tensor, share: float) -> Tensor:
    """[h, w] bool, of the pixels with ground truth [h, w] [m] (0 = none) those whose variance is at or below the
    frame's ``share`` quantile, in (0, 1]."""
    assert row.variance is not None
    judged = row.valid & (truth > 0)
    values = row.variance[judged]
    if not len(values):
        return judged
    threshold = values.kthvalue(max(1, math.ceil(share * len(values)))).values
    return judged & (torch.where(judged, row.variance, torch.inf) <= threshold)

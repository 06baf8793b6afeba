"""One row on its way through a sequence: its estimator, its metrics and its counts."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from statistics import median
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ufmstar_torch.eval.engine.anchor_source import AnchorSource
from ufmstar_torch.eval.engine.estimator import Estimate, make_estimator
from ufmstar_torch.eval.engine.predicted import Predicted
from ufmstar_torch.eval.engine.run_clock import Stopwatch
from ufmstar_torch.eval.methods.perturb import Drift, perturbed, selects
from ufmstar_torch.eval.methods.row import Row
from ufmstar_torch.eval.metrics import NLLByError, SequenceMetrics
from ufmstar_torch.eval.sequences.frame import Frame

METRICS = "metrics"
BY_ERROR = "nll_by_error"


class RowRun:
    """A row in the middle of a sequence.

    Args:
        row: which.
        device: of its estimator.
        references: names of the methods on whose confident pixels its NLL is binned by error.
        anchors: where its anchors come from; None = it has none.

    Attributes:
        done: frames that it has used so far.
        last: name and [4, 4] pose of the last of them.
        estimator: see ``make_estimator``.

    Raises:
        ValueError: see ``make_estimator``.
    """

    def __init__(
        self, row: Row, device: torch.device, references: list[str], anchors: AnchorSource | None = None
    ) -> None:
        self.row = row
        self._anchors = anchors
        self._drift = Drift(row.setting)
        self.estimator = make_estimator(row, device)
        self.done = 0
        self.last: tuple[str, Any] | None = None
        self._clock = Stopwatch(device)
        self._references = references
        self._metrics: SequenceMetrics | None = None
        self._by_error: dict[str, NLLByError] = {}
        self._reasons: Counter[str] = Counter()
        self._judged = self._selected = 0
        self._ms: dict[str, list[float]] = {"network": [], "anchors": [], "uncertainty": []}
        self._state = _StateLog()

    def selects(self, number: int) -> bool:
        """Whether the row uses image ``number`` of those to be judged."""
        return selects(self.row.setting, number)

    def skip(self, reason: str) -> None:
        """Count a frame that cannot be used."""
        self._selected += 1
        self._reasons[reason] += 1

    def estimate(self, frame: Frame, predicted: Predicted, truth: NDArray[np.float32]) -> Estimate:
        """Take in the next frame; its ground truth [h, w] is for anchors of it alone."""
        T = perturbed(self._drift.of(frame.T_world_cam, frame.index), self.row.setting, frame.index)
        anchors = None
        if self._anchors is not None:
            anchors, ms = self._anchors.of(frame, T, predicted, truth)
            self._ms["anchors"] += [] if ms is None else [ms]
        with self._clock.stage("uncertainty"):
            estimate = self.estimator.update(predicted, torch.from_numpy(T), anchors)
        self._ms["uncertainty"].append(self._clock.take()["uncertainty"])
        if predicted.ms is not None:
            self._ms["network"].append(predicted.ms)
        self._state.add(self.estimator.state())
        self.done += 1
        self._selected += 1
        self.last = (frame.name, T)
        return estimate

    def judge(self, estimate: Estimate, truth: Tensor, confident: Mapping[str, Tensor]) -> None:
        """Add a frame to the metrics.

        Args:
            estimate: the row's.
            truth: [h, w] [m], 0 = none.
            confident: [h, w] bool by reference.
        """
        self._judged += 1
        # NaN and not a mask, so that the metrics count what the row leaves out of the pixels with ground truth.
        depth = torch.where(estimate.valid, estimate.depth, torch.nan)
        if self._metrics is None:
            self._metrics = SequenceMetrics(with_variance=estimate.variance is not None)
        self._metrics.update(depth, estimate.variance, truth)
        if estimate.variance is None:
            return
        for name in self._references:
            binned = self._by_error.setdefault(name, NLLByError(sync_on_compute=False))
            binned.update(depth, estimate.variance, truth, confident[name])

    def frames(self) -> dict[str, Any]:
        """Counts, as ``Record`` has them."""
        skipped = sum(self._reasons.values())
        counts = {"selected": self._selected, "done": self.done, "judged": self._judged, "skipped": skipped}
        return {**counts, "reasons": dict(sorted(self._reasons.items()))}

    def figures(self) -> dict[str, float]:
        """``SequenceMetrics.compute``; {} if nothing was judged."""
        return {} if self._metrics is None else self._metrics.compute()

    def curves(self) -> dict[str, Any]:
        """``SequenceMetrics.curves``, and the NLL and error by reference."""
        found: dict[str, Any] = {} if self._metrics is None else self._metrics.curves()
        for reference, binned in self._by_error.items():
            found |= {f"{name}:{reference}": curve.tolist() for name, curve in binned.compute().items()}
        return found

    def state(self) -> dict[str, float]:
        """What the method kept over the sequence, as ``Record`` has it."""
        return self._state.summary()

    def ms(self) -> dict[str, float]:
        """Median times per frame [ms]; without the network's where all predictions were read from the cache."""
        return {stage: median(times) for stage, times in self._ms.items() if times}

    def sums(self) -> dict[str, dict[str, Tensor]]:
        """States of the metrics by name."""
        named: dict[str, Any] = {} if self._metrics is None else {METRICS: self._metrics}
        named |= {f"{BY_ERROR}:{reference}": binned for reference, binned in self._by_error.items()}
        return {name: {key: value.cpu() for key, value in m.state_dict().items()} for name, m in named.items()}


class _StateLog:
    """Mean, largest and last of the bytes and counts, without keeping them all."""

    def __init__(self) -> None:
        self._frames = 0
        self._sum: dict[str, float] = {}
        self._most: dict[str, float] = {}
        self._last: dict[str, float] = {}

    def add(self, state: Mapping[str, float]) -> None:
        self._frames += 1
        self._last = dict(state)
        for name, value in state.items():
            self._sum[name] = self._sum.get(name, 0) + value
            self._most[name] = max(value, self._most.get(name, 0))

    def summary(self) -> dict[str, float]:
        found: dict[str, float] = {}
        for name in ("bytes", "count"):
            if name in self._last:
                mean = self._sum[name] / self._frames
                found |= {f"{name}_mean": mean, f"{name}_max": self._most[name], f"{name}_end": self._last[name]}
        if "anchors" in self._last:
            found["anchors_mean"] = self._sum["anchors"] / self._frames
        if "smoothing_bytes" in self._last:
            found["smoothing_bytes"] = self._last["smoothing_bytes"]
        return found

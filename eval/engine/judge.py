"""Figures against ground truth: of a run, and of the rows of an evaluation.

The paper's figure of NLL by error uses the pixels where the ensemble (left panel) or UfM-Ensemble (right) is confident,
without a definition. Here they are the half of the reference's pixels with the smallest variance in every frame
(``RowResult.confident``). All rows on the same frames are evaluated on the same pixels.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from statistics import median
from typing import Any

import torch
from torch import Tensor

from ufmstar_torch.eval.engine.record import METRICS, Record
from ufmstar_torch.eval.engine.rows import RowResult, RowRunner
from ufmstar_torch.eval.engine.stream import FrameResult
from ufmstar_torch.eval.methods import method
from ufmstar_torch.eval.methods.row import Row
from ufmstar_torch.eval.metrics.ranking import NLLByError
from ufmstar_torch.eval.metrics.sequence import SequenceMetrics

# Names of a run's figures: of UfM*, of the network alone, and of the posterior if there is one.
UFM, ALONE, POSTERIOR = "ufm", "network_alone", "posterior"
# Names under which a row stores its sums, in addition to those of METRICS.
BY_ERROR, CONFIDENCE = "nll_by_error", "confidence"
EACH = 512  # evenly spaced pixels of a frame for ``ufmstar recalibrate --covariate confidence``
PluginMetrics = Mapping[str, Any]  # the user's metrics by name (``sequences.plugins``)


class SequenceError(Exception):
    """A sequence cannot be used as a whole: no frame can be read, or there is no ground truth."""


def add_to(
    metrics: dict[str, SequenceMetrics], key: str, row: RowResult, maps: tuple[Tensor, Tensor | None],
    valid: Tensor | None = None, mixture: tuple[Tensor, Tensor] | None = None, level: Tensor | None = None, **how: Any,
) -> None:  # fmt: skip
    """Add a row's frame with ground truth to the metrics of a key, and of "key.moving" and "key.still" where it is
    known what moves (``RowResult.parts``); they are created with the arguments ``how`` of ``SequenceMetrics``. The
    other arguments, with depth and variance in ``maps``, are those of ``SequenceMetrics.update``."""
    assert row.truth is not None
    masks = {f"{key}.{part}": mask if valid is None else valid & mask for part, mask in row.parts.items()}
    for name, mask in ({key: valid} | masks).items():
        if name not in metrics:
            metrics[name] = SequenceMetrics(**how)
        metrics[name].update(*maps, torch.from_numpy(row.truth), mask, mixture, level)


def judge_run(metrics: dict[str, SequenceMetrics], row: RowResult, plugins: PluginMetrics) -> None:
    """Add a frame of a run to the metrics of its row, ``UFM``, of its network ``ALONE``, and of its ``POSTERIOR``, on
    the row's valid pixels, and as "ufm.moving", "ufm.still", ... on its ``RowResult.parts``, without curves of gates. A
    frame without ground truth is ignored."""
    if row.truth is None:
        return
    depth = row.prediction.depth[0]
    maps: dict[str, tuple[Tensor, Tensor | None]] = {UFM: (depth, row.map("ufm_variance"))}
    maps |= {} if row.network_variance is None else {ALONE: (depth, row.network_variance)}
    if row.corrected:
        maps[POSTERIOR] = row.depth, row.variance
    corrected = POSTERIOR if row.corrected else UFM
    for name, stated in maps.items():
        mixture, level = row.mixture if name == POSTERIOR else None, row.level if name == corrected else None
        add_to(metrics, name, row, stated, row.valid, mixture, level, gates=False, plugins=plugins)


class RowJudge:
    """Collects counts, metrics, times and memory of one row over a sequence. ``reference_names`` has, by key, the names
    of the rows on whose confident pixels the NLL by error is computed."""

    def __init__(
        self, row: Row, runner: RowRunner, reference_names: Mapping[str, str], bins: str, plugins: PluginMetrics
    ) -> None:
        self.row, self._runner, self._multiview = row, runner, row.method.fusion == method.UFM_STAR
        self._references, self._bins, self._plugins = reference_names, bins, plugins
        self._metrics: dict[str, SequenceMetrics] = {}
        self._by_error: dict[str, NLLByError] = {}
        self._samples: list[Tensor] = []
        self._judged, self._reasons, self._idle = 0, Counter[str](), Counter[str]()
        self._ms: list[Mapping[str, float]] = []
        self._memory: list[Mapping[str, float]] = []

    def add(self, result: FrameResult) -> None:
        """Add a frame. Invalid pixels are NaN, not masked, so that the metrics count them."""
        key = self._runner.key
        if key in result.skipped:
            self._reasons[result.skipped[key]] += 1
        if key in result.rows:
            self._add(result.rows[key], result.rows)

    def _add(self, result: RowResult, rows: Mapping[str, RowResult]) -> None:
        statistics = result.out.statistics
        if self._multiview:
            segments, matched = (int(count[0]) for count in (statistics.segments, statistics.matched))
            # In the first frame there is no component to match.
            self._idle.update(without_segment=int(not segments), without_match=int(bool(self._ms) and not matched))
        self._ms.append(result.ms)
        self._memory.append(self._runner.memory())
        if result.truth is None:
            return
        self._judged += 1
        depth, variance, target = (
            torch.where(result.valid, result.depth, torch.nan), result.variance, torch.from_numpy(result.truth)
        )  # fmt: skip
        how: dict[str, Any] = {"with_variance": variance is not None, "bins": self._bins, "plugins": self._plugins}
        level = None if variance is None else result.level
        add_to(self._metrics, METRICS, result, (depth, variance), mixture=result.mixture, level=level, **how)
        if variance is None:
            return
        if self._multiview and (confidence := result.prediction.confidence) is not None:
            self._samples.append(_samples(confidence[0], depth, variance, target))
        for other, name in self._references.items():
            by_error = self._by_error.setdefault(f"{BY_ERROR}:{name}", NLLByError())
            by_error.update(depth, variance, target, rows[other].confident)

    def record(self) -> Record:
        """The row's figures after the last frame, as a record without a data set. Raises SequenceError: no frame was
        evaluated."""
        reasons, done, skipped = dict(sorted(self._reasons.items())), len(self._ms), self._reasons.total()
        if not self._judged:
            worst = "; ".join(f"{count} x {reason}" for reason, count in list(reasons.items())[:3])
            raise SequenceError(f"no frame could be judged: {worst or 'none of those that were read has ground truth'}")
        frames = {"selected": done + skipped, "done": done, "judged": self._judged, "skipped": skipped}
        metrics = self._metrics[METRICS]
        curves: dict[str, Any] = metrics.curves()
        sums: dict[str, dict[str, Tensor]] = {METRICS: metrics.state_dict()}
        for name, by_error in self._by_error.items():
            curves[name] = by_error.compute()["nll_by_error"].tolist()
            sums[name] = by_error.state_dict()
        if self._samples:
            sums[CONFIDENCE] = {"samples": torch.cat(self._samples)}
        stages = ("network", "anchors", "uncertainty")
        times = {stage: [ms[stage] for ms in self._ms if stage in ms] for stage in stages}
        return Record(
            method=self.row.method.name,
            setting=self.row.setting.to_dict(),
            frames={**frames, **self._idle, "reasons": reasons},
            figures=metrics.compute() | self._parts(),
            curves=curves,
            state=self._state(),
            ms={stage: median(values) for stage, values in times.items() if values},
            sums={name: {entry: value.cpu() for entry, value in state.items()} for name, state in sums.items()},
        )

    def _parts(self) -> dict[str, float]:
        """The figures of what moves and what stands still, "moving.delta1" and so on; {} without masks."""
        parts = {key.removeprefix(f"{METRICS}."): metrics for key, metrics in self._metrics.items() if key != METRICS}
        return {f"{part}.{name}": value for part, m in parts.items() for name, value in m.compute().items()}

    def _state(self) -> dict[str, float]:
        """The size of the method's state over the sequence, for ``Record``."""
        state: dict[str, float] = {}
        for name, end in self._memory[-1].items():
            values = [memory[name] for memory in self._memory]
            mean = sum(values) / len(values)
            if name in ("bytes", "count"):
                state |= {f"{name}_mean": mean, f"{name}_max": max(values), f"{name}_end": end}
            else:
                state |= {"anchors_mean": mean} if name == "anchors" else {name: end}
        return state


def _samples(confidence: Tensor, depth: Tensor, variance: Tensor, target: Tensor) -> Tensor:
    """[n, 3] float64 confidence, variance [m^2] and squared error [m^2] at ``EACH`` of the pixels with all of them."""
    maps = torch.stack([confidence, variance, (target - depth).square()], -1).double()
    usable = maps[(target > 0) & maps.isfinite().all(-1) & (variance > 0)]
    return usable[:: max(1, -(-len(usable) // EACH))]


def references(row: Row, rows: Sequence[Row]) -> list[Row]:
    """The references of a row for the NLL by error, among ``rows`` on the same frames: its base alone, and its base
    with the UfM of the fewest points. The row's pose noise is preferred, then the default setting."""

    def seen(other: Row) -> tuple[str, int, str]:  # defines the frames and the part of them that the network sees
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

"""Many rows on one sequence in one pass: every network sees a frame once, and every row sees the same frames.

A frame that one row cannot use (its file is broken, its pose is no pose, a network has nothing to predict from) is
left out by all rows, whose tables could not be compared otherwise. Pixels are each row's own: those with ground truth
where it predicts something. How many it leaves out is among its figures (``left_out_share``).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from ufmstar_torch.eval.engine.frame_pass import FramePass
from ufmstar_torch.eval.engine.networks import BaseNetwork
from ufmstar_torch.eval.engine.row_run import RowRun
from ufmstar_torch.eval.methods.method import ALONE
from ufmstar_torch.eval.methods.row import Row
from ufmstar_torch.eval.results.cache import PredictionCache
from ufmstar_torch.eval.results.examples import Examples, ExampleWriter
from ufmstar_torch.eval.sequences.frame import FrameSequence


class SequenceError(Exception):
    """A sequence cannot be used as a whole: no frame can be read, or there is no ground truth.

    Attributes:
        reason: why.
    """

    def __init__(self, reason: str) -> None:
        super().__init__(reason)
        self.reason = reason


class Stopped(Exception):
    """The caller asked to stop, between two frames; nothing of the sequence counts."""


@dataclass(frozen=True)
class RowResult:
    """One row on one sequence.

    Attributes:
        row: which.
        frames, figures, curves, state, ms: as ``Record`` has them.
        sums: states of the metrics on the CPU by name: "metrics" (``SequenceMetrics``) and
            "nll_by_error:REFERENCE" (``NLLByError``), to be added up over sequences.
    """

    row: Row
    frames: dict[str, Any]
    figures: dict[str, float]
    curves: dict[str, Any]
    state: dict[str, float]
    ms: dict[str, float]
    sums: dict[str, dict[str, Tensor]]


def evaluate_sequence(
    sequence: FrameSequence,
    rows: Sequence[Row],
    networks: Mapping[str, BaseNetwork],
    *,
    cache: PredictionCache,
    device: torch.device,
    limit: slice = slice(None),
    examples: Examples | None = None,
    confident: float = 0.5,
    stop: Callable[[], bool] = lambda: False,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> list[RowResult]:
    """Judge every row on the frames of a sequence.

    Args:
        sequence: posed frames with ground truth.
        rows: different ones.
        networks: by base.
        cache: of predictions.
        device: where UfM and UfM* run.
        limit: which frames, before a setting's skip.
        examples: where to leave maps and mixtures of a few frames; None = nowhere.
        confident: of the pixels of a frame, the share of which a reference method counts as confident.
        stop: asked before every frame; True raises ``Stopped``.
        progress: called with the frames that are done and all of them, at the start and after every one.

    Returns:
        One result for each row, in their order.

    Raises:
        SequenceError: the sequence cannot be used.
        Stopped: ``stop`` said so.
        ValueError: no row, one of them twice, a base without a network, an override that UfM* does not know.
    """
    _check(rows, networks, confident)
    indices = range(len(sequence))[limit]
    if not indices:
        raise SequenceError(f"no frame is selected of {len(sequence)}")
    if all(sequence.entries[index].load_depth is None for index in indices):
        raise SequenceError("no frame has ground truth")
    comparing = [row.method.name for row in rows if row.method.fusion != ALONE]
    if comparing and not sequence.posed:
        raise SequenceError(f"single images without poses, on which {', '.join(comparing)} cannot compare views")
    frames = FramePass(sequence, rows, networks, cache, device, confident)
    writer = None if examples is None else ExampleWriter(examples, len(indices))
    progress(0, len(indices))
    for number, index in enumerate(indices):
        if stop():
            raise Stopped
        finished = frames.take(number, index)
        if writer is not None:
            writer.after(number + 1, finished, frames.runs)
        progress(number + 1, len(indices))
    if writer is not None:
        writer.end(frames.runs)
    return [_result(run, sequence) for run in frames.runs]


def _check(rows: Sequence[Row], networks: Mapping[str, BaseNetwork], confident: float) -> None:
    """Raises ValueError for what ``evaluate_sequence`` cannot do, whatever the sequence."""
    if not rows or len({row.slug for row in rows}) < len(rows):
        raise ValueError(f"rows must be one or more different ones, got {[row.label for row in rows]}")
    missing = sorted({row.method.base for row in rows} - networks.keys())
    if missing:
        raise ValueError(f"networks must hold one for each base of the rows, {', '.join(missing)} is missing")
    if not 0 < confident <= 1:
        raise ValueError(f"confident must be a share in (0, 1], got {confident}")


def _result(run: RowRun, sequence: FrameSequence) -> RowResult:
    """What a row leaves behind.

    Raises:
        SequenceError: it has judged nothing.
    """
    frames = run.frames()
    if not frames["judged"]:
        told = "; ".join(f"{count} x {reason}" for reason, count in list(frames["reasons"].items())[:3])
        raise SequenceError(f"no frame could be judged: {told or 'none of those that were read has ground truth'}")
    opened = Counter(skipped.reason for skipped in sequence.skipped)
    return RowResult(
        row=run.row,
        frames={**frames, "left_out_on_opening": dict(sorted(opened.items()))},
        figures=run.figures(),
        curves=run.curves(),
        state=run.state(),
        ms=run.ms(),
        sums=run.sums(),
    )

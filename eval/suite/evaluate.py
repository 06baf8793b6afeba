"""Many rows on one sequence in one pass."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from collections.abc import Sequence as SequenceOf
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from ufmstar_torch.eval.sequences.frame import Sequence
from ufmstar_torch.eval.suite.cache import PredictionCache
from ufmstar_torch.eval.suite.examples import Examples
from ufmstar_torch.eval.suite.networks import BaseNetwork
from ufmstar_torch.eval.suite.row import Row


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
    sequence: Sequence,
    rows: SequenceOf[Row],
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
        networks: by base; on ``device``.
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
    raise SequenceError(f"{sequence.name}: nothing is judged yet")

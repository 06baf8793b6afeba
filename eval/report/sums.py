"""Curves over all pixels of many sequences, from the sums that were kept of each."""

from __future__ import annotations

import pickle
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import torch
from torch import Tensor

from ufmstar_torch.eval.metrics.packed_sums import unpack

METRICS = "metrics"
BY_ERROR = "nll_by_error:"
Sums = Mapping[str, Mapping[str, Tensor]]


class SumsError(ValueError):
    """A file does not hold the sums of a row on a sequence, or they cannot be added; the message names it."""


@dataclass(frozen=True)
class Merged:
    """Several sequences judged as if they were one: every pixel counts the same.

    Attributes:
        figures: ``SequenceMetrics.compute()``.
        curves: ``SequenceMetrics.curves()``, and "nll_by_error:REFERENCE", "error_by_error:REFERENCE".
        sequences: how many.
    """

    figures: Mapping[str, float]
    curves: Mapping[str, list[float]] = field(default_factory=dict)
    sequences: int = 1


def merge_sums(paths: Sequence[Path]) -> Merged:
    """Add the sums in the order given, which decides the last bits, and say what they amount to.

    Raises:
        SumsError: a file holds no sums, or sums of other metrics than the first one's.
    """
    total: dict[str, dict[str, Tensor]] = {}
    for path in paths:
        _add(total, read_sums(path), path)
    return _results(total, paths)


def read_sums(path: Path) -> Sums:
    """``RowResult.sums`` of one row on one sequence.

    Raises:
        SumsError: the file does not hold them.
    """
    try:
        sums = torch.load(path, map_location="cpu", weights_only=True)
    except (EOFError, KeyError, RuntimeError, ValueError, pickle.UnpicklingError) as error:
        raise SumsError(f"{path} does not hold the sums of metrics: {' '.join(str(error).split())[:200]}") from error
    if not isinstance(sums, dict) or METRICS not in sums or not all(isinstance(s, Mapping) for s in sums.values()):
        raise SumsError(f"{path} does not hold the sums of metrics by name")
    return {name: {key: unpack(value) for key, value in states.items()} for name, states in sums.items()}


def _add(total: dict[str, dict[str, Tensor]], more: Sums, path: Path) -> None:
    """Add ``more`` to ``total``, which belongs to the caller's loop; a reference that is new starts from it."""
    for name, states in more.items():
        mine = total.setdefault(name, {key: torch.zeros_like(value) for key, value in states.items()})
        shapes = {key: value.shape for key, value in mine.items()}
        if shapes != {key: value.shape for key, value in states.items()}:
            raise SumsError(f"{path} holds sums of other metrics than the sequences before it ({name})")
        for key, value in states.items():
            mine[key] = mine[key] + value


def _results(total: Sums, paths: Sequence[Path]) -> Merged:
    """Figures and curves of the summed states."""
    from ufmstar_torch.eval.metrics import NLLByError, SequenceMetrics

    states = total[METRICS]
    kinds = {key.split(".")[1] for key in states if key.startswith("metrics.")}
    metrics = SequenceMetrics(with_variance="NLL" in kinds, ranking="Sparsification" in kinds)
    by_error = {name: NLLByError() for name in total if name.startswith(BY_ERROR)}
    try:
        metrics.load_state_dict(dict(states))
        for name, metric in by_error.items():
            metric.load_state_dict(dict(total[name]))
    except RuntimeError as error:
        raise SumsError(f"{paths[0]} holds sums of other metrics: {' '.join(str(error).split())[:200]}") from error
    curves = metrics.curves()
    for name, metric in by_error.items():
        reference = name.removeprefix(BY_ERROR)
        curves |= {f"{curve}:{reference}": value.tolist() for curve, value in metric.compute().items()}
    return Merged(metrics.compute(), curves, len(paths))

"""Validation of a network's uncertainty on sequences, with the loop, rows and metrics of the evaluation."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import lightning.pytorch as pl
import torch
from torch import nn

from ufmstar_torch.anchors.sources import DENSE
from ufmstar_torch.eval.engine.evaluate import evaluate_sequence
from ufmstar_torch.eval.engine.networks import NetworkSource
from ufmstar_torch.eval.engine.record import METRICS
from ufmstar_torch.eval.methods.method import UFM_STAR, Method
from ufmstar_torch.eval.methods.row import Row
from ufmstar_torch.eval.methods.setting import Setting
from ufmstar_torch.eval.metrics import SequenceMetrics
from ufmstar_torch.eval.report.figures_calibration import write_curves
from ufmstar_torch.eval.sequences import FrameSequence, open_sequence
from ufmstar_torch.frames.prediction import NetworksInTurn
from ufmstar_torch.models.any_network import wrap_network
from ufmstar_torch.models.network import DepthNetwork, in_eval_mode
from ufmstar_torch.models.preprocess import Preprocess
from ufmstar_torch.runtime.kinds import check_kinds

_BASE = "aleatoric"  # one network, with all variances that it predicts
ROWS: dict[str, Row] = {
    "network": Row(Method(_BASE)),
    "ufmstar": Row(Method(_BASE, UFM_STAR)),
    "posterior": Row(Method(_BASE, UFM_STAR), Setting(anchors=DENSE, posterior=True)),
}
LOGGED = ("delta1", "nll", "ece_delta", "ece_q", "ause_rmse")


@check_kinds
def judge_network(
    network: nn.Module,
    sequences: Sequence[FrameSequence | str | Path],
    *,
    rows: Sequence[str] = tuple(ROWS),
    preprocess: Preprocess | None = None,
    frames: int | None = None,
    device: torch.device | str = "cpu",
) -> dict[str, SequenceMetrics]:
    """Evaluate the uncertainty of a network on sequences, alone, with UfM* and with the posterior.

    Args:
        network: a ``DepthNetwork``, or a module for ``wrap_network``; stays on ``device``, its modes are restored.
        sequences: posed, with ground truth; opened, or names as for ``ufmstar run`` ("tour:7").
        rows: of "network", "ufmstar" and "posterior".
        preprocess: preprocessing of a module's input; None = images in [0, 1], not resized.
        frames: most frames of each sequence.
        device: of all computations.

    Returns:
        By row, the metrics over all pixels of all sequences; ``compute()`` and ``curves()`` return their values.

    Raises:
        ValueError: no sequence, or an unknown row; others as ``evaluate_sequence``.
    """
    if not sequences or not rows or not set(rows) <= ROWS.keys():
        expected = f"at least one sequence, and rows of {list(ROWS)}"
        raise ValueError(f"sequences and rows must hold {expected}, got {len(sequences)} and {list(rows)}")
    depth = network if isinstance(network, DepthNetwork) else wrap_network(network, preprocess=preprocess)
    where, totals = torch.device(device), dict[str, SequenceMetrics]()
    with in_eval_mode(depth):
        source = NetworkSource(NetworksInTurn([depth], preprocess=depth.preprocess), where, {})
        how: dict[str, Any] = {"device": where, "frames": slice(frames)}
        for sequence in sequences:
            opened = sequence if isinstance(sequence, FrameSequence) else open_sequence(sequence)
            results = evaluate_sequence(opened, [ROWS[n] for n in rows], {_BASE: source}, **how)
            for name, result in zip(rows, results, strict=True):
                metrics = SequenceMetrics(with_variance="nll" in result.figures)
                metrics.load_state_dict(result.sums[METRICS])
                totals.setdefault(name, SequenceMetrics(with_variance=metrics.with_variance)).merge_state(metrics)
    return totals


class UncertaintyCallback(pl.Callback):
    """Logs the uncertainty of a Lightning module's network on validation sequences after each validation.

    Logs delta1, NLL, ECE_delta, ECE_q and AUSE as "ROW/FIGURE", and writes reliability plots to
    ``uncertainty/epoch_N.png`` in the logger's folder, or the trainer's.

    Args:
        sequences, rows, preprocess, frames: as in :func:`judge_network`.
        network: returns the network of the Lightning module; default: its attribute ``network``.
        every: validations per evaluation.

    Raises:
        ValueError: ``every`` is not positive.
    """

    @check_kinds
    def __init__(
        self,
        sequences: Sequence[FrameSequence | str | Path],
        *,
        network: Callable[[Any], nn.Module] = lambda module: module.network,
        every: int = 1,
        rows: Sequence[str] = tuple(ROWS),
        preprocess: Preprocess | None = None,
        frames: int | None = None,
    ) -> None:
        if every < 1:
            raise ValueError(f"every must be at least 1, got {every}")
        self._network, self._every, self._validations = network, every, 0
        self._sequences = tuple(sequences)
        self._how: dict[str, Any] = {"rows": rows, "preprocess": preprocess, "frames": frames}

    def on_validation_epoch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        """Evaluate, log and plot, in the first process only."""
        self._validations += not trainer.sanity_checking
        if trainer.sanity_checking or self._validations % self._every or not trainer.is_global_zero:
            return
        judged = judge_network(self._network(pl_module), self._sequences, device=pl_module.device, **self._how)
        figures = {row: metrics.compute() for row, metrics in judged.items()}
        logged = {
            f"{row}/{name}": row_figures[name]
            for row, row_figures in figures.items()
            for name in LOGGED
            if name in row_figures
        }
        pl_module.log_dict(logged, rank_zero_only=True)
        curves = {name: metrics.curves() for name, metrics in judged.items() if metrics.with_variance}
        if curves:
            folder = Path(trainer.log_dir or trainer.default_root_dir) / "uncertainty"
            folder.mkdir(parents=True, exist_ok=True)
            title = f"epoch {trainer.current_epoch}, step {trainer.global_step}"
            write_curves(folder / f"epoch_{trainer.current_epoch}.png", curves, title=title)

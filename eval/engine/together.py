"""What several sequences compute at once: a network predicts for their images, UfM* takes in their depth maps."""

from __future__ import annotations

from collections.abc import Sequence

from ufmstar_torch.eval.engine.clock import StageTimer
from ufmstar_torch.eval.engine.estimators import Estimate, Estimator, EstimatorInput, Gaussians
from ufmstar_torch.eval.engine.networks import NetworkSource
from ufmstar_torch.eval.engine.predictions import FramePredictions
from ufmstar_torch.eval.engine.rows import RowFrame, RowRunner


def infer_together(wanted: Sequence[tuple[FramePredictions, RowRunner]]) -> None:
    """Make the inferences of several frames, each of which a row needs, as one batch of every network; those of one
    frame are left to it. Inferences that fail together are left to each frame as well, which then meets its own error.
    """
    if len({predictions for predictions, _ in wanted}) < 2:
        return
    frames: dict[tuple[object, int], dict[FramePredictions, NetworkSource]] = {}
    for predictions, row in wanted:
        if isinstance(row.source, NetworkSource) and row.source.batches:
            for n in predictions.missing(row.source, row.images, row.every):
                frames.setdefault((row.source.digest or row.source, n), {})[predictions] = row.source
    for (_, n), sources in frames.items():
        together = [known for known in sources if known.frame.image is not None]
        if len(together) > 1:
            source = next(iter(sources.values()))
            try:
                made = source.several([known.frame for known in together], n)
            except (RuntimeError, ValueError):
                continue
            for known, prediction in zip(together, made, strict=True):
                known.add(source, n, prediction)


def update_together(updates: Sequence[RowFrame]) -> None:
    """Answer updates of different estimators; streams of one UfM* are one batch."""
    batches: dict[object, list[RowFrame]] = {}
    for n, update in enumerate(updates):
        estimator = update.row.estimator
        batch = estimator.batch(update.prediction) if isinstance(estimator, Gaussians) else n
        batches.setdefault(batch, []).append(update)
    for batch in batches.values():
        timer = StageTimer(batch[0].row.device)
        with timer.stage("uncertainty"):
            answers = _answers([one.row.estimator for one in batch], [one.of_estimator() for one in batch])
        ms = timer.take()["uncertainty"] / len(batch)
        for update, answer in zip(batch, answers, strict=True):
            update.answer, update.ms["uncertainty"] = answer, ms


def _answers(
    estimators: Sequence[Estimator], inputs: Sequence[EstimatorInput]
) -> Sequence[Estimate | RuntimeError | ValueError]:
    """Of one estimator, or of streams of one UfM*."""
    streams = [estimator for estimator in estimators if isinstance(estimator, Gaussians)]
    try:
        if streams:
            return Gaussians.update_together(streams, inputs)
        return [estimators[0].update(*inputs[0])]
    except (RuntimeError, ValueError) as error:
        if len(estimators) == 1:
            return [error]
    # UfM* has taken in nothing: one of the frames is at fault.
    return [_answers([one], [given])[0] for one, given in zip(estimators, inputs, strict=True)]

"""Evaluates many rows on a sequence in one stream: each network runs once per frame, all rows use the same frames.

A frame that one row cannot use is skipped by all rows, so that their figures can be compared. Each row is evaluated on
the pixels with ground truth and a prediction of that row; ``left_out_share`` is the share of the other pixels.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import torch

from ufmstar_torch.eval.engine.anchors import anchor_sources
from ufmstar_torch.eval.engine.estimators import make_estimator
from ufmstar_torch.eval.engine.examples import ExampleWriter
from ufmstar_torch.eval.engine.judge import RowJudge, SequenceError, references
from ufmstar_torch.eval.engine.predictions import DepthSource, PredictionCache
from ufmstar_torch.eval.engine.progress import Progress
from ufmstar_torch.eval.engine.record import Record
from ufmstar_torch.eval.engine.rows import RowRunner
from ufmstar_torch.eval.engine.stream import frame_progress, frame_results
from ufmstar_torch.eval.methods.method import ALONE
from ufmstar_torch.eval.methods.row import Row
from ufmstar_torch.eval.sequences.frame import FrameError, FrameSequence
from ufmstar_torch.eval.sequences.plugins import Plugins

# Errors of a sequence that cannot be used. Any other error is a bug and ends the program.
BROKEN = (SequenceError, FrameError, RuntimeError, ValueError)
_CPU, _ALL, _NO_PLUGINS = torch.device("cpu"), slice(None), Plugins()


def evaluate_sequence(
    sequence: FrameSequence,
    rows: Sequence[Row],
    networks: Mapping[str, DepthSource],
    *,
    device: torch.device = _CPU,
    cache: PredictionCache | None = None,
    frames: slice = _ALL,
    bins: str = "ours",
    plugins: Plugins = _NO_PLUGINS,
    examples: Path | None = None,
    progress: Callable[[Progress], object] = lambda _: None,
    stop: Callable[[], bool] = lambda: False,
) -> list[Record]:
    """Evaluate every row on the frames of a posed sequence with ground truth. Returns a record for each
    row, in order, without the names of suite, data set and network.

    Args:
        sequence: with poses and ground truth.
        rows: to evaluate.
        networks: by base.
        device: of UfM and UfM*.
        cache: of predictions; None = compute all.
        frames: selects frames, before a setting's skip.
        bins: of the calibration errors: "ours" or "authors", see ``SequenceMetrics``.
        plugins: the user's methods and metrics.
        examples: folder for maps of a few frames (``ExampleWriter``); None = none.
        progress: called at the start and after every frame.
        stop: called before every frame.

    Raises:
        SequenceError: the sequence cannot be evaluated.
        FrameError, RuntimeError, ValueError: rows cannot be evaluated, or errors of readers and networks.
        Stopped: ``stop`` returned True.
    """
    indices = range(len(sequence))[frames]
    _check(sequence, rows, indices)
    expected = dict.fromkeys((row.method.base, row.setting.preprocess) for row in rows)
    sources = {(base, how): networks[base].prepared(how) for base, how in expected}
    anchors = anchor_sources(rows, sequence.folder, sequence.pose_scale)
    runners, judges = [], []
    for row in rows:
        source = sources[row.method.base, row.setting.preprocess]
        estimator = make_estimator(row, device, source, plugins.methods)
        every, setting = row.method.every_member, row.setting
        runners.append(RowRunner(row.slug, source, estimator, every=every, setting=setting, anchors=anchors.get(row)))
        named = {other.slug: other.method.name for other in references(row, rows)}
        judges.append(RowJudge(row, runners[-1], named, bins, plugins.metrics))
    shown = frame_progress(progress, len(indices))
    writer = None if examples is None else ExampleWriter(examples, len(indices))
    stream = frame_results(sequence, indices, runners, cache=cache, device=device, stop=stop)
    with closing(stream) as results:
        for result in results:
            for one in judges:
                one.add(result)
            if writer is not None:
                writer.add(result)
            shown(result)
    opened = dict(sorted(Counter(skipped.reason for skipped in sequence.skipped).items()))
    records = [one.record() for one in judges]
    return [replace(one, frames={**one.frames, "left_out_on_opening": opened}) for one in records]


def _check(sequence: FrameSequence, rows: Sequence[Row], indices: range) -> None:
    """Raises SequenceError if the rows cannot be evaluated on the sequence."""
    if not indices:
        raise SequenceError(f"no frame is selected of {len(sequence)}")
    if all(sequence.entries[index].load_depth is None for index in indices):
        raise SequenceError("no frame has ground truth")
    multiview = [row.method.name for row in rows if row.method.fusion != ALONE]
    if multiview and not sequence.posed:
        raise SequenceError(f"single images without poses, on which {', '.join(multiview)} cannot compare views")

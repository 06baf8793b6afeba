"""The loop over frames: read, predict, update every row.

``ufmstar run`` writes the results of one row, ``ufmstar eval`` judges those of a suite's rows, ``ufmstar rank`` scores
those of one row on many sequences.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Generator, Iterable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass, field
from time import perf_counter
from typing import TypeVar

import numpy as np
import torch
from numpy.typing import NDArray

from ufmstar_torch.eval.engine.clock import timed
from ufmstar_torch.eval.engine.predictions import FramePredictions, PredictionCache, sequence_digest
from ufmstar_torch.eval.engine.rows import RowResult, RowRunner
from ufmstar_torch.eval.methods.perturb import selects
from ufmstar_torch.eval.sequences.frame import Frame, FrameError, FrameSequence
from ufmstar_torch.eval.sequences.ground_truth import truth_at
from ufmstar_torch.frames.prediction import DepthPrediction

_AHEAD = 2  # frames; decoding releases Python's lock
_CPU = torch.device("cpu")
Read = TypeVar("Read")


class Stopped(Exception):
    """The caller asked to stop, between two frames."""


@dataclass(frozen=True, eq=False)
class FrameResult:
    """The result of one frame."""

    number: int  # of the frame in the stream, from 0
    index: int  # of the frame in its sequence
    name: str  # of the frame
    frame: Frame | None = None  # None if no row selects it, or it cannot be used
    rows: Mapping[str, RowResult] = field(default_factory=dict)  # by key, of the rows that used the frame
    skipped: Mapping[str, str] = field(default_factory=dict)  # by key, why a row that selects the frame cannot use it
    # [ms]: "read" (the wait for the thread that reads ahead), "predict", "truth", "cycle" (since the previous result).
    ms: Mapping[str, float] = field(default_factory=dict)


def frame_results(
    sequence: FrameSequence,
    indices: Sequence[int],
    rows: Sequence[RowRunner],
    *,
    cache: PredictionCache | None = None,
    device: torch.device = _CPU,
    check: Callable[[Frame], None] = lambda _: None,
    stop: Callable[[], bool] = lambda: False,
) -> Generator[FrameResult]:
    """Yield the result of every frame, in order. A frame that no row selects is not decoded. If a frame cannot be read
    or predicted from, all rows skip it. Close the generator to end the thread that reads ahead.

    Args:
        sequence: posed frames.
        indices: of the frames, in order.
        rows: with different keys, in their initial state.
        cache: of predictions; None = compute all.
        device: of the rows' estimators and their maps.
        check: raises ``FrameError`` for a frame that all rows must skip.
        stop: called before every frame.

    Raises:
        Stopped: ``stop`` returned True.
    """
    names, digest = sequence.names, "" if cache is None else sequence_digest(sequence)

    def read(index: int) -> FramePredictions:
        predictions = FramePredictions(sequence[index], device, cache, digest)
        if torch.get_num_threads() == 1:  # a second team of OpenMP threads makes networks three times slower
            for row in rows:
                predictions.prepare(row.source)
        return predictions

    selected = [index for n, index in enumerate(indices) if any(selects(row.setting, n) for row in rows)]
    last = perf_counter()
    with closing(read_ahead(read, selected)) as frames:
        for number, index in enumerate(indices):
            if stop():
                raise Stopped
            active, ms = [row for row in rows if selects(row.setting, number)], dict[str, float]()
            results, skipped, frame = dict[str, RowResult](), dict[str, str](), None
            try:
                if active:
                    with timed(ms, "read", device):
                        predictions = next(frames).result()
                        check(predictions.frame)
                    with timed(ms, "predict", device):
                        predicted = {row.key: predictions.of(row.source, row.images, row.every) for row in active}
                    with timed(ms, "truth", device):
                        truths = _truths(predictions.frame, predicted)
                    frame = predictions.frame
            except FrameError as error:
                skipped, active = {row.key: error.reason for row in active}, []
            for row in active:
                assert frame is not None
                try:
                    results[row.key] = row.update(frame, predicted[row.key], truths[row.key])
                except FrameError as error:
                    skipped[row.key] = error.reason
            now = perf_counter()
            ms["cycle"], last = 1000 * (now - last), now
            yield FrameResult(number, index, names[index], frame, results, skipped, ms)


def _truths(frame: Frame, predictions: Mapping[str, DepthPrediction]) -> dict[str, NDArray[np.float32] | None]:
    """Ground truth at the pixels of every row's maps, computed once per camera. Raises FrameError: the depth map has no
    ground truth."""
    computed: dict[tuple[object, ...], NDArray[np.float32] | None] = {}
    truths = {}
    for key, prediction in predictions.items():
        K = prediction.K[0].numpy()
        camera = (prediction.size, K.tobytes())
        if camera not in computed:
            computed[camera] = truth_at(frame, K, prediction.size)
        truths[key] = computed[camera]
    return truths


def read_ahead(read: Callable[[int], Read], indices: Iterable[int]) -> Generator[Future[Read]]:
    """Yield what ``read`` returns for some indices, in order, read by one thread at most two ahead. Its error is raised
    by ``result()``. Closing the generator ends the thread."""
    thread, reading = ThreadPoolExecutor(1), deque[Future[Read]]()
    try:
        for index in indices:
            reading.append(thread.submit(read, index))
            if len(reading) > _AHEAD:
                yield reading.popleft()
        yield from reading
    finally:
        thread.shutdown(cancel_futures=True)

"""The loop over frames: predict, update every row, hand the result to the sinks.

``ufmstar run`` is one row with writers, ``ufmstar eval`` the rows of a suite with metrics.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ufmstar_torch.eval.engine.clock import timed
from ufmstar_torch.eval.engine.predictions import FramePredictions, PredictionCache, sequence_digest
from ufmstar_torch.eval.engine.rows import RowResult, RowRunner
from ufmstar_torch.eval.methods.perturb import selects
from ufmstar_torch.eval.sequences.frame import Frame, FrameError, FrameSequence
from ufmstar_torch.eval.sequences.ground_truth import truth_at
from ufmstar_torch.frames.prediction import DepthPrediction


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
    # "read" (the wait for the prefetch), "predict" and "truth" [ms]; sinks may add others.
    ms: dict[str, float] = field(default_factory=dict)
    # The stream's state after the frame, for sinks in a ``WriterThread``.
    state: Mapping[str, Mapping[str, Tensor]] = field(default_factory=dict)


class FrameSink(ABC):
    """Receives the result of every frame: metrics, writers, progress."""

    def begin(self, stream: FrameStream) -> None:
        """Called before the first frame, also after a resume."""

    @abstractmethod
    def take(self, result: FrameResult) -> None:
        """Called after every frame, skipped ones included, when the stream's state includes the frame."""

    def end(self) -> None:
        """Called after the last frame, but not after a stop or an error."""


class FrameStream:
    """The frames of a sequence, processed by rows. A frame that no row selects is not decoded. If a frame cannot be
    read or predicted from, all rows skip it.

    Args:
        sequence: posed frames.
        indices: of the frames, in order.
        rows: with different keys.
        store: of predictions; None = compute all.
        device: of the rows' estimators and their maps.
        check: raises ``FrameError`` for a frame that all rows must skip.
        start: number of finished frames, skipped ones included (``position``); the rows are in that state.
    """

    def __init__(
        self,
        sequence: FrameSequence,
        indices: Sequence[int],
        rows: Sequence[RowRunner],
        *,
        store: PredictionCache | None = None,
        device: torch.device | None = None,
        check: Callable[[Frame], None] | None = None,
        start: int = 0,
    ) -> None:
        self.sequence, self.indices, self.rows = sequence, indices, tuple(rows)
        self._store, self._device, self._check = store, device or torch.device("cpu"), check
        self._names = sequence.names
        self._digest = "" if store is None else sequence_digest(sequence)
        self.position = start

    def drive(self, sinks: Sequence[FrameSink], *, stop: Callable[[], bool] = lambda: False) -> None:
        """Process the remaining frames, and pass each result to the sinks in order. ``stop`` is called before every
        frame.

        Raises:
            Stopped: ``stop`` returned True.
        """
        with closing(prefetch(self.sequence, self._selected(), self._prepare)) as frames:
            for sink in sinks:
                sink.begin(self)
            while self.position < len(self.indices):
                if stop():
                    raise Stopped
                result = self._next(frames)
                for sink in sinks:
                    sink.take(result)
        for sink in sinks:
            sink.end()

    def state(self) -> dict[str, dict[str, Tensor]]:
        """All tensors on which the next frame depends, by row."""
        return {row.key: row.state() for row in self.rows}

    def _next(self, frames: Iterator[Future[Frame]]) -> FrameResult:
        """Process the next frame."""
        number, index = self.position, self.indices[self.position]
        name = self._names[index]
        active = [row for row in self.rows if selects(row.setting, number)]
        self.position += 1
        if not active:
            return FrameResult(number, index, name)
        ms: dict[str, float] = {}
        try:
            with timed(ms, "read", self._device):
                frame = next(frames).result()
                if self._check is not None:
                    self._check(frame)
            cached = FramePredictions(frame, self._device, self._store, self._digest)
            with timed(ms, "predict", self._device):
                predictions = {row.key: cached.of(row.source, row.images, row.every) for row in active}
            with timed(ms, "truth", self._device):
                truths = _truths(frame, predictions)
        except FrameError as error:
            return FrameResult(number, index, name, skipped={row.key: error.reason for row in active})
        results: dict[str, RowResult] = {}
        skipped: dict[str, str] = {}
        for row in active:
            try:
                results[row.key] = row.update(frame, predictions[row.key], truths[row.key])
            except FrameError as error:
                skipped[row.key] = error.reason
        return FrameResult(number, index, name, frame, results, skipped, ms)

    def _selected(self) -> list[int]:
        """Indices of the remaining frames that a row selects."""
        remaining = range(self.position, len(self.indices))
        return [self.indices[n] for n in remaining if any(selects(row.setting, n) for row in self.rows)]

    def _prepare(self, frame: Frame) -> None:
        """Compute the networks' input in the prefetch thread, unless a store may have all predictions. Only if torch
        uses one thread: a second team of OpenMP threads would stop the first one's spinning, which made networks three
        times slower."""
        if self._store is None and torch.get_num_threads() == 1:
            for row in self.rows:
                row.source.prepare(frame)


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


_AHEAD = 2  # frames; decoding releases Python's lock


def prefetch(
    sequence: FrameSequence, indices: Iterable[int], prepare: Callable[[Frame], None] = lambda _: None
) -> Generator[Future[Frame]]:
    """Yield the frames at some indices, in order, read by one thread at most two frames ahead, which calls ``prepare``
    with each. A frame's ``result()`` raises FrameError if it cannot be read. Closing the generator ends the thread."""

    def read(index: int) -> Frame:
        frame = sequence[index]
        prepare(frame)
        return frame

    thread, reading = ThreadPoolExecutor(1), deque[Future[Frame]]()
    try:
        for index in indices:
            reading.append(thread.submit(read, index))
            if len(reading) > _AHEAD:
                yield reading.popleft()
        yield from reading
    finally:
        thread.shutdown(cancel_futures=True)

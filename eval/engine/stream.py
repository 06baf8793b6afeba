"""The loop over frames: every frame of a sequence through all rows, and what came of it to the sinks.

``ufmstar run`` is one row with writers, ``ufmstar demo`` four rows on a rendered tour, ``ufmstar eval`` the rows of a
suite with metrics, and the benchmark no row, or one, with a clock. Several sequences may go through it at the same
time: networks and UfM* then get batches.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ufmstar_torch.eval.engine.ahead import FramesAhead
from ufmstar_torch.eval.engine.clock import StageTimer
from ufmstar_torch.eval.engine.predictions import FramePredictions, Prediction, PredictionStore, sequence_digest
from ufmstar_torch.eval.engine.rows import RowFrame, RowRunner
from ufmstar_torch.eval.engine.together import infer_together, update_together
from ufmstar_torch.eval.methods.perturb import selects
from ufmstar_torch.eval.sequences.frame import Frame, FrameError, FrameSequence
from ufmstar_torch.eval.sequences.ground_truth import truth_at


class Stopped(Exception):
    """The caller asked to stop, between two frames."""


@dataclass(frozen=True, eq=False)
class FrameResult:
    """What came of a frame."""

    number: int  # of the frame among those that the stream selects, from 0
    index: int  # of the frame in its sequence
    name: str  # of the frame
    frame: Frame | None = None  # as it was read; None where no row selects it, or it cannot be used
    rows: Mapping[str, RowFrame] = field(default_factory=dict)  # by key, of the rows that have taken it in
    skipped: Mapping[str, str] = field(default_factory=dict)  # by key, why a row that selects the frame cannot use it
    # "read" (what was left to wait for: frames are read ahead), "predict" (without the batches of several streams) and
    # "truth", and the stages of the sinks that came before [ms].
    ms: dict[str, float] = field(default_factory=dict)
    # the stream's after the frame (``FrameStream.state``), for sinks that work behind the loop; else empty.
    state: Mapping[str, Mapping[str, Tensor]] = field(default_factory=dict)


class FrameSink(ABC):
    """Takes what comes of the frames: metrics, writers, progress. Each defines its own ``take``."""

    # Its time stands in ``FrameResult.ms`` under this name for the sinks after it; None = it is not timed.
    stage: str | None = None

    def begin(self, stream: FrameStream) -> None:
        """Before the first frame, or the first one after a resume."""

    @abstractmethod
    def take(self, result: FrameResult) -> None:
        """After every frame, skipped ones too. The stream's state is that after the frame."""

    def end(self) -> None:
        """After the last frame; not after a stop or an error."""


class FrameStream:
    """The frames of a sequence on their way through rows.

    A frame that no row selects is not decoded. A frame that cannot be read or predicted from is skipped by all rows
    that select it, and counts for none of them.

    Args:
        sequence: posed frames.
        indices: which of them, in order.
        rows: with different keys. () only reads the frames, and a frame that cannot be read is an error.
        store: of predictions; None = every prediction is computed.
        device: of the rows' estimators, where they want their maps.
        check: raises ``FrameError`` for a frame that no row is to use.
        start: position in ``indices`` to begin at; the rows are in the state of that moment.

    Attributes:
        position: frames that are done, skipped ones included.
        timer: of the stages of a frame.
    """

    def __init__(
        self,
        sequence: FrameSequence,
        indices: Sequence[int],
        rows: Sequence[RowRunner],
        *,
        store: PredictionStore | None = None,
        device: torch.device | None = None,
        check: Callable[[Frame], None] | None = None,
        start: int = 0,
    ) -> None:
        if len({row.key for row in rows}) < len(rows):
            raise ValueError(f"rows must have different keys, got {[row.key for row in rows]}")
        self.sequence, self.indices, self.rows = sequence, indices, tuple(rows)
        self._store, self._device, self._check = store, device or torch.device("cpu"), check
        self._names = sequence.names
        self._digest = "" if store is None else sequence_digest(sequence)
        self.timer = StageTimer(self._device)
        self.position = start

    def drive(self, sinks: Sequence[FrameSink], *, stop: Callable[[], bool] = lambda: False) -> None:
        """Go through the frames that are left; each one's result goes to the sinks in their order. ``stop`` is asked
        before every frame.

        Raises:
            Stopped: ``stop`` returned True.
            FrameError: without rows, a frame cannot be read.
        """
        for _ in drive_together(iter([(self, sinks)]), stop=stop):
            pass

    def state(self) -> dict[str, dict[str, Tensor]]:
        """All tensors on which the next frame depends, by row."""
        return {row.key: row.state() for row in self.rows}

    def needed(self) -> list[int]:
        """Of the frames that are left, those that a row selects; without rows all."""
        left = range(self.position, len(self.indices))
        return [self.indices[n] for n in left if not self.rows or any(selects(row.setting, n) for row in self.rows)]

    def prepare(self, frame: Frame) -> None:
        """The networks' input, unless a store may have all predictions; in the thread that reads ahead.

        Only where torch computes with one thread. With more, torch's operations in this thread would start a second
        team of OpenMP threads, beside which the first one no longer spins: networks took three times as long.
        """
        if self._store is None and torch.get_num_threads() == 1:
            for row in self.rows:
                row.source.prepare(frame)

    def next(self, frames: FramesAhead) -> _Frame:
        """The way of the next frame: yields (predictions, row) whose inferences may be made meanwhile, and then the
        rows' frames, which must be answered; returns what came of it. Raises FrameError: without rows, the frame cannot
        be read."""
        number, index = self.position, self.indices[self.position]
        name = self._names[index]
        active = [row for row in self.rows if selects(row.setting, number)]
        self.timer.take()
        self.position += 1
        if self.rows and not active:
            return FrameResult(number, index, name)
        try:
            with self.timer.stage("read"):
                frame = frames.next()
                if self._check is not None:
                    self._check(frame)
            known = FramePredictions(frame, self._device, self._store, self._digest)
            yield [(known, row) for row in active]
            with self.timer.stage("predict"):
                predictions = {row.key: known.of(row.source, row.images, row.every) for row in active}
            with self.timer.stage("truth"):
                truths = _truths(frame, predictions)
        except FrameError as error:
            if not self.rows:
                raise
            return FrameResult(number, index, name, skipped={row.key: error.reason for row in active})
        ms = self.timer.take()
        updates = [row.begin(frame, predictions[row.key], truths[row.key]) for row in active]
        yield updates
        taken: dict[str, RowFrame] = {}
        skipped: dict[str, str] = {}
        for one in updates:
            try:
                one.row.finish(one, name)
                taken[one.row.key] = one
            except FrameError as error:
                skipped[one.row.key] = error.reason
        return FrameResult(number, index, name, frame, taken, skipped, ms)


_Frame = Generator[Sequence[Any], None, FrameResult]


def drive_together(
    streams: Iterator[tuple[FrameStream, Sequence[FrameSink]]],
    *,
    at_once: int = 1,
    stop: Callable[[], bool] = lambda: False,
    broken: tuple[type[Exception], ...] = (),
) -> Generator[tuple[FrameStream, Exception | None], None, None]:
    """Go through the frames of several streams at the same time: one frame of each, then the next of each.

    Args:
        streams: each with its sinks; the next one is taken when one has ended.
        at_once: number of streams.
        stop: asked before every frame.
        broken: errors that end the stream whose frame raises them, and no other; any other error ends all.

    Yields:
        A stream that has ended, and the error that ended it before its last frame, or None.

    Raises:
        Stopped: ``stop`` returned True.
    """
    lanes: list[_Lane] = []
    try:
        while True:
            while len(lanes) < at_once and (entry := next(streams, None)) is not None:
                lanes.append(_Lane(*entry, broken))
            if not lanes:
                return
            if not any(lane.over for lane in lanes):
                if stop():
                    raise Stopped
                _one_frame_of_each(lanes)
            for lane in [lane for lane in lanes if lane.over]:
                lanes.remove(lane)
                lane.end()
                yield lane.stream, lane.error
    finally:
        for lane in lanes:
            lane.close()


class _Lane:
    """A stream on its way, its sinks, and what keeps an error of its own from other streams."""

    def __init__(self, stream: FrameStream, sinks: Sequence[FrameSink], broken: tuple[type[Exception], ...]) -> None:
        self.stream, self._sinks, self._broken = stream, sinks, broken
        self.error: Exception | None = None
        self._frame: _Frame | None = None
        self._open = ExitStack()
        self._frames = self._open.enter_context(FramesAhead(stream.sequence, stream.needed(), stream.prepare))
        with self._own_errors():
            for sink in sinks:
                sink.begin(stream)

    @property
    def over(self) -> bool:
        """Whether no frame is left, or an error has ended it."""
        done = self._frame is None and self.stream.position >= len(self.stream.indices)
        return done or self.error is not None

    def advance(self) -> Sequence[Any]:
        """Bring the frame in hand, or the next one, to its next stop: what it needs there. At its end the sinks get
        what came of it."""
        if self.over:
            return []
        with self._own_errors():
            if self._frame is None:
                self._frame = self.stream.next(self._frames)
            try:
                return next(self._frame)
            except StopIteration as ended:
                self._frame = None
                hand_over(ended.value, self._sinks, self.stream.timer)
        return []

    @property
    def waits(self) -> bool:
        """Whether a frame is in hand."""
        return self._frame is not None and self.error is None

    def end(self) -> None:
        """After the last frame, or an error."""
        self.close()
        if self.error is None:
            with self._own_errors():
                for sink in self._sinks:
                    sink.end()

    def close(self) -> None:
        """Read no further frame."""
        self._open.close()

    @contextmanager
    def _own_errors(self) -> Iterator[None]:
        try:
            yield
        except self._broken as error:
            self.error = error


def _one_frame_of_each(lanes: Sequence[_Lane]) -> None:
    """All frames to their first stop, there the inferences; to their second stop, there the updates; to their end."""
    infer_together([one for lane in lanes for one in lane.advance()])
    update_together([one for lane in lanes if lane.waits for one in lane.advance()])
    for lane in lanes:
        if lane.waits:
            lane.advance()


def hand_over(result: FrameResult, sinks: Sequence[FrameSink], timer: StageTimer) -> None:
    """Give a result to sinks, in their order; the times of their stages are added to it."""
    for sink in sinks:
        if sink.stage is None:
            sink.take(result)
            continue
        with timer.stage(sink.stage):
            sink.take(result)
        result.ms.update(timer.take())


def _truths(frame: Frame, predictions: Mapping[str, Prediction]) -> dict[str, NDArray[np.float32] | None]:
    """Ground truth at the pixels of every row's maps, [h, w] [m], 0 = none; once for every camera. Raises FrameError:
    the depth map has no camera."""
    known: dict[tuple[object, ...], NDArray[np.float32] | None] = {}
    truths = {}
    for key, one in predictions.items():
        camera = (one.size, one.intrinsics.numpy().tobytes())
        if camera not in known:
            known[camera] = truth_at(frame, one.intrinsics.numpy(), one.size)
        truths[key] = known[camera]
    return truths

"""The loop over frames: every frame of a sequence through all rows, and what came of it to the sinks.

``ufmstar run`` is one row with writers, ``ufmstar demo`` four rows on a rendered tour, ``ufmstar eval`` the rows of a
suite with metrics, and the benchmark no row, or one, with a clock.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ufmstar_torch.eval.engine.ahead import FramesAhead
from ufmstar_torch.eval.engine.clock import StageTimer
from ufmstar_torch.eval.engine.predictions import FramePredictions, Prediction, PredictionStore, sequence_digest
from ufmstar_torch.eval.engine.rows import RowFrame, RowRunner
from ufmstar_torch.eval.sequences.frame import Frame, FrameError, FrameSequence
from ufmstar_torch.eval.sequences.ground_truth import truth_at


class Stopped(Exception):
    """The caller asked to stop, between two frames."""


@dataclass(frozen=True, eq=False)
class FrameResult:
    """What came of a frame.

    Attributes:
        number: of the frame among those that the stream selects, from 0.
        index: of the frame in its sequence.
        name: of the frame.
        frame: as it was read; None where no row selects it, or it cannot be used.
        rows: by key, of the rows that have taken it in.
        skipped: by key, why a row that selects the frame cannot use it.
        ms: "read" (what was left to wait for: frames are read ahead), "predict" and "truth", and the stages of the
            sinks that came before [ms].
        state: the stream's after the frame (``FrameStream.state``), for sinks that work behind the loop; else empty.
    """

    number: int
    index: int
    name: str
    frame: Frame | None = None
    rows: Mapping[str, RowFrame] = field(default_factory=dict)
    skipped: Mapping[str, str] = field(default_factory=dict)
    ms: dict[str, float] = field(default_factory=dict)
    state: Mapping[str, Tensor] = field(default_factory=dict)


class Sink(Protocol):
    """Takes what comes of the frames: metrics, writers, progress.

    Attributes:
        stage: its time stands in ``FrameResult.ms`` under this name for the sinks after it; None = it is not timed.
    """

    stage: str | None

    def begin(self, stream: FrameStream) -> None:
        """Before the first frame, or the first one after a resume."""
        ...

    def take(self, result: FrameResult) -> None:
        """After every frame, skipped ones too. The stream's state is that after the frame."""
        ...

    def end(self) -> None:
        """After the last frame; not after a stop or an error."""
        ...


class FrameSink:
    """The parts of a :class:`Sink` that most sinks leave empty; each defines its own ``take``."""

    stage: str | None = None

    def begin(self, stream: FrameStream) -> None:
        """See :class:`Sink`."""

    def end(self) -> None:
        """See :class:`Sink`."""


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
        self._timer = StageTimer(self._device)
        self.position = start

    def drive(self, sinks: Sequence[Sink], *, stop: Callable[[], bool] = lambda: False) -> None:
        """Go through the frames that are left; each one's result goes to the sinks in their order.

        Args:
            sinks: see :class:`Sink`.
            stop: asked before every frame.

        Raises:
            Stopped: ``stop`` returned True.
            FrameError: without rows, a frame cannot be read.
        """
        for sink in sinks:
            sink.begin(self)
        with FramesAhead(self.sequence, self._needed(), self._prepare) as frames:
            while self.position < len(self.indices):
                if stop():
                    raise Stopped
                result = self._next(frames)
                for sink in sinks:
                    if sink.stage is None:
                        sink.take(result)
                        continue
                    with self._timer.stage(sink.stage):
                        sink.take(result)
                    result.ms.update(self._timer.take())
        for sink in sinks:
            sink.end()

    def state(self) -> dict[str, Tensor]:
        """All tensors on which the next frame depends, by row: "KEY/NAME"."""
        return {f"{row.key}/{name}": value for row in self.rows for name, value in row.state().items()}

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        """Bring the rows to where ``state`` was taken; :attr:`position` is the caller's.

        Raises:
            ValueError: it is the state of other rows.
        """
        for row in self.rows:
            prefix = f"{row.key}/"
            row.load_state({name[len(prefix) :]: v for name, v in state.items() if name.startswith(prefix)})

    def _needed(self) -> list[int]:
        """Of the frames that are left, those that a row selects; without rows all."""
        left = range(self.position, len(self.indices))
        return [self.indices[n] for n in left if not self.rows or any(row.selects(n) for row in self.rows)]

    def _prepare(self, frame: Frame) -> None:
        """The networks' input, unless it may be that a store has all predictions."""
        if self._store is None:
            for row in self.rows:
                row.source.prepare(frame)

    def _next(self, frames: FramesAhead) -> FrameResult:
        number, index = self.position, self.indices[self.position]
        name = self._names[index]
        active = [row for row in self.rows if row.selects(number)]
        self._timer.take()
        self.position += 1
        if self.rows and not active:
            return FrameResult(number, index, name)
        try:
            frame, predictions, truths = self._inputs(frames, active)
        except FrameError as error:
            if not self.rows:
                raise
            return FrameResult(number, index, name, skipped={row.key: error.reason for row in active})
        ms = self._timer.take()
        taken: dict[str, RowFrame] = {}
        skipped: dict[str, str] = {}
        for row in active:
            try:
                taken[row.key] = row.take(frame, predictions[row.key], truths[row.key])
            except FrameError as error:
                skipped[row.key] = error.reason
        return FrameResult(number, index, name, frame, taken, skipped, ms)

    def _inputs(
        self, frames: FramesAhead, active: Sequence[RowRunner]
    ) -> tuple[Frame, dict[str, Prediction], dict[str, NDArray[np.float32] | None]]:
        """The frame, and by row what is predicted for it and its ground truth.

        Raises:
            FrameError: the frame cannot be used.
        """
        with self._timer.stage("read"):
            frame = frames.next()
            if self._check is not None:
                self._check(frame)
        with self._timer.stage("predict"):
            known = FramePredictions(frame, self._device, self._store, self._digest)
            predictions = {row.key: row.predict(known) for row in active}
        with self._timer.stage("truth"):
            return frame, predictions, _truths(frame, predictions)


def _truths(frame: Frame, predictions: Mapping[str, Prediction]) -> dict[str, NDArray[np.float32] | None]:
    """Ground truth at the pixels of every row's maps, [h, w] [m], 0 = none; once for every camera.

    Raises:
        FrameError: the depth map has no camera.
    """
    known: dict[tuple[object, ...], NDArray[np.float32] | None] = {}
    truths = {}
    for key, one in predictions.items():
        camera = (one.size, one.intrinsics.numpy().tobytes())
        if camera not in known:
            known[camera] = truth_at(frame, one.intrinsics.numpy(), one.size)
        truths[key] = known[camera]
    return truths

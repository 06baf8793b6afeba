"""The progress of a command, for a terminal."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from ufmstar_torch.eval.engine.stream import FrameResult, FrameSink, FrameStream


@dataclass(frozen=True)
class Progress:
    """The progress of a command."""

    stage: str  # "kernels" (compiled on a machine's first run), "rooms", "frames" or "pictures"
    done: int  # number of finished steps of this stage, skipped frames included
    total: int  # number of steps of this stage
    components: int | None = None  # of the first row with UfM*; None if it skipped the frame, and before the first one
    skipped: int = 0  # number of frames skipped so far


class ProgressSink(FrameSink):
    """Calls ``progress`` at the start and after every frame; ``skipped`` is the initial count of skipped frames."""

    def __init__(self, progress: Callable[[Progress], object], skipped: int = 0) -> None:
        self._progress, self._skipped = progress, skipped

    def begin(self, stream: FrameStream) -> None:
        self._total = len(stream.indices)
        self._progress(Progress("frames", stream.position, self._total, None, self._skipped))

    def take(self, result: FrameResult) -> None:
        self._skipped += bool(result.skipped)
        each = (row.statistics for row in result.rows.values())
        statistics = next((one for one in each if one is not None), None)
        components = None if statistics is None else int(statistics.components[0])
        self._progress(Progress("frames", result.number + 1, self._total, components, self._skipped))

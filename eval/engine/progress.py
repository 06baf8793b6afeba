"""The progress of a command, for a terminal."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from ufmstar_torch.eval.engine.stream import FrameResult


@dataclass(frozen=True)
class Progress:
    """The progress of a command."""

    stage: str  # "kernels" (compiled on a machine's first run), "rooms", "frames" or "pictures"
    done: int  # number of finished steps of this stage, skipped frames included
    total: int  # number of steps of this stage
    components: int | None = None  # of the first row with components; None before the first frame
    skipped: int = 0  # number of frames skipped so far


class FrameProgress:
    """Shows the progress over ``total`` frames: at the start, and after every frame."""

    def __init__(self, show: Callable[[Progress], object], total: int) -> None:
        self._show, self._total, self._skipped = show, total, 0
        show(Progress("frames", 0, total))

    def add(self, result: FrameResult) -> None:
        """Show that a frame is done."""
        self._skipped += bool(result.skipped)
        each = (int(row.out.statistics.components[0]) for row in result.rows.values())
        components = next((count for count in each if count), None)
        self._show(Progress("frames", result.number + 1, self._total, components, self._skipped))

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


def frame_progress(show: Callable[[Progress], object], total: int) -> Callable[[FrameResult], None]:
    """Show the progress over ``total`` frames: at the start, and by the returned function after every frame."""
    skipped = 0

    def shown(result: FrameResult) -> None:
        nonlocal skipped
        skipped += bool(result.skipped)
        each = (int(row.out.statistics.components[0]) for row in result.rows.values())
        components = next((count for count in each if count), None)
        show(Progress("frames", result.number + 1, total, components, skipped))

    show(Progress("frames", 0, total))
    return shown

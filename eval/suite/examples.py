"""Maps and mixtures of a few frames, for pictures."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Examples:
    """Where pictures are made from.

    Attributes:
        folder: of the sequence; "examples" and "room" are made within it.
        frames: how many, evenly spaced.
        room: whether to leave UfM*'s mixtures as well, after a quarter, half and all of the frames.
    """

    folder: Path
    frames: int = 3
    room: bool = True

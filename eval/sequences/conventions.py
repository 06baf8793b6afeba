"""How poses are written down, and what makes them camera-to-world ones with our axes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ufmstar_torch.eval.sequences.frame import FrameSequence

# Columns are our camera axes in a camera frame with x forward, y right, z down, or x right, y up, z backward.
_NED_FROM_CAMERA = np.array([[0.0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
_OPENGL_FROM_CAMERA = np.diag([1.0, -1, -1, 1])


class Convention(NamedTuple):
    """A way to write poses, in words, and the map of poses [..., 4, 4] to camera-to-world ones with our axes."""

    description: str
    convert: Callable[[np.ndarray], np.ndarray]


OURS = "camera-to-world"
CONVENTIONS = {
    OURS: Convention("camera-to-world, x right, y down, z forward", lambda T: T),
    "world-to-camera": Convention("world-to-camera (inverted)", np.linalg.inv),
    "ned": Convention("camera-to-world with NED axes (x forward, y right, z down)", lambda T: T @ _NED_FROM_CAMERA),
    "opengl": Convention(
        "camera-to-world with OpenGL axes (x right, y up, z backward)", lambda T: T @ _OPENGL_FROM_CAMERA
    ),
}


def convert_poses(sequence: FrameSequence, convention: str) -> FrameSequence:
    """The sequence with its poses, which were written so, as camera-to-world ones with our axes. Raises ValueError: an
    unknown convention, or a sequence without poses."""
    if convention not in CONVENTIONS:
        raise ValueError(f"poses must be one of {', '.join(CONVENTIONS)}, got {convention!r}")
    if convention == OURS:
        return sequence
    if not sequence.posed:
        raise ValueError(f"sequence {sequence.name!r} has no poses to convert from {convention}")
    convert = CONVENTIONS[convention].convert
    return replace(sequence, entries=tuple(replace(e, T_world_cam=convert(e.T_world_cam)) for e in sequence.entries))

"""Conventions of camera poses, and their conversion to ours."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

# Columns are our camera axes in a camera frame with x forward, y right, z down, or x right, y up, z backward.
_NED_FROM_CAMERA = np.array([[0.0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
_OPENGL_FROM_CAMERA = np.diag([1.0, -1, -1, 1])


class Convention(NamedTuple):
    """A convention of poses: its description, and the conversion of poses [..., 4, 4] to ours."""

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

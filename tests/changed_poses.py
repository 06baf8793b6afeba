"""Changes of camera poses [4, 4]."""

from __future__ import annotations

import numpy as np


def rigid(R, t):
    """[4, 4] pose from a rotation and a position."""
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = R, t
    return out


def scaled(T, factor):
    """The pose with its position in another unit."""
    out = T.copy()
    out[:3, 3] *= factor
    return out

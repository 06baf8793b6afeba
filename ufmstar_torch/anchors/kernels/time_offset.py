"""Motion between poses, and the time offset that a window's pose errors show, for ``anchors.time_offset``; on the CPU
(numba)."""

from __future__ import annotations

import numpy as np

from ufmstar_torch.kernels.compile_cpu import empty, reordered, reordered_leaf


@reordered
def steps(T, out):
    """Write the motion [W - 1, 6] from each pose [W, 4, 4] to the next one: rotation vector in the camera's axes [rad],
    shift along the world's [m]."""
    axis = empty(3, np.float64)
    for k in range(len(T) - 1):
        _motion(T[k], T[k + 1], 1.0, axis, out[k])


@reordered
def late(T, precision, error, covariance):
    """The information of a window on the lag, and the lag by it beyond the present one [images]; arguments as
    ``TimeOffset.learn``."""
    views, size = len(T), 6 * len(T)
    motion, axis = empty((views, 6), np.float64), empty(3, np.float64)
    for k in range(views):  # before and after each view; neighbours of the first and the last view
        before, after = max(k - 1, 0), min(k + 1, views - 1)
        if k == 0:
            before, after = 1, 2
        elif k == views - 1:
            before, after = views - 3, views - 2
        _motion(T[before], T[after], 0.5 if 0 < k < views - 1 else 1.0, axis, motion[k])
    information = total = 0.0
    for i in range(size):
        m = motion[i // 6, i % 6]
        expected = m
        for j in range(size):
            expected -= covariance[i, j] * precision[j] * motion[j // 6, j % 6]
        information += precision[i] * m * expected
        total += precision[i] * m * error[i]
    information /= views  # windows overlap: each pose is in W windows
    return information, total / views / information


@reordered_leaf
def _motion(T, T_next, share, axis, out):
    """Write a share of the motion between two poses [4, 4] to ``out`` [6]; ``axis`` is a buffer [3]."""
    trace = 0.0
    for i in range(3):
        one, other = (i + 1) % 3, (i + 2) % 3
        axis[i] = 0.0
        for m in range(3):
            trace += T[m, i] * T_next[m, i]
            axis[i] += (T[m, other] * T_next[m, one] - T[m, one] * T_next[m, other]) / 2
    sine = np.sqrt(axis[0] * axis[0] + axis[1] * axis[1] + axis[2] * axis[2])
    over = share * np.arctan2(sine, (trace - 1) / 2) / max(sine, 1e-12)
    for i in range(3):
        out[i], out[3 + i] = axis[i] * over, share * (T_next[i, 3] - T[i, 3])

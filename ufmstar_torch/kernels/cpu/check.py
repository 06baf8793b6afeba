"""The check of a frame's values on the CPU: maps in NumPy, cameras in plain numbers.

The same comparisons as the reference in :mod:`ufmstar_torch.frames.frame`, whose chain of small tensors takes a
millisecond. Thresholds are rounded to the maps' dtype as torch rounds them.
"""

from __future__ import annotations

import itertools
import math
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ufmstar_torch.frames.frame import DEPTH_RANGE, FARTHEST, FOCAL_RANGE, LARGEST, FrameInput
from ufmstar_torch.gaussians.camera import POLAR_STEPS
from ufmstar_torch.kernels.cpu.calls import array

_Matrix = list[list[float]]
_EYE3, _EYE4 = np.eye(3).tolist(), np.eye(4).tolist()
_AXES = range(3)
_ROUNDING = 4e-16  # deviation of R^T R below which a further step changes nothing


def check_values(
    depth: Tensor,
    pose: Tensor,
    intrinsics: Tensor,
    aleatoric: Tensor | None,
    epistemic: Tensor | None,
    features: Tensor | None,
    mask: Tensor | None,
    *,
    rotation_tolerance: float,
    max_depth: float,
) -> FrameInput:
    """As :func:`ufmstar_torch.frames.frame.check_values`, for the CPU. Depth that is valid everywhere is not copied."""
    b, height, width = depth.shape
    poses, cameras = (_matrices(matrix, b) for matrix in (pose, intrinsics))
    checked = [_camera(T, K, height, width, rotation_tolerance) for T, K in zip(poses, cameras, strict=True)]
    T_safe, K_safe, faults, deviations = zip(*checked, strict=True)
    z, wanted = array(depth), None if mask is None else array(mask)
    use = np.ones(z.shape, np.bool_) if wanted is None else wanted.copy()
    _restrict(use, z, DEPTH_RANGE[0], min(max_depth, DEPTH_RANGE[1]))
    for variance in (aleatoric, epistemic):
        if variance is not None:
            _restrict(use, array(variance), 0.0, LARGEST)
    for channel in [] if features is None else array(features).swapaxes(0, 1):
        _restrict(use, channel, -LARGEST, LARGEST)
    if any(faults):
        use[np.flatnonzero(faults)] = False
    safe, counts = z, np.zeros((3, b), np.int64)
    counts[0] = faults
    if not use.all():
        left_out = np.flatnonzero(~use)
        values, stream = z.reshape(-1)[left_out], left_out // (height * width)
        has_depth = (values > 0) & (values < np.inf) & (counts[0] == 0)[stream]
        if wanted is not None:
            has_depth &= wanted.reshape(-1)[left_out]
        far = values > max_depth
        for kind, chosen in enumerate((has_depth & far, has_depth & ~far), start=1):
            counts[kind] = np.bincount(stream[chosen], minlength=b)
        safe = z.copy()
        safe.reshape(-1)[left_out] = 0
    arrays = safe, np.array(T_safe), np.array(K_safe), use, np.array(deviations), *counts
    safe_depth, T, K, valid, deviation, fault, beyond, out_of_range = map(torch.from_numpy, arrays)
    return FrameInput(
        safe_depth, T, K, aleatoric, epistemic, features, valid, fault, deviation, beyond, out_of_range, fault
    )


def _matrices(tensor: Tensor, streams: int) -> list[_Matrix]:
    """One matrix for each stream as lists of numbers, from [B, n, n], [1, n, n] or [n, n]."""
    matrices = tensor.tolist() if tensor.dim() == 3 else [tensor.tolist()]
    return matrices if len(matrices) == streams else matrices * streams


def _restrict(use: NDArray[np.bool_], values: NDArray[Any], least: float, most: float) -> None:
    """Clear ``use`` [B, H, W] where values are outside [least, most] or NaN.

    Where all values are inside, the extremes show it without memory for masks.
    """
    if not (values.min() >= least and values.max() <= most):
        use &= values >= least
        use &= values <= most


def pose_fault(T: _Matrix, tolerance: float) -> int:
    """Code 1 to 4 or 7 of a camera-to-world pose (``frame.FRAME_FAULTS``), 0 for none.

    Args:
        T: [4][4] [m].
        tolerance: largest deviation of R^T R from the identity.
    """
    return _pose_fault(T, _deviation(_gram(T)), tolerance)


def intrinsics_fault(K: _Matrix, height: float, width: float) -> int:
    """Code 5, 6, 8 or 9 of intrinsics [3][3] of an image of ``height`` and ``width`` [px], 0 for none."""
    (fx, skew, cx), (other, fy, cy), last = K
    if not _finite(K):
        return 5
    if skew or other or last != [0.0, 0.0, 1.0] or fx <= 0 or fy <= 0:
        return 6
    if min(fx, fy) < FOCAL_RANGE[0] or max(fx, fy) > FOCAL_RANGE[1]:
        return 8
    return 9 if min(cx, cy) < -0.5 or cx > width - 0.5 or cy > height - 0.5 else 0


def _camera(T: _Matrix, K: _Matrix, height: int, width: int, tolerance: float) -> tuple[_Matrix, _Matrix, int, float]:
    """The pose with its nearest rotation and the intrinsics of a stream (identities where there is a fault), the code
    of the first fault (``FRAME_FAULTS``), and max |R^T R - I| of the pose ``T``."""
    gram = _gram(T)
    deviation = _deviation(gram)
    fault = _pose_fault(T, deviation, tolerance) or intrinsics_fault(K, height, width)
    if fault:
        return _EYE4, _EYE3, fault, deviation
    rotation = [row[:3] for row in T[:3]]
    for _ in range(POLAR_STEPS):  # as ``camera.nearest_rotation``: R <- R (3 I - R^T R)/2
        if _deviation(gram) < _ROUNDING:
            break
        Q = [[(1.5 if i == j else 0.0) - 0.5 * value for j, value in enumerate(row)] for i, row in enumerate(gram)]
        rotation = [[a * Q[0][j] + b * Q[1][j] + c * Q[2][j] for j in _AXES] for a, b, c in rotation]
        gram = _gram(rotation)
    return [[*row, T[i][3]] for i, row in enumerate(rotation)] + _EYE4[3:], K, 0, deviation


def _gram(R: _Matrix) -> _Matrix:
    """R^T R of the first three rows and columns."""
    x, y, z = R[:3]
    return [[x[i] * x[j] + y[i] * y[j] + z[i] * z[j] for j in _AXES] for i in _AXES]


def _deviation(gram: _Matrix) -> float:
    """max |G - I|, NaN where an entry is."""
    (a, b, c), (_, d, e), (_, _, f) = gram
    off = abs(a - 1), abs(b), abs(c), abs(d - 1), abs(e), abs(f - 1)
    return math.nan if math.isnan(sum(off)) else max(off)


def _finite(matrix: _Matrix) -> bool:
    return all(map(math.isfinite, itertools.chain.from_iterable(matrix)))


def _pose_fault(T: _Matrix, deviation: float, tolerance: float) -> int:
    """Code 1 to 4 or 7 of a pose, 0 for none."""
    if not _finite(T):
        return 1
    x, y, z, last = T
    if max(abs(a - b) for a, b in zip(last, _EYE4[3], strict=True)) > tolerance:
        return 2
    if deviation > tolerance:
        return 3
    cross = x[1] * y[2] - x[2] * y[1], x[2] * y[0] - x[0] * y[2], x[0] * y[1] - x[1] * y[0]
    if sum(a * b for a, b in zip(cross, z, strict=False)) < 0:
        return 4
    return 7 if max(abs(row[3]) for row in T[:3]) > FARTHEST else 0

"""The check of a frame's values on the CPU: maps in NumPy, cameras in plain numbers.

The same comparisons as the reference in :mod:`ufmstar_torch.frame`, whose chain of small tensors takes a millisecond.
Thresholds are rounded to the maps' dtype as torch rounds them.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ufmstar_torch.frame import DEPTH_RANGE, FARTHEST, FOCAL_RANGE, LARGEST, POLAR_STEPS, FrameInput, FrameMaps
from ufmstar_torch.kernels.arrays_cpu import array

_Matrix = list[list[float]]
_EYE3, _EYE4 = np.eye(3).tolist(), np.eye(4).tolist()
_AXES = range(3)
_ROUNDING = 4e-16  # of R^T R: a further step changes nothing


def check_values(
    maps: FrameMaps, pose: Tensor, intrinsics: Tensor, *, rotation_tolerance: float, max_depth: float
) -> FrameInput:
    """As :func:`ufmstar_torch.frame.check_values`, for the CPU. Depth that is valid everywhere is not copied."""
    b, height, width = maps.depth.shape
    poses, cameras = ([m for m in _matrices(given) for _ in range(b if given.dim() == 2 or len(given) == 1 else 1)]
                      for given in (pose, intrinsics))  # fmt: skip
    checked = [_camera(T, K, height, width, rotation_tolerance) for T, K in zip(poses, cameras, strict=True)]
    T_safe, K_safe, faults, deviations = zip(*checked, strict=True)
    depth, mask = array(maps.depth), None if maps.mask is None else array(maps.mask)
    fine = np.array(faults) == 0
    use = _valid(maps, depth, mask, min(max_depth, DEPTH_RANGE[1]))
    if not fine.all():
        use &= fine[:, None, None]
    beyond, out_of_range = np.zeros(b, np.int64), np.zeros(b, np.int64)
    kept = [int(np.count_nonzero(one)) for one in use]
    whole = [count == height * width for count in kept]
    safe = depth
    if not all(whole):
        safe = np.where(use, depth, np.zeros((), depth.dtype))
        for s in np.flatnonzero(fine & ~np.array(whole)):
            given = (depth[s] > 0) & (depth[s] < np.inf)
            if mask is not None:
                given &= mask[s]
            far = int(np.count_nonzero(given & (depth[s] > max_depth)))
            beyond[s], out_of_range[s] = far, int(np.count_nonzero(given)) - far - kept[s]
    arrays = safe, np.array(T_safe), np.array(K_safe), use, np.array(deviations), beyond, out_of_range
    safe_depth, T, K, valid, deviation, beyond_count, out_count = map(torch.from_numpy, arrays)
    fault = torch.tensor(faults)
    return FrameInput(
        safe_depth, T, K, maps.aleatoric, maps.epistemic, maps.features, valid, fault, deviation, beyond_count,
        out_count, fault,
    )  # fmt: skip


def _matrices(cameras: Tensor) -> list[_Matrix]:
    """[B, n, n] or [n, n] as lists of float64."""
    return np.asarray(array(cameras), np.float64).reshape(-1, *cameras.shape[-2:]).tolist()


def _valid(maps: FrameMaps, depth: NDArray[Any], mask: NDArray[np.bool_] | None, farthest: float) -> NDArray[np.bool_]:
    """[B, H, W] pixels whose values can be used; NaN fails every comparison."""
    use = depth >= DEPTH_RANGE[0]
    use &= depth <= farthest
    if mask is not None:
        use &= mask
    for variance in (maps.aleatoric, maps.epistemic):
        if variance is not None:
            values = array(variance)
            use &= (values >= 0) & (values <= LARGEST)
    if maps.features is not None:
        use &= (np.abs(array(maps.features)) <= LARGEST).all(1)
    return use


def _camera(T: _Matrix, K: _Matrix, height: int, width: int, tolerance: float) -> tuple[_Matrix, _Matrix, int, float]:
    """Of a stream the pose with its nearest rotation and the intrinsics (an identity and a unit camera where there is a
    fault), the code of the first fault (``FRAME_FAULTS``), and max |R^T R - I| of the given pose."""
    off = [abs(value - (i == j)) for i, row in enumerate(_gram(T)) for j, value in enumerate(row)]
    deviation = math.nan if any(map(math.isnan, off)) else max(off)
    finite = all(math.isfinite(value) for row in T for value in row)
    fault = (_pose_fault(T, deviation, tolerance) if finite else 1) or _intrinsics_fault(K, height, width)
    if fault:
        return _EYE4, _EYE3, fault, deviation
    rotation = [row[:3] for row in T[:3]]
    for _ in range(POLAR_STEPS):  # as ``camera.nearest_rotation``: R <- R (3 I - R^T R)/2
        gram = _gram(rotation)
        if max(abs(value - (i == j)) for i, row in enumerate(gram) for j, value in enumerate(row)) < _ROUNDING:
            break
        Q = [[(1.5 if i == j else 0.0) - 0.5 * value for j, value in enumerate(row)] for i, row in enumerate(gram)]
        rotation = [[a * Q[0][j] + b * Q[1][j] + c * Q[2][j] for j in _AXES] for a, b, c in rotation]
    return [[*row, T[i][3]] for i, row in enumerate(rotation)] + _EYE4[3:], K, 0, deviation


def _gram(R: _Matrix) -> _Matrix:
    """R^T R of the first three rows and columns."""
    x, y, z = R[:3]
    return [[x[i] * x[j] + y[i] * y[j] + z[i] * z[j] for j in _AXES] for i in _AXES]


def _pose_fault(T: _Matrix, deviation: float, tolerance: float) -> int:
    """Code 2 to 4 or 7 of a finite pose, 0 for none."""
    x, y, z, last = T
    if max(abs(a - b) for a, b in zip(last, _EYE4[3], strict=True)) > tolerance:
        return 2
    if deviation > tolerance:
        return 3
    cross = x[1] * y[2] - x[2] * y[1], x[2] * y[0] - x[0] * y[2], x[0] * y[1] - x[1] * y[0]
    if sum(a * b for a, b in zip(cross, z, strict=False)) < 0:
        return 4
    return 7 if max(abs(row[3]) for row in T[:3]) > FARTHEST else 0


def _intrinsics_fault(K: _Matrix, height: int, width: int) -> int:
    """Code 5, 6, 8 or 9, 0 for none."""
    (fx, skew, cx), (other, fy, cy), last = K
    if not all(math.isfinite(value) for row in K for value in row):
        return 5
    if skew or other or last != [0.0, 0.0, 1.0] or fx <= 0 or fy <= 0:
        return 6
    if min(fx, fy) < FOCAL_RANGE[0] or max(fx, fy) > FOCAL_RANGE[1]:
        return 8
    return 9 if min(cx, cy) < -0.5 or cx > width - 0.5 or cy > height - 0.5 else 0

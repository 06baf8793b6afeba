"""The check of a frame's values on the CPU (numba): one call, and one for each further map.

The same comparisons as the reference in :mod:`ufmstar_torch.frames.frame`. Thresholds are rounded to the maps' dtype as
torch rounds them.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ufmstar_torch.frames.frame import DEPTH_RANGE, FARTHEST, FOCAL_RANGE, LARGEST, FrameInput
from ufmstar_torch.gaussians.camera import POLAR_STEPS
from ufmstar_torch.kernels.compile_cpu import empty, kernel, leaf
from ufmstar_torch.kernels.cpu.calls import array

Matrices = NDArray[np.floating[Any]]
_ROUNDING = 4e-16  # deviation of R^T R below which a further step changes nothing
_LEAST_FOCAL, _LARGEST_FOCAL = FOCAL_RANGE
_NO_MASK, _NO_LIMITS = np.empty((0, 0, 0), np.bool_), (0.0, 0.0, 0.0)


def check_values(
    depth: Tensor, pose: Tensor, intrinsics: Tensor, aleatoric: Tensor | None, epistemic: Tensor | None,
    mask: Tensor | None, *, rotation_tolerance: float, max_depth: float
) -> FrameInput:  # fmt: skip
    """As :func:`ufmstar_torch.frames.frame.check_values`, for the CPU. Depth that is valid everywhere is not copied."""
    z, wanted = array(depth), _NO_MASK if mask is None else array(mask)
    allowed, size = wanted, z.shape[1:]
    for values in (aleatoric, epistemic):
        if values is not None:
            allowed = np.ones(z.shape, np.bool_) if allowed is _NO_MASK else allowed.copy()
            _restrict(allowed.reshape(len(z), -1), array(values).reshape(len(z), -1))
    limits = DEPTH_RANGE[0], min(max_depth, DEPTH_RANGE[1]), max_depth
    cameras = _matrices(array(pose), array(intrinsics))
    checked = _check(*cameras, float(size[0]), float(size[1]), rotation_tolerance, z, wanted, allowed, limits)
    T, K, deviation, fault, valid, safe, *counts = map(torch.from_numpy, (*checked[:-1], *checked[-1]))
    beyond, out_of_range, usable = counts
    return FrameInput(
        safe, T, K, aleatoric, epistemic, None, valid, fault, deviation, beyond, out_of_range, usable, fault
    )


def camera_faults(pose: Matrices, K: Matrices, size: tuple[float, ...], tolerance: float) -> list[int]:
    """Codes of the first faults (``frame.FRAME_FAULTS``, 0 for none) of poses [B, 4, 4] [m] and intrinsics [B, 3, 3] of
    images of a size (H, W) [px]; ``tolerance`` is the largest deviation of R^T R from the identity."""
    no_pixels = np.empty((len(pose), 0, 0), np.float32), _NO_MASK, _NO_MASK, _NO_LIMITS
    return _check(*_matrices(pose, K), *map(float, size), tolerance, *no_pixels)[3].tolist()


def _matrices(*cameras: Matrices) -> list[NDArray[np.float64]]:
    """Poses and intrinsics as float64 [n, ...]: one, or one of each stream."""
    return [np.ascontiguousarray(x, np.float64).reshape(-1, *x.shape[-2:]) for x in cameras]


@kernel
def _check(poses, intrinsics, height, width, tolerance, depth, wanted, allowed, limits):
    """Check cameras and pixels.

    Args:
        poses, intrinsics: [B, 4, 4] and [B, 3, 3], or one of all streams.
        height, width: of the images [px].
        tolerance: of the poses.
        depth: [B, H, W]; it may have no pixels.
        wanted: [B, H, W] the caller's mask, of size 0 without one.
        allowed: [B, H, W] the part of it that :func:`_restrict` left; of size 0 = all.
        limits: the least and the largest usable depth, and the largest depth that the network states [m].

    Returns:
        The poses with their nearest rotations and the intrinsics of each stream, identities where there is a fault; the
        deviations max |R^T R - I| of the poses; the codes of the first faults; the usable pixels; the depth, 0 where
        not usable; and counts [3, B] of the wanted pixels with a depth: those beyond the largest, those otherwise not
        usable, and the usable ones.
    """
    b = len(depth)
    T, K = empty((b, 4, 4), np.float64), empty((b, 3, 3), np.float64)
    deviations, faults = empty(b, np.float64), empty(b, np.int64)
    gram, Q = empty((3, 3), np.float64), empty((3, 3), np.float64)
    for i in range(b):
        pose, camera = poses[i % len(poses)], intrinsics[i % len(intrinsics)]
        _check_camera(pose, camera, height, width, tolerance, gram, Q, T[i], K[i], deviations, faults, i)
    use, counts, safe = empty(depth.shape, np.bool_), empty((3, b), np.int64), depth
    real, every = depth.dtype.type, 0
    for i in range(b):
        low = real(limits[0]) if faults[i] == 0 else real(np.inf)
        counts[0, i] = counts[1, i] = counts[2, i] = 0
        for v in range(depth.shape[1]):
            counts[2, i] += _within(depth[i, v], low, real(limits[1]), use[i, v])
            if allowed.size > 0:
                counts[2, i] += _remove(use[i, v], allowed[i, v])
        every += counts[2, i]
    if every < depth.size:
        safe = empty(depth.shape, depth.dtype)
    for i in range(b if every < depth.size else 0):
        deepest = real(limits[2])
        for v in range(depth.shape[1]):
            z, usable, out = depth[i, v], use[i, v], safe[i, v]
            for u in range(z.size):
                has_depth = (z[u] > 0) & (z[u] < np.inf) & (faults[i] == 0) & (wanted.size == 0 or wanted[i, v, u])
                counts[0, i] += has_depth & (z[u] > deepest)
                counts[1, i] += has_depth & (z[u] <= deepest) & (not usable[u])
                out[u] = z[u] if usable[u] else real(0)
    return T, K, deviations, faults, use, safe, counts


@leaf
def _check_camera(T, K, height, width, tolerance, gram, Q, R, camera, deviations, faults, b):
    """Write a camera's part of the results of :func:`_check`; ``gram`` and ``Q`` [3, 3] are scratch."""
    _gram(T, gram)
    deviations[b] = _deviation(gram)
    fault = _pose_fault(T, deviations[b], tolerance)
    faults[b] = fault = fault if fault > 0 else _intrinsics_fault(K, height, width)
    for i in range(4):
        for j in range(4):
            R[i, j] = T[i, j] if fault == 0 and i < 3 else 1.0 if i == j else 0.0
    for i in range(3):
        for j in range(3):
            camera[i, j] = K[i, j] if fault == 0 else 1.0 if i == j else 0.0
    for _ in range(POLAR_STEPS if fault == 0 else 0):  # as ``camera.nearest_rotation``: R <- R (3 I - R^T R)/2
        if _deviation(gram) < _ROUNDING:
            break
        for i in range(3):
            for j in range(3):
                Q[i, j] = (1.5 if i == j else 0.0) - 0.5 * gram[i, j]
        for i in range(3):
            x, y, z = R[i, 0], R[i, 1], R[i, 2]
            for j in range(3):
                R[i, j] = x * Q[0, j] + y * Q[1, j] + z * Q[2, j]
        _gram(R, gram)


@leaf
def _gram(R, gram):
    """Write R^T R of the first three rows and columns."""
    for i in range(3):
        for j in range(3):
            gram[i, j] = R[0, i] * R[0, j] + R[1, i] * R[1, j] + R[2, i] * R[2, j]


@leaf
def _deviation(gram):
    """max |G - I|, NaN where an entry is."""
    most = 0.0
    for i in range(3):
        for j in range(i, 3):
            off = abs(gram[i, j] - (1.0 if i == j else 0.0))
            most = off if off > most or off != off else most
    return most


@leaf
def _finite(matrix):
    """True if all entries are finite."""
    total = 0.0
    for i in range(matrix.shape[0]):
        for j in range(matrix.shape[1]):
            total += 0.0 * matrix[i, j]
    return total == 0.0


@leaf
def _pose_fault(T, deviation, tolerance):
    """Code 1 to 4 or 7 of a pose, 0 for none."""
    if not _finite(T):
        return 1
    for j in range(4):
        if abs(T[3, j] - (1.0 if j == 3 else 0.0)) > tolerance:
            return 2
    if deviation > tolerance:
        return 3
    x, y = T[0, 1] * T[1, 2] - T[0, 2] * T[1, 1], T[0, 2] * T[1, 0] - T[0, 0] * T[1, 2]
    z = T[0, 0] * T[1, 1] - T[0, 1] * T[1, 0]
    if x * T[2, 0] + y * T[2, 1] + z * T[2, 2] < 0:
        return 4
    for i in range(3):
        if abs(T[i, 3]) > FARTHEST:
            return 7
    return 0


@leaf
def _intrinsics_fault(K, height, width):
    """Code 5, 6, 8 or 9 of intrinsics, 0 for none."""
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    if not _finite(K):
        return 5
    if K[0, 1] != 0 or K[1, 0] != 0 or K[2, 0] != 0 or K[2, 1] != 0 or K[2, 2] != 1 or fx <= 0 or fy <= 0:
        return 6
    if fx < _LEAST_FOCAL or fy < _LEAST_FOCAL or fx > _LARGEST_FOCAL or fy > _LARGEST_FOCAL:
        return 8
    return 9 if cx < -0.5 or cy < -0.5 or cx > width - 0.5 or cy > height - 0.5 else 0


@kernel
def _restrict(use, variances):
    """Clear ``use`` [B, P] where a variance [B, P] is negative, above ``LARGEST`` or NaN."""
    high = variances.dtype.type(LARGEST)
    for b in range(variances.shape[0]):
        for i in range(variances.shape[1]):
            use[b, i] &= (variances[b, i] >= 0) & (variances[b, i] <= high)


@leaf
def _within(values, low, high, use):
    """Write where values are in [low, high]; return their number."""
    count = 0
    for i in range(values.size):
        use[i] = (values[i] >= low) & (values[i] <= high)
        count += use[i]
    return count


@leaf
def _remove(use, allowed):
    """Clear ``use`` where not allowed; return the change of their number."""
    change = 0
    for i in range(use.size):
        change -= use[i] & (not allowed[i])
        use[i] &= allowed[i]
    return change

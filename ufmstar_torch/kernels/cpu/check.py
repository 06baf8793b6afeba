"""The check of a frame's values on the CPU (numba): a call for the cameras and a call for the pixels.

The same comparisons as the reference in :mod:`ufmstar_torch.frames.frame`, whose chain of small tensors takes a
millisecond. Thresholds are rounded to the maps' dtype as torch rounds them.
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


def check_values(
    depth: Tensor,
    pose: Tensor,
    intrinsics: Tensor,
    aleatoric: Tensor | None,
    epistemic: Tensor | None,
    mask: Tensor | None,
    *,
    rotation_tolerance: float,
    max_depth: float,
) -> FrameInput:
    """As :func:`ufmstar_torch.frames.frame.check_values`, for the CPU. Depth that is valid everywhere is not copied."""
    z = array(depth)
    b, shape = len(z), (len(z), z[0].size)
    cameras = _checked_cameras(array(pose), array(intrinsics), b, z.shape[1:], rotation_tolerance)
    wanted = np.ones(z.shape, np.bool_) if mask is None else array(mask)
    use, safe, counts = wanted if mask is None else wanted.copy(), np.empty_like(z), np.empty((3, b), np.int64)
    pixels = use.reshape(shape)
    for values in (aleatoric, epistemic):
        if values is not None:
            _restrict(pixels, array(values).reshape(shape))
    limits = DEPTH_RANGE[0], min(max_depth, DEPTH_RANGE[1]), max_depth
    wanted = wanted.reshape(shape)
    usable = _count(z.reshape(shape), pixels, wanted, mask is not None, safe.reshape(shape), cameras[3], limits, counts)
    T, K, deviation, fault, valid = map(torch.from_numpy, (*cameras, use))
    beyond, out_of_range, valid_pixels = torch.from_numpy(counts).unbind()
    return FrameInput(
        torch.from_numpy(z if usable == z.size else safe), T, K, aleatoric, epistemic, None, valid, fault,
        deviation, beyond, out_of_range, valid_pixels, fault,
    )  # fmt: skip


def camera_faults(pose: Matrices, K: Matrices, size: tuple[float, ...], tolerance: float) -> list[int]:
    """Codes of the first faults (``frame.FRAME_FAULTS``, 0 for none) of poses [B, 4, 4] [m] and intrinsics [B, 3, 3] of
    images of a size (H, W) [px]; ``tolerance`` is the largest deviation of R^T R from the identity."""
    return _checked_cameras(pose, K, len(pose), size, tolerance)[3].tolist()


def _checked_cameras(
    pose: Matrices, K: Matrices, streams: int, size: tuple[float, ...], tolerance: float
) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any], NDArray[Any]]:
    """The poses with their nearest rotations and the intrinsics of each stream, identities where there is a fault; the
    deviations max |R^T R - I| of the poses; and the codes of the first faults. One matrix may be of all streams."""
    T, camera = (np.ascontiguousarray(value, np.float64).reshape(-1, *value.shape[-2:]) for value in (pose, K))
    out = np.empty((streams, 4, 4)), np.empty((streams, 3, 3)), np.empty(streams), np.empty(streams, np.int64)
    _check_cameras(T, camera, float(size[0]), float(size[1]), tolerance, *out)
    return out


@kernel
def _check_cameras(poses, intrinsics, height, width, tolerance, out_T, out_K, deviations, faults):
    """Write the results of :func:`_checked_cameras`."""
    gram, Q = empty((3, 3), np.float64), empty((3, 3), np.float64)
    for b in range(faults.size):
        T, K, R, camera = poses[b % len(poses)], intrinsics[b % len(intrinsics)], out_T[b], out_K[b]
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
    for b in range(len(variances)):
        _within(variances[b], variances.dtype.type(0.0), variances.dtype.type(LARGEST), use[b])


@kernel
def _count(depth, use, wanted, masked, safe, faults, limits, counts):
    """Clear ``use`` [B, P] where the depth is out of range or the stream has a fault; return the number of usable
    pixels. If some are not, write ``safe``: the depth, 0 where not usable.

    Args:
        wanted: the caller's mask, if ``masked``.
        limits: the least and the largest usable depth, and the largest depth that the network states [m].
        counts: [3, B] written: of the wanted pixels with a depth those beyond it, those otherwise not usable, and the
            usable ones.
    """
    real, every = depth.dtype.type, 0
    for b in range(faults.size):
        low = real(limits[0]) if faults[b] == 0 else real(np.inf)
        counts[0, b] = counts[1, b] = 0
        counts[2, b] = _within(depth[b], low, real(limits[1]), use[b])
        every += counts[2, b]
    for b in range(faults.size if every < depth.size else 0):
        z, usable, deepest = depth[b], use[b], real(limits[2])
        for i in range(z.size):
            has_depth = (z[i] > 0) & (z[i] < np.inf) & (faults[b] == 0) & (not masked or wanted[b, i])
            counts[0, b] += has_depth & (z[i] > deepest)
            counts[1, b] += has_depth & (z[i] <= deepest) & (not usable[i])
            safe[b, i] = z[i] if usable[i] else real(0)
    return every


@leaf
def _within(values, low, high, use):
    """Clear ``use`` where values are outside [low, high] or NaN; return the number that is left."""
    count = 0
    for i in range(values.size):
        use[i] &= (values[i] >= low) & (values[i] <= high)
        count += use[i]
    return count

"""The check of a frame's values on the CPU (numba): maps in one pass, cameras without small tensors.

The same comparisons as the reference in :mod:`ufmstar_torch.frame`, thresholds rounded to the maps' dtype as torch
rounds them.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from ufmstar_torch.frame import DEPTH_RANGE, FARTHEST, FOCAL_RANGE, LARGEST, POLAR_STEPS, FrameInput, FrameMaps
from ufmstar_torch.kernels.arrays_cpu import array
from ufmstar_torch.kernels.compile_cpu import kernel, part
from ufmstar_torch.kernels.threads_cpu import each


def check_values(
    maps: FrameMaps, pose: Tensor, intrinsics: Tensor, *, rotation_tolerance: float, max_depth: float
) -> FrameInput:
    """As :func:`ufmstar_torch.frame.check_values`, for the CPU. Depth that is valid everywhere is not copied."""
    shape = b, *size = tuple(maps.depth.shape)
    depth = array(maps.depth).reshape(b, -1)
    none = np.empty((b, 0, depth.shape[1]), depth.dtype)
    mask = np.empty((b, 0), np.bool_) if maps.mask is None else array(maps.mask).reshape(b, -1)
    A, E, features = (
        none if value is None else array(value).reshape(b, -1, depth.shape[1])
        for value in (maps.aleatoric, maps.epistemic, maps.features)
    )
    given = (np.asarray(array(camera), np.float64).reshape(-1, *camera.shape[-2:]) for camera in (pose, intrinsics))
    cameras = *given, *size, rotation_tolerance, FARTHEST, FOCAL_RANGE, POLAR_STEPS
    limits = float(max_depth), *DEPTH_RANGE, LARGEST
    T, K, deviation, counts = np.empty((b, 4, 4)), np.empty((b, 3, 3)), np.empty(b), np.empty((4, b), np.int64)
    safe, use = np.empty_like(depth), np.empty(depth.shape, np.bool_)
    values, written = (depth, mask, A, E, features, limits), (T, K, deviation, counts, safe, use)
    each(_stream, [(s, cameras, values, written) for s in range(b)])
    whole = [kept == depth.shape[1] for kept in counts[3].tolist()]
    if all(whole):
        safe = depth
    elif any(whole):
        safe[whole] = depth[whole]
    results = safe.reshape(shape), T, K, use.reshape(shape), deviation, *counts[:3]
    safe_depth, T_safe, K_safe, valid, deviations, fault, beyond, out_of_range = map(torch.from_numpy, results)
    return FrameInput(
        safe_depth, T_safe, K_safe, maps.aleatoric, maps.epistemic, maps.features, valid, fault, deviations, beyond,
        out_of_range, fault,
    )  # fmt: skip


@kernel
def _stream(s, cameras, values, written):
    """Check stream ``s``: its camera to ``T`` and ``K`` with the rotation's ``deviation``, its maps to ``use`` and,
    unless all pixels are valid, ``safe``; to ``counts`` [4, B] the code of the fault, and how many pixels lie beyond
    the largest depth, are out of range and are valid."""
    pose, intrinsics, height, width, tolerance, farthest, focal, steps = cameras
    P, C = pose[s if len(pose) > 1 else 0], intrinsics[s if len(intrinsics) > 1 else 0]
    depth, mask, aleatoric, epistemic, features, limits = values
    T, K, deviation, counts, safe, use = written
    deviation[s] = _deviation(P)
    fault = _camera(P, C, height, width, deviation[s], tolerance, farthest, focal, steps, T[s], K[s])
    beyond, near, kept = _maps(
        depth[s], mask[s], aleatoric[s], epistemic[s], features[s], fault == 0, limits, safe[s], use[s]
    )
    counts[0, s], counts[1, s], counts[2, s], counts[3, s] = fault, beyond, near, kept


@part
def _maps(depth, mask, aleatoric, epistemic, features, fine, limits, safe, use):
    """One stream [N]: which pixels are valid; unless all are, depth where they are and else 0. Returns how many are
    beyond, out of range and valid.

    Few conditions a loop, which the compiler turns into vector instructions.
    """
    real = depth.dtype.type
    farthest, low, high, largest, zero = real(limits[0]), real(limits[1]), real(limits[2]), real(limits[3]), real(0)
    most, kept = min(farthest, high), 0
    for i in range(depth.size):
        use[i] = (depth[i] >= low) & (depth[i] <= most) & fine
    for i in range(mask.size):
        use[i] = use[i] & mask[i]
    for maps, least in ((aleatoric, zero), (epistemic, zero), (features, -largest)):
        for f in range(maps.shape[0]):
            for i in range(depth.size):
                use[i] = use[i] & (maps[f, i] >= least) & (maps[f, i] <= largest)
    for i in range(depth.size):
        kept += use[i]
    if kept == depth.size:
        return 0, 0, kept
    for i in range(depth.size):
        safe[i] = depth[i] if use[i] else zero
    beyond = near = 0
    if fine:
        for i in range(depth.size):
            d = depth[i]
            given = (d > 0) & (d < np.inf)
            if mask.size > 0:
                given = given & mask[i]
            beyond += given & (d > farthest)
            near += given & (d <= farthest)
        near -= kept
    return beyond, near, kept


@part
def _camera(P, C, height, width, deviation, tolerance, farthest, focal, steps, T, K):
    """Write the pose with its nearest rotation and the intrinsics, an identity and a unit camera where there is a
    fault; return the code of the first fault."""
    fault = _pose_fault(P, deviation, tolerance, farthest)
    if fault == 0:
        fault = _intrinsics_fault(C, height, width, focal)
    for i in range(4):
        for j in range(4):
            T[i, j] = P[i, j] if fault == 0 and i < 3 else 1.0 if i == j else 0.0
    for i in range(3):
        for j in range(3):
            K[i, j] = C[i, j] if fault == 0 else 1.0 if i == j else 0.0
    _nearest_rotation(T, steps)
    return fault


@part
def _gram(R, i, j):
    """Entry (i, j) of R^T R."""
    return R[0, i] * R[0, j] + R[1, i] * R[1, j] + R[2, i] * R[2, j]


@part
def _deviation(R):
    """max |R^T R - I|, NaN where an entry is."""
    most = 0.0
    for i in range(3):
        for j in range(3):
            off = abs(_gram(R, i, j) - (1.0 if i == j else 0.0))
            most = off if off > most or off != off else most
            if off != off:
                return off
    return most


@part
def _nearest_rotation(T, steps):
    """R <- R (3 I - R^T R)/2 in place, as ``camera.nearest_rotation``."""
    Q, R = np.empty((3, 3)), np.empty((3, 3))
    for _ in range(steps):
        for i in range(3):
            for j in range(3):
                R[i, j] = T[i, j]
                Q[i, j] = (1.5 if i == j else 0.0) - 0.5 * _gram(T, i, j)
        for i in range(3):
            for j in range(3):
                T[i, j] = R[i, 0] * Q[0, j] + R[i, 1] * Q[1, j] + R[i, 2] * Q[2, j]


@part
def _pose_fault(T, deviation, tolerance, farthest):
    """Code 1 to 4 or 7, 0 for none."""
    off = far = 0.0
    for i in range(4):
        for j in range(4):
            if not math.isfinite(T[i, j]):
                return 1
        off = max(off, abs(T[3, i] - (1.0 if i == 3 else 0.0)))
    if off > tolerance:
        return 2
    if deviation > tolerance:
        return 3
    determinant = (T[0, 1] * T[1, 2] - T[0, 2] * T[1, 1]) * T[2, 0]
    determinant += (T[0, 2] * T[1, 0] - T[0, 0] * T[1, 2]) * T[2, 1]
    determinant += (T[0, 0] * T[1, 1] - T[0, 1] * T[1, 0]) * T[2, 2]
    if determinant < 0:
        return 4
    for i in range(3):
        far = max(far, abs(T[i, 3]))
    return 7 if far > farthest else 0


@part
def _intrinsics_fault(K, height, width, focal):
    """Code 5, 6, 8 or 9, 0 for none."""
    for i in range(3):
        for j in range(3):
            if not math.isfinite(K[i, j]):
                return 5
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    if K[0, 1] != 0 or K[1, 0] != 0 or K[2, 0] != 0 or K[2, 1] != 0 or K[2, 2] != 1 or fx <= 0 or fy <= 0:
        return 6
    if min(fx, fy) < focal[0] or max(fx, fy) > focal[1]:
        return 8
    return 9 if min(cx, cy) < -0.5 or cx > width - 0.5 or cy > height - 0.5 else 0

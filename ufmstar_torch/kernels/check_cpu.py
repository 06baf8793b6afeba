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
from ufmstar_torch.kernels.compile_cpu import kernel, part
from ufmstar_torch.kernels.threads_cpu import each


def check_values(
    maps: FrameMaps, pose: Tensor, intrinsics: Tensor, *, rotation_tolerance: float, max_depth: float
) -> FrameInput:
    """As :func:`ufmstar_torch.frame.check_values`, for maps on the CPU."""
    b, height, width = maps.depth.shape
    T, K = np.empty((b, 4, 4)), np.empty((b, 3, 3))
    fault, deviation = np.empty(b, np.int64), np.empty(b)
    given = (value.cpu().contiguous().numpy() for value in (pose, intrinsics))
    _cameras(*given, height, width, rotation_tolerance, FARTHEST, FOCAL_RANGE, POLAR_STEPS, T, K, fault, deviation)
    depth = maps.depth.contiguous().view(b, -1).numpy()
    none = np.empty((b, 0, depth.shape[1]), depth.dtype)
    mask = np.empty((b, 0), np.bool_) if maps.mask is None else maps.mask.contiguous().view(b, -1).numpy()
    A, E, features = (
        none if value is None else value.detach().contiguous().view(b, -1, depth.shape[1]).numpy()
        for value in (maps.aleatoric, maps.epistemic, maps.features)
    )
    safe, use, counts = np.empty_like(depth), np.empty(depth.shape, np.bool_), np.empty((2, b), np.int64)
    limits = np.array([max_depth, *DEPTH_RANGE, LARGEST], depth.dtype)

    def stream(s: int) -> None:
        counts[:, s] = _maps(depth[s], mask[s], A[s], E[s], features[s], fault[s] == 0, limits, safe[s], use[s])

    each(stream, [(s,) for s in range(b)])
    shape = maps.depth.shape
    maps_out = (safe.reshape(shape), T, K, use.reshape(shape))
    tensors = map(torch.from_numpy, (*maps_out, fault, deviation, counts[0], counts[1]))
    safe_depth, T_safe, K_safe, valid, codes, deviations, beyond, out_of_range = tensors
    return FrameInput(
        safe_depth, T_safe, K_safe, maps.aleatoric, maps.epistemic, maps.features, valid, codes, deviations, beyond,
        out_of_range, codes,
    )  # fmt: skip


@kernel
def _maps(depth, mask, aleatoric, epistemic, features, fine, limits, safe, use):
    """One stream [N]: depth where valid and else 0, which pixels are valid, and how many are beyond or out of range.

    Few conditions a loop, which the compiler turns into vector instructions.
    """
    farthest, low, high, largest = limits
    most, zero = min(farthest, high), depth.dtype.type(0)
    for i in range(depth.size):
        use[i] = (depth[i] >= low) & (depth[i] <= most) & fine
    for i in range(mask.size):
        use[i] = use[i] & mask[i]
    for maps, least in ((aleatoric, zero), (epistemic, zero), (features, -largest)):
        for f in range(maps.shape[0]):
            for i in range(depth.size):
                use[i] = use[i] & (maps[f, i] >= least) & (maps[f, i] <= largest)
    kept = 0
    for i in range(depth.size):
        safe[i] = depth[i] if use[i] else zero
        kept += use[i]
    beyond = near = 0
    if fine and kept < depth.size:
        for i in range(depth.size):
            d = depth[i]
            given = (d > 0) & (d < np.inf)
            if mask.size > 0:
                given = given & mask[i]
            beyond += given & (d > farthest)
            near += given & (d <= farthest)
        near -= kept
    return beyond, near


@kernel
def _cameras(pose, intrinsics, height, width, tolerance, farthest, focal, steps, T, K, fault, deviation):
    """Of every stream: the pose with its nearest rotation, the intrinsics, the code of the first fault, and how far the
    rotation given is from one. An identity and a unit camera where there is a fault."""
    for b in range(fault.size):
        P, C = pose[b], intrinsics[b]
        deviation[b] = _deviation(P)
        fault[b] = _pose_fault(P, deviation[b], tolerance, farthest)
        if fault[b] == 0:
            fault[b] = _intrinsics_fault(C, height, width, focal)
        for i in range(4):
            for j in range(4):
                T[b, i, j] = 1.0 if i == j else 0.0
        for i in range(3):
            for j in range(3):
                K[b, i, j] = C[i, j] if fault[b] == 0 else 1.0 if i == j else 0.0
        if fault[b] == 0:
            for i in range(3):
                for j in range(4):
                    T[b, i, j] = P[i, j]
        _nearest_rotation(T[b], steps)


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

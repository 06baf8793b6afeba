"""Check of a frame's values on a GPU in two launches: a program per stream for the camera, one per 1,024 pixels."""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from ufmstar_torch.frames.frame import (
    DEPTH_RANGE,
    FARTHEST,
    FOCAL_RANGE,
    LARGEST,
    FrameInput,
    intrinsics_fault,
    of_streams,
    pose_fault,
)
from ufmstar_torch.gaussians.camera import POLAR_STEPS, rotation_deviation
from ufmstar_torch.kernels.triton.launch import launch
from ufmstar_torch.kernels.triton.matrices import exact


def check_values(
    depth: Tensor, pose: Tensor, intrinsics: Tensor, aleatoric: Tensor | None, epistemic: Tensor | None,
    mask: Tensor | None, *, rotation_tolerance: float, max_depth: float,
) -> FrameInput:  # fmt: skip
    """As :func:`ufmstar_torch.frames.frame.check_values`."""
    depth = depth.contiguous()
    b, height, width = depth.shape
    device = depth.device
    pose, intrinsics = (of_streams(camera, b) for camera in (pose, intrinsics))
    host_fault = None
    if pose.device.type == intrinsics.device.type == "cpu" != device.type:
        pose_faults = pose_fault(pose, rotation_deviation(pose[..., :3, :3]), rotation_tolerance)
        host_fault = torch.where(pose_faults > 0, pose_faults, intrinsics_fault(intrinsics, (height, width)))
    T, K = (v.to(device, non_blocking=True).contiguous() for v in (pose, intrinsics))
    T_safe, K_safe, deviation = torch.empty_like(T), torch.empty_like(K), T.new_empty(b)
    counts = torch.zeros(3, b, dtype=torch.int64, device=device)
    fault = torch.empty(b, dtype=torch.int64, device=device)
    launch(
        _camera, (b,), T, K, T_safe, K_safe, deviation, fault, height, width, tolerance=float(rotation_tolerance),
        farthest=FARTHEST, shortest=FOCAL_RANGE[0], longest=FOCAL_RANGE[1], steps=POLAR_STEPS, warps=1,
    )  # fmt: skip
    safe, valid = torch.empty_like(depth), torch.empty_like(depth, dtype=torch.bool)
    optional = (mask, aleatoric, epistemic)
    launch(
        _maps, (triton.cdiv(height * width, 1024), b), depth,
        *(depth if v is None else v.detach().contiguous() for v in optional), fault, safe, valid, counts,
        height * width, b, masked=mask is not None, has_aleatoric=aleatoric is not None,
        has_epistemic=epistemic is not None, nearest=DEPTH_RANGE[0], deepest=DEPTH_RANGE[1],
        max_depth=float(max_depth), largest=LARGEST, chunk=1024,
    )  # fmt: skip
    return FrameInput(
        safe, T_safe, K_safe, aleatoric, epistemic, None, valid, fault, deviation, counts[0], counts[1], counts[2],
        host_fault,
    )  # fmt: skip


@triton.jit
def _gram(a, b, c, d, e, f, g, h, i):
    """The upper triangle of R^T R."""
    return (
        a * a + d * d + g * g, a * b + d * e + g * h, a * c + d * f + g * i,
        b * b + e * e + h * h, b * c + e * f + h * i, c * c + f * f + i * i,
    )  # fmt: skip


@triton.jit
def _any(flags):
    """True if any flag of a block is set."""
    return tl.sum(flags.to(tl.int32), 0) > 0


@triton.jit
def _camera(
    T, K, T_safe, K_safe, deviation, faults, height, width,
    tolerance: tl.constexpr, farthest: tl.constexpr, shortest: tl.constexpr, longest: tl.constexpr,
    steps: tl.constexpr,
):  # fmt: skip
    stream = tl.program_id(0).to(tl.int64)
    T, K = T + 16 * stream, K + 9 * stream
    entry = tl.arange(0, 16)
    t = tl.load(T + entry)
    k = tl.load(K + entry, mask=entry < 9, other=0.0)
    a, b, c = tl.load(T), tl.load(T + 1), tl.load(T + 2)
    d, e, f = tl.load(T + 4), tl.load(T + 5), tl.load(T + 6)
    g, h, i = tl.load(T + 8), tl.load(T + 9), tl.load(T + 10)
    g0, g1, g2, g3, g4, g5 = _gram(a, b, c, d, e, f, g, h, i)
    diagonal = tl.maximum(tl.abs(g0 - 1), tl.maximum(tl.abs(g3 - 1), tl.abs(g5 - 1)))
    off_diagonal = tl.maximum(tl.abs(g1), tl.maximum(tl.abs(g2), tl.abs(g4)))
    total = g0 + g1 + g2 + g3 + g4 + g5
    error = tl.where(total != total, float("nan"), tl.maximum(diagonal, off_diagonal))
    tl.store(deviation + stream, error)

    focal_x, focal_y, cx, cy = tl.load(K), tl.load(K + 4), tl.load(K + 2), tl.load(K + 5)
    determinant = (b * f - c * e) * g + (c * d - a * f) * h + (a * e - b * d) * i
    last = tl.abs(t - tl.where(entry == 15, 1.0, 0.0))
    shift = (entry == 3) | (entry == 7) | (entry == 11)
    zeros = (entry == 1) | (entry == 3) | (entry == 6) | (entry == 7)
    least, most = tl.minimum(focal_x, focal_y), tl.maximum(focal_x, focal_y)
    fault = 0
    # In reverse order of the checks, so that the first failed check determines the fault.
    fault = tl.where((tl.minimum(cx, cy) < -0.5) | (cx > width - 0.5) | (cy > height - 0.5), 9, fault)
    fault = tl.where((least < exact(shortest, least)) | (most > exact(longest, most)), 8, fault)
    fault = tl.where(_any(zeros & (k != 0)) | (tl.load(K + 8) != 1) | (focal_x <= 0) | (focal_y <= 0), 6, fault)
    fault = tl.where(_any(k - k != 0), 5, fault)
    fault = tl.where(_any(shift & (tl.abs(t) > exact(farthest, t))), 7, fault)
    fault = tl.where(determinant < 0, 4, fault)
    fault = tl.where(error > exact(tolerance, error), 3, fault)
    fault = tl.where(_any((entry >= 12) & (last > exact(tolerance, last))), 2, fault)
    fault = tl.where(_any(t - t != 0), 1, fault)
    tl.store(faults + stream, fault)

    fine = fault == 0
    a, b, c = tl.where(fine, a, 1.0), tl.where(fine, b, 0.0), tl.where(fine, c, 0.0)
    d, e, f = tl.where(fine, d, 0.0), tl.where(fine, e, 1.0), tl.where(fine, f, 0.0)
    g, h, i = tl.where(fine, g, 0.0), tl.where(fine, h, 0.0), tl.where(fine, i, 1.0)
    for _ in range(steps):  # Newton-Schulz (``camera.nearest_rotation``)
        g0, g1, g2, g3, g4, g5 = _gram(a, b, c, d, e, f, g, h, i)
        s0, s1, s2, s3, s4, s5 = 1.5 - 0.5 * g0, -0.5 * g1, -0.5 * g2, 1.5 - 0.5 * g3, -0.5 * g4, 1.5 - 0.5 * g5
        a, b, c = a * s0 + b * s1 + c * s2, a * s1 + b * s3 + c * s4, a * s2 + b * s4 + c * s5
        d, e, f = d * s0 + e * s1 + f * s2, d * s1 + e * s3 + f * s4, d * s2 + e * s4 + f * s5
        g, h, i = g * s0 + h * s1 + i * s2, g * s1 + h * s3 + i * s4, g * s2 + h * s4 + i * s5
    out = T_safe + 16 * stream
    tl.store(out + entry, tl.where(fine & shift, t, tl.where(entry == 15, 1.0, 0.0)), mask=shift | (entry >= 12))
    tl.store(out, a)
    tl.store(out + 1, b)
    tl.store(out + 2, c)
    tl.store(out + 4, d)
    tl.store(out + 5, e)
    tl.store(out + 6, f)
    tl.store(out + 8, g)
    tl.store(out + 9, h)
    tl.store(out + 10, i)
    unit = (entry == 0) | (entry == 4) | (entry == 8)
    tl.store(K_safe + 9 * stream + entry, tl.where(fine, k, tl.where(unit, 1.0, 0.0)), mask=entry < 9)


@triton.jit
def _maps(
    depth, mask, aleatoric, epistemic, faults, safe, valid, counts, pixels, streams,
    masked: tl.constexpr, has_aleatoric: tl.constexpr, has_epistemic: tl.constexpr,
    nearest: tl.constexpr, deepest: tl.constexpr, max_depth: tl.constexpr, largest: tl.constexpr, chunk: tl.constexpr,
):  # fmt: skip
    b = tl.program_id(1).to(tl.int64)
    i = tl.program_id(0) * chunk + tl.arange(0, chunk)
    inside = i < pixels
    pixel = b * pixels + i
    z = tl.load(depth + pixel, mask=inside, other=0.0)
    has_depth = inside & (z > 0) & (z < float("inf")) & (tl.load(faults + b) == 0)
    if masked:
        has_depth = has_depth & (tl.load(mask + pixel, mask=inside, other=0) != 0)
    beyond = has_depth & (z > exact(max_depth, z))
    near = has_depth & ~beyond
    use = near & (z >= exact(nearest, z)) & (z <= exact(deepest, z))
    if has_aleatoric:
        variance = tl.load(aleatoric + pixel, mask=inside, other=0.0)
        use = use & (variance >= 0) & (variance <= exact(largest, variance))
    if has_epistemic:
        variance = tl.load(epistemic + pixel, mask=inside, other=0.0)
        use = use & (variance >= 0) & (variance <= exact(largest, variance))
    tl.store(safe + pixel, tl.where(use, z, 0.0), mask=inside)
    tl.store(valid + pixel, use, mask=inside)
    tl.atomic_add(counts + b, tl.sum(beyond.to(tl.int32), 0))
    tl.atomic_add(counts + streams + b, tl.sum((near & ~use).to(tl.int32), 0))
    tl.atomic_add(counts + 2 * streams + b, tl.sum(use.to(tl.int32), 0))

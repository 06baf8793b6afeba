"""First half of SPGF on a GPU: the rows of all streams in parallel, a lane each, columns in order.

Each lane holds the open segments of its row in registers. The order of operations is that of the torch reference, and
no product and sum are contracted, so that every decision agrees to the last bit.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
import triton
import triton.language as tl
from torch import Tensor

from ufmstar_torch.config import SPGFConfig
from ufmstar_torch.kernels.triton.launch import interpreted, launch, power_of_two
from ufmstar_torch.kernels.triton.matrices import exact

MOMENTS, INTEGERS = 8, 3  # of a finished segment: mean x, z; scatter xx, xz, zz; line x, z; length^2 | N, interval


@dataclass(frozen=True)
class Rows:
    """Finished segments of B H rows of W pixels, at most M in a row.

    Attributes:
        camera: [B, 3, 3] float64 [px].
        moments: [B H, M, 8] float64.
        whole: [B H, M, 3] int32.
        count: [B H] int32.
        owner: [B H, W] int32 (int16 if W fits), index of the start in the row to whose segment a pixel belongs, -1 =
            none.
        finished_index: [B H, W] of the same dtype, index of the finished segment of every start, -1 = too sparse.
    """

    camera: Tensor
    moments: Tensor
    integers: Tensor
    count: Tensor
    owner: Tensor
    finished_index: Tensor


def scanlines(depth: Tensor, intrinsics: Tensor, limits: SPGFConfig) -> Rows:
    """Cut every row into segments (``segment_scanline.scanlines``), in two launches."""
    b, height, width = depth.shape
    device, most, rows = depth.device, limits.segments_per_row(width), b * height

    def integers(*shape: int, dtype: torch.dtype = torch.int32) -> Tensor:
        return torch.empty(*shape, dtype=dtype, device=device)

    camera, depth = intrinsics.to(torch.float64).contiguous(), depth.contiguous()
    lengths2 = torch.empty(b, limits.depth_bins, dtype=torch.float64, device=device)
    bins = torch.empty(b, height, width, dtype=torch.int16, device=device)
    launch(
        _bins, (triton.cdiv(height * width, 1024), b), depth, camera, lengths2, bins, height, width,
        number=limits.depth_bins, shortest=float(limits.min_gaussian_length),
        longest=float(limits.frame_max_scale * limits.min_gaussian_length), chunk=1024,
    )  # fmt: skip
    narrow = torch.int16 if width < 2**15 else torch.int32
    moments = torch.empty(rows, most, MOMENTS, dtype=torch.float64, device=device)
    result = Rows(
        camera, moments, integers(rows, most, INTEGERS), integers(rows),
        integers(rows, width, dtype=narrow), integers(rows, width, dtype=narrow),
    )  # fmt: skip
    lanes = min(power_of_two(rows), 256) if interpreted() else 32  # the interpreter's time does not depend on it
    launch(
        _scanline, (triton.cdiv(rows, lanes),), depth, camera, lengths2, bins,
        result.moments, result.integers, result.count, result.owner, result.finished_index, rows, height, width,
        most,
        scale=float(limits.adaptive_thresh_scale), reference=float(limits.reference_focal),
        scaled=limits.fixed_slope, noise_floor=float(limits.noise_floor), noise_thresh=float(limits.noise_thresh),
        line_thresh=float(limits.line_thresh), max_depth=float(limits.depth_limit), gap=limits.occlusion_gap,
        n_check=limits.n_check, sparse=limits.sparse, max_open=limits.max_open, registers=power_of_two(limits.max_open),
        number=limits.depth_bins, lanes=lanes, warps=1,
    )  # fmt: skip
    return result


@triton.jit
def slope_of(focal, scale: tl.constexpr, reference: tl.constexpr, scaled: tl.constexpr):
    """a/f [1/m] (``SPGFConfig.slope``)."""
    return scale * (focal / reference) / focal if scaled else scale / focal


@triton.jit
def _bins(
    depth, camera, lengths2, bins, height, width,
    number: tl.constexpr, shortest: tl.constexpr, longest: tl.constexpr, chunk: tl.constexpr,
):  # fmt: skip
    """Compute the depth bin of every pixel, and the table of the bins' squared lengths."""
    b = tl.program_id(1).to(tl.int64)
    i = tl.program_id(0) * chunk + tl.arange(0, chunk)
    inside = i < height * width
    z = tl.load(depth + b * height * width + i, mask=inside, other=0.0).to(tl.float64)
    fx, fy = tl.load(camera + 9 * b), tl.load(camera + 9 * b + 4)
    s = 0.5 * tl.minimum(width / fx, height / fy)
    length = s * 0.0 + shortest
    edge = s * 0.0
    k = tl.zeros([chunk], tl.int32)
    for j in range(number):
        edge += length
        if tl.program_id(0) == 0:
            tl.store(lengths2 + b * number + j, length * length)
        k += (edge < z).to(tl.int32)
        length = tl.minimum(tl.maximum(s * edge, exact(shortest, s)), exact(longest, s))
    tl.store(bins + b * height * width + i, tl.minimum(k, number - 1).to(tl.int16), mask=inside)


@triton.jit
def _finish(
    done, n, u_left, u_right, reach, born, x_left, z_left, dx, dz, dxx, dxz, dzz, moments, integers, finished_index,
    count, r, most, width, sparse: tl.constexpr,
):  # fmt: skip
    """Write the segments of the mask ``done`` [R, Q], at most one per row; return the rows' new numbers of segments."""
    keep = done & (n > sparse)
    pixels = tl.maximum(n, 1).to(tl.float64)
    segment = r[:, None] * most + count[:, None] + n * 0
    out = moments + 8 * segment
    tl.store(out, x_left + dx / pixels, mask=keep)
    tl.store(out + 1, z_left + dz / pixels, mask=keep)
    tl.store(out + 2, dxx - dx * dx / pixels, mask=keep)
    tl.store(out + 3, dxz - dx * dz / pixels, mask=keep)
    tl.store(out + 4, dzz - dz * dz / pixels, mask=keep)
    tl.store(out + 5, dx, mask=keep)
    tl.store(out + 6, dz, mask=keep)
    tl.store(out + 7, reach, mask=keep)
    out = integers + 3 * segment
    tl.store(out, n, mask=keep)
    tl.store(out + 1, u_left, mask=keep)
    tl.store(out + 2, u_right, mask=keep)
    tl.store(finished_index + r[:, None] * width + born, tl.where(keep, count[:, None], -1), mask=done)
    return count + tl.sum(keep.to(tl.int32), 1)


@triton.jit
def _near_line(
    x, z, x_left, z_left, x_right, z_right, dx, dz, n, slope,
    noise_floor: tl.constexpr, noise_thresh: tl.constexpr, line_thresh: tl.constexpr, n_check: tl.constexpr,
):  # fmt: skip
    """[R, Q] whether a row's pixel x, z [R, 1] continues its segments: near the last point of short ones, near the line
    of longer ones."""
    t = slope[:, None] * z * z
    tau_z = tl.minimum(tl.maximum(6.0 * t, exact(noise_floor, t)), exact(noise_thresh, t))
    tau_x = tl.minimum(tl.maximum(t, exact(noise_floor, t)), exact(line_thresh, t))
    close = (tl.abs(z - z_right) < tau_z) & (tl.abs(x - x_right) < tau_x)
    flat = dx == 0
    line = z_left + dz * (x - x_left) / tl.where(flat, 1.0, dx)
    straight = (tl.abs(line - z) < tau_z) & ~flat
    return (close & (n <= n_check)) | (straight & (n > n_check))


@triton.jit
def _scanline(
    depth, camera, lengths2, bins, moments, integers, counts, owner, finished_index, rows, height, width, most,
    scale: tl.constexpr, reference: tl.constexpr, scaled: tl.constexpr, noise_floor: tl.constexpr,
    noise_thresh: tl.constexpr, line_thresh: tl.constexpr, max_depth: tl.constexpr, gap: tl.constexpr,
    n_check: tl.constexpr, sparse: tl.constexpr, max_open: tl.constexpr, registers: tl.constexpr,
    number: tl.constexpr, lanes: tl.constexpr,
):  # fmt: skip
    r = (tl.program_id(0) * lanes + tl.arange(0, lanes)).to(tl.int64)
    real_row = r < rows
    b, v = r // height, r % height
    fx = tl.load(camera + 9 * b, mask=real_row, other=1.0)
    fy = tl.load(camera + 9 * b + 4, mask=real_row, other=1.0)
    cx = tl.load(camera + 9 * b + 2, mask=real_row, other=0.0)
    cy = tl.load(camera + 9 * b + 5, mask=real_row, other=0.0)
    ry = (v.to(tl.float64) - cy) / fy
    y_factor = (1.0 + ry * ry)[:, None]
    focal = tl.minimum(fx, fy)
    slope = slope_of(focal, scale, reference, scaled)

    q = tl.arange(0, registers)[None, :]
    empty = tl.zeros([lanes, registers], tl.float64)
    x_left, z_left, x_right, z_right, w2 = empty, empty, empty, empty, empty
    dx, dz, dxx, dxz, dzz, reach = empty, empty, empty, empty, empty, empty
    n = tl.zeros([lanes, registers], tl.int32)
    u_left, u_right, born = n, n, n
    started, count = tl.zeros([lanes], tl.int32), tl.zeros([lanes], tl.int32)
    for u in range(width):
        pixel = r * width + u
        z = tl.load(depth + pixel, mask=real_row, other=0.0).to(tl.float64)
        use = (z > 0) & (z <= exact(max_depth, z))
        z = tl.where(use, z, 0.0)
        x = (u - cx) / fx * z
        k = tl.load(bins + pixel, mask=use, other=0).to(tl.int32)
        length2 = tl.load(lengths2 + b * number + k, mask=use, other=0.0)[:, None]
        x, z = x[:, None], z[:, None]
        fits = (n > 0) & (u - u_right <= gap) & (w2 < length2) & use[:, None]
        fits = fits & _near_line(
            x, z, x_left, z_left, x_right, z_right, dx, dz, n, slope, noise_floor, noise_thresh, line_thresh, n_check
        )
        newest = tl.max(tl.where(fits, born, -1), 1)
        start = use & (newest < 0)
        # A new segment takes a free register, or that of the oldest one, which is finished.
        age = tl.where(q < max_open, tl.where(n > 0, born, -1 - q), 2147483647)
        opened = start[:, None] & (age == tl.min(age, 1)[:, None])
        pushed = opened & (n > 0)
        if tl.max(tl.max(pushed.to(tl.int32), 1), 0) > 0:
            count = _finish(
                pushed, n, u_left, u_right, reach, born, x_left, z_left, dx, dz, dxx, dxz, dzz, moments, integers,
                finished_index, count, r, most, width, sparse,
            )  # fmt: skip
        target = opened | (fits & (born == newest[:, None]))
        n, u_left, reach = tl.where(opened, 0, n), tl.where(opened, u, u_left), tl.where(opened, length2, reach)
        born = tl.where(opened, started[:, None], born)
        x_left, z_left = tl.where(opened, x, x_left), tl.where(opened, z, z_left)
        dx, dz = tl.where(opened, 0.0, dx), tl.where(opened, 0.0, dz)
        dxx, dxz, dzz = tl.where(opened, 0.0, dxx), tl.where(opened, 0.0, dxz), tl.where(opened, 0.0, dzz)
        started += start.to(tl.int32)

        ex, ez = x - x_left, z - z_left
        xx, xz, zz = dxx + ex * ex, dxz + ex * ez, dzz + ez * ez
        n, u_right = tl.where(target, n + 1, n), tl.where(target, u, u_right)
        reach = tl.where(target, tl.minimum(reach, length2), reach)
        x_right, z_right = tl.where(target, x, x_right), tl.where(target, z, z_right)
        w2 = tl.where(target, ex * ex + y_factor * (ez * ez), w2)
        dx, dz = tl.where(target, dx + ex, dx), tl.where(target, dz + ez, dz)
        dxx, dxz, dzz = tl.where(target, xx, dxx), tl.where(target, xz, dxz), tl.where(target, zz, dzz)
        start_index = tl.sum(tl.where(target, born, 0), 1)
        tl.store(owner + pixel, tl.where(use, start_index, -1), mask=real_row)
    for _ in range(max_open):
        newest = tl.max(tl.where(n > 0, born, -1), 1)
        last = (n > 0) & (born == newest[:, None])
        count = _finish(
            last, n, u_left, u_right, reach, born, x_left, z_left, dx, dz, dxx, dxz, dzz, moments, integers,
            finished_index, count, r, most, width, sparse,
        )  # fmt: skip
        n = tl.where(last, 0, n)
    tl.store(counts + r, count, mask=real_row)

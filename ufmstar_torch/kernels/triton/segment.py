"""SPGF on a GPU: rows (``scanline``), then a program per stream joins the segments of successive rows.

Each lane of a block holds an active Gaussian. There are as many lanes as segments in two rows: for the Gaussians of the
row before and for new ones. A segment is tested against all lanes at once. A Gaussian that ends is either pruned or
written to its slot of the mixture at once.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import torch
import triton
import triton.language as tl
from torch import Tensor

from ufmstar_torch.config import SPGFConfig
from ufmstar_torch.gaussians.gaussian import PIXEL_VARIANCE
from ufmstar_torch.gaussians.mixture import GaussianMixture
from ufmstar_torch.kernels.triton.launch import launch, power_of_two
from ufmstar_torch.kernels.triton.matrices import exact, floored, load_symmetric, store_symmetric
from ufmstar_torch.kernels.triton.scanline import Rows, scanlines, slope_of
from ufmstar_torch.steps.segment import max_gaussians

_PRUNE = {"none": 0, "both": 1, "either": 2}
_CHUNK = 32  # Gaussians of a program of ``_lift``
_FEW = 32  # lanes of a warp
# Below so many columns, ratios of whole numbers of columns differ by more than float32 rounds: 1/n - 1/(n + 1) > 2^-24.
_SINGLE = 4096


@dataclass(frozen=True)
class Floor:
    """Lower limit of the eigenvalues of segmented covariances, as in ``step._segment``.

    Attributes:
        near_plane: [m].
        epsilon: share of the trace, 8 eps of the dtype in which the mixture is stored.
    """

    near_plane: float
    epsilon: float


def segment(
    depth: Tensor, intrinsics: Tensor, limits: SPGFConfig, features: Tensor | None = None
) -> tuple[GaussianMixture, Tensor]:
    """As :func:`ufmstar_torch.steps.segment.segment`, computed in float64, with the capacity for accelerators."""
    mixture, read_labels = fit(depth, intrinsics, limits, features)
    return mixture, read_labels()


def fit(
    depth: Tensor, intrinsics: Tensor, limits: SPGFConfig, features: Tensor | None = None,
    *, floor: Floor | None = None,
) -> tuple[GaussianMixture, Callable[[], Tensor]]:  # fmt: skip
    """Fit Gaussians to B depth maps.

    Args:
        depth, intrinsics, limits, features: as :func:`ufmstar_torch.steps.segment.segment`.
        floor: of the covariances; the mixture is float64. None = no floor; the mixture has the depth's dtype.

    Returns:
        The mixture [B, C], and a function that writes and returns the labels [B, H, W] int64.
    """
    b, height, width = depth.shape
    device = depth.device
    most = limits.segments_per_row(width)
    total = most * height
    capacity = min(total, max_gaussians(limits, height, width))
    channels = 0 if features is None else features.shape[1]
    rows = scanlines(depth, intrinsics, limits)
    dtype = depth.dtype if floor is None else torch.float64
    mixture = GaussianMixture.empty(b, capacity, features=channels, dtype=dtype, device=device)
    member = torch.empty(b * height, most, dtype=torch.int32, device=device)
    slot_of = torch.empty(b, total, dtype=torch.int32, device=device)
    lanes = power_of_two(2 * most)
    # A stream runs in the first launch that has enough lanes for its rows: one warp, which needs no barriers, in most.
    for least, enough in ((0, lanes),) if lanes <= _FEW else ((0, _FEW), (_FEW, lanes)):
        launch(
            _join, (b,),
            rows.camera, rows.moments, rows.integers, rows.count,
            mixture.mean, mixture.covariance, mixture.weight, member, slot_of, height, most, capacity, total,
            rounded=floor is not None and depth.dtype == torch.float32,
            scale=float(limits.adaptive_thresh_scale), reference=float(limits.reference_focal),
            scaled=limits.fixed_slope, noise_floor=float(limits.noise_floor), angle2=float(limits.angle_cosine) ** 2,
            min_pixels=limits.min_pixels, min_rows=limits.min_rows, prune=_PRUNE[limits.prune],
            single=width < _SINGLE, least=least, lanes=enough, warps=max(1, min(8, enough // 32)),
        )  # fmt: skip
    if floor is not None:
        launch(
            _lift, (triton.cdiv(capacity, _CHUNK), b), rows.camera, mixture.mean, mixture.covariance, mixture.weight,
            capacity, near_plane=floor.near_plane, epsilon=floor.epsilon, pixel_variance=PIXEL_VARIANCE, chunk=_CHUNK,
            warps=1,
        )  # fmt: skip
    read_labels = partial(_labelled, rows, member, slot_of, depth.shape)
    if features is not None:
        _average(features, read_labels(), mixture)
    return mixture, read_labels


def _labelled(rows: Rows, member: Tensor, slot_of: Tensor, shape: torch.Size) -> Tensor:
    """[B, H, W] int64 slot of every pixel, -1 = none."""
    b, height, width = shape
    out = torch.empty(b, height, width, dtype=torch.int64, device=member.device)
    launch(
        _label, (triton.cdiv(height * width, 1024), b), rows.owner, rows.finished_index, member, slot_of, out, height,
        width, member.shape[1], slot_of.shape[1], chunk=1024,
    )  # fmt: skip
    return out


def _average(features: Tensor, slots: Tensor, mixture: GaussianMixture) -> None:
    """Write the means of the features [B, F, H, W] over the pixels of every Gaussian into a mixture of zeros."""
    b, channels, height, width = features.shape
    launch(
        _feature_means, (mixture.capacity, b), features.contiguous(), slots, mixture.weight, mixture.features,
        height * width, mixture.capacity, channels, chunk=1024,
    )  # fmt: skip


@triton.jit
def _label(owner, finished_index, member, slot_of, out, height, width, most, total, chunk: tl.constexpr):
    b = tl.program_id(1).to(tl.int64)
    i = tl.program_id(0) * chunk + tl.arange(0, chunk)
    inside = i < height * width
    row = b * height + i // width
    start = tl.load(owner + b * height * width + i, mask=inside, other=-1)
    piece = tl.load(finished_index + row * width + start, mask=inside & (start >= 0), other=-1)
    gaussian = tl.load(member + row * most + piece, mask=piece >= 0, other=0)
    slot = tl.load(slot_of + b * total + gaussian, mask=piece >= 0, other=-1)
    tl.store(out + b * height * width + i, slot, mask=inside)


@triton.jit
def _feature_means(features, slots, weight, out, pixels, capacity, channels, chunk: tl.constexpr):
    """A program per Gaussian reads all labels of its image, so that the order of summation is fixed."""
    b = tl.program_id(1).to(tl.int64)
    k = tl.program_id(0)
    n = tl.load(weight + b * capacity + k).to(tl.float64)
    if n > 0:
        for channel in range(channels):
            sums = tl.zeros([chunk], tl.float64)
            for first in range(0, pixels, chunk):
                i = first + tl.arange(0, chunk)
                labelled = tl.load(slots + b * pixels + i, mask=i < pixels, other=-1) == k
                value = tl.load(features + (b * channels + channel) * pixels + i, mask=labelled, other=0.0)
                sums += value.to(tl.float64)
            tl.store(out + (b * capacity + k) * channels + channel, tl.sum(sums, 0) / n)


@triton.jit
def _stored(x, single: tl.constexpr):
    """x, rounded to float32 if ``single``."""
    return x.to(tl.float32).to(tl.float64) if single else x


@triton.jit
def _ratio(a, b, single: tl.constexpr):
    """A number that orders the fractions a/b (0 <= a <= b) as they are, with equal numbers for equal fractions."""
    if single:  # the bits of a float that is not negative have its order, and integers are compared faster
        ratio = tl.div_rn(a.to(tl.float32), b.to(tl.float32)).to(tl.int32, bitcast=True)
    else:
        ratio = a.to(tl.float64) / b.to(tl.float64)
    return ratio


@triton.jit
def _loaded(moments, integers, segment):
    """Load a segment: its moments, squared length, number of pixels and interval (``scanline.Rows``)."""
    m, w = moments + 8 * segment, integers + 3 * segment
    return (
        tl.load(m), tl.load(m + 1), tl.load(m + 2), tl.load(m + 3), tl.load(m + 4), tl.load(m + 5), tl.load(m + 6),
        tl.load(m + 7), tl.load(w), tl.load(w + 1), tl.load(w + 2),
    )  # fmt: skip


@triton.jit
def _most_active(counts, height, lanes: tl.constexpr):
    """Most segments in two successive rows; at least 1. No more Gaussians are active at a time."""
    most = 1
    for first in range(0, height, lanes):
        v = first + tl.arange(0, lanes)
        present = tl.load(counts + v, mask=v < height, other=0)
        above = tl.load(counts + v - 1, mask=(v > 0) & (v < height), other=0)
        most = tl.maximum(most, tl.max(present + above, 0))
    return most


@triton.jit
def _most_overlapping(u_left, u_right, h_left, h_right, open, single: tl.constexpr):
    """The lanes of ``open`` Gaussians whose interval shares the largest part with a segment's."""
    shared = tl.minimum(u_right, h_right) - tl.maximum(u_left, h_left)
    span = tl.maximum(u_right, h_right) - tl.minimum(u_left, h_left)
    over = open & (shared > 0)
    rho = _ratio(tl.where(over, shared, 0), tl.where(over, span, 1), single)
    return over & (rho == tl.max(rho, 0))


@triton.jit
def _coplanar(mean, line, offset, merged, segment, along, slope, noise_floor: tl.constexpr, angle2: tl.constexpr):
    """[lanes] True where a segment with the line ``along`` is parallel to a Gaussian's line, and its mean is close to
    the Gaussian's plane, or to the mean of a Gaussian of one row."""
    mx, my, mz = mean
    lx, ly, lz = line
    px, py, pz = offset
    hx, hy, hz = segment
    hlx, hlz = along
    dot = hlx * lx + hlz * lz
    parallel = dot * dot > angle2 * (hlx * hlx + hlz * hlz) * (lx * lx + lz * lz)
    dx, dy, dz = mx - hx, my - hy, mz - hz
    first = tl.abs(dz) < 6.0 * (slope * mz * mz)
    nx, ny, nz = ly * pz - lz * py, lz * px - lx * pz, lx * py - ly * px
    distance = nx * dx + ny * dy + nz * dz
    later = distance * distance < (nx * nx + ny * ny + nz * nz) * (noise_floor * noise_floor)
    return parallel & ((first & (merged == 1)) | (later & (merged != 1)))


@triton.jit
def _joint(join, n, hn, mean, scatter, segment, segment_scatter):
    """Means and scatters of the Gaussians [lanes], those of the mask ``join`` with a segment's pixels."""
    mx, my, mz = mean
    sxx, sxy, sxz, syy, syz, szz = scatter
    hx, hy, hz = segment
    hxx, hxy, hxz, hyy, hyz, hzz = segment_scatter
    both = n + hn
    share = hn.to(tl.float64) / both.to(tl.float64)
    factor = n.to(tl.float64) * hn.to(tl.float64) / both.to(tl.float64)
    dx, dy, dz = hx - mx, hy - my, hz - mz
    sxx = tl.where(join, sxx + (hxx + factor * (dx * dx)), sxx)
    sxy = tl.where(join, sxy + (hxy + factor * (dx * dy)), sxy)
    sxz = tl.where(join, sxz + (hxz + factor * (dx * dz)), sxz)
    syy = tl.where(join, syy + (hyy + factor * (dy * dy)), syy)
    syz = tl.where(join, syz + (hyz + factor * (dy * dz)), syz)
    szz = tl.where(join, szz + (hzz + factor * (dz * dz)), szz)
    mx, my = tl.where(join, mx + share * dx, mx), tl.where(join, my + share * dy, my)
    return mx, my, tl.where(join, mz + share * dz, mz), sxx, sxy, sxz, syy, syz, szz


@triton.jit
def _large_enough(gone, n, merged, min_pixels: tl.constexpr, min_rows: tl.constexpr, prune: tl.constexpr):
    """The Gaussians ``gone`` that are not pruned."""
    large, tall = n >= min_pixels, merged >= min_rows
    if prune == 0:
        keep = gone
    elif prune == 1:
        keep = gone & (large | tall)
    else:
        keep = gone & large & tall
    return keep


@triton.jit
def _slots(keep, born, retained, lanes: tl.constexpr):
    """Slots of the Gaussians ``keep`` in the order of their creation, -1 for others, after ``retained`` earlier ones;
    and the new number of these."""
    slot = tl.arange(0, lanes) * 0 - 1
    waiting = keep
    for _ in range(tl.sum(keep.to(tl.int32), 0)):
        next_born = tl.min(tl.where(waiting, born, 2147483647), 0)
        selected = waiting & (born == next_born)
        slot = tl.where(selected, retained, slot)
        waiting = waiting & ~selected
        retained += 1
    return slot, retained


@triton.jit
def _write(out, keep, n, mean, scatter, mean_o, covariance_o, weight_o, rounded: tl.constexpr):
    """Write the Gaussians ``keep`` to slots ``out`` of the mixture."""
    mx, my, mz = mean
    sxx, sxy, sxz, syy, syz, szz = scatter
    ratio = tl.where(n > 1, n - 1, 1).to(tl.float64)
    several = n > 1
    cxx, cxy = tl.where(several, sxx / ratio, 0.0), tl.where(several, sxy / ratio, 0.0)
    cxz, cyy = tl.where(several, sxz / ratio, 0.0), tl.where(several, syy / ratio, 0.0)
    cyz, czz = tl.where(several, syz / ratio, 0.0), tl.where(several, szz / ratio, 0.0)
    cxx, cxy, cxz = _stored(cxx, rounded), _stored(cxy, rounded), _stored(cxz, rounded)
    cyy, cyz, czz = _stored(cyy, rounded), _stored(cyz, rounded), _stored(czz, rounded)
    tl.store(mean_o + 3 * out, _stored(mx, rounded), mask=keep)
    tl.store(mean_o + 3 * out + 1, _stored(my, rounded), mask=keep)
    tl.store(mean_o + 3 * out + 2, _stored(mz, rounded), mask=keep)
    store_symmetric(covariance_o + 9 * out, cxx, cxy, cxz, cyy, cyz, czz, keep)
    tl.store(weight_o + out, n.to(tl.float64), mask=keep)


@triton.jit
def _join(
    camera, moments, integers, counts, mean_o, covariance_o, weight_o, member, slot_of,
    height, most, capacity, total,
    rounded: tl.constexpr, scale: tl.constexpr, reference: tl.constexpr, scaled: tl.constexpr,
    noise_floor: tl.constexpr, angle2: tl.constexpr, min_pixels: tl.constexpr, min_rows: tl.constexpr,
    prune: tl.constexpr, single: tl.constexpr, least: tl.constexpr, lanes: tl.constexpr,
):  # fmt: skip
    b = tl.program_id(0).to(tl.int64)
    fx, fy, cy = tl.load(camera + 9 * b), tl.load(camera + 9 * b + 4), tl.load(camera + 9 * b + 5)
    focal = tl.minimum(fx, fy)
    slope = slope_of(focal, scale, reference, scaled)
    lane = tl.arange(0, lanes)
    active = _most_active(counts + b * height, height, lanes)
    rows = tl.where((active > least) & (active <= lanes), height, 0)
    zero = tl.zeros([lanes], tl.float64)
    mx, my, mz, sxx, sxy, sxz, syy, syz, szz = zero, zero, zero, zero, zero, zero, zero, zero, zero
    lx, ly, lz, ox, oy, oz, px, py, pz, p2, reach = zero, zero, zero, zero, zero, zero, zero, zero, zero, zero, zero
    n = tl.zeros([lanes], tl.int32)
    merged, u_left, u_right, since, last = n, n, n, n, n
    born = n - 1  # -1 = a lane without a Gaussian
    created, retained = 0, 0
    prefetched = _loaded(moments, integers, b * height * most)
    found_next = tl.load(counts + b * height)
    for v in range(rows):
        row = b * height + v
        ry = (v - cy) / fy
        next_row = b * height + tl.minimum(v + 1, height - 1)
        following = next_row * most
        found, found_next = found_next, tl.load(counts + next_row)
        if found == 0:
            prefetched = _loaded(moments, integers, following)
        for j in range(found):
            hx, hz, hxx, hxz, hzz, hlx, hlz, h_reach, hn, h_left, h_right = prefetched
            # Prefetch the next segment while this one is tested.
            prefetched = _loaded(moments, integers, tl.where(j + 1 < found, row * most + j + 1, following))
            hy, hly = ry * hz, ry * hlz
            hxy, hyy, hyz = ry * hxz, ry * ry * hzz, ry * hzz

            best = _most_overlapping(u_left, u_right, h_left, h_right, (born >= 0) & (since < v), single)
            oldest = tl.min(tl.where(best, born, 2147483647), 0)
            join = best & (born == oldest) & (p2 < reach)
            join = join & _coplanar(
                (mx, my, mz), (lx, ly, lz), (px, py, pz), merged, (hx, hy, hz), (hlx, hlz), slope, noise_floor, angle2
            )
            if tl.sum(join.to(tl.int32), 0) > 0:
                mx, my, mz, sxx, sxy, sxz, syy, syz, szz = _joint(
                    join, n, hn, (mx, my, mz), (sxx, sxy, sxz, syy, syz, szz), (hx, hy, hz),
                    (hxx, hxy, hxz, hyy, hyz, hzz),
                )  # fmt: skip
                lx, ly, lz = tl.where(join, lx + hlx, lx), tl.where(join, ly + hly, ly), tl.where(join, lz + hlz, lz)
                begun = join & (merged == 1)
                ox, oy, oz = tl.where(begun, mx, ox), tl.where(begun, my, oy), tl.where(begun, mz, oz)
                ex, ey, ez = hx - ox, hy - oy, hz - oz
                px, py, pz = tl.where(join, px + ex, px), tl.where(join, py + ey, py), tl.where(join, pz + ez, pz)
                p2 = tl.where(join, ex * ex + ey * ey + ez * ez, p2)
                n = tl.where(join, n + hn, n)
                merged = tl.where(join, merged + 1, merged)
                u_left = tl.where(join, (u_left + h_left) // 2, u_left)
                u_right = tl.where(join, (u_right + h_right) // 2, u_right)
                reach = tl.where(join, tl.minimum(reach, h_reach), reach)
                last = tl.where(join, v, last)
                tl.store(member + row * most + j, oldest)
            else:
                free = lane == tl.min(tl.where(born < 0, lane, lanes), 0)
                mx, my, mz = tl.where(free, hx, mx), tl.where(free, hy, my), tl.where(free, hz, mz)
                sxx, sxy, sxz = tl.where(free, hxx, sxx), tl.where(free, hxy, sxy), tl.where(free, hxz, sxz)
                syy, syz, szz = tl.where(free, hyy, syy), tl.where(free, hyz, syz), tl.where(free, hzz, szz)
                lx, ly, lz = tl.where(free, hlx, lx), tl.where(free, hly, ly), tl.where(free, hlz, lz)
                ox, oy, oz = tl.where(free, 0.0, ox), tl.where(free, 0.0, oy), tl.where(free, 0.0, oz)
                px, py, pz = tl.where(free, 0.0, px), tl.where(free, 0.0, py), tl.where(free, 0.0, pz)
                p2, reach = tl.where(free, 0.0, p2), tl.where(free, h_reach, reach)
                n, merged = tl.where(free, hn, n), tl.where(free, 1, merged)
                u_left, u_right = tl.where(free, h_left, u_left), tl.where(free, h_right, u_right)
                since, last, born = tl.where(free, v, since), tl.where(free, v, last), tl.where(free, created, born)
                tl.store(member + row * most + j, created)
                created += 1
        # Gaussians that the row did not extend end, and all after the last row. Slots follow the order of creation.
        gone = (born >= 0) & (tl.where(height - 1 - v == 0, -1, last) != v)
        if tl.sum(gone.to(tl.int32), 0) > 0:
            keep = _large_enough(gone, n, merged, min_pixels, min_rows, prune)
            slot, retained = _slots(keep, born, retained, lanes)
            tl.store(slot_of + b * total + born, slot, mask=gone)
            _write(
                b * capacity + slot, keep, n, (mx, my, mz), (sxx, sxy, sxz, syy, syz, szz), mean_o, covariance_o,
                weight_o, rounded,
            )  # fmt: skip
            born = tl.where(gone, -1, born)


@triton.jit
def _lift(
    camera, mean, covariance, weight, capacity,
    near_plane: tl.constexpr, epsilon: tl.constexpr, pixel_variance: tl.constexpr, chunk: tl.constexpr,
):  # fmt: skip
    """Raise the eigenvalues of the covariances in place, as ``step._segment``."""
    b = tl.program_id(1).to(tl.int64)
    focal = tl.minimum(tl.load(camera + 9 * b), tl.load(camera + 9 * b + 4))
    k = tl.program_id(0) * chunk + tl.arange(0, chunk)
    inside = k < capacity
    k = b * capacity + k
    occupied = tl.load(weight + k, mask=inside, other=0.0) > 0
    if tl.max(occupied.to(tl.int32), 0) > 0:
        z = tl.load(mean + 3 * k + 2, mask=occupied, other=1.0)
        xx, xy, xz, yy, yz, zz = load_symmetric(covariance + 9 * k, occupied)
        across = tl.maximum(z, exact(near_plane, z)) / focal
        least = tl.maximum(across * across * pixel_variance, epsilon * (xx + yy + zz))
        xx, xy, xz, yy, yz, zz = floored(xx, xy, xz, yy, yz, zz, least)
        store_symmetric(covariance + 9 * k, xx, xy, xz, yy, yz, zz, occupied)

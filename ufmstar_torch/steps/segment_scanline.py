"""First half of SPGF: divides every row of the depth map into segments that are lines in x and z.

Processes all rows of all images at once, column by column. Moments are taken about a segment's first pixel.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from ufmstar_torch.config import SPGFConfig
from ufmstar_torch.gaussians.camera import focal_and_centre


class OpenSegment(NamedTuple):
    """Open segments: the columns of a table [..., 15]. d = p - pL; within a row y = ry z, so x and z suffice."""

    n: Tensor
    dx: Tensor  # sums of d_x, d_z, d_x^2, d_x d_z, d_z^2
    dz: Tensor
    dxx: Tensor
    dxz: Tensor
    dzz: Tensor
    x_left: Tensor
    z_left: Tensor
    x_right: Tensor
    z_right: Tensor
    w2: Tensor  # |pR - pL|^2
    u_left: Tensor
    u_right: Tensor
    nearest: Tensor  # smallest depth bin
    born: Tensor  # index in the row, in order of creation


@dataclass(frozen=True)
class Frame:
    """The images as R = B H rows [R, W] in float64, 0 where a pixel is ignored."""

    limits: SPGFConfig  # for images of this size
    height: int
    z: Tensor
    use: Tensor
    rx: Tensor  # [R, W] and [R, 1], the rays
    ry: Tensor
    slope: Tensor  # [B, 1] a / f [1/m]
    bins: Tensor  # [R, W] int64
    lengths2: Tensor  # [B, bins] [m^2]

    @classmethod
    def of(cls, depth: Tensor, intrinsics: Tensor, limits: SPGFConfig) -> Frame:
        dtype = torch.float64
        b, height, width = depth.shape
        z = depth.to(dtype)
        use = (z > 0) & (z <= limits.depth_limit)
        z = torch.where(use, z, 0)
        K = intrinsics.to(dtype)
        fx, fy, cx, cy = focal_and_centre(K)
        rx = (torch.arange(width, dtype=dtype, device=z.device) - cx[:, None]) / fx[:, None]
        ry = (torch.arange(height, dtype=dtype, device=z.device) - cy[:, None]) / fy[:, None]
        lengths, edges = _depth_bins(limits, 0.5 * torch.minimum(width / fx, height / fy))
        # On an accelerator, NaN in the intrinsics is not rejected here (that would synchronise): clamp the index.
        bins = torch.searchsorted(edges, z.reshape(b, -1)).clamp_max(limits.depth_bins - 1)
        return cls(
            limits, height, z.reshape(-1, width), use.reshape(-1, width),
            rx.repeat_interleave(height, 0), ry.reshape(-1, 1), limits.slope(torch.minimum(fx, fy))[:, None],
            bins.reshape(-1, width), lengths * lengths,
        )  # fmt: skip

    def per_row(self, value: Tensor) -> Tensor:
        """[B, ...] to [R, ...]."""
        return value.repeat_interleave(self.height, 0)


def _depth_bins(limits: SPGFConfig, s: Tensor) -> tuple[Tensor, Tensor]:
    """Lengths and far edges [B, bins] of the depth bins [m]; edges may lie beyond max_depth."""
    length = torch.full_like(s, limits.min_gaussian_length)
    edge = torch.zeros_like(s)
    lengths, edges = [], []
    for _ in range(limits.depth_bins):
        edge = edge + length
        lengths.append(length)
        edges.append(edge)
        longest = limits.frame_max_scale * limits.min_gaussian_length
        length = (s * edge).clamp(limits.min_gaussian_length, longest)
    return torch.stack(lengths, 1), torch.stack(edges, 1)


@dataclass(frozen=True)
class Segments:
    """Finished segments of every row in order of output, at most M.

    Attributes:
        table: [R, M, 15] as :class:`OpenSegment`.
        count: [R].
        pixel: [R, W] the pixel's segment, -1 = none.
    """

    table: Tensor
    count: Tensor
    pixel: Tensor


@dataclass(frozen=True)
class _Column:
    """One column of all rows, [R, 1] each."""

    u: int
    x: Tensor
    z: Tensor
    use: Tensor
    bins: Tensor
    length2: Tensor
    tau_z: Tensor
    tau_x: Tensor


def _columns(frame: Frame) -> Iterator[_Column]:
    limits = frame.limits
    t = frame.per_row(frame.slope) * frame.z * frame.z
    maps = {
        "x": frame.rx * frame.z,
        "z": frame.z,
        "use": frame.use,
        "bins": frame.bins,
        "length2": frame.per_row(frame.lengths2).gather(1, frame.bins),
        "tau_z": (6.0 * t).clamp(limits.noise_floor, limits.noise_thresh),
        "tau_x": t.clamp(limits.noise_floor, limits.line_thresh),
    }
    for u in range(frame.z.shape[1]):
        yield _Column(u=u, **{name: value[:, u : u + 1] for name, value in maps.items()})


def scanlines(frame: Frame) -> Segments:
    """Scanline segmentation of all rows at once, column by column.

    ``queue`` [R, max_open, 15] holds the open segments, newest first; an empty entry has n = 0.
    """
    limits = frame.limits
    rows, width = frame.z.shape
    y_factor = 1.0 + frame.ry * frame.ry
    queue = frame.z.new_zeros(rows, limits.max_open, len(OpenSegment._fields))
    started = frame.z.new_zeros(rows, 1)
    owner = torch.full_like(frame.bins, -1)
    done = _Finished(frame.z, limits.segments_per_row(width), limits.sparse)
    for p in _columns(frame):
        fits = _fits(OpenSegment(*queue.unbind(-1)), p, limits)
        start = p.use & ~fits.any(-1, keepdim=True)
        done.add(queue[:, -1], start[:, 0])
        pushed = torch.cat([_fresh(p, started), queue[:, :-1]], 1)
        queue = torch.where(start[..., None], pushed, queue)
        started = started + start
        first = fits & (fits.cumsum(-1) == 1)
        target = torch.cat([first[:, :1] | start, first[:, 1:]], 1)
        open_ = OpenSegment(*queue.unbind(-1))
        queue = torch.where(target[..., None], torch.stack(_extended(open_, p, y_factor), -1), queue)
        born = torch.where(target, open_.born, 0).sum(-1)
        owner[:, p.u] = torch.where(p.use[:, 0], born, -1).to(torch.int64)
    for q in range(limits.max_open):
        done.add(queue[:, q], torch.ones_like(done.count, dtype=torch.bool))
    # Pixels without a segment read entry ``width``, which is -1.
    pixel = done.finished_index.gather(1, torch.where(owner < 0, width, owner))
    return Segments(done.table[:, :-1], done.count, pixel)


def _fits(open_: OpenSegment, p: _Column, limits: SPGFConfig) -> Tensor:
    """[R, max_open] True where the pixel continues an open segment."""
    near = (open_.n > 0) & (p.u - open_.u_right <= limits.occlusion_gap) & (open_.w2 < p.length2)
    close = ((p.z - open_.z_right).abs() < p.tau_z) & ((p.x - open_.x_right).abs() < p.tau_x)
    flat = open_.dx == 0
    line = open_.z_left + open_.dz * (p.x - open_.x_left) / torch.where(flat, 1, open_.dx)
    straight = ~flat & ((line - p.z).abs() < p.tau_z)
    return near & torch.where(open_.n <= limits.n_check, close, straight) & p.use


def _fresh(p: _Column, started: Tensor) -> Tensor:
    """[R, 1, 15] a segment without pixels that starts at the current pixel."""
    zero = torch.zeros_like(p.x)
    values = dict.fromkeys(OpenSegment._fields, zero)
    values |= {"x_left": p.x, "z_left": p.z, "u_left": zero + p.u, "nearest": p.bins.to(zero), "born": started}
    return torch.stack(OpenSegment(**values), -1)


def _extended(open_: OpenSegment, p: _Column, y_factor: Tensor) -> OpenSegment:
    """All open segments with the pixel added; the caller selects its segment."""
    dx, dz = p.x - open_.x_left, p.z - open_.z_left
    return open_._replace(
        n=open_.n + 1,
        dx=open_.dx + dx,
        dz=open_.dz + dz,
        dxx=open_.dxx + dx * dx,
        dxz=open_.dxz + dx * dz,
        dzz=open_.dzz + dz * dz,
        x_right=p.x.expand_as(dx),
        z_right=p.z.expand_as(dz),
        w2=dx * dx + y_factor * (dz * dz),
        u_right=torch.full_like(dx, p.u),
        nearest=torch.minimum(open_.nearest, p.bins.to(dx)),
    )


class _Finished:
    """Collects finished segments; an additional last entry receives the segments that are dropped."""

    def __init__(self, z: Tensor, most: int, sparse: int) -> None:
        rows, width = z.shape
        self.sparse, self.most, self.width = sparse, most, width
        self.table = z.new_zeros(rows, most + 1, len(OpenSegment._fields))
        self.finished_index = torch.full((rows, width + 1), -1, dtype=torch.int64, device=z.device)
        self.count = torch.zeros(rows, dtype=torch.int64, device=z.device)

    def add(self, segment: Tensor, mask: Tensor) -> None:
        """Output the segments [R, 15] where ``mask`` [R] is True and they are not too sparse."""
        open_ = OpenSegment(*segment.unbind(-1))
        keep = mask & (open_.n > self.sparse)
        index = torch.where(keep, self.count, self.most)[:, None, None].expand(-1, 1, segment.shape[1])
        self.table.scatter_(1, index, segment[:, None])
        start = torch.where(keep, open_.born.to(torch.int64), self.width)
        self.finished_index.scatter_(1, start[:, None], torch.where(keep, self.count, -1)[:, None])
        self.count = self.count + keep

"""Second half of SPGF: joins the segments of successive rows into Gaussians, planes of at most the depth bin's length.

Processes all images at once, row by row and segment by segment. Moments are taken about the running mean.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from ufmstar_torch.steps.segment_scanline import Frame, OpenSegment, Segments


class Gaussian(NamedTuple):
    """Active or emitted Gaussians: the columns of a table [..., 25], each field [..., width]."""

    mean: Tensor  # 3
    scatter: Tensor  # 6: xx, xy, xz, yy, yz, zz about the mean
    l: Tensor  # 3, the line vector
    mu0: Tensor  # 3
    pi: Tensor  # 3, the plane vector
    pi2: Tensor  # 1, like all further fields
    n: Tensor  # pixels
    merged: Tensor  # segments
    nearest: Tensor  # smallest depth bin
    u_left: Tensor
    u_right: Tensor
    row: Tensor  # last row that extended it
    born: Tensor  # index in order of creation


_WIDTHS = (3, 6, 3, 3, 3, 1, 1, 1, 1, 1, 1, 1, 1)
GAUSSIAN_WIDTH = sum(_WIDTHS)
_TRIANGLE = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))


def _lift(frame: Frame, segments: Segments) -> Tensor:
    """[R, M, 25] a Gaussian of each segment; moments in y follow from y = ry z."""
    s = OpenSegment(*segments.table[..., None].unbind(-2))
    ry, n = frame.ry[..., None], s.n.clamp_min(1.0)
    mean_x, mean_z = s.x_left + s.dx / n, s.z_left + s.dz / n
    xx, xz, zz = s.dxx - s.dx * s.dx / n, s.dxz - s.dx * s.dz / n, s.dzz - s.dz * s.dz / n
    none = torch.zeros_like(s.n)
    height = frame.height
    row = torch.arange(height, device=n.device).repeat(len(n) // height).to(n)[:, None, None].expand_as(n)
    return torch.cat(
        Gaussian(
            mean=torch.cat([mean_x, ry * mean_z, mean_z], -1),
            scatter=torch.cat([xx, ry * xz, xz, ry * ry * zz, ry * zz, zz], -1),
            l=torch.cat([s.dx, ry * s.dz, s.dz], -1),
            mu0=none.expand(-1, -1, 3),
            pi=none.expand(-1, -1, 3),
            pi2=none,
            n=s.n,
            merged=none + 1,
            nearest=s.nearest,
            u_left=s.u_left,
            u_right=s.u_right,
            row=row,
            born=none,
        ),
        -1,
    )


def fuse_segments(frame: Frame, segments: Segments) -> tuple[Tensor, Tensor, Tensor]:
    """Segment fusion, all streams at once, row by row and segment by segment.

    After a row at most M Gaussians are active, since each has a segment of that row.

    Returns:
        The emitted Gaussians [B, G, 25] in order, their number [B], and the index, in order of creation, of each
        segment's Gaussian [B, H, M].
    """
    height = frame.height
    present = segments.count.view(-1, height)
    b = len(present)
    trips, wide, total = _trip_counts(frame, present)
    lifted = _lift(frame, segments).view(b, height, -1, GAUSSIAN_WIDTH)[:, :, :wide]
    slot = torch.arange(wide, device=present.device)
    nothing = present.new_zeros(b)
    active, active_count, created = lifted.new_zeros(b, wide, GAUSSIAN_WIDTH), nothing, nothing
    emitted, emitted_count = lifted.new_zeros(b, total + 1, GAUSSIAN_WIDTH), nothing
    member = present.new_zeros(b, height, wide)
    for v in range(height):
        exists = slot < active_count[:, None]
        active, joined = _join_row(frame, active, exists, lifted[:, v], present[:, v], trips[v])
        alone = (joined < 0) & (slot < present[:, v, None])
        new_index = created[:, None] + alone.cumsum(1) - 1
        created = created + alone.sum(1)
        member[:, v] = torch.where(alone, new_index, joined)
        fresh = torch.cat([lifted[:, v, :, :-1], new_index[..., None].to(lifted)], -1)

        both, exists = torch.cat([active, fresh], 1), torch.cat([exists, alone], 1)
        # The last row completes all Gaussians, in the order of the active list.
        going = exists & (parts(both).row[..., 0] == v) & (v < height - 1)
        emitted_count = append(emitted, emitted_count, both, exists & ~going)
        active = lifted.new_zeros(b, wide + 1, GAUSSIAN_WIDTH)
        active_count = append(active, nothing, both, going)
        active = active[:, :wide]
    return emitted[:, :total], emitted_count, member


def reads_are_free(device: torch.device) -> bool:
    """True on the CPU, where a loop bound may depend on a value; on other devices, reading it would synchronise."""
    return device.type == "cpu"


def _trip_counts(frame: Frame, present: Tensor) -> tuple[list[int], int, int]:
    """Number of segments to visit in each row, its maximum, and the largest number of Gaussians of any stream.

    Read from the data on the CPU; static bounds elsewhere (:func:`reads_are_free`).
    """
    if not reads_are_free(present.device):
        most = frame.limits.segments_per_row(frame.z.shape[1])
        return [most] * frame.height, most, most * frame.height
    trips = present.amax(0).tolist()
    return trips, max(1, *trips), max(1, int(present.sum(1).max()))


def parts(table: Tensor) -> Gaussian:
    return Gaussian(*table.split(_WIDTHS, -1))


def append(table: Tensor, count: Tensor, values: Tensor, mask: Tensor) -> Tensor:
    """Write the values [B, N, C] where ``mask`` [B, N] is True after the ``count`` [B] first entries of the buffer
    ``table`` [B, T + 1, C], whose last entry collects the others. Returns the new count."""
    index = torch.where(mask, count[:, None] + mask.cumsum(1) - 1, table.shape[1] - 1)
    table.scatter_(1, index[..., None].expand_as(values), values)
    return count + mask.sum(1)


def _join_row(
    frame: Frame, active: Tensor, exists: Tensor, row: Tensor, present: Tensor, trips: int
) -> tuple[Tensor, Tensor]:
    """Join the segments ``row`` [B, M, 25] of one row, one after the other, with the active Gaussians [B, A, 25].

    Returns the Gaussians, and the index of the Gaussian that each segment joined [B, M], -1 = none.
    """
    joined = torch.full(row.shape[:2], -1, dtype=torch.int64, device=row.device)
    for j in range(trips):
        h = row[:, j : j + 1]
        best, overlaps = _best_overlap(parts(active), exists, parts(h))
        best = best[..., None].expand_as(h)
        o = active.gather(1, best)
        join = (present > j)[:, None] & overlaps & _same_plane(parts(o), parts(h), frame)
        merged = torch.cat(_merged(parts(o), parts(h)), -1)
        active = active.scatter(1, best, torch.where(join[..., None], merged, o))
        joined[:, j] = torch.where(join, parts(o).born[..., 0].to(torch.int64), -1)[:, 0]
    return active, joined


def _best_overlap(o: Gaussian, exists: Tensor, h: Gaussian) -> tuple[Tensor, Tensor]:
    """[B, 1] index of the first active Gaussian whose interval overlaps the segment's most, and whether any does."""
    shared = torch.minimum(o.u_right, h.u_right) - torch.maximum(o.u_left, h.u_left)
    span = torch.maximum(o.u_right, h.u_right) - torch.minimum(o.u_left, h.u_left)
    overlap = exists[..., None] & (shared > 0)
    rho = torch.where(overlap, shared / torch.where(overlap, span, 1), 0)[..., 0]
    best = rho.argmax(1, keepdim=True)
    return best, rho.gather(1, best) > 0


def _same_plane(o: Gaussian, h: Gaussian, frame: Frame) -> Tensor:
    """[B, 1] True where segment h continues the surface of Gaussian o."""
    limits = frame.limits
    reach = frame.lengths2.gather(1, o.nearest[..., 0].to(torch.int64))
    (hx, _, hz), (ox, oy, oz) = h.l.unbind(-1), o.l.unbind(-1)
    dot = hx * ox + hz * oz
    along = dot * dot > limits.angle_cosine**2 * (hx * hx + hz * hz) * (ox * ox + oz * oz)

    dx, dy, dz = (o.mean - h.mean).unbind(-1)
    z = o.mean[..., 2]
    first = dz.abs() < 6.0 * (frame.slope * z * z)
    px, py, pz = o.pi.unbind(-1)
    nx, ny, nz = oy * pz - oz * py, oz * px - ox * pz, ox * py - oy * px
    distance = nx * dx + ny * dy + nz * dz
    later = distance * distance < (nx * nx + ny * ny + nz * nz) * (limits.noise_floor * limits.noise_floor)
    return (o.pi2[..., 0] < reach) & along & torch.where(o.merged[..., 0] == 1, first, later)


def _merged(o: Gaussian, h: Gaussian) -> Gaussian:
    """Gaussian o with segment h added: moments about the means (Chan et al.), then interval and plane state."""
    n = (o.n + h.n).clamp_min(1.0)
    d = h.mean - o.mean
    outer = torch.stack([d[..., i] * d[..., j] for i, j in _TRIANGLE], -1)
    mean = o.mean + h.n / n * d
    mu0 = torch.where(o.merged == 1, mean, o.mu0)
    step = h.mean - mu0
    sx, sy, sz = (step * step).split(1, -1)
    return Gaussian(
        mean=mean,
        scatter=o.scatter + (h.scatter + o.n * h.n / n * outer),
        l=o.l + h.l,
        mu0=mu0,
        pi=o.pi + step,
        pi2=sx + sy + sz,
        n=n,
        merged=o.merged + 1,
        nearest=torch.minimum(o.nearest, h.nearest),
        u_left=((o.u_left + h.u_left) / 2).floor(),
        u_right=((o.u_right + h.u_right) / 2).floor(),
        row=h.row,
        born=o.born,
    )

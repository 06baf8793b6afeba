"""The points of UfM and their update by one frame: a pure function per stream.

UfM (Sudhakar, Karaman, Sze, "Uncertainty from Motion for DNN Monocular Depth Estimation", ICRA 2022) stores every
predicted pixel as a point with a mean, a covariance and a count. There are two deliberate differences from the authors'
release. The points stay in the frame of the first camera; the release moves all points into each new camera, which
accumulates the error of rotations that are not quite orthonormal. Covariances may have negative entries; the release
sets them to zero through a mistyped threshold.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

# The covariance is symmetric: the six entries of its upper triangle are stored, row by row.
_ROW, _COLUMN = (0, 0, 0, 1, 1, 2), (0, 1, 2, 1, 2, 2)
# x, y, z and the six entries above.
MOMENTS = 9


@dataclass(frozen=True)
class Cloud:
    """The N points of one stream in the order in which they were added, oldest first."""

    # [N, 9] mean x, y, z [m] and covariance xx, xy, xz, yy, yz, zz [m^2], in one frame (the caller's).
    moments: Tensor
    count: Tensor  # [N] int32 n, observations fused into the point

    @classmethod
    def empty(cls, dtype: torch.dtype, device: torch.device) -> Cloud:
        """No points."""
        return cls(
            torch.zeros(0, MOMENTS, dtype=dtype, device=device), torch.zeros(0, dtype=torch.int32, device=device)
        )

    @property
    def mean(self) -> Tensor:
        """[N, 3] [m]."""
        return self.moments[:, :3]

    @property
    def covariance(self) -> Tensor:
        """[N, 3, 3] [m^2]."""
        full = self.moments.new_empty(len(self.count), 3, 3)
        for entry, (i, j) in enumerate(zip(_ROW, _COLUMN, strict=True)):
            full[:, i, j] = full[:, j, i] = self.moments[:, 3 + entry]
        return full

    @property
    def bytes_per_point(self) -> int:
        """9 numbers and a count: 40 in float32, 76 in float64."""
        return MOMENTS * self.moments.element_size() + self.count.element_size()


@dataclass(frozen=True)
class View:
    """The prediction of one camera, in one stream."""

    depth: Tensor  # [H, W] [m], 0 where not valid
    variance: Tensor  # [H, W] the network's variance s^2 [m^2], 0 without one
    valid: Tensor  # [H, W] bool, True = use
    intrinsics: Tensor  # [3, 3] float64 [px]
    R_first_cam: Tensor  # [3, 3] float64 rotation from this camera into the first one
    t_first_cam: Tensor  # [3] float64 this camera's position in the first one [m]


def take_in(cloud: Cloud, view: View, max_points: int | None) -> tuple[Cloud, Tensor]:
    """Steps 1 to 5 of a frame: correspond, fuse, read out, append, prune. Returns the points after the frame, and the
    variance [H, W] [m^2], NaN where not valid.

    A point corresponds to the pixel that it projects into, without a test of occlusion or depth. Points that project
    into an invalid pixel are unchanged.

    Args:
        cloud: in the frame of the first camera; not modified.
        view: its depth may have another dtype than the cloud, whose dtype is used for the computation.
        max_points: limit beyond which the oldest points out of view are dropped, then the oldest of all; None = no
            limit.
    """
    pixel, seen = _landing(cloud, view)
    observed = _observations(view, cloud.moments.dtype)
    valid = view.valid.flatten()
    met = (seen & valid.index_select(0, pixel)).nonzero()[:, 0]
    pixel = pixel[met]
    fused = _fused(cloud, met, observed.index_select(0, pixel))
    variance, hit = _read_out(fused.moments.index_select(0, met), pixel, view)
    fresh = (valid & ~hit).nonzero()[:, 0]
    cloud = Cloud(
        torch.cat([fused.moments, observed.index_select(0, fresh)]),
        torch.cat([fused.count, torch.ones_like(fresh, dtype=torch.int32)]),
    )
    keep = _retained(torch.cat([seen, torch.ones_like(fresh, dtype=torch.bool)]), max_points)
    if keep is not None:
        cloud = Cloud(cloud.moments.index_select(0, keep), cloud.count.index_select(0, keep))
    return cloud, variance


def _landing(cloud: Cloud, view: View) -> tuple[Tensor, Tensor]:
    """Step 1: the pixel [N] into which each point is projected (0 if none), and whether it is in view [N].

    u = round(fx x/z + cx), half to even. A point in the camera's plane, z = 0, has no pixel.
    """
    height, width = view.depth.shape
    dtype = cloud.moments.dtype
    K, R, t = (value.to(dtype) for value in (view.intrinsics, view.R_first_cam, view.t_first_cam))
    # Column by column, which is faster than a matrix product of three numbers per point.
    offset = [cloud.moments[:, axis] - t[axis] for axis in range(3)]
    x, y, z = (offset[0] * R[0, i] + offset[1] * R[1, i] + offset[2] * R[2, i] for i in range(3))
    u = torch.round(K[0, 0] * x / z + K[0, 2])
    v = torch.round(K[1, 1] * y / z + K[1, 2])
    seen = (z > 0) & (u >= 0) & (u < width) & (v >= 0) & (v < height)
    pixel = torch.where(seen, v * width + u, torch.zeros_like(u))
    return pixel.long(), seen


def _observations(view: View, dtype: torch.dtype) -> Tensor:
    """[H*W, 9] each pixel as a point in the first camera's frame: p = z r + t and A = s^2 r r^T with
    r = R ((u-cx)/fx, (v-cy)/fy, 1)."""
    height, width = view.depth.shape
    K, R, t = (value.to(dtype) for value in (view.intrinsics, view.R_first_cam, view.t_first_cam))
    device = view.depth.device
    x = (torch.arange(width, dtype=dtype, device=device) - K[0, 2]) / K[0, 0]
    y = (torch.arange(height, dtype=dtype, device=device) - K[1, 2]) / K[1, 1]
    ray = [x * R[i, 0] + y[:, None] * R[i, 1] + R[i, 2] for i in range(3)]
    # 0 where not valid, because 0 * NaN is NaN.
    depth = torch.where(view.valid, view.depth, torch.zeros_like(view.depth)).to(dtype)
    s2 = torch.where(view.valid, view.variance, torch.zeros_like(view.variance)).to(dtype)
    points = [depth * ray[i] + t[i] for i in range(3)]
    spread = [s2 * (ray[i] * ray[j]) for i, j in zip(_ROW, _COLUMN, strict=True)]
    return torch.stack([*points, *spread], dim=-1).flatten(0, 1)


def _fused(cloud: Cloud, met: Tensor, observed: Tensor) -> Cloud:
    """Step 2 at the points ``met`` [P], with the observations ``observed`` [P, 9] of their pixels; M = n + 1:

    mu' = mu + (p - mu)/M and S' = (M-1)/M S + A/M + (M-1)/M^2 (p - mu)(p - mu)^T.
    """
    old = cloud.moments.index_select(0, met)
    M = cloud.count.index_select(0, met) + 1
    share = M.to(old.dtype).reciprocal()[:, None]
    step = observed - old
    new = old + step * share
    scaled = step[:, :3] * (share - share.square())  # (M-1)/M^2 = 1/M - 1/M^2
    for entry, (i, j) in enumerate(zip(_ROW, _COLUMN, strict=True)):
        new[:, 3 + entry].addcmul_(scaled[:, i], step[:, j])
    return Cloud(cloud.moments.index_copy(0, met, new), cloud.count.index_copy(0, met, M))


def _read_out(met: Tensor, pixel: Tensor, view: View) -> tuple[Tensor, Tensor]:
    """Step 3: S'_zz in this camera of the newest fused point at a pixel, s^2 at pixels without a point.

    Args:
        met: [P, 9] fused points, oldest first.
        pixel: [P] their pixels.
        view: of this camera.

    Returns:
        variance [H, W] [m^2], NaN where not valid; and hit [H*W], True at pixels with a point.
    """
    axis = view.R_first_cam[:, 2].to(met.dtype)
    weight = torch.stack([axis[i] * axis[j] * (1 if i == j else 2) for i, j in zip(_ROW, _COLUMN, strict=True)])
    along_z = (met[:, 3:] * weight).sum(1).clamp_min(0)  # not below 0 by rounding
    # The maximum selects the newest point, independent of the order in which a device writes.
    newest = torch.full((view.depth.numel(),), -1, dtype=torch.int64, device=pixel.device)
    newest = newest.scatter_reduce(0, pixel, torch.arange(len(pixel), device=pixel.device), "amax")
    hit = newest >= 0
    variance = torch.where(view.valid, view.variance.to(met.dtype), torch.nan).flatten()
    if len(pixel):
        variance = torch.where(hit, along_z.index_select(0, newest.clamp_min(0)), variance)
    return variance.view(view.depth.shape), hit


def _retained(seen: Tensor, max_points: int | None) -> Tensor | None:
    """Step 5: indices of the points to keep; ``seen`` [N] is True for points in view. None = all."""
    excess = 0 if max_points is None else len(seen) - max_points
    if excess <= 0:
        return None
    unseen = ~seen
    keep = seen | (unseen.cumsum(0) > excess)
    excess -= int(unseen.sum().clamp_max(excess))
    return keep.nonzero()[excess:, 0]

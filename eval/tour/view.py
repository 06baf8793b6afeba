"""``render``: a camera's image of a tour, with exact depth."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ufmstar_torch.eval.tour.intersect import entry
from ufmstar_torch.eval.tour.sensor import develop
from ufmstar_torch.eval.tour.shade import shade
from ufmstar_torch.eval.tour.tour import Tour
from ufmstar_torch.eval.tour.visibility import Window, surface_windows
from ufmstar_torch.runtime.kinds import check_kinds

_SKY = torch.tensor([[0.55], [0.7], [0.9]])  # linear RGB


@dataclass(frozen=True, eq=False)
class TourView:
    """A rendered image with its depth."""

    image: Tensor  # [H, W, 3] uint8 RGB
    depth: Tensor  # [H, W] float64 along z [m], 0 in the sky
    surface: Tensor  # [H, W] int64 index of the primitive, -1 = none: the sky


def intrinsics(height: int, width: int, fov_degrees: float = 70.0) -> NDArray[np.float64]:
    """[3, 3] a centred pinhole camera [px] with the given horizontal field of view."""
    f = 0.5 * width / np.tan(np.radians(fov_degrees) / 2)
    return np.array([[f, 0.0, (width - 1) / 2], [0.0, f, (height - 1) / 2], [0.0, 0.0, 1.0]])


@check_kinds
def render(
    tour: Tour, T_world_cam: Tensor, K: Tensor, height: int, width: int, *, frame_seed: int | None = None
) -> TourView:
    """Render one view from a pose [4, 4] (camera-to-world, x right, y down, z forward [m]) with intrinsics [3, 3] [px].
    ``frame_seed`` adds a sensor's exposure, vignetting and noise. Raises ValueError: a malformed pose, intrinsics or
    size, or a camera outside of all rooms."""
    pose, intrinsics = _checked(tour, T_world_cam, K, height, width)
    depth, surface = cast(tour, pose, intrinsics, height, width)
    valid = surface >= 0
    fx, fy = float(intrinsics[0, 0]), float(intrinsics[1, 1])
    u, v = _pixels(height, width)
    M = (pose[:3, :3, None] * torch.linalg.inv(intrinsics)).sum(1)
    direction = torch.stack([(u * row[0] + (v * row[1] + row[2])).flatten().float() for row in M])
    flat = surface.flatten().clamp_min(0)
    near = torch.where(valid, depth, 0.0).flatten().float()
    color = shade(tour, flat, near, direction, pose[:3, 3].float(), (fx * fy) ** -0.5)
    image = develop(torch.where(valid.flatten(), color, _SKY).view(3, height, width), frame_seed)
    return TourView(image, torch.where(valid, depth, 0.0), surface)


def cast(tour: Tour, T_world_cam: Tensor, K: Tensor, height: int, width: int) -> tuple[Tensor, Tensor]:
    """Depth [H, W] float64 [m], infinite without a surface, and the visible primitives [H, W] int64, -1 = none;
    arguments as for :func:`render`."""
    seen = surface_windows(tour.surfaces.corners, T_world_cam, K, height, width)
    u, v = _pixels(height, width)
    depth = torch.full((height, width), float("inf"), dtype=torch.float64)
    surface = torch.full((height, width), -1, dtype=torch.int64)
    for (i, (top, bottom, left, right)), (kind, taper, o, M) in zip(
        seen, _rays(tour, T_world_cam, K, seen), strict=True
    ):
        x, y, z = (u[left:right] * m[0] + (v[top:bottom] * m[1] + m[2]) for m in M)
        t = entry(kind, (o[0], o[1], o[2]), (x, y, z), taper)
        part = depth[top:bottom, left:right]
        surface[top:bottom, left:right].masked_fill_(t < part, i)
        torch.minimum(part, t, out=part)
    return depth, surface


def _pixels(height: int, width: int) -> tuple[Tensor, Tensor]:
    """Columns [W] and rows [H, 1] float64."""
    return torch.arange(width, dtype=torch.float64), torch.arange(height, dtype=torch.float64)[:, None]


def _rays(
    tour: Tour, T_world_cam: Tensor, K: Tensor, seen: list[tuple[int, Window]]
) -> Iterator[tuple[int, float, list[float], list[list[float]]]]:
    """Kind, taper, camera o [3] and M [3, 3] of primitives, in whose unit coordinates a ray is o + t M (u, v, 1)."""
    s, chosen = tour.surfaces, torch.tensor([i for i, _ in seen], dtype=torch.int64)
    R, half = s.rotation[chosen], s.half[chosen]
    o = ((T_world_cam[:3, 3] - s.centre[chosen])[:, :, None] * R).sum(1) / half
    camera = (R[:, :, :, None] * T_world_cam[:3, None, :3]).sum(1) / half[:, :, None]
    M = (camera[..., None] * torch.linalg.inv(K)).sum(2)
    return zip(s.kind[chosen].tolist(), s.taper[chosen].tolist(), o.tolist(), M.tolist(), strict=True)


def _checked(tour: Tour, T_world_cam: Tensor, K: Tensor, height: int, width: int) -> tuple[Tensor, Tensor]:
    for name, value, size in (("T_world_cam", T_world_cam, 4), ("K", K, 3)):
        if value.shape != (size, size) or not bool(torch.isfinite(value).all()):
            raise ValueError(f"{name} must be a finite [{size}, {size}] matrix, got shape {tuple(value.shape)}")
    if height < 1 or width < 1:
        raise ValueError(f"height and width must be at least 1, got {height} and {width}")
    pose = T_world_cam.to(torch.float64)
    p = pose[:3, 3]
    boxes = torch.cat([tour.rooms, tour.doors])
    if not bool(((boxes[:, 0] < p) & (p < boxes[:, 1])).all(1).any()):
        raise ValueError(f"T_world_cam must stand in a room or a doorway of the tour, got position {p.tolist()}")
    return pose, K.to(torch.float64)

"""What of a tour a camera can see: the part of the image that each primitive and each room can touch."""

from __future__ import annotations

import torch
from torch import Tensor

from ufmstar_torch.eval.tour.shapes import NOBODY, QUAD, Surfaces
from ufmstar_torch.eval.tour.tour import Tour

# Outlines are cut at this depth [m]: what is nearer lies thousands of pixels beside the image, as a camera
# keeps away from everything.
_NEAR = 1e-3
_SIGNS = [[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)]
_EDGES = [(a, b) for a in range(8) for b in range(a + 1, 8) if sum(p != q for p, q in zip(_SIGNS[a], _SIGNS[b])) == 1]


def surface_windows(tour: Tour, T_world_cam: Tensor, K: Tensor, height: int, width: int) -> Tensor:
    """[N, 4] int64 first and last-but-one row, first and last-but-one column that each primitive can touch.

    A primitive lies within the outline of its corners, and is seen through the doorways that lead to its room.
    """
    windows = _outlines(_corners(tour.surfaces), T_world_cam, K, height, width)
    rooms = _room_windows(tour, T_world_cam, K, height, width)
    first, second = tour.surfaces.rooms.unbind(1)
    seen = rooms[first]
    both = torch.where((second == NOBODY)[:, None], seen, _union(seen, rooms[second.clamp_min(0)]))
    return _intersection(windows, both)


def _corners(surfaces: Surfaces) -> Tensor:
    """[N, 8, 3] of the boxes around the primitives [m]."""
    half = surfaces.half.clone()
    half[:, 1] = torch.where(surfaces.kind == QUAD, 0.0, half[:, 1])
    wide = surfaces.taper.clamp_min(1.0)
    half[:, 0], half[:, 2] = half[:, 0] * wide, half[:, 2] * wide
    local = torch.tensor(_SIGNS, dtype=half.dtype, device=half.device) * half[:, None]
    turned = (surfaces.rotation[:, None] * local[:, :, None]).sum(-1)
    return surfaces.centre[:, None] + turned


def _outlines(corners: Tensor, T_world_cam: Tensor, K: Tensor, height: int, width: int) -> Tensor:
    """[N, 4] windows of convex hulls of corners [N, 8, 3], cut where they pass the camera."""
    R, t = T_world_cam[:3, :3], T_world_cam[:3, 3]
    camera = ((corners - t)[..., None] * R).sum(-2)  # R^T (p - t)
    a, b = camera[:, [e[0] for e in _EDGES]], camera[:, [e[1] for e in _EDGES]]
    crosses = (a[..., 2] < _NEAR) != (b[..., 2] < _NEAR)
    share = (_NEAR - a[..., 2]) / torch.where(crosses, b[..., 2] - a[..., 2], 1.0)
    points = torch.cat([camera, a + share[..., None] * (b - a)], dim=1)
    valid = torch.cat([camera[..., 2] >= _NEAR, crosses], dim=1)
    x, y, z = points[..., 0], points[..., 1], torch.where(valid, points[..., 2], 1.0).clamp_min(_NEAR / 2)
    u = (K[0, 0] * x + K[0, 1] * y) / z + K[0, 2]
    v = K[1, 1] * y / z + K[1, 2]
    bounds = []
    for values, size in ((v, height), (u, width)):
        low = values.masked_fill(~valid, float("inf")).amin(1).floor()
        high = values.masked_fill(~valid, float("-inf")).amax(1).ceil() + 1
        bounds += [low.clamp(0, size), high.clamp(0, size)]
    return torch.stack(bounds, dim=1).long()


def _room_windows(tour: Tour, T_world_cam: Tensor, K: Tensor, height: int, width: int) -> Tensor:
    """[R, 4] windows in which each room can be seen, through the doorways from the camera's room."""
    windows = torch.zeros(len(tour.rooms), 4, dtype=torch.int64)
    windows[int(tour.room_at(T_world_cam[:3, 3]))] = torch.tensor([0, height, 0, width])
    if len(tour.doors) == 0:
        return windows.to(tour.device)
    portals = _outlines(_box_corners(tour.doors), T_world_cam, K, height, width).cpu()
    pairs = tour.door_rooms.tolist()
    for _ in pairs:  # the rooms are a tree: as many rounds as doorways reach every room
        for portal, (a, b) in zip(portals, pairs, strict=True):
            for here, there in ((a, b), (b, a)):
                windows[there] = _union(windows[there], _intersection(windows[here], portal))
    return windows.to(tour.device)


def _box_corners(boxes: Tensor) -> Tensor:
    signs = torch.tensor(_SIGNS, dtype=boxes.dtype, device=boxes.device)
    low, high = boxes[:, None, 0], boxes[:, None, 1]
    return torch.where(signs < 0, low, high)


def _intersection(a: Tensor, b: Tensor) -> Tensor:
    """Windows [..., 4] in both; an empty one has as many rows or columns as none."""
    low, high = torch.maximum(a[..., 0::2], b[..., 0::2]), torch.minimum(a[..., 1::2], b[..., 1::2])
    empty = (low >= high).any(-1, keepdim=True)
    return _interleave(torch.where(empty, 0, low), torch.where(empty, 0, high))


def _union(a: Tensor, b: Tensor) -> Tensor:
    """The smallest windows [..., 4] around both; an empty one adds nothing."""
    low, high = torch.minimum(a[..., 0::2], b[..., 0::2]), torch.maximum(a[..., 1::2], b[..., 1::2])
    no_a, no_b = (
        (a[..., 1::2] <= a[..., 0::2]).any(-1, keepdim=True),
        (b[..., 1::2] <= b[..., 0::2]).any(-1, keepdim=True),
    )
    around = _interleave(low, high)
    return torch.where(no_a, b, torch.where(no_b, a, around))


def _interleave(low: Tensor, high: Tensor) -> Tensor:
    return torch.stack([low, high], dim=-1).flatten(-2)

"""Visibility: the part of the image that each primitive and each room can touch."""

from __future__ import annotations

import torch
from torch import Tensor

from ufmstar_torch.eval.tour.shapes import NOBODY
from ufmstar_torch.eval.tour.tour import Tour

# Outlines are cut at this depth [m]: what is nearer lies thousands of pixels beside the image, as a camera
# keeps away from everything.
_NEAR = 1e-3
# Corners are numbered by their signs along x, y, z as binary digits; edges join those that differ in one.
_EDGES = [(a, a | bit) for a in range(8) for bit in (1, 2, 4) if not a & bit]
Window = tuple[int, int, int, int]
_EMPTY: Window = (0, 0, 0, 0)


def surface_windows(tour: Tour, T_world_cam: Tensor, K: Tensor, height: int, width: int) -> list[tuple[int, Window]]:
    """The primitives that can be seen, with the first and last-but-one row and column that each can touch.

    A primitive lies within the outline of its corners, and is seen through the doorways that lead to its room.
    """
    rooms = room_windows(tour, T_world_cam, K, height, width)
    seen = torch.tensor([top < bottom for top, bottom, _, _ in rooms])
    first, second = tour.surfaces.rooms.unbind(1)
    candidates = torch.nonzero(seen[first] | ((second != NOBODY) & seen[second.clamp_min(0)])).flatten()
    outlines = _outlines(tour.surfaces.corners[candidates], T_world_cam, K, height, width)
    windows = []
    for i, (a, b), outline in zip(candidates.tolist(), tour.surfaces.rooms[candidates].tolist(), outlines, strict=True):
        window = _intersection(outline, rooms[a] if b == NOBODY else _union(rooms[a], rooms[b]))
        if window is not _EMPTY:
            windows.append((i, window))
    return windows


def room_windows(tour: Tour, T_world_cam: Tensor, K: Tensor, height: int, width: int) -> list[Window]:
    """The part of the image in which each room is visible from the camera's own, through the doorways."""
    windows = [_EMPTY] * len(tour.rooms)
    windows[int(tour.room_at(T_world_cam[:3, 3]))] = (0, height, 0, width)
    if len(tour.doors) == 0:
        return windows
    portals = _outlines(box_corners(tour.doors), T_world_cam, K, height, width)
    pairs = tour.door_rooms.tolist()
    for _ in pairs:  # the rooms are a tree: as many rounds as doorways reach every room
        for portal, (a, b) in zip(portals, pairs, strict=True):
            for here, there in ((a, b), (b, a)):
                windows[there] = _union(windows[there], _intersection(windows[here], portal))
    return windows


def box_corners(boxes: Tensor) -> Tensor:
    """[N, 8, 3] of axis-aligned boxes [N, 2, 3], in the order of their signs as binary digits."""
    pick = torch.tensor([[i >> 2 & 1, i >> 1 & 1, i & 1] for i in range(8)])
    return boxes.gather(1, pick.expand(len(boxes), 8, 3))


def _outlines(corners: Tensor, T_world_cam: Tensor, K: Tensor, height: int, width: int) -> list[Window]:
    """Windows of convex hulls of corners [N, 8, 3], cut where they pass the camera."""
    R, p = T_world_cam[:3, :3].tolist(), (corners - T_world_cam[:3, 3]).unbind(-1)
    x, y, z = (p[0] * R[0][k] + p[1] * R[1][k] + p[2] * R[2][k] for k in range(3))  # R^T (p - t)
    start, end = [a for a, _ in _EDGES], [b for _, b in _EDGES]
    z_a, z_b = z[:, start], z[:, end]
    crosses = (z_a < _NEAR) != (z_b < _NEAR)
    share = (_NEAR - z_a) / torch.where(crosses, z_b - z_a, 1.0)
    x, y = (torch.cat([c, c[:, start] + share * (c[:, end] - c[:, start])], dim=1) for c in (x, y))
    valid = torch.cat([z >= _NEAR, crosses], dim=1)
    z = torch.where(valid, torch.cat([z, torch.full_like(z_a, _NEAR)], dim=1), 1.0)
    k = K.tolist()
    bounds = []
    for values, size in (((k[1][1] * y) / z + k[1][2], height), ((k[0][0] * x + k[0][1] * y) / z + k[0][2], width)):
        low = values.masked_fill(~valid, float("inf")).amin(1).floor()
        high = values.masked_fill(~valid, float("-inf")).amax(1).ceil() + 1
        bounds += [low.clamp(0, size), high.clamp(0, size)]
    return [_intersection((a, b, c, d), (0, height, 0, width)) for a, b, c, d in torch.stack(bounds, 1).long().tolist()]


def _intersection(a: Window, b: Window) -> Window:
    top, bottom, left, right = max(a[0], b[0]), min(a[1], b[1]), max(a[2], b[2]), min(a[3], b[3])
    return (top, bottom, left, right) if top < bottom and left < right else _EMPTY


def _union(a: Window, b: Window) -> Window:
    """The smallest window around both; an empty one adds nothing."""
    if a is _EMPTY or b is _EMPTY:
        return b if a is _EMPTY else a
    return min(a[0], b[0]), max(a[1], b[1]), min(a[2], b[2]), max(a[3], b[3])

"""Visibility: the part of the image that each primitive can cover."""

from __future__ import annotations

import torch
from torch import Tensor

# Outlines are cut at this depth [m]. Cameras are never near a surface, so nearer parts are thousands of pixels outside
# of the image.
_NEAR = 1e-3
# The number of a corner has its signs along x, y, z as binary digits; edges join corners that differ in one digit.
_EDGES = [(a, a | bit) for a in range(8) for bit in (1, 2, 4) if not a & bit]
Window = tuple[int, int, int, int]


def surface_windows(
    corners: Tensor, T_world_cam: Tensor, K: Tensor, height: int, width: int
) -> list[tuple[int, Window]]:
    """The visible primitives, with the range of rows and columns (start, end exclusive) that each can cover, from the
    outline of its corners [N, 8, 3] [m], cut at the near plane."""
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
    windows: list[Window] = [(a, b, c, d) for a, b, c, d in torch.stack(bounds, 1).long().tolist()]
    return [(i, window) for i, window in enumerate(windows) if window[0] < window[1] and window[2] < window[3]]

"""The share of each light that reaches a grid of points in a room, for soft shadows by interpolation.

It is computed once per tour with shadow rays; a surface samples it slightly in front.
"""

from __future__ import annotations

import torch
from torch import Tensor

from ufmstar_torch.eval.tour.intersect import Components, entry
from ufmstar_torch.eval.tour.shapes import NOBODY, Surfaces

GRID = (14, 22, 22)  # points of a room along y, z, x
# Sample points of a light in units of its size: the corners of a tetrahedron.
_SAMPLES = ((1.0, 1.0, 1.0), (-1.0, -1.0, 1.0), (-1.0, 1.0, -1.0), (1.0, -1.0, -1.0))
# A surface nearer to a lamp than this casts no shadow, which would cover half of the room [m].
_TOO_NEAR = 0.5
_SMALL = 0.05  # primitives with smaller half extents cast no shadow [m]


def light_volumes(rooms: Tensor, surfaces: Surfaces, lights: Tensor, sizes: Tensor, casts: Tensor) -> Tensor:
    """[R, L, *GRID] float32 share of each light in [0, 1] at the points of rooms with corners [R, 2, 3] [m]. The lights
    [R, L, 7] (positions first [m]) have the sizes [R, L] [m]; ``casts`` [N] is True for surfaces that cast shadows."""
    volume = torch.ones(*lights.shape[:2], *GRID)
    for r, (lower, upper) in enumerate(rooms.float()):
        x, y, z = (lower[k] + (upper[k] - lower[k]) * torch.linspace(0, 1, GRID[n]) for k, n in enumerate((2, 0, 1)))
        points = (x, y[:, None, None], z[:, None])
        casters = _casters(surfaces, casts, r)
        for k in range(lights.shape[1]):
            if not lights[r, k, 3:6].any():
                continue
            reached = torch.zeros(GRID)
            for offset in _SAMPLES:
                lamp = lights[r, k, :3] + 0.5 * sizes[r, k] * torch.tensor(offset)
                reached += _visible(points, lamp, surfaces, casters)
            volume[r, k] = reached / len(_SAMPLES)
    return volume


def _casters(surfaces: Surfaces, casts: Tensor, room: int) -> list[int]:
    in_room = (surfaces.rooms[:, 0] == room) & (surfaces.rooms[:, 1] == NOBODY) & casts
    large = surfaces.half.sort(dim=1).values[:, 1] > _SMALL
    return [int(i) for i in torch.nonzero(in_room & large).flatten()]


def _visible(points: Components, lamp: Tensor, surfaces: Surfaces, casters: list[int]) -> Tensor:
    """[*GRID] 1.0 where no caster is between a point and a lamp [3]; ``points`` are x, y, z that broadcast."""
    to_x, to_y, to_z = (points[k] - lamp[k] for k in range(3))
    distance = (to_x * to_x + to_y * to_y + to_z * to_z).sqrt()
    free = torch.ones(GRID)
    # Rays from the lamp to the points, because a point may be inside a primitive.
    for i in casters:
        axes = (surfaces.rotation[i].float() / surfaces.half[i].float()).T.tolist()
        to_lamp = (lamp - surfaces.centre[i].float()).tolist()
        o = [sum(to_lamp[j] * axis[j] for j in range(3)) for axis in axes]
        d = [to_x * axis[0] + (to_y * axis[1] + to_z * axis[2]) for axis in axes]
        t = entry(int(surfaces.kind[i]), (o[0], o[1], o[2]), (d[0], d[1], d[2]), float(surfaces.taper[i]))
        free.masked_fill_((t < 1) & (t * distance > _TOO_NEAR), 0.0)
    return free

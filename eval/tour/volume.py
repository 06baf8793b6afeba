"""How much of each light reaches a grid of points in a room: soft shadows for the price of a lookup.

Computed once per tour with shadow rays; a surface looks up a point a little before it.
"""

from __future__ import annotations

import torch
from torch import Tensor

from ufmstar_torch.eval.tour.intersect import entry
from ufmstar_torch.eval.tour.shapes import NOBODY, Surfaces

GRID = (11, 22, 22)  # points of a room along y, z, x
# Where a light's rays end, as parts of its size: the corners of a tetrahedron.
_SAMPLES = ((1.0, 1.0, 1.0), (-1.0, -1.0, 1.0), (-1.0, 1.0, -1.0), (1.0, -1.0, -1.0))
_SMALL = 0.05  # half extents below this cast no shadow worth a ray [m]


def light_volumes(rooms: Tensor, surfaces: Surfaces, lights: Tensor, sizes: Tensor, casts: Tensor) -> Tensor:
    """[R, L, *GRID] float32 share of each light in [0, 1] at a room's points.

    Args:
        rooms: [R, 2, 3] corners [m].
        surfaces: the primitives.
        lights: [R, L, 7] positions first [m].
        sizes: [R, L] of the lights [m].
        casts: [N] bool which primitives cast a shadow.
    """
    found = torch.ones(*lights.shape[:2], *GRID)
    for r, (lower, upper) in enumerate(rooms):
        points = torch.meshgrid(*(torch.linspace(0, 1, n, dtype=torch.float64) for n in GRID), indexing="ij")
        y, z, x = (p.reshape(-1) for p in points)
        xyz = [lower[k] + (upper[k] - lower[k]) * p for k, p in enumerate((x, y, z))]
        casters = _casters(surfaces, casts, r)
        for k in range(lights.shape[1]):
            if not lights[r, k, 3:6].any():
                continue
            reached = sum(
                _visible(xyz, lights[r, k, :3].double() + sizes[r, k] * 0.5 * torch.tensor(s), surfaces, casters)
                for s in _SAMPLES
            )
            found[r, k] = (reached / len(_SAMPLES)).reshape(GRID).float()
    return found


def _casters(surfaces: Surfaces, casts: Tensor, room: int) -> list[int]:
    own = (surfaces.rooms[:, 0] == room) & (surfaces.rooms[:, 1] == NOBODY) & casts
    large = surfaces.half.sort(dim=1).values[:, 1] > _SMALL
    return [int(i) for i in torch.nonzero(own & large).flatten()]


def _visible(xyz: list[Tensor], light: Tensor, surfaces: Surfaces, casters: list[int]) -> Tensor:
    """[P] 1.0 where nothing stands between a point and a light [3]."""
    free = torch.ones_like(xyz[0])
    for i in casters:
        R, half, centre = (surfaces.rotation[i], surfaces.half[i], surfaces.centre[i])
        # From the light to the points: the light is outside of everything, a point may be inside.
        o = [float(((light - centre) * R[:, k]).sum() / half[k]) for k in range(3)]
        d = [sum((xyz[j] - light[j]) * (R[j, k] / half[k]) for j in range(3)) for k in range(3)]
        t = entry(int(surfaces.kind[i]), (o[0], o[1], o[2]), (d[0], d[1], d[2]), float(surfaces.taper[i]))
        free = free * (t > 1)
    return free

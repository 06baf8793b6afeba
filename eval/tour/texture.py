"""Patterns of surfaces, evaluated at the point of a pixel and softened to the size of a pixel.

Coordinates are in periods of the pattern. ``pixel`` is a pixel's size in these coordinates: edges are as soft as in a
camera's image, and patterns finer than a pixel fade to their mean.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

_CELLS, _FINE = 64, 8  # number of cells after which noise repeats, and table entries per side of a cell
_SIDE = _CELLS * _FINE
_POSITIVE = 4096.0  # cells added so that truncation rounds down; a multiple of _CELLS


@dataclass(frozen=True, eq=False)
class Patch:
    """P pixels that see one kind of texture."""

    u: Tensor  # [P] coordinates on the surface [periods], shifted at random
    v: Tensor
    local_u: Tensor  # [P] coordinates without the random shift
    local_v: Tensor
    pixel: Tensor  # [P] size of a pixel on the surface [periods]
    first: Tensor  # [3, P] the texture's colours
    second: Tensor
    table: Tensor  # see :func:`noise_table`

    def mixed(self, share: Tensor, mean: float = 0.5) -> Tensor:
        """[3, P] from the first to the second colour by ``share``, or by ``mean`` if the pattern is too fine."""
        return self.first + (self.second - self.first) * (mean + (share - mean) * self.seen())

    def gain(self, values: Tensor, contrast: float) -> Tensor:
        """[P] 1 + contrast times values in [0, 1] about their middle."""
        return 1 + contrast * self.seen() * (values - 0.5)

    def seen(self) -> Tensor:
        """[P] visibility of the pattern: 1 = sharp, 0 = too fine."""
        return (1.6 - 2.0 * self.pixel).clamp(0, 1)

    def noise(self, u: Tensor, v: Tensor) -> Tensor:
        """[P] smooth noise in [0, 1) with cells of size 1; at integers, a random number of each cell."""
        i, j = ((x * _FINE + _POSITIVE * _FINE).long() & (_SIDE - 1) for x in (u, v))
        return self.table.index_select(0, i.mul_(_SIDE).add_(j))


def noise_table() -> Tensor:
    """[512 * 512] smooth noise with a random value at the first corner of each cell."""
    corners = torch.rand(_CELLS, _CELLS, generator=torch.Generator().manual_seed(3))
    share = torch.arange(_FINE) / _FINE
    share = share * share * (3 - 2 * share)
    rows = corners[:, None] * (1 - share)[None, :, None] + corners.roll(-1, 0)[:, None] * share[None, :, None]
    rows = rows.reshape(_SIDE, _CELLS)
    return (rows[..., None] * (1 - share) + rows.roll(-1, 1)[..., None] * share).reshape(-1)


def albedo(texture: int, patch: Patch) -> Tensor:
    """[3, P] linear RGB in [0, 1] of a texture, an index into ``TEXTURES``."""
    return _PATTERNS[texture](patch).clamp(0, 1)


def _soft(edge: Tensor, pixel: Tensor) -> Tensor:
    """0 where edge is negative, 1 where it is positive, over the width of a pixel."""
    return (edge / (pixel + 0.01) + 0.5).clamp(0, 1)


def _centred(x: Tensor) -> Tensor:
    """Coordinate from the middle between two integers, -0.5 to 0.5."""
    return x - x.floor() - 0.5


def _square(x: Tensor, pixel: Tensor) -> Tensor:
    """A square wave of period 1."""
    return _soft(0.25 - _centred(x).abs(), pixel)


def _to_edge(x: Tensor) -> Tensor:
    """Distance to the nearest integer."""
    return 0.5 - _centred(x).abs()


def _plain(p: Patch) -> Tensor:
    return p.first * p.gain(p.noise(p.u * 2, p.v * 2), 0.08)


def _plaster(p: Patch) -> Tensor:
    return p.first * p.gain(p.noise(p.u * 5, p.v * 5) * 0.6 + p.noise(p.u * 13, p.v * 13) * 0.4, 0.35)


def _wood(p: Patch) -> Tensor:
    plank = p.v.floor()
    grain = p.noise(p.u * 0.9 + plank * 7, p.v * 11)
    share = 0.65 * grain + 0.35 * p.noise(plank, (p.u * 0.18 + plank * 0.37).floor())
    seam = 1 - 0.45 * (1 - _soft(_to_edge(p.v) - 0.04, p.pixel)) * p.seen()
    return p.mixed(share) * seam


def _checks(p: Patch) -> Tensor:
    a, b = _square(p.u / 2, p.pixel), _square(p.v / 2, p.pixel)
    return p.mixed(a + b - 2 * a * b)


def _stripes(p: Patch) -> Tensor:
    return p.mixed(_square(p.u, p.pixel))


def _tiles(p: Patch) -> Tensor:
    joint = _soft(torch.minimum(_to_edge(p.u), _to_edge(p.v)) - 0.03, p.pixel)
    return p.mixed(1 - joint, 0.1) * p.gain(p.noise(p.u.floor(), p.v.floor()), 0.3)


def _bricks(p: Patch) -> Tensor:
    v = p.v * 3
    u = p.u + 0.5 * (v.floor() % 2)
    joint = _soft(torch.minimum(_to_edge(u) * 3, _to_edge(v)) - 0.09, p.pixel * 3)
    return p.mixed(1 - joint, 0.25) * p.gain(p.noise(u.floor(), v.floor()), 0.5)


def _fabric(p: Patch) -> Tensor:
    weave = 0.5 + 0.25 * torch.sin(25 * p.u) + 0.25 * torch.sin(25 * p.v)
    return p.mixed(0.6 * p.noise(p.u * 3, p.v * 3) + 0.4 * weave, 0.4)


def _books(p: Patch) -> Tensor:
    i = p.u.floor()
    spine = torch.stack([p.noise(i, torch.full_like(i, k)) for k in (1, 2, 3)])
    band = 1 - 0.5 * _soft(0.12 - (p.local_v - 1.2).abs(), p.pixel)
    gap = 0.3 + 0.7 * _soft(_to_edge(p.u) - 0.08, p.pixel)
    return (0.1 + 0.6 * spine**1.5 + 0.2 * p.first) * (band * gap)


def _painting(p: Patch) -> Tensor:
    """Hills and a sky, or coloured fields, chosen by the surface's random shift."""
    shift = p.u - p.local_u
    tall = 0.12 * torch.sin(p.local_u * 5 + shift) + 0.06 * torch.sin(p.local_u * 13 + 2)
    hill = _soft(p.local_v - tall, p.pixel)
    sun = _soft(0.1 - ((p.local_u - 0.4 * torch.sin(shift)) ** 2 + (p.local_v + 0.2) ** 2).sqrt(), p.pixel)
    sky = p.first * (0.7 - 0.5 * p.local_v)
    ground = p.second * (0.5 + 0.5 * p.noise(p.u * 9, p.v * 9))
    landscape = (sky * (1 - hill) + ground * hill) * (1 - sun) + (1 - p.second * 0.3) * sun
    field = p.noise((p.u * 3).floor(), (p.v * 2.2).floor())
    fields = p.first * (1 - field) + p.second * field + 0.25 * (field > 0.7)
    return torch.where(shift - shift.floor() < 0.5, landscape, fields)


def _window(p: Patch) -> Tensor:
    """Trees and a sky with clouds."""
    cloud = p.noise(p.u * 3, p.v * 6)
    sky = torch.stack([0.45 + 0.4 * cloud, 0.62 + 0.28 * cloud, 0.9 + 0.05 * cloud])
    leaves = 0.4 + 0.6 * p.noise(p.u * 14, p.v * 14)
    tree = torch.stack([0.12 * leaves, 0.25 * leaves, 0.08 * leaves])
    skyline = _soft(p.local_v - 0.12 - 0.35 * (p.noise(p.u * 2.5, p.v * 0) - 0.5), p.pixel)
    return sky * (1 - skyline) + tree * skyline


def _dots(p: Patch) -> Tensor:
    distance = (_centred(p.u) ** 2 + _centred(p.v) ** 2).sqrt()
    return p.mixed(_soft(0.28 - distance, p.pixel), 0.25)


def _zigzag(p: Patch) -> Tensor:
    return p.mixed(_square(p.v + 2 * _centred(p.u / 2).abs(), p.pixel))


def _marble(p: Patch) -> Tensor:
    bent = p.u + 1.6 * p.noise(p.u * 2, p.v * 2) + 0.6 * p.noise(p.u * 6, p.v * 6)
    return p.mixed((0.5 + 0.5 * torch.sin(6.0 * bent)) ** 3, 0.3)


def _terrazzo(p: Patch) -> Tensor:
    u, v = p.u * 4, p.v * 4
    i, j = u.floor(), v.floor()
    du, dv = u - i - 0.3 - 0.4 * p.noise(i, j), v - j - 0.3 - 0.4 * p.noise(j, i)
    chip = _soft(0.16 + 0.14 * p.noise(i + 9, j) - (du * du + dv * dv).sqrt(), p.pixel * 4)
    return p.mixed(chip, 0.2) * p.gain(p.noise(i, j + 5), 0.6)


def _hexagons(p: Patch) -> Tensor:
    """Distance to the border of hexagonal cells, from the nearer of two rectangular grids of centres."""
    r = 3.0**0.5
    edges = []
    for shift in (0.0, 0.5):
        x, y = _centred(p.u + shift).abs(), _centred(p.v / r + shift).abs() * r
        edges.append(0.5 - torch.maximum(x, 0.5 * x + 0.5 * r * y))
    return p.mixed(1 - _soft(torch.maximum(edges[0], edges[1]) - 0.06, p.pixel), 0.3)


def _rings(p: Patch) -> Tensor:
    u, v = _centred(p.u / 4), _centred(p.v / 4)
    return p.mixed(_square(4 * (u * u + v * v).sqrt(), p.pixel))


_PATTERNS: tuple[Callable[[Patch], Tensor], ...] = (  # in the order of ``TEXTURES``
    _plain, _plaster, _wood, _checks, _stripes, _tiles, _bricks, _fabric, _books, _painting, _window,
    _dots, _zigzag, _marble, _terrazzo, _hexagons, _rings,
)  # fmt: skip

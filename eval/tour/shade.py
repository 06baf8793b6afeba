"""The light from a tour's surfaces to the camera: texture, Lambert's law, soft shadows, dark corners."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import grid_sample

from ufmstar_torch.eval.tour.shapes import BOX, ELLIPSOID, FRUSTUM, QUAD
from ufmstar_torch.eval.tour.style import TEXTURES
from ufmstar_torch.eval.tour.texture import Patch, albedo
from ufmstar_torch.eval.tour.tour import Tour

_AMBIENT = 0.42  # ambient light as a share of the lamps'
_BEFORE = 0.1  # distance in front of a surface at which its shadow is sampled [m]
_CORNER, _DARKNESS = 0.22, 0.3  # range of darker corners [m], and their darkening
_TEXTURES = len(TEXTURES)
Span = tuple[int, int, int]  # a value, its first pixel, and the end of its pixels (exclusive)
_CAP = 1e-3  # distance from a frustum's end within which a point is on its cap, in unit coordinates


@dataclass(frozen=True, eq=False)
class Hits:
    """The points seen by P pixels, float32, sorted by room, kind and texture."""

    surface: Tensor  # [P] int64
    point: Tensor  # [3, P] [m]
    normal: Tensor  # [3, P] unit, towards the camera
    uv: Tensor  # [2, P] coordinates on the surface [m]
    footprint: Tensor  # [P] size of a pixel on the surface [m]


def shade(tour: Tour, surface: Tensor, depth: Tensor, direction: Tensor, origin: Tensor, pixel_angle: float) -> Tensor:
    """[3, P] linear RGB, about 0 to 1, of pixels.

    Args:
        tour: the rooms.
        surface: [P] int64 primitives that the pixels see.
        depth: [P] float32 along z [m].
        direction: [3, P] float32 rays (of depth 1).
        origin: [3] of the rays [m].
        pixel_angle: size of a pixel at depth 1 [m].
    """
    s = tour.surfaces
    group, order = torch.sort((s.rooms[:, 0] * 4 + s.kind)[surface] * _TEXTURES + s.texture[surface], stable=True)
    values, counts = torch.unique_consecutive(group, return_counts=True)
    ends = torch.cumsum(counts, 0).tolist()
    spans = [(value, end - n, end) for value, end, n in zip(values.tolist(), ends, counts.tolist(), strict=True)]
    sorted_surface = surface[order]
    kinds, rooms = _merged(spans, _TEXTURES), _merged(spans, 4 * _TEXTURES)
    hits = _hits(tour, sorted_surface, depth[order], direction.index_select(1, order), origin, pixel_angle, kinds)
    lit = [_light(tour, room, hits.point[:, a:b], hits.normal[:, a:b]) for room, a, b in rooms]
    light = torch.maximum(torch.cat(lit, dim=1), s.appearance[:, 7][sorted_surface])
    radiance = torch.empty_like(light)
    return radiance.index_copy_(1, order, _albedo(tour, hits, spans) * light)


def _merged(spans: list[Span], divisor: int) -> list[Span]:
    """Merge adjacent spans whose values are equal after division."""
    merged: list[Span] = []
    for value, start, end in spans:
        if merged and merged[-1][0] == value // divisor:
            merged[-1] = (merged[-1][0], merged[-1][1], end)
        else:
            merged.append((value // divisor, start, end))
    return merged


def _hits(
    tour: Tour, surface: Tensor, depth: Tensor, direction: Tensor, origin: Tensor, pixel_angle: float, kinds: list[Span]
) -> Hits:
    s = tour.surfaces
    geometry = torch.cat([s.rotation.flatten(1), s.centre, s.half, s.taper[:, None]], dim=1).float().T.contiguous()
    g = geometry.index_select(1, surface)
    R = g[:9].view(3, 3, -1)
    point = origin[:, None] + depth * direction
    d = point - g[9:12]
    q = R[0] * d[0] + R[1] * d[1] + R[2] * d[2]
    local_uv = [_LOCAL[value % 4](q[:, start:end], g[:, start:end]) for value, start, end in kinds]
    local, uv = (torch.cat(parts, dim=1) for parts in zip(*local_uv, strict=True))
    n = R[:, 0] * local[0] + R[:, 1] * local[1] + R[:, 2] * local[2]
    n = n * _dot(n, n).clamp_min(1e-12).rsqrt()
    cosine = _dot(n, direction) * _dot(direction, direction).rsqrt()
    footprint = pixel_angle * depth / cosine.abs().clamp_min(0.25)
    return Hits(surface, point, n * -torch.copysign(torch.ones_like(cosine), cosine), uv, footprint)


def _quad(q: Tensor, g: Tensor) -> tuple[Tensor, Tensor]:
    """Coordinates from the world's origin, so that patterns continue between pieces of a wall."""
    R, centre = g[:9].view(3, 3, -1), g[9:12]
    normal = torch.zeros_like(q)
    normal[1] = -1
    return normal, torch.stack([q[k] + _dot(R[:, k], centre) for k in (0, 2)])


def _box(q: Tensor, g: Tensor) -> tuple[Tensor, Tensor]:
    e = q / g[12:15]
    a = e.abs()
    x, y = (a[0] >= a[1]) & (a[0] >= a[2]), (a[1] > a[0]) & (a[1] >= a[2])
    z = ~(x | y)
    normal = torch.stack([x, y, z]) * e.sign()
    return normal, torch.stack([torch.where(x, q[2], q[0]), torch.where(y, q[2], q[1])])


def _ellipsoid(q: Tensor, g: Tensor) -> tuple[Tensor, Tensor]:
    half = g[12:15]
    radius = 0.5 * (half[0] + half[2])
    return q / (half * half), torch.stack([torch.atan2(q[0] / half[0], q[2] / half[2]) * radius, q[1]])


def _frustum(q: Tensor, g: Tensor) -> tuple[Tensor, Tensor]:
    half, taper = g[12:15], g[15]
    e = q / half
    m, n = (1 + taper) / 2, (1 - taper) / 2
    cap = (e[1].abs() > 1 - _CAP) & ((e[0] * e[0] + e[2] * e[2]).sqrt() < m + n * e[1] - _CAP)
    side = torch.stack([e[0], -n * (m + n * e[1]), e[2]]) / half
    flat = torch.stack([torch.zeros_like(cap), cap, torch.zeros_like(cap)]) * e.sign()
    around = torch.atan2(e[0], e[2]) * half[0]
    uv = torch.stack([torch.where(cap, q[0], around), torch.where(cap, q[2], q[1])])
    return torch.where(cap, flat, side), uv


_LOCAL = {QUAD: _quad, BOX: _box, ELLIPSOID: _ellipsoid, FRUSTUM: _frustum}


def _albedo(tour: Tour, hits: Hits, spans: list[Span]) -> Tensor:
    appearance = tour.surfaces.appearance.T.contiguous().index_select(1, hits.surface)
    local = hits.uv / appearance[6]
    shifted, pixel = local + appearance[8:10], hits.footprint / appearance[6]
    colours = []
    for value, start, end in spans:
        part = slice(start, end)
        u, v = shifted[:, part]
        local_u, local_v = local[:, part]
        patch = Patch(u, v, local_u, local_v, pixel[part], appearance[:3, part], appearance[3:6, part], tour.noise)
        colours.append(albedo(value % _TEXTURES, patch))
    return torch.cat(colours, dim=1)


def _light(tour: Tour, room: int, point: Tensor, normal: Tensor) -> Tensor:
    """[3, P] light of a room's lamps and ambient light on its surfaces."""
    lower, upper = tour.rooms[room].float()
    sample = ((point + _BEFORE * normal - lower[:, None]) / (upper - lower)[:, None] * 2 - 1).T
    reached = grid_sample(
        tour.volumes[room][None], sample[None, None, None], align_corners=True, padding_mode="border"
    )[0, :, 0, 0]
    lamps = tour.lights[room]
    ambient = _AMBIENT * lamps[:, 3:6].sum(0)
    light = ambient[:, None] * _corners(point, normal, lower, upper)
    for k, lamp in enumerate(lamps):
        to_lamp = lamp[:3, None] - point
        squared = _dot(to_lamp, to_lamp)
        facing = (_dot(to_lamp, normal) * squared.clamp_min(1e-6).rsqrt()).clamp_min(0)
        strength = facing * reached[k] / (0.35 + 0.65 * squared / (lamp[6] * lamp[6]))
        light = light + lamp[3:6, None] * strength
    return light


def _corners(point: Tensor, normal: Tensor, lower: Tensor, upper: Tensor) -> Tensor:
    """[P] factor of ambient light, smaller near another wall, the floor or the ceiling."""
    open_ = torch.ones_like(point[0])
    for k in range(3):
        near = torch.minimum(point[k] - lower[k], upper[k] - point[k]).clamp_min(0)
        open_ = open_ * (1 - _DARKNESS * (1 - normal[k] * normal[k]) * torch.exp(-near / _CORNER))
    return open_


def _dot(a: Tensor, b: Tensor) -> Tensor:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]

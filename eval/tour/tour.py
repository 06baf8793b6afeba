"""``make_tour``: rooms, furniture, lights and ways from a seed."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ufmstar_torch.eval.tour.furnish import LIGHTS, furnish
from ufmstar_torch.eval.tour.palette import Palette
from ufmstar_torch.eval.tour.rooms import Door, Room, frame, lay_out, shell
from ufmstar_torch.eval.tour.route import drive, ways
from ufmstar_torch.eval.tour.shapes import NOBODY, QUAD, Part, Surfaces, surfaces
from ufmstar_torch.eval.tour.style import style_of
from ufmstar_torch.eval.tour.texture import noise_table
from ufmstar_torch.eval.tour.volume import light_volumes

Array = NDArray[np.float64]

_DARK = [*[0.0] * 6, 1.0, 0.0]  # an unused light, see ``Furnished.lights``
# Margin of the box around a doorway's opening and frame [m].
_FRAME = 0.12
_SEEDS = 2**32  # number of seeds; those of a tour's frames, a million times as many, have 64 bits
_SHADOWLESS = ("window", "picture", "clock", "skirting")  # flat on the wall


@dataclass(frozen=True, eq=False)
class Tour:
    """Furnished rooms, and the ways through them. World axes: x right, y down, z forward [m], the floor at y = 0."""

    seed: int
    rooms: Tensor  # [R, 2, 3] float64 lower and upper corners (y from the ceiling to 0) [m]
    room_styles: tuple[str, ...]  # the name of each room's style
    doors: Tensor  # [D, 2, 3] float64 boxes around the openings [m]
    surfaces: Surfaces  # the primitives
    lights: Tensor  # [R, L, 7] float32: position [m], linear RGB, reach [m]; unused ones are dark
    volumes: Tensor  # [R, L, Y, Z, X] float32 share of each light that reaches a grid of points in the room
    noise: Tensor  # of the textures, see ``texture.noise_table``
    # [M, 2] float64 x and z [m]: closed ways, see ``route.ways``; in a style with a length, one line to drive along.
    ways: tuple[Array, ...]
    camera_height: float  # above the floor [m]


@lru_cache(maxsize=8, typed=True)  # True is no seed
def make_tour(seed: int, style: str = "home") -> Tour:
    """Make the rooms of a seed in one of ``STYLES``, equal on every machine. Raises ValueError: a seed out of
    range, or no such style."""
    if not isinstance(seed, int) or isinstance(seed, bool) or not 0 <= seed < _SEEDS:
        raise ValueError(f"seed must be an integer of at least 0 and below {_SEEDS}, got {seed!r}")
    chosen = style_of(style)
    # Each part of a tour has a separate generator, so that it can change without the others.
    plan, height, looks, things, shifts = (np.random.default_rng([seed, number]) for number in range(5))
    rooms, doors = lay_out(chosen, plan)
    routes = ways(rooms, doors) if chosen.length is None else (drive(rooms[0]),)
    parts, lights = _fill(rooms, doors, np.concatenate(routes), looks, things)
    table = surfaces(parts, shifts)
    corners = torch.tensor(np.array([room.box for room in rooms]))
    openings = [door.box(_FRAME, door.thickness / 2 + _FRAME, _FRAME, _FRAME) for door in doors]
    rows = torch.tensor([[*lamps, *[_DARK] * (LIGHTS - len(lamps))] for lamps in lights], dtype=torch.float32)
    light_table, sizes = rows[..., :7].contiguous(), rows[..., 7]
    casts = torch.tensor([p.kind != QUAD and p.finish.glow == 0 and p.label not in _SHADOWLESS for p in parts])
    return Tour(
        seed=seed,
        rooms=corners,
        room_styles=tuple(room.style.name for room in rooms),
        doors=torch.tensor(np.array(openings).reshape(-1, 2, 3)),
        surfaces=table,
        lights=light_table,
        volumes=light_volumes(corners, table, light_table, sizes, casts),
        noise=noise_table(),
        ways=routes,
        camera_height=float(height.uniform(*chosen.camera_height)),
    )


def _fill(
    rooms: list[Room], doors: list[Door], way: Array, looks: np.random.Generator, things: np.random.Generator
) -> tuple[list[Part], list[list[list[float]]]]:
    """All primitives, and the lights of each room."""
    parts: list[Part] = []
    lights: list[list[list[float]]] = []
    palettes = [Palette(room.style, looks) for room in rooms]
    for index, room in enumerate(rooms):
        room_doors = [door for door in doors if index in door.rooms]
        shell_parts = list(shell(room, room_doors, palettes[index]))
        stock = furnish(room, room_doors, way, palettes[index], things)
        parts += [replace(p, rooms=(index, NOBODY)) for p in shell_parts + stock.parts]
        lights.append(stock.lights)
    for door in doors:
        parts += [replace(p, rooms=door.rooms) for p in frame(door, palettes[door.rooms[0]].finish("wood"))]
    return parts, lights

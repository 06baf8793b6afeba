"""Puts furniture, pictures, windows, rugs and lamps into a room, clear of the ways through it."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ufmstar_torch.eval.tour.furniture import AT_WALLS, FREE_STANDING, IN_HALLS, Piece, chair
from ufmstar_torch.eval.tour.palette import Palette
from ufmstar_torch.eval.tour.rooms import Door, Room
from ufmstar_torch.eval.tour.shapes import Part, ball, box, tube, turn

Array = NDArray[np.float64]

CLEARANCE = 0.38  # between furniture and any way: 0.3 m for the camera, and the sway of its hand [m]
OVERHEAD = 2.0  # things whose lower edge is higher than this hang over a way [m]
LIGHTS = 3  # of a room at most
_FROM_WALL = 0.02  # the skirting board stands between [m]
_HALL_FROM = 7.0  # rooms with a side from here on are stock as halls [m]


@dataclass(frozen=True, eq=False)
class Light:
    """A lamp's or a window's light."""

    position: Array  # [3] [m]
    color: Array  # [3] linear RGB at the distance ``reach``, facing it
    reach: float  # [m]
    size: float  # how far its parts lie apart, which softens shadows [m]


@dataclass(eq=False)
class Furnished:
    """What a room holds; it grows while the room is stock."""

    parts: list[Part] = field(default_factory=list)  # primitives
    lights: list[Light] = field(default_factory=list)  # at most ``LIGHTS``
    taken: list[Array] = field(default_factory=list)  # [2, 3] lower and upper corners of the space that is taken [m]


def furnish(room: Room, doors: list[Door], way: Array, palette: Palette, rng: np.random.Generator) -> Furnished:
    """Furnishes a room, whose doors are given, clear of ``way`` [M, 2], x and z of all points where a camera may be
    [m]."""
    stock = Furnished()
    for door in doors:
        across = door.along * (door.width / 2 + 0.15) + np.abs(door.normal) * 0.5
        low, high = door.middle - across, door.middle + across
        stock.taken.append(np.array([[low[0], -door.height - 0.1, low[1]], [high[0], 0.0, high[1]]]))
    near = way[((way > room.lower - 1) & (way < room.upper + 1)).all(1)]
    _ceiling_lamps(stock, room, palette, rng)
    if rng.random() < 0.7:
        _rug(stock, room, palette, rng)
    _furniture(stock, room, near, palette, rng)
    for _ in range(int(rng.integers(1, 3))):
        _window(stock, room, near, palette, rng)
    for _ in range(int(rng.integers(2, 6))):
        _picture(stock, room, near, palette, rng)
    return stock


def _furniture(stock: Furnished, room: Room, way: Array, palette: Palette, rng: np.random.Generator) -> None:
    size = room.upper - room.lower
    large = size.max() >= _HALL_FROM
    wanted, placed = round(float(room.style.furniture * size.prod())), 0
    scale = float(rng.uniform(*room.style.scale))
    for _ in range(12 * wanted):
        if placed >= wanted:
            return
        free = rng.random() < (0.4 if large else 0.2)
        makers = IN_HALLS if large else FREE_STANDING if free else AT_WALLS
        piece = makers[int(rng.integers(len(makers)))](rng, palette)
        if free:
            yaw = float(rng.uniform(0, 2 * np.pi))
            spot = rng.uniform(room.lower, room.upper)
        else:
            spot, yaw = _at_wall(room, piece.width * scale, rng)
        if _place(stock, room, way, piece, spot, yaw, scale):
            placed += 1
            if piece.name == "table":
                _chairs(stock, room, way, piece, spot, yaw, scale, palette, rng)


def _at_wall(room: Room, width: float, rng: np.random.Generator, gap: float = _FROM_WALL) -> tuple[Array, float]:
    """A spot at a wall and the yaw that looks away from it."""
    axis, sign = int(rng.integers(2)), int(rng.choice([-1, 1]))
    along = 1 - axis
    spot = np.zeros(2)
    spot[axis] = room.upper[axis] - gap if sign > 0 else room.lower[axis] + gap
    low, high = room.lower[along] + width / 2 + 0.03, room.upper[along] - width / 2 - 0.03
    spot[along] = rng.uniform(low, high) if low < high else room.centre[along]
    inward = np.zeros(2)
    inward[axis] = -sign
    return spot, float(np.arctan2(inward[0], inward[1]))


def _place(
    stock: Furnished,
    room: Room,
    way: Array,
    piece: Piece,
    spot: Array,
    yaw: float,
    scale: float,
    ignore: Array | None = None,
    bottom: float = 0.0,
) -> bool:
    """Adds a piece if there is room for it."""
    R = turn(yaw)
    corners = np.array([[x, z] for x in (-piece.width / 2, piece.width / 2) for z in (0, piece.depth)]) * scale
    ground = corners @ R[np.ix_([0, 2], [0, 2])].T + spot
    low, high = ground.min(0), ground.max(0)
    space = np.array([[low[0], -bottom - piece.height * scale, low[1]], [high[0], -bottom, high[1]]])
    if (low < room.lower + 0.005).any() or (high > room.upper - 0.005).any():
        return False
    if -space[0, 1] > room.height - 0.08 or (bottom < OVERHEAD and _to_way(way, low, high) < CLEARANCE):
        return False
    for other in stock.taken:
        if other is not ignore and (space[0] < other[1] + 0.02).all() and (space[1] > other[0] - 0.02).all():
            return False
    stock.taken.append(space)
    base = np.array([spot[0], -bottom, spot[1]])
    for p in piece.parts:
        centre = base + R @ (p.centre * scale)
        stock.parts.append(Part(p.kind, centre, p.half * scale, p.finish, R @ p.rotation, p.taper, label=piece.name))
    return True


def _to_way(way: Array, low: Array, high: Array) -> float:
    """Distance from a rectangle to the nearest point of the ways [m]."""
    if not len(way):
        return float("inf")
    return float(np.linalg.norm(np.maximum(np.maximum(low - way, way - high), 0), axis=1).min())


def _chairs(
    stock: Furnished,
    room: Room,
    way: Array,
    piece: Piece,
    spot: Array,
    yaw: float,
    scale: float,
    palette: Palette,
    rng: np.random.Generator,
) -> None:
    """Chairs around a table that was just placed, pushed under it halfway."""
    own = stock.taken[-1]
    middle = spot + scale * piece.depth / 2 * np.array([np.sin(yaw), np.cos(yaw)])
    model, wanted = chair(rng, palette), int(rng.integers(1, 4))
    for angle in yaw + np.pi / 2 * rng.permutation(4):
        reach = scale * (0.22 + (piece.depth if abs(np.cos(angle - yaw)) > 0.5 else piece.width) / 2)
        outward = np.array([np.sin(angle), np.cos(angle)])
        facing = float(angle + np.pi + rng.normal(0, 0.1))
        if wanted and _place(stock, room, way, model, middle + reach * outward, facing, scale, ignore=own):
            wanted -= 1


def _ceiling_lamps(stock: Furnished, room: Room, palette: Palette, rng: np.random.Generator) -> None:
    size, style = room.upper - room.lower, room.style
    count = 2 if size.max() > 5 else 1
    warm = float(rng.uniform(*style.warmth))
    color = np.array([1.0 + 0.18 * warm, 1.0 + 0.02 * warm, 1.0 - 0.28 * warm])
    shade = palette.solid((0.95, 0.9, 0.8), 1.2 * style.brightness[1])
    what, metal = int(rng.integers(3)), palette.finish("metal")
    for k in range(count):
        offset = np.zeros(2)
        offset[int(np.argmax(size))] = (k - (count - 1) / 2) * size.max() / 2
        x, z = room.centre + offset + rng.uniform(-0.2, 0.2, 2)
        drop = min(0.08, room.height - OVERHEAD - 0.22) + (room.height - 2.9 if room.height > 3.2 else 0.0)
        if what == 0:
            stock.parts.append(tube((x, -room.height + drop + 0.1, z), 0.22, 0.09, shade, 0.5))
        elif what == 1:
            stock.parts.append(ball((x, -room.height + drop + 0.1, z), (0.17, 0.1, 0.17), shade))
        else:
            stock.parts.append(box((x, -room.height + drop + 0.05, z), (0.3, 0.03, 0.3), shade))
        if drop > 0.02:
            stock.parts.append(tube((x, -room.height + drop / 2, z), 0.012, drop / 2, metal))
        power = float(rng.uniform(*style.brightness)) / count**0.7
        stock.lights.append(Light(np.array([x, -room.height + drop + 0.16, z]), color * power, 0.5 * size.mean(), 0.25))


def _rug(stock: Furnished, room: Room, palette: Palette, rng: np.random.Generator) -> None:
    x, z = room.centre + rng.uniform(-0.3, 0.3, 2)
    half = (room.upper - room.lower) * rng.uniform(0.2, 0.32, 2)
    finish = palette.finish("cloth")
    if rng.random() < 0.35:
        stock.parts.append(tube((x, -0.006, z), float(half.min()), 0.007, finish))
    else:
        stock.parts.append(box((x, -0.006, z), (half[0], 0.007, half[1]), finish, yaw=float(rng.normal(0, 0.1))))


def _window(stock: Furnished, room: Room, way: Array, palette: Palette, rng: np.random.Generator) -> None:
    """A window with a frame, sometimes with curtains, and its daylight."""
    w, h = rng.uniform(0.45, 0.8), rng.uniform(0.45, 0.6)
    sill = rng.uniform(0.8, 0.95)
    frame, view = palette.finish("ceiling"), palette.picture("window", "paint", 2 * h, glow=0.75)
    parts = [
        box((0, -h, 0.02), (w, h, 0.015), view),
        box((0, 0.0, 0.04), (w + 0.08, 0.03, 0.042), frame),
        box((0, -2 * h, 0.02), (w + 0.04, 0.03, 0.025), frame),
        box((-w, -h, 0.02), (0.03, h, 0.025), frame),
        box((w, -h, 0.02), (0.03, h, 0.025), frame),
        box((0, -h, 0.02), (0.02, h, 0.02), frame),
    ]
    if rng.random() < 0.5:
        cloth = palette.finish("cloth")
        parts += [box((s * (w + 0.12), -h + 0.1, 0.06), (0.15, h + 0.22, 0.03), cloth) for s in (-1, 1)]
    piece = Piece("window", parts, 2 * w + 0.55, 0.1, 2 * h + 0.14)
    for _ in range(8):
        spot, yaw = _at_wall(room, piece.width, rng, 0.006)
        if _place(stock, room, way, piece, spot, yaw, 1.0, bottom=sill):
            inward = np.array([np.sin(yaw), 0.0, np.cos(yaw)])
            at = np.array([spot[0], -sill - h, spot[1]]) + 0.35 * inward
            if len(stock.lights) < LIGHTS:
                power = 0.55 * float(rng.uniform(*room.style.brightness))
                color = np.array([0.88, 0.97, 1.15]) * power
                stock.lights.append(Light(at, color, 0.45 * float((room.upper - room.lower).mean()), 0.5))
            return


def _picture(stock: Furnished, room: Room, way: Array, palette: Palette, rng: np.random.Generator) -> None:
    """A framed picture, or a clock."""
    if rng.random() < 0.15:
        round_ = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
        face = tube((0, -0.16, 0.02), 0.16, 0.02, palette.finish("ceiling"), rotation=round_)
        piece = Piece("clock", [face], 0.34, 0.045, 0.33)
    else:
        w, h = rng.uniform(0.15, 0.5), rng.uniform(0.15, 0.35)
        parts = [
            box((0, -h, 0.012), (w, h, 0.01), palette.finish("wood")),
            box((0, -h, 0.022), (w - 0.03, h - 0.03, 0.008), palette.picture("painting", "paint", 2 * h)),
        ]
        piece = Piece("picture", parts, 2 * w, 0.04, 2 * h)
    for _ in range(6):
        spot, yaw = _at_wall(room, piece.width, rng, 0.006)
        if _place(stock, room, way, piece, spot, yaw, 1.0, bottom=float(rng.uniform(1.3, 1.6))):
            return

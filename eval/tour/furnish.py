"""Adds furniture, pictures, windows, rugs and lamps to a room, clear of the ways through it."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from ufmstar_torch.eval.tour.furniture import AT_WALLS, FREE_STANDING, IN_HALLS, Piece, chair
from ufmstar_torch.eval.tour.palette import Palette
from ufmstar_torch.eval.tour.rooms import Door, Room, on_plan
from ufmstar_torch.eval.tour.shapes import Part, ball, box, rotation, tube

Array = NDArray[np.float64]

CLEARANCE = 0.38  # smallest distance of furniture from a way: 0.3 m for the camera, and the sway of the hand [m]
OVERHEAD = 2.0  # objects whose lower edge is higher than this may be above a way [m]
LIGHTS = 3  # largest number of lights of a room
_FROM_WALL = 0.02  # distance of furniture from the wall, for the skirting board [m]
_HALL_FROM = 7.0  # rooms with a side of at least this are furnished as halls [m]


def furnish(room: Room, doors: list[Door], way: Array, palette: Palette, rng: np.random.Generator) -> Furnished:
    """Furnish a room with these doors, clear of ``way`` [M, 2], x and z of all points where a camera may be [m]."""
    near = way[((way > room.lower - 1) & (way < room.upper + 1)).all(1)]
    stock = Furnished(room, near, palette, rng)
    stock.occupied += [door.box(0.15, 0.5, 0.1, 0.0) for door in doors]
    if room.style.outdoors:
        stock.add_sun()
    else:
        stock.hang_ceiling_lamps()
    if rng.random() < 0.7:
        stock.lay_rug()
    stock.place_furniture()
    for _ in range(int(rng.integers(1, 3))):
        stock.hang_window()
    for _ in range(int(rng.integers(2, 6))):
        stock.hang_picture()
    return stock


@dataclass(eq=False)
class Furnished:
    """The content of a room; it grows while the room is furnished."""

    room: Room
    way: Array  # [M, 2] x and z of the points near the room where a camera may be [m]
    palette: Palette
    rng: np.random.Generator
    parts: list[Part] = field(default_factory=list)  # primitives
    # At most ``LIGHTS`` lamps and windows: position [m], linear RGB on a surface that faces it at the distance
    # ``reach`` [m], reach, and extent, which softens shadows [m].
    lights: list[list[float]] = field(default_factory=list)
    occupied: list[Array] = field(default_factory=list)  # [2, 3] lower and upper corners of occupied space [m]

    def place_furniture(self) -> None:
        """Add furniture at the walls and in the middle, and chairs around tables."""
        room, rng = self.room, self.rng
        size = room.upper - room.lower
        large = size.min() >= _HALL_FROM
        wanted, placed = round(float(room.style.furniture * size.prod())), 0
        scale = float(rng.uniform(*room.style.scale))
        for _ in range(12 * wanted):
            if placed >= wanted:
                return
            free = rng.random() < (0.4 if large else 0.2)
            makers = IN_HALLS if large else FREE_STANDING if free else AT_WALLS
            piece = makers[int(rng.integers(len(makers)))](rng, self.palette)
            if free:
                yaw = float(rng.uniform(0, 2 * np.pi))
                spot = rng.uniform(room.lower, room.upper)
            else:
                spot, yaw = self._at_wall(piece.width * scale)
            if self._try_place(piece, spot, yaw, scale):
                placed += 1
                if piece.name == "table":
                    self._place_chairs(piece, spot, yaw, scale)

    def _place_chairs(self, table: Piece, spot: Array, yaw: float, scale: float) -> None:
        """Add chairs around the table that was placed last, halfway under it."""
        rng, footprint = self.rng, self.occupied[-1]
        middle = spot + scale * table.depth / 2 * np.array([np.sin(yaw), np.cos(yaw)])
        model, wanted = chair(rng, self.palette), int(rng.integers(1, 4))
        for angle in yaw + np.pi / 2 * rng.permutation(4):
            reach = scale * (0.22 + (table.depth if abs(np.cos(angle - yaw)) > 0.5 else table.width) / 2)
            outward = np.array([np.sin(angle), np.cos(angle)])
            facing = float(angle + np.pi + rng.normal(0, 0.1))
            if wanted and self._try_place(model, middle + reach * outward, facing, scale, ignore=footprint):
                wanted -= 1

    def hang_ceiling_lamps(self) -> None:
        """Add one or two lamps, and their light."""
        room, rng, palette = self.room, self.rng, self.palette
        size, style = room.upper - room.lower, room.style
        count = 2 if size.max() > 5 else 1
        warm = float(rng.uniform(*style.warmth))
        color = np.array([1.0 + 0.18 * warm, 1.0 + 0.02 * warm, 1.0 - 0.28 * warm])
        shade = palette.solid((0.95, 0.9, 0.8), 1.2 * style.brightness[1])
        what, metal = int(rng.integers(3)), palette.finish("metal")
        for k in range(count):
            offset = on_plan(int(np.argmax(size)), (k - (count - 1) / 2) * size.max() / 2, 0)
            x, z = room.centre + offset + rng.uniform(-0.2, 0.2, 2)
            drop = min(0.08, room.height - OVERHEAD - 0.22) + (room.height - 2.9 if room.height > 3.2 else 0.0)
            if what == 0:
                self.parts.append(tube((x, -room.height + drop + 0.1, z), 0.22, 0.09, shade, 0.5))
            elif what == 1:
                self.parts.append(ball((x, -room.height + drop + 0.1, z), (0.17, 0.1, 0.17), shade))
            else:
                self.parts.append(box((x, -room.height + drop + 0.05, z), (0.3, 0.03, 0.3), shade))
            if drop > 0.02:
                self.parts.append(tube((x, -room.height + drop / 2, z), 0.012, drop / 2, metal))
            power = float(rng.uniform(*style.brightness)) / count**0.7
            self.lights.append([x, -room.height + drop + 0.16, z, *color * power, 0.5 * size.mean(), 0.25])

    def add_sun(self) -> None:
        """Add one light far above the room."""
        (x, z), size, style = self.room.centre, self.room.upper - self.room.lower, self.room.style
        warm, far = float(self.rng.uniform(*style.warmth)), 2 * float(size.max())
        color = np.array([1.0 + 0.18 * warm, 1.0 + 0.02 * warm, 1.0 - 0.28 * warm])
        x, z = (x, z) + far * self.rng.uniform(-0.5, 0.5, 2)
        self.lights.append([x, -far, z, *color * float(self.rng.uniform(*style.brightness)), far, 0.25])

    def lay_rug(self) -> None:
        """Add a round or rectangular rug near the middle."""
        room, rng = self.room, self.rng
        x, z = room.centre + rng.uniform(-0.3, 0.3, 2)
        half = (room.upper - room.lower) * rng.uniform(0.2, 0.32, 2)
        finish = self.palette.finish("cloth")
        if rng.random() < 0.35:
            self.parts.append(tube((x, -0.006, z), float(half.min()), 0.007, finish))
        else:
            self.parts.append(box((x, -0.006, z), (half[0], 0.007, half[1]), finish, yaw=float(rng.normal(0, 0.1))))

    def hang_window(self) -> None:
        """Add a window with a frame, sometimes with curtains, and its daylight."""
        rng, palette = self.rng, self.palette
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
            spot, yaw = self._at_wall(piece.width, 0.006)
            if self._try_place(piece, spot, yaw, bottom=sill):
                position = np.array([spot[0], -sill - h, spot[1]]) + 0.35 * np.array([np.sin(yaw), 0.0, np.cos(yaw)])
                if len(self.lights) < LIGHTS:
                    power = 0.55 * float(rng.uniform(*self.room.style.brightness))
                    reach = 0.45 * float((self.room.upper - self.room.lower).mean())
                    self.lights.append([*position, *np.array([0.88, 0.97, 1.15]) * power, reach, 0.5])
                return

    def hang_picture(self) -> None:
        """Add a framed picture, or a clock."""
        rng, palette = self.rng, self.palette
        if rng.random() < 0.15:
            round_ = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
            face = tube((0, -0.16, 0.02), 0.16, 0.02, palette.finish("ceiling"), axes=round_)
            piece = Piece("clock", [face], 0.34, 0.045, 0.33)
        else:
            w, h = rng.uniform(0.15, 0.5), rng.uniform(0.15, 0.35)
            parts = [
                box((0, -h, 0.012), (w, h, 0.01), palette.finish("wood")),
                box((0, -h, 0.022), (w - 0.03, h - 0.03, 0.008), palette.picture("painting", "paint", 2 * h)),
            ]
            piece = Piece("picture", parts, 2 * w, 0.04, 2 * h)
        for _ in range(6):
            spot, yaw = self._at_wall(piece.width, 0.006)
            if self._try_place(piece, spot, yaw, bottom=float(rng.uniform(1.3, 1.6))):
                return

    def _at_wall(self, width: float, gap: float = _FROM_WALL) -> tuple[Array, float]:
        """A position at a wall and the yaw that faces away from it."""
        room, rng = self.room, self.rng
        axis, sign = int(rng.integers(2)), int(rng.choice([-1, 1]))
        along = 1 - axis
        wall = room.upper[axis] - gap if sign > 0 else room.lower[axis] + gap
        low, high = room.lower[along] + width / 2 + 0.03, room.upper[along] - width / 2 - 0.03
        inward = on_plan(axis, -sign, 0)
        coordinate = rng.uniform(low, high) if low < high else room.centre[along]
        return on_plan(axis, wall, coordinate), float(np.arctan2(inward[0], inward[1]))

    def _try_place(
        self,
        piece: Piece,
        spot: Array,
        yaw: float,
        scale: float = 1.0,
        ignore: Array | None = None,
        bottom: float = 0.0,
    ) -> bool:
        """Add a piece and return True if it fits; overlap with the space ``ignore`` is allowed."""
        room, R = self.room, rotation(1, yaw)
        corners = np.array([[x, z] for x in (-piece.width / 2, piece.width / 2) for z in (0, piece.depth)]) * scale
        ground = corners @ R[np.ix_([0, 2], [0, 2])].T + spot
        low, high = ground.min(0), ground.max(0)
        space = np.array([[low[0], -bottom - piece.height * scale, low[1]], [high[0], -bottom, high[1]]])
        if (low < room.lower + 0.005).any() or (high > room.upper - 0.005).any():
            return False
        if -space[0, 1] > room.height - 0.08 or (bottom < OVERHEAD and self._to_way(low, high) < CLEARANCE):
            return False
        for other in self.occupied:
            if other is not ignore and (space[0] < other[1] + 0.02).all() and (space[1] > other[0] - 0.02).all():
                return False
        self.occupied.append(space)
        base = np.array([spot[0], -bottom, spot[1]])
        for p in piece.parts:
            centre, axes = base + R @ (p.centre * scale), R @ p.rotation
            self.parts.append(replace(p, centre=centre, half=p.half * scale, rotation=axes, label=piece.name))
        return True

    def _to_way(self, low: Array, high: Array) -> float:
        """Distance from a rectangle to the nearest point of the ways [m]."""
        outside = np.maximum(np.maximum(low - self.way, self.way - high), 0)
        return float(np.linalg.norm(outside, axis=1).min(initial=np.inf))

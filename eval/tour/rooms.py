"""The plan of a tour: rooms as rectangles side by side, a doorway from each to an earlier one, and their shells."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ufmstar_torch.eval.tour.palette import Palette
from ufmstar_torch.eval.tour.shapes import BOX, QUAD, Finish, Part, part
from ufmstar_torch.eval.tour.style import TourStyle

Array = NDArray[np.float64]

# Walls and floors overlap by this at their edges, so that no ray passes between them [m].
_OVERLAP = 0.02
_CORNER_TO_DOOR = 0.8  # smallest distance between a room's corner and the middle of a doorway [m]
_DOOR_TO_DOOR = 1.5  # smallest distance between the middles of two doorways of one wall [m]
_TRIES = 400


@dataclass(frozen=True, eq=False)
class Room:
    """A rectangle of floor with walls up to a ceiling."""

    lower: Array  # [2] x and z of its corners [m]
    upper: Array
    height: float  # of the ceiling [m]
    style: TourStyle  # of the furniture

    @property
    def centre(self) -> Array:
        """[2] x and z [m]."""
        return (self.lower + self.upper) / 2

    @property
    def box(self) -> Array:
        """[2, 3] lower and upper corner, y from the ceiling to 0 [m]."""
        return np.array([[self.lower[0], -self.height, self.lower[1]], [self.upper[0], 0.0, self.upper[1]]])


@dataclass(frozen=True, eq=False)
class Door:
    """An opening in the wall between two rooms."""

    rooms: tuple[int, int]  # the earlier and the later room
    middle: Array  # [2] x and z of its middle, halfway through the wall [m]
    normal: Array  # [2] unit vector from the earlier into the later room
    width: float  # of the opening [m]
    height: float
    thickness: float  # of the wall [m]

    @property
    def along(self) -> Array:
        """[2] unit vector along the wall, towards larger coordinates."""
        return np.abs(self.normal[::-1])

    def box(self, sideways: float, through: float, above: float, below: float) -> Array:
        """[2, 3] lower and upper corner of a box around the opening: ``through`` to either side of the wall's middle,
        and larger than the opening ``sideways``, ``above`` and ``below`` by these margins [m]."""
        across = self.along * (self.width / 2 + sideways) + np.abs(self.normal) * through
        low, high = self.middle - across, self.middle + across
        return np.array([[low[0], -self.height - above, low[1]], [high[0], below, high[1]]])


def on_plan(axis: int, across: float, along: float) -> Array:
    """[2] x and z of a point from its coordinates across a wall, on an axis (0 = x, 1 = z), and along it."""
    return np.array([across, along] if axis == 0 else [along, across], dtype=np.float64)


def lay_out(style: TourStyle, rng: np.random.Generator) -> tuple[list[Room], list[Door]]:
    """Draw random rooms; door i joins room i + 1 to an earlier one."""
    count = int(rng.integers(style.rooms[0], style.rooms[1] + 1))
    styles = [style] * (count - 1) + [style.last or style]
    rooms = [_room(styles[0], rng)]
    doors: list[Door] = []
    for room_style in styles[1:]:
        new = _room(room_style, rng)
        for _ in range(_TRIES):
            parent = len(rooms) - 1 if rng.random() < 0.75 or room_style is not style else int(rng.integers(len(rooms)))
            if (attached := _attach(rooms, doors, parent, new, rng)) is not None:
                rooms.append(attached[0])
                doors.append(attached[1])
                break
        else:
            return lay_out(style, rng)
    return rooms, doors


def _room(style: TourStyle, rng: np.random.Generator) -> Room:
    size = rng.uniform(style.room_size[0], style.room_size[1], size=2)
    if style.length is not None:
        size[1] = size[0] * rng.uniform(*style.length)
    return Room(np.zeros(2), size, float(rng.uniform(*style.ceiling)), style)


def _attach(
    rooms: list[Room], doors: list[Door], parent: int, new: Room, rng: np.random.Generator
) -> tuple[Room, Door] | None:
    """The new room moved to a wall of its parent, with a doorway; None if it does not fit."""
    old, size = rooms[parent], new.upper - new.lower
    axis, sign = int(rng.integers(2)), int(rng.choice([-1, 1]))
    thickness, width = float(rng.uniform(0.12, 0.22)), float(rng.uniform(1.0, 1.25))
    along = 1 - axis
    wall = old.upper[axis] if sign > 0 else old.lower[axis]
    centre = rng.uniform(old.lower[along] + _CORNER_TO_DOOR, old.upper[along] - _CORNER_TO_DOOR)
    start = centre - rng.uniform(_CORNER_TO_DOOR, size[along] - _CORNER_TO_DOOR)
    middle = on_plan(axis, wall + sign * thickness / 2, centre)
    lower = on_plan(axis, wall + thickness if sign > 0 else wall - thickness - size[axis], start)
    room = Room(lower, lower + size, new.height, new.style)
    for other in rooms:
        if (room.lower < other.upper + 0.1).all() and (room.upper > other.lower - 0.1).all():
            return None
    for door in doors:
        if parent in door.rooms and np.linalg.norm(door.middle - middle) < _DOOR_TO_DOOR:
            return None
    height = min(old.height, new.height, 2.3) - float(rng.uniform(0.15, 0.3))
    return room, Door((parent, len(rooms)), middle, on_plan(axis, sign, 0), width, height, thickness)


def shell(room: Room, doors: list[Door], palette: Palette) -> Iterator[Part]:
    """Floor, ceiling, walls around the openings of the room's doors, and skirting boards."""
    x, z = room.centre
    half = (room.upper - room.lower) / 2 + _OVERLAP
    yield part(QUAD, (x, 0, z), (half[0], 1, half[1]), palette.finish("floor"), label="floor")
    over, ceiling = np.diag([1.0, -1.0, -1.0]), palette.finish("ceiling")
    if not room.style.outdoors:
        yield part(QUAD, (x, -room.height, z), (half[0], 1, half[1]), ceiling, over, label="ceiling")
    usual, special, board = palette.finish("wall"), palette.finish("wall"), palette.finish("paint")
    accent = int(room.lower.sum() * 1000) % 4
    for number, (axis, sign) in enumerate(((0, -1), (0, 1), (1, -1), (1, 1))):
        finish = special if number == accent else usual
        yield from _wall(room, axis, sign, doors, finish, board)


def _wall(room: Room, axis: int, sign: int, doors: list[Door], finish: Finish, board: Finish) -> Iterator[Part]:
    along = 1 - axis
    wall = float(room.upper[axis] if sign > 0 else room.lower[axis])
    openings = []  # of the doorways in this wall: start, end and height [m]
    for door in doors:
        if abs(door.normal[axis]) > 0.5 and abs(door.middle[axis] - wall) < door.thickness:
            s = float(door.middle[along])
            openings.append((s - door.width / 2, s + door.width / 2, door.height))

    def spot(across: float, y: float, on: float) -> Array:
        return np.insert(on_plan(axis, across, on), 1, y)

    inward = spot(-sign, 0, 0)
    y_axis, z_axis = -inward, np.array([0.0, 1.0, 0.0])
    R = np.stack([np.cross(y_axis, z_axis), y_axis, z_axis], axis=1)

    def rectangle(start: float, end: float, top: float, bottom: float) -> Part:
        centre = spot(wall, (top + bottom) / 2, (start + end) / 2)
        return part(QUAD, centre, ((end - start) / 2, 1, (bottom - top) / 2), finish, R, label=f"wall {axis}{sign}")

    def skirting(start: float, end: float) -> Part:
        centre, half = spot(wall, -0.04, (start + end) / 2), spot(0.012, 0.045, (end - start) / 2)
        return part(BOX, centre, half, board, label="skirting")

    top, position = -room.height - _OVERLAP, float(room.lower[along]) - _OVERLAP
    for start, end, height in sorted(openings):
        yield rectangle(position, start, top, _OVERLAP)
        yield skirting(position, start)
        yield rectangle(start, end, top, -height)
        position = end
    yield rectangle(position, float(room.upper[along]) + _OVERLAP, top, _OVERLAP)
    yield skirting(position, float(room.upper[along]) + _OVERLAP)


def frame(door: Door, finish: Finish) -> Iterator[Part]:
    """Jambs, head and threshold of a doorway, through the whole wall."""
    n, a = np.abs(door.normal), door.along
    through = door.thickness / 2 + 0.015

    def piece(offset: float, y: float, half_along: float, half_y: float, half_through: float) -> Part:
        centre, half = door.middle + a * offset, a * half_along + n * half_through
        return part(BOX, (centre[0], y, centre[1]), (half[0], half_y, half[1]), finish, label="door")

    for side in (-1, 1):
        yield piece(side * (door.width / 2 + 0.015), -door.height / 2, 0.035, door.height / 2 + 0.03, through)
    yield piece(0.0, -door.height - 0.015, door.width / 2 + 0.05, 0.035, through)
    yield piece(0.0, 0.005, door.width / 2, 0.013, through - 0.005)

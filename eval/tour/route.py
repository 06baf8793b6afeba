"""Ways through a tour's rooms: around every room, through the doorways, and back.

A way is a uniform cubic B-spline, which stays within the hull of four consecutive control points. In a room these are
on an ellipse around its middle, in a doorway on its axis, so the way is clear of the walls by construction. Furniture
is placed clear of all ways (see ``furnish``).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ufmstar_torch.eval.tour.rooms import Door, Room

Array = NDArray[np.float64]

SPACING = 0.02  # of the samples of a way [m]
_WALL_TO_RING = 1.25  # distance of the ellipse from the walls, if the room is large enough [m]
_SMALLEST, _LARGEST = (
    0.35,
    0.6,
)  # limits of the ellipse's half axes: smallest [m], largest as a share of the room's half
_RING_STEP = np.radians(30.0)


def ways(rooms: list[Room], doors: list[Door]) -> tuple[Array, ...]:
    """All ways [M, 2] of x and z [m], ``SPACING`` apart, closed (the first point follows the last).

    Way 2 k + 1 goes around in each of the rooms 0 to k and returns; way 2 k uses the shorter side of the ellipse of
    every room that it passes through. The last way has the most views.
    """
    routes = []
    for last in range(len(rooms)):
        for full in (False, True):
            routes.append(_sampled(np.array(_circuit(rooms[: last + 1], doors[:last], full))))
    return tuple(routes)


def drive(room: Room) -> Array:
    """[M, 2] x and z of the straight line along a long room's axis [m], ``SPACING`` apart."""
    start = room.lower[1] + _WALL_TO_RING
    z = np.arange(start, room.upper[1] - _WALL_TO_RING, SPACING)
    return np.stack([np.full(len(z), room.centre[0]), z], axis=1)


def ring_radii(room: Room) -> Array:
    """[2] half axes of the ellipse on which the camera goes around in a room [m]."""
    half = (room.upper - room.lower) / 2
    return np.minimum(np.maximum(half - _WALL_TO_RING, _SMALLEST), _LARGEST * half)


def _circuit(rooms: list[Room], doors: list[Door], full: bool) -> list[Array]:
    points: list[Array] = []

    def visit(index: int, entrance: Door | None) -> None:
        room, children = rooms[index], [(i + 1, door) for i, door in enumerate(doors) if door.rooms[0] == index]
        first = entrance or (children[0][1] if children else None)
        start = 0.0 if first is None else _angle(room, first.middle)
        if entrance is None:
            start += np.pi  # begin at the far side, so that the camera sees the first room before the others
        angle = start
        if entrance is not None:
            points.extend(_through(entrance, inward=True))
        for child, door in children:
            angle = _go_round(points, room, angle, _angle(room, door.middle), full)
            points.extend(_through(door, inward=True)[:2])
            visit(child, door)
            points.extend(_through(door, inward=False)[-2:])
        _go_round(points, room, angle, start, full or not children)
        if entrance is not None:
            points.extend(_through(entrance, inward=False))

    visit(0, None)
    return points


def _through(door: Door, inward: bool) -> list[Array]:
    """Points on the axis of a doorway."""
    offsets = (-0.75, -0.35, 0.0, 0.35, 0.75)
    points = [door.middle + door.normal * offset for offset in offsets]
    return points if inward else points[::-1]


def _angle(room: Room, point: Array) -> float:
    """The parameter of a room's ellipse in the direction of a point."""
    x, z = (point - room.centre) / ring_radii(room)
    return float(np.arctan2(z, x))


def _go_round(points: list[Array], room: Room, start: float, end: float, full: bool) -> float:
    """Append points of a room's ellipse from one parameter to another, on the longer side if ``full``."""
    turn = (end - start + np.pi) % (2 * np.pi) - np.pi
    if full:
        turn += -2 * np.pi if turn > 0 else 2 * np.pi
        if abs(turn) < np.pi:
            turn += np.sign(turn) * 2 * np.pi
    steps = max(int(np.ceil(abs(turn) / _RING_STEP)), 1)
    for angle in start + turn * np.arange(steps + 1) / steps:
        points.append(room.centre + ring_radii(room) * np.array([np.cos(angle), np.sin(angle)]))
    return end


def _sampled(points: Array) -> Array:
    """Equally spaced samples of the closed B-spline with these control points."""
    t = np.linspace(0, 1, 64, endpoint=False)[:, None]
    weights = np.stack([(1 - t) ** 3, 3 * t**3 - 6 * t**2 + 4, -3 * t**3 + 3 * t**2 + 3 * t + 1, t**3]) / 6
    corners = np.stack([np.roll(points, -k, axis=0) for k in range(4)])  # [4, P, 2]
    dense = (weights[:, None] * corners[:, :, None]).sum(0).reshape(-1, 2)
    closed = np.concatenate([dense, dense[:1]])
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(closed, axis=0), axis=1))])
    count = max(round(float(length[-1]) / SPACING), 8)
    s = length[-1] * np.arange(count) / count
    return np.stack([np.interp(s, length, closed[:, k]) for k in (0, 1)], axis=1)

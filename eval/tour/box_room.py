"""A rendered room with known answers: boxes in a larger box, exact depth and poses, smooth flicker.

It stands in for a recorded sequence where none is at hand, above all in the benchmark: as many frames of
any size as asked for, the same ones everywhere for the same seed, with a loop that comes back to where it was.
World axes as a level camera's: x right, y down, z forward [m].
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ufmstar_torch.eval.tour.shapes import tilt, turn

Array = NDArray[np.float64]

# Nearer than this a box is rendered over the whole image instead of its projected outline, which needs
# all corners in front of the camera [m].
_IN_FRONT = 1e-3


@dataclass(frozen=True, eq=False)
class BoxRoom:
    """Axis-aligned boxes inside an axis-aligned box, seen from within."""

    walls: Array  # [2, 3] lower and upper corner of the room [m]
    boxes: Array  # [N, 2, 3] the same of the things in it

    @classmethod
    def furnished(cls, boxes: int = 60, seed: int = 0) -> BoxRoom:
        """A room of 7 x 2.8 x 7 m whose floor and walls are lined with boxes; the middle stays free to walk. Raises
        ValueError: a negative number of boxes."""
        if boxes < 0:
            raise ValueError(f"boxes must not be negative, got {boxes}")
        rng = np.random.default_rng(seed)
        walls = np.array([[-3.5, -1.4, -3.5], [3.5, 1.4, 3.5]])
        angle = rng.uniform(0, 2 * np.pi, boxes)
        distance = rng.uniform(2.3, 3.3, boxes)
        size = rng.uniform((0.25, 0.2, 0.25), (0.9, 1.1, 0.9), (boxes, 3))
        centre = np.stack([distance * np.sin(angle), np.zeros(boxes), distance * np.cos(angle)], axis=1)
        standing = rng.random(boxes) < 0.6
        on_floor = walls[1, 1] - size[:, 1] / 2
        centre[:, 1] = np.where(standing, on_floor, rng.uniform(-1.0, 0.6, boxes))  # the others hang as shelves do
        return cls(walls, np.stack([centre - size / 2, centre + size / 2], axis=1))


def intrinsics(height: int, width: int, fov_degrees: float = 70.0) -> Array:
    """[3, 3] a centred pinhole camera [px] with the given horizontal field of view."""
    f = 0.5 * width / np.tan(np.radians(fov_degrees) / 2)
    return np.array([[f, 0.0, (width - 1) / 2], [0.0, f, (height - 1) / 2], [0.0, 0.0, 1.0]])


def look(position: tuple[float, float, float], yaw: float, pitch: float = 0.0) -> Array:
    """[4, 4] camera-to-world pose; yaw turns right about the vertical axis, pitch looks down [rad]."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = turn(yaw) @ tilt(pitch), position
    return T


def walk(frames: int, period: int = 100) -> Iterator[Array]:
    """Poses [4, 4] of a camera that goes round in the middle of the room and looks outwards.

    One turn takes ``period`` frames. Radius, height, yaw and pitch sway at rates that are no multiples of
    the turn, so every place is seen again but no view comes back exactly.

    Raises:
        ValueError: ``period`` is not positive.
    """
    if period < 1:
        raise ValueError(f"period must be at least 1 frame, got {period}")
    for i in range(frames):
        turn = 2 * np.pi * i / period
        radius = 0.6 + 0.25 * np.sin(0.23 * turn)
        position = (radius * np.sin(turn), 0.15 * np.sin(0.31 * turn), radius * np.cos(turn))
        yield look(position, turn + 0.3 * np.sin(0.37 * turn), 0.12 + 0.08 * np.sin(0.71 * turn))


def render(room: BoxRoom, T_world_cam: Array, K: Array, height: int, width: int) -> Array:
    """Exact depth [height, width] along the optical axis [m] of the room, from a camera inside it. Raises ValueError:
    the camera stands outside the room or inside a box."""
    origin = T_world_cam[:3, 3]
    inside = ((room.boxes[:, 0] < origin) & (origin < room.boxes[:, 1])).all(-1)
    if not ((room.walls[0] < origin) & (origin < room.walls[1])).all() or inside.any():
        raise ValueError(f"the camera must stand inside the room and outside its boxes, got position {origin}")
    v, u = np.mgrid[0:height, 0:width].astype(np.float64)
    rays = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones_like(u)], axis=-1)
    directions = rays @ T_world_cam[:3, :3].T  # ray_z = 1, so the ray parameter is the depth
    depth = _entry_exit(origin, directions, room.walls)[1]
    for box in room.boxes:
        window = _window(box, T_world_cam, K, height, width)
        near, far = _entry_exit(origin, directions[window], box)
        part = depth[window]
        depth[window] = np.where((near < far) & (near > 0) & (near < part), near, part)
    return depth


def flicker(depth: Array, amount: float, rng: np.random.Generator) -> Array:
    """What a network makes of a depth map [H, W] [m]: a smooth random relative error of standard deviation ``amount``,
    new in every frame."""
    height, width = depth.shape
    y, x = np.linspace(0, 1, height)[:, None], np.linspace(0, 1, width)[None]
    a, b, c = rng.normal(size=3)
    p, q = rng.uniform(0, 2 * np.pi, 2)
    # Variances: 1/2 of the shift, 1/4 of each wave of amplitude 1/sqrt(2).
    field = a / np.sqrt(2) + (b * np.sin(2 * np.pi * x + p) + c * np.sin(2 * np.pi * y + q)) / np.sqrt(2)
    return depth * (1 + amount * field)


def _entry_exit(origin: Array, directions: Array, box: Array) -> tuple[Array, Array]:
    """Ray parameters at which rays [..., 3] enter and leave a box [2, 3]; entry > exit where they miss it."""
    # A ray parallel to a face divides by zero: the infinities compare correctly, and 0/0 = NaN (a ray
    # within the face's plane) is left to the other axes by fmax and fmin.
    with np.errstate(divide="ignore", invalid="ignore"):
        a, b = (box[0] - origin) / directions, (box[1] - origin) / directions
    near, far = np.fmin(a, b), np.fmax(a, b)
    return (
        np.fmax(np.fmax(near[..., 0], near[..., 1]), near[..., 2]),
        np.fmin(np.fmin(far[..., 0], far[..., 1]), far[..., 2]),
    )


def _window(box: Array, T_world_cam: Array, K: Array, height: int, width: int) -> tuple[slice, slice]:
    """The rows and columns that a box can touch: everything it could hide lies within its corners' outline."""
    corners = np.stack(np.meshgrid(*box.T), axis=-1).reshape(8, 3)
    x, y, z = ((corners - T_world_cam[:3, 3]) @ T_world_cam[:3, :3]).T
    if (z < -_IN_FRONT).all():
        return slice(0, 0), slice(0, 0)
    if (z < _IN_FRONT).any():
        return slice(0, height), slice(0, width)
    u, v = K[0, 0] * x / z + K[0, 2], K[1, 1] * y / z + K[1, 2]

    def span(values: Array, size: int) -> slice:
        low, high = np.clip([np.floor(values.min()), np.ceil(values.max()) + 1], 0, size).astype(int)
        return slice(int(low), int(high))

    return span(v, height), span(u, width)

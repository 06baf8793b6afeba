"""Things that move through a tour: persons, carts and toys that cross the camera's way, walk along, approach or leave.

A thing's position is its foot, the middle of its base on the floor. Things move without turning, touch nothing that
stands, and stay clear of the camera.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ufmstar_torch.eval.tour.furniture import Piece
from ufmstar_torch.eval.tour.palette import Palette
from ufmstar_torch.eval.tour.shapes import NOBODY, Surfaces, ball, box, rotation, surfaces, tube
from ufmstar_torch.eval.tour.style import style_of
from ufmstar_torch.eval.tour.tour import Tour
from ufmstar_torch.eval.tour.view import cast

Array = NDArray[np.float64]

SIZES = ("person", "cart", "toy")
# A thing that walks along is displaced by this share of the camera's displacement.
SHARES = {"along, half": 0.5, "along, equal": 1.0, "along, faster": 1.5}
MOTIONS = ("across", *SHARES, "towards", "away")
_REACH = 15  # frames for which a thing moves before and after its middle frame, at most
_TRIES, _ENOUGH = 60, 12  # random paths of a thing; frames in view after which no other one is tried
_SLOWEST, _FASTEST = 0.3, 1.0  # speed across, towards and away, over the camera's mean speed
_LEAST_STEP = 0.02  # mean step of a camera that hardly moves [m per frame]
_NEAREST, _FARTHEST = 1.2, 3.5  # distance from the camera in the middle frame [m]
_CLEAR = 0.6  # smallest distance between a thing's side and the camera [m]
_BASE = 0.05  # objects on the floor up to this height are no obstacle (rugs) [m]
_COARSE = (24, 32)  # size of the images in which a thing's visibility is tested [px]


@dataclass(frozen=True, eq=False)
class Mover:
    """A thing that moves."""

    size: str  # one of ``SIZES``
    motion: str  # one of ``MOTIONS``
    surfaces: Surfaces  # its primitives about its foot
    start: int  # first frame in which it exists
    position: Array  # [n, 3] of its foot in n successive frames [m]
    room: NDArray[np.int64]  # [n] the room that lights it


def make_movers(tour: Tour, poses: Tensor, K: Tensor, size: tuple[int, int], count: int) -> tuple[Mover, ...]:
    """``count`` things on paths before the camera, spread over its frames: each size and each motion as often as the
    others. The seed of the tour determines them. Where no path in free space comes into view, a thing is missing.

    Args:
        tour: the rooms.
        poses: [N, 4, 4] float64 camera-to-world [m].
        K: [3, 3] [px].
        size: (H, W) of the images [px].
        count: at least 0.
    """
    scout = _Scout(tour, poses.numpy(), K, size)
    movers = []
    for k in range(count):
        rng = np.random.default_rng([tour.seed, 103, k])
        order = np.random.default_rng([tour.seed, 104, k // len(MOTIONS)])
        motion = MOTIONS[int(order.permutation(len(MOTIONS))[k % len(MOTIONS)])]
        kind = SIZES[int(order.permutation(len(MOTIONS))[k % len(MOTIONS)]) % len(SIZES)]
        middle = int(len(poses) * (k + 0.5) / count)
        thing = _MAKERS[kind](rng, Palette(style_of(scout.style(middle)), rng))
        best = max(scout.paths(thing, motion, middle, count, rng), key=lambda path: path[0], default=None)
        if best is not None and best[0]:
            table = surfaces(thing.parts, rng)
            movers.append(Mover(kind, motion, table, best[1], best[2], scout.rooms(best[2])))
    return tuple(movers)


def with_movers(tour: Tour, movers: tuple[Mover, ...], index: int) -> Tour:
    """The tour at a frame: the things that exist there are its last primitives."""
    tables = [tour.surfaces]
    for mover in movers:
        n = index - mover.start
        if 0 <= n < len(mover.position):
            shift = torch.from_numpy(mover.position[n])
            s = mover.surfaces
            room = torch.tensor([int(mover.room[n]), NOBODY]).expand(len(s.kind), 2)
            tables.append(replace(s, centre=s.centre + shift, corners=s.corners + shift, rooms=room))
    if len(tables) == 1:
        return tour
    joined = {name: torch.cat([getattr(t, name) for t in tables]) for name in Surfaces.__dataclass_fields__}
    return replace(tour, surfaces=Surfaces(**joined))


class _Scout:
    """Finds paths in free space that a camera sees."""

    def __init__(self, tour: Tour, poses: Array, K: Tensor, size: tuple[int, int]) -> None:
        self._tour, self._poses, self._camera = tour, poses, poses[:, :3, 3]
        scale = torch.tensor([_COARSE[1] / size[1], _COARSE[0] / size[0], 1.0], dtype=torch.float64)
        self._K = K * scale[:, None]
        self._depths: dict[int, Array] = {}
        corners = tour.surfaces.corners
        self._lower, self._upper = corners.amin(1).numpy(), corners.amax(1).numpy()
        moved = np.linalg.norm(np.diff(self._camera[:, ::2], axis=0), axis=1)
        self._step = max(float(moved.mean()) if len(moved) else 0.0, _LEAST_STEP)

    def rooms(self, position: Array) -> NDArray[np.int64]:
        """[n] the rooms that contain positions [n, 3], or the nearest ones."""
        boxes = self._tour.rooms.numpy()
        beyond = np.maximum(boxes[:, 0] - position[:, None], position[:, None] - boxes[:, 1]).clip(0)
        return np.square(beyond[..., ::2]).sum(-1).argmin(-1)

    def style(self, index: int) -> str:
        """The style of the room of a camera."""
        return self._tour.room_styles[int(self.rooms(self._camera[[index]])[0])]

    def paths(
        self, thing: Piece, motion: str, middle: int, count: int, rng: np.random.Generator
    ) -> list[tuple[int, int, Array]]:
        """Random paths until one is in view long enough: frames in view, first frame, positions [n, 3]."""
        found: list[tuple[int, int, Array]] = []
        jitter = len(self._poses) // (2 * count)
        for _ in range(_TRIES):
            at = int(np.clip(middle + rng.integers(-jitter, jitter + 1), 0, len(self._poses) - 1))
            start, position = self._free(thing, self._path(motion, at, rng), at)
            if len(position):
                found.append((self._in_view(thing, start, position), start, position))
                if found[-1][0] >= _ENOUGH:
                    break
        return found

    def _path(self, motion: str, at: int, rng: np.random.Generator) -> Array:
        """[N, 3] positions in all frames; in frame ``at`` in front of the camera."""
        forward = self._poses[at, :3, 2] * [1, 0, 1]
        forward /= np.linalg.norm(forward)
        right = np.array([forward[2], 0.0, -forward[0]])
        away = rng.uniform(_NEAREST, _FARTHEST) * forward + rng.uniform(-0.8, 0.8) * right
        foot = self._camera[at] * [1, 0, 1] + away
        speed, side = self._step * rng.uniform(_SLOWEST, _FASTEST), rng.choice([-1.0, 1.0])
        if motion in SHARES:
            return foot + SHARES[motion] * (self._camera - self._camera[at]) * [1, 0, 1]
        away /= np.linalg.norm(away)
        direction = {"across": side * right, "towards": -away, "away": away}[motion]
        return foot + speed * (np.arange(len(self._poses)) - at)[:, None] * direction

    def _free(self, thing: Piece, path: Array, at: int) -> tuple[int, Array]:
        """The part of a path around frame ``at`` where the thing is clear of camera, walls and furniture."""
        first, last = max(at - _REACH, 0), min(at + _REACH, len(path) - 1)
        path = path[first : last + 1]
        half = np.array([thing.width / 2, 0.0, thing.depth / 2])
        low, high = path - half - [0, thing.height, 0], path + half - [0, _BASE, 0]
        touches = np.any(np.all((low[:, None] < self._upper) & (high[:, None] > self._lower), -1), 1)
        camera = self._camera[first : last + 1]
        gap = np.maximum(np.maximum(low - camera, camera - high), 0)[:, ::2]
        boxes = torch.cat([self._tour.rooms, self._tour.doors]).numpy()
        within = (boxes[:, 0] < path[:, None]) & (path[:, None] < boxes[:, 1])
        inside = np.any(np.all(within[..., ::2], -1), 1)
        blocked = touches | ~inside | (np.linalg.norm(gap, axis=1) < _CLEAR)
        before, after = np.flatnonzero(blocked[: at - first + 1]), np.flatnonzero(blocked[at - first :])
        start = int(before[-1]) + 1 if len(before) else 0
        end = at - first + int(after[0]) if len(after) else len(path)
        return first + start, path[start:end]

    def _in_view(self, thing: Piece, start: int, position: Array) -> int:
        """Number of frames in which the camera sees the thing's middle."""
        return sum(self._sees(start + n, p - [0, thing.height / 2, 0]) for n, p in enumerate(position))

    def _sees(self, index: int, point: Array) -> bool:
        T, K = self._poses[index], self._K.numpy()
        x, y, z = K @ (T[:3, :3].T @ (point - T[:3, 3]))
        if z <= 0:
            return False
        u, v = int(np.floor(x / z + 0.5)), int(np.floor(y / z + 0.5))
        if not (0 <= u < _COARSE[1] and 0 <= v < _COARSE[0]):
            return False
        if index not in self._depths:
            self._depths[index] = cast(self._tour, torch.from_numpy(T), self._K, *_COARSE)[0].numpy()
        return bool(z < self._depths[index][v, u])


def _person(rng: np.random.Generator, palette: Palette) -> Piece:
    """Two legs, a body and a head."""
    height = rng.uniform(1.55, 1.85)
    legs, shirt, yaw = palette.patterned(), palette.patterned(), float(rng.uniform(-0.6, 0.6))
    hip = np.array([0.1 * np.cos(yaw), 0.0, -0.1 * np.sin(yaw)])
    parts = [tube(side * hip - [0, 0.235 * height, 0], 0.09, 0.235 * height, legs, 1.2) for side in (-1, 1)]
    parts.append(box((0, -0.65 * height, 0), (0.23, 0.19 * height, 0.13), shirt, yaw))
    parts.append(ball((0, -0.92 * height, 0), (0.09, 0.08 * height, 0.1), palette.patterned()))
    return Piece("person", parts, 0.52, 0.52, height)


def _cart(rng: np.random.Generator, palette: Palette) -> Piece:
    """A loaded box on wheels with a handle."""
    w, d, h = rng.uniform(0.22, 0.32), rng.uniform(0.25, 0.4), rng.uniform(0.3, 0.45)
    body, load, wheel = palette.patterned(), palette.patterned(), palette.finish("metal")
    lying = rotation(2, np.pi / 2)
    parts = [tube((x * w, -0.1, z * d * 0.7), 0.1, 0.03, wheel, axes=lying) for x in (-1, 1) for z in (-1, 1)]
    parts.append(box((0, -0.15 - h, 0), (w, h, d), body))
    parts.append(box((0, -0.15 - 2 * h - 0.1, -0.2 * d), (0.7 * w, 0.1, 0.6 * d), load, float(rng.uniform(-0.5, 0.5))))
    return Piece("cart", parts, 2 * w + 0.08, 2 * d, 0.35 + 2 * h)


def _toy(rng: np.random.Generator, palette: Palette) -> Piece:
    """A box on wheels or a ball, some 30 cm high."""
    r = float(rng.uniform(0.13, 0.2))
    if rng.random() < 0.4:
        return Piece("toy", [ball((0, -r, 0), (r, r, r), palette.patterned())], 2 * r, 2 * r, 2 * r)
    parts = [box((0, -0.9 * r, 0), (r, 0.8 * r, 1.3 * r), palette.patterned())]
    parts.append(ball((0, -2.1 * r, 0), (0.5 * r, 0.5 * r, 0.5 * r), palette.patterned()))
    return Piece("toy", parts, 2 * r, 2.6 * r, 2.6 * r)


_MAKERS = {"person": _person, "cart": _cart, "toy": _toy}

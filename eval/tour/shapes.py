"""Surfaces of a tour: quads, boxes, ellipsoids and frusta, each an affine image of a unit shape.

In unit coordinates q = diag(1/half) R^T (p - centre), a box is [-1, 1]^3, an ellipsoid the unit ball, and a
frustum stands along y with radius 1 at its foot y = 1 and ``taper`` at its head y = -1 (a cylinder has 1, a cone
nearly 0). A quad is the square |x|, |z| <= 1 of the plane y = 0, seen from y < 0 only. World axes: x right,
y down, z forward [m], the floor at y = 0.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ufmstar_torch.eval.tour.style import TEXTURES

QUAD, BOX, ELLIPSOID, FRUSTUM = range(4)
Array = NDArray[np.float64]
Vector = Sequence[float] | Array
NOBODY = -1


@dataclass(frozen=True)
class Finish:
    """The appearance of a surface: texture and colours."""

    texture: str = "plain"  # one of ``TEXTURES``
    first: tuple[float, float, float] = (0.5, 0.5, 0.5)  # the two colours, linear RGB in [0, 1]
    second: tuple[float, float, float] = (0.3, 0.3, 0.3)
    period: float = 0.3  # of the pattern [m]
    glow: float = 0.0  # emitted light, 0 = none


@dataclass(frozen=True, eq=False)
class Part:
    """One primitive while a tour is built."""

    kind: int  # QUAD, BOX, ELLIPSOID or FRUSTUM
    centre: Array  # [3] [m]
    half: Array  # [3] half extents along its axes [m]; a quad's is (x, 1, z)
    finish: Finish
    rotation: Array  # [3, 3] its axes in the world, as columns
    taper: float = 1.0  # of a frustum
    rooms: tuple[int, int] = (0, NOBODY)  # the one or two rooms from which it is directly visible
    label: str = ""  # name of the piece to which it belongs


@dataclass(frozen=True, eq=False)
class Surfaces:
    """The N primitives of a tour as tensors."""

    kind: Tensor  # [N] int64
    centre: Tensor  # [N, 3] float64 [m]
    half: Tensor  # [N, 3] float64 [m]
    rotation: Tensor  # [N, 3, 3] float64
    taper: Tensor  # [N] float64
    rooms: Tensor  # [N, 2] int64
    texture: Tensor  # [N] int64, index into ``TEXTURES``
    corners: Tensor  # [N, 8, 3] float64 of the boxes around them, by signs along x, y, z as binary digits [m]
    appearance: Tensor  # [N, 10] float32: two colours, period [m], glow, and two random offsets of the pattern [m]


def part(
    kind: int,
    centre: Vector,
    half: Vector,
    finish: Finish,
    axes: Array | None = None,
    taper: float = 1.0,
    label: str = "",
) -> Part:
    """A primitive in the caller's frame."""
    R = np.eye(3) if axes is None else axes
    return Part(kind, np.asarray(centre, np.float64), np.asarray(half, np.float64), finish, R, taper, label=label)


def box(centre: Vector, half: Vector, finish: Finish, yaw: float = 0.0, pitch: float = 0.0) -> Part:
    """A box, turned about the vertical axis by ``yaw`` and then tilted about its x axis by ``pitch`` [rad]."""
    return part(BOX, centre, half, finish, rotation(1, yaw) @ rotation(0, -pitch))


def ball(centre: Vector, half: Vector, finish: Finish, yaw: float = 0.0, roll: float = 0.0) -> Part:
    """An ellipsoid."""
    return part(ELLIPSOID, centre, half, finish, rotation(1, yaw) @ rotation(2, roll))


def tube(
    centre: Vector, radius: float, half_height: float, finish: Finish, taper: float = 1.0, axes: Array | None = None
) -> Part:
    """A frustum on its foot."""
    return part(FRUSTUM, centre, (radius, half_height, radius), finish, axes, taper)


def rotation(axis: int, angle: float) -> Array:
    """[3, 3] rotation about an axis, 0 to 2 for x, y, z, by the right-hand rule [rad]."""
    R, i, j = np.eye(3), (axis + 1) % 3, (axis + 2) % 3
    R[i, i] = R[j, j] = np.cos(angle)
    R[j, i] = np.sin(angle)
    R[i, j] = -R[j, i]
    return R


def surfaces(parts: Sequence[Part], rng: np.random.Generator) -> Surfaces:
    """The tensors of a list of primitives; ``rng`` shifts every pattern by a random offset."""
    offsets = rng.uniform(0.0, 7.0, (len(parts), 2))
    finishes = [p.finish for p in parts]
    appearance = [[*f.first, *f.second, f.period, f.glow, *offset] for f, offset in zip(finishes, offsets, strict=True)]
    return Surfaces(
        kind=torch.tensor([p.kind for p in parts]),
        centre=torch.tensor(np.array([p.centre for p in parts])),
        half=torch.tensor(np.array([p.half for p in parts])),
        rotation=torch.tensor(np.array([p.rotation for p in parts])),
        taper=torch.tensor([p.taper for p in parts], dtype=torch.float64),
        rooms=torch.tensor([p.rooms for p in parts]),
        texture=torch.tensor([TEXTURES.index(finish.texture) for finish in finishes]),
        corners=torch.tensor(np.array([_around(p) for p in parts])),
        appearance=torch.tensor(appearance, dtype=torch.float32),
    )


def _around(p: Part) -> Array:
    """[8, 3] corners of the box around a primitive [m]."""
    signs = np.array([[i >> 2 & 1, i >> 1 & 1, i & 1] for i in range(8)]) * 2.0 - 1.0
    wide = max(p.taper, 1.0)
    half = p.half * [wide, 0.0 if p.kind == QUAD else 1.0, wide]
    corners: Array = p.centre + (signs * half) @ p.rotation.T
    return corners

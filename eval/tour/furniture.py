"""Pieces of furniture as lists of primitives.

A piece stands in its own frame: x along the wall behind it, z away from that wall, from 0 to its depth, y down
with the floor at 0 [m].
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ufmstar_torch.eval.tour.palette import Palette
from ufmstar_torch.eval.tour.shapes import Finish, Part, ball, box, tube


@dataclass(frozen=True, eq=False)
class Piece:
    """A piece of furniture."""

    name: str  # kind
    parts: list[Part]  # primitives
    width: float  # of its space [m]
    depth: float
    height: float


Maker = Callable[[np.random.Generator, Palette], Piece]


def _legs(
    width: float, depth: float, z: float, height: float, thick: float, finish: Finish, round_: bool
) -> list[Part]:
    """Four legs under a rectangle whose middle is at (0, z)."""
    spots = [(sx * (width / 2 - thick), z + sz * (depth / 2 - thick)) for sx in (-1, 1) for sz in (-1, 1)]
    if round_:
        return [tube((x, -height / 2, zz), thick / 2, height / 2, finish, 1.0) for x, zz in spots]
    return [box((x, -height / 2, zz), (thick / 2, height / 2, thick / 2), finish) for x, zz in spots]


def _on_top(rng: np.random.Generator, palette: Palette, width: float, z: float, y: float) -> list[Part]:
    """A few objects on a surface at height -y."""
    things: list[Part] = []
    for slot in np.linspace(-0.3, 0.3, 3):
        x, what = slot * width + rng.uniform(-0.03, 0.03), int(rng.integers(6))
        if what == 0:
            h = rng.uniform(0.08, 0.15)
            things.append(tube((x, y - h, z), 0.07, h, palette.finish("paint"), rng.uniform(0.4, 0.9)))
        elif what == 1:
            r = rng.uniform(0.06, 0.12)
            things.append(ball((x, y - r, z), (r, r, r), palette.finish("paint")))
        elif what == 2:
            half = (0.09, rng.uniform(0.02, 0.06), 0.12)
            things.append(box((x, y - half[1], z), half, palette.finish("cloth"), yaw=rng.uniform(-0.6, 0.6)))
        elif what == 3:
            things.append(tube((x, y - 0.1, z), 0.045, 0.1, palette.finish("paint"), 1.0))
            things.append(ball((x, y - 0.28, z), (0.12, 0.14, 0.12), palette.finish("leaf")))
    return things


def chair(rng: np.random.Generator, palette: Palette) -> Piece:
    """A chair, its back at z = 0."""
    wood, seat = palette.finish("wood"), palette.finish("cloth")
    w, d, h = rng.uniform(0.42, 0.5), rng.uniform(0.42, 0.5), rng.uniform(0.42, 0.48)
    parts = _legs(w, d, d / 2, h, 0.045, wood, bool(rng.random() < 0.4))
    parts.append(box((0, -h, d / 2), (w / 2, 0.03, d / 2), seat))
    back = rng.uniform(0.2, 0.28)
    parts.append(box((0, -h - back, 0.03), (w / 2, back, 0.02), seat if rng.random() < 0.5 else wood, pitch=0.08))
    return Piece("chair", parts, w, d, h + 2 * back)


def _table(rng: np.random.Generator, palette: Palette) -> Piece:
    wood, h = palette.finish("wood"), rng.uniform(0.7, 0.78)
    if rng.random() < 0.4:
        r = rng.uniform(0.4, 0.6)
        parts = [
            tube((0, -h, r), r, 0.02, wood),
            tube((0, -h / 2, r), 0.05, h / 2, wood),
            tube((0, -0.02, r), 0.25, 0.02, wood, 0.6),
        ]
        return Piece("table", [*parts, *_on_top(rng, palette, r * 1.4, r, -h - 0.02)], 2 * r, 2 * r, h)
    w, d = rng.uniform(0.9, 1.5), rng.uniform(0.6, 0.85)
    parts = [box((0, -h, d / 2), (w / 2, 0.02, d / 2), wood)]
    parts += _legs(w, d, d / 2, h, 0.06, wood, bool(rng.random() < 0.5))
    return Piece("table", [*parts, *_on_top(rng, palette, w, d / 2, -h - 0.02)], w, d, h)


def _desk(rng: np.random.Generator, palette: Palette) -> Piece:
    wood, dark = palette.finish("wood"), palette.solid((0.02, 0.02, 0.025))
    w, d, h = rng.uniform(1.1, 1.5), rng.uniform(0.6, 0.75), 0.74
    screen = rng.uniform(0.22, 0.34)
    parts = [
        box((0, -h, d / 2), (w / 2, 0.02, d / 2), wood),
        box((-w / 2 + 0.03, -h / 2, d / 2), (0.02, h / 2, d / 2 - 0.03), wood),
        box((w / 2 - 0.22, -h / 2, d / 2), (0.2, h / 2 - 0.03, d / 2 - 0.05), palette.finish("paint")),
        box((0.1, -h - 0.25, 0.2), (screen, screen * 0.6, 0.015), dark, yaw=rng.uniform(-0.3, 0.3)),
        box((0.1, -h - 0.06, 0.2), (0.03, 0.06, 0.03), dark),
        box((0.05, -h - 0.03, 0.45), (0.2, 0.012, 0.07), palette.finish("metal")),
    ]
    return Piece("desk", parts, w, d, h + 0.5)


def _sofa(rng: np.random.Generator, palette: Palette) -> Piece:
    cloth, w = palette.finish("cloth"), rng.uniform(1.5, 2.0) if rng.random() < 0.65 else rng.uniform(0.8, 0.95)
    d, seat = rng.uniform(0.75, 0.9), rng.uniform(0.36, 0.44)
    parts = [
        box((0, -seat / 2 - 0.03, d / 2), (w / 2 - 0.02, seat / 2 - 0.03, d / 2 - 0.01), cloth),
        box((0, -seat - 0.2, 0.11), (w / 2 - 0.01, 0.22, 0.1), cloth, pitch=0.1),
        box((-w / 2 + 0.08, -seat - 0.08, d / 2), (0.08, 0.12, d / 2), cloth),
        box((w / 2 - 0.08, -seat - 0.08, d / 2), (0.08, 0.12, d / 2), cloth),
    ]
    for x in np.arange(-w / 2 + 0.4, w / 2 - 0.2, 0.6):
        cushion = palette.finish("cloth")
        parts.append(ball((x, -seat - 0.16, 0.3), (0.2, 0.16, 0.09), cushion, yaw=rng.uniform(-0.3, 0.3)))
    return Piece("sofa", parts, w, d, seat + 0.45)


def _bed(rng: np.random.Generator, palette: Palette) -> Piece:
    wood, w, d = palette.finish("wood"), rng.uniform(0.95, 1.5), rng.uniform(1.9, 2.05)
    parts = [
        box((0, -0.14, d / 2), (w / 2, 0.11, d / 2), wood),
        box((0, -0.35, d / 2), (w / 2 - 0.03, 0.11, d / 2 - 0.02), palette.finish("cloth")),
        box((0, -0.42, d * 0.62), (w / 2, 0.06, d * 0.38), palette.finish("cloth")),
        box((0, -0.5, 0.03), (w / 2, 0.45, 0.03), wood),
    ]
    for x in (-w / 4, w / 4):
        parts.append(ball((x, -0.5, 0.3), (w / 5, 0.08, 0.2), palette.finish("cloth"), yaw=rng.uniform(-0.2, 0.2)))
    return Piece("bed", parts, w, d, 0.95)


def _bookshelf(rng: np.random.Generator, palette: Palette) -> Piece:
    wood, w, d = palette.finish("wood"), rng.uniform(0.7, 1.3), rng.uniform(0.26, 0.34)
    rows = int(rng.integers(3, 6))
    h = rows * 0.36 + 0.06
    parts = [box((s * (w / 2 - 0.012), -h / 2, d / 2), (0.012, h / 2, d / 2), wood) for s in (-1, 1)]
    parts.append(box((0, -h / 2, 0.01), (w / 2, h / 2, 0.01), wood))
    for row in range(rows + 1):
        parts.append(box((0, -0.05 - row * 0.36, d / 2), (w / 2 - 0.02, 0.013, d / 2 - 0.004), wood))
    for row in range(rows):
        y = -0.063 - row * 0.36
        if rng.random() < 0.75:
            half, high = rng.uniform(0.5, 0.95) * (w / 2 - 0.03), rng.uniform(0.1, 0.14)
            books = palette.picture("books", "cloth", rng.uniform(0.03, 0.05))
            at = rng.choice([-1, 1]) * (w / 2 - 0.03 - half)
            parts.append(box((at, y - high, d / 2 - 0.03), (half, high, d / 2 - 0.05), books))
        else:
            parts.append(tube((rng.uniform(-0.2, 0.2), y - 0.1, d / 2), 0.08, 0.1, palette.finish("paint"), 0.6))
    return Piece("bookshelf", parts, w, d, h)


def _cabinet(rng: np.random.Generator, palette: Palette) -> Piece:
    body, front, knob = palette.finish("wood"), palette.finish("wood"), palette.finish("metal")
    high = rng.random() < 0.4
    h = rng.uniform(1.7, 2.0) if high else rng.uniform(0.7, 1.0)
    w, d = rng.uniform(0.8, 1.4), rng.uniform(0.38, 0.55)
    parts = [box((0, -h / 2, d / 2), (w / 2, h / 2, d / 2), body)]
    for side in (-1, 1):
        parts.append(box((side * w / 4, -h / 2 - 0.03, d), (w / 4 - 0.02, h / 2 - 0.07, 0.012), front))
        parts.append(ball((side * 0.06, -h * 0.55, d + 0.02), (0.02, 0.02, 0.02), knob))
    if not high:
        parts += _on_top(rng, palette, w, d / 2, -h)
    return Piece("cabinet", parts, w, d + 0.03, h)


def _television(rng: np.random.Generator, palette: Palette) -> Piece:
    dark, w, d, h = palette.solid((0.015, 0.015, 0.02)), rng.uniform(1.2, 1.7), 0.42, 0.45
    half = rng.uniform(0.4, 0.6)
    parts = [
        box((0, -h / 2 - 0.05, d / 2), (w / 2, h / 2 - 0.05, d / 2), palette.finish("wood")),
        box((0, -0.05, d / 2), (w / 2 - 0.1, 0.05, d / 2 - 0.08), dark),
        box((0, -h - 0.08 - half * 0.56, 0.2), (half, half * 0.56, 0.02), dark),
        box((0, -h - 0.04, 0.2), (0.15, 0.05, 0.08), dark),
    ]
    return Piece("television", parts, w, d, h + 1.2 * half)


def _lamp(rng: np.random.Generator, palette: Palette) -> Piece:
    metal, h = palette.finish("metal"), rng.uniform(1.35, 1.65)
    shade = palette.solid((0.9, 0.8, 0.6), 0.9)
    parts = [
        tube((0, -0.015, 0.2), 0.15, 0.015, metal),
        tube((0, -h / 2, 0.2), 0.014, h / 2, metal),
        tube((0, -h - 0.05, 0.2), rng.uniform(0.17, 0.22), rng.uniform(0.12, 0.16), shade, rng.uniform(0.4, 0.9)),
    ]
    return Piece("lamp", parts, 0.44, 0.44, h + 0.2)


def _plant(rng: np.random.Generator, palette: Palette) -> Piece:
    h, leaf = rng.uniform(0.22, 0.34), palette.finish("leaf")
    parts = [tube((0, -h / 2, 0.25), rng.uniform(0.12, 0.16), h / 2, palette.finish("paint"), 1.3)]
    top = h + rng.uniform(0.1, 0.5)
    parts.append(tube((0, -top / 2, 0.25), 0.02, top / 2, palette.finish("wood")))
    for _ in range(4):
        half = rng.uniform((0.1, 0.1, 0.06), (0.2, 0.28, 0.14))
        spot = (rng.uniform(-0.1, 0.1), -top - rng.uniform(0.0, 0.25), 0.25 + rng.uniform(-0.08, 0.08))
        parts.append(ball(spot, half, leaf, yaw=rng.uniform(0, np.pi), roll=rng.uniform(-0.6, 0.6)))
    return Piece("plant", parts, 0.5, 0.5, top + 0.5)


def _stool(rng: np.random.Generator, palette: Palette) -> Piece:
    what, r = int(rng.integers(3)), rng.uniform(0.18, 0.26)
    if what == 0:
        parts = [tube((0, -0.45, r), r, 0.025, palette.finish("wood"))]
        parts += _legs(1.3 * r, 1.3 * r, r, 0.43, 0.035, palette.finish("wood"), True)
    elif what == 1:
        parts = [ball((0, -0.2, r), (r, 0.2, r), palette.finish("cloth"))]
    else:
        parts = [tube((0, -0.17, r), 0.75 * r, 0.17, palette.finish("paint"), 1.3)]
    return Piece("stool", parts, 2 * r, 2 * r, 0.48)


def _crates(rng: np.random.Generator, palette: Palette) -> Piece:
    parts, y = [], 0.0
    for _ in range(int(rng.integers(1, 4))):
        half = rng.uniform((0.14, 0.1, 0.12), (0.24, 0.18, 0.22))
        parts.append(box((0, y - half[1], 0.34), half, palette.finish("wood"), yaw=rng.uniform(-0.7, 0.7)))
        y -= 2 * half[1]
    if rng.random() < 0.5:
        parts.append(ball((0, y - 0.12, 0.34), (0.12, 0.12, 0.12), palette.finish("paint")))
    return Piece("crates", parts, 0.68, 0.68, 0.2 - y)


def _statue(rng: np.random.Generator, palette: Palette) -> Piece:
    parts = [box((0, -0.4, 0.3), (0.2, 0.4, 0.2), palette.finish("paint"))]
    what = int(rng.integers(3))
    if what == 0:
        parts.append(ball((0, -1.05, 0.3), (0.18, 0.26, 0.18), palette.finish("paint")))
    elif what == 1:
        parts.append(tube((0, -1.05, 0.3), 0.2, 0.25, palette.finish("paint"), 0.05))
    else:
        parts.append(box((0, -1.07, 0.3), (0.16, 0.16, 0.16), palette.finish("paint"), yaw=0.5, pitch=0.6))
    return Piece("statue", parts, 0.5, 0.6, 1.35)


def _column(rng: np.random.Generator, palette: Palette) -> Piece:
    finish, r, h = palette.finish("wall"), rng.uniform(0.14, 0.2), 2.05
    parts = [
        box((0, -0.06, 0.3), (r + 0.06, 0.06, r + 0.06), finish),
        tube((0, -h / 2, 0.3), r, h / 2, finish, 0.85),
        box((0, -h, 0.3), (r + 0.06, 0.06, r + 0.06), finish),
    ]
    return Piece("column", parts, 0.6, 0.6, h + 0.06)


AT_WALLS: tuple[Maker, ...] = (
    _sofa, _bookshelf, _cabinet, _cabinet, _desk, _bed, _television, _lamp, _plant, _table, chair, _stool, _crates,
    _statue,
)  # fmt: skip
FREE_STANDING: tuple[Maker, ...] = (_table, _stool, chair, _plant, _crates, _statue)
IN_HALLS: tuple[Maker, ...] = (_column, _column, _statue, _sofa, _table, _plant, _crates, _bookshelf, _lamp)

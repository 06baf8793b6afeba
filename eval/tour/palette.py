"""Colours and textures by the role of a surface: walls of a room, wood, cloth, ..."""

from __future__ import annotations

import colorsys

import numpy as np

from ufmstar_torch.eval.tour.shapes import Finish
from ufmstar_torch.eval.tour.style import Range, TourStyle

Color = tuple[float, float, float]

# Textures of objects instead of materials; only surfaces of these objects use them.
_PICTURES = ("books", "painting", "window")
# The materials of a surface: textures, ranges of saturation and value of its first colour, and of its
# pattern's period [m].
_ROLES: dict[str, tuple[tuple[str, ...], Range, Range, Range]] = {
    "wall": (
        ("plaster", "plaster", "plaster", "plain", "plain", "stripes", "bricks"),
        (0.03, 0.4),
        (0.5, 0.9),
        (0.2, 0.4),
    ),
    "floor": (("wood", "wood", "tiles", "checks", "fabric"), (0.1, 0.6), (0.3, 0.75), (0.2, 0.5)),
    "ceiling": (("plain", "plaster"), (0.0, 0.06), (0.8, 0.95), (0.3, 0.5)),
    "wood": (("wood", "wood", "plain"), (0.3, 0.65), (0.25, 0.8), (0.08, 0.16)),
    "cloth": (("fabric", "stripes", "checks", "plain"), (0.1, 0.65), (0.2, 0.85), (0.05, 0.2)),
    "paint": (("plain", "plaster"), (0.0, 0.6), (0.25, 0.95), (0.2, 0.4)),
    "metal": (("plain",), (0.0, 0.1), (0.15, 0.7), (0.2, 0.4)),
    "leaf": (("plaster", "fabric"), (0.5, 0.8), (0.25, 0.55), (0.05, 0.12)),
}
_WOOD_HUES, _LEAF_HUES, _WALL_HUES = (0.04, 0.11), (0.22, 0.38), (0.02, 0.65)


class Palette:
    """Draws finishes for one room from its style; the colours of a room's walls and wood stay the same.

    Args:
        style: of the room.
        rng: source of random numbers.
    """

    def __init__(self, style: TourStyle, rng: np.random.Generator) -> None:
        self._style, self._rng = style, rng
        self._usual = {role: self._draw(role) for role in ("wood", "cloth", "paint")}

    def finish(self, role: str) -> Finish:
        """A finish for a role; for wood, cloth and paint mostly the room's usual one."""
        if role in self._usual and self._rng.random() < 0.6:
            return self._usual[role]
        return self._draw(role)

    def picture(self, texture: str, fallback: str, period: float, glow: float = 0.0) -> Finish:
        """A finish with an object's texture, or that of the fallback role if the style has no such texture."""
        if texture not in self._style.textures:
            return self._draw(fallback)
        first, second = self._colors((0.4, 0.8), (0.3, 0.9), (0.0, 1.0))
        return Finish(texture, first, second, period, glow)

    def solid(self, color: Color, glow: float = 0.0) -> Finish:
        """One colour, as far as the style's textures allow."""
        other = (0.8 * color[0], 0.8 * color[1], 0.8 * color[2])
        texture = "plain" if "plain" in self._style.textures else self._draw("metal").texture
        return Finish(texture, color, other, 0.12, glow)

    def patterned(self) -> Finish:
        """A finish with a fine pattern in any colour, for things that must be seen to move."""
        available = [t for t in self._style.textures if t not in (*_PICTURES, "plain")]
        texture = available[int(self._rng.integers(len(available)))]
        first, second = self._colors((0.2, 0.7), (0.35, 0.9), (0.0, 1.0))
        return Finish(texture, first, second, float(self._rng.uniform(0.06, 0.16)))

    def _draw(self, role: str) -> Finish:
        textures, saturation, value, period = _ROLES[role]
        available = [t for t in textures if t in self._style.textures]
        available = available or [t for t in self._style.textures if t not in _PICTURES] or list(self._style.textures)
        texture = available[int(self._rng.integers(len(available)))]
        hues = {"wood": _WOOD_HUES, "leaf": _LEAF_HUES, "wall": _WALL_HUES}.get(role, (0.0, 1.0))
        if role == "floor" and texture == "wood":
            hues = _WOOD_HUES
        first, second = self._colors(saturation, value, hues)
        return Finish(texture, first, second, float(self._rng.uniform(*period)) * self._style.scale[0])

    def _colors(self, saturation: Range, value: Range, hues: Range) -> tuple[Color, Color]:
        """A colour, and a matching one: mostly darker or lighter with nearly the same hue."""
        rng = self._rng
        h, s, v = rng.uniform(*hues), rng.uniform(*saturation), rng.uniform(*value)
        far = rng.random() < 0.2
        other = (
            (h + (rng.uniform(0.2, 0.8) if far else rng.normal(0, 0.02))) % 1.0,
            float(np.clip(s + rng.normal(0, 0.12), 0, 0.9)),
            float(np.clip(v * rng.uniform(0.5, 0.85) if rng.random() < 0.7 else v * 1.3, 0.08, 0.97)),
        )
        return _linear(h, s, v), _linear(*other)


def _linear(h: float, s: float, v: float) -> Color:
    r, g, b = (float(c) ** 2.2 for c in colorsys.hsv_to_rgb(h, s, v))
    return r, g, b

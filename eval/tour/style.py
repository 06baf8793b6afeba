"""The styles of a tour's rooms: sizes, surfaces and light.

``home`` is the distribution for training networks. ``hall`` is outside of it: larger rooms and objects, darker and
colder light, and textures that no home has. ``mixed`` begins in a home and ends in a hall. ``blank`` is a home of plain
surfaces, full of furniture: most walls and floors have no features. ``scales`` is a hall with furniture from a doll's
size to the usual one. In ``corridor`` and ``street`` the camera drives along the axis of one long room; a street is
outdoors: facades without a ceiling, under a sky without depth. ``close`` is a small place full of things at the range
of a depth camera or an arm, .3 to 2 m.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

Range = tuple[float, float]

# The two sets are disjoint, so that a network trained on homes has never seen a texture of a hall.
HOME_TEXTURES = (
    "plain", "plaster", "wood", "checks", "stripes", "tiles", "bricks", "fabric", "books", "painting", "window"
)  # fmt: skip
HALL_TEXTURES = ("dots", "zigzag", "marble", "terrazzo", "hexagons", "rings")
TEXTURES = HOME_TEXTURES + HALL_TEXTURES


@dataclass(frozen=True)
class TourStyle:
    """Sizes and appearance of a tour's rooms; ranges are (lowest, highest), drawn uniformly."""

    name: str = "home"  # of the style
    textures: tuple[str, ...] = HOME_TEXTURES  # names of the surface textures
    rooms: tuple[int, int] = (3, 5)  # number of rooms, lowest and highest
    room_size: Range = (3.2, 6.0)  # side of a room [m]
    ceiling: Range = (2.3, 3.0)  # its height [m]
    camera_height: Range = (1.0, 1.6)  # above the floor [m]
    scale: Range = (0.9, 1.1)  # of the furniture, 1 = usual
    furniture: float = 0.5  # pieces of furniture per m^2 of floor
    brightness: Range = (0.8, 1.2)  # of the lights, 1 = a lit living room
    warmth: Range = (0.1, 0.9)  # -1 (cold, blue) to 1 (warm, yellow) of the lights
    last: TourStyle | None = None  # style of the last room; None = as the others
    length: Range | None = None  # of one long room in multiples of its width, along which the camera drives
    outdoors: bool = False  # no ceiling and no lamps; the sun is far above


HOME = TourStyle()
HALL = TourStyle(
    name="hall",
    textures=HALL_TEXTURES,
    rooms=(2, 3),
    room_size=(8.0, 14.0),
    ceiling=(4.0, 6.0),
    scale=(1.5, 1.9),
    furniture=0.16,
    brightness=(0.45, 0.65),
    warmth=(-0.9, -0.4),
)
MIXED = TourStyle(
    rooms=(3, 3),
    room_size=(3.2, 4.4),
    last=replace(HALL, rooms=(1, 1), room_size=(7.0, 9.0), ceiling=(3.6, 4.6), scale=(1.4, 1.7), furniture=0.22),
)
BLANK = replace(HOME, name="blank", textures=("plain",) * 4 + ("stripes", "books", "painting", "window"), furniture=0.9)
SCALES = replace(HALL, name="scales", scale=(0.25, 1.2), furniture=0.4)
CORRIDOR = replace(
    HOME, name="corridor", textures=("plain",) * 2 + HOME_TEXTURES + HALL_TEXTURES, rooms=(1, 1), room_size=(2.0, 3.2),
    length=(5.0, 8.0), camera_height=(0.4, 1.4), furniture=0.6, brightness=(0.6, 1.1),
)  # fmt: skip
STREET = replace(
    HALL, name="street", textures=("plain",) * 3 + HOME_TEXTURES + HALL_TEXTURES, rooms=(1, 1), room_size=(7.0, 12.0),
    ceiling=(4.0, 8.0), length=(5.0, 7.0), camera_height=(1.0, 1.7), furniture=0.1, brightness=(0.7, 1.2),
    warmth=(-0.3, 0.5), outdoors=True,
)  # fmt: skip
CLOSE = replace(
    HOME, name="close", rooms=(1, 2), room_size=(1.7, 2.6), camera_height=(0.3, 0.6), scale=(0.2, 0.5), furniture=4.0
)
STYLES = {
    "home": HOME, "hall": HALL, "mixed": MIXED, "blank": BLANK, "scales": SCALES,
    "corridor": CORRIDOR, "street": STREET, "close": CLOSE,
}  # fmt: skip


def style_of(style: str) -> TourStyle:
    """A style by its name. Raises ValueError: no such name."""
    if style not in STYLES:
        raise ValueError(f"style must be one of {', '.join(STYLES)}, got {style!r}")
    return STYLES[style]

"""Pictures inside a page: data URIs, so that one file is all there is."""

from __future__ import annotations

import base64
import io
import re
from dataclasses import dataclass
from pathlib import Path

from ufmstar_torch.eval.report.markup import Markup, tag

# All pictures together [bytes of the page]; the rest of the page needs well below a megabyte.
MOST_BYTES = 7_000_000
# Of WebP: below it letters in pictures get visible rings.
QUALITY = 84


@dataclass(frozen=True)
class Embedded:
    """A picture as a page holds it.

    Attributes:
        uri: "data:image/...".
        width: in pixels, as it is meant to be seen.
        height: see ``width``.
    """

    uri: str
    width: int
    height: int


class Embedder:
    """Reads pictures as long as there is room.

    Args:
        most: bytes of all data URIs together.
    """

    def __init__(self, most: int = MOST_BYTES) -> None:
        self._left = most
        self.left_out: list[Path] = []

    def take(self, path: Path) -> Embedded | None:
        """The picture, or None where it would not fit; it then stands in ``left_out``.

        Raises:
            ValueError: it is neither SVG nor PNG.
            ImportError: Pillow is missing.
            OSError: it cannot be read.
        """
        found = _svg(path) if path.suffix == ".svg" else _png(path)
        if len(found.uri) > self._left:
            self.left_out.append(path)
            return None
        self._left -= len(found.uri)
        return found


def image(found: Embedded, alt: str) -> Markup:
    """The picture with its size, so that the page does not jump while it loads."""
    return tag(
        "img", src=found.uri, alt=alt, width=str(found.width), height=str(found.height), loading="lazy", class_="zoom"
    )


def _svg(path: Path) -> Embedded:
    text = path.read_text(encoding="utf-8")
    width, height = (_points(text, name) for name in ("width", "height"))
    return Embedded(_uri("image/svg+xml", text.encode()), width, height)


def _points(text: str, name: str) -> int:
    """A length of the outermost element, in pixels of the page (4/3 of a point)."""
    found = re.search(rf'<svg\b[^>]*?\b{name}="([0-9.]+)(pt|px)?"', text)
    if found is None:
        raise ValueError(f"a picture must be an SVG with a {name} in points, or a PNG")
    return round(float(found[1]) * (4 / 3 if found[2] == "pt" else 1))


def _png(path: Path) -> Embedded:
    """As WebP, which is a fifth of it."""
    if path.suffix != ".png":
        raise ValueError(f"a picture must be an SVG or a PNG, got {path.name}")
    from PIL import Image

    with Image.open(path) as picture:
        buffer = io.BytesIO()
        picture.convert("RGB").save(buffer, "WEBP", quality=QUALITY, method=4)
        return Embedded(_uri("image/webp", buffer.getvalue()), *picture.size)


def _uri(kind: str, data: bytes) -> str:
    return f"data:{kind};base64,{base64.b64encode(data).decode()}"

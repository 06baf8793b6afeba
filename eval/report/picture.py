"""A picture of the report: its file and the words that go with it."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable
from dataclasses import asdict, dataclass, fields
from hashlib import sha256
from pathlib import Path

from ufmstar_torch.eval.results.files import write_json_atomic

INDEX = "pictures.json"
STRIP, BREAKDOWN, COMPARE, ROOM = "strip", "breakdown", "compare", "room"
KINDS = (STRIP, BREAKDOWN, COMPARE, ROOM)


@dataclass(frozen=True)
class Picture:
    """One picture.

    Attributes:
        file: name within the figures' folder.
        kind: one of ``KINDS``.
        title: what it shows, a few words.
        caption: how to read it.
        alt: what a reader who cannot see it should know.
    """

    file: str
    kind: str
    title: str
    caption: str
    alt: str


def file_name(*parts: str) -> str:
    """A name for a PNG from names of people's own; a few letters of a digest keep names apart that would look alike."""
    plain = re.sub(r"[^A-Za-z0-9.-]+", "-", "_".join(parts).replace("*", "star"))[:100].strip("-.")
    return f"{plain}_{sha256(repr(parts).encode()).hexdigest()[:6]}.png"


def write_index(folder: Path, pictures: Iterable[Picture]) -> Path:
    """Write which pictures there are, and the words that go with them."""
    path = folder / INDEX
    write_json_atomic(path, {"pictures": [asdict(picture) for picture in pictures]})
    return path


def read_index(folder: Path) -> list[Picture]:
    """The pictures of which the file is there; [] if none were made.

    Raises:
        ValueError: the index is not one.
    """
    path = folder / INDEX
    if not path.is_file():
        return []
    names = {f.name for f in fields(Picture)}
    listed = json.loads(path.read_text(encoding="utf-8"))["pictures"]
    if any(not isinstance(entry, dict) or entry.keys() != names for entry in listed):
        raise ValueError(f"{path} is not an index of pictures")
    return [Picture(**entry) for entry in listed if (folder / entry["file"]).is_file()]

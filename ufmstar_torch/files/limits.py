"""The limits on the sizes that files, names of tours and settings may state, checked before memory is allocated."""

from __future__ import annotations

import json
from math import prod
from pathlib import Path
from typing import Any

MOST_BYTES = 2**30  # of one array, of a state, or of a list of frames
MOST_PIXELS = MOST_BYTES // 12  # of an image, which takes 12 bytes a pixel as float32 RGB


def require_bytes(what: str, size: int) -> None:
    """Raise a ValueError if ``what`` would take more than ``MOST_BYTES`` bytes."""
    if size > MOST_BYTES:
        raise ValueError(f"{what} would take {size:,} bytes, more than the limit of {MOST_BYTES:,}")


def require_pixels(what: str, size: tuple[int, int]) -> None:
    """Raise a ValueError if ``what``, an image or map of ``size`` (H, W), has more than ``MOST_PIXELS`` pixels."""
    if prod(size) > MOST_PIXELS:
        limit = f"more than the limit of {MOST_PIXELS:,} pixels"
        raise ValueError(f"{what} would have {size[0]} x {size[1]} pixels, {limit}")


def read_text(path: str | Path) -> str:
    """The text of a file, in UTF-8 with or without the mark that editors on Windows add. Raises OSError: it cannot be
    opened; ValueError: it is a device or a pipe, which may have no end, is larger than ``MOST_BYTES``, or is no text.
    """
    path = Path(path)
    if path.exists() and not (path.is_file() or path.is_dir()):
        raise ValueError(f"{path} must be a file, got a device or a pipe")
    if path.is_file():
        require_bytes(str(path), path.stat().st_size)
    return path.read_text(encoding="utf-8-sig")


def read_json(path: str | Path) -> Any:
    """The value of a JSON file. Raises OSError, ValueError: as :func:`read_text`; it is no JSON, or nested too deep."""
    try:
        return json.loads(read_text(path))
    except RecursionError as error:
        raise ValueError("its values are nested too deep") from error

"""The limits on the sizes that files, names of tours and settings may state, checked before memory is allocated."""

from __future__ import annotations

import json
import tomllib
from codecs import BOM_UTF16_BE, BOM_UTF16_LE
from math import prod
from pathlib import Path
from typing import Any

MOST_BYTES = 2**30  # of one array, of a state, or of a list of frames
MOST_SETTINGS = 1_000_000  # bytes of a file of settings; those of all commands together have some kilobytes
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
    """The text of a file, in UTF-8 or, if it begins with its mark, UTF-16. Raises OSError: it cannot be opened;
    ValueError: it is a device or a pipe, which may have no end, is larger than ``MOST_BYTES``, or is no text.
    """
    path = _no_device(path)
    if path.is_file():
        require_bytes(str(path), path.stat().st_size)
    return decoded(path.read_bytes())


def _no_device(path: str | Path) -> Path:
    """The path. Raises ValueError: it is a folder, a device or a pipe."""
    path = Path(path)
    if path.exists() and not path.is_file():
        raise ValueError(f"{path} must be a file, got a {'folder' if path.is_dir() else 'device or a pipe'}")
    return path


def decoded(content: bytes) -> str:
    """A text in UTF-8, with or without the mark that editors on Windows add, or in UTF-16 with its mark, as PowerShell
    writes it. Raises ValueError: it is no text."""
    return content.decode("utf-16" if content.startswith((BOM_UTF16_LE, BOM_UTF16_BE)) else "utf-8-sig")


def read_json(path: str | Path) -> Any:
    """The value of a JSON file. Raises OSError, ValueError: as :func:`read_text`; it is no JSON, or nested too deep."""
    try:
        return json.loads(read_text(path))
    except RecursionError as error:
        raise ValueError("its values are nested too deep") from error


def read_settings(path: str | Path) -> Any:
    """The value of a file of settings. Raises OSError: it cannot be opened; ValueError: it is a device or a pipe, is
    larger than ``MOST_SETTINGS`` bytes, or neither TOML nor JSON."""
    path = _no_device(path)
    with path.open("rb") as file:
        content = file.read(MOST_SETTINGS + 1)
    if len(content) > MOST_SETTINGS:
        raise ValueError(f"it is larger than {MOST_SETTINGS:,} bytes, which no settings need")
    try:
        return (tomllib if path.suffix.lower() == ".toml" else json).loads(decoded(content))
    except (ValueError, RecursionError) as error:
        raise ValueError(f"it is neither TOML (*.toml) nor JSON: {error}") from error

"""Sequences by path or name: recordings on disk, and tours, ``tour:SEED?style=mixed&frames=150&size=160x224``."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from ufmstar_torch.eval.sequences import layout as on_disk
from ufmstar_torch.eval.sequences.frame import FrameSequence, parse_size
from ufmstar_torch.eval.sequences.poses import OURS
from ufmstar_torch.eval.tour.sequence import tour_sequence
from ufmstar_torch.eval.tour.style import STYLES

PREFIX = "tour:"
_FORM = "tour:SEED or tour:SEED?option=value&..., with the options style, frames, size, fov, path and sensor"


def open_sequence(path: str | Path, layout: str = "auto", *, poses: str = OURS, **options: Any) -> FrameSequence:
    """Opens a recording, or renders a tour; the frames are decoded, or rendered, when they are indexed.

    Args:
        path: of a recording; or ``tour:SEED``, rooms rendered from a seed, with the options of
            :func:`open_tour` in the name.
        layout: see :func:`ufmstar_torch.eval.sequences.open_sequence`, as ``poses`` and ``options``; a tour has none.
        poses: how the poses are written.
        options: further options of a recording.

    Raises:
        FileNotFoundError: ``path`` does not exist.
        ValueError: see :func:`ufmstar_torch.eval.sequences.open_sequence`; or a layout or option for a tour.
    """
    if not str(path).startswith(PREFIX):
        return on_disk.open_sequence(path, layout, poses=poses, **options)
    if layout != "auto":
        raise ValueError(f"layout must be auto for {path!r}, got {layout!r}")
    if options:
        raise ValueError(f"{path!r} takes no {', '.join(options)}: a tour's options stand in its name")
    return on_disk.convert_poses(open_tour(str(path)), poses)


def open_tour(name: str) -> FrameSequence:
    """The tour of a name.

    Options: ``style`` (home, hall, mixed), ``frames``, ``size`` (HxW), ``fov`` (degrees), ``path`` (seed of the way)
    and ``sensor`` (1, or 0 for a perfect camera).

    Raises:
        ValueError: another form, an unknown option, or a value that it does not take.
    """
    seed, _, query = name.removeprefix(PREFIX).partition("?")
    if not name.startswith(PREFIX) or not seed.isdecimal():
        raise ValueError(f"a tour is named {_FORM}; got {name!r}")
    options: dict[str, Any] = {}
    for word in query.split("&") if query else []:
        key, _, value = word.partition("=")
        if key not in _OPTIONS:
            raise ValueError(f"{name!r}: unknown option {key!r}; a tour is named {_FORM}")
        argument, parse, expected = _OPTIONS[key]
        if argument in options:
            raise ValueError(f"{name!r}: the option {key} is given twice")
        try:
            options[argument] = parse(value)
        except (ValueError, KeyError) as error:
            raise ValueError(f"{name!r}: {key} must be {expected}, got {value!r}") from error
    return tour_sequence(int(seed), **options)


def _whole(text: str, least: int = 0) -> int:
    if not text.isdecimal() or int(text) < least:
        raise ValueError(text)
    return int(text)


# By option: the argument of ``tour_sequence``, what reads it (ValueError or KeyError where it cannot), and its form.
_OPTIONS: dict[str, tuple[str, Callable[[str], Any], str]] = {
    "style": ("style", {style: style for style in STYLES}.__getitem__, f"one of {', '.join(STYLES)}"),
    "frames": ("frames", partial(_whole, least=1), "a number of at least 1"),
    "size": ("size", parse_size, "HxW in pixels, 160x224 say"),
    "fov": ("fov", float, "a number of degrees, 20 to 120"),
    "path": ("path_seed", _whole, "a number of at least 0"),
    "sensor": ("sensor", {"0": False, "1": True}.__getitem__, "0 or 1"),
}

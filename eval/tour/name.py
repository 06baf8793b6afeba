"""Tours by name, ``tour:SEED?style=mixed&frames=150&size=160x224``, wherever a sequence's folder may stand."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from ufmstar_torch.eval.sequences.frame import FrameSequence
from ufmstar_torch.eval.tour.sequence import tour_sequence
from ufmstar_torch.eval.tour.style import STYLES

PREFIX = "tour:"
_FORM = "tour:SEED or tour:SEED?option=value&..., with the options style, frames, size, fov, path and sensor"


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


def _style(text: str) -> str:
    if text not in STYLES:
        raise ValueError(text)
    return text


def _count(text: str) -> int:
    if not text.isdecimal() or int(text) < 1:
        raise ValueError(text)
    return int(text)


def _seed(text: str) -> int:
    if not text.isdecimal():
        raise ValueError(text)
    return int(text)


def _size(text: str) -> tuple[int, int]:
    height, width = text.lower().split("x")
    return _count(height), _count(width)


def _switch(text: str) -> bool:
    return {"0": False, "1": True}[text]


_OPTIONS: dict[str, tuple[str, Callable[[str], Any], str]] = {
    "style": ("style", _style, f"one of {', '.join(STYLES)}"),
    "frames": ("frames", _count, "a number of at least 1"),
    "size": ("size", _size, "HxW in pixels, 160x224 say"),
    "fov": ("fov", float, "a number of degrees, 20 to 120"),
    "path": ("path_seed", _seed, "a number of at least 0"),
    "sensor": ("sensor", _switch, "0 or 1"),
}

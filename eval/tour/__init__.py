"""Tours: furnished rooms rendered from a seed, with exact depth and poses (see docs/tour.md)."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ufmstar_torch.eval.tour.path import tour_path as tour_path
    from ufmstar_torch.eval.tour.sequence import export_tour as export_tour
    from ufmstar_torch.eval.tour.sequence import tour_sequence as tour_sequence
    from ufmstar_torch.eval.tour.style import TourStyle as TourStyle
    from ufmstar_torch.eval.tour.tour import Tour as Tour
    from ufmstar_torch.eval.tour.tour import make_tour as make_tour
    from ufmstar_torch.eval.tour.view import TourView as TourView
    from ufmstar_torch.eval.tour.view import render as render

_HOME = {
    "Tour": "tour",
    "TourStyle": "style",
    "TourView": "view",
    "export_tour": "sequence",
    "make_tour": "tour",
    "render": "view",
    "tour_path": "path",
    "tour_sequence": "sequence",
}


def __getattr__(name: str) -> Any:
    """Imports a name's module when it is first asked for (PEP 562).

    ``render`` is a function and a module: importing the module would bind its name here, so the function
    takes the name's place at once.
    """
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOME[name]}"), name)

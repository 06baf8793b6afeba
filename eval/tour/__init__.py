"""Tours: furnished rooms rendered from a seed, with exact depth and poses (see docs/tour.md)."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ufmstar_torch.runtime.optional import lazy_names

if TYPE_CHECKING:
    from ufmstar_torch.eval.tour.movers import make_movers as make_movers
    from ufmstar_torch.eval.tour.path import tour_path as tour_path
    from ufmstar_torch.eval.tour.sequence import export_tour as export_tour
    from ufmstar_torch.eval.tour.sequence import tour_sequence as tour_sequence
    from ufmstar_torch.eval.tour.tour import Tour as Tour
    from ufmstar_torch.eval.tour.tour import make_tour as make_tour
    from ufmstar_torch.eval.tour.view import TourView as TourView
    from ufmstar_torch.eval.tour.view import render as render
else:
    __getattr__, __dir__ = lazy_names(__name__)

"""Which figures a report has, and their files; a file's first word is its kind."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

from ufmstar_torch.eval.report.data import Results
from ufmstar_torch.eval.report.figures_calibration import draw_calibration, draw_sequence_calibration
from ufmstar_torch.eval.report.figures_cost import draw_latency, draw_stages, draw_tradeoff
from ufmstar_torch.eval.report.figures_error import draw_entropy, draw_error
from ufmstar_torch.eval.report.figures_sweep import draw_changes, draw_sweep
from ufmstar_torch.eval.report.pictures import DRAWING_ERRORS
from ufmstar_torch.eval.report.style import save_figure
from ufmstar_torch.eval.report.sweeps import sweeps

SVG, PNG = "svg", "png"


def write_figures(results: Results, kind: str, undrawn: dict[str, str]) -> list[Path]:
    """Draw every figure for which there are results into ``figures/``.

    Args:
        results: of an evaluation, with the sums over sequences.
        kind: "svg" or "png".
        undrawn: gets the reason of each figure that cannot be drawn, by its name.

    Returns:
        The files.

    Raises:
        ValueError: another kind.
        ImportError: matplotlib is missing.
        OSError: a file cannot be written.
    """
    if kind not in (SVG, PNG):
        raise ValueError(f"figures must be {SVG} or {PNG}, got {kind!r}")
    folder = results.out / "figures"
    folder.mkdir(exist_ok=True)
    written = []
    for name, draw in figures_of(results):
        path = folder / f"{re.sub(r'[^A-Za-z0-9.-]+', '-', name.replace('/', '_'))}.{kind}"
        try:
            figure = draw()
            if figure is not None:
                save_figure(figure, path)
                written.append(path)
        except DRAWING_ERRORS as error:
            undrawn[name] = " ".join(str(error).split()) or type(error).__name__
    return written


def figures_of(results: Results) -> Iterator[tuple[str, Callable[[], Any]]]:
    """Name and function of every figure; the function returns None where there is nothing to draw."""
    for dataset in results.datasets:
        yield f"calibration {dataset}", partial(draw_calibration, results, dataset)
        for base in results.bases:
            yield (
                f"calibration sequences {dataset} {base}",
                partial(draw_sequence_calibration, results, dataset, base),
            )
        yield f"error {dataset}", partial(draw_error, results, dataset)
    for base in results.bases:
        yield f"entropy {base}", partial(draw_entropy, results, base)
    for base, name in sweeps(results):
        yield f"sweep {base} {name}", partial(draw_sweep, results, base, name)
    for base in results.bases:
        yield f"sweep changes {base}", partial(draw_changes, results, base)
    yield "latency", partial(draw_latency, results)
    yield "latency stages", partial(draw_stages, results)
    yield "tradeoff", partial(draw_tradeoff, results)

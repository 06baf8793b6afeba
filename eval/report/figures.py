"""All figures of a report; a file's first word says what kind it is."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from ufmstar_torch.eval.report.figure_style import save_figure
from ufmstar_torch.eval.report.figures_calibration import draw_calibration, draw_sequence_calibration
from ufmstar_torch.eval.report.figures_cost import draw_latency, draw_stages, draw_tradeoff
from ufmstar_torch.eval.report.figures_entropy import draw_entropy
from ufmstar_torch.eval.report.figures_error import draw_error
from ufmstar_torch.eval.report.figures_sweep import draw_changes, draw_sweep
from ufmstar_torch.eval.report.data import Results
from ufmstar_torch.eval.report.sweep_lines import sweeps

SVG, PNG = "svg", "png"


def write_figures(results: Results, kind: str = SVG) -> list[Path]:
    """Draw every figure for which there are results into ``figures/``.

    Args:
        results: of an evaluation, with the sums over sequences.
        kind: "svg" or "png".

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
    for name, figure in _figures(results):
        if figure is not None:
            path = folder / f"{re.sub(r'[^A-Za-z0-9.-]+', '-', name.replace('/', '_'))}.{kind}"
            save_figure(figure, path)
            written.append(path)
    return written


def _figures(results: Results) -> Iterator[tuple[str, Any]]:
    """Name and figure, one after the other; None where there is nothing to draw."""
    bases = list(dict.fromkeys(row.method.base for row in results.rows))
    for dataset in results.datasets:
        yield f"calibration {dataset}", draw_calibration(results, dataset)
        for base in bases:
            yield f"calibration sequences {dataset} {base}", draw_sequence_calibration(results, dataset, base)
        yield f"error {dataset}", draw_error(results, dataset)
    for base in bases:
        yield f"entropy {base}", draw_entropy(results, base)
    for base, name in sweeps(results):
        yield f"sweep {base} {name}", draw_sweep(results, base, name)
    for base in bases:
        yield f"sweep changes {base}", draw_changes(results, base)
    yield "latency", draw_latency(results)
    yield "latency stages", draw_stages(results)
    yield "tradeoff", draw_tradeoff(results)

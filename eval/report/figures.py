"""Which figures a report has; the first word of a name is the figure's kind."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

from ufmstar_torch.eval.report.data import Results
from ufmstar_torch.eval.report.figures_calibration import draw_calibration, draw_sequence_calibration
from ufmstar_torch.eval.report.figures_cost import draw_latency, draw_stages, draw_tradeoff
from ufmstar_torch.eval.report.figures_error import draw_entropy, draw_error
from ufmstar_torch.eval.report.figures_sweep import draw_changes, draw_sweep
from ufmstar_torch.eval.report.sweeps import sweeps


def figures_of(results: Results) -> Iterator[tuple[str, Callable[[], Any]]]:
    """Name and function of every figure; the function returns None where there is nothing to draw."""
    for dataset in results.datasets:
        yield f"calibration {dataset}", partial(draw_calibration, results, dataset)
        for base in results.bases:
            name = f"calibration sequences {dataset} {base}"
            yield name, partial(draw_sequence_calibration, results, dataset, base)
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

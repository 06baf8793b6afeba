"""``ufmstar recalibrate``: its options, the fit and its printed output."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from ufmstar_torch.eval.commands.options import Positional, arg, reader
from ufmstar_torch.eval.commands.terminal import usage_errors
from ufmstar_torch.eval.methods.method import UFM_STAR

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from ufmstar_torch.eval.methods.row import Row
    from ufmstar_torch.eval.report.data import Results
    from ufmstar_torch.posterior.recalibrate import Recalibration


@dataclass(frozen=True, kw_only=True)
class RecalibrateOptions:
    """A monotone map of the variance, fitted to frames with ground truth.

    Fits the map to the sequences of an evaluation (`ufmstar eval`) and writes it to a file, which
    `ufmstar run` and `live` apply with --recalibration FILE. The printed figures are of each sequence under the map
    that was fitted to the others.

    Attributes:
        out: The folder of `ufmstar eval`.
        row: Fit to this row, as the table names it: UfM*-DepthOnly, say.
        to: Write the map to this file.
        covariate: Map the variance, or the network's confidence to a factor of the variance.
    """

    out: Annotated[Positional[Path], arg(metavar="OUT")]
    row: str
    to: Path
    covariate: Literal["variance", "confidence"] = "variance"


read = reader(RecalibrateOptions, "ufmstar recalibrate")


def main(options: RecalibrateOptions) -> int:
    """Fit, write the file, and print the figures on held-out sequences. Returns the exit code."""
    from ufmstar_torch.eval.report.data import load_results
    from ufmstar_torch.eval.report.quantities import count
    from ufmstar_torch.eval.report.table import aligned

    with usage_errors(ValueError):
        results = load_results(options.out, with_sums=False)
        rows = [row for row in results.rows if row.method.fusion == UFM_STAR]
        row = next((row for row in rows if row.label == options.row), None)
        if row is None:
            labels = ", ".join(row.label for row in rows) or "(none: no row of UfM*)"
            raise ValueError(f"--row must be one of {labels}, got {options.row!r}")
        counts = _counts(results, row, options.covariate)
        fitted = _fit(list(counts.values()), options.covariate)
        _about(fitted, results, row).save(options.to)
    print("\n".join(aligned(_table(counts, options.covariate))))
    if len(counts) == 1:
        print("fitted to a single sequence, on which it is not judged: evaluate more of them")
    print(f"{options.to}: {len(fitted.variance)} knots, fitted to {count(len(counts), 'sequence')}")
    return 0


def _fit(counts: Sequence[NDArray[Any]], covariate: str) -> Recalibration:
    from ufmstar_torch.eval.engine.judge import CONFIDENCE
    from ufmstar_torch.eval.metrics.recalibration import fit, fit_confidence

    return fit_confidence(counts) if covariate == CONFIDENCE else fit(counts)


def _counts(results: Results, row: Row, covariate: str) -> dict[str, NDArray[Any]]:
    """By "DATASET/SEQUENCE", the histogram [V, e] of pixels over variance and squared error; for the covariate
    confidence, samples [n, 3]. Raises ValueError: the network states no confidence."""
    from ufmstar_torch.eval.engine.judge import CONFIDENCE
    from ufmstar_torch.eval.engine.record import METRICS

    counts = {}
    for record in results.of(row):
        sums = record.load_sums()
        if covariate == CONFIDENCE and CONFIDENCE not in sums:
            raise ValueError(f"--covariate confidence needs a network that states one: {row.label} has none")
        chosen = (CONFIDENCE, "samples") if covariate == CONFIDENCE else (METRICS, "metrics.SpearmanCorrelation.joint")
        counts[f"{record.dataset}/{record.sequence}"] = sums[chosen[0]][chosen[1]].double().numpy()
    return counts


def _table(counts: Mapping[str, NDArray[Any]], covariate: str) -> list[list[str]]:
    """Figures of every sequence without a map, and with the map fitted to the other sequences."""
    from ufmstar_torch.eval.engine.judge import CONFIDENCE
    from ufmstar_torch.eval.metrics.recalibration import figures, figures_of_samples
    from ufmstar_torch.eval.report.text import number

    judged = figures_of_samples if covariate == CONFIDENCE else figures
    lines = [["", "coverage error", "recalibrated", "NLL", "recalibrated"]]
    for name, joint in counts.items():
        others = [other for label, other in counts.items() if label != name]
        before = judged(joint, None)
        after = judged(joint, _fit(others, covariate)) if others else dict.fromkeys(before)
        lines.append([name, *(number(of[key]) for key in ("coverage_error", "nll") for of in (before, after))])
    return lines


def _about(fitted: Recalibration, results: Results, row: Row) -> Recalibration:
    """The map with the row, settings, network and sequences of its fit."""
    from ufmstar_torch.eval.engine.estimators import ufm_star_config

    records = results.of(row)
    network: Mapping[str, object] = results.about["networks"][row.method.base]
    files = network.get("files")
    return replace(
        fitted,
        row=row.label,
        ufm=ufm_star_config(row).to_dict(),
        network=", ".join(file["name"] for file in files) if isinstance(files, list) else "",
        sequences=tuple(f"{record.dataset}/{record.sequence}" for record in records),
    )

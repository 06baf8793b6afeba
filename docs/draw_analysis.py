"""The pictures of docs/results/analysis.md.

python docs/draw_analysis.py --root ../shared --out docs/images
python docs/measure_factors.py --tours 200:206 --save factors.json
python docs/draw_analysis.py --factors factors.json --out docs/images
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from clips import Clip, Map, clips, estimate
from matplotlib.figure import Figure
from measure_views import surface_points

from ufmstar_torch import UfMStar
from ufmstar_torch.eval.methods.ufm import UfM
from ufmstar_torch.eval.metrics.sequence import mean_and_ci

EDGES = np.logspace(-4, 1, 21)  # [m^2] of the variance
FEWEST = 2000  # pixels of a bin that is drawn
COLOURS = {"UfM-100K": "tab:orange", "UfM*": "tab:blue"}


@dataclass(frozen=True, eq=False)
class Judged:
    """A clip and its variances by method."""

    clip: Clip
    variances: dict[str, Map]


def reliability(variance: Map, clip: Clip) -> tuple[np.ndarray, np.ndarray]:
    """Mean variance and mean squared error [m^2] of the pixels in each logarithmic bin of the variance."""
    v = variance[clip.known].astype(np.float64)
    squared = (clip.depth[clip.known].astype(np.float64) - clip.truth[clip.known]) ** 2
    bins = np.digitize(v, EDGES)
    count, length = np.bincount(bins, minlength=len(EDGES) + 1), len(EDGES) + 1
    kept = count >= FEWEST
    sums = (np.bincount(bins, values, length)[kept] / count[kept] for values in (v, squared))
    return next(sums), next(sums)


def draw_reliability(judged: Sequence[Judged]) -> Figure:
    """Squared error against the variance, one panel a clip; on the diagonal the variance is right."""
    figure, axes = plt.subplots(1, len(judged), figsize=(3 * len(judged), 3.2), sharey=True, layout="constrained")
    for axis, one in zip(np.atleast_1d(axes), judged, strict=True):
        for name, variance in one.variances.items():
            axis.loglog(*reliability(variance, one.clip), "o-", markersize=4, color=COLOURS[name], label=name)
        axis.loglog([1e-4, 10], [1e-4, 10], "k--", linewidth=1, label="calibrated")
        axis.set(title=one.clip.name, xlabel="variance V [m²]", xlim=(1e-4, 10), ylim=(1e-2, 40))
        axis.grid(alpha=0.3)
    np.atleast_1d(axes)[0].set_ylabel("mean squared error [m²]")
    np.atleast_1d(axes)[0].legend(loc="lower right", fontsize=8)
    return figure


def draw_share(judged: Sequence[Judged]) -> Figure:
    """What all views get wrong alike, what varies between them, and the variances stated at the same points."""
    figure, axis = plt.subplots(figsize=(7.5, 3.4), layout="constrained")
    for i, one in enumerate(judged):
        points = surface_points(one.clip).often()
        mse, varying = (points.squares / points.views).mean(), points.varying.mean()
        stated = {name: float(v[tuple(points.at)].mean(dtype=np.float64)) for name, v in one.variances.items()}
        bars = {"error that all views share": mse - varying, "error that varies": varying, **stated}
        colours = ("0.75", "tab:green", *(COLOURS[name] for name in stated))
        for k, ((name, value), colour) in enumerate(zip(bars.items(), colours, strict=True)):
            axis.bar(i + 0.2 * (k - 1.5), value, 0.18, color=colour, label=name if i == 0 else None)
    axis.set(yscale="log", ylabel="mean [m²]", xticks=range(len(judged)))
    axis.set_xticklabels([one.clip.name for one in judged])
    axis.grid(alpha=0.3, axis="y")
    axis.legend(fontsize=8, ncols=2)
    return figure


def draw_factors(groups: dict[str, list[dict[str, dict[str, float]]]]) -> Figure:
    """Differences to the defaults, mean and 95 % interval over the clips; left of the line is better."""
    columns = {"ece_delta": "change of ECE_δ", "ece_q": "change of ECE_q"}
    names = list(next(iter(groups.values()))[0])[1:]
    figure, axes = plt.subplots(1, 2, figsize=(9, 0.26 * len(names) + 1), sharey=True, layout="constrained")
    for axis, (column, title) in zip(axes, columns.items(), strict=True):
        for k, (group, result) in enumerate(groups.items()):
            changes = [mean_and_ci(one[n][column] - one["default"][column] for one in result) for n in names]
            rows = np.arange(len(names)) + 0.25 * (k - (len(groups) - 1) / 2)
            means, halves = zip(*changes, strict=True)
            axis.errorbar(means, rows, xerr=halves, fmt="o", markersize=4, label=f"{group}, {len(result)} clips")
        axis.axvline(0, color="k", linewidth=1)
        axis.set(xlabel=title, yticks=range(len(names)))
        axis.set_yticklabels(names, fontsize=8)
        axis.grid(alpha=0.3, axis="x")
    axes[0].invert_yaxis()
    axes[0].legend(fontsize=8, loc="lower right")
    return figure


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    source = parser.add_mutually_exclusive_group(required=True)
    source.add_argument("--root", type=Path, help="folder that holds data/ and weights/")
    source.add_argument("--factors", type=Path, help="what measure_factors.py saved")
    parser.add_argument("--out", type=Path, required=True, help="folder")
    arguments = parser.parse_args()
    if arguments.factors is not None:
        pictures = {"factors": draw_factors(json.loads(arguments.factors.read_text()))}
    else:
        judged = [
            Judged(clip, {"UfM-100K": estimate(clip, UfM()), "UfM*": estimate(clip, UfMStar())})
            for clip in clips(arguments)
        ]
        pictures = {"reliability": draw_reliability(judged), "share": draw_share(judged)}
    for name, figure in pictures.items():
        figure.savefig(arguments.out / f"analysis_{name}.png", dpi=110)


if __name__ == "__main__":
    main()

"""The picture of docs/results/real_video.md: what UfM* changes, against how sure the network alone was of itself.

python docs/draw_gain.py --foreign results/tum results/rest --same results/same --out docs/images/evaluation_gain.png
"""

from __future__ import annotations

import argparse
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.figure import Figure

from ufmstar_torch.eval.methods.method import ALONE, BASES, UFM_STAR, Method
from ufmstar_torch.eval.report.data import load_results

COLOURS = dict(zip(BASES, ("tab:blue", "tab:orange", "tab:green", "tab:red", "tab:purple", "0.5"), strict=True))
# "nll" on an axis that is linear up to .1 nat and logarithmic beyond: its changes reach from .01 to 20.
FIGURES = {"nll": "NLL", "ece_delta": "ECE$_\\delta$", "ece_q": "ECE$_q$"}
Point = tuple[str, float, dict[str, float]]  # base, over-confidence of the network alone, change by UfM*


def points(folders: list[Path]) -> list[Point]:
    """One for each network and sequence that has both rows."""
    result: list[Point] = []
    for folder in folders:
        records = {(r.dataset, r.sequence, r.method): r for r in load_results(folder, with_sums=False).records}
        for (dataset, sequence, name), alone in records.items():
            method = Method.parse(name)
            star = records.get((dataset, sequence, Method(method.base, UFM_STAR).name))
            if method.fusion == ALONE and star is not None and method.uses_aleatoric:
                change = {key: star.figures[key] - alone.figures[key] for key in FIGURES}
                result.append((method.base, alone.figures["overconfidence"], change))
    return result


def draw(foreign: list[Point], same: list[Point]) -> Figure:
    """One panel a figure; below the line UfM* is better than the network alone."""
    figure, axes = plt.subplots(1, len(FIGURES), figsize=(10, 3.3), layout="constrained")
    for axis, (key, name) in zip(axes, FIGURES.items(), strict=True):
        for kind, marker, listed in (("other rooms", "o", foreign), ("same rooms", "^", same)):
            for base in COLOURS:
                xy = [(x, change[key]) for b, x, change in listed if b == base]
                if xy:
                    label = f"{BASES[base][0]}, {kind}" if key == "nll" else None
                    axis.scatter(*zip(*xy, strict=True), s=26, marker=marker, color=COLOURS[base], label=label)
        axis.axhline(0, color="k", linewidth=1)
        axis.axvline(0, color="0.7", linewidth=1)
        if key == "nll":
            axis.set_yscale("symlog", linthresh=0.1)
        axis.set(title=f"change of {name}", xlabel="over-confidence of the network alone")
        axis.grid(alpha=0.3)
    axes[0].set_ylabel("UfM* less alone, negative = better")
    figure.legend(loc="outside right center", fontsize=7)
    return figure


def main() -> None:
    """See the module's text."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--foreign", type=Path, nargs="+", default=[], help="evaluations on other rooms")
    parser.add_argument("--same", type=Path, nargs="+", default=[], help="evaluations on the rooms of the training")
    parser.add_argument("--out", type=Path, required=True, help="picture")
    options = parser.parse_args()
    draw(points(options.foreign), points(options.same)).savefig(options.out, dpi=130)


if __name__ == "__main__":
    main()

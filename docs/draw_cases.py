"""The paper's cases A to E: when pointwise and Gaussian disagreement follow the error, and when they do not.

python docs/draw_cases.py --out docs/images/cases.png

A square of 1 m is seen by two views, each of which estimates every point of it. The point that is judged lies in its
left half, X = (-0.25 m, 0, 4 m); the region is the whole square.

| case | left half | right half |
|---|---|---|
| A | both views right | both views right |
| B | views wrong to different sides | the same |
| C | both views wrong by the same | the same |
| D | both views wrong by the same | views wrong to different sides |
| E | both views right | views wrong to different sides |
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from ufmstar_torch.eval.report.style import Look, finish, new_figure, save_figure
from ufmstar_torch.gaussian import floor_covariance, pointwise_disagreement, wasserstein_variance

WRONG = 0.6  # [m] of a view's estimate
DEPTH, SIDE, COUNT = 4.0, 1.0, 20  # [m], [m], points along a side
# Offsets along the ray of the left and right half [m], of the first view and the second.
OFFSETS: Mapping[str, tuple[tuple[float, float], tuple[float, float]]] = {
    "A": ((0.0, 0.0), (0.0, 0.0)),
    "B": ((-WRONG, -WRONG), (WRONG, WRONG)),
    "C": ((WRONG, WRONG), (WRONG, WRONG)),
    "D": ((WRONG, WRONG), (WRONG, -WRONG)),
    "E": ((0.0, WRONG), (0.0, -WRONG)),
}
WORDS = {
    "A": "right",
    "B": "views differ",
    "C": "wrong alike",
    "D": "C left, B right",
    "E": "A left, B right",
}
LOOKS = {"pointwise": Look("pointwise, √m_p", "#E69F00", "s"), "gaussian": Look("Gaussian, √m_g", "#0072B2", "o")}
VIEWS = ("#D55E00", "#0072B2")


@dataclass(frozen=True, eq=False)
class Case:
    """What two views see of the square.

    Attributes:
        estimates: [2, N, 3] of every point of it [m].
        error: of the judged point, the root mean square distance of its estimates [m].
        pointwise: m_p of the judged point [m^2].
        gaussian: m_g of the region [m^2].
    """

    estimates: Tensor
    error: float
    pointwise: float
    gaussian: float

    @classmethod
    def of(cls, left_and_right: tuple[tuple[float, float], tuple[float, float]]) -> Case:
        """From the offsets of both halves in both views [m]."""
        truth = square()
        halves = torch.tensor(left_and_right, dtype=torch.float64)
        offset = torch.where(truth[:, 0] < 0, halves[:, :1], halves[:, 1:])
        estimates = truth.expand(2, -1, 3).clone()
        estimates[..., 2] += offset
        judged = int((truth - torch.tensor([-SIDE / 4, 0.0, DEPTH])).norm(dim=1).argmin())
        point = estimates[:, judged]
        covariance = torch.stack([view.T.cov() for view in estimates])
        flat = torch.full((2,), 1e-6, dtype=torch.float64)  # the square is flat: a thickness of 1 mm
        return cls(
            estimates,
            error=float((point - truth[judged]).square().sum(-1).mean().sqrt()),
            pointwise=float(pointwise_disagreement(point)),
            gaussian=float(
                wasserstein_variance(estimates.mean(1), floor_covariance(covariance, flat), torch.ones(2).double())
            ),
        )


def square() -> Tensor:
    """[N, 3] points of the square [m]."""
    side = (torch.arange(COUNT, dtype=torch.float64) + 0.5) / COUNT * SIDE - SIDE / 2
    x, y = torch.meshgrid(side, side, indexing="xy")
    return torch.stack([x, y, torch.full_like(x, DEPTH)], -1).reshape(-1, 3)


def draw(cases: Mapping[str, Case]) -> Any:
    """The estimates from above, a panel a case; below, both disagreements against the error, as standard deviations."""
    figure = new_figure(2.1 * len(cases), 6.4, "Two views of a square, and what their disagreement says of the point +")
    grid = figure.add_gridspec(2, len(cases), height_ratios=(1.0, 1.3))
    for column, (name, case) in enumerate(cases.items()):
        axes = figure.add_subplot(grid[0, column])
        for view, colour, marker in zip(case.estimates, VIEWS, ("o", "x"), strict=True):
            axes.plot(view[:COUNT, 0], view[:COUNT, 2], linestyle="", marker=marker, markersize=4, color=colour)
        axes.plot([-SIDE / 2, SIDE / 2], [DEPTH, DEPTH], color="0.6", linewidth=1)
        axes.plot(-SIDE / 4, DEPTH, "k+", markersize=10)
        axes.set(ylim=(DEPTH - 1.6 * WRONG, DEPTH + 1.6 * WRONG))
        finish(axes, title=f"{name}: {WORDS[name]}", x="x [m]", y="z [m]" if column == 0 else "")
    below = figure.add_subplot(grid[1, :])
    for kind, look in LOOKS.items():
        points = {name: (case.error, getattr(case, kind) ** 0.5) for name, case in cases.items()}
        below.plot(*zip(*points.values(), strict=True), **look.line | {"linestyle": ""})
        named: dict[tuple[float, float], list[str]] = {}
        for name, (x, y) in points.items():
            named.setdefault((round(x, 6), round(y, 6)), []).append(name)
        for place, names in named.items():
            shift = (8, 6) if kind == "gaussian" else (-26, -3)
            words = ", ".join(names)
            below.annotate(words, place, xytext=shift, textcoords="offset points", color=look.colour)
    below.set_ylim(bottom=-0.08)
    below.plot([0, 1.1 * WRONG], [0, 1.1 * WRONG], linestyle="--", color="0.6", label="as large as the error")
    below.legend(frameon=False, fontsize=8)
    finish(below, x="error of the point [m]", y="disagreement [m]")
    return figure


def main() -> None:
    """See the module's text."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="picture")
    cases = {name: Case.of(offsets) for name, offsets in OFFSETS.items()}
    for name, case in cases.items():
        print(f"| {name} | {case.error:.2f} | {case.pointwise:.2f} | {case.gaussian:.2f} |")
    save_figure(draw(cases), parser.parse_args().out)


if __name__ == "__main__":
    main()

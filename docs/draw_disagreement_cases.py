"""Draws the paper's five cases of pointwise and Gaussian multiview disagreement, A to E.

    python docs/draw_disagreement_cases.py

writes docs/images/disagreement_cases.png. A surface is seen by two views; the figures are those of its left half.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from matplotlib.patches import Ellipse
from torch import Tensor

from ufmstar_torch.eval.report import style
from ufmstar_torch.eval.run.colours import FAINT, INK
from ufmstar_torch.gaussians.gaussian import pointwise_disagreement, wasserstein_variance

FILE = Path(__file__).parent / "images" / "disagreement_cases.png"
# Error in depth [m] of the left and the right half in the first view, then in the second.
ERRORS: Mapping[str, tuple[tuple[float, float], tuple[float, float]]] = {
    "A": ((0.0, 0.0), (0.0, 0.0)),
    "B": ((-0.3, -0.3), (0.3, 0.3)),
    "C": ((0.3, 0.3), (0.3, 0.3)),
    "D": ((0.3, -0.3), (0.3, 0.3)),
    "E": ((0.0, -0.3), (0.0, 0.3)),
}
TITLES = {
    "A": "right", "B": "inconsistently wrong", "C": "consistently wrong", "D": "left: consistently wrong",
    "E": "left: right",
}  # fmt: skip
COLOURS = ("#c0392b", "#2980b9")  # of the views
SIDE, RELIEF, DISTANCE = 9, 0.02, 2.0  # points per side; amplitude of the surface, and its distance [m]


@dataclass(frozen=True, eq=False)
class Case:
    """Two views of one surface: their points [2, P, 3] and the true ones [P, 3] [m], and the left half [P]."""

    points: Tensor
    truth: Tensor
    left: Tensor

    @property
    def error(self) -> float:
        """Root of the mean squared distance of the left half's points from the surface [m]."""
        return float((self.points - self.truth)[:, self.left].square().sum(-1).mean().sqrt())

    @property
    def pointwise(self) -> float:
        """Mean m_p of the left half's points [m^2]."""
        return float(pointwise_disagreement(self.points.transpose(0, 1))[self.left].mean())

    @property
    def gaussian(self) -> float:
        """m_g of the whole surface [m^2], which the left half has as well."""
        means, covariances = self.points.mean(1), torch.stack([points.T.cov() for points in self.points])
        return float(wasserstein_variance(means, covariances, torch.ones(2, dtype=torch.float64)))


def make_case(name: str) -> Case:
    """A case by its letter."""
    x, y = (axis.flatten() for axis in np.meshgrid(*[np.linspace(-0.5, 0.5, SIDE)] * 2))
    relief = RELIEF * np.sin(12 * x) * np.cos(9 * y)  # a plane has no positive definite covariance
    truth = torch.from_numpy(np.stack([x, y, DISTANCE + relief], -1))
    left = truth[:, 0] < -1e-9
    errors = torch.stack([torch.where(left, *torch.tensor(view, dtype=torch.float64)) for view in ERRORS[name]])
    return Case(truth + torch.stack([torch.zeros_like(errors)] * 2 + [errors], -1), truth, left)


def draw() -> None:
    """Draw the cases from above, and their disagreement against the error."""
    figure = style.new_figure(15.0, 3.1, "Pointwise and Gaussian disagreement of two views")
    *panels, plot = figure.subplots(1, len(ERRORS) + 1, width_ratios=[1] * len(ERRORS) + [1.5])
    for panel, name in zip(panels, ERRORS, strict=True):
        case = make_case(name)
        middle = case.truth[:, 1].abs() < 1e-9
        panel.plot(*case.truth[middle][:, [0, 2]].T, color=INK, linewidth=1.0)
        for points, colour, shift in zip(case.points, COLOURS, (-0.008, 0.008), strict=True):
            panel.plot(points[middle, 0] + shift, points[middle, 2], "o", color=colour, markersize=3)
            flat = points[:, [0, 2]]
            values, axes = torch.linalg.eigh(flat.T.cov())
            width, height = (4 * values.sqrt()).tolist()
            angle = float(torch.rad2deg(torch.atan2(axes[1, 0], axes[0, 0])))
            how = {"fill": False, "edgecolor": colour, "linewidth": 1.2}
            panel.add_patch(Ellipse(flat.mean(0).tolist(), width, height, angle=angle, **how))
        panel.set(xlim=(-0.8, 0.8), ylim=(DISTANCE - 0.9, DISTANCE + 0.9), aspect="equal")
        style.finish(panel, title=f"{name}: {TITLES[name]}", x="x [m]", y="depth [m]" if name == "A" else "")
    plot.plot([0, 0.5], [0, 0.5], "--", color=FAINT, linewidth=1.0, label="the error")
    for kind, colour, marker, size in (("pointwise", "#E69F00", "s", 9), ("gaussian", "#0072B2", "o", 5)):
        places: dict[tuple[float, float], str] = {}
        for name in ERRORS:
            case = make_case(name)
            place = round(case.error, 3), round(max(0.0, getattr(case, kind)) ** 0.5, 3)
            places[place] = ", ".join(filter(None, (places.get(place), name)))
        plot.plot(*zip(*places, strict=True), marker, color=colour, markersize=size, label=f"{kind}, √m", linestyle="")
        for (x, y), names in places.items():
            where = (x + 0.015, y + (0.012 if kind == "gaussian" else -0.045))
            plot.annotate(names, where, color=colour, size=style.LABEL)
    plot.set(xlim=(-0.05, 0.55), ylim=(-0.06, 0.55))
    style.finish(plot, title="left half", x="error [m]", y="√ disagreement [m]")
    style.name_lines(plot)
    style.save_figure(figure, FILE)


if __name__ == "__main__":
    draw()

"""What views of a surface point disagree about: the error that they do not share, and how UfM* measures it.

    python docs/measure_views.py share --root ../shared
    python docs/measure_views.py parts --root ../shared

print the tables of docs/results/analysis.md.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import torch
from clips import Clip, Map, add_sources, clips, estimate, line, shown
from numpy.typing import NDArray

from ufmstar_torch import UfMStar
from ufmstar_torch.camera import relative_pose
from ufmstar_torch.correspond import correspond
from ufmstar_torch.eval.methods.ufm import UfM
from ufmstar_torch.gaussian import wasserstein_squared

Array = NDArray[np.float64]
EVERY = 8  # [px] between the surface points of a frame; every second frame has some
SAME_SURFACE = 0.03  # relative difference of the true depths up to which a view sees the point itself
OFTEN = 5  # views


@dataclass(frozen=True, eq=False)
class Points:
    """Surface points, and what all views say of them: errors e = d - g, matched by the true geometry.

    Attributes:
        at: [3, P] frame, row and column of the pixel that chose the point.
        views: [P] n.
        total: [P] sum of e [m].
        squares: [P] sum of e^2 [m^2].
    """

    at: NDArray[np.intp]
    views: Array
    total: Array
    squares: Array

    @property
    def varying(self) -> Array:
        """[P] unbiased variance of e over the views [m^2]; n >= 2."""
        return (self.squares - self.total**2 / self.views) / (self.views - 1)

    def often(self) -> Points:
        """Those that many views see."""
        kept = self.views >= OFTEN
        return Points(self.at[:, kept], self.views[kept], self.total[kept], self.squares[kept])


def surface_points(clip: Clip) -> Points:
    """See :class:`Points`."""
    height, width = clip.depth.shape[1:]
    grid = np.mgrid[EVERY // 2 : height : EVERY, EVERY // 2 : width : EVERY].reshape(2, -1)
    parts = []
    for i in range(0, len(clip.depth), 2):
        v, u = grid[:, clip.truth[i][tuple(grid)] > 0]
        ray = np.linalg.inv(clip.K) @ np.stack([u, v, np.ones_like(u)]).astype(np.float64)
        world = clip.pose[i, :3, :3] @ (ray * clip.truth[i, v, u]) + clip.pose[i, :3, 3:]
        sums = sum(_seen_by(clip, j, world) for j in range(len(clip.depth)))
        parts.append(np.concatenate([np.stack([np.full_like(v, i), v, u]), sums]))
    every = np.concatenate(parts, axis=1)
    return Points(every[:3].astype(np.intp), every[3], every[4], every[5])


def _seen_by(clip: Clip, j: int, world: Array) -> Array:
    """[3, P] 1, e and e^2 of the points [3, P] in view j, 0 where it does not see them."""
    height, width = clip.depth.shape[1:]
    x, y, z = clip.pose[j, :3, :3].T @ (world - clip.pose[j, :3, 3:])
    ahead = np.maximum(z, 1e-6)
    column = np.round(clip.K[0, 0] * x / ahead + clip.K[0, 2]).clip(-1, width).astype(np.intp)
    row = np.round(clip.K[1, 1] * y / ahead + clip.K[1, 2]).clip(-1, height).astype(np.intp)
    seen = (z > 0) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
    row, column = row.clip(0, height - 1), column.clip(0, width - 1)
    truth = clip.truth[j, row, column].astype(np.float64)
    seen &= np.abs(truth - z) < SAME_SURFACE * z
    error = np.where(seen, clip.depth[j, row, column] - truth, 0.0)
    return np.stack([seen, error, error**2])


def share(clip: Clip) -> None:
    """MSE, the share of it that varies between views, and how much of the varying part UfM and UfM* state."""
    points = surface_points(clip).often()
    mse, varying = (points.squares / points.views).mean(), points.varying.mean()
    d, g = (maps[clip.known].astype(np.float64) for maps in (clip.depth, clip.truth))
    one_scale = ((d * (d @ g) / (d @ d) - g) ** 2).mean() / ((d - g) ** 2).mean()
    stated = (estimate(clip, UfM()), estimate(clip, UfMStar()))
    means = (float(v[tuple(points.at)].mean(dtype=np.float64)) for v in stated)
    words = (points.views.mean(), mse, varying / mse, one_scale, *(mean / varying for mean in means))
    line(clip.name, *map(shown, words))


def pairs(depth: Map, clip: Clip) -> Iterator[tuple[Array, Array]]:
    """Of every frame after the first: the matched pairs' W2^2 along the ray, across it, of the shapes [3, M] [m^2]; and
    their pixels [M]."""
    ufm, K = UfMStar(), torch.from_numpy(clip.K)[None]
    for i, d in enumerate(depth):
        pose, before = torch.from_numpy(clip.pose[i])[None], ufm.mixture
        current = ufm(torch.from_numpy(d)[None], pose, K).current_cam
        if i == 0:
            continue
        previous = before.to(torch.float64).rigid(*relative_pose(ufm.T_world_first, pose))
        match = correspond(previous, current, K, d.shape, ufm.config).match[0]
        c, k = match.nonzero(as_tuple=True)
        mean_c, mean_k = current.mean[0, c], previous.mean[0, k]
        apart = mean_c - mean_k
        along = (apart * mean_c / mean_c.norm(dim=-1, keepdim=True)).sum(-1).square()
        between_means = apart.square().sum(-1)
        whole = wasserstein_squared(mean_c, current.covariance[0, c], mean_k, previous.covariance[0, k])
        terms = torch.stack([along, between_means - along, whole - between_means])
        yield terms.numpy(), current.weight[0, c].double().numpy()


def parts(clip: Clip) -> None:
    """Mean W2^2 of the pairs, weighted with their pixels, of the predicted and of the true depth."""
    for what, depth in (("predicted", clip.depth), ("true", clip.truth)):
        result = list(pairs(depth, clip))
        terms, pixels = (np.concatenate(arrays, axis=-1) for arrays in zip(*result, strict=True))
        line(clip.name, what, *(f"{value:.4f}" for value in (terms * pixels).sum(1) / pixels.sum()))


TABLES: dict[str, Callable[[Clip], None]] = {"share": share, "parts": parts}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("table", choices=list(TABLES))
    add_sources(parser)
    arguments = parser.parse_args()
    for clip in clips(arguments):
        TABLES[arguments.table](clip)


if __name__ == "__main__":
    main()

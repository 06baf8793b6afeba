"""Motion as a second explanation of evidence: the surface moves, and its matched depth is wrong.

Where a surface moves along its epipolar line, matching measures a wrong depth. The evidence then asks for another
ratio of depth and prediction, y, than other surfaces:

    y = c + b_u u + b_v v + e.

Over the surfaces of a stream that stand still, e is Student-t distributed with two degrees of freedom and the scale s
("between"). c is the most probable constant of the frame by this density and a normal prior about its running mean
("centre"), so that a large thing that moves does not shift it, as it shifts b. b's slope in log d is left out, because
it would follow a near thing. s is the most likely scale of the recent frames. With motion, e is normal with the
variance s^2 + ``_MOVING``^2. The log odds of motion at a node are

    l = ``_PRIOR`` + ``_WEIGHT`` mean(r) + log(a exp(``_WEIGHT`` mean(q)) + (1 - a) e^m),
    r = (1 - distance/reach) log(N(e; s^2 + _MOVING^2)/t_2(e; s)).

m is the log likelihood ratio of the tests in the images (``anchors.motion``), and a the share of motion that passes all
tests. Such a thing follows the camera and looks farther than it is: e < 0 has the probability ``_NEARER``, and q is the
log ratio of this one-sided density and the symmetric one, times 1 - distance/reach. The means are over neighbouring
nodes of similar predicted depth, in a Gaussian window: the network bounds the region that moves. A surface counts as
still unless there is evidence of motion: the probability of motion is P = max(0, (sigma(l) - c_0)/(1 - c_0)).

An anchor with |y - c| above ``_FARTHEST`` s and log F (``farthest``), by c and s of the frames before, is no evidence:
a thing that keeps the camera's speed has no parallax, and its anchors, nearly infinitely far, would pull the field of
the surfaces around. r is ``_BEYOND`` for such anchors, by their share in the node. Where they are the majority, c is
wrong and all count.

With the probability P, the depth is that of the prediction at the scale of most surfaces: e is normal with the variance
w (``update``). The stated depth stays that of the evidence, which is right more often than the prediction even where P
exceeds one half; its variance is the second moment about it. P adds to the probability p of another surface:
1 - (1 - p)(1 - P).

The constants are fitted to eight tours with six moving things each, FastDepth and the demo's network; ``_NEARER`` to
six tours with and without things that move, FastDepth, an exact network and one that errs by another factor in every
cube of space.
"""

from __future__ import annotations

import math

import numpy as np

from ufmstar_torch.kernels.compile_cpu import reordered
from ufmstar_torch.posterior.config import PosteriorConfig
from ufmstar_torch.posterior.running import Floats, Running
from ufmstar_torch.posterior.scene import AnchorRows, Scene

# Standard deviation of log depth that motion adds; probability that motion that passes all tests looks nearer.
_MOVING, _NEARER = 0.8, 0.05
# Log odds of motion without evidence, share a, weight of the ratio's likelihood, and c_0.
_PRIOR, _PASSING, _WEIGHT, _CERTAIN = -1.57, 0.12, 1.06, 0.15
# Window of the mean: standard deviation and half width [nodes], and difference of log d at which a weight is halved.
_SIGMA, _HALF, _CONTRAST = 1.5, 3, 0.3
# Number of nodes that count as one surface in the choice of c, and as one anchor in the estimate of s.
_SURFACE, _ANCHOR = 40.0, 8.0
# Largest |y - c| of evidence over s, the 99 % quantile of |t_2|; and the log ratio of motion where all is beyond.
_FARTHEST, _BEYOND = 9.92, 50.0
# Standard deviation of c about its running mean; number of first candidates, and of iterations.
_CHANGE, _CANDIDATES, _ITERATIONS = 0.15, 33, 8


def plausible(
    anchors: AnchorRows, running: Running, image: tuple[int, ...], size: tuple[int, int], config: PosteriorConfig
) -> tuple[AnchorRows, Floats]:
    """The anchors whose ratio a surface that stands still may have, and [R C] the share of the others at every node.

    Args:
        anchors: of the frame.
        running: up to the frame before.
        image: H and W of the depth map.
        size: R and C of the nodes.
        config: of the posterior.
    """
    c, limit = running.ratios.centre, max(_FARTHEST * math.sqrt(running.ratios.between), math.log(config.farthest))
    far = anchors.valid & (np.abs(np.log(anchors.depth / anchors.predicted) - c) > limit)
    if not running.frames or 2 * far.sum() > anchors.valid.sum():
        return anchors, np.zeros(size[0] * size[1])
    cell = (anchors.pixel + 0.5) * (size[1], size[0]) // (image[1], image[0])
    node = cell.clip(0, (size[1] - 1, size[0] - 1)).astype(np.int64) @ (1, size[1])
    count, beyond = (np.bincount(node, mask, size[0] * size[1]) for mask in (anchors.valid, far))
    return anchors._replace(valid=anchors.valid & ~far), beyond / np.maximum(count, 1)


def surfaces(
    scene: Scene, b: Floats, running: Running, config: PosteriorConfig
) -> tuple[float, dict[str, tuple[float, float]]]:
    """The constant c of a frame, and the sums for the ratios "centre" and "between" (``running``).

    Each iteration computes c for s by a step of iterated reweighting, and s for c. The first starts at the most
    probable of some quantiles of y - b_u u - b_v v.

    Args:
        scene: of the frame.
        b: [4] coefficients of the frame.
        running: up to the frame before.
        config: of the posterior.
    """
    observed, nu, s2 = scene.observed, config.degrees_of_freedom, running.ratios.between
    mean, variance = running.ratios.centre, _CHANGE**2 if running.frames else config.prior_sigma**2
    weights = np.bincount(observed.node, 1 / scene.noise, len(scene.grid.log_depth))
    seen = np.flatnonzero(weights)
    if not len(seen):
        return mean, {"centre": (0.0, 0.0), "between": (0.0, 0.0)}
    weighted = (observed.value - in_image(observed.features, b)) / scene.noise
    y = np.bincount(observed.node, weighted, len(weights))[seen] / weights[seen]
    candidates, count = np.append(_quantiles(y), mean), len(y) / _ANCHOR
    loss = (nu + 1) / 2 * np.log1p((y[:, None] - candidates) ** 2 / s2 / nu).sum(0) / _SURFACE
    c, square = float(candidates[(loss + (candidates - mean) ** 2 / variance / 2).argmin()]), 0.0
    for _ in range(_ITERATIONS):
        weight = (nu + 1) / (nu + (y - c) ** 2 / s2)
        precision = weight / s2 / _SURFACE
        c = float((precision @ y + mean / variance) / (precision.sum() + 1 / variance))
        square = float((weight * (y - c) ** 2).mean())
        s2 = running.after("between", square * count, count, config)
    return c, {"centre": (c * count, count), "between": (square * count, count)}


def _quantiles(y: Floats) -> Floats:
    """Some quantiles of y [n], as ``np.quantile``, which takes ten times as long."""
    return np.interp(np.linspace(0.02, 0.98, _CANDIDATES), np.linspace(0, 1, len(y)), np.sort(y))


def in_image(x: Floats, b: Floats) -> Floats:
    """[N] b_u u + b_v v for features x [N, 4]."""
    part: Floats = x[:, 2:] @ b[2:]
    return part


def tests_at(motion: Floats, height: int, width: int, rows: int, cols: int) -> Floats:
    """[rows cols] log likelihood ratios of motion at the nodes of a map: means of the points ``motion`` [M, 3] (u, v,
    ratio) around them, with bilinear weights; 0 where there is none."""
    finite = motion[np.isfinite(motion).all(1)]
    sums, weights = np.zeros((2, rows, cols))
    u, v = (finite[:, 0] + 0.5) / width * cols - 0.5, (finite[:, 1] + 0.5) / height * rows - 0.5
    _spread(u, v, finite[:, 2], sums, weights)
    mean: Floats = (sums / np.maximum(weights, 1e-9)).ravel()
    return mean


@reordered
def _spread(u, v, value, sums, weights):
    rows, cols = sums.shape
    for k in range(len(value)):
        for i in range(max(int(v[k]), 0), min(int(v[k]) + 2, rows)):
            for j in range(max(int(u[k]), 0), min(int(u[k]) + 2, cols)):
                w = max(1 - abs(v[k] - i), 0.0) * max(1 - abs(u[k] - j), 0.0)
                sums[i, j] += w * value[k]
                weights[i, j] += w


def probability(
    e: Floats, log_depth: Floats, away: Floats, tests: Floats, beyond: Floats, between: float, size: tuple[int, int]
) -> Floats:
    """[n] probability P that the surface at a node moves.

    Args:
        e: [n] ratios less those of most surfaces.
        log_depth: [n] of the prediction.
        away: [n] distance from evidence as a share of ``reach``.
        tests: [n] from :func:`tests_at`.
        beyond: [n] from :func:`plausible`.
        between: s^2, the squared scale of e over still surfaces.
        size: R and C of the nodes.
    """
    variance, square, near = between + _MOVING**2, e**2, np.maximum(1 - away, 0)
    moving = -(square / variance + math.log(2 * math.pi * variance)) / 2
    still = -1.5 * np.log1p(square / between / 2) - math.log(2 * math.sqrt(2 * between))
    side = np.where(e > 0, math.log(2 * (1 - _NEARER)), math.log(2 * _NEARER))
    means = np.zeros((2, *size))
    ratio = (1 - beyond) * near * (moving - still) + beyond * _BEYOND
    for value, mean in zip((ratio, near * side), means, strict=True):
        _mean_around(value.reshape(size), log_depth.reshape(size), mean)
    r, q = _WEIGHT * means.reshape(2, -1)
    odds = _PRIOR + r + np.log(_PASSING * np.exp(q) + (1 - _PASSING) * np.exp(tests))
    P: Floats = np.maximum(1 / (1 + np.exp(-odds.clip(-50, 50))) - _CERTAIN, 0) / (1 - _CERTAIN)
    return P


@reordered
def _mean_around(value, log_depth, out):
    rows, cols = value.shape
    window = np.empty((2 * _HALF + 1, 2 * _HALF + 1))
    for i in range(-_HALF, _HALF + 1):
        for j in range(-_HALF, _HALF + 1):
            window[i + _HALF, j + _HALF] = math.exp(-(i * i + j * j) / (2 * _SIGMA * _SIGMA))
    for r in range(rows):
        for c in range(cols):
            total = weights = 0.0
            for i in range(max(r - _HALF, 0), min(r + _HALF + 1, rows)):
                for j in range(max(c - _HALF, 0), min(c + _HALF + 1, cols)):
                    jump = (log_depth[i, j] - log_depth[r, c]) / _CONTRAST
                    w = window[i - r + _HALF, j - c + _HALF] / (1 + jump * jump)
                    total += w * value[i, j]
                    weights += w
            out[r, c] = total / weights

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

The relative variance of a surface is at least ``LEAST``: what moves by a few hundredths of the camera's motion fails no
test, and no ratio shows it.

The constants are fitted to eight tours with six moving things each, FastDepth and the demo's network; ``_NEARER`` to
six tours with and without things that move, FastDepth, an exact network and one that errs by another factor in every
cube of space.
"""

from __future__ import annotations

import math

import numpy as np

from ufmstar_torch.kernels.compile_cpu import empty, leaf, part, reordered_leaf
from ufmstar_torch.posterior.moments import quantile
from ufmstar_torch.posterior.running import BETWEEN, CENTRE, after_frame
from ufmstar_torch.posterior.scene import AnchorRows, node_of

# Standard deviation of log depth that motion adds; probability that motion that passes all tests looks nearer.
_MOVING, _NEARER = 0.8, 0.05
# Log odds of motion without evidence, share a, weight of the ratio's likelihood, and c_0.
_PRIOR, _PASSING, _WEIGHT, _CERTAIN = -1.57, 0.12, 1.06, 0.15
# Least variance over the squared depth, where images are tested for motion.
LEAST = 0.02**2
# Window of the mean: standard deviation and half width [nodes], and difference of log d at which a weight is halved.
_SIGMA, _HALF, _CONTRAST = 1.5, 3, 0.3
_WIDE = 2 * _HALF + 1
# Number of nodes that count as one surface in the choice of c, and as one anchor in the estimate of s.
_SURFACE, _ANCHOR = 40.0, 8.0
# Largest |y - c| of evidence over s, the 99 % quantile of |t_2|; and the log ratio of motion where all is beyond.
_FARTHEST, _BEYOND = 9.92, 50.0
# Standard deviation of c about its running mean; number of first candidates, the lowest of them as a quantile, and
# number of iterations.
_CHANGE, _CANDIDATES, _LOWEST, _ITERATIONS = 0.15, 33, 0.02, 8
_LARGE = 1e100  # limit of a product: a further factor stays in range


@part
def plausible(anchors, frames, ratios, size, grid, config):
    """The :class:`AnchorRows` whose ratio a surface that stands still may have, and [R C] the share of the others at
    every node. ``frames`` with anchors, and the ``ratios``, are those before; ``size`` is H and W."""
    valid, n, far, total = empty(anchors.valid.size, np.bool_), grid.log_depth.size, 0, 0
    beyond, count = empty(n, np.float64), empty(n, np.float64)
    for i in range(n):
        beyond[i] = count[i] = 0.0
    limit = max(_FARTHEST * math.sqrt(ratios[BETWEEN]), math.log(config.farthest))
    for k in range(valid.size):
        y = math.log(anchors.depth[k] / anchors.predicted[k])
        valid[k] = anchors.valid[k] and abs(y - ratios[CENTRE]) <= limit
        total += anchors.valid[k]
        far += anchors.valid[k] and not valid[k]
    if frames == 0 or 2 * far > total:
        return anchors, beyond
    for k in range(valid.size):
        if anchors.valid[k]:
            i = node_of((anchors.pixel[k, 0] + 0.5) / size[1], (anchors.pixel[k, 1] + 0.5) / size[0], grid)
            count[i] += 1
            beyond[i] += not valid[k]
    for i in range(n):
        beyond[i] /= max(count[i], 1.0)
    rows = AnchorRows(anchors.pixel, anchors.at_pixel, anchors.predicted, anchors.depth, anchors.variance, valid)
    return rows, beyond


@part
def surfaces(scene, b, memory, priors, ratios, config, sums):
    """The constant c of a frame with the coefficients ``b`` [4]; writes the ``sums`` [2, R] for the ratios "centre" and
    "between" (``running``). ``memory`` and ``ratios`` are those before.

    Each iteration computes c for s by a step of iterated reweighting, and s for c. The first starts at the most
    probable of some quantiles of y - b_u u - b_v v.
    """
    nu, s2, mean = config.degrees_of_freedom, ratios[BETWEEN], ratios[CENTRE]
    variance = _CHANGE**2 if memory.frames[0] > 0 else config.prior_sigma**2
    y = _at_nodes(scene, b)
    if not y.size:
        return mean
    c, count, square = _first(y, mean, variance, s2, nu), y.size / _ANCHOR, 0.0
    for _ in range(_ITERATIONS):
        total, precision, squares = 0.0, 0.0, 0.0
        for i in range(y.size):
            share = (nu + 1) / (nu + (y[i] - c) ** 2 / s2) / s2 / _SURFACE
            precision += share
            total += share * y[i]
        before = c
        c = (total + mean / variance) / (precision + 1 / variance)
        for i in range(y.size):
            squares += (nu + 1) / (nu + (y[i] - before) ** 2 / s2) * (y[i] - c) ** 2
        square = squares / y.size
        above, below = after_frame(memory, priors, BETWEEN, square * count, count, config)
        s2 = above / below
    sums[0, CENTRE], sums[1, CENTRE] = c * count, count
    sums[0, BETWEEN], sums[1, BETWEEN] = square * count, count
    return c


@part
def _at_nodes(scene, b):
    """[n] means of y - b_u u - b_v v at the nodes with anchors, weighted by 1/noise."""
    observed, size = scene.observed, scene.grid.log_depth.size
    total, weights, count = empty(size, np.float64), empty(size, np.float64), 0
    for i in range(size):
        total[i] = weights[i] = 0.0
    for k in range(observed.node.size):
        i, weight = observed.node[k], 1 / scene.noise[k]
        count += weights[i] == 0
        weights[i] += weight
        total[i] += weight * (observed.value[k] - in_image(observed.features, k, b))
    y, n = empty(count, np.float64), 0
    for i in range(size):
        if weights[i] > 0:
            y[n] = total[i] / weights[i]
            n += 1
    return y


@part
def _first(y, mean, variance, s2, nu):
    """The most probable candidate for c: quantiles of y [n], and the running mean."""
    ordered, best, least = empty(y.size, np.float64), mean, np.inf
    for i in range(y.size):
        ordered[i] = y[i]
    for k in range(_CANDIDATES + 1):
        c = mean
        if k < _CANDIDATES:
            c = quantile(ordered, _LOWEST + (1 - 2 * _LOWEST) * k / (_CANDIDATES - 1))
        loss, product = 0.0, 1.0
        for i in range(y.size):
            product *= 1 + (y[i] - c) ** 2 / s2 / nu
            if product > _LARGE:  # one logarithm for several factors
                loss, product = loss + math.log(product), 1.0
        loss = (nu + 1) / 2 / _SURFACE * (loss + math.log(product)) + (c - mean) ** 2 / variance / 2
        if loss < least:
            best, least = c, loss
    return best


@leaf
def in_image(x, k, b):
    """b_u u + b_v v for the features ``x[k]``."""
    return x[k, 2] * b[2] + x[k, 3] * b[3]


@part
def tests_at(motion, height, width, rows, cols):
    """[rows cols] log likelihood ratios of motion at the nodes of a map: means of the points ``motion`` [M, 3] (u, v,
    ratio) around them, with bilinear weights; 0 where there is none."""
    sums, weights = empty(rows * cols, np.float64), empty(rows * cols, np.float64)
    for i in range(sums.size):
        sums[i] = weights[i] = 0.0
    for k in range(motion.shape[0]):
        u, v = (motion[k, 0] + 0.5) / width * cols - 0.5, (motion[k, 1] + 0.5) / height * rows - 0.5
        if not _finite(motion, k):
            continue
        for i in range(max(int(v), 0), min(int(v) + 2, rows)):
            for j in range(max(int(u), 0), min(int(u) + 2, cols)):
                w = max(1 - abs(v - i), 0.0) * max(1 - abs(u - j), 0.0)
                sums[i * cols + j] += w * motion[k, 2]
                weights[i * cols + j] += w
    for i in range(sums.size):
        sums[i] /= max(weights[i], 1e-9)
    return sums


@part
def tested(motion):
    """True if a point of ``motion`` [M, 3] has no NaN and no infinity."""
    found = False
    for k in range(motion.shape[0]):
        found |= _finite(motion, k)
    return found


@leaf
def _finite(motion, k):
    return math.isfinite(motion[k, 0]) and math.isfinite(motion[k, 1]) and math.isfinite(motion[k, 2])


@part
def probability(e, log_depth, away, tests, beyond, between, rows, cols):
    """[n] probability P that the surface at a node moves.

    Args:
        e: [n] ratios less those of most surfaces.
        log_depth: [n] of the prediction.
        away: [n] distance from evidence as a share of ``reach``.
        tests: [n] from :func:`tests_at`.
        beyond: [n] from :func:`plausible`.
        between: s^2, the squared scale of e over still surfaces.
        rows, cols: R and C of the nodes.
    """
    n, variance = e.size, between + _MOVING**2
    values, means, window = empty((2, n), np.float64), empty((2, n), np.float64), empty((_WIDE, _WIDE), np.float64)
    farther, nearer = math.log(2 * (1 - _NEARER)), math.log(2 * _NEARER)
    for i in range(n):
        square, near = e[i] * e[i], max(1 - away[i], 0.0)
        moving = -(square / variance + math.log(2 * math.pi * variance)) / 2
        still = -1.5 * math.log1p(square / between / 2) - math.log(2 * math.sqrt(2 * between))
        values[0, i] = (1 - beyond[i]) * near * (moving - still) + beyond[i] * _BEYOND
        values[1, i] = near * (farther if e[i] > 0 else nearer)
    _means_around(values, log_depth, rows, cols, window, means)
    P = empty(n, np.float64)
    for i in range(n):
        r, q = _WEIGHT * means[0, i], _WEIGHT * means[1, i]
        odds = _PRIOR + r + math.log(_PASSING * math.exp(q) + (1 - _PASSING) * math.exp(tests[i]))
        P[i] = max(1 / (1 + math.exp(-min(max(odds, -50.0), 50.0))) - _CERTAIN, 0.0) / (1 - _CERTAIN)
    return P


@reordered_leaf
def _means_around(values, log_depth, rows, cols, window, out):
    """Write the means of two rows of values [2, n] around every node."""
    for i in range(-_HALF, _HALF + 1):
        for j in range(-_HALF, _HALF + 1):
            window[i + _HALF, j + _HALF] = math.exp(-(i * i + j * j) / (2 * _SIGMA * _SIGMA))
    for r in range(rows):
        for c in range(cols):
            node, first, second, weights = r * cols + c, 0.0, 0.0, 0.0
            for i in range(max(r - _HALF, 0), min(r + _HALF + 1, rows)):
                for j in range(max(c - _HALF, 0), min(c + _HALF + 1, cols)):
                    other = i * cols + j
                    jump = (log_depth[other] - log_depth[node]) / _CONTRAST
                    w = window[i - r + _HALF, j - c + _HALF] / (1 + jump * jump)
                    first += w * values[0, other]
                    second += w * values[1, other]
                    weights += w
            out[0, node], out[1, node] = first / weights, second / weights

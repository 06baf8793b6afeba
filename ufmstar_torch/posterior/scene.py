"""A frame's nodes and anchors, the field fitted to them, and the parts of the resulting variance (numba; model:
``update``).

The nodes are cells of the image with links between neighbours. A link is weaker, the more the predicted depths of its
two nodes differ: across a depth edge, the network may err by another factor.

``config`` is the posterior's, as ``config.Constants``. Functions of one node or anchor take numbers.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ufmstar_torch.kernels.compile_cpu import empty, leaf, part
from ufmstar_torch.posterior.cells import cell_means, highest_over_lowest, windows_around
from ufmstar_torch.posterior.field import Observed, Prior, at, conditioned, distance, invert
from ufmstar_torch.posterior.running import AMPLITUDE, FEATURES, INLIER, NOISE, ROUGHNESS, Floats

# Largest number of nodes in a row and in a column (the field's window allows 31 in a row).
SIDE = 28
# Least divisor 1 - w v of a leave-one-out residual: it is 0 for a single anchor.
LEAST_LEFT = 0.05
# Largest probability that the local correction does not hold.
MOST_WRONG = 0.5


class AnchorRows(NamedTuple):
    """N anchors of one stream, as in ``Anchors``, whose ``index`` is ``at_pixel``."""

    pixel: Floats
    at_pixel: NDArray[np.int64]
    predicted: Floats
    depth: Floats
    variance: Floats
    valid: NDArray[np.bool_]


class Grid(NamedTuple):
    """R x C nodes of a depth map.

    Attributes:
        rows, cols: R and C.
        log_depth: [R C] mean of log d over the cell's valid pixels; the mean of all other cells if it has none.
        mean: m_0, mean of ``log_depth``.
        right, down: [R C] variance of the difference of y to the next node in the row, in the column; infinite at the
            border.
        far_right, far_down: [R C] lengths of the same links: size of a cell plus difference of log d times ``jump``.
    """

    rows: int
    cols: int
    log_depth: Floats
    mean: float
    right: Floats
    down: Floats
    far_right: Floats
    far_down: Floats


class Scene(NamedTuple):
    """A frame's nodes and N valid anchors, before the fit.

    Attributes:
        grid: the nodes.
        prior: of b and f.
        observed: the anchors.
        stated: [N] noise s^2/g^2 + alone/N.
        noise: [N] n: ``stated`` with roughness and blur^2.
        believed: [N] weight of an anchor in the learnt means: 1/(1 + n/weak_sigma^2).
        by_area: [N] ``believed`` over the number of anchors in the cell.
    """

    grid: Grid
    prior: Prior
    observed: Observed
    stated: Floats
    noise: Floats
    believed: Floats
    by_area: Floats


class LeftOut(NamedTuple):
    """Leave-one-out prediction of each anchor.

    Attributes:
        residual: [N] of y.
        total: [N] predicted variance of the residual.
    """

    residual: Floats
    total: Floats


@part
def grid_of(logs, valid, rows, cols, config):
    """The :class:`Grid` of log d [H, W], which is read where ``valid`` [H, W]."""
    log_depth, n, total = cell_means(logs, valid, rows, cols), rows * cols, 0.0
    right, down, far_right, far_down = (
        empty(n, np.float64), empty(n, np.float64), empty(n, np.float64), empty(n, np.float64),
    )  # fmt: skip
    for i in range(n):
        total += log_depth[i]
        edge = config.jump * abs(log_depth[i + 1] - log_depth[i]) if (i + 1) % cols else np.inf
        right[i], far_right[i] = config.link_variance + config.edge_variance * edge * edge, 1 / cols + edge
        edge = config.jump * abs(log_depth[i + cols] - log_depth[i]) if i + cols < n else np.inf
        down[i], far_down[i] = config.link_variance + config.edge_variance * edge * edge, 1 / rows + edge
    return Grid(rows, cols, log_depth, total / n, right, down, far_right, far_down)


@leaf
def features(log_depth, u, v, x, k):
    """Write the features ``x[k]`` for log d - m_0 at u and v from 0 to 1: 1, log d - m_0, u and v from -1 to 1."""
    x[k, 0], x[k, 1], x[k, 2], x[k, 3] = 1.0, log_depth, 2 * u - 1, 2 * v - 1


@leaf
def node_of(u, v, grid):
    """The node at u and v from 0 to 1."""
    column, row = min(max(int(u * grid.cols), 0), grid.cols - 1), min(max(int(v * grid.rows), 0), grid.rows - 1)
    return row * grid.cols + column


@part
def _scene_of(grid, depth, valid, anchors, ratios, expected, config):
    """The :class:`Scene` of the :class:`AnchorRows` of a frame of depth d [H, W] [m]. ``ratios`` and ``expected``
    (``running.expected``) are those of the frames before."""
    N, k, n = 0, 0, grid.log_depth.size
    for i in range(anchors.valid.size):
        N += anchors.valid[i]
    node, x, y = empty(N, np.int64), empty((N, FEATURES), np.float64), empty(N, np.float64)
    stated, noise, believed, by_area = (
        empty(N, np.float64), empty(N, np.float64), empty(N, np.float64), empty(N, np.float64),
    )  # fmt: skip
    for i in range(anchors.valid.size):
        if not anchors.valid[i]:
            continue
        u, v = (anchors.pixel[i, 0] + 0.5) / depth.shape[1], (anchors.pixel[i, 1] + 0.5) / depth.shape[0]
        node[k], log_depth, g = node_of(u, v, grid), math.log(anchors.predicted[i]), anchors.depth[i]
        features(log_depth - grid.mean, u, v, x, k)
        y[k] = math.log(g) - log_depth
        stated[k] = ratios[NOISE] * anchors.variance[i] / (g * g) + config.alone / N
        blur = math.log(highest_over_lowest(depth, valid, anchors.at_pixel[i])) / 2
        noise[k] = stated[k] + ratios[ROUGHNESS] + blur * blur
        believed[k] = by_area[k] = 1 / (1 + noise[k] / config.weak_sigma**2)
        k += 1
    count = counts(node, n)
    for k in range(N):
        by_area[k] /= count[node[k]]
    return Scene(grid, _prior(grid, ratios, expected, config), Observed(node, x, y), stated, noise, believed, by_area)


@part
def counts(node, n):
    """[n] number of anchors at every node, for the nodes [N] of anchors."""
    count = empty(n, np.float64)
    for i in range(n):
        count[i] = 0.0
    for k in range(node.size):
        count[node[k]] += 1
    return count


@part
def _prior(grid, ratios, expected, config):
    """The prior of b and f."""
    mean, precision = expected
    right, down = empty(grid.right.size, np.float64), empty(grid.down.size, np.float64)
    for i in range(right.size):
        right[i], down[i] = 1 / (grid.right[i] * ratios[AMPLITUDE]), 1 / (grid.down[i] * ratios[AMPLITUDE])
    invert(precision)
    return Prior(config.precision / ratios[AMPLITUDE], right, down, mean, precision, grid.cols)


@part
def fitted(grid, depth, valid, anchors, ratios, expected, config):
    """The :class:`Scene`; the field with robust weights; its :class:`LeftOut`; the anchors' weights [N]; and the
    distance of every node from evidence [n]. Arguments of :func:`_scene_of`; the covariance in ``expected`` is
    overwritten."""
    scene = _scene_of(grid, depth, valid, anchors, ratios, expected, config)
    weight, evidence = empty(scene.noise.size, np.float64), empty(scene.noise.size, np.bool_)
    for k in range(weight.size):
        weight[k] = 1 / scene.noise[k]
    first, left_out = _with_weights(scene, scene.prior, weight)
    for k in range(weight.size):
        excess = max(left_out.residual[k] ** 2 - left_out.total[k], 0.0) / (config.degrees_of_freedom + 1)
        weight[k] = 1 / (scene.noise[k] + excess)
        evidence[k] = weight[k] * config.weak_sigma**2 >= 1
    field, left_out = _with_weights(scene, _loosened(scene.prior, first.offset, config), weight)
    return scene, field, left_out, weight, away_from(grid, scene.observed.node, evidence, config)


@part
def _loosened(prior, f, config):
    """The prior with Student-t weights on the links: a link across a jump of the field's mean ``f`` is weaker."""
    nu, right, down = config.degrees_of_freedom, empty(f.size, np.float64), empty(f.size, np.float64)
    for i in range(f.size):
        x = f[i + 1] - f[i] if (i + 1) % prior.cols else 0.0
        right[i] = prior.right[i] * (nu + 1) / (nu + prior.right[i] * x * x)
        x = f[i + prior.cols] - f[i] if i + prior.cols < f.size else 0.0
        down[i] = prior.down[i] * (nu + 1) / (nu + prior.down[i] * x * x)
    return Prior(prior.diagonal, right, down, prior.mean, prior.precision, prior.cols)


@part
def _with_weights(scene, prior, weight):
    """The field for anchors of precision ``weight`` [N]."""
    field, observed = conditioned(prior, scene.observed, weight), scene.observed
    residual, total = empty(weight.size, np.float64), empty(weight.size, np.float64)
    for k in range(weight.size):
        mean, variance = at(field, observed.node[k], observed.features, k)
        divisor = max(1 - weight[k] * variance, LEAST_LEFT)
        residual[k], total[k] = (observed.value[k] - mean) / divisor, variance / divisor + scene.noise[k]
    return field, LeftOut(residual, total)


@part
def away_from(grid, node, evidence, config):
    """[n] geodesic distance of every node from the anchors of the mask ``evidence`` [N] at nodes [N], in image
    widths."""
    source = empty(grid.log_depth.size, np.bool_)
    for i in range(source.size):
        source[i] = False
    for k in range(node.size):
        if evidence[k]:
            source[node[k]] = True
    return distance(source, grid.far_right, grid.far_down, grid.cols, config.reach)


@part
def spread_around(scene, used, mean, config):
    """[n] variance of y around every node, over the anchors of the mask ``used`` [N], weighted ``by_area`` and by a
    Gaussian window, and one virtual anchor of the prior variance about ``mean``."""
    y, rows = scene.observed.value, empty((3, used.size), np.float64)
    for k in range(used.size):
        weight = scene.by_area[k] if used[k] else 0.0
        rows[0, k], rows[1, k], rows[2, k] = weight, weight * y[k], weight * y[k] * y[k]
    sums, around = windows_around(scene, rows, config.radius), empty(scene.grid.log_depth.size, np.float64)
    for i in range(around.size):
        total = sums[0, i] + 1
        middle = (sums[1, i] + mean) / total
        around[i] = max((sums[2, i] + mean * mean + config.prior_sigma**2) / total - middle * middle, 0.0)
    return around


@part
def local_scale(scene, left_out, used, config):
    """[n] factor by which errors around every node exceed the field's prediction: the mean leave-one-out z^2 of the
    anchors of the mask ``used`` [N] and of one virtual anchor with z^2 = 1. Gaussian windows and weights as in
    :func:`spread_around`."""
    rows, scale = empty((2, used.size), np.float64), empty(scene.grid.log_depth.size, np.float64)
    for k in range(used.size):
        weight = scene.by_area[k] if used[k] else 0.0
        rows[0, k] = weight
        rows[1, k] = weight * min(left_out.residual[k] ** 2 / left_out.total[k], config.clip)
    sums = windows_around(scene, rows, config.near)
    for i in range(scale.size):
        scale[i] = (sums[1, i] + 1) / (sums[0, i] + 1)
    return scale


@leaf
def wrong_factor(config, away, scale):
    """Factor on ``wrong``: the local ``scale`` of errors at the evidence, 1 from the distance ``radius`` on; ``away``
    is the distance."""
    return scale ** max(1 - away / config.radius, 0.0)


@leaf
def slopes_away(config, x, k, away, slopes):
    """Change of y at features ``x[k]`` and the distance ``away`` from evidence, where the mean slopes of the stream
    replace those of the frame: what its anchors show is no evidence far from them. ``slopes`` [3] are the mean ones
    less the frame's."""
    change = 0.0
    for f in range(slopes.size):
        change += x[k, 1 + f] * slopes[f]
    return away * away / (away * away + config.slope_reach**2) * change


@leaf
def unmeasured(config, variance):
    """Share in [0, 1] of the prior that is left: the squared share of the ``variance`` of b's constant in that before
    the first anchor."""
    return min(variance / config.prior_sigma**2, 1.0) ** 2


@leaf
def misscaled(config, share, p, wide):
    """The probability of another surface and the variance of y there, raised towards ``misscaled`` and ``widest`` by
    the ``share`` that is ``unmeasured``."""
    return p + share * max(config.misscaled - p, 0.0), wide + share * (config.widest - wide)


@leaf
def inlier_factor(config, ratios, away):
    """Factor on the variance of y on the evidence's surface, at the distance ``away``: ``inlier`` at the evidence, 1
    from a disc's diameter on. Held-out anchors are no farther from the others."""
    return 1 + (ratios[INLIER] - 1) * max(1 - away / (2 * config.radius), 0.0)


@leaf
def elsewhere_variance(config, around, unseen):
    """Variance of y on another surface than the evidence's: the variance ``around`` of the anchors' y plus
    ``elsewhere`` times the variance ``unseen`` from the distance; at most ``widest``."""
    return min(around + config.elsewhere * unseen, config.widest)


@leaf
def at_pixels(config, factor, field, roughness, unseen, steep, share):
    """Variance of y at pixels on the evidence's surface, before the local scale: the parts that held-out anchors show,
    times factors from anchors to pixels. ``factor`` is h; the ``share`` that is ``unmeasured`` of the field's variance
    has no factor."""
    of_field = config.pixel_field + (1 - config.pixel_field) * share
    parts = of_field * field + config.pixel_roughness * roughness + config.pixel_unseen * unseen
    return factor * parts + config.pixel_steepness * steep

"""Sums for ``running`` by cross-validation (numba): one anchor of a frame, a disc, or a half of the image is held out.

Leave-one-out residuals give roughness and noise. For the other ratios, discs that move over the image are held out, and
the field of the other anchors predicts those in them. In every fourth frame a half of the image is held out instead: it
shows how errors grow farther from evidence than a disc reaches. Products of errors in neighbouring cells give the
amplitude, and their increase with the distance from evidence gives ``unseen``. ``wrong`` is the mean probability that
an anchor lies on another surface, weighted by area because corners cluster on textured surfaces. ``inlier`` is the mean
z^2 of the other anchors: outliers have widened the field's variance, and ``wrong`` accounts for them.
"""

from __future__ import annotations

import math

import numpy as np

from ufmstar_torch.kernels.compile_cpu import empty, leaf, part
from ufmstar_torch.posterior.cells import steepness
from ufmstar_torch.posterior.field import at, conditioned
from ufmstar_torch.posterior.moments import below, second_moments
from ufmstar_torch.posterior.running import AMPLITUDE, CALIBRATION, INLIER, NOISE, RATIOS, ROUGHNESS, UNSEEN, WRONG
from ufmstar_torch.posterior.scene import (
    MOST_WRONG,
    at_pixels,
    away_from,
    counts,
    elsewhere_variance,
    inlier_factor,
    local_scale,
    spread_around,
    wrong_factor,
)

# Variance of the difference between neighbouring nodes over the link's variance: on a square lattice, all other paths
# between the two nodes conduct as much as the link.
APART = 0.5
# With fewer other anchors none is held out: the field would be close to its prior.
LEAST_REST = 5
# Frames with anchors from one with a held-out half of the image to the next.
HALVES = 4
# Disc centres and the halves' directions follow this low-discrepancy sequence over the frames (R2, Roberts).
STEPS = (0.7548776662466927, 0.5698402909980532)


@part
def sums_of(scene, weight, left_out, ratios, frames, config):
    """Sums over a frame's anchors, and the scores of the held-out ones.

    Args:
        scene: of the frame.
        weight: [N] of the anchors (``scene.fitted``).
        left_out: leave-one-out predictions.
        ratios: up to the frame before.
        frames: number of frames with anchors before.
        config: of the posterior.

    Returns:
        [2, R] numerators and denominators to add to those of the ratios, 0 for "between" and "centre"; and [3, M] of
        the held-out anchors: CDF of the posterior at the depth, distance from evidence, and weight by area.
    """
    sums = empty((2, RATIOS), np.float64)
    for i in range(RATIOS):
        sums[0, i] = sums[1, i] = 0.0
    _add_neighbours(scene, left_out, ratios, config, sums)
    rest, held_out = empty(weight.size, np.bool_), _held_out(scene, frames, config)
    count = 0
    for k in range(weight.size):
        rest[k] = not held_out[k]
        count += rest[k]
    if count < LEAST_REST:
        for k in range(weight.size):
            held_out[k] = False
    scores = _add_held_out(scene, weight, left_out, ratios, rest, held_out, config, sums)
    return sums, scores


@leaf
def _add(sums, ratio, above, under):
    sums[0, ratio] += above
    sums[1, ratio] += under


@part
def _add_neighbours(scene, left_out, ratios, config, sums):
    """Add the sums for roughness and noise from the excess of squared leave-one-out residuals over their variance,
    weighted by the squared share of the quantity in that variance."""
    count = counts(scene.observed.node, scene.grid.log_depth.size)
    for k in range(scene.noise.size):
        variance, residual = left_out.total[k], left_out.residual[k]
        excess = min(residual * residual, config.clip * variance) - variance
        for ratio, value, term in (
            (ROUGHNESS, ratios[ROUGHNESS], ratios[ROUGHNESS]), (NOISE, ratios[NOISE], scene.stated[k]),
        ):  # fmt: skip
            w = (term / variance) ** 2 / count[scene.observed.node[k]]
            _add(sums, ratio, w * (term + excess) * value / max(term, 1e-12), w)


@part
def _add_held_out(scene, weight, left_out, ratios, rest, held_out, config, sums):
    """Add the sums for the other ratios, from held-out anchors; returns their scores."""
    grid, observed, M = scene.grid, scene.observed, 0
    of_rest, area = empty(weight.size, np.float64), empty(grid.log_depth.size, np.float64)
    for i in range(area.size):
        area[i] = 0.0
    for k in range(weight.size):
        of_rest[k] = weight[k] if rest[k] else 0.0
        if held_out[k]:
            area[observed.node[k]] += scene.believed[k]
            M += 1
    field = conditioned(scene.prior, observed, of_rest)
    b, steep = field.coefficients, steepness(field.offset, grid.rows, grid.cols)
    distances = away_from(grid, observed.node, rest, config)
    around, scales = spread_around(scene, rest, b[0], config), local_scale(scene, left_out, rest, config)
    scores, node, values, m = empty((3, M), np.float64), empty(M, np.int64), empty((4, M), np.float64), 0
    for k in range(weight.size):
        if not held_out[k]:
            continue
        i = observed.node[k]
        mean, variance = at(field, i, observed.features, k)
        offset, error = mean, observed.value[k] - mean
        for f in range(b.size):
            offset -= observed.features[k, f] * b[f]
        noise, away, scale, believed = scene.noise[k], distances[i], scales[i], scene.believed[k] / max(area[i], 1e-12)
        node[m], scores[1, m], scores[2, m] = i, away, believed
        values[0, m], values[1, m], values[2, m], values[3, m] = error, variance, away, noise
        unseen = away * ratios[UNSEEN]
        wide, factor = elsewhere_variance(config, around[i], unseen), inlier_factor(config, ratios, away)
        inlier, more_wrong = (
            scale * (factor * (variance + noise + unseen) + steep[i]), wrong_factor(config, away, scale),
        )  # fmt: skip
        p = min(ratios[WRONG] * more_wrong, MOST_WRONG)
        z2 = error * error / inlier - (error + offset) ** 2 / (noise + wide)
        # infinite odds of the evidence's surface make 0
        elsewhere = 1 / (1 + math.exp(-math.log(p / (1 - p)) - (math.log(inlier / (noise + wide)) + z2) / 2))
        stated = second_moments(config, inlier, p, offset, wide)[0]
        _add(sums, WRONG, believed * elsewhere, believed * more_wrong)
        _add(sums, INLIER, believed * (1 - elsewhere) * factor * error * error / inlier, believed * (1 - elsewhere))
        _add(sums, CALIBRATION, believed * error * error / stated, believed)
        # At a pixel there is neither an anchor's blur nor its part in ``alone``, only the noise of its measurement.
        measured = scene.stated[k] - config.alone / weight.size
        at_pixel = at_pixels(config, factor, variance, ratios[ROUGHNESS], unseen, steep[i], 0.0)
        moment, inlier = second_moments(config, scale * (at_pixel + measured), p, offset, wide + measured)
        scores[0, m] = below(math.exp(error), p, moment, inlier)
        m += 1
    _add_pairs(grid, node, values, ratios, sums)
    return scores


@part
def _add_pairs(grid, node, values, ratios, sums):
    """Add the sums for amplitude and unseen from the errors at pairs of neighbouring cells.

    The mean product of their errors is the covariance of the network's errors: noise and wrong anchors are independent
    between cells. An isolated cell contributes its squared error less its noise. The more pairs there are, the less
    isolated cells count.

    Args:
        grid: of the frame.
        node: [M] nodes of the held-out anchors.
        values: [4, M] error, its variance in the field, distance from evidence and noise.
        ratios: up to the frame before.
        sums: [2, R].
    """
    n = grid.log_depth.size
    count, means, alone = counts(node, n), empty((4, n), np.float64), empty(n, np.bool_)
    for i in range(n):
        alone[i] = count[i] > 0
        for c in range(4):
            means[c, i] = 0.0
    for m in range(node.size):
        for c in range(4):
            means[c, node[m]] += values[c, m] / count[node[m]]
    pairs, isolated = 0, 0
    for i in range(n):
        for other, link in ((i + 1 if (i + 1) % grid.cols else n, grid.right[i]), (i + grid.cols, grid.down[i])):
            if other < n and count[i] > 0 and count[other] > 0:
                alone[i] = alone[other] = False
                pairs += 1
                variance, away = (means[1, i] + means[1, other]) / 2, (means[2, i] + means[2, other]) / 2
                covariance = max(variance - APART * ratios[AMPLITUDE] * link / 2, 0.0)
                noise = (means[3, i] + means[3, other]) / 2
                _add_product(means[0, i] * means[0, other], covariance, variance, noise, away, 1.0, ratios, sums)
    for i in range(n):
        isolated += alone[i]
    share = isolated / max(isolated + pairs, 1)
    for i in range(n):
        if alone[i]:
            error, variance, away, noise = means[0, i], means[1, i], means[2, i], means[3, i]
            _add_product(
                error * error - noise / count[i], variance, variance, noise, away, share, ratios, sums
            )  # fmt: skip


@leaf
def _add_product(product, expected, variance, noise, away, share, ratios, sums):
    """Add a product of errors whose ``expected`` value holds without the error's growth with the distance."""
    weight = share / max(variance + noise, 1e-12)
    _add(sums, AMPLITUDE, weight * product, weight * expected / ratios[AMPLITUDE])
    _add(sums, UNSEEN, share * away * (product - expected), share * away * away)


@part
def _held_out(scene, frames, config):
    """[N] whether an anchor is held out: in every ``HALVES``-th frame by a half of the image, else by discs."""
    x, discs, number = scene.observed.features, int(config.discs), (frames + 1) / HALVES
    halved, angle = discs > 0 and number % 1 == 0, 2 * math.pi * STEPS[0] * number
    held_out = empty(x.shape[0], np.bool_)
    for k in range(x.shape[0]):
        held_out[k] = halved and math.cos(angle) * x[k, 2] + math.sin(angle) * x[k, 3] > 0
        for disc in range(0 if halved else discs):
            u = (frames * discs + disc + 1) * STEPS[0] % 1 - (x[k, 2] + 1) / 2
            v = (frames * discs + disc + 1) * STEPS[1] % 1 - (x[k, 3] + 1) / 2
            held_out[k] |= u * u + v * v < config.radius**2
    return held_out

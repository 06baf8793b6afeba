"""Updates ``running`` from a frame's anchors by cross-validation: one anchor, or a disc of anchors, is held out.

Leave-one-out residuals give roughness and noise. For the other ratios, discs that move over the image are held out, and
the field of the other anchors predicts those in them. Products of errors in neighbouring cells give the amplitude, and
their increase with the distance from evidence gives ``unseen``. ``wrong`` is the mean probability that an anchor lies
on another surface, weighted by area because corners cluster on textured surfaces. ``inlier`` is the mean z^2 of the
other anchors: outliers have widened the field's variance, and ``wrong`` accounts for them.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ufmstar_torch.posterior.conformal import image_weights
from ufmstar_torch.posterior.field import Field, at, conditioned
from ufmstar_torch.posterior.moments import score
from ufmstar_torch.posterior.running import Floats, Running
from ufmstar_torch.posterior.scene import (
    MOST_WRONG,
    LeftOut,
    Scene,
    at_pixels,
    away_from,
    elsewhere_variance,
    inlier_factor,
    local_scale,
    second_moments,
    spread_around,
    steepness,
    wrong_factor,
)

# Variance of the difference between neighbouring nodes over the link's variance: on a square lattice, all other paths
# between the two nodes conduct as much as the link.
APART = 0.5
# With fewer anchors outside the discs none is held out: the field would be close to its prior.
LEAST_REST = 5
# Disc centres follow this low-discrepancy sequence over the frames (R2, Roberts).
STEPS = (0.7548776662466927, 0.5698402909980532)


def learnt(
    scene: Scene, field: Field, weight: Floats, left_out: LeftOut, running: Running, away: Floats,
    of_surfaces: dict[str, tuple[float, float]],
) -> tuple[Floats, Floats]:  # fmt: skip
    """The packed memory after the frame; and [2, M] scores of held-out anchors with their weights (``conformal``).
    ``away`` [R C]: distance of every node from evidence; ``of_surfaces``: sums from ``motion.surfaces``."""
    sums, scores = _of_discs(scene, weight, left_out, running, away)
    above, below = running.added(_of_neighbours(scene, left_out, running) | sums | of_surfaces)
    first, b = [running.frames + 1, scene.grid.mean], field.coefficients
    slopes = running.with_slopes(b[1:])
    return np.concatenate([first, above, below, slopes, b, field.covariance.ravel()]), scores


def _of_neighbours(scene: Scene, left_out: LeftOut, running: Running) -> dict[str, tuple[float, float]]:
    """Sums for roughness and noise from the excess of squared leave-one-out residuals over their variance, weighted by
    the squared share of the quantity in that variance."""
    variance = left_out.total
    excess = np.minimum(left_out.residual**2, scene.config.clip * variance) - variance
    per_cell = 1 / scene.counted(np.ones(len(variance)))
    sums = {}
    for name, part in (("roughness", np.full(len(variance), running.ratios["roughness"])), ("noise", scene.stated)):
        w = per_cell * (part / variance) ** 2
        unit = running.ratios[name] / np.maximum(part, 1e-12)
        sums[name] = float((w * (part + excess) * unit).sum()), float(w.sum())
    return sums


def _of_discs(
    scene: Scene, weight: Floats, left_out: LeftOut, running: Running, everywhere: Floats
) -> tuple[dict[str, tuple[float, float]], Floats]:
    """Sums for the other ratios, from anchors in held-out discs, and these anchors' scores with weights."""
    held_out, config = _discs(scene, running.frames), scene.config
    rest = ~held_out
    held_out = held_out & (np.count_nonzero(rest) >= LEAST_REST)
    field = conditioned(scene.prior, scene.observed, weight * rest)
    node, x, noise = scene.observed.node[held_out], scene.observed.features[held_out], scene.noise[held_out]
    mean, variance = at(field, node, x)
    away, b = away_from(scene, rest)[node], field.coefficients
    error, offset = scene.observed.value[held_out] - mean, mean - (x * b).sum(1)
    believed = np.where(held_out, scene.believed, 0.0)
    area = (believed / np.maximum(scene.counted(believed), 1e-12))[held_out]
    unseen = away * running.ratios["unseen"]
    wide = elsewhere_variance(config, spread_around(scene, rest, b[0])[node], unseen)
    scale, factor = local_scale(scene, left_out, rest)[node], inlier_factor(running, away)
    steep = steepness(scene.grid, field.offset)[node]
    inlier_variance = factor * (variance + noise + unseen) + steep
    inlier_variance, more_wrong = scale * inlier_variance, wrong_factor(config, away, scale)
    p = np.minimum(running.ratios["wrong"] * more_wrong, MOST_WRONG)
    z2 = error**2 / inlier_variance - (error + offset) ** 2 / (noise + wide)
    with np.errstate(over="ignore", divide="ignore"):  # infinite odds of the evidence's surface
        elsewhere = 1 / (1 + np.exp(-np.log(p / (1 - p)) - (np.log(inlier_variance / (noise + wide)) + z2) / 2))
    stated = second_moments(config, inlier_variance, p, offset, wide)[0]
    sums = {
        "wrong": (area * elsewhere, area * more_wrong),
        "inlier": (area * (1 - elsewhere) * factor * error**2 / inlier_variance, area * (1 - elsewhere)),
        "calibration": (area * error**2 / stated, area),
    }
    added = {name: (float(above.sum()), float(below.sum())) for name, (above, below) in sums.items()}
    # At a pixel there is neither an anchor's blur nor its part in ``alone``, only the noise of its measurement.
    measured = scene.stated[held_out] - config.alone / len(scene.stated)
    at_pixel = at_pixels(config, factor, variance, running.ratios["roughness"], unseen, steep)
    moments = second_moments(config, scale * (at_pixel + measured), p, offset, wide + measured)
    scores = np.stack([score(error, p, *moments), image_weights(away, area, everywhere)])
    return _of_pairs(scene, node, np.stack([error, variance, away, noise]), running) | added, scores


def _of_pairs(
    scene: Scene, node: NDArray[np.int64], values: Floats, running: Running
) -> dict[str, tuple[float, float]]:  # fmt: skip
    """Sums for amplitude and unseen from the errors at pairs of neighbouring cells.

    The mean product of their errors is the covariance of the network's errors: noise and wrong anchors are independent
    between cells. An isolated cell contributes its squared error less its noise. The more pairs there are, the less
    isolated cells count.

    Args:
        scene: of the frame.
        node: [M] nodes of the held-out anchors.
        values: [4, M] error, its variance in the field, distance from evidence and noise.
        running: up to the frame before.
    """
    grid, amplitude, sums = scene.grid, running.ratios["amplitude"], np.zeros(4)
    count = np.bincount(node, minlength=grid.rows * grid.cols)
    means = np.stack([np.bincount(node, row, len(count)) for row in values]) / np.maximum(count, 1)
    cells, alone, pairs = np.arange(len(count)).reshape(grid.rows, grid.cols), count > 0, 0
    for first, second, link in ((cells[:, :-1], cells[:, 1:], grid.right), (cells[:-1], cells[1:], grid.down)):
        pair = (count[first] > 0) & (count[second] > 0)
        one, other = first[pair], second[pair]
        alone[one] = alone[other] = False
        pairs += len(one)
        _, variance, away, noise = (means[:, one] + means[:, other]) / 2
        covariance = np.maximum(variance - APART * amplitude * link[one] / 2, 0)
        sums += _products(means[0, one] * means[0, other], covariance, variance, noise, away)
    error, variance, away, noise = means[:, alone]
    share = len(error) / max(len(error) + pairs, 1)
    sums += share * _products(error**2 - noise / count[alone], variance, variance, noise, away)
    return {"amplitude": (float(sums[0]), float(sums[1]) / amplitude), "unseen": (float(sums[2]), float(sums[3]))}


def _products(product: Floats, expected: Floats, variance: Floats, noise: Floats, away: Floats) -> Floats:
    """[4] sums: numerator and denominator of amplitude, weighted, and of unseen."""
    weight = 1 / np.maximum(variance + noise, 1e-12)
    terms = weight * product, weight * expected, away * (product - expected), away**2
    return np.array([x.sum() for x in terms])


def _discs(scene: Scene, frames: float) -> NDArray[np.bool_]:
    """[N] whether an anchor lies in one of the frame's discs."""
    position, discs = (scene.observed.features[:, 2:4] + 1) / 2, scene.config.discs
    inside = np.zeros(len(position), np.bool_)
    for disc in range(discs):
        centre = np.array([((frames * discs + disc + 1) * step) % 1 for step in STEPS])
        inside |= ((position - centre) ** 2).sum(1) < scene.config.radius**2
    return inside

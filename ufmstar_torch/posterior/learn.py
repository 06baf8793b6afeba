"""Updates ``running`` from a frame's anchors by cross-validation: one anchor, or a disc of anchors, is held out.

Leave-one-out residuals give roughness and noise. For the other ratios, discs that move over the image are held out, and
the field of the other anchors predicts those in them. Products of errors in neighbouring cells give the amplitude, and
their increase with the distance from evidence gives ``unseen``. ``wrong`` is the mean probability that an anchor lies
on another surface, weighted by area because corners cluster on textured surfaces. ``inlier`` is the mean z^2 of the
other anchors: outliers have widened the field's variance, and ``wrong`` accounts for them.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import pad

from ufmstar_torch.fixed_order import total
from ufmstar_torch.posterior.field import Field
from ufmstar_torch.posterior.running import Running, ratios
from ufmstar_torch.posterior.scene import (
    LeftOut,
    Scene,
    away_from,
    elsewhere_variance,
    inlier_factor,
    local_scale,
    second_moments,
    spread_around,
    steepness,
    wrong,
    wrong_factor,
)

# Variance of the difference between neighbouring nodes over the link's variance: on a square lattice, all other paths
# between the two nodes conduct as much as the link.
APART = 0.5
# With fewer anchors outside the discs none is held out: the field would be close to its prior.
LEAST_REST = 5
# Disc centres follow this low-discrepancy sequence over the frames (R2, Roberts).
STEPS = (0.7548776662466927, 0.5698402909980532)


def learnt(scene: Scene, field: Field, weight: Tensor, left_out: LeftOut, running: Running) -> Running:
    """The memory after the frame."""
    sums = _of_neighbours(scene, left_out, running) | _of_discs(scene, weight, left_out, running)
    added = {name: running.added(name, *sums[name]) for name in ratios(scene.config)}
    above, below = ({name: pair[i] for name, pair in added.items()} for i in range(2))
    after = running.frames + 1, scene.grid.mean, above, below, field.coefficients, field.covariance
    return Running(scene.config, *after)


def _of_neighbours(scene: Scene, left_out: LeftOut, running: Running) -> dict[str, tuple[Tensor, Tensor]]:
    """Sums for roughness and noise from the excess of squared leave-one-out residuals over their variance, weighted by
    the squared share of the quantity in that variance."""
    variance = left_out.total
    excess = torch.minimum(left_out.residual.square(), scene.config.clip * variance) - variance
    per_cell = torch.where(scene.valid, 1 / scene.counted(torch.ones_like(excess)), 0.0)
    sums = {}
    for name, part in (("roughness", running.ratio("roughness")[:, None]), ("noise", scene.stated)):
        w = per_cell * (part / variance).square()
        unit = running.ratio(name)[:, None] / part.clamp_min(1e-12)
        sums[name] = (total(w * (part + excess) * unit, 1), total(w, 1))
    return sums


def _of_discs(
    scene: Scene, weight: Tensor, left_out: LeftOut, running: Running
) -> dict[str, tuple[Tensor, Tensor]]:  # fmt: skip
    """Sums for the other ratios, from anchors in held-out discs."""
    held_out = _discs(scene, running.frames) & scene.valid
    rest = scene.valid & ~held_out
    held_out = held_out & (rest.sum(1, keepdim=True) >= LEAST_REST)
    field = Field.conditioned(scene.prior, scene.observed, weight * rest)
    mean, variance = field.at(scene.observed.node, scene.observed.features)
    away = torch.gather(away_from(scene, rest), 1, scene.observed.node)
    error, b = scene.observed.value - mean, field.coefficients
    believed = torch.where(held_out, scene.believed(), 0.0)
    area = believed / scene.counted(believed).clamp_min(1e-12)
    offset = mean - (scene.observed.features * b[:, None]).sum(-1)
    nodes = spread_around(scene, rest, b[:, 0]), local_scale(scene, left_out, rest), steepness(scene.grid, field.offset)
    around, scale, steep = (torch.gather(x, 1, scene.observed.node) for x in nodes)
    factor, more_wrong = inlier_factor(running, away), wrong_factor(scene.config, away, scale)
    unseen = away * running.ratio("unseen")[:, None]
    inlier_variance = scale * (factor * (variance + scene.noise + unseen) + steep)
    p, wide = wrong(running, more_wrong), elsewhere_variance(scene.config, around, unseen)
    z2 = error.square() / inlier_variance - (error + offset).square() / (scene.noise + wide)
    elsewhere = torch.sigmoid(p.logit() + ((inlier_variance / (scene.noise + wide)).log() + z2) / 2)
    stated = second_moments(scene.config, inlier_variance, p, offset, wide)[0]
    return _of_pairs(scene, held_out, torch.stack([error, variance, away, scene.noise]), running) | {
        "wrong": (total(area * elsewhere, 1), total(area * more_wrong, 1)),
        "inlier": (
            total(area * (1 - elsewhere) * factor * error.square() / inlier_variance, 1),
            total(area * (1 - elsewhere), 1),
        ),
        "calibration": (total(area * error.square() / stated, 1), total(area, 1)),
    }


def _of_pairs(scene: Scene, held_out: Tensor, values: Tensor, running: Running) -> dict[str, tuple[Tensor, Tensor]]:
    """Sums for amplitude and unseen from the errors at pairs of neighbouring cells.

    The mean product of their errors is the covariance of the network's errors: noise and wrong anchors are independent
    between cells. An isolated cell contributes its squared error less its noise. The more pairs there are, the less
    isolated cells count.

    Args:
        scene: of the frame.
        held_out: [B, N] bool.
        values: [4, B, N] error, its variance in the field, distance from evidence and noise.
        running: up to the frame before.
    """
    streams, (rows, cols) = len(held_out), scene.grid.size
    each = torch.cat([torch.where(held_out, values, 0.0), held_out[None].to(values)])
    cells = torch.zeros(5, streams, rows * cols, dtype=each.dtype, device=each.device)
    cells = cells.scatter_add(2, scene.observed.node.expand_as(each), each).view(5, streams, rows, cols)
    count, means = cells[4], cells[:4] / cells[4].clamp_min(1)
    amplitude, paired = running.ratio("amplitude"), torch.zeros_like(count, dtype=torch.bool)
    sums = torch.zeros(4, streams, dtype=each.dtype, device=each.device)
    pairs = torch.zeros_like(sums[0])
    for axis, link in ((2, scene.grid.right), (1, scene.grid.down)):
        n = count.shape[axis] - 1
        one, other = means.narrow(axis + 1, 0, n), means.narrow(axis + 1, 1, n)
        pair = (count.narrow(axis, 0, n) > 0) & (count.narrow(axis, 1, n) > 0)
        before, after = ((0, 1), (1, 0)) if axis == 2 else ((0, 0, 0, 1), (0, 0, 1, 0))
        paired, pairs = paired | pad(pair, before) | pad(pair, after), pairs + pair.sum((1, 2))
        _, variance, away, noise = (one + other) / 2
        between = amplitude[:, None, None] * link.view_as(count).narrow(axis, 0, n)
        sums = sums + _products(
            pair, one[0] * other[0], (variance - APART * between / 2).clamp_min(0), variance, noise, away
        )
    error, variance, away, noise = means
    alone, product = (count > 0) & ~paired, error.square() - noise / count.clamp_min(1)
    share = alone.sum((1, 2)) / (alone.sum((1, 2)) + pairs).clamp_min(1)
    sums = sums + share * _products(alone, product, variance, variance, noise, away)
    return {"amplitude": (sums[0], sums[1] / amplitude), "unseen": (sums[2], sums[3])}


def _products(
    used: Tensor, product: Tensor, expected: Tensor, variance: Tensor, noise: Tensor, away: Tensor
) -> Tensor:  # fmt: skip
    """[4, B] sums over the mask ``used``: numerator and denominator of amplitude, weighted, and of unseen."""
    weight = 1 / (variance + noise).clamp_min(1e-12)
    terms = weight * product, weight * expected, away * (product - expected), away.square()
    return torch.stack([total(torch.where(used, x, 0.0).flatten(1), 1) for x in terms])


def _discs(scene: Scene, frames: Tensor) -> Tensor:
    """[B, N] whether an anchor lies in one of the frame's discs."""
    position, discs = (scene.observed.features[..., 2:4] + 1) / 2, scene.config.discs
    inside = torch.zeros_like(scene.valid)
    for disc in range(discs):
        centre = torch.stack([((frames * discs + disc + 1) * step) % 1 for step in STEPS], -1)
        inside = inside | ((position - centre[:, None]).square().sum(-1) < scene.config.radius**2)
    return inside

"""Learns ``running`` from a frame's anchors: each is predicted from the others, alone or without its whole region.

Roughness and noise follow from anchors that are left out alone. For the rest, discs that move over the image are left
out of the field, which then predicts the anchors in them. Products of errors in neighbouring cells teach the amplitude,
and ``unseen`` in proportion to the distance from evidence. ``wrong`` is the mean probability that an anchor lies on
another surface, by area and not by number, since corners cluster on what is well textured. ``inlier`` is the mean z^2
of the anchors that do not: outliers have widened the field's variance, and ``wrong`` states them already.
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

# Variance of the difference between neighbouring nodes, over that of the link between them: on a square lattice the
# other ways from one to the other are worth as much as the link.
APART = 0.5
# With fewer anchors outside the discs, no anchor is held out: the field alone would be close to its prior.
LEAST_REST = 5
# The frame's number moves the discs along this sequence of low discrepancy (R2, Roberts).
STEPS = (0.7548776662466927, 0.5698402909980532)


def learnt(scene: Scene, field: Field, weight: Tensor, left_out: LeftOut, running: Running) -> Running:
    """The memory after the frame."""
    sums = _of_neighbours(scene, left_out, running) | _of_discs(scene, weight, left_out, running)
    added = {name: running.added(name, *sums[name]) for name in ratios(scene.config)}
    above, below = ({name: pair[i] for name, pair in added.items()} for i in range(2))
    after = running.frames + 1, scene.grid.mean, above, below, field.coefficients, field.covariance
    return Running(scene.config, *after)


def _of_neighbours(scene: Scene, left_out: LeftOut, running: Running) -> dict[str, tuple[Tensor, Tensor]]:
    """Sums for roughness and noise from leave-one-out residuals: what they are beyond the rest of their variance, each
    weighted by the squared share that the quantity has in it."""
    variance = left_out.total
    excess = torch.minimum(left_out.residual.square(), scene.config.clip * variance) - variance
    once = torch.where(scene.valid, 1 / scene.counted(torch.ones_like(excess)), 0.0)
    sums = {}
    for name, part in (("roughness", running.ratio("roughness")[:, None]), ("noise", scene.stated)):
        w = once * (part / variance).square()
        unit = running.ratio(name)[:, None] / part.clamp_min(1e-12)
        sums[name] = (total(w * (part + excess) * unit, 1), total(w, 1))
    return sums


def _of_discs(
    scene: Scene, weight: Tensor, left_out: LeftOut, running: Running
) -> dict[str, tuple[Tensor, Tensor]]:  # fmt: skip
    """Sums for all else that is learnt, from anchors whose whole region is left out."""
    held = _discs(scene, running.frames) & scene.valid
    rest = scene.valid & ~held
    held = held & (rest.sum(1, keepdim=True) >= LEAST_REST)
    field = Field.conditioned(scene.prior, scene.observed, weight * rest)
    mean, variance = field.at(scene.observed.node, scene.observed.features)
    away = torch.gather(away_from(scene, rest), 1, scene.observed.node)
    error, b = scene.observed.value - mean, field.coefficients
    believed = torch.where(held, scene.believed(), 0.0)
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
    return _of_pairs(scene, held, torch.stack([error, variance, away, scene.noise]), running) | {
        "wrong": (total(area * elsewhere, 1), total(area * more_wrong, 1)),
        "inlier": (
            total(area * (1 - elsewhere) * factor * error.square() / inlier_variance, 1),
            total(area * (1 - elsewhere), 1),
        ),
        "calibration": (total(area * error.square() / stated, 1), total(area, 1)),
    }


def _of_pairs(scene: Scene, held: Tensor, values: Tensor, running: Running) -> dict[str, tuple[Tensor, Tensor]]:
    """Sums for amplitude and unseen from the errors at pairs of neighbouring cells.

    The mean of their product is the covariance of what all depths there have in common. The anchors' own errors, and
    anchors that are wrong, differ from cell to cell and have no part in it. A cell without neighbours is its own, less
    its noise; such cells count the less, the more pairs there are.

    Args:
        scene: of the frame.
        held: [B, N] bool, anchors left out.
        values: [4, B, N] their error, its variance in the field, distance from evidence and noise.
        running: up to the frame before.
    """
    streams, (rows, cols) = len(held), scene.grid.size
    each = torch.cat([torch.where(held, values, 0.0), held[None].to(values)])
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
    """[4, B] sums over the mask of products of errors: the two of amplitude, weighted, and the two of unseen."""
    weight = 1 / (variance + noise).clamp_min(1e-12)
    terms = weight * product, weight * expected, away * (product - expected), away.square()
    return torch.stack([total(torch.where(used, x, 0.0).flatten(1), 1) for x in terms])


def _discs(scene: Scene, frames: Tensor) -> Tensor:
    """[B, N] whether an anchor lies in one of the frame's discs."""
    at, discs = (scene.observed.features[..., 2:4] + 1) / 2, scene.config.discs
    inside = torch.zeros_like(scene.valid)
    for disc in range(discs):
        centre = torch.stack([((frames * discs + disc + 1) * step) % 1 for step in STEPS], -1)
        inside = inside | ((at - centre[:, None]).square().sum(-1) < scene.config.radius**2)
    return inside

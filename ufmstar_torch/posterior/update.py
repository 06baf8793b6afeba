"""One frame: p(depth | network, UfM*, anchors), and the update of the stream's memory.

At an anchor of depth g the network's error is y = log(g/d). Its model over the image is

    y = b . (1, log d - m_0, u, v) + f.

b follows a random walk from frame to frame. f is a Gaussian field on a grid whose links are weaker across edges of the
predicted depth (``grid``, ``field``). An anchor of standard deviation s observes y with the variance

    n = roughness + blur^2 + noise s^2/g^2 + alone/N.

blur is half the range of log d over the pixel and its neighbours. ``noise`` is the factor by which the anchors' stated
variances are too small. N is the number of anchors: few anchors do not confirm each other. An anchor's residual from
the prediction of the others is Student-t distributed: the factor (nu + z^2)/(nu + 1) scales the predicted variance,
with z from the leave-one-out residual, and the increase is added to n. This suppresses outliers. The difference of f
across a link is Student-t distributed as well, so that f can jump.

Variance over the squared depth at a node, with v = s (h (the field's variance + roughness + unseen distance) +
steepness), and share = min(1, distance/reach):

    max((1 - p) m(v) + p tail, share V/d^2),      m(v) = E[(e^n - 1)^2],  n ~ N(0, v),
    p = wrong s^max(0, 1 - distance/radius),
    h = 1 + (inlier - 1) max(0, 1 - distance/(2 radius)).

- s is the local scale, because the network errs more in some regions: the mean leave-one-out z^2 of the anchors in a
  Gaussian window of width ``near``, and of one virtual anchor with z^2 = 1.
- ``steepness`` is the variance of f over a node and its neighbours: a depth edge may be one node off in f.
- m exceeds v where v is large, because the error of the depth is log-normal. The output ``inlier`` is m(v).
- p is the probability that the depth is of another surface than its evidence: the output ``outlier``.
- The ratios include the held-out anchors of this frame.

The distance from evidence is geodesic, in image widths, and differences of log d lengthen it: on tours the variance of
the error is proportional to it. ``learn`` estimates ``unseen``, ``wrong`` and the other ratios (``running``).

``tail`` is the second moment about the posterior depth if the local correction f does not hold, because the evidence is
wrong or lies on another surface. Then y - b . x is normal with the variance w, and the depth log-normal:

    tail = E[(e^(n - f) - 1)^2] = q^2 e^(2 w) - 2 q e^(w/2) + 1,      q = e^-f <= 100,      n ~ N(0, w),
    w = a + elsewhere unseen distance.

a is the variance of the anchors' y in a Gaussian window: depths differ more between surfaces than within one, and the
farther the evidence, the more surfaces lie between. v and w are at most ``widest``. Contradictory evidence thus limits
the certainty of every pixel, and a depth far below the global correction is less certain than one above it.

A stream whose anchors were all invalid so far has the network's depth with the variance of a node without evidence. A
stream without anchors has UfM*'s output.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from ufmstar_torch.anchors.anchors import AnchorInput
from ufmstar_torch.frame import FrameInput
from ufmstar_torch.posterior.config import PosteriorConfig
from ufmstar_torch.posterior.grid import Grid
from ufmstar_torch.posterior.learn import learnt
from ufmstar_torch.posterior.read import read
from ufmstar_torch.posterior.running import Running
from ufmstar_torch.posterior.scene import (
    Scene,
    away_from,
    elsewhere_variance,
    fitted,
    inlier_factor,
    local_scale,
    second_moments,
    spread_around,
    steepness,
    wrong,
    wrong_factor,
)


@dataclass(frozen=True)
class Posterior:
    """The posterior of B streams.

    Attributes:
        depth: [B, H, W] [m]; as predicted before the first anchor. NaN where not valid.
        variance: [B, H, W] [m^2]; UfM*'s in a stream without anchors.
        calibration: [B] running mean z^2 of held-out anchors: 1 = as predicted, above = too certain; NaN before any.
        unseen: [B] variance of y per image width of distance from evidence.
        outlier: [B, H, W] probability in [0, 1] that a pixel lies on another surface than its evidence; NaN where not
            valid or in a stream without anchors.
        inlier: [B, H, W] variance if the pixel does not [m^2]; UfM*'s in a stream without anchors.
    """

    depth: Tensor
    variance: Tensor
    calibration: Tensor
    unseen: Tensor
    outlier: Tensor
    inlier: Tensor


# Signature of :func:`update`, and of ``kernels/posterior_cpu.update``.
PosteriorUpdate = Callable[[Tensor, FrameInput, AnchorInput | None, Tensor, PosteriorConfig], tuple[Tensor, Posterior]]


def update(
    packed: Tensor,
    frame: FrameInput,
    anchors: AnchorInput | None,
    claimed: Tensor,
    config: PosteriorConfig,
) -> tuple[Tensor, Posterior]:
    """Process a frame.

    Args:
        packed: [B, running.SIZE] the memory; not modified.
        frame: checked.
        anchors: of the frame, or None.
        claimed: [B, H, W] V of UfM* without B [m^2], NaN where not valid.
        config: the constants.

    Returns:
        The memory after this frame, and the posterior. Without a valid anchor, a stream learns nothing and its
        coefficients drift.
    """
    has_anchors = anchors is not None
    anchors = anchors if anchors is not None and anchors.valid.shape[1] else _none(frame)
    running, grid = Running.of(packed, config), Grid.of(frame, config)
    scene = Scene.of(grid, frame, anchors, running)
    field, left_out, weight = fitted(scene)
    away = away_from(scene, anchors.valid & (weight * config.weak_sigma**2 >= 1))
    has_valid = anchors.valid.any(1)
    drifted = torch.where(frame.valid.flatten(1).any(1)[:, None], running.drifted(grid.mean), packed)
    memory = torch.where(has_valid[:, None], learnt(scene, field, weight, left_out, running).packed(), drifted)
    updated = Running.of(memory, config)
    features, b = grid.features(), field.coefficients
    mean, variance = field.at(torch.arange(features.shape[1], device=b.device).expand_as(away), features)
    offset = mean - (features * b[:, None]).sum(-1)
    unseen = away * updated.ratio("unseen")[:, None]
    variance = variance + updated.ratio("roughness")[:, None] + unseen
    wide = elsewhere_variance(config, spread_around(scene, anchors.valid, b[:, 0]), unseen)
    scale = local_scale(scene, left_out, anchors.valid)
    variance = scale * (inlier_factor(updated, away) * variance + steepness(grid, field.offset))
    p = wrong(updated, wrong_factor(config, away, scale))
    variance, inlier = second_moments(config, variance, p, offset, wide)
    nodes = torch.stack([grid.log_depth, offset, variance, inlier, p, away / config.reach], -1)
    maps = frame.depth, frame.valid, claimed.nan_to_num()
    depth, spread, inlier, outlier = read(*maps, nodes, b, grid.mean, grid.size, config)
    corrected = (has_valid | (running.frames > 0) | has_anchors)[:, None, None]
    plain = torch.where(frame.valid, frame.depth, torch.nan)
    calibration = torch.where(updated.below["calibration"] > 0, updated.ratio("calibration"), torch.nan)
    return memory.to(packed.dtype), Posterior(
        torch.where(corrected, depth, plain), torch.where(corrected, spread, claimed), calibration,
        updated.ratio("unseen"), torch.where(corrected, outlier, torch.nan), torch.where(corrected, inlier, claimed),
    )  # fmt: skip


def _none(frame: FrameInput) -> AnchorInput:
    """One invalid anchor for each stream."""
    b, camera = len(frame.depth), frame.intrinsics
    one, zero = camera.new_ones(b, 1), camera.new_zeros(b, 1)
    index = torch.zeros(b, 1, dtype=torch.int64, device=camera.device)
    return AnchorInput(camera.new_zeros(b, 1, 2), index, one, one, zero, zero, index.bool())

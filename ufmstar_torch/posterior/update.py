"""One frame: p(depth | network, UfM*, anchors), and what the stream learns from it.

At an anchor of depth g the network's error is y = log(g/d). Over the image it is modelled as

    y = b . (1, log d - m_0, u, v) + f,

with b carried from frame to frame as a random walk and a Gaussian field f on a grid whose links loosen across edges of
the predicted depth (``grid``, ``field``). An anchor observes y with the variance

    n = roughness + blur^2 + noise s^2/g^2,

where blur is half the range of log d among the pixel's neighbours, and ``noise`` the factor by which anchors state
their variances too small, and ``alone`` over the number of anchors is added: few anchors do not confirm each other. An
anchor is distributed about the prediction of the others as Student's t. What (nu + z^2)/(nu + 1) adds to that
prediction's variance, with z from the leave-one-out residual, is counted as its noise: this takes outliers out. The
difference of f across a link is Student's t in the same way, so that f may jump where the anchors say so.

Variance over the squared depth at a node, with v = s (h (the field's variance + roughness + unseen distance) +
steepness), and share = min(1, distance/reach):

    max((1 - p) m(v) + p tail, share V/d^2),      m(v) = E[(e^n - 1)^2],  n ~ N(0, v),
    p = wrong s^max(0, 1 - distance/radius),
    h = 1 + (inlier - 1) max(0, 1 - distance/(2 radius)),

with s the local scale: the mean z^2 of the anchors around, each predicted from the others, in a Gaussian window of the
width ``near``, and of one of z^2 = 1. The network errs more in some regions than in others; s says where. All this
with what was learnt up to this frame, its held-out anchors included. ``steepness`` is the variance of f among a node
and its neighbours: an edge of depth may lie a node from where f has it. The error of the depth is log-normal, so m
exceeds v where v is large. p is the probability that the depth is of another surface than its evidence: ``outlier``.
``inlier`` is m(v) alone.

The distance from evidence is geodesic, in widths of the image, and differences of log d lengthen it: on tours the
variance of the error grows in proportion to it. ``learn`` learns ``unseen``, ``wrong`` and the other ratios
(``running``) from the anchors.

``tail`` is the second moment about the posterior depth if the local correction f does not hold, because the evidence is
wrong or lies on another surface. Then y - b . x is normal with the variance w, and the depth log-normal:

    tail = E[(e^(n - f) - 1)^2] = q^2 e^(2 w) - 2 q e^(w/2) + 1,      q = e^-f <= 100,      n ~ N(0, w),
    w = a + elsewhere unseen distance,

with a the variance of the anchors' y around, of a Gaussian window: surfaces differ more from each other than one does
within, and the farther the evidence, the more surfaces lie between. Neither v nor w exceeds ``widest``. So no pixel is
more certain than contradictory evidence allows, and a depth that was pulled far below the global correction is less
certain than one above it.

A stream that is given anchors of which none was valid so far has that variance without evidence, about the network's
depth: nothing was measured, and nothing reads as certain. A stream without anchors is UfM*'s.
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
        variance: [B, H, W] [m^2]; UfM*'s where no anchors were ever given.
        calibration: [B] mean z^2 of held-out anchors lately: 1 = as predicted, more = too certain; NaN before any.
        unseen: [B] variance of y a width of the image from evidence.
        outlier: [B, H, W] probability in [0, 1] that a pixel lies on another surface than its evidence; NaN where not
            valid or no anchors were ever given.
        inlier: [B, H, W] the variance if it does not [m^2]; UfM*'s where no anchors were ever given.
    """

    depth: Tensor
    variance: Tensor
    calibration: Tensor
    unseen: Tensor
    outlier: Tensor
    inlier: Tensor


# As :func:`update`; ``kernels/posterior_cpu`` has the compiled one.
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
        packed: [B, running.SIZE] what was learnt; not modified.
        frame: checked.
        anchors: of the frame, or None.
        claimed: [B, H, W] V of UfM* without B [m^2], NaN where not valid.
        config: the constants.

    Returns:
        The statistics up to this frame, and the posterior. A stream without a usable anchor learns nothing; its
        coefficients drift.
    """
    has_anchors = anchors is not None
    anchors = anchors if anchors is not None and anchors.valid.shape[1] else _none(frame)
    running, grid = Running.of(packed, config), Grid.of(frame, config)
    scene = Scene.of(grid, frame, anchors, running)
    field, left_out, weight = fitted(scene)
    away = away_from(scene, anchors.valid & (weight * config.weak_sigma**2 >= 1))
    some = anchors.valid.any(1)
    drifted = torch.where(frame.valid.flatten(1).any(1)[:, None], running.drifted(grid.mean), packed)
    memory = torch.where(some[:, None], learnt(scene, field, weight, left_out, running).packed(), drifted)
    now = Running.of(memory, config)
    features, b = grid.features(), field.coefficients
    mean, variance = field.at(torch.arange(features.shape[1], device=b.device).expand_as(away), features)
    offset = mean - (features * b[:, None]).sum(-1)
    unseen = away * now.ratio("unseen")[:, None]
    variance = variance + now.ratio("roughness")[:, None] + unseen
    wide = elsewhere_variance(config, spread_around(scene, anchors.valid, b[:, 0]), unseen)
    scale = local_scale(scene, left_out, anchors.valid)
    variance = scale * (inlier_factor(now, away) * variance + steepness(grid, field.offset))
    p = wrong(now, wrong_factor(config, away, scale))
    variance, inlier = second_moments(config, variance, p, offset, wide)
    nodes = torch.stack([grid.log_depth, offset, variance, inlier, p, away / config.reach], -1)
    maps = frame.depth, frame.valid, claimed.nan_to_num()
    depth, spread, inlier, outlier = read(*maps, nodes, b, grid.mean, grid.size, config)
    corrected = (some | (running.frames > 0) | has_anchors)[:, None, None]
    plain = torch.where(frame.valid, frame.depth, torch.nan)
    calibration = torch.where(now.below["calibration"] > 0, now.ratio("calibration"), torch.nan)
    return memory.to(packed.dtype), Posterior(
        torch.where(corrected, depth, plain), torch.where(corrected, spread, claimed), calibration, now.ratio("unseen"),
        torch.where(corrected, outlier, torch.nan), torch.where(corrected, inlier, claimed),
    )  # fmt: skip


def _none(frame: FrameInput) -> AnchorInput:
    """One anchor a stream that is not valid."""
    b, like = len(frame.depth), frame.intrinsics
    one, zero = like.new_ones(b, 1), like.new_zeros(b, 1)
    index = torch.zeros(b, 1, dtype=torch.int64, device=like.device)
    return AnchorInput(like.new_zeros(b, 1, 2), index, one, one, zero, zero, index.bool())

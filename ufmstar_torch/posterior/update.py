"""One frame: p(depth | network, UfM*, anchors), and the update of the stream's memory.

At an anchor of depth g the network's error is y = log(g/d). Its model over the image is

    y = b . (1, log d - m_0, u, v) + f.

b's constant follows a random walk from frame to frame. The slope in log d reverts to 0, those in u and v to their means
over the stream, so that without evidence the depth fades to the network's shape at the stream's scale. At the distance
a from evidence the slopes are those of the frame and the mean slopes of the stream (``running``), with the shares
l^2/(a^2 + l^2) and a^2/(a^2 + l^2), l = ``slope_reach``: in a turn, anchors at one side of the image are no evidence of
the network's shape at the other.

f is a Gaussian field on a grid whose links are weaker across edges of the predicted depth (``scene``, ``field``). An
anchor of standard deviation s observes y with the variance

    n = roughness + blur^2 + noise s^2/g^2 + alone/N.

blur is half the range of log d over the pixel and its neighbours. ``noise`` is the factor by which the anchors' stated
variances are too small. N is the number of anchors: few anchors do not confirm each other. An anchor's residual from
the prediction of the others is Student-t distributed: the factor (nu + z^2)/(nu + 1) scales the predicted variance,
with z from the leave-one-out residual, and the increase is added to n. This suppresses outliers. The difference of f
across a link is Student-t distributed as well, so that f can jump.

Variance over the squared depth at a node, with share = min(1, distance/reach):

    v = s (h (a_0 the field's variance + a_1 roughness + a_2 unseen distance) + a_3 steepness),
    max((1 - p) m(v) + p tail, share V/d^2),      m(v) = E[(e^n - 1)^2 | |n| <= log F],  n ~ N(0, v),
    p = wrong s^max(0, 1 - distance/radius),
    h = 1 + (inlier - 1) max(0, 1 - distance/(2 radius)).

- a_0 to a_3 lead from anchors to pixels (``pixel_field`` ...). Anchors lie on texture, often at the edges of surfaces.
  Between them the field errs less than it states, and neighbouring pixels differ more than neighbouring anchors. The
  factors are fitted to tours with wrong poses, blur, noise and compressed images, for the sum of the NLL of the normal
  distribution, that of the mixture, and the log loss of an error below 25 %.
- s is the local scale, because the network errs more in some regions: the mean leave-one-out z^2 of the anchors in a
  Gaussian window of width ``near``, and of one virtual anchor with z^2 = 1.
- ``steepness`` is the variance of f over a node and its neighbours: a depth edge may be one node off in f.
- m exceeds v where v is large, because the error of the depth is log-normal. Errors beyond a factor F (``farthest``) do
  not count: without this limit, errors that never occur would decide the variance. The output ``inlier`` is m(v), at
  most its 70 % quantile over the image.
- p is the probability that the depth is of another surface than its evidence. Where the inliers' variance exceeds the
  usual one of the image, a larger output ``outlier`` stands for the difference (``distribution.divided``).
- The ratios include the held-out anchors of this frame.

Before the first anchor the network may be off by any factor. The squared share of the variance of b's constant in that
before the first anchor is ``unmeasured``: with it p is raised towards ``misscaled``, w towards ``widest``, and a_0
towards 1. At the start the standard deviation is .9 times the depth.

The distance from evidence is geodesic, in image widths, and differences of log d lengthen it: on tours the variance of
the error is proportional to it. ``learn`` estimates ``unseen``, ``wrong`` and the other ratios (``running``).

``tail`` is the second moment about the posterior depth if the local correction f does not hold, because the evidence is
wrong or lies on another surface. Then y - b . x is normal with the variance w, and the depth log-normal:

    tail = E[(e^(n - f) - 1)^2 | |n - f| <= log F],      n ~ N(0, w),
    w = a + elsewhere unseen distance.

a is the variance of the anchors' y in a Gaussian window: depths differ more between surfaces than within one, and the
farther the evidence, the more surfaces lie between. v and w are at most ``widest``. Contradictory evidence thus limits
the certainty of every pixel.

Anchors that matching has measured are wrong on surfaces that move. With the probability P of ``motion``, the depth is
that of the prediction at the scale of most surfaces: the variance becomes (1 - P) V + P tail, with the tail about
their ratio instead of b . x, and p includes P.

A stream whose anchors were all invalid so far has the network's depth with the variance of a node without evidence. A
stream without anchors has UfM*'s output.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ufmstar_torch.anchors.anchors import Anchors
from ufmstar_torch.frames.frame import FrameInput
from ufmstar_torch.kernels.cpu.calls import array, each
from ufmstar_torch.posterior.cells import cell_means, features, read
from ufmstar_torch.posterior.config import PosteriorConfig
from ufmstar_torch.posterior.distribution import divided
from ufmstar_torch.posterior.field import at
from ufmstar_torch.posterior.learn import learnt
from ufmstar_torch.posterior.motion import in_image, probability, surfaces, tests_at
from ufmstar_torch.posterior.running import Floats, Running
from ufmstar_torch.posterior.scene import (
    MOST_WRONG,
    SIDE,
    AnchorRows,
    Grid,
    at_pixels,
    away_from,
    elsewhere_variance,
    fitted,
    inlier_factor,
    local_scale,
    misscaled,
    scene_of,
    second_moments,
    slopes_away,
    spread_around,
    steepness,
    unmeasured,
    wrong_factor,
)

_NONE = AnchorRows(np.empty((0, 2)), np.empty(0, np.int64), *(np.empty(0) for _ in range(3)))


@dataclass(frozen=True)
class Posterior:
    """The posterior of B streams.

    Attributes:
        depth: [B, H, W] [m]; as predicted before the first anchor. NaN where not valid.
        variance: [B, H, W] [m^2]; UfM*'s in a stream without anchors.
        calibration: [B] running mean z^2 of held-out anchors: 1 = as predicted, above = too certain; NaN before any.
        unseen: [B] variance of y per image width of distance from evidence.
        outlier: [B, H, W] probability in [0, 1] that the error is not one of the inliers: the pixel lies on another
            surface than its evidence, or the surface moves; NaN where not valid or in a stream without anchors.
        inlier: [B, H, W] variance of the inliers [m^2]; UfM*'s in a stream without anchors.
        scores: for each stream, [2, M] scores of the frame's held-out anchors and their weights (``conformal``).
    """

    depth: Tensor
    variance: Tensor
    calibration: Tensor
    unseen: Tensor
    outlier: Tensor
    inlier: Tensor
    scores: tuple[Tensor, ...] = ()


def update(
    packed: Tensor, frame: FrameInput, anchors: Anchors | None, claimed: Tensor, config: PosteriorConfig
) -> tuple[Tensor, Posterior]:
    """Process a frame of B streams, one after the other, on the CPU.

    Args:
        packed: [B, running.SIZE] float64, the memory; not modified.
        frame: checked, on any device. On device meta, the results have shapes and no values.
        anchors: of the frame, or None.
        claimed: [B, H, W] V of UfM* without B [m^2], NaN where not valid.
        config: the constants.

    Returns:
        The memory after this frame, and the posterior, on the frame's device. Without a valid anchor, a stream learns
        nothing and its coefficients drift.
    """
    device = frame.depth.device
    if device.type == "meta":
        return packed, Posterior(frame.depth, claimed, packed[:, 0], packed[:, 0], frame.depth, claimed)
    maps = [array(x) for x in (packed, frame.depth, frame.valid, claimed)]
    streams = zip(*maps, _anchors(anchors, len(packed)), strict=True)
    results = each(functools.partial(_of_stream, config), list(streams))
    memory, depth, variance, outlier, inlier = (np.stack([result[i] for result in results]) for i in range(5))
    memories = [result[5] for result in results]
    calibration = [one.ratios["calibration"] if one.below[-1] > 0 else np.nan for one in memories]
    unseen = [one.ratios["unseen"] for one in memories]
    names = ("depth", "variance", "outlier", "inlier", "calibration", "unseen")
    arrays = depth, variance, outlier, inlier, np.array(calibration), np.array(unseen)
    scores = tuple(torch.from_numpy(result[6]) for result in results)
    outputs = {name: torch.from_numpy(x).to(device) for name, x in zip(names, arrays, strict=True)}
    return torch.from_numpy(memory).to(device), Posterior(**outputs, scores=scores)


def _anchors(anchors: Anchors | None, streams: int) -> list[AnchorRows | None]:
    if anchors is None:
        return [None] * streams
    fields = [array(x) for x in (anchors.pixel, anchors.index, anchors.predicted, anchors.depth, anchors.variance)]
    used, motion = array(anchors.mask), None if anchors.motion is None else array(anchors.motion)
    rows = [AnchorRows(*(x[b][used[b]] for x in fields)) for b in range(streams)]
    return (
        list(rows)
        if motion is None
        else [row._replace(motion=motion[b] if np.isfinite(motion[b]).any() else None) for b, row in enumerate(rows)]
    )


def _of_stream(
    config: PosteriorConfig, packed: Floats, depth: NDArray[Any], valid: NDArray[np.bool_], claimed: NDArray[Any],
    anchor_rows: AnchorRows | None,
) -> tuple[Floats, NDArray[Any], NDArray[Any], NDArray[Any], NDArray[Any], Running, Floats]:  # fmt: skip
    """The memory after the frame; depth, variance, probability of another surface and inlier variance; the unpacked
    memory; and the scores."""
    running, anchors = Running.of(packed, config), _NONE if anchor_rows is None else anchor_rows
    has_valid = len(anchors.depth) > 0
    if anchor_rows is None and not running.frames:
        predicted = np.where(valid, depth, np.nan).astype(depth.dtype)
        return packed, predicted, claimed, np.full_like(depth, np.nan), claimed, running, np.zeros((2, 0))
    with np.errstate(all="ignore"):  # invalid pixels are not read
        logs = np.log(depth)
    rows, cols = (min(SIDE, n) for n in depth.shape)
    grid = Grid.of(cell_means(logs, valid, rows, cols), rows, cols, config)
    scene = scene_of(grid, depth, valid, anchors, running)
    field, left_out, weight = fitted(scene)
    away = away_from(scene, weight * config.weak_sigma**2 >= 1)
    scores, (c, of_surfaces) = np.zeros((2, 0)), surfaces(scene, field.coefficients, running)
    if has_valid:
        memory, scores = learnt(scene, field, weight, left_out, running, away, of_surfaces)
    else:
        memory = running.drifted(grid.mean) if running.frames and valid.any() else packed
    node = np.arange(rows * cols)
    x = features(grid.log_depth - grid.mean, (node % cols + 0.5) / cols, (node // cols + 0.5) / rows)
    mean, variance = at(field, node, x)
    b, updated = field.coefficients, Running.of(memory, config)
    offset, all_anchors = mean - (x * b).sum(1), np.ones(len(scene.noise), np.bool_)
    unseen = away * updated.ratios["unseen"]
    steep = steepness(grid, field.offset)
    share, factor = unmeasured(config, field.covariance[0, 0]), inlier_factor(updated, away)
    variance = at_pixels(config, factor, variance, updated.ratios["roughness"], unseen, steep, share)
    wide = elsewhere_variance(config, spread_around(scene, all_anchors, b[0]), unseen)
    scale = local_scale(scene, left_out, all_anchors)
    p = np.minimum(updated.ratios["wrong"] * wrong_factor(config, away, scale), MOST_WRONG)
    p, wide = misscaled(config, share, p, wide)
    variance, inlier = second_moments(config, scale * variance, p, offset, wide)
    if anchors.motion is not None:
        tests = tests_at(anchors.motion, depth.shape[0], depth.shape[1], rows, cols)
        e = mean - c - in_image(x, b)
        P = probability(e, grid.log_depth, away / config.reach, tests, updated.ratios["between"], (rows, cols))
        one = np.ones_like(P)
        p, variance = 1 - (1 - p) * (1 - P), (1 - P) * variance + P * second_moments(config, variance, one, e, wide)[0]
    inlier, p = divided(variance, inlier, p)
    offset = offset + slopes_away(config, x, away, b[1:], updated.slopes)
    nodes = np.stack([grid.log_depth, offset, variance, inlier, p, away / config.reach], 1)
    depth, spread, inlier, p = read(depth, valid, logs, claimed, nodes, b, grid.mean, (rows, cols), config)
    return memory, depth, spread, p, inlier, updated, scores

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
  not count: without this limit, errors that never occur would decide the variance.
- p is the probability that the depth is of another surface than its evidence. The outputs ``inlier`` and ``outlier``
  are m(v) and p, changed by ``moments.divide``.
- In views that share little with the evidence, v has a part for the change of the network's scale (``overlap``).

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

Anchors that matching has measured are wrong on surfaces that move. Those whose ratio to the prediction no surface of
the stream has are left out (``motion.plausible``). With the probability P of ``motion``, the depth is that of the
prediction at the scale of most surfaces: the variance becomes (1 - P) V + P tail, with the tail about their ratio
instead of b . x, and p includes P. V is at least ``motion.LEAST``.

A stream whose anchors were all invalid so far has the network's depth with the variance of a node without evidence. A
stream without anchors has UfM*'s output.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ufmstar_torch.anchors.anchors import Anchors
from ufmstar_torch.frames.frame import FrameInput
from ufmstar_torch.kernels.compile_cpu import empty, kernel, part
from ufmstar_torch.kernels.cpu.calls import array, each
from ufmstar_torch.posterior.cells import interpolate, steepness
from ufmstar_torch.posterior.config import PosteriorConfig
from ufmstar_torch.posterior.conformal import adapt, quantiles, weigh
from ufmstar_torch.posterior.distribution import LEVELS
from ufmstar_torch.posterior.field import at
from ufmstar_torch.posterior.learn import sums_of
from ufmstar_torch.posterior.moments import divide, second_moments
from ufmstar_torch.posterior.motion import LEAST, in_image, plausible, probability, surfaces, tested, tests_at
from ufmstar_torch.posterior.overlap import confirm, scale_elsewhere
from ufmstar_torch.posterior.running import (
    BETWEEN,
    CALIBRATION,
    FEATURES,
    RATIOS,
    ROUGHNESS,
    UNSEEN,
    WRONG,
    Floats,
    constants,
    drift,
    expected,
    learn,
    priors,
    restart,
    views,
    write_ratios,
)
from ufmstar_torch.posterior.scene import (
    MOST_WRONG,
    SIDE,
    AnchorRows,
    at_pixels,
    elsewhere_variance,
    features,
    fitted,
    grid_of,
    inlier_factor,
    local_scale,
    misscaled,
    slopes_away,
    spread_around,
    unmeasured,
    wrong_factor,
)

_EMPTY, _UNTESTED = np.empty(0), np.empty((0, 3))
_NONE = AnchorRows(np.empty((0, 2)), np.empty(0, np.int64), _EMPTY, _EMPTY, _EMPTY, np.empty(0, np.bool_))
# A stream's anchors, tests of motion [M, 3], and the errors that its anchors share; None without anchors.
_Found = tuple[AnchorRows, Floats, tuple[float, ...]] | None
_SHOWN = 2 + len(LEVELS)  # calibration, growth with the distance, and quantiles


@dataclass(frozen=True)
class Posterior:
    """The posterior of B streams.

    Attributes:
        depth: [B, H, W] [m]; as predicted before the first anchor. NaN where not valid.
        variance: [B, H, W] [m^2]; UfM*'s in a stream without anchors. With the errors that all anchors of the frame
            share; where most anchors are off by a factor over 100, with their mean squared error.
        outlier: [B, H, W] probability in [0, 1] that the error is not one of the inliers: the pixel lies on another
            surface than its evidence, or the surface moves; NaN where not valid or in a stream without anchors.
        inlier: [B, H, W] variance of the inliers [m^2]; UfM*'s in a stream without anchors.
        calibration: [B] running mean z^2 of held-out anchors: 1 = as predicted, above = too certain; NaN before any.
        unseen: [B] variance of y per image width of distance from evidence.
        quantiles: [B, 3] |z| of held-out anchors at the levels of intervals (``conformal``); NaN = no evidence.
    """

    depth: Tensor
    variance: Tensor
    outlier: Tensor
    inlier: Tensor
    calibration: Tensor
    unseen: Tensor
    quantiles: Tensor


def update(
    packed: Tensor, frame: FrameInput, anchors: Anchors | None, claimed: Tensor, config: PosteriorConfig,
    floor: float = 0.0,
) -> tuple[Tensor, Posterior]:  # fmt: skip
    """Process a frame of B streams, one after the other, on the CPU.

    Args:
        packed: [B, running.SIZE] float64, the memory; not modified.
        frame: checked, on any device. On device meta, the results have shapes and no values.
        anchors: of the frame, or None.
        claimed: [B, H, W] V of UfM* without B [m^2], NaN where not valid.
        config: the constants.
        floor: least variance [m^2], before the errors that the anchors share.

    Returns:
        The memory after this frame, and the posterior, on the frame's device. Without a valid anchor, a stream learns
        nothing and its coefficients drift.
    """
    device = frame.depth.device
    if device.type == "meta":
        one, levels = packed[:, 0], packed[:, : len(LEVELS)]
        return packed, Posterior(frame.depth, claimed, frame.depth, claimed, one, one, levels)
    view = frame.T_world_cam, frame.intrinsics
    before, *maps = (array(x) for x in (packed, frame.depth, frame.valid, claimed, *view))
    after, outputs = before.copy(), np.empty((4, *maps[0].shape), maps[0].dtype)
    shown = np.empty((len(before), _SHOWN))
    streams = zip(after, *maps, _anchors(anchors, len(before)), zip(*outputs, strict=True), shown, strict=True)
    each(functools.partial(_of_stream, config, floor), list(streams))
    results = (torch.from_numpy(x).to(device) for x in (after, *outputs, shown))
    memory, depth, variance, outlier, inlier, figures = results
    return memory, Posterior(depth, variance, outlier, inlier, figures[:, 0], figures[:, 1], figures[:, 2:])


def _anchors(anchors: Anchors | None, streams: int) -> list[_Found]:
    """The anchors of each stream. The shared errors are variances of the inverse depth and of a factor's logarithm, and
    the mean square of rejected anchors' relative errors."""
    if anchors is None:
        return [None] * streams
    fields = (anchors.pixel, anchors.index, anchors.predicted, anchors.depth, anchors.variance, anchors.mask)
    motion = [_UNTESTED] * streams if anchors.motion is None else array(anchors.motion)
    shared = (anchors.shared, anchors.scale, anchors.contradiction)
    columns = [[0.0] * streams if x is None else x.tolist() for x in shared]
    return list(zip(map(AnchorRows, *map(array, fields)), motion, zip(*columns, strict=True), strict=True))


def _of_stream(
    config: PosteriorConfig, floor: float, packed: Floats, depth: NDArray[Any], valid: NDArray[np.bool_],
    claimed: NDArray[Any], pose: Floats, K: Floats, found: _Found, outputs: tuple[NDArray[Any], ...], shown: Floats,
) -> None:  # fmt: skip
    """Change the memory [SIZE]; write depth, variance, probability of another surface and inlier variance [H, W] to the
    ``outputs``, and the figures [5] that ``Posterior`` has of a stream."""
    factor, variance, outlier, inlier = outputs
    anchors, motion, shared = found or (_NONE, _UNTESTED, (0.0, 0.0, 0.0))
    if found is None and packed[0] == 0:
        factor[:], variance[:], inlier[:], outlier[:] = np.where(valid, 1, np.nan), claimed, claimed, np.nan
        shown[:] = np.nan
        shown[1] = config.unseen
    else:
        with np.errstate(all="ignore"):  # invalid pixels are not read
            maps = depth, valid, np.log(depth), claimed
        memory = views(packed)
        if math.isinf(shared[0]):
            restart(memory, config)
        of_frame(memory, maps, (pose, K), anchors, motion, priors(config), constants(config), outputs, shown)
        np.exp(factor, out=factor)
    finish(depth, factor, variance, inlier, (*shared, config.prior_sigma**2), floor)


@kernel
def of_frame(memory, maps, view, anchors, motion, priors, config, outputs, shown):
    """The frame of one stream.

    Args:
        memory: :class:`~ufmstar_torch.posterior.running.Memory`; changed.
        maps: depth, valid, log of the depth, claimed variance [H, W].
        view: pose [4, 4] camera-to-world [m], and K [3, 3] [px].
        anchors: :class:`AnchorRows`.
        motion: [M, 3] tests of motion (``motion.tests_at``); none if no value is finite.
        priors: [4, R] (``running.priors``).
        config: of the posterior.
        outputs: [H, W] y, variance, probability and inlier variance (``cells.interpolate``); written.
        shown: [5] calibration, growth with the distance, and quantiles; written.
    """
    depth, valid, logs, _ = maps
    ratios, frames = empty(RATIOS, np.float64), memory.frames[0]
    write_ratios(memory, priors, ratios)
    grid = grid_of(logs, valid, min(SIDE, depth.shape[0]), min(SIDE, depth.shape[1]), config)
    before, beyond = expected(memory, grid.mean, config), empty(grid.log_depth.size, np.float64)
    if tested(motion):
        anchors, beyond = plausible(anchors, frames, ratios, depth.shape, grid, config)
    scene, field, left_out, weight, away = fitted(grid, depth, valid, anchors, ratios, before, config)
    sums, scores = sums_of(scene, weight, left_out, ratios, frames, config)
    c = surfaces(scene, field.coefficients, memory, priors, ratios, config, sums)
    if scene.noise.size:
        learn(memory, sums, grid.mean, field.coefficients, field.covariance, priors, config)
        weights = empty(scores.shape[1], np.float64)
        weigh(scores[1], scores[2], away, weights)
        adapt(memory.intervals, scores[0], weights)
    elif frames > 0 and _any(valid):
        b, covariance = expected(memory, grid.mean, config)
        drift(memory, grid.mean, b, covariance, config)
    confirm(memory, view, depth.shape, grid, scene.noise.size, away, config)
    write_ratios(memory, priors, ratios)
    nodes, x, mean, wide = _nodes(scene, field, left_out, away, memory.frames[2], ratios, config)
    if tested(motion):
        _add_motion(nodes, x, mean, c, wide, motion, beyond, depth.shape, scene, field.coefficients, ratios, config)
    slopes = empty(FEATURES - 1, np.float64)
    for f in range(slopes.size):
        slopes[f] = memory.slopes[f] - field.coefficients[1 + f]
    for i in range(away.size):
        nodes[1, i] += slopes_away(config, x, i, away[i], slopes)
    divide(nodes[2], nodes[3], nodes[4])
    interpolate(maps, nodes, field.coefficients, grid, config, outputs)
    shown[0] = ratios[CALIBRATION] if memory.sums[1, CALIBRATION] > 0 else np.nan
    shown[1] = ratios[UNSEEN]
    quantiles(memory.intervals, shown[2:])


@part
def _any(valid):
    for i in range(valid.shape[0]):
        for j in range(valid.shape[1]):
            if valid[i, j]:
                return True
    return False


@part
def _nodes(scene, field, left_out, away, unconfirmed, ratios, config):
    """The nodes of :func:`ufmstar_torch.posterior.cells.interpolate` without motion [6, n], their features [n, F], mean
    of y [n], and its variance on another surface [n]."""
    grid, b, n = scene.grid, field.coefficients, away.size
    nodes, x = empty((6, n), np.float64), empty((n, FEATURES), np.float64)
    means, wides, every = empty(n, np.float64), empty(n, np.float64), empty(scene.noise.size, np.bool_)
    for k in range(every.size):
        every[k] = True
    around, scales = spread_around(scene, every, b[0], config), local_scale(scene, left_out, every, config)
    steep, scale = steepness(field.offset, grid.rows, grid.cols), scale_elsewhere(config, unconfirmed, ratios)
    for i in range(n):
        row = i // grid.cols
        features(
            grid.log_depth[i] - grid.mean, (i - row * grid.cols + 0.5) / grid.cols, (row + 0.5) / grid.rows, x, i
        )  # fmt: skip
        mean, variance = at(field, i, x, i)
        offset = mean
        for f in range(FEATURES):
            offset -= x[i, f] * b[f]
        unseen, factor = away[i] * ratios[UNSEEN], inlier_factor(config, ratios, away[i])
        of_scale = scale * away[i] / config.reach
        share = unmeasured(config, field.covariance[0, 0] + of_scale)
        variance = at_pixels(config, factor, variance, ratios[ROUGHNESS], unseen, steep[i], share) + of_scale
        p = min(ratios[WRONG] * wrong_factor(config, away[i], scales[i]), MOST_WRONG)
        p, wide = misscaled(config, share, p, elsewhere_variance(config, around[i], unseen))
        means[i], wides[i], nodes[0, i], nodes[1, i] = mean, wide, grid.log_depth[i], offset
        nodes[2, i], nodes[3, i] = second_moments(config, scales[i] * variance, p, offset, wide)
        nodes[4, i], nodes[5, i] = p, away[i] / config.reach
    return nodes, x, means, wides


@part
def _add_motion(nodes, x, mean, c, wide, motion, beyond, size, scene, b, ratios, config):
    """Add the probability of motion to the ``nodes`` [6, n]. These, ``x``, ``mean``, ``wide`` are from :func:`_nodes`.
    ``c``: constant of most surfaces; ``motion`` as in :func:`of_frame`; ``beyond`` [n] from ``motion.plausible``;
    ``size``: H and W; ``b`` [4]: coefficients; ``ratios`` up to this frame.
    """
    grid, e = scene.grid, empty(mean.size, np.float64)
    for i in range(e.size):
        e[i] = mean[i] - c - in_image(x, i, b)
    tests = tests_at(motion, size[0], size[1], grid.rows, grid.cols)
    P = probability(e, grid.log_depth, nodes[5], tests, beyond, ratios[BETWEEN], grid.rows, grid.cols)
    for i in range(e.size):
        if P[i] > 0:
            tail = second_moments(config, nodes[2, i], 1.0, e[i], wide[i])[0]
            nodes[2, i] = (1 - P[i]) * nodes[2, i] + P[i] * tail
            nodes[4, i] = 1 - (1 - nodes[4, i]) * (1 - P[i])
        nodes[2, i] = max(nodes[2, i], LEAST)


@kernel
def finish(depth, factor, variance, inlier, common, floor):
    """Change e^y [H, W] to the depth d e^y, and its variances over e^2y to those [m^2]: at least ``floor``, plus the
    errors that all anchors of the frame share.

    ``common``: variance of the inverse-depth error, variance of the logarithm of a factor, mean square of rejected
    anchors' relative errors (``Anchors``), and the limit of the first two, over the squared depth.
    """
    shared, scale, contradiction, limit = common
    for i in range(depth.shape[0]):
        for j in range(depth.shape[1]):
            square = np.float64(factor[i, j]) * np.float64(factor[i, j])
            d = factor[i, j] = depth[i, j] * factor[i, j]
            V, V1 = variance[i, j] * square, inlier[i, j] * square
            depth_square = np.float64(d) * np.float64(d)
            added = depth_square * (contradiction + min(depth_square * shared + scale, limit))
            variance[i, j] = (floor if floor > V else V) + added
            inlier[i, j] = (floor if floor > V1 else V1) + added

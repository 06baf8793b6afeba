"""The posterior of ``ufmstar_torch/posterior`` as NumPy loops: dense matrices, one stream, float64."""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np
import oracle_field as field
import oracle_interval as interval
import oracle_overlap as overlap
import oracle_spread as spreads
from oracle_held_out import held_out
from oracle_motion import moving, plausible, surfaces

CLIP = 9.0


def update(state, depth, claimed, pixel, g, variance, motion=None, view=overlap.LEVEL):
    """One frame: depth [H, W] (0 = not valid), claimed V [m^2], anchors (pixel [N, 2], depth, variance), all valid.
    ``motion`` [M, 3]: u, v and log likelihood field.ratio of motion. ``view``: pose [4, 4] and K [3, 3].

    Returns the state after it, posterior depth, variance, variance on the evidence's surface, and probability of
    another [H, W].
    """
    logs = field.nodes(depth)
    prior, beyond = field.joint_prior(logs, state), np.zeros(logs.shape)
    if motion is not None:
        (pixel, g, variance), beyond = plausible(state, depth, logs, pixel, g, variance)
    seen = observed(state, depth, logs, pixel, g, variance)
    fit = fitted(state, logs, *prior, seen)
    after = learnt(state, logs, *prior, seen, fit)
    overlap.confirmed(state, after, logs, depth.shape, fit.away, view)
    offset, alone, spread, p, share = at_nodes(state, after, depth.shape, logs, seen, fit, motion, beyond)
    b = fit.mean[:4]
    posterior, variance, outlier = read(depth, np.nan_to_num(claimed), logs, b, offset, spread, p, share)
    _, inlier, _ = read(depth, 0 * depth, logs, b, offset, alone, p, share)
    return after, posterior, variance, inlier, outlier


def observed(state, depth, logs, pixel, g, variance):
    """The anchors: y = log(g / d), field.design H, cell, position, and variances of the noise."""
    (rows, cols), (h, w), N = logs.shape, depth.shape, len(g)
    u, v = (pixel[:, 0] + 0.5) / w, (pixel[:, 1] + 0.5) / h
    node = np.minimum((v * rows).astype(int), rows - 1) * cols + np.minimum((u * cols).astype(int), cols - 1)
    at = np.rint(pixel).astype(int)
    d = np.array([depth[r, c] for c, r in at])
    stated, blur = field.ratio(state, "noise") * variance / g**2 + 1 / N, np.zeros(N)
    for k, (c, r) in enumerate(at):
        around = depth[max(r - 1, 0) : r + 2, max(c - 1, 0) : c + 2]
        around = np.log(around[around > 0])
        blur[k] = (around.max() - around.min()) / 2
    x = np.array([field.features(math.log(d[k]) - logs.mean(), u[k], v[k]) for k in range(N)])
    noise = stated + field.ratio(state, "roughness") + blur**2
    return SimpleNamespace(
        y=np.log(g / d), H=field.design(x, node, logs.size), node=node, u=u, v=v, stated=stated, noise=noise
    )


def fitted(state, logs, mean0, Q, seen):
    """Mean and covariance of (b, f) after a fit and one with new weights, and each anchor's residual without itself."""
    weight, prior = 1 / seen.noise, Q
    for round_ in range(2):
        mean, C = field.condition(mean0, prior, seen.H, seen.y, weight)
        var = np.einsum("ij,jk,ik->i", seen.H, C, seen.H)
        remainder = np.maximum(1 - weight * var, 0.05)
        residual, var = (seen.y - seen.H @ mean) / remainder, var / remainder
        total = var + seen.noise
        if round_ < 1:
            weight = 1 / (seen.noise + np.maximum(residual**2 / total - 1, 0) * total / 3)
            prior = field.loosened(Q, logs, mean[field.FEATURES :], field.ratio(state, "amplitude"))
    away, z2 = field.distances(logs, set(seen.node[weight * spreads.WEAK >= 1])), np.minimum(residual**2 / total, CLIP)
    return SimpleNamespace(mean=mean, C=C, weight=weight, residual=residual, total=total, away=away, z2=z2)


def learnt(state, logs, mean0, Q, seen, fit):
    """The state after the frame."""
    node, N, new = seen.node, len(seen.y), {}
    count, square = np.bincount(node, minlength=logs.size)[node], np.minimum(fit.residual**2, CLIP * fit.total)
    roughness = field.ratio(state, "roughness")
    for name, part in (("roughness", np.full(N, roughness)), ("noise", seen.stated)):
        weights = (part / fit.total) ** 2 / count
        unit = field.ratio(state, name) / np.maximum(part, 1e-12)
        new[name] = (weights * (part + square - fit.total) * unit).sum(), weights.sum()
    new |= held_out(state, logs, Q, mean0, seen.H, seen.y, fit.weight, seen.noise, fit.z2, node, seen.u, seen.v,
                 seen.stated - 1 / N, fit.away)  # fmt: skip
    c, new["centre"], new["between"] = surfaces(state, node, seen.y - seen.H[:, 2:4] @ fit.mean[2:4], seen.noise)
    weights = 3 + sum(field.MEMORY**k for k in range(state["frames"] + 1))
    slopes = state["slopes"] * (1 - 1 / weights) + fit.mean[1:4] / weights
    after = {"frames": state["frames"] + 1, "m0": logs.mean(), "slopes": slopes, "b": fit.mean[:4],
             "C": fit.C[:4, :4], "sums": {}, "most": c,
             "intervals": interval.updated(state["intervals"], *new.pop("scores"))}  # fmt: skip
    for name, (value, prior, low, high) in field.START.items():
        above, below = state["sums"][name]
        below = field.MEMORY * below + (1 - field.MEMORY) * prior + new[name][1]
        above = field.MEMORY * above + (1 - field.MEMORY) * prior * value + new[name][0]
        after["sums"][name] = [min(max(above, low * below), high * below), below]
    return after


def at_nodes(state, after, size, logs, seen, fit, motion, beyond):
    """Offset of log depth, relative variances on the evidence's surface and in all, probability of another surface, and
    distance, at the field.nodes."""
    mean, C, n = fit.mean, fit.C, logs.size
    X, used = field.node_features(logs), np.ones(len(seen.y), bool)
    HX = field.design(X, np.arange(n), n)
    unsure, unseen = np.einsum("ij,jk,ik->i", HX, C, HX), fit.away * field.ratio(after, "unseen")
    scale = spreads.local_scale(logs.shape, seen.node, fit.z2, seen.noise, used)
    steep, of_scale = spreads.steepness(logs.shape, mean[field.FEATURES :]), overlap.scale_elsewhere(after, fit.away)
    unmeasured = np.minimum((C[0, 0] + of_scale) / field.PRIOR[0], 1) ** 2
    factor = spreads.inlier_factor(after, fit.away)
    spread = spreads.at_pixels(factor, unsure, field.ratio(after, "roughness"), unseen, steep, unmeasured) + of_scale
    spread = scale * spread
    offset, share = HX[:, 4:] @ mean[4:], fit.away / field.REACH
    around = spreads.y_variance(logs.shape, seen.node, seen.y, seen.noise, used, mean[0])
    p = np.minimum(field.ratio(after, "wrong") * spreads.wrong_factor(share, scale), 0.5)
    wide = [spreads.elsewhere(*each) for each in zip(around, unseen, strict=True)]
    p = np.where(p < 0.1, p + unmeasured * (0.1 - p), p)
    wide = np.array(wide) + unmeasured * (2 - np.array(wide))
    alone = [spreads.second_moment(0.0, *each) for each in zip(spread, offset, wide, strict=True)]
    spread = [spreads.second_moment(*each) for each in zip(p, spread, offset, wide, strict=True)]
    if motion is not None:
        e = offset + mean[0] + X[:, 1] * mean[1] - after["most"]
        P = moving(motion, size, logs, e, share, field.ratio(after, "between"), beyond)
        elsewhere_ = [spreads.second_moment(1.0, 0.1, *each) for each in zip(e, wide, strict=True)]
        p, spread = 1 - (1 - p) * (1 - P), np.maximum((1 - P) * spread + P * elsewhere_, 0.02**2)
    alone, spread = np.array(alone), np.array(spread)
    beyond = np.maximum((spread - (1 - p) * alone) / np.maximum(p, 1e-12), alone)
    alone = np.minimum(alone, np.quantile(alone, 0.7))
    p = np.maximum(p, np.clip((spread - alone) / np.maximum(np.maximum(beyond, 16 * alone) - alone, 1e-12), 0, 1))
    for k, x in enumerate(HX[:, 1:4]):
        offset[k] += share[k] ** 2 / (share[k] ** 2 + 0.5**2) * (x @ (after["slopes"] - mean[1:4]))
    return offset, alone, spread, p, share


def read(depth, claimed, logs, b, offset, spread, p, share):
    h, w = depth.shape
    rows, cols = logs.shape
    out, variance, outlier = np.full((3, h, w), np.nan)
    for i in range(h):
        for j in range(w):
            if depth[i, j] <= 0:
                continue
            v, u, g = (i + 0.5) / h, (j + 0.5) / w, math.log(depth[i, j])
            y = b[0] + b[1] * (g - logs.mean()) + b[2] * (2 * u - 1) + b[3] * (2 * v - 1)
            r, c = (min(max(x * n - 0.5, 0), n - 1) for x, n in ((v, rows), (u, cols)))
            top, left = (min(int(x), max(n - 2, 0)) for x, n in ((r, rows), (c, cols)))
            sums = np.zeros(5)
            for row, by_row in ((top, 1 - (r - top)), (min(top + 1, rows - 1), r - top)):
                for col, by_col in ((left, 1 - (c - left)), (min(left + 1, cols - 1), c - left)):
                    k = row * cols + col
                    weight = by_row * by_col / (1 + ((g - logs[row, col]) / 0.1) ** 2)
                    sums += weight * np.array([1, offset[k], spread[k], p[k], share[k]])
            offset_, spread_, p_, share_ = sums[1:] / sums[0]
            out[i, j] = depth[i, j] * math.exp(min(max(y + offset_, -math.log(100)), math.log(100)))
            variance[i, j] = out[i, j] ** 2 * max(spread_, share_ * claimed[i, j] / depth[i, j] ** 2)
            outlier[i, j] = p_
    return out, variance, outlier

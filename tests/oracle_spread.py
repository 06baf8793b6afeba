"""Variances of the posterior's oracle at nodes, and the probability of another surface."""

from __future__ import annotations

import math

import numpy as np
from oracle_field import ratio

RADIUS, NEAR, WEAK = 0.15, 0.05, 0.25**2


def around(shape, node, noise, used, width):
    """The used anchors' indices, and for each node their weights: a Gaussian of ``width`` of the image. Cells and
    certain anchors have equal weights."""
    count, k = np.bincount(node, minlength=shape[0] * shape[1])[node], np.nonzero(used)[0]
    (r, c), rows, cols = np.divmod(node[k], shape[1]), *np.indices(shape).reshape(2, -1)
    far = ((r - rows[:, None]) / shape[0]) ** 2 + ((c - cols[:, None]) / shape[1]) ** 2
    return k, np.exp(-far / width**2 / 2) / (1 + noise[k] / WEAK) / count[k]


def local_scale(shape, node, z2, noise, used):
    """Mean z^2 of the anchors around each node, with a prior observation z^2 = 1."""
    k, weights = around(shape, node, noise, used, NEAR)
    return np.array([np.average([1, *z2[k]], weights=[1, *w]) for w in weights])


def wrong_factor(share, scale):
    """Factor on the probability of another surface; share = distance."""
    return scale ** np.maximum(1 - share / RADIUS, 0)


def y_variance(shape, node, y, noise, used, centre):
    """Variance of the anchors around each node, with a prior observation of variance .25 about ``centre``."""
    k, weights = around(shape, node, noise, used, RADIUS)
    out, values = [], np.array([centre, *y[k]])
    for w in weights:
        w = np.array([1, *w])
        out.append(np.average((values - np.average(values, weights=w)) ** 2, weights=w) + 0.25 / w.sum())
    return np.array(out)


def second_moment(p, variance, offset, wide):
    """E[(e^n - 1)^2] for |n| up to log 6, n normal, or with the probability p of n - offset."""
    limit, moments = math.log(6), []
    for v, o in ((min(variance, 2), 0.0), (wide, min(max(offset, -limit), limit))):
        sigma = math.sqrt(v)
        mass, first, second = (
            normal_cdf((o + limit) / sigma - k * sigma) - normal_cdf((o - limit) / sigma - k * sigma) for k in range(3)
        )
        square = math.exp(2 * v - 2 * o) * second - 2 * math.exp(v / 2 - o) * first + mass
        moments.append(max(square / mass, 0))
    return (1 - p) * moments[0] + p * moments[1]


def normal_cdf(x):
    return math.erfc(-x / math.sqrt(2)) / 2


def normal(x, variance):
    return np.exp(-(x**2) / variance / 2) / np.sqrt(2 * math.pi * variance)


def at_pixels(factor, field, roughness, unseen, steep, unmeasured=0.0):
    """Variance of y at pixels, before the local scale."""
    return factor * ((0.17 + 0.83 * unmeasured) * field + 21 * roughness + 0.55 * unseen) + 2.3 * steep


def steepness(shape, f):
    """Variance of f over each node and its eight neighbours; the border is replicated."""
    f, out = f.reshape(shape), np.empty(shape)
    for r in range(shape[0]):
        for c in range(shape[1]):
            rows, cols = (np.clip([i - 1, i, i + 1], 0, n - 1) for i, n in zip((r, c), shape, strict=True))
            out[r, c] = np.var(f[np.ix_(rows, cols)])
    return out.ravel()


def inlier_factor(state, away):
    """Factor from held-out anchors; it fades within the width of a disc."""
    return 1 + (ratio(state, "inlier") - 1) * np.maximum(1 - away / (2 * RADIUS), 0)


def elsewhere(around, unseen):
    """Variance of y on another surface."""
    return min(around + 12 * unseen, 2)

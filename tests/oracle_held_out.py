"""Held-out anchors of the posterior's oracle: those in discs or a half of the image, predicted from the others."""

from __future__ import annotations

import math

import numpy as np
import oracle_interval as interval
import oracle_spread as spread
from oracle_field import FEATURES, REACH, condition, distances, links, ratio

APART = 0.5


def held_out(state, logs, Q, mean0, H, y, weight, noise, z2, node, u, v, measured, everywhere):
    held, frames = np.zeros(len(y), bool), state["frames"]
    if frames % 4 == 3:
        angle = 2 * math.pi * 0.7548776662466927 * (frames + 1) / 4
        held = (u - 0.5) * math.cos(angle) + (v - 0.5) * math.sin(angle) > 0
    for number in range(frames * 3 + 1, frames * 3 + 4) if frames % 4 < 3 else ():
        cu, cv = (number * 0.7548776662466927) % 1, (number * 0.5698402909980532) % 1
        held |= (u - cu) ** 2 + (v - cv) ** 2 < spread.RADIUS**2
    rest = ~held
    if rest.sum() < 5:
        held[:] = False
    mean, C = condition(mean0, Q, H, y, weight * rest)
    fit, var = H @ mean, np.einsum("ij,jk,ik->i", H, C, H)
    away = distances(logs, set(node[rest]))[node]
    error = y - fit
    believed = np.where(held, 1 / (1 + noise / spread.WEAK), 0.0)
    area = believed / np.maximum(np.bincount(node, believed, minlength=logs.size)[node], 1e-12)
    share, around = away / REACH, spread.y_variance(logs.shape, node, y, noise, rest, mean[0])[node]
    offset = H[:, FEATURES:] @ mean[FEATURES:]
    factor = spread.inlier_factor(state, away)
    scale = spread.local_scale(logs.shape, node, z2, noise, rest)[node]
    inlier_variance = (
        factor * (var + noise + away * ratio(state, "unseen")) + spread.steepness(logs.shape, mean[FEATURES:])[node]
    )
    inlier_variance, more_wrong = scale * inlier_variance, spread.wrong_factor(share, scale)
    beyond = np.array([spread.elsewhere(*each) for each in zip(around, away * ratio(state, "unseen"), strict=True)])
    wide = noise + beyond
    p = np.minimum(ratio(state, "wrong") * more_wrong, 0.5)
    final = [spread.second_moment(*each) for each in zip(p, inlier_variance, offset, beyond, strict=True)]
    scores = []
    for i in np.nonzero(held)[0]:
        steep, unseen = spread.steepness(logs.shape, mean[FEATURES:])[node[i]], away[i] * ratio(state, "unseen")
        at_pixel = spread.at_pixels(factor[i], var[i], ratio(state, "roughness"), unseen, steep)
        at_pixel = scale[i] * (at_pixel + measured[i])
        total, alone = (spread.second_moment(q, at_pixel, offset[i], beyond[i] + measured[i]) for q in (p[i], 0.0))
        mixture = [(1 - p[i], 1.0, alone), (p[i], 1.0, max((total - (1 - p[i]) * alone) / p[i], alone))]
        scores.append(abs(interval.standard(mixture, math.exp(error[i]))))
    inlier, outlier = (1 - p) * spread.normal(error, inlier_variance), p * spread.normal(error + offset, wide)
    inlier, outlier = inlier / (inlier + outlier), outlier / (inlier + outlier)
    return pairs(state, logs, held, node, error, var, away, noise) | {
        "wrong": ((area * outlier).sum(), (area * more_wrong).sum()),
        "inlier": ((area * inlier * factor * error**2 / inlier_variance).sum(), (area * inlier).sum()),
        "calibration": ((area * error**2 / final).sum(), area.sum()),
        "scores": (scores, interval.weights(away[held], area[held], everywhere)),
    }


def pairs(state, logs, held, node, error, var, away, noise):
    """Sums over neighbouring cells that both hold anchors, and over cells without such a neighbour."""
    amplitude, sums = ratio(state, "amplitude"), np.zeros(4)
    inside = {i: held & (node == i) for i in set(node[held])}
    alone, count = set(inside), 0
    for i, j, variance, _ in links(logs):
        if i in inside and j in inside:
            e, v, a, n = ([x[inside[k]].mean() for k in (i, j)] for x in (error, var, away, noise))
            common, far = max((sum(v) - APART * amplitude * variance) / 2, 0), sum(a) / 2
            weight, product = 2 / (sum(v) + sum(n)), e[0] * e[1]
            sums += weight * product, weight * common / amplitude, far * (product - common), far**2
            alone, count = alone - {i, j}, count + 1
    for i in alone:
        e, v, far, n = (x[inside[i]].mean() for x in (error, var, away, noise))
        product = e * e - n / inside[i].sum()
        terms = np.array([product / (v + n), v / (v + n) / amplitude, far * (product - v), far**2])
        sums += terms * len(alone) / (len(alone) + count)
    return {"amplitude": (sums[0], sums[1]), "unseen": (sums[2], sums[3])}

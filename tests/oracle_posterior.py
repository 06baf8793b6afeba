"""The posterior of ``ufmstar_torch/posterior`` as NumPy loops: dense matrices, one stream, float64."""

from __future__ import annotations

import heapq
import math
from types import SimpleNamespace

import numpy as np
import oracle_interval as interval

SIDE, FEATURES = 28, 4
START = {
    "amplitude": (1.0, 20.0, 0.1, 100.0),
    "roughness": (0.0025, 20.0, 1e-4, 0.04),
    "noise": (1.0, 20.0, 0.25, 16.0),
    "unseen": (0.06, 20.0, 0.0, 16.0),
    "wrong": (0.015, 20.0, 0.0015, 0.15),
    "inlier": (1.0, 20.0, 0.05, 4.0),
    "between": (0.04, 20.0, 9e-4, 1.0),
    "centre": (0.0, 0.0, -14.0, 14.0),
    "calibration": (0.0, 0.0, 0.0, 1e6),
}
PRIOR, DRIFT, MEMORY = np.array([0.5, 0.12, 0.2, 0.2]) ** 2, 0.05**2, 0.5 ** (1 / 20)
REACH, RADIUS, NEAR, WEAK, CLIP, APART = 1.0, 0.15, 0.05, 0.25**2, 9.0, 0.5


def start():
    return {"frames": 0, "m0": 0.0, "slopes": np.zeros(3), "b": np.zeros(4), "C": np.diag(PRIOR),
            "intervals": [0.0] * 4, "sums": {k: [v * n, n] for k, (v, n, _, _) in START.items()}}  # fmt: skip


def ratio(state, name):
    value, _, low, high = START[name]
    above, below = state["sums"][name]
    return min(max(above / below, low), high) if below > 0 else value


def nodes(depth):
    """Mean log depth of R x C cells; a cell covers every pixel that it touches."""
    h, w = depth.shape
    rows, cols = min(SIDE, h), min(SIDE, w)
    mean = np.full((rows, cols), np.nan)
    for r in range(rows):
        for c in range(cols):
            top, bottom = r * h // rows, -(-(r + 1) * h // rows)
            left, right = c * w // cols, -(-(c + 1) * w // cols)
            inside = depth[top:bottom, left:right]
            if (inside > 0).any():
                mean[r, c] = np.log(inside[inside > 0]).mean()
    return np.where(np.isnan(mean), 0.0 if np.isnan(mean).all() else np.nanmean(mean), mean)


def links(logs):
    """(i, j, variance, length) of all links."""
    rows, cols = logs.shape
    for r in range(rows):
        for c in range(cols):
            for dr, dc, n in ((0, 1, cols), (1, 0, rows)):
                if r + dr < rows and c + dc < cols:
                    d = 1.67 * abs(logs[r + dr, c + dc] - logs[r, c])
                    i = r * cols + c
                    yield i, i + dr * cols + dc, 0.0015 + 6 * d * d, 1 / n + d


def features(logs, u, v):
    """logs less m_0; u and v from 0 to 1."""
    return np.array([1, logs, 2 * u - 1, 2 * v - 1])


def node_features(logs):
    rows, cols = logs.shape
    m0 = logs.mean()
    return np.array([features(logs[r, c] - m0, (c + 0.5) / cols, (r + 0.5) / rows)
                     for r in range(rows) for c in range(cols)])  # fmt: skip


def joint_prior(logs, state):
    """Mean and precision of (b, f)."""
    n, m0, q, amplitude = logs.size, logs.mean(), FEATURES, ratio(state, "amplitude")
    T, C = np.eye(4), state["C"]
    if state["frames"]:
        T = np.diag([1, 0.8, 0.8, 0.8]) @ np.array([[1, m0 - state["m0"], 0, 0], *np.eye(4)[1:]])
        C = T @ C @ T.T
        C = C + np.diag([DRIFT * min(max(1 - C[0, 0] / PRIOR[0], 0), 1), *(0.36 * PRIOR[1:])])
    Q = np.zeros((q + n, q + n))
    Q[:4, :4] = np.linalg.inv(C)
    Q[q:, q:] = np.eye(n) * 0.5 / amplitude
    for i, j, variance, _ in links(logs):
        w = 1 / (variance * amplitude)
        for a, b, s in ((i, i, 1), (j, j, 1), (i, j, -1), (j, i, -1)):
            Q[q + a, q + b] += s * w
    mean = np.zeros(q + n)
    mean[:4] = T @ state["b"] + np.array([0, 0, *(0.2 * state["slopes"][1:] * (state["frames"] > 0))])
    return mean, Q


def loosened(Q, logs, f, amplitude):
    """The prior's precision reweighted after a first fit f: links have Student's t with two degrees of freedom."""
    Q, q = Q.copy(), FEATURES
    for i, j, variance, _ in links(logs):
        w = 1 / (variance * amplitude)
        more = w * 3 / (2 + w * (f[i] - f[j]) ** 2) - w
        for a, b, s in ((i, i, 1), (j, j, 1), (i, j, -1), (j, i, -1)):
            Q[q + a, q + b] += s * more
    return Q


def condition(mean, Q, H, y, w):
    """Posterior mean and covariance given y = H x + noise of precision w."""
    covariance = np.linalg.inv(Q + (H * w[:, None]).T @ H)
    return mean + covariance @ (H.T @ (w * (y - H @ mean))), covariance


def design(x, node, n):
    H = np.zeros((len(x), x.shape[1] + n))
    H[:, : x.shape[1]] = x
    H[np.arange(len(x)), x.shape[1] + node] = 1
    return H


def distances(logs, source):
    """Dijkstra, up to ``REACH``."""
    n = logs.size
    near = [[] for _ in range(n)]
    for i, j, _, length in links(logs):
        near[i].append((j, length))
        near[j].append((i, length))
    way, heap = np.full(n, REACH), [(0.0, i) for i in source]
    for i in source:
        way[i] = 0.0
    while heap:
        d, i = heapq.heappop(heap)
        for j, length in near[i]:
            if d + length < way[j]:
                way[j] = d + length
                heapq.heappush(heap, (way[j], j))
    return way


def update(state, depth, claimed, pixel, g, variance, motion=None):
    """One frame: depth [H, W] (0 = not valid), claimed V [m^2], anchors (pixel [N, 2], depth, variance), all valid.
    ``motion`` [M, 3]: u, v and log likelihood ratio of motion.

    Returns the state after it, posterior depth, variance, variance on the evidence's surface, and probability of
    another [H, W].
    """
    logs = nodes(depth)
    prior, beyond = joint_prior(logs, state), np.zeros(logs.shape)
    if motion is not None:
        (pixel, g, variance), beyond = plausible(state, depth, logs, pixel, g, variance)
    seen = observed(state, depth, logs, pixel, g, variance)
    fit = fitted(state, logs, *prior, seen)
    after = learnt(state, logs, *prior, seen, fit)
    offset, alone, spread, p, share = at_nodes(state, after, depth.shape, logs, seen, fit, motion, beyond)
    b = fit.mean[:4]
    posterior, variance, outlier = read(depth, np.nan_to_num(claimed), logs, b, offset, spread, p, share)
    _, inlier, _ = read(depth, 0 * depth, logs, b, offset, alone, p, share)
    return after, posterior, variance, inlier, outlier


def plausible(state, depth, logs, pixel, g, variance):
    """The anchors (pixel, depth, variance) whose log ratio lies within 9.92 scales, or log 6, of that of most;
    all, if these are not half of them; and the share of the others at every node."""
    y = [math.log(one / depth[round(v), round(u)]) for one, (u, v) in zip(g, pixel, strict=True)]
    far = np.abs(y - np.float64(ratio(state, "centre"))) > max(9.92 * ratio(state, "between") ** 0.5, math.log(6))
    if not state["frames"] or far.mean() > 0.5:
        far[:] = False
    count, beyond = np.zeros((2, *logs.shape))
    for (u, v), one in zip(pixel, far, strict=True):
        r, c = int((v + 0.5) / depth.shape[0] * logs.shape[0]), int((u + 0.5) / depth.shape[1] * logs.shape[1])
        count[r, c] += 1
        beyond[r, c] += one
    return (pixel[~far], g[~far], variance[~far]), beyond / np.maximum(count, 1)


def observed(state, depth, logs, pixel, g, variance):
    """The anchors: y = log(g / d), design H, cell, position, and variances of the noise."""
    (rows, cols), (h, w), N = logs.shape, depth.shape, len(g)
    u, v = (pixel[:, 0] + 0.5) / w, (pixel[:, 1] + 0.5) / h
    node = np.minimum((v * rows).astype(int), rows - 1) * cols + np.minimum((u * cols).astype(int), cols - 1)
    at = np.rint(pixel).astype(int)
    d = np.array([depth[r, c] for c, r in at])
    stated, blur = ratio(state, "noise") * variance / g**2 + 1 / N, np.zeros(N)
    for k, (c, r) in enumerate(at):
        around = depth[max(r - 1, 0) : r + 2, max(c - 1, 0) : c + 2]
        around = np.log(around[around > 0])
        blur[k] = (around.max() - around.min()) / 2
    x = np.array([features(math.log(d[k]) - logs.mean(), u[k], v[k]) for k in range(N)])
    noise = stated + ratio(state, "roughness") + blur**2
    return SimpleNamespace(
        y=np.log(g / d), H=design(x, node, logs.size), node=node, u=u, v=v, stated=stated, noise=noise
    )


def fitted(state, logs, mean0, Q, seen):
    """Mean and covariance of (b, f) after a fit and one with new weights, and each anchor's residual without itself."""
    weight, prior = 1 / seen.noise, Q
    for round_ in range(2):
        mean, C = condition(mean0, prior, seen.H, seen.y, weight)
        var = np.einsum("ij,jk,ik->i", seen.H, C, seen.H)
        remainder = np.maximum(1 - weight * var, 0.05)
        residual, var = (seen.y - seen.H @ mean) / remainder, var / remainder
        total = var + seen.noise
        if round_ < 1:
            weight = 1 / (seen.noise + np.maximum(residual**2 / total - 1, 0) * total / 3)
            prior = loosened(Q, logs, mean[FEATURES:], ratio(state, "amplitude"))
    away, z2 = distances(logs, set(seen.node[weight * WEAK >= 1])), np.minimum(residual**2 / total, CLIP)
    return SimpleNamespace(mean=mean, C=C, weight=weight, residual=residual, total=total, away=away, z2=z2)


def learnt(state, logs, mean0, Q, seen, fit):
    """The state after the frame."""
    node, N, new = seen.node, len(seen.y), {}
    count, square = np.bincount(node, minlength=logs.size)[node], np.minimum(fit.residual**2, CLIP * fit.total)
    roughness = ratio(state, "roughness")
    for name, part in (("roughness", np.full(N, roughness)), ("noise", seen.stated)):
        weights = (part / fit.total) ** 2 / count
        unit = ratio(state, name) / np.maximum(part, 1e-12)
        new[name] = (weights * (part + square - fit.total) * unit).sum(), weights.sum()
    new |= discs(state, logs, Q, mean0, seen.H, seen.y, fit.weight, seen.noise, fit.z2, node, seen.u, seen.v,
                 seen.stated - 1 / N, fit.away)  # fmt: skip
    c, new["centre"], new["between"] = surfaces(state, node, seen.y - seen.H[:, 2:4] @ fit.mean[2:4], seen.noise)
    weights = 3 + sum(MEMORY**k for k in range(state["frames"] + 1))
    slopes = state["slopes"] * (1 - 1 / weights) + fit.mean[1:4] / weights
    after = {"frames": state["frames"] + 1, "m0": logs.mean(), "slopes": slopes, "b": fit.mean[:4],
             "C": fit.C[:4, :4], "sums": {}, "most": c,
             "intervals": interval.updated(state["intervals"], *new.pop("scores"))}  # fmt: skip
    for name, (value, prior, low, high) in START.items():
        above, below = state["sums"][name]
        below = MEMORY * below + (1 - MEMORY) * prior + new[name][1]
        above = MEMORY * above + (1 - MEMORY) * prior * value + new[name][0]
        after["sums"][name] = [min(max(above, low * below), high * below), below]
    return after


def at_nodes(state, after, size, logs, seen, fit, motion, beyond):
    """Offset of log depth, relative variances on the evidence's surface and in all, probability of another surface, and
    distance, at the nodes."""
    mean, C, n = fit.mean, fit.C, logs.size
    X, used = node_features(logs), np.ones(len(seen.y), bool)
    HX = design(X, np.arange(n), n)
    field, unseen = np.einsum("ij,jk,ik->i", HX, C, HX), fit.away * ratio(after, "unseen")
    scale = local_scale(logs.shape, seen.node, fit.z2, seen.noise, used)
    steep, unmeasured = steepness(logs.shape, mean[FEATURES:]), min(C[0, 0] / PRIOR[0], 1) ** 2
    factor = inlier_factor(after, fit.away)
    spread = scale * at_pixels(factor, field, ratio(after, "roughness"), unseen, steep, unmeasured)
    offset, share = HX[:, 4:] @ mean[4:], fit.away / REACH
    around = y_variance(logs.shape, seen.node, seen.y, seen.noise, used, mean[0])
    p = np.minimum(ratio(after, "wrong") * wrong_factor(share, scale), 0.5)
    wide = [elsewhere(*each) for each in zip(around, unseen, strict=True)]
    p = np.where(p < 0.1, p + unmeasured * (0.1 - p), p)
    wide = [each + unmeasured * (2 - each) for each in wide]
    alone = [second_moment(0.0, *each) for each in zip(spread, offset, wide, strict=True)]
    spread = [second_moment(*each) for each in zip(p, spread, offset, wide, strict=True)]
    if motion is not None:
        e = offset + mean[0] + X[:, 1] * mean[1] - after["most"]
        P = moving(motion, size, logs, e, share, ratio(after, "between"), beyond)
        elsewhere_ = [second_moment(1.0, 0.1, *each) for each in zip(e, wide, strict=True)]
        p, spread = 1 - (1 - p) * (1 - P), (1 - P) * np.array(spread) + P * np.array(elsewhere_)
    alone, spread = np.array(alone), np.array(spread)
    beyond = np.maximum((spread - (1 - p) * alone) / np.maximum(p, 1e-12), alone)
    alone = np.minimum(alone, np.quantile(alone, 0.7))
    p = np.maximum(p, np.clip((spread - alone) / np.maximum(np.maximum(beyond, 16 * alone) - alone, 1e-12), 0, 1))
    for k, x in enumerate(HX[:, 1:4]):
        offset[k] += share[k] ** 2 / (share[k] ** 2 + 0.5**2) * (x @ (after["slopes"] - mean[1:4]))
    return offset, alone, spread, p, share


def surfaces(state, node, y, noise):
    """The constant of most surfaces, and the sums of centre and between."""
    cells = sorted(set(node))
    y = [np.average(y[node == i], weights=1 / noise[node == i]) for i in cells]
    s2, mean, variance = ratio(state, "between"), ratio(state, "centre"), 0.15**2 if state["frames"] else PRIOR[0]

    def loss(c):
        return sum(1.5 * math.log(1 + (one - c) ** 2 / s2 / 2) for one in y) / 40 + (c - mean) ** 2 / variance / 2

    c, n = min([*np.quantile(y, np.linspace(0.02, 0.98, 33)), mean], key=loss), len(y) / 8
    value, prior, low, high = START["between"]
    above, below = (MEMORY * one for one in state["sums"]["between"])
    for _ in range(8):
        weights = [3 / (2 + (one - c) ** 2 / s2) for one in y]
        sums = sum(w * one for w, one in zip(weights, y, strict=True)) / s2 / 40, sum(weights) / s2 / 40
        c = (sums[0] + mean / variance) / (sums[1] + 1 / variance)
        square = sum(w * (one - c) ** 2 for w, one in zip(weights, y, strict=True)) / 8
        s2 = (above + (1 - MEMORY) * prior * value + square) / (below + (1 - MEMORY) * prior + n)
        s2 = min(max(s2, low), high)
    return c, (c * n, n), (square, n)


def moving(motion, size, logs, e, share, between, beyond):
    """Probability of motion at the nodes."""
    rows, cols = logs.shape
    e, share, P = e.reshape(logs.shape), share.reshape(logs.shape), []
    ratios, sides = np.zeros((2, *logs.shape))
    for r in range(rows):
        for c in range(cols):
            f, v = e[r, c], between + 0.8**2
            normal_density = math.exp(-f * f / v / 2) / math.sqrt(2 * math.pi * v)
            student = (1 + f * f / between / 2) ** -1.5 / (2 * math.sqrt(2) * math.sqrt(between))
            ratios[r, c] = max(1 - share[r, c], 0) * math.log(normal_density / student)
            ratios[r, c] += beyond[r, c] * (50 - ratios[r, c])
            sides[r, c] = max(1 - share[r, c], 0) * math.log(1.9 if f > 0 else 0.1)
    for r in range(rows):
        for c in range(cols):
            weights, values, of_side = [], [], []
            for i in range(max(r - 3, 0), min(r + 4, rows)):
                for j in range(max(c - 3, 0), min(c + 4, cols)):
                    near = math.exp(-((i - r) ** 2 + (j - c) ** 2) / 4.5)
                    weights.append(near / (1 + ((logs[i, j] - logs[r, c]) / 0.3) ** 2))
                    values.append(ratios[i, j])
                    of_side.append(sides[i, j])
            near = [(1 - abs((v + 0.5) / size[0] * rows - 0.5 - r), 1 - abs((u + 0.5) / size[1] * cols - 0.5 - c), m)
                    for u, v, m in motion]  # fmt: skip
            near = [(a * b, m) for a, b, m in near if a > 0 and b > 0]
            tests = sum(w * m for w, m in near) / sum(w for w, _ in near) if near else 0.0
            passing = 0.12 * math.exp(1.06 * np.average(of_side, weights=weights))
            odds = -1.57 + 1.06 * np.average(values, weights=weights) + math.log(passing + 0.88 * math.exp(tests))
            P.append(max(1 / (1 + math.exp(-odds)) - 0.15, 0) / 0.85)
    return np.array(P)


def local_scale(shape, node, z2, noise, used):
    """Mean z^2 over the used anchors around each node, weighted by a Gaussian of ``NEAR`` of the image, with a prior
    observation z^2 = 1. Cells and certain anchors have equal weights."""
    out, count = np.empty(shape), np.bincount(node, minlength=shape[0] * shape[1])
    for r in range(shape[0]):
        for c in range(shape[1]):
            weights, values = [1.0], [1.0]
            for k, i in enumerate(node):
                if used[k]:
                    far = ((i // shape[1] - r) / shape[0]) ** 2 + ((i % shape[1] - c) / shape[1]) ** 2
                    weights.append(math.exp(-far / NEAR**2 / 2) / (1 + noise[k] / WEAK) / count[i])
                    values.append(z2[k])
            out[r, c] = np.average(values, weights=weights)
    return out.ravel()


def wrong_factor(share, scale):
    """Factor on the probability of another surface; share = distance."""
    return scale ** np.maximum(1 - share / RADIUS, 0)


def y_variance(shape, node, y, noise, used, centre):
    """Variance over the used anchors around each node, weighted by a Gaussian of ``RADIUS`` of the image, with a prior
    observation of variance .25 about ``centre``. Cells and certain anchors have equal weights."""
    out, count = np.empty(shape), np.bincount(node, minlength=shape[0] * shape[1])
    for r in range(shape[0]):
        for c in range(shape[1]):
            weights, values = [1.0], [centre]
            for k, i in enumerate(node):
                if used[k]:
                    far = ((i // shape[1] - r) / shape[0]) ** 2 + ((i % shape[1] - c) / shape[1]) ** 2
                    weights.append(math.exp(-far / RADIUS**2 / 2) / (1 + noise[k] / WEAK) / count[i])
                    values.append(y[k])
            middle = np.average(values, weights=weights)
            out[r, c] = (np.average((np.array(values) - middle) ** 2, weights=weights)) + 0.25 / sum(weights)
    return out.ravel()


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


def discs(state, logs, Q, mean0, H, y, weight, noise, z2, node, u, v, measured, everywhere):
    held = np.zeros(len(y), bool)
    for k in range(3):
        number = state["frames"] * 3 + k + 1
        cu, cv = (number * 0.7548776662466927) % 1, (number * 0.5698402909980532) % 1
        held |= (u - cu) ** 2 + (v - cv) ** 2 < RADIUS**2
    rest = ~held
    if rest.sum() < 5:
        held[:] = False
    mean, C = condition(mean0, Q, H, y, weight * rest)
    fit, var = H @ mean, np.einsum("ij,jk,ik->i", H, C, H)
    away = distances(logs, set(node[rest]))[node]
    error = y - fit
    believed = np.where(held, 1 / (1 + noise / WEAK), 0.0)
    area = believed / np.maximum(np.bincount(node, believed, minlength=logs.size)[node], 1e-12)
    share, around = away / REACH, y_variance(logs.shape, node, y, noise, rest, mean[0])[node]
    offset = H[:, FEATURES:] @ mean[FEATURES:]
    factor = inlier_factor(state, away)
    scale = local_scale(logs.shape, node, z2, noise, rest)[node]
    inlier_variance = (
        factor * (var + noise + away * ratio(state, "unseen")) + steepness(logs.shape, mean[FEATURES:])[node]
    )
    inlier_variance, more_wrong = scale * inlier_variance, wrong_factor(share, scale)
    beyond = np.array([elsewhere(*each) for each in zip(around, away * ratio(state, "unseen"), strict=True)])
    wide = noise + beyond
    p = np.minimum(ratio(state, "wrong") * more_wrong, 0.5)
    final = [second_moment(*each) for each in zip(p, inlier_variance, offset, beyond, strict=True)]
    scores = []
    for i in np.nonzero(held)[0]:
        steep, unseen = steepness(logs.shape, mean[FEATURES:])[node[i]], away[i] * ratio(state, "unseen")
        at_pixel = at_pixels(factor[i], var[i], ratio(state, "roughness"), unseen, steep)
        at_pixel = scale[i] * (at_pixel + measured[i])
        total, alone = (second_moment(q, at_pixel, offset[i], beyond[i] + measured[i]) for q in (p[i], 0.0))
        mixture = [(1 - p[i], 1.0, alone), (p[i], 1.0, max((total - (1 - p[i]) * alone) / p[i], alone))]
        scores.append(abs(interval.standard(mixture, math.exp(error[i]))))
    inlier, outlier = (1 - p) * normal(error, inlier_variance), p * normal(error + offset, wide)
    inlier, outlier = inlier / (inlier + outlier), outlier / (inlier + outlier)
    return pairs(state, logs, held, node, error, var, away, noise) | {
        "wrong": ((area * outlier).sum(), (area * more_wrong).sum()),
        "inlier": ((area * inlier * factor * error**2 / inlier_variance).sum(), (area * inlier).sum()),
        "calibration": ((area * error**2 / final).sum(), area.sum()),
        "scores": (scores, interval.weights(away[held], area[held], everywhere)),
    }


def normal(x, variance):
    return np.exp(-(x**2) / variance / 2) / np.sqrt(2 * math.pi * variance)


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

"""Motion in the posterior's oracle: implausible anchors, the constant of most surfaces, probabilities at nodes."""

from __future__ import annotations

import math

import numpy as np
from oracle_field import MEMORY, PRIOR, START, ratio


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

"""The field of the posterior's oracle: nodes, links, prior, and what is learnt of a stream."""

from __future__ import annotations

import heapq

import numpy as np

SIDE, FEATURES, REACH = 28, 4, 1.0
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

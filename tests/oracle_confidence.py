"""The confidence of ``ufmstar_torch/anchors/confidence.py`` as NumPy loops: one stream, float64."""

from __future__ import annotations

import numpy as np

N, EACH, BINS, PRIOR, LEAST, LARGEST, MEMORY = 1024, 64, 16, 16.0, 0.1, 25.0, 0.5 ** (1 / 20)


def start():
    return {"anchors": [], "gains": []}


def pooled(mean, weight):
    """Pool adjacent violators."""
    blocks = []
    for m, w in zip(mean, weight, strict=True):
        blocks.append([m, w, 1])
        while len(blocks) > 1 and blocks[-2][0] > blocks[-1][0]:
            (m1, w1, n1), (m2, w2, n2) = blocks.pop(-2), blocks.pop()
            blocks.append([(m1 * w1 + m2 * w2) / (w1 + w2), w1 + w2, n1 + n2])
    return np.array([m for m, _, n in blocks for _ in range(n)])


def factor_map(state):
    """The factor as a function of c, and the constant factor without c."""
    anchors = state["anchors"]
    ordered = sorted(c for c, _, _ in anchors)
    edges = [ordered[k * len(ordered) // BINS] for k in range(1, BINS)] if anchors else [np.inf] * (BINS - 1)

    def bin_of(c):
        return sum(c >= edge for edge in edges)

    w, wy = np.zeros(BINS), np.zeros(BINS)
    for c, y, weight in anchors:
        w[bin_of(c)] += weight
        wy[bin_of(c)] += weight * y
    weight, mean = w + PRIOR, (wy + PRIOR) / (w + PRIOR)
    rising, falling = pooled(mean, weight), pooled(mean[::-1], weight[::-1])[::-1]
    fitted = min(rising, falling, key=lambda h: (weight * (mean - h) ** 2).sum())
    h = np.clip(fitted, LEAST, LARGEST)
    one = np.clip((wy.sum() + PRIOR) / (w.sum() + PRIOR), LEAST, LARGEST)
    return (lambda c: 1.0 if np.isnan(c) else h[bin_of(c)]), one


def gain(state):
    """The lower of the two gains less their standard errors [nat]."""
    frames = len(state["gains"])
    if frames < 5:
        return -np.inf
    fade = MEMORY ** np.arange(frames)[::-1]
    n = fade.sum()
    if n < 5 * (1 - 1e-3):
        return -np.inf
    lower = []
    for g in np.array(state["gains"]).T:
        mean = (fade * g).sum() / n
        lower.append(mean - np.sqrt(max((fade * g**2).sum() / n - mean**2, 0) / n))
    return min(lower) - 1e-3


def update(state, confidence, variance, at, predicted, g, s2):
    """State and V' [H, W] after a frame with anchors. ``at``: their pixels in the flattened image."""
    h, one = factor_map(state)
    new = []
    for i, d, z, s in zip(at, predicted, g, s2, strict=True):
        c, V = confidence.flat[i], variance.flat[i]
        if not np.isnan(c):
            new.append((c, min((z - d) ** 2 / (V + s), LARGEST), (V / (V + s)) ** 2))
    if len(state["anchors"]) >= 4 * BINS and new:
        likelihood = [[-0.5 * (y / f + np.log(f)) for f in (h(c), 1.0, one)] for c, y, _ in new]
        mean = np.average(likelihood, axis=0, weights=[w for _, _, w in new])
        state["gains"].append((mean[0] - mean[1], mean[0] - mean[2]))
    stride = max(1, -(-len(new) // EACH))
    state["anchors"] = (state["anchors"] + new[::stride])[-N:]
    h, _ = factor_map(state)
    used = gain(state) > 0
    factor = np.array([h(c) if used else 1.0 for c in confidence.flat]).reshape(confidence.shape)
    return state, factor * variance

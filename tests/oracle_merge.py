"""Merging in NumPy float64 loops, from the derivation in ufmstar_torch/steps/merge.py. It imports neither
torch nor the package.

Components are dicts as in ``oracle`` with one more entry, "sums": the sums over anchors.
"""

from __future__ import annotations

import numpy as np


def joint(g, h):
    """The component with the joint moments of two components."""
    weight = g["weight"] + h["weight"]
    a, b = g["weight"] / weight, h["weight"] / weight
    d = g["mean"] - h["mean"]
    return {
        "mean": a * g["mean"] + b * h["mean"],
        "cov": a * g["cov"] + b * h["cov"] + a * b * np.outer(d, d),
        "weight": weight,
        "m": (g["compared"] * g["m"] + h["compared"] * h["m"]) / max(g["compared"] + h["compared"], 1e-300),
        "compared": g["compared"] + h["compared"],
        "views": g["views"] + h["views"],
        "reference": (g if a >= b else h)["reference"],
        "features": a * g["features"] + b * h["features"],
        "sums": g["sums"] + h["sums"],
    }


def loss(g, h):
    """Bound on the divergence per pixel of the lighter component [nat]; infinite for a pair that must not join."""
    lighter, heavier = (g, h) if g["weight"] < h["weight"] else (h, g)
    if lighter["views"] > 0 and heavier["views"] == 0:
        return np.inf
    weight = g["weight"] + h["weight"]
    volume = [np.linalg.slogdet(x["cov"])[1] for x in (joint(g, h), g, h)]
    whole = 0.5 * (weight * volume[0] - g["weight"] * volume[1] - h["weight"] * volume[2])
    return whole / lighter["weight"]


def join(components, limit):
    """Repeatedly join the pairs that are each other's best candidate."""
    while True:
        n = len(components)
        table = np.array(
            [[np.inf if i == j else loss(components[i], components[j]) for j in range(n)] for i in range(n)]
        ).reshape(n, n)
        best = [int(np.argmin(row)) for row in table]
        pairs = [(i, best[i]) for i in range(n) if i < best[i] and best[best[i]] == i and table[i, best[i]] <= limit]
        if not pairs:
            return components
        gone = {j for _, j in pairs}
        stays = dict(pairs)
        components = [
            joint(g, components[stays[i]]) if i in stays else g for i, g in enumerate(components) if i not in gone
        ]


def points(g):
    L = np.linalg.cholesky(g["cov"])
    return [g["mean"] + sign * np.sqrt(3) * L[:, i] for sign in (1, -1) for i in range(3)]


def density(x, g):
    d = x - g["mean"]
    return np.exp(-d @ np.linalg.solve(g["cov"], d) / 2) / np.sqrt((2 * np.pi) ** 3 * np.linalg.det(g["cov"]))


def mean_shares(g, components, prior_weight):
    """Mean share of every component in explaining the points of g."""
    table = []
    for x in points(g):
        each = np.array([h["weight"] * density(x, h) for h in components])
        table.append(each / (each.sum() + prior_weight))
    return np.mean(table, axis=0)


def dissolve(components, least, prior_weight):
    """Dissolve components whose share at their own points is below ``least`` and whose neighbours explain the rest."""
    table = [mean_shares(g, components, prior_weight) for g in components]
    weak = [row[k] < least for k, row in enumerate(table)]
    after = [dict(g) for g in components]
    retained = []
    for k, g in enumerate(components):
        shares = np.where(weak, 0.0, table[k])
        if not weak[k] or shares.sum() < 1 - least:
            retained.append(k)
            continue
        for h, share in zip(after, shares / shares.sum(), strict=True):
            for weight, name in (("weight", "features"), ("compared", "m")):
                total = h[weight] + share * g[weight]
                if total > 0:
                    h[name] = (h[weight] * h[name] + share * g[weight] * g[name]) / total
                h[weight] = total
            h["sums"] = h["sums"] + share * g["sums"]
    return [after[k] for k in retained]


def merge(components, limit, least, prior_weight):
    return dissolve(join(components, limit), least, prior_weight)

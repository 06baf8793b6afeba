"""The terms of anchors in UfM*, in NumPy float64 loops from docs/anchors.md; imports neither torch nor the package."""

from __future__ import annotations

import numpy as np

import oracle

NEIGHBOURS, SUPPORT, SIGMAS, QUARTILE, LEAST, CLAIM = 8, 3, 2.5, 0.4506, 0.02, 4.0


def believed(anchors):
    """Mark each (u, v, depth, variance, predicted) that is supported by enough of its nearest neighbours in the
    image."""
    if len(anchors) <= SUPPORT:
        return [True] * len(anchors)
    ratio = [np.log(g / d) for _, _, g, _, d in anchors]
    noise = [s2 / g**2 for _, _, g, s2, _ in anchors]
    requested = []
    for i, (u, v, *_) in enumerate(anchors):
        others = [j for j in range(len(anchors)) if j != i]
        others.sort(key=lambda j: ((anchors[j][0] - u) ** 2 + (anchors[j][1] - v) ** 2, j))
        requested.append(others[:NEIGHBOURS])
    sigma = np.quantile([abs(ratio[i] - ratio[j]) for i, near in enumerate(requested) for j in near], 0.25) / QUARTILE
    result = []
    for i, near in enumerate(requested):
        limits = [SIGMAS * np.sqrt(sigma**2 + 2 * LEAST**2 + noise[i] + noise[j]) for j in near]
        agree = sum(abs(ratio[i] - ratio[j]) <= limit for j, limit in zip(near, limits, strict=True))
        result.append(agree >= SUPPORT)
    return result


def weight(claim, others):
    """Weight of an anchor whose relative variance is ``claim``; its neighbours have the errors ``others``."""
    limit = min(CLAIM, len(others)) * max(LEAST**2, np.mean(np.square(others))) if others else 1.0
    return min(1.0, limit / claim) ** 2 if claim > 0 else 1.0


class AnchoredOracle(oracle.Oracle):
    """UfM* with the sums of (1, r, e) per component and per stream."""

    def __init__(self, spgf, *, kappa, half_life, **settings):
        super().__init__(spgf, **settings)
        self.kappa, self.memory = kappa, 0.5 ** (1 / half_life)
        self.sums, self.total = [], np.zeros(3)

    def step_anchored(self, depth, T_world_cam, K, anchors, aleatoric=None):
        """V, B and the expected r [H, W]; anchors are (u, v, depth, variance)."""
        network_variance = np.zeros_like(depth) if aleatoric is None else aleatoric
        V, M = self.step(depth, T_world_cam, K, aleatoric)
        self.sums += [np.zeros(3) for _ in range(len(self.mixture) - len(self.sums))]
        self._learn(depth, network_variance, K, anchors)
        stream = self.total[1:] / (self.total[0] + self.kappa)
        values = [(row[1:] + self.kappa * stream) / (row[0] + self.kappa) for row in self.sums]
        B, bias, at = np.full(depth.shape, np.nan), np.full(depth.shape, np.nan), np.isfinite(M)
        bias[at], e = oracle.regress(oracle.points_of(depth, at, K), self.mixture_cam, values, stream, **self.prior).T
        B[at] = np.maximum(0.0, depth[at] ** 2 * e - M[at])
        return V + B, B, bias

    def _learn(self, depth, network_variance, K, anchors):
        full = [(u, v, g, s2, depth[round(v), round(u)]) for u, v, g, s2 in anchors]
        used = [anchor for anchor, fine in zip(full, believed(full), strict=True) if fine]
        errors = [(g - d) / d for *_, g, _, d in used]
        claims = [(s2 + network_variance[round(v), round(u)]) / d**2 for u, v, _, s2, d in used]
        weights = [weight(claim, errors[:i] + errors[i + 1 :]) for i, claim in enumerate(claims)]
        if any(w >= 0.5 for w in weights):
            self.sums = [self.memory * row for row in self.sums]
            self.total = self.memory * self.total
        for (u, v, *_), r, claim, own_weight in zip(used, errors, claims, weights, strict=True):
            row = own_weight * np.array([1.0, r, r**2 - claim])
            self.total = self.total + row
            at = np.zeros(depth.shape, dtype=bool)
            at[round(v), round(u)] = True
            p = oracle.evidence(oracle.points_of(depth, at, K), self.mixture_cam)[:, 0]
            for k, w in enumerate(p / (p.sum() + self.prior["prior_weight"])):
                self.sums[k] = self.sums[k] + w * row

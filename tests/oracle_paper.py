"""Steps 3 to 5 of UfM* in NumPy float64, literally from the paper's equations: no variance of a pixel, no floor of a
covariance, no near plane. The segmentation is ``oracle_spgf``'s, with the paper's pruning and the raw moments.

Imports neither torch nor the package. A component is a dict with mean, cov, weight and m, in the camera's frame of the
latest image, as in the paper.
"""

from __future__ import annotations

import numpy as np
import oracle_spgf

ETA, ETA_OCCL = 0.5, 0.7
NEAR, FAR = 0.1, 0.5  # [m] of the search in the R-tree
BOX = 2.0  # standard deviations of the boxes in the R-tree: the paper states none
PRIOR_WEIGHT, PRIOR_MEAN = 1.0, 0.0
ALPHA = 0.5


def root(S):
    """The square root of a symmetric positive semidefinite matrix."""
    values, vectors = np.linalg.eigh(S)
    return vectors @ np.diag(np.sqrt(np.maximum(values, 0))) @ vectors.T


def projected(g, K):
    """Mean and covariance in the image plane [px], or None without a candidate's mean inside the image."""
    x, y, z = g["mean"]
    A = np.array([[K[0, 0] / z, 0, -K[0, 0] * x / z**2], [0, K[1, 1] / z, -K[1, 1] * y / z**2]])
    return np.array([K[0, 0] * x / z + K[0, 2], K[1, 1] * y / z + K[1, 2]]), A @ g["cov"] @ A.T


def candidate(g, K, size):
    """The projection of a Gaussian in front of the camera whose projected mean lies inside the image, or None."""
    if g["mean"][2] <= 0:
        return None
    mean, cov = projected(g, K)
    inside = (mean >= -0.5).all() and mean[0] < size[1] - 0.5 and mean[1] < size[0] - 0.5
    return (mean, cov) if inside else None


def beta(a, b):
    """The Bhattacharyya coefficient of two Gaussians in the image plane."""
    S, d = (a[1] + b[1]) / 2, a[0] - b[0]
    determinants = np.linalg.det(S) / np.sqrt(np.linalg.det(a[1]) * np.linalg.det(b[1]))
    return np.exp(-d @ np.linalg.inv(S) @ d / 8 - np.log(determinants) / 2)


def correspondences(mixture, current, K, size):
    """For every c, the k that match: overlap at least ETA, and not hidden by a nearer one of them."""
    images = [candidate(g, K, size) for g in mixture]
    found = []
    for c in current:
        mine = candidate(c, K, size)
        near = [] if mine is None else [k for k, image in enumerate(images) if image is not None]
        F = [k for k in near if beta(mine, images[k]) >= ETA]
        hidden = {
            far for far in F for near in F
            if mixture[far]["mean"][2] > mixture[near]["mean"][2] and beta(images[far], images[near]) > ETA_OCCL
        }  # fmt: skip
        found.append([k for k in F if k not in hidden])
    return found


def fused(mixture, current, matches):
    """M_i: one barycentre of two Gaussians at a time, and a running average of W_2^2."""
    mixture = [dict(g) for g in mixture]
    for c, ks in zip(current, matches, strict=True):
        for k in ks:
            g = mixture[k]
            lam = c["weight"] / (g["weight"] + c["weight"])
            half = root(g["cov"])
            Q = half @ c["cov"] @ half
            W = np.sum((c["mean"] - g["mean"]) ** 2) + np.trace(g["cov"] + c["cov"] - 2 * root(Q))
            inverse = np.linalg.inv(half)
            T = (1 - lam) * np.eye(3) + lam * inverse @ root(Q) @ inverse
            g["mean"] = (1 - lam) * g["mean"] + lam * c["mean"]
            g["cov"] = T @ g["cov"] @ T.T
            g["m"] = (1 - lam) * g["m"] + lam * W
            g["weight"] = g["weight"] + c["weight"]
    return mixture + [dict(c) for c, ks in zip(current, matches, strict=True) if not ks]


def regressed(mixture, depth, valid, K):
    """m_hat at every valid pixel, NaN elsewhere: over the Gaussians within NEAR, or FAR where there are none."""
    v, u = np.nonzero(valid)
    d = depth[valid]
    x = np.stack([(u - K[0, 2]) / K[0, 0] * d, (v - K[1, 2]) / K[1, 1] * d, d], -1)
    density, gap = np.zeros((len(mixture), len(d))), np.full((len(mixture), len(d)), np.inf)
    for k, g in enumerate(mixture):
        from_mean = x - g["mean"]
        exponent = -np.einsum("pi,ij,pj->p", from_mean, np.linalg.inv(g["cov"]), from_mean) / 2
        density[k] = g["weight"] * np.exp(exponent) / np.sqrt((2 * np.pi) ** 3 * np.linalg.det(g["cov"]))
        gap[k] = (np.abs(from_mean) - BOX * np.sqrt(np.diag(g["cov"]))).max(1)
    near = gap <= NEAR
    used = np.where(near.any(0), near, gap <= FAR) * density
    m = np.array([g["m"] for g in mixture])
    out = np.full(depth.shape, np.nan)
    out[valid] = (m @ used + PRIOR_WEIGHT * PRIOR_MEAN) / (used.sum(0) + PRIOR_WEIGHT)
    return out


class PaperOracle:
    """UfM* of one stream; ``settings`` of ``oracle_spgf`` and the thresholds of pruning at the image's resolution."""

    def __init__(self, settings, min_pixels, min_rows):
        self.settings, self.min_pixels, self.min_rows = settings, min_pixels, min_rows
        self.mixture, self.T_before, self.smoothed = [], None, None

    def segmented(self, depth, K):
        """C_i: SPGF without the Gaussians of fewer pixels or rows than the thresholds."""
        camera = oracle_spgf.Camera(K[0, 0], K[1, 1], K[0, 2], K[1, 2])
        pieces, _ = oracle_spgf.segment(depth, camera, self.settings)
        large = [piece for piece in pieces if self.min_pixels <= piece.N and piece.n >= self.min_rows]
        return [{"mean": p.mu, "cov": p.covariance, "weight": float(p.N), "m": 0.0} for p in large]

    def step(self, depth, T_world_cam, K):
        """M of an image, NaN where there is no depth."""
        current = self.segmented(depth, K)
        if self.T_before is not None:
            relative = np.linalg.inv(T_world_cam) @ self.T_before
            R, T = relative[:3, :3], relative[:3, 3]
            self.mixture = [{**g, "mean": R @ g["mean"] + T, "cov": R @ g["cov"] @ R.T} for g in self.mixture]
        self.T_before = T_world_cam
        matches = correspondences(self.mixture, current, K, depth.shape)
        self.mixture = fused(self.mixture, current, matches)
        M = regressed(self.mixture, depth, np.isfinite(depth) & (depth > 0), K)
        if self.smoothed is not None:
            average = (1 - ALPHA) * self.smoothed + ALPHA * M
            M = np.where(np.isnan(self.smoothed), M, np.where(np.isnan(M), self.smoothed, average))
        self.smoothed = M
        return M

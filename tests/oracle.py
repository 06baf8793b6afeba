"""UfM* steps 2 to 6 in NumPy float64 loops, straight from the paper; slow, plain, and independent.

Imports neither torch nor the package. Component lists are plain Python lists of dicts with keys mean, cov, weight, m,
features, and of the views compared: compared, views and reference (the camera's centre, the network's
index, and the largest change since). The mixture is kept in the first camera's frame.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import oracle_spgf

PIXEL_VARIANCE = 1.0 / 12.0


def sqrtm(S):
    values, vectors = np.linalg.eigh((S + S.T) / 2)
    return vectors @ np.diag(np.sqrt(np.maximum(values, 0))) @ vectors.T


def w2_squared(mean_a, cov_a, mean_b, cov_b):
    root = sqrtm(cov_a)
    Q = root @ cov_b @ root
    return float(np.sum((mean_b - mean_a) ** 2) + max(0.0, np.trace(cov_a + cov_b - 2 * sqrtm(Q))))


def geodesic(mean_k, cov_k, mean_c, cov_c, lam):
    root = sqrtm(cov_k)
    inverse = np.linalg.inv(root)
    Z = inverse @ sqrtm(root @ cov_c @ root) @ inverse
    T = (1 - lam) * np.eye(3) + lam * Z
    return (1 - lam) * mean_k + lam * mean_c, T @ cov_k @ T.T


def bhattacharyya(mean_a, cov_a, mean_b, cov_b):
    S = (cov_a + cov_b) / 2
    d = mean_a - mean_b
    log_ratio = np.log(np.linalg.det(S) / np.sqrt(np.linalg.det(cov_a) * np.linalg.det(cov_b)))
    return float(np.exp(-d @ np.linalg.solve(S, d) / 8 - log_ratio / 2))


def project(mean, cov, K, pixel_variance=PIXEL_VARIANCE):
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    x, y, z = mean
    A = np.array([[fx / z, 0, -fx * x / z**2], [0, fy / z, -fy * y / z**2]])
    return np.array([fx * x / z + cx, fy * y / z + cy]), A @ cov @ A.T + pixel_variance * np.eye(2)


def floor_eigenvalues(cov, floor):
    values, vectors = np.linalg.eigh(cov)
    if values[0] >= floor:
        return cov
    return vectors @ np.diag(np.maximum(values, floor)) @ vectors.T


def transform(component, R, t):
    return {**component, "mean": R @ component["mean"] + t, "cov": R @ component["cov"] @ R.T}


def relative(T_world_a, T_world_b):
    """Rotation and translation from camera a into camera b."""
    T = np.linalg.inv(T_world_b) @ T_world_a
    return T[:3, :3], T[:3, 3]


@dataclass(frozen=True)
class Segmentation:
    """SPGF's thresholds for the image as it is, and the pruning rule."""

    settings: oracle_spgf.Settings
    min_pixels: int
    min_rows: int
    prune: str  # "both": drop if both are small, "either": drop if one is, "none"

    def keeps(self, piece):
        few_pixels, few_rows = self.min_pixels > piece.N, piece.n < self.min_rows
        drops = {"both": few_pixels and few_rows, "either": few_pixels or few_rows, "none": False}
        return not drops[self.prune]


def segment(depth, K, segmentation, *, valid=None, features=None, near=0.05, pixel_variance=PIXEL_VARIANCE):
    """C_i. The covariance floor is the footprint of a pixel, at no less than the near plane's depth.

    features [F, H, W] are averaged over the pixels of a component.
    """
    camera = oracle_spgf.Camera(K[0, 0], K[1, 1], K[0, 2], K[1, 2])
    pieces, _ = oracle_spgf.segment(depth, camera, segmentation.settings, valid=valid)
    components = []
    for piece in pieces:
        if not segmentation.keeps(piece):
            continue
        rows, columns = np.array(piece.pixels).T
        floor = (max(piece.mu[2], near) / min(K[0, 0], K[1, 1])) ** 2 * pixel_variance
        components.append({
            "mean": piece.mu,
            "cov": floor_eigenvalues(piece.covariance, floor),
            "weight": float(piece.N),
            "m": 0.0,
            "features": np.zeros(0) if features is None else features[:, rows, columns].mean(1),
        })  # fmt: skip
    return components


def candidate(component_cam, K, size, near, pixel_variance):
    if component_cam["mean"][2] <= near:
        return None
    mean, cov = project(component_cam["mean"], component_cam["cov"], K, pixel_variance)
    inside = -0.5 <= mean[0] < size[1] - 0.5 and -0.5 <= mean[1] < size[0] - 0.5
    return (mean, cov) if inside else None


def correspond(previous_cam, current_cam, K, size, eta, eta_occl, near, pixel_variance=PIXEL_VARIANCE):
    """For every c the list of matched k, and the overlaps."""
    projected = [candidate(k, K, size, near, pixel_variance) for k in previous_cam]
    matches, overlaps = [], {}
    for c, component in enumerate(current_cam):
        gaussian = candidate(component, K, size, near, pixel_variance)
        result = []
        for k, other in enumerate(projected):
            if gaussian is None or other is None:
                continue
            overlaps[c, k] = bhattacharyya(*other, *gaussian)
            if overlaps[c, k] >= eta:
                result.append(k)
        visible = []
        for k in result:
            hidden = False
            for other in result:
                nearer = previous_cam[other]["mean"][2] < previous_cam[k]["mean"][2]
                if nearer and bhattacharyya(*projected[other], *projected[k]) > eta_occl:
                    hidden = True
            if not hidden:
                visible.append(k)
        matches.append(visible)
    return matches, overlaps


def view_weight(component, view, baseline, near):
    """Weight of a comparison: 1 if another network predicted (or baseline is None, the paper), else the increase of
    1 - exp(-(b/b0)^2), with the baseline b over the distance, beyond its largest value since the reference view;
    0 if that is below .01."""
    if baseline is None or component["reference"][3] != view[3]:
        return 1.0
    distance = max(np.linalg.norm(component["mean"] - view[:3]), near)
    change = 1 - np.exp(-((np.linalg.norm(view[:3] - component["reference"][:3]) / distance / baseline) ** 2))
    increase = change - component["reference"][4]
    return increase if increase >= 0.01 else 0.0


def fuse(mixture, current, matches, overlaps, view, *, baseline=0.07, near=0.05, overlap_weighted=False,
         remembered=None):  # fmt: skip
    """M_i from M_(i-1) and C_i, both in the first camera's frame; returns a new list. view: centre of the camera there,
    and index of the network."""
    fused = [dict(k) for k in mixture]
    counts = [view_weight(g, view, baseline, near) for g in mixture]
    for k in {k for ks in matches for k in ks}:
        if counts[k] > 0:
            fused[k]["views"] += counts[k]
            change = fused[k]["reference"][4] + counts[k]
            reference = fused[k]["reference"][:4]
            fused[k]["reference"] = np.append(view, 0.0) if change >= 0.9 else np.append(reference, change)
    for c, ks in enumerate(matches):  # increasing c for every k
        for k in ks:
            if counts[k] == 0:
                continue
            g, new = fused[k], current[c]
            pi_c = new["weight"] * (overlaps[c, k] if overlap_weighted else 1.0)
            lam = pi_c / (g["weight"] + pi_c)
            distance = w2_squared(g["mean"], g["cov"], new["mean"], new["cov"])
            g["mean"], g["cov"] = geodesic(g["mean"], g["cov"], new["mean"], new["cov"], lam)
            g["m"] = (g["compared"] * g["m"] + counts[k] * pi_c * distance) / (g["compared"] + counts[k] * pi_c)
            g["compared"] += counts[k] * pi_c
            g["features"] = (1 - lam) * g["features"] + lam * new["features"]
            g["weight"] += pi_c
    for c, ks in enumerate(matches):
        if not ks and (remembered is None or remembered[c]):
            first = 0.0 if baseline is not None else current[c]["weight"]
            fused.append({**current[c], "m": 0.0, "compared": first, "views": 0.0, "reference": np.append(view, 0.0)})
    return fused


def evidence(points, mixture, neighbourhood=None):
    """p_k(x) [K, P], the weight times the density of every component at points [P, 3]. With a neighbourhood (sigmas,
    near, far), 0 for components whose box is farther than near, or than far where no box is as near."""
    p, gap = np.zeros((2, len(mixture), len(points)))
    for k, g in enumerate(mixture):
        d = points - g["mean"]
        exponent = -((d @ np.linalg.inv(g["cov"])) * d).sum(1) / 2
        p[k] = g["weight"] * np.exp(exponent) / np.sqrt((2 * np.pi) ** 3 * np.linalg.det(g["cov"]))
        if neighbourhood is not None:
            gap[k] = (np.abs(d) - neighbourhood[0] * np.sqrt(np.diag(g["cov"]))).max(1)
    if neighbourhood is None:
        return p
    near, far = (gap <= radius for radius in neighbourhood[1:])
    return np.where(np.where(near.any(0), near, far), p, 0.0)


def regress(points, mixture, values, prior, *, prior_weight, neighbourhood=None):
    """(sum_k p_k h_k + pi_0 h_0) / (sum_k p_k + pi_0) at points [P, 3], for values h_k [K, C] and the prior's h_0."""
    p = evidence(points, mixture, neighbourhood)
    return (p.T @ np.reshape(values, (len(p), -1)) + prior_weight * prior) / (p.sum(0) + prior_weight)[:, None]


def points_of(depth, at, K):
    """Points [P, 3] in the camera's frame of the pixels where the mask ``at`` is set."""
    (v, u), d = np.nonzero(at), depth[at]
    return np.stack([(u - K[0, 2]) / K[0, 0] * d, (v - K[1, 2]) / K[1, 1] * d, d], -1)


def regressed_map(mixture_cam, depth, valid, K, values, prior, **settings):
    """:func:`regress` of one value at every valid pixel of a depth map, NaN elsewhere."""
    out = np.full(depth.shape, np.nan)
    out[valid] = regress(points_of(depth, valid, K), mixture_cam, values, prior, **settings)[:, 0]
    return out


def aleatoric_in_h(mixture_cam, depth, valid, K, aleatoric, *, prior_weight):
    """The aleatoric variance at every valid pixel, regressed from the first feature; the pixel's variance A has the
    prior's weight: (sum_k p_k a_k + pi_0 A) / (sum_k p_k + pi_0), exact sum."""
    values, prior = [g["features"][0] for g in mixture_cam], aleatoric[valid][:, None]
    return regressed_map(mixture_cam, depth, valid, K, values, prior, prior_weight=prior_weight)


class Oracle:
    """The whole algorithm for one stream. The paper's equations have no near plane, no variance of a pixel and no floor
    of a covariance: near = pixel_variance = 0."""

    def __init__(self, spgf, *, eta=0.5, eta_occl=0.7, near=0.05, prior_weight=1.0, prior_mean=0.0,
                 alpha=0.5, overlap_weighted=False, neighbourhood=None,
                 unmeasured="paper", unmeasured_relative=0.1, baseline=0.07,
                 pixel_variance=PIXEL_VARIANCE):  # fmt: skip
        self.baseline, self.pixel_variance = baseline, pixel_variance
        self.unmeasured, self.unmeasured_relative = unmeasured, unmeasured_relative
        self.spgf, self.eta, self.eta_occl, self.near = spgf, eta, eta_occl, near
        self.prior_mean = prior_mean
        self.prior = {"prior_weight": prior_weight, "neighbourhood": neighbourhood}
        self.alpha, self.overlap_weighted = alpha, overlap_weighted
        self.mixture, self.T_first, self.smoothed = [], None, None
        self.matches = []

    def share(self):
        """Share to which every valid pixel of the last frame is measured, sum of w_k (1 - exp(-n_k)); NaN elsewhere."""
        values = [1 - np.exp(-g["views"]) for g in self.mixture_cam]
        return self.informative * regressed_map(*self.seen, values, 0.0, **self.prior)

    def step(self, depth, T_world_cam, K, aleatoric=None, epistemic=None, features=None, member=0, informative=True):
        self.informative = float(informative)
        valid = np.isfinite(depth) & (depth > 0) & (depth <= self.spgf.settings.max_depth)
        if self.T_first is None:
            self.T_first = T_world_cam
        shown = valid & informative
        current = segment(
            np.where(shown, depth, 0.0), K, self.spgf, valid=shown, features=features,
            pixel_variance=self.pixel_variance,
        )  # fmt: skip
        to_cam = relative(self.T_first, T_world_cam)
        to_first = relative(T_world_cam, self.T_first)
        previous_cam = [transform(g, *to_cam) for g in self.mixture]
        limits = self.eta, self.eta_occl, self.near, self.pixel_variance
        self.matches, overlaps = correspond(previous_cam, current, K, depth.shape, *limits)
        current_first = [transform(g, *to_first) for g in current]
        self.mixture = fuse(
            self.mixture,
            current_first,
            self.matches,
            overlaps,
            np.append(to_first[1], member),
            baseline=self.baseline,
            near=self.near,
            overlap_weighted=self.overlap_weighted,
            remembered=[g["mean"][2] > self.near for g in current],
        )
        mixture_cam = self.mixture_cam = [transform(g, *to_cam) for g in self.mixture]
        self.seen = mixture_cam, depth, valid, K
        M = regressed_map(*self.seen, [g["m"] for g in mixture_cam], self.prior_mean, **self.prior)
        if self.unmeasured == "relative":
            M = M + (1 - self.share()) * (self.unmeasured_relative * depth) ** 2
        if self.unmeasured == "nan":
            M = np.where(self.share() < 0.5, np.nan, M)
        measured = ~np.isnan(M)
        if self.smoothed is not None:
            both = (1 - self.alpha) * self.smoothed + self.alpha * M
            M = np.where(np.isnan(M), self.smoothed, np.where(np.isnan(self.smoothed), M, both))
        self.smoothed = M
        M = np.where(measured, M, np.nan)
        V = M + (0 if aleatoric is None else aleatoric) + (0 if epistemic is None else epistemic)
        return V, M


def barycenter(means, covs, weights, iterations=500):
    """Wasserstein-Bures barycenter by the fixed point of Alvarez-Esteban et al. (2016)."""
    w = np.asarray(weights) / np.sum(weights)
    mean = sum(w_j * m for w_j, m in zip(w, means, strict=True))
    S = sum(w_j * c for w_j, c in zip(w, covs, strict=True))
    for _ in range(iterations):
        root = sqrtm(S)
        inverse = np.linalg.inv(root)
        inner = sum(w_j * sqrtm(root @ c @ root) for w_j, c in zip(w, covs, strict=True))
        S = inverse @ inner @ inner @ inverse
    return mean, S

"""Merging on the CPU (numba): pairs and points that are too far apart to count are left out, which changes nothing."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from ufmstar_torch.config import UfMStarConfig
from ufmstar_torch.kernels.compile_cpu import empty, kernel, part
from ufmstar_torch.kernels.fuse_cpu import cholesky3
from ufmstar_torch.kernels.regress_cull_cpu import HALF_LOG_TWO_PI_CUBED
from ufmstar_torch.mixture import GaussianMixture

# A component's density at a point is left out below this share of the point's own density: K of them change a share
# by less than K times this.
_LEAST_SHARE = 1e-15


def partition(mixture: GaussianMixture, limit: float) -> Tensor:
    """As :func:`ufmstar_torch.merge.partition`, for CPU tensors."""
    into = torch.arange(mixture.capacity).repeat(mixture.streams, 1)
    compared = (mixture.count > 1).numpy()
    mean, covariance, weight = _arrays(mixture)
    for b in range(mixture.streams):
        n = int(mixture.components[b])
        into[b, :n] = torch.from_numpy(
            _partition(mean[b, :n], covariance[b, :n], weight[b, :n], compared[b, :n], limit)
        )
    return into


def own_shares(mixture: GaussianMixture, config: UfMStarConfig) -> Tensor:
    """As :func:`ufmstar_torch.merge.own_shares`, for CPU tensors."""
    own = torch.zeros_like(mixture.weight)
    mean, covariance, weight = _arrays(mixture)
    for b in range(mixture.streams):
        occupied = np.flatnonzero(weight[b] > 0)
        result = _own_shares(mean[b][occupied], covariance[b][occupied], weight[b][occupied], config.prior_weight)
        own[b, torch.from_numpy(occupied)] = torch.from_numpy(result)
    return own


def _arrays(mixture: GaussianMixture) -> list[np.ndarray]:
    return [v.detach().double().contiguous().numpy() for v in (mixture.mean, mixture.covariance, mixture.weight)]


@part
def _log_det(S):
    p0 = S[0, 0]
    u, v = S[1, 0] / p0, S[2, 0] / p0
    p1 = S[1, 1] - u * S[1, 0]
    w = S[2, 1] - v * S[1, 0]
    return math.log(p0 * p1 * (S[2, 2] - v * S[2, 0] - w * w / p1))


@part
def _joint(a, b, mean_a, mean_b, cov_a, cov_b, S):
    """Common covariance of two components with the shares a and b."""
    for r in range(3):
        for c in range(3):
            between = (a * b) * (mean_a[r] - mean_b[r]) * (mean_a[c] - mean_b[c])
            S[r, c] = a * cov_a[r, c] + b * cov_b[r, c] + between


@part
def _loss(i, j, mean, covariance, weight, compared, log_det, reach, S):
    """l(i, j) [nat]; infinite where it exceeds every limit of interest, or where the two may not join.

    log|Sigma| >= a log|Sigma_i| + b log|Sigma_j| + log(1 + a b q) with q >= d_x^2 / (a Sigma_i + b Sigma_j)_xx for
    every axis, so l > limit where q > (exp(2 min(a, b) limit) - 1) / (a b), which is at most ``reach``.
    """
    both = weight[i] + weight[j]
    a, b = weight[i] / both, weight[j] / both
    for r in range(3):
        d = mean[i, r] - mean[j, r]
        if d * d > reach * (a * covariance[i, r, r] + b * covariance[j, r, r]):
            return np.inf
    light, heavy = (i, j) if weight[i] < weight[j] else (j, i)
    if compared[light] and not compared[heavy]:
        return np.inf
    _joint(a, b, mean[i], mean[j], covariance[i], covariance[j], S)
    return 0.5 * (_log_det(S) - a * log_det[i] - b * log_det[j]) / min(a, b)


@kernel
def _partition(mean, covariance, weight, compared, limit):
    """The slot that each component joins. Kept is a list of the pairs whose loss is within the limit."""
    n = weight.size
    mean, covariance, weight, compared = mean.copy(), covariance.copy(), weight.copy(), compared.copy()
    into, alive, changed = np.arange(n), np.ones(n, np.bool_), np.ones(n, np.bool_)
    log_det, S = empty(n, np.float64), empty((3, 3), np.float64)
    reach = 4 * math.expm1(limit) * (1 + 1e-9)
    left, right, loss, pairs = empty(n, np.int64), empty(n, np.int64), empty(n, np.float64), 0
    best, partner = empty(n, np.float64), empty(n, np.int64)
    for i in range(n):
        log_det[i] = _log_det(covariance[i])
    while True:
        for i in range(n):
            if not (alive[i] and changed[i]):
                continue
            for j in range(n):
                if j == i or not alive[j] or (changed[j] and j < i):
                    continue
                value = _loss(i, j, mean, covariance, weight, compared, log_det, reach, S)
                if value <= limit:
                    if pairs == loss.size:
                        left, right = np.append(left, np.empty_like(left)), np.append(right, np.empty_like(right))
                        loss = np.append(loss, np.empty_like(loss))
                    left[pairs], right[pairs], loss[pairs] = min(i, j), max(i, j), value
                    pairs += 1
        best[:], partner[:] = np.inf, -1
        for p in range(pairs):
            for i, j in ((left[p], right[p]), (right[p], left[p])):
                if loss[p] < best[i] or (loss[p] == best[i] and j < partner[i]):
                    best[i], partner[i] = loss[p], j
        changed[:] = False
        for i in range(n):
            j = partner[i]
            if j <= i or partner[j] != i:
                continue
            both = weight[i] + weight[j]
            a, b = weight[i] / both, weight[j] / both
            _joint(a, b, mean[i], mean[j], covariance[i], covariance[j], S)
            covariance[i] = S
            mean[i] = a * mean[i] + b * mean[j]
            weight[i], compared[i] = both, compared[i] or compared[j]
            log_det[i] = _log_det(S)
            into[j], alive[j], changed[i], changed[j] = i, False, True, True
        if not changed.any():
            break
        kept = 0
        for p in range(pairs):
            if not (changed[left[p]] or changed[right[p]]):
                left[kept], right[kept], loss[kept] = left[p], right[p], loss[p]
                kept += 1
        pairs = kept
    for i in range(n):  # a component joins a lower slot, whose own way is known by then
        into[i] = into[into[i]]
    return into


@kernel
def _own_shares(mean, covariance, weight, prior_weight):
    """s_k of occupied components."""
    n = weight.size
    L, W, log_peak, half = (
        empty((n, 3, 3), np.float64),
        empty((n, 6), np.float64),
        empty(n, np.float64),
        empty((n, 3), np.float64),
    )
    for k in range(n):
        S = covariance[k]
        cholesky3(S, L[k])
        i00, i11, i22 = 1 / L[k, 0, 0], 1 / L[k, 1, 1], 1 / L[k, 2, 2]
        i10, i21 = -L[k, 1, 0] * i00 * i11, -L[k, 2, 1] * i11 * i22
        W[k, 0], W[k, 1], W[k, 2], W[k, 4], W[k, 5] = i00, i10, i11, i21, i22
        W[k, 3] = -(L[k, 2, 0] * i00 + L[k, 2, 1] * i10) * i22
        log_peak[k] = math.log(weight[k]) - HALF_LOG_TWO_PI_CUBED + math.log(i00) + math.log(i11) + math.log(i22)
        for r in range(3):
            half[k, r] = math.sqrt(3 * S[r, r])
    shares, x, evidence = empty(n, np.float64), empty((6, 3), np.float64), empty(6, np.float64)
    for f in range(n):
        for i in range(3):
            for r in range(3):
                step = math.sqrt(3.0) * L[f, r, i]
                x[i, r], x[3 + i, r] = mean[f, r] + step, mean[f, r] - step
        least = log_peak[f] - 1.5 + math.log(_LEAST_SHARE)  # the own density is peak exp(-3/2) at all six
        evidence[:] = prior_weight
        for k in range(n):
            square = 2 * (log_peak[k] - least)
            if square < 0:
                continue
            outside = False
            for r in range(3):
                gap = abs(mean[f, r] - mean[k, r]) - half[f, r]
                outside |= gap > 0 and gap * gap > square * covariance[k, r, r]
            if outside:
                continue
            for p in range(6):
                dx, dy, dz = x[p, 0] - mean[k, 0], x[p, 1] - mean[k, 1], x[p, 2] - mean[k, 2]
                y0 = W[k, 0] * dx
                y1 = W[k, 1] * dx + W[k, 2] * dy
                y2 = W[k, 3] * dx + W[k, 4] * dy + W[k, 5] * dz
                q = y0 * y0 + y1 * y1 + y2 * y2
                if q <= square:
                    evidence[p] += math.exp(log_peak[k] - 0.5 * q)
        own, mean_share = math.exp(log_peak[f] - 1.5), 0.0
        for p in range(6):
            mean_share += own / evidence[p] / 6
        shares[f] = mean_share
    return shares

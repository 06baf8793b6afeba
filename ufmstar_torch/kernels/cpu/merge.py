"""The parts of merging whose time grows with the square of the number of components, on the CPU (numba)."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from ufmstar_torch.kernels.compile_cpu import empty, kernel, leaf
from ufmstar_torch.kernels.cpu.calls import array

_FIRST_PAIRS = 8  # room for pairs per component, at first


def close_pairs(
    mean: Tensor, covariance: Tensor, weight: Tensor, views: Tensor, log_det: Tensor, fresh: Tensor, limit: float
) -> tuple[Tensor, Tensor]:
    """As :func:`ufmstar_torch.steps.merge.close_pairs`, for CPU tensors."""
    arguments = [array(value) for value in (mean, covariance, weight, views, log_det, fresh)]
    room = _FIRST_PAIRS * len(weight) + 64
    while True:
        pairs, loss = np.empty((2, room), np.int64), np.empty(room)
        count = _close_pairs(*arguments, limit, pairs, loss)
        if count <= room:
            return torch.from_numpy(pairs[:, :count].copy()), torch.from_numpy(loss[:count].copy())
        room = count


def evidence(
    points: Tensor, mean: Tensor, sigma: Tensor, whitening: Tensor, log_peak: Tensor, prior: float, reach: float,
    least: float,
) -> Tensor:  # fmt: skip
    """As :func:`ufmstar_torch.steps.merge.evidence`, for CPU tensors."""
    out = np.full(points.shape[:2], prior)
    arrays = (array(value) for value in (points, mean, sigma, whitening, log_peak))
    _evidence(*arrays, reach, 1.5 - math.log(least), out)
    return torch.from_numpy(out)


@kernel
def _close_pairs(mean, covariance, weight, views, log_det, fresh, limit, pairs, loss):
    """Write the pairs and their losses as far as there is room; returns their number."""
    reach = 4 * math.expm1(limit) * (1 + 1e-9)
    count, n = 0, weight.size
    position, spread, far = empty((3, n), np.float64), empty((3, n), np.float64), empty(n, np.float64)
    for i in range(n):
        for axis in range(3):
            position[axis, i], spread[axis, i] = mean[i, axis], weight[i] * covariance[i, axis, axis]
    for i in range(n):
        if not fresh[i]:
            continue
        far[:] = -np.inf
        for axis in range(3):
            for j in range(n):
                gap = position[axis, i] - position[axis, j]
                excess = gap * gap * (weight[i] + weight[j]) - reach * (spread[axis, i] + spread[axis, j])
                far[j] = max(far[j], excess)
        for j in range(n):
            if not far[j] <= 0 or (fresh[j] and j <= i):  # a pair of two fresh components once
                continue
            first, second = min(i, j), max(i, j)
            a = weight[first] / (weight[first] + weight[second])
            b = weight[second] / (weight[first] + weight[second])
            volume = _joint_log_det(mean, covariance, first, second, a, b) - a * log_det[first] - b * log_det[second]
            value = 0.5 * volume / min(a, b)
            lighter, heavier = (first, second) if weight[first] < weight[second] else (second, first)
            if value <= limit and not (views[lighter] > 0 and views[heavier] == 0):
                if count < loss.size:
                    pairs[0, count], pairs[1, count], loss[count] = first, second, value
                count += 1
    return count


@leaf
def _joint_log_det(mean, covariance, i, j, a, b):
    """log of the determinant of the joint covariance of two components."""
    x, y, z = mean[i, 0] - mean[j, 0], mean[i, 1] - mean[j, 1], mean[i, 2] - mean[j, 2]
    S, T, ab = covariance[i], covariance[j], a * b
    p0 = a * S[0, 0] + b * T[0, 0] + ab * x * x
    s10, s20 = a * S[1, 0] + b * T[1, 0] + ab * y * x, a * S[2, 0] + b * T[2, 0] + ab * z * x
    s11, s21 = a * S[1, 1] + b * T[1, 1] + ab * y * y, a * S[2, 1] + b * T[2, 1] + ab * z * y
    s22 = a * S[2, 2] + b * T[2, 2] + ab * z * z
    u, v = s10 / p0, s20 / p0
    p1 = s11 - u * s10
    w = s21 - v * s10
    return math.log(p0 * p1 * (s22 - v * s20 - w * w / p1))


@kernel
def _evidence(points, mean, sigma, whitening, log_peak, reach, beyond, out):
    """Add the densities that matter at the points [n, P] of each component: those above exp(-``beyond``) of its peak.
    Most exponents are smaller; computing them takes half as long as their exponential."""
    n = mean.shape[0]
    position, variance, far = empty((3, n), np.float64), empty((3, n), np.float64), empty(n, np.float64)
    for axis in range(3):
        for k in range(n):
            position[axis, k], variance[axis, k] = mean[k, axis], sigma[k, axis] * sigma[k, axis]
    for i in range(n):
        far[:] = -np.inf
        for axis in range(3):
            for k in range(n):
                gap = max(abs(position[axis, i] - position[axis, k]) - reach * sigma[i, axis], 0.0)
                radius2 = max(2 * (log_peak[k] - log_peak[i] + beyond), 0.0)
                far[k] = max(far[k], gap * gap - radius2 * variance[axis, k])
        for k in range(n):
            if not far[k] <= 0:
                continue
            for p in range(points.shape[1]):
                x, y, z = points[i, p, 0] - mean[k, 0], points[i, p, 1] - mean[k, 1], points[i, p, 2] - mean[k, 2]
                a = whitening[k, 0, 0] * x
                b = whitening[k, 1, 0] * x + whitening[k, 1, 1] * y
                c = whitening[k, 2, 0] * x + whitening[k, 2, 1] * y + whitening[k, 2, 2] * z
                exponent = log_peak[k] - 0.5 * (a * a + b * b + c * c)
                if exponent >= log_peak[i] - beyond:
                    out[i, p] += math.exp(exponent)

"""Which anchors their neighbours support, on the CPU (numba): neighbours along a sorted axis instead of all pairs."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from ufmstar_torch.anchors.evidence import LEAST_SIGMA, LOWER_QUARTILE, NEIGHBOURS, SIMILAR_SIGMAS, SUPPORT, TIE
from ufmstar_torch.anchors.given import AnchorInput
from ufmstar_torch.kernels.compile_cpu import kernel, part


def inliers(anchors: AnchorInput) -> Tensor:
    """As :func:`ufmstar_torch.anchors.evidence.inliers`, for CPU tensors; the same anchors."""
    n = anchors.valid.shape[1]
    if n <= SUPPORT:
        return anchors.valid
    log_ratio = (anchors.depth / anchors.predicted).log()
    noise = anchors.variance / anchors.depth.square()
    tie = (TIE * torch.arange(n)).double().numpy()
    out = np.empty(anchors.valid.shape, np.bool_)
    given = (value.contiguous().numpy() for value in (anchors.pixel, anchors.valid, log_ratio, noise))
    for pixel, valid, ratio, spread, supported in zip(*given, out, strict=True):
        order = np.argsort(pixel[:, 0])
        order = order[valid[order]]
        _supported(pixel, valid, ratio, spread, tie, order, min(NEIGHBOURS, n - 1), supported)
    return torch.from_numpy(out)


@kernel
def _supported(pixel, valid, ratio, noise, tie, order, most, out):
    """One stream; ``order`` are its valid anchors by u."""
    neighbour = np.empty((order.size, most), np.int64)
    count = np.empty(order.size, np.int64)
    distance = np.empty(most)
    differ, total = np.empty(order.size * most), 0
    for place in range(order.size):
        count[place] = _nearest(pixel, tie, order, place, distance, neighbour[place])
        for i in range(count[place]):
            differ[total] = abs(ratio[order[place]] - ratio[neighbour[place, i]])
            total += 1
    quartile = _lower_quartile(differ[:total])
    sigma2 = (quartile / LOWER_QUARTILE) * (quartile / LOWER_QUARTILE) + 2 * LEAST_SIGMA**2
    for i in range(out.size):
        out[i] = valid[i] and order.size <= SUPPORT
    for place in range(order.size):
        a, support = order[place], 0
        for i in range(count[place]):
            b = neighbour[place, i]
            support += abs(ratio[a] - ratio[b]) <= SIMILAR_SIGMAS * math.sqrt(sigma2 + noise[a] + noise[b])
        out[a] = out[a] or support >= SUPPORT


@part
def _nearest(pixel, tie, order, place, distance, neighbour):
    """The nearest anchors in the image, and how many there are: from the place in the order to both sides, until the
    difference in u alone is farther than the farthest of them."""
    a, n, most = order[place], 0, neighbour.size
    for side in (-1, 1):
        other = place + side
        while 0 <= other < order.size:
            b = order[other]
            du, dv = pixel[a, 0] - pixel[b, 0], pixel[a, 1] - pixel[b, 1]
            if n == most and du * du > distance[n - 1]:
                break
            apart = du * du + dv * dv + tie[b]
            if n < most or apart < distance[n - 1]:
                n = min(n + 1, most)
                i = n - 1
                while i > 0 and distance[i - 1] > apart:
                    distance[i], neighbour[i] = distance[i - 1], neighbour[i - 1]
                    i -= 1
                distance[i], neighbour[i] = apart, b
            other += side
    return n


@part
def _lower_quartile(values):
    """``torch.quantile(values, 0.25)``, 0 of no values."""
    if values.size == 0:
        return 0.0
    rank = 0.25 * (values.size - 1)
    below = int(rank)
    part = np.partition(values, below)
    low, high = part[below], part[below]
    if below + 1 < values.size:
        high = part[below + 1 :].min()
    weight = rank - below
    return low + weight * (high - low) if weight < 0.5 else high - (high - low) * (1 - weight)

"""SPGF on the CPU (numba): the same partitions as :mod:`ufmstar_torch.segment`, in well under a millisecond
at 224 x 224.

One thread per call and no shared state: calls from several Python threads run side by side (the GIL is
released), and no thread pool stands in the way of fork.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from ufmstar_torch.kernels.compile_cpu import kernel
from ufmstar_torch.kernels.segment_image_cpu import segment_image, write_gaussians
from ufmstar_torch.mixture import GaussianMixture
from ufmstar_torch.segment_input import SegmentInput

_PRUNE = {"none": 0, "both": 1, "either": 2}


class _Limits(NamedTuple):
    """The thresholds that do not depend on the camera, as compiled code takes them."""

    noise_floor: float
    noise_thresh: float
    line_thresh: float
    angle2: float
    max_depth: float
    shortest_bin: float
    longest_bin: float
    depth_bins: int
    occlusion_gap: int
    n_check: int
    max_open: int
    sparse: int
    prune: int
    min_pixels: int
    min_rows: int


def segment(given: SegmentInput, *, before_pruning: bool = False) -> tuple[GaussianMixture, Tensor]:
    """As :func:`ufmstar_torch.segment.segment`, for CPU tensors, float64 inside."""
    z = given.depth.contiguous().numpy()
    absent = (z.shape[0], 1, 0)  # rows of no pixels stand for "not given"
    use = np.empty(absent, np.bool_) if given.valid is None else given.valid.contiguous().numpy()
    spread = np.empty(absent, z.dtype) if given.variance is None else _array(given.variance)
    limits = _limits(given, before_pruning)
    labels = np.empty(z.shape, np.int64)
    result = []
    for b, K in enumerate(given.intrinsics.tolist()):
        fx, fy, cx, cy = K[0][0], K[1][1], K[0][2], K[1][2]
        slope = given.config.slope(min(fx, fy))
        bins = _depth_bins(0.5 * min(z.shape[2] / fx, z.shape[1] / fy), limits)
        result.append(segment_image(z[b], use[b], spread[b], fx, fy, cx, cy, slope, *bins, limits, labels[b]))
    return _mixture(result, given, labels), torch.from_numpy(labels)


def _mixture(
    found: list[tuple[np.ndarray, np.ndarray, np.ndarray]], given: SegmentInput, labels: np.ndarray
) -> GaussianMixture:
    """The kept Gaussians of all streams, padded to the largest."""
    dtype = np.float32 if given.dtype == torch.float32 else np.float64
    b, k = len(found), max(1, *(kept.size for kept, _, _ in found))
    mean, covariance = np.zeros((b, k, 3), dtype), np.zeros((b, k, 3, 3), dtype)
    weight, count = np.zeros((b, k), dtype), np.zeros((b, k), np.int64)
    for i, (kept, gaussians, whole) in enumerate(found):
        write_gaussians(kept, gaussians, whole, mean[i], covariance[i], weight[i], count[i])
    if given.features is None:
        features = np.empty((b, k, 0), dtype)
    else:
        features = _feature_means(_array(given.features), labels, weight)
    fields = (mean, covariance, weight, np.zeros((b, k), dtype), count, features)
    return GaussianMixture(*map(torch.from_numpy, fields))


def _array(value: Tensor) -> np.ndarray:
    """A contiguous float32 or float64 view of a CPU tensor; half and bfloat16 are converted."""
    if value.dtype not in (torch.float32, torch.float64):
        value = value.to(torch.float32)
    return value.contiguous().numpy()


def _limits(given: SegmentInput, before_pruning: bool) -> _Limits:
    c = given.config
    return _Limits(
        noise_floor=float(c.noise_floor),
        noise_thresh=float(c.noise_thresh),
        line_thresh=float(c.line_thresh),
        angle2=float(c.angle_cosine) ** 2,
        max_depth=float(c.depth_limit),
        shortest_bin=float(c.min_gaussian_length),
        longest_bin=float(c.frame_max_scale * c.min_gaussian_length),
        depth_bins=given.depth_bins,
        occlusion_gap=c.occlusion_gap,
        n_check=c.n_check,
        max_open=c.max_open,
        sparse=c.sparse,
        prune=0 if before_pruning else _PRUNE[c.prune],
        min_pixels=c.min_pixels,
        min_rows=c.min_rows,
    )


@kernel
def _depth_bins(s, limits):
    """Squared length and far edge of every depth bin [m^2, m]."""
    lengths2, edges = np.empty(limits.depth_bins), np.empty(limits.depth_bins)
    length = limits.shortest_bin
    edge = 0.0
    for k in range(limits.depth_bins):
        edge += length
        lengths2[k], edges[k] = length * length, edge
        length = min(max(s * edge, limits.shortest_bin), limits.longest_bin)
    return lengths2, edges


@kernel
def _feature_means(features, labels, weight):
    """Mean of the features [B, F, H, W] over the pixels of each Gaussian, in raster order."""
    streams, channels, height, width = features.shape
    sums = np.zeros((streams, weight.shape[1], channels))
    for b in range(streams):
        for f in range(channels):
            for v in range(height):
                for u in range(width):
                    if labels[b, v, u] >= 0:
                        sums[b, labels[b, v, u], f] += features[b, f, v, u]
    out = np.zeros(sums.shape, weight.dtype)
    for b in range(streams):
        for k in range(weight.shape[1]):
            for f in range(channels):
                if weight[b, k] > 0:
                    out[b, k, f] = sums[b, k, f] / weight[b, k]
    return out

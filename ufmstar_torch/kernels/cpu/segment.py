"""SPGF on the CPU (numba): the same partitions as :mod:`ufmstar_torch.steps.segment`, in well under a millisecond
at 224 x 224.

All threads that torch may use segment the rows of an image; one thread fuses their segments.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ufmstar_torch.config import SPGFConfig
from ufmstar_torch.gaussians.mixture import GaussianMixture
from ufmstar_torch.kernels.cpu.calls import array, each, shares_of_stream
from ufmstar_torch.kernels.cpu.segment_image import join_rows, write_gaussians, write_labels
from ufmstar_torch.kernels.cpu.segment_rows import SEGMENT, SEGMENT_INT, scan_rows

Maps = NDArray[np.floating[Any]]
_LIGHTER = 4  # a pixel takes a fraction of its regression's time: fewer threads pay off
_PRUNE = {"none": 0, "both": 1, "either": 2}


class _Limits(NamedTuple):
    """The thresholds that do not depend on the camera, for compiled code."""

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


def segment(
    depth: Tensor, intrinsics: Tensor, limits: SPGFConfig, features: Tensor | None = None
) -> tuple[GaussianMixture, Tensor]:
    """As :func:`ufmstar_torch.steps.segment.segment`, for CPU tensors, float64 inside."""
    fields, labels = gaussians(array(depth), array(intrinsics), limits, None if features is None else array(features))
    return GaussianMixture(*map(torch.from_numpy, fields)), labels()


def gaussians(
    z: Maps, intrinsics: Maps, config: SPGFConfig, features: Maps | None = None
) -> tuple[tuple[Maps, ...], Callable[[], Tensor]]:
    """The fields of the mixture of :func:`segment`, and a function that writes the labels."""
    streams, height, width = z.shape
    limits = _limits(config)
    room = height * config.segments_per_row(width)
    spans, runs = np.empty((streams, height, 4), np.int64), np.empty((streams, height * width, 2), np.int32)
    table, table_int = np.empty((streams, room, SEGMENT)), np.empty((streams, room, SEGMENT_INT), np.int64)
    shares = shares_of_stream(streams, height * width // _LIGHTER)
    rows = [height * i // shares for i in range(shares + 1)]
    scans, joins = [], []
    for b, K in enumerate(intrinsics.tolist()):
        fx, fy, cx, cy = K[0][0], K[1][1], K[0][2], K[1][2]
        slope = config.slope(min(fx, fy))
        bins = _depth_bins(0.5 * min(width / fx, height / fy), limits)
        tables = spans[b], table[b], table_int[b]
        for first, last in itertools.pairwise(rows):
            scans.append((z[b], fx, fy, cx, cy, slope, *bins, limits, first, last, *tables, runs[b]))
        joins.append((width, fy, cy, slope, bins[0], limits, *tables))
    each(scan_rows, scans)
    joined = each(join_rows, joins)

    def labels() -> Tensor:
        out = np.empty(z.shape, np.int64)
        for b, (*_, slot) in enumerate(joined):
            write_labels(spans[b], runs[b], slot, out[b])
        return torch.from_numpy(out)

    dtype = z.dtype
    k = max(1, *(retained.size for retained, *_ in joined))
    mean, covariance = np.zeros((streams, k, 3), dtype), np.zeros((streams, k, 3, 3), dtype)
    weight = np.zeros((streams, k), dtype)
    for b, fit in enumerate(joined):
        write_gaussians(*fit[:3], mean[b], covariance[b], weight[b])
    means = np.empty((streams, k, 0), dtype)
    if features is not None:
        means = _feature_means(features, labels().numpy(), weight)
    not_compared = *(np.zeros((streams, k), dtype) for _ in range(3)), np.zeros((streams, k, 5), dtype)
    return (mean, covariance, weight, *not_compared, means), labels


def _feature_means(features: np.ndarray, labels: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Means [B, K, F] of the features [B, F, H, W] over the pixels of each Gaussian, summed in raster order, in the
    dtype of ``weight`` [B, K]."""
    out = np.empty((*weight.shape, features.shape[1]), weight.dtype)
    for b, gaussian in enumerate(labels + 1):  # 0: no Gaussian
        for f, values in enumerate(features[b]):
            sums = np.bincount(gaussian.ravel(), values.ravel(), weight.shape[1] + 1)
            out[b, :, f] = sums[1:] / np.maximum(weight[b], 1)
    return out


@functools.lru_cache(maxsize=16)
def _limits(c: SPGFConfig) -> _Limits:
    return _Limits(
        noise_floor=float(c.noise_floor),
        noise_thresh=float(c.noise_thresh),
        line_thresh=float(c.line_thresh),
        angle2=float(c.angle_cosine) ** 2,
        max_depth=float(c.depth_limit),
        shortest_bin=float(c.min_gaussian_length),
        longest_bin=float(c.frame_max_scale * c.min_gaussian_length),
        depth_bins=c.depth_bins,
        occlusion_gap=c.occlusion_gap,
        n_check=c.n_check,
        max_open=c.max_open,
        sparse=c.sparse,
        prune=_PRUNE[c.prune],
        min_pixels=c.min_pixels,
        min_rows=c.min_rows,
    )


@functools.lru_cache(maxsize=16)  # a camera's focal length does not change
def _depth_bins(s: float, limits: _Limits) -> tuple[np.ndarray, np.ndarray]:
    """Squared length and far edge of every depth bin [m^2, m]."""
    lengths2, edges = np.empty(limits.depth_bins), np.empty(limits.depth_bins)
    length, edge = limits.shortest_bin, 0.0
    for k in range(limits.depth_bins):
        edge += length
        lengths2[k], edges[k] = length * length, edge
        length = min(max(s * edge, limits.shortest_bin), limits.longest_bin)
    return lengths2, edges

"""SPGF on the CPU (numba): the same partitions as :mod:`ufmstar_torch.steps.segment`, in well under a millisecond
at 224 x 224.

All threads that torch may use segment the rows of an image; one thread fuses their segments.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ufmstar_torch.config import SPGFConfig
from ufmstar_torch.gaussians.mixture import GaussianMixture
from ufmstar_torch.kernels.cpu.calls import array, each, shares_of_stream
from ufmstar_torch.kernels.cpu.segment_image import fit, write_labels
from ufmstar_torch.kernels.cpu.segment_rows import SEGMENT, SEGMENT_INT

Maps = NDArray[np.floating[Any]]
_LIGHTER = 4  # a pixel takes a fraction of its regression's time: fewer threads pay off
_NO_FLOOR = 0.0, -1.0, -1.0
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
    z, K = array(depth), np.asarray(array(intrinsics), np.float64)
    fields, labels = gaussians(z, K, limits, None if features is None else array(features))
    return GaussianMixture(*(torch.from_numpy(field.astype(z.dtype)) for field in fields)), torch.from_numpy(labels())


def gaussians(
    z: Maps, intrinsics: NDArray[np.float64], config: SPGFConfig, features: Maps | None = None,
    floor: tuple[float, float, float] = _NO_FLOOR,
) -> tuple[tuple[Maps, ...], Callable[[], NDArray[np.int64]]]:  # fmt: skip
    """The fields of the mixture of :func:`segment`, float64 with the values of the depth's dtype, and a function that
    computes the labels. ``floor``: near plane, variance of a pixel and share of the trace, below which no eigenvalue of
    a covariance is (``steps.step``)."""
    streams, height, width = z.shape
    room = height * max(1, width // (config.sparse + 1))
    spans, runs = np.empty((streams, height, 4), np.int64), np.empty((streams, height * width, 2), np.int32)
    table, table_int = np.empty((streams, room, SEGMENT)), np.empty((streams, room, SEGMENT_INT), np.int64)
    shares = shares_of_stream(streams, height * width // _LIGHTER)

    def arguments(b: int, first: int, last: int, joined: bool) -> tuple[Any, ...]:
        (fx, _, _), (_, fy, _), _ = intrinsics[b].tolist()
        thresholds, tables = _thresholds(config, width, height, fx, fy), (spans[b], table[b], table_int[b], runs[b])
        return z[b], intrinsics[b], *thresholds, first, last, joined, *tables, floor

    if shares > 1:
        rows = [(height * i // shares, height * (i + 1) // shares) for i in range(shares)]
        each(fit, [arguments(b, *part, False) for b in range(streams) for part in rows])
    scanned = height if shares > 1 else 0
    fits = each(fit, [arguments(b, scanned, height, True) for b in range(streams)])

    def labels() -> NDArray[np.int64]:
        out = np.empty(z.shape, np.int64)
        for b, (*_, slot) in enumerate(fits):
            write_labels(spans[b], runs[b], slot, out[b])
        return out

    if streams == 1 and fits[0][2].size > 0:
        mean, covariance, weight = [value[None] for value in fits[0][:3]]
    else:
        mean, covariance, weight = map(_padded, zip(*[fit[:3] for fit in fits], strict=True))
    none, means = np.zeros(weight.shape), np.empty((*weight.shape, 0))
    if features is not None:
        means = _feature_means(features, labels(), weight.astype(z.dtype)).astype(np.float64)
    return (mean, covariance, weight, none, none, none, np.zeros((*weight.shape, 5)), means), labels


def _padded(values: Sequence[Maps]) -> Maps:
    """[B, K, ...] of values [k, ...] by stream, zeros behind them; K is at least 1."""
    out = np.zeros((len(values), max(1, *map(len, values)), *values[0].shape[1:]))
    for padded, value in zip(out, values, strict=True):
        padded[: len(value)] = value
    return out


def _feature_means(features: np.ndarray, labels: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Means [B, K, F] of the features [B, F, H, W] over the pixels of each Gaussian, summed in raster order, in the
    dtype of ``weight`` [B, K]."""
    out = np.empty((*weight.shape, features.shape[1]), weight.dtype)
    for b, gaussian in enumerate(labels + 1):  # 0: no Gaussian
        for f, values in enumerate(features[b]):
            sums = np.bincount(gaussian.ravel(), values.ravel(), weight.shape[1] + 1)
            out[b, :, f] = sums[1:] / np.maximum(weight[b], 1)
    return out


@functools.lru_cache(maxsize=64)  # a camera's focal length does not change
def _thresholds(
    c: SPGFConfig, width: int, height: int, fx: float, fy: float
) -> tuple[float, tuple[Maps, Maps], _Limits]:
    """The slope, the depth bins and the other thresholds for a camera."""
    limits = _Limits(
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
    return c.slope(min(fx, fy)), _depth_bins(0.5 * min(width / fx, height / fy), limits), limits


def _depth_bins(s: float, limits: _Limits) -> tuple[np.ndarray, np.ndarray]:
    """Squared length and far edge of every depth bin [m^2, m]."""
    lengths2, edges = np.empty(limits.depth_bins), np.empty(limits.depth_bins)
    length, edge = limits.shortest_bin, 0.0
    for k in range(limits.depth_bins):
        edge += length
        lengths2[k], edges[k] = length * length, edge
        length = min(max(s * edge, limits.shortest_bin), limits.longest_bin)
    return lengths2, edges

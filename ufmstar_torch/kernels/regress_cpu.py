"""Gaussian mixture regression on the CPU (numba): the entry points.

The exact sum at every pixel is in ``regress_tiles_cpu``, at points of any kind in ``regress_points_cpu``; both leave
out components that cannot matter, and state the error. The paper's neighbourhood is in ``regress_near_cpu``.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ufmstar_torch.config import UfMStarConfig
from ufmstar_torch.kernels.arrays_cpu import array
from ufmstar_torch.kernels.compile_cpu import kernel
from ufmstar_torch.kernels.regress_cull_cpu import in_view
from ufmstar_torch.kernels.regress_near_cpu import near_image, near_points
from ufmstar_torch.kernels.regress_points_cpu import at_points
from ufmstar_torch.kernels.regress_tiles_cpu import exact, exact_at
from ufmstar_torch.kernels.threads_cpu import each, shares_of_stream
from ufmstar_torch.mixture import GaussianMixture
from ufmstar_torch.regress import Regression, regress_pixels

# Share of the denominator that culling may leave out: about the rounding of a sum in the dtype, so that culling is no
# coarser than the arithmetic itself.
EPSILON = {torch.float32: 1e-6, torch.float64: 1e-14}


def regress_image(
    mixture_cam: GaussianMixture,
    depth: Tensor,
    intrinsics: Tensor,
    valid: Tensor,
    config: UfMStarConfig,
    pixels: Tensor | None = None,
) -> Regression:
    """As :func:`ufmstar_torch.regress.regress_image`, for CPU tensors; every feature is a contiguous map."""
    return regress_maps(mixture_cam, torch.where(valid, depth.detach(), 0), intrinsics, config, pixels)


def regress_maps(
    mixture_cam: GaussianMixture,
    depth: Tensor,
    intrinsics: Tensor,
    config: UfMStarConfig,
    pixels: Tensor | None = None,
    near: Sequence[tuple[NDArray[np.int64], int]] | None = None,
    shift: NDArray[np.float64] | None = None,
) -> Regression:
    """:func:`regress_image` of a depth that is positive where it is valid, and only there.

    ``near`` are the slots of each stream that can matter, in increasing order, and how many are occupied; None = all.
    With the exact sum, ``shift`` [B, 2] is added to the two features before the last, of three or more; None = nothing.
    """
    if pixels is not None and config.regression != "exact":
        return regress_pixels(mixture_cam, depth, intrinsics, depth > 0, config, pixels, regress)
    z, K = array(depth), _doubles(intrinsics)[0]
    shape = z.shape if pixels is None else tuple(pixels.shape)
    out, features = np.empty(shape, z.dtype), np.empty((len(z), mixture_cam.features.shape[2], *shape[1:]), z.dtype)
    shares = 1 if pixels is not None else shares_of_stream(len(z), z[0].size)
    settings, moved = _settings(config, depth.dtype), np.zeros((len(z), 2)) if shift is None else shift
    kernel = near_image if config.regression != "exact" else exact if pixels is None else exact_at
    calls: list[tuple[Any, ...]] = []
    for b, fields in enumerate(zip(*_fields(mixture_cam), strict=True)):
        if kernel is near_image:
            calls += [(z[b], K[b], *fields, *settings, out[b], features[b], i, shares) for i in range(shares)]
            continue
        slots = np.flatnonzero(fields[2] > 0) if near is None else near[b][0]
        occupied = len(slots) if near is None else near[b][1]
        view = in_view(slots, occupied, *fields, K[b], z[b], *settings)
        if pixels is None:
            calls += [(z[b], K[b], view, fields[4], moved[b], out[b], features[b], i, shares) for i in range(shares)]
        else:
            calls.append((z[b], K[b], pixels[b].contiguous().numpy(), view, fields[4], moved[b], out[b], features[b]))
    each(kernel, calls)
    return _regression(out, features)


def regress(mixture: GaussianMixture, points: Tensor, config: UfMStarConfig) -> Regression:
    """As :func:`ufmstar_torch.regress.regress`, for CPU tensors; with the exact sum components are left out where they
    add less than eps pi_0 / K to the denominator, so that the error is at most eps max(m_k, mu_0)."""
    x = points.detach().contiguous().numpy()
    out, features = np.empty(x.shape[:2], x.dtype), np.empty((len(x), mixture.features.shape[2], x.shape[1]), x.dtype)
    settings = _settings(config, points.dtype)
    streams = zip(x, *_fields(mixture), out, features, strict=True)
    each(
        at_points if config.regression == "exact" else near_points,
        [(*given[:6], *settings, *given[6:]) for given in streams],
    )
    return _regression(out, features)


def smooth(previous: Tensor, current: Tensor, alpha: float) -> tuple[Tensor, Tensor]:
    """As :func:`ufmstar_torch.regress.smooth`, for CPU tensors, in one pass."""
    given = array(previous), array(current)
    memory, shown = map(np.empty_like, given)
    _smooth(*(value.reshape(-1) for value in given), alpha, memory.reshape(-1), shown.reshape(-1))
    return torch.from_numpy(memory), torch.from_numpy(shown)


@kernel
def _smooth(previous, current, alpha, memory, shown):
    for i in range(previous.size):
        before, now = previous[i], memory.dtype.type(current[i])
        memory[i] = before if now != now else now if before != before else (1 - alpha) * before + alpha * now
        shown[i] = now if now != now else memory[i]


def _settings(config: UfMStarConfig, dtype: torch.dtype) -> tuple[float, ...]:
    """What the kernel of the configured sum needs to know."""
    prior = (config.prior_weight, config.prior_mean)
    if config.regression == "exact":
        return (*prior, EPSILON[dtype])
    return (*prior, config.neighbourhood_sigmas, config.near_radius, config.far_radius)


def _doubles(*values: Tensor) -> list[NDArray[np.float64]]:
    return [np.asarray(array(value), np.float64) for value in values]


def _fields(m: GaussianMixture) -> list[NDArray[np.float64]]:
    return _doubles(m.mean, m.covariance, m.weight, m.disagreement, m.features)


def _regression(out: NDArray[Any], features: NDArray[Any]) -> Regression:
    last = features.transpose(0, *range(2, features.ndim), 1)
    return Regression(torch.from_numpy(out), torch.from_numpy(last))

"""Gaussian mixture regression on the CPU (numba): the entry points.

The exact sum at every pixel is in ``regress_tiles_cpu``, at points of any kind in ``regress_points_cpu``; both leave
out components that cannot matter, and state the error. The paper's neighbourhood is in ``regress_near_cpu``.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ufmstar_torch.config import UfMStarConfig
from ufmstar_torch.kernels.compile_cpu import kernel
from ufmstar_torch.kernels.regress_near_cpu import near_image, near_points
from ufmstar_torch.kernels.regress_points_cpu import at_points, unprojected
from ufmstar_torch.kernels.regress_tiles_cpu import exact
from ufmstar_torch.kernels.threads_cpu import each
from ufmstar_torch.mixture import GaussianMixture
from ufmstar_torch.regress import Regression

# Share of the denominator that culling may leave out: about the rounding of a sum in the dtype, so that culling is no
# coarser than the arithmetic itself.
EPSILON = {torch.float32: 1e-7, torch.float64: 1e-14}

_SHARE = 128 * 128  # pixels; below that a thread costs more than it saves


def regress_image(
    mixture_cam: GaussianMixture,
    depth: Tensor,
    intrinsics: Tensor,
    valid: Tensor,
    config: UfMStarConfig,
    pixels: Tensor | None = None,
) -> Regression:
    """As :func:`ufmstar_torch.regress.regress_image`, for CPU tensors; every feature is a contiguous map."""
    z, use, K = depth.detach().contiguous().numpy(), valid.contiguous().numpy(), _doubles(intrinsics)[0]
    if pixels is not None:
        index = pixels.contiguous().numpy()
        points = np.empty((*index.shape, 3), z.dtype)
        for b in range(len(index)):
            unprojected(z[b], use[b], K[b], index[b], points[b])
        return regress(mixture_cam, torch.from_numpy(points), config)
    out = np.empty(z.shape, z.dtype)
    features = np.empty((z.shape[0], mixture_cam.features.shape[2], *z.shape[1:]), z.dtype)
    kernel, settings = _kernel(config, depth.dtype, exact, near_image)
    shares = max(1, min(-(-torch.get_num_threads() // len(z)), z[0].size // _SHARE))
    streams = zip(z, use, K, *_fields(mixture_cam), out, features, strict=True)
    split = [(*given[:8], *settings, *given[8:], first, shares) for given in streams for first in range(shares)]
    each(kernel, split)
    return _regression(out, features)


def regress(mixture: GaussianMixture, points: Tensor, config: UfMStarConfig) -> Regression:
    """As :func:`ufmstar_torch.regress.regress`, for CPU tensors; with the exact sum components are left out where they
    add less than eps pi_0 / K to the denominator, so that the error is at most eps max(m_k, mu_0)."""
    x = points.detach().contiguous().numpy()
    out, features = np.empty(x.shape[:2], x.dtype), np.empty((len(x), mixture.features.shape[2], x.shape[1]), x.dtype)
    kernel, settings = _kernel(config, points.dtype, at_points, near_points)
    streams = zip(x, *_fields(mixture), out, features, strict=True)
    each(kernel, [(*given[:6], *settings, *given[6:]) for given in streams])
    return _regression(out, features)


def smooth(previous: Tensor, current: Tensor, alpha: float) -> tuple[Tensor, Tensor]:
    """As :func:`ufmstar_torch.regress.smooth`, for CPU tensors, in one pass."""
    memory, shown = torch.empty_like(previous), torch.empty_like(current)
    given = (value.detach().contiguous().view(-1).numpy() for value in (previous, current))
    _smooth(*given, alpha, memory.view(-1).numpy(), shown.view(-1).numpy())
    return memory, shown


@kernel
def _smooth(previous, current, alpha, memory, shown):
    for i in range(previous.size):
        before, now = previous[i], memory.dtype.type(current[i])
        memory[i] = before if now != now else now if before != before else (1 - alpha) * before + alpha * now
        shown[i] = now if now != now else memory[i]


def _kernel(config: UfMStarConfig, dtype: torch.dtype, exact: Any, near: Any) -> tuple[Any, tuple[float, ...]]:
    """The kernel of the configured sum, and its settings."""
    prior = (config.prior_weight, config.prior_mean)
    if config.regression == "exact":
        return exact, (*prior, EPSILON[dtype])
    return near, (*prior, config.neighbourhood_sigmas, config.near_radius, config.far_radius)


def _doubles(*values: Tensor) -> list[NDArray[np.float64]]:
    return [value.detach().double().contiguous().numpy() for value in values]


def _fields(m: GaussianMixture) -> list[NDArray[np.float64]]:
    return _doubles(m.mean, m.covariance, m.weight, m.disagreement, m.features)


def _regression(out: NDArray[Any], features: NDArray[Any]) -> Regression:
    return Regression(torch.from_numpy(out), torch.from_numpy(features).movedim(1, -1))

"""Fusion on the CPU (numba): one pass over the matched pairs."""

from __future__ import annotations

import numpy as np
import torch
from numba import njit

from ufmstar_torch.config import UfMStarConfig
from ufmstar_torch.correspond import Correspondence
from ufmstar_torch.kernels.gaussian_cpu import geodesic
from ufmstar_torch.mixture import GaussianMixture


def fuse(
    mixture: GaussianMixture,
    current: GaussianMixture,
    pairs: Correspondence,
    config: UfMStarConfig,
    *,
    rounds: int | None = None,
) -> GaussianMixture:
    """As :func:`ufmstar_torch.fuse.fuse`, for CPU tensors; ``rounds`` is not needed here."""
    fused = GaussianMixture(**{name: value.detach().clone() for name, value in mixture.tensors().items()})
    out = [value.numpy() for value in fused.tensors().values()]
    new = (current.mean, current.covariance, current.weight, current.features)
    _fuse(
        *out,
        *(value.detach().to(torch.float64).contiguous().numpy() for value in new),
        pairs.match.contiguous().numpy(),
        pairs.overlap.contiguous().numpy(),
        config.overlap_weighted,
    )
    return fused


@njit(cache=True, nogil=True)
def _fuse(
    mean, covariance, weight, disagreement, count, features,
    mean_c, cov_c, weight_c, features_c, match, overlap, overlap_weighted,
):  # fmt: skip
    """Apply every pair in place; after each one the values take the precision they are stored in."""
    work = np.empty((6, 3, 3))
    mean_k, cov_k = np.empty(3), np.empty((3, 3))
    for b in range(match.shape[0]):
        for c in range(match.shape[1]):
            for k in range(match.shape[2]):
                if not match[b, c, k]:
                    continue
                pi_k = np.float64(weight[b, k])
                pi_c = weight_c[b, c] * (overlap[b, c, k] if overlap_weighted else 1.0)
                lam = pi_c / (pi_k + pi_c)
                mean_k[:] = mean[b, k]
                cov_k[:] = covariance[b, k]
                distance = geodesic(mean_k, cov_k, mean_c[b, c], cov_c[b, c], lam, work)
                mean[b, k] = mean_k
                covariance[b, k] = cov_k
                weight[b, k] = pi_k + pi_c
                disagreement[b, k] = (1 - lam) * np.float64(disagreement[b, k]) + lam * distance
                for g in range(features.shape[2]):
                    features[b, k, g] = (1 - lam) * np.float64(features[b, k, g]) + lam * features_c[b, c, g]
                count[b, k] += 1

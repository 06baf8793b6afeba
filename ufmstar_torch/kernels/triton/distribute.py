"""Shares the anchors' evidence among components on a GPU in two launches: every point's evidence, then the sums.

A lane of the second launch is a component, which takes the points in their order: the sums depend on nothing else.
"""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from ufmstar_torch.config import UfMStarConfig
from ufmstar_torch.kernels.triton.launch import launch, power_of_two
from ufmstar_torch.kernels.triton.listing import whitened
from ufmstar_torch.kernels.triton.matrices import load_symmetric
from ufmstar_torch.mixture import GaussianMixture
from ufmstar_torch.regress import distribute as reference

_POINTS, _SLOTS = 32, 32


def distribute(mixture: GaussianMixture, points: Tensor, values: Tensor, config: UfMStarConfig) -> Tensor:
    """As :func:`ufmstar_torch.regress.distribute`; ``config.regression == "neighbourhood"`` runs there."""
    if config.regression != "exact":
        return reference(mixture, points, values, config)
    (b, k), (n, channels) = mixture.weight.shape, values.shape[1:]
    out = torch.zeros(b, k, channels, dtype=torch.float64, device=points.device)
    evidence = torch.empty(b, n, dtype=torch.float64, device=points.device)
    given = [v.to(torch.float64).contiguous() for v in (mixture.mean, mixture.covariance, mixture.weight, points)]
    launch(
        _evidence, (triton.cdiv(n, _POINTS), b), *given, evidence, k, n,
        prior=config.prior_weight, chunk=_SLOTS, lanes=_POINTS,
    )  # fmt: skip
    launch(
        _sums, (triton.cdiv(k, _SLOTS), b), *given, values.to(torch.float64).contiguous(), evidence, out, k, n,
        channels=channels, padded=power_of_two(channels), lanes=_SLOTS, warps=1,
    )  # fmt: skip
    return out


@triton.jit
def _component(mean, covariance, weight, k, there):
    """Mean, whitening and peak density pi_k N(mu_k) of components; 0 where the slot is empty."""
    pi = tl.load(weight + k, mask=there, other=0.0)
    there = there & (pi > 0)
    x = tl.load(mean + 3 * k, mask=there, other=0.0)
    y = tl.load(mean + 3 * k + 1, mask=there, other=0.0)
    z = tl.load(mean + 3 * k + 2, mask=there, other=0.0)
    xx, xy, xz, yy, yz, zz = load_symmetric(covariance + 9 * k, 1, there)
    one = tl.where(there, 0.0, 1.0)
    a, b, c, d, e, f, det = whitened(xx + one, xy, xz, yy + one, yz, zz + one)
    return x, y, z, a, b, c, d, e, f, tl.where(there, pi / det, 0.0) * 0.06349363593424098  # (2 pi)^(-3/2)


@triton.jit
def _evidence(
    mean, covariance, weight, points, evidence, many, count,
    prior: tl.constexpr, chunk: tl.constexpr, lanes: tl.constexpr,
):  # fmt: skip
    batch = tl.program_id(1).to(tl.int64)
    i = tl.program_id(0) * lanes + tl.arange(0, lanes)
    at = points + 3 * (batch * count + i)
    px = tl.load(at, mask=i < count, other=0.0)[:, None]
    py = tl.load(at + 1, mask=i < count, other=0.0)[:, None]
    pz = tl.load(at + 2, mask=i < count, other=0.0)[:, None]
    total = tl.zeros([lanes], tl.float64) + prior
    for first in range(0, many, chunk):
        slot = first + tl.arange(0, chunk)
        x, y, z, a, b, c, d, e, f, peak = _component(mean, covariance, weight, batch * many + slot, slot < many)
        dx, dy, dz = px - x[None, :], py - y[None, :], pz - z[None, :]
        y0, y1 = a[None, :] * dx, b[None, :] * dx + c[None, :] * dy
        y2 = d[None, :] * dx + e[None, :] * dy + f[None, :] * dz
        total += tl.sum(peak[None, :] * tl.exp(-0.5 * (y0 * y0 + y1 * y1 + y2 * y2)), 1)
    tl.store(evidence + batch * count + i, total, mask=i < count)


@triton.jit
def _sums(
    mean, covariance, weight, points, values, evidence, out, many, count,
    channels: tl.constexpr, padded: tl.constexpr, lanes: tl.constexpr,
):  # fmt: skip
    batch = tl.program_id(1).to(tl.int64)
    slot = tl.program_id(0) * lanes + tl.arange(0, lanes)
    channel = tl.arange(0, padded)
    x, y, z, a, b, c, d, e, f, peak = _component(mean, covariance, weight, batch * many + slot, slot < many)
    sums = tl.zeros([lanes, padded], tl.float64)
    for i in range(count):
        at = batch * count + i
        dx, dy, dz = tl.load(points + 3 * at) - x, tl.load(points + 3 * at + 1) - y, tl.load(points + 3 * at + 2) - z
        y0, y1, y2 = a * dx, b * dx + c * dy, d * dx + e * dy + f * dz
        share = peak * tl.exp(-0.5 * (y0 * y0 + y1 * y1 + y2 * y2)) / tl.load(evidence + at)
        value = tl.load(values + at * channels + channel, mask=channel < channels, other=0.0)
        sums += share[:, None] * value[None, :]
    place = (batch * many + slot)[:, None] * channels + channel[None, :]
    tl.store(out + place, sums, mask=(slot < many)[:, None] & (channel < channels)[None, :])

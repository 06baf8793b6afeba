"""Gaussian mixture regression on the CPU (numba): the entry points.

``regress_tiles`` has the exact sum, which leaves out components that cannot matter and states the error.
``regress_near`` has the paper's neighbourhood.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ufmstar_torch.config import UfMStarConfig
from ufmstar_torch.kernels.compile_cpu import contracted, kernel
from ufmstar_torch.kernels.cpu.calls import array, each, shares_of_stream
from ufmstar_torch.kernels.cpu.regress_cull import View, in_view
from ufmstar_torch.kernels.cpu.regress_near import near
from ufmstar_torch.kernels.cpu.regress_tiles import exact, exact_at
from ufmstar_torch.steps.regress import HALF, Regression

# Share of the denominator that culling may leave out: about the rounding of a sum in the dtype, so that culling is no
# coarser than the arithmetic itself.
EPSILON = {torch.float32: 1e-6, torch.float64: 1e-14}


class Seen(NamedTuple):
    """A stream's mixture: n components by field [13, n and more] in the camera's frame (``rigid``), their
    disagreement [n] and features [n, F]."""

    components: NDArray[np.float64]
    disagreement: NDArray[np.float64]
    features: NDArray[np.float64]


def views_of(
    seen: Sequence[Seen], depth: Tensor, intrinsics: Tensor, config: UfMStarConfig, *others: torch.dtype
) -> list[View]:
    """The components in view of each stream, for the exact sum. The error is that of the most precise dtype among the
    depth's and the ``others``."""
    epsilon = min(EPSILON[dtype] for dtype in (depth.dtype, *others))
    streams = zip(seen, np.asarray(array(intrinsics), np.float64), array(depth), strict=True)
    prior = config.prior_weight, config.prior_mean
    return [in_view(*one, K, z, float(z.max()), *prior, epsilon) for one, K, z in streams]


def regress_maps(
    seen: Sequence[Seen],
    depth: Tensor,
    intrinsics: Tensor,
    config: UfMStarConfig,
    pixels: Tensor | None = None,
    views: Sequence[View] | None = None,
    shift: NDArray[np.float64] | None = None,
) -> Regression:
    """As :func:`ufmstar_torch.steps.regress.regress_image`, over the components in view, for a depth that is positive
    exactly where it is valid; every feature is a contiguous map.

    With the exact sum, ``views`` are those of :func:`views_of` (None: computed here), and ``shift`` [B, 2] is added to
    the two features before the last, of three or more (None: zero).
    """
    z, K = array(depth), np.asarray(array(intrinsics), np.float64)
    shape, features = z.shape if pixels is None else tuple(pixels.shape), seen[0].features.shape[1]
    out, out_f = (np.full(size, np.nan, z.dtype) for size in (shape, (len(z), features, *shape[1:])))
    shares = 1 if pixels is not None else shares_of_stream(len(z), z[0].size)
    shifts = np.zeros((len(z), 2)) if shift is None else shift
    if config.regression != "exact":
        index = np.arange(z[0].size)[None].repeat(len(z), 0) if pixels is None else array(pixels)
        settings = (
            config.prior_weight, config.prior_mean, config.neighbourhood_sigmas, config.near_radius, config.far_radius,
        )  # fmt: skip
        calls: list[tuple[Any, ...]] = [
            (z[b], K[b], index[b], one.components, one.disagreement, one.features, settings, out[b].reshape(-1),
             out_f[b].reshape(features, index.shape[1]), i, shares)
            for b, one in enumerate(seen) for i in range(shares)
        ]  # fmt: skip
        each(near, calls)
        return _regression(out, out_f)
    if views is None:
        views = views_of(seen, depth, intrinsics, config)
    calls = []
    for b, one in enumerate(seen):
        outputs = out[b], out_f[b]
        view = views[b]
        if pixels is None:
            calls += [(z[b], K[b], view, one.features, shifts[b], *outputs, i, shares) for i in range(shares)]
        else:
            calls.append((z[b], K[b], pixels[b].contiguous().numpy(), view, one.features, shifts[b], *outputs))
    each(exact if pixels is None else exact_at, calls)
    return _regression(out, out_f)


def fill_and_smooth(
    disagreement: Tensor, measured: Tensor, depth: Tensor, memory: Tensor, config: UfMStarConfig, alpha: float
) -> tuple[Tensor, Tensor, list[int]]:
    """``steps.regress.set_unmeasured`` and ``steps.regress.smooth`` in one pass.

    Args:
        disagreement, measured, depth: at the pixels that are regressed, [B, H, W] or [B, n]; one dtype.
        memory: likewise, in any dtype; with ``alpha`` = 1 it counts only where M has no value.

    Returns:
        The new memory, the map to show, and the number of pixels of each stream that are not measured.
    """
    maps_in = [array(value) for value in (disagreement, depth, memory)]
    after, shown = np.empty_like(maps_in[2]), np.empty_like(maps_in[0])
    share = maps_in[0].dtype.type(config.unmeasured_relative**2 if config.unmeasured == "relative" else 0)
    settings = share, config.unmeasured == "nan", float(alpha)
    maps = (*maps_in, array(measured), after, shown)
    counts = each(_fill_and_smooth, [(*(value[b].reshape(-1) for value in maps), *settings) for b in range(len(after))])
    return torch.from_numpy(after), torch.from_numpy(shown), counts


@kernel
def _fill_and_smooth(disagreement, depth, previous, measured, memory, shown, share, blank, alpha):
    one, zero, unmeasured = shown.dtype.type(1), shown.dtype.type(0), 0
    half = shown.dtype.type(HALF)
    for i in range(shown.size):
        value, share_measured = disagreement[i], measured[i]
        missing = one - share_measured
        value = _plus(value, (missing if missing > zero else zero) * depth[i] * depth[i], share)
        unmeasured += share_measured < half
        current, last = memory.dtype.type(np.nan if blank and share_measured < half else value), previous[i]
        memory[i] = last if current != current else current if last != last else (1 - alpha) * last + alpha * current
        shown[i] = current if current != current else memory[i]
    return unmeasured


@contracted
def _plus(value, more, factor):
    """As torch's ``add`` with ``alpha``."""
    return value + more * factor


def _regression(out: NDArray[Any], features: NDArray[Any]) -> Regression:
    last = features.transpose(0, *range(2, features.ndim), 1)
    return Regression(torch.from_numpy(out), torch.from_numpy(last))

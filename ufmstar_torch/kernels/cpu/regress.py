"""Gaussian mixture regression on the CPU (numba): the entry points.

``regress_tiles`` has the exact sum, which leaves out components that cannot matter and states the error.
``regress_near`` has the paper's neighbourhood.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from ufmstar_torch.config import UfMStarConfig
from ufmstar_torch.kernels.compile_cpu import contracted, kernel
from ufmstar_torch.kernels.cpu.calls import each, shares_of_stream
from ufmstar_torch.kernels.cpu.regress_cull import Seen, View, in_view, settings_of
from ufmstar_torch.kernels.cpu.regress_near import near
from ufmstar_torch.kernels.cpu.regress_tiles import exact, exact_at
from ufmstar_torch.steps.regress import HALF

Reals = NDArray[np.floating[Any]]
# Share of the sums that culling may leave out: about the rounding of a sum in the dtype, so that culling is no
# coarser than the arithmetic itself.
EPSILON = {torch.float32: 1e-6, torch.float64: 1e-14}
# The same for maps: sigma, a square root, is off by half of it at most.
ERROR = {torch.float32: 1e-2, torch.float64: 1e-14}
_DTYPES: dict[Any, torch.dtype] = {np.dtype(np.float32): torch.float32, np.dtype(np.float64): torch.float64}


def views_of(
    seen: Sequence[Seen], depth: Reals, intrinsics: NDArray[np.float64], config: UfMStarConfig, *others: torch.dtype
) -> list[View]:
    """The components in view of each stream, for the exact sum. The error for anchors is that of the most precise dtype
    among the depth's and the ``others``."""
    dtype = _DTYPES[depth.dtype]
    epsilon, error = min(map(EPSILON.__getitem__, (dtype, *others))), ERROR[dtype]
    settings = settings_of(config.prior_weight, config.prior_mean, epsilon, error)
    views = []
    for b, one in enumerate(seen):
        slot, fields, packed, terms, n = in_view(*one, depth[b], intrinsics[b], settings)
        views.append(View(slot[:n], fields[:n], packed, terms[:n], len(slot), settings))
    return views


def regress_maps(
    seen: Sequence[Seen], depth: Reals, intrinsics: NDArray[np.float64], config: UfMStarConfig,
    pixels: NDArray[np.int64] | None = None, *, views: Sequence[View] | None = None,
    shift: NDArray[np.float64] | None = None, informative: NDArray[np.bool_] | None = None,
    smoothed: Reals | None = None,
) -> tuple[Reals, Reals, Reals | None, list[int]]:  # fmt: skip
    """The regression at the pixels of depth maps that are positive exactly where they are valid, M where it was not
    measured (``steps.regress.set_unmeasured``), and the moving average (``steps.regress.smooth``).

    Args:
        seen: the mixtures, whose last feature is that of ``steps.regress.with_measured_share``.
        depth, intrinsics: [B, H, W], [B, 3, 3].
        config: of UfM*.
        pixels: [B, n] indices into the flattened image; None = all.
        views: with the exact sum, those of :func:`views_of`; None = computed here.
        shift: [B, 2] added to the two features before the last, of three or more; None = zero.
        informative: [B] False for the streams whose image shows nothing; None = all True.
        smoothed: [B, H, W] the moving average of the frame before, NaN without a value; None = M is not averaged, as at
            ``pixels``.

    Returns:
        M [B, H, W] or [B, n]; the features [B, F, ...], every one a contiguous map; the moving average after the frame;
        and by stream the number of pixels that are not measured.
    """
    out, out_f = regression(seen, depth, intrinsics, config, pixels, views, shift)
    if informative is not None:
        out_f[:, -1] *= informative.reshape(-1, *[1] * (out.ndim - 1))
    shown, features = (out, out_f) if pixels is None else (out[:, None], out_f[:, :, None])
    z = depth if pixels is None else at_pixels(depth, pixels)[:, None]
    previous = z if smoothed is None else smoothed
    memory = np.empty(previous.shape, previous.dtype)
    relative = config.unmeasured_relative**2 if config.unmeasured == "relative" else 0
    settings = depth.dtype.type(relative), config.unmeasured == "nan", 1.0 if smoothed is None else config.ema_alpha
    counts = each(_finish, [(b, shown, features, z, previous, memory, *settings) for b in range(len(out))])
    return out, out_f, None if smoothed is None else memory, counts


def at_pixels(values: Reals, pixels: NDArray[np.int64]) -> Reals:
    """The values of a map [B, H, W] at pixels [B, n], indices into the flattened image."""
    index = pixels if len(values) == 1 else pixels + values[0].size * np.arange(len(values))[:, None]
    return values.reshape(-1).take(index)


def regression(
    seen: Sequence[Seen], depth: Reals, intrinsics: NDArray[np.float64], config: UfMStarConfig,
    pixels: NDArray[np.int64] | None = None, views: Sequence[View] | None = None,
    shift: NDArray[np.float64] | None = None,
) -> tuple[Reals, Reals]:  # fmt: skip
    """M [B, H, W] or [B, n], and the features [B, F, ...], as those of
    :func:`ufmstar_torch.steps.regress.regress_image`, over the components in view; arguments as :func:`regress_maps`.
    """
    shape, features = depth.shape if pixels is None else pixels.shape, seen[0].features.shape[1]
    out, out_f = np.empty(shape, depth.dtype), np.empty((len(depth), features, *shape[1:]), depth.dtype)
    shares = 1 if pixels is not None else shares_of_stream(len(depth), depth[0].size)
    calls: list[tuple[Any, ...]] = []
    if config.regression != "exact":
        index = np.arange(depth[0].size)[None].repeat(len(depth), 0) if pixels is None else pixels
        settings = (
            config.prior_weight, config.prior_mean, config.neighbourhood_sigmas, config.near_radius, config.far_radius,
        )  # fmt: skip
        calls = [
            (depth[b], intrinsics[b], index[b], *one, settings, out[b].reshape(-1),
             out_f[b].reshape(features, index.shape[1]), i, shares)
            for b, one in enumerate(seen) for i in range(shares)
        ]  # fmt: skip
        each(near, calls)
        return out, out_f
    views = views_of(seen, depth, intrinsics, config) if views is None else views
    shifts = np.zeros((len(depth), 2)) if shift is None else shift
    for b, one in enumerate(seen):
        rest = views[b], one.features, shifts[b], out[b], out_f[b]
        if pixels is None:
            calls += [(depth[b], intrinsics[b], *rest, i, shares) for i in range(shares)]
        else:
            calls.append((depth[b], intrinsics[b], pixels[b], *rest))
    each(exact if pixels is None else exact_at, calls)
    return out, out_f


@kernel
def _finish(b, shown, features, depth, previous, memory, share, blank, alpha):
    """Change M [B, H, W] at the pixels of a stream, of which the last feature says how far it is measured; write its
    moving average with an ``alpha`` below 1, and return the number of pixels that are not measured."""
    one, zero, unmeasured = shown.dtype.type(1), shown.dtype.type(0), 0
    half = shown.dtype.type(HALF)
    for v in range(shown.shape[1]):
        row, measured, z = shown[b, v], features[b, features.shape[1] - 1, v], depth[b, v]
        before, after = previous[b, v], memory[b, v]
        for u in range(row.size):
            missing = one - measured[u]
            value = _plus(row[u], (missing if missing > zero else zero) * z[u] * z[u], share)
            unmeasured += measured[u] < half
            current, last = memory.dtype.type(np.nan if blank and measured[u] < half else value), before[u]
            after[u] = last if current != current else current if last != last else (1 - alpha) * last + alpha * current
            row[u] = current if current != current else after[u]
    return unmeasured


@contracted
def _plus(value, more, factor):
    """As torch's ``add`` with ``alpha``."""
    return value + more * factor

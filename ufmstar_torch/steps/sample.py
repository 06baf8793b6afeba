"""Means over a sample of an image's pixels, for active learning (section "Compute- and memory efficiency")."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import NamedTuple, TypeAlias

import numpy as np
import torch
from torch import Tensor

from ufmstar_torch.frames.arguments import require_number, require_whole
from ufmstar_torch.frames.output import MeanUncertainty, SampleStatistics, UncertaintyOutput
from ufmstar_torch.gaussians.fixed_order import total
from ufmstar_torch.steps.regress import HALF

# The statistics of each map, the standard error of the mean of the first, and the share of measured pixels, [B] each.
Summary: TypeAlias = tuple[list[SampleStatistics], Tensor, Tensor]
_MAPS = ("variance", "disagreement", "aleatoric", "epistemic", "anchored", "depth")


class SampleKernels(NamedTuple):
    """The implementations of the replaceable parts.

    Attributes:
        pixels: see :func:`sample_pixels`.
        summary: see :func:`sample_summary`; without gradients.
    """

    pixels: Callable[[Tensor, int, int], tuple[Tensor, Tensor]]
    summary: Callable[[Sequence[Tensor], Tensor, Tensor, Tensor], Summary]


def mean_uncertainty(
    out: UncertaintyOutput,
    used: Tensor,
    summary: Callable[[Sequence[Tensor], Tensor, Tensor, Tensor], Summary] | None = None,
) -> MeanUncertainty:
    """Averages of V, M, A, E and B over the sampled pixels.

    Args:
        out: at the sampled pixels [B, n].
        used: [B, n] True for the pixels to average.
        summary: an implementation of :func:`sample_summary` for values without a graph.
    """
    maps = {**out.maps, "depth": out.depth, "variance": out.variance}
    sampled = {name: value for name in _MAPS if (value := maps.get(name)) is not None}
    if summary is None or out.variance.requires_grad:
        summary = sample_summary
    valid_pixels, measured = out.statistics.counts["valid_pixels"], maps["measured"]
    each, standard_error, share = summary(list(sampled.values()), used, measured, valid_pixels)
    by_map = dict(zip(sampled, each, strict=True))
    return MeanUncertainty(
        total=by_map["variance"],
        disagreement=by_map["disagreement"],
        aleatoric=by_map.get("aleatoric"),
        epistemic=by_map.get("epistemic"),
        anchored=by_map.get("anchored"),
        depth=by_map["depth"],
        standard_error=standard_error,
        measured=share,
        statistics=out.statistics,
    )


def sample_size(size: tuple[int, int], pixels: int | None, fraction: float | None, seed: int) -> tuple[int, int]:
    """Number of pixels to sample in an image of ``size`` (H, W): ``pixels``, or a ``fraction`` of all; default 1000;
    and the seed.

    Raises:
        ValueError: both arguments, or one out of range.
    """
    every, seed = size[0] * size[1], require_whole("seed", seed)
    if pixels is not None and fraction is not None:
        raise ValueError("pass pixels or fraction, not both")
    if fraction is not None:
        if not 0 < require_number("fraction", fraction) <= 1:
            raise ValueError(f"fraction must lie in (0, 1], got {fraction}")
        return max(1, round(fraction * every)), seed
    if pixels is None:
        return min(1000, every), seed
    if isinstance(pixels, bool) or not isinstance(pixels, int | np.integer) or not 1 <= pixels <= every:
        raise ValueError(f"pixels must be a whole number from 1 to H*W = {every}, got {pixels!r}")
    return int(pixels), seed


def sample_pixels(valid: Tensor, count: int, seed: int) -> tuple[Tensor, Tensor]:
    """A uniform sample of the valid pixels of each image, without replacement.

    The first ``count`` valid pixels in a random order, which depends only on the seed and the number of pixels: equal
    streams of a batch draw the same pixels.

    Args:
        valid: [B, H, W] bool.
        count: pixels per image, 1 <= count <= H W.
        seed: of the random order, drawn on the CPU so that all devices sample the same pixels.

    Returns:
        index [B, count] into the flattened image and used [B, count]; with fewer than ``count`` valid pixels the rest
        of ``used`` is False.
    """
    flat = valid.flatten(1)
    pixels, on_cpu = flat.shape[1], valid.device.type == "cpu"
    requested = 2 * count if on_cpu else pixels  # elsewhere, counting the valid ones would synchronise
    while True:
        order = random_order(pixels, seed)[:requested].to(valid.device, non_blocking=not on_cpu)
        usable = flat[:, order]
        if requested >= pixels or bool((usable.sum(1) >= count).all()):
            break
        requested *= 2
    rank_invalid = usable.sum(1, keepdim=True) + (~usable).cumsum(1) - 1
    position = torch.where(usable, usable.cumsum(1) - 1, rank_invalid)  # valid pixels first, both in random order
    index = torch.empty_like(position).scatter_(1, position, order.expand_as(position))[:, :count]
    return index, torch.gather(flat, 1, index)


def sample_summary(maps: Sequence[Tensor], used: Tensor, measured: Tensor, valid_pixels: Tensor) -> Summary:
    """Statistics of maps over a sample of pixels, see :class:`MeanUncertainty`.

    Args:
        maps: [B, n] each, the first one V.
        used: [B, n] True for the pixels to average.
        measured: [B, n] share that is measured.
        valid_pixels: [B].
    """
    values = torch.where(used, torch.stack(list(maps)), torch.nan)
    columns = zip(*(value.unbind() for value in vars(sample_statistics(values)).values()), strict=True)
    each = [SampleStatistics(*column) for column in columns]
    count = used.sum(1)
    # finite population correction: a sample of all pixels has no error
    unsampled = 1 - count / valid_pixels.clamp_min(1)
    standard_error = (each[0].variance / each[0].pixels * unsampled).sqrt()
    return each, standard_error, ((measured >= HALF) & used).sum(1) / count


def sample_statistics(values: Tensor) -> SampleStatistics:
    """Statistics of maps over a sample of pixels.

    Args:
        values: [..., B, n], NaN = no value.

    Returns:
        Each statistic [..., B].
    """
    present = ~values.isnan()
    count = present.sum(-1)
    mean = total(torch.where(present, values, 0), -1) / count  # 0/0 = NaN without a pixel
    squares = total(torch.where(present, (values - mean[..., None]) ** 2, 0), -1)
    variance = torch.where(count > 1, squares / (count - 1).clamp_min(1), torch.nan)
    largest = torch.where(present, values, -torch.inf).amax(-1)
    return SampleStatistics(
        mean, variance, values.nanmedian(-1).values, torch.where(count > 0, largest, torch.nan), count
    )


@functools.lru_cache(maxsize=4)  # the draw costs more than a sample
def random_order(pixels: int, seed: int) -> Tensor:
    """A permutation of the numbers below ``pixels``; the caller must not modify it."""
    return torch.randperm(pixels, generator=torch.Generator().manual_seed(seed))


REFERENCE = SampleKernels(sample_pixels, sample_summary)

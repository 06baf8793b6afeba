"""Step 2, 3D Gaussian segmentation: Single Pass Gaussian Fitting, depth map -> mixture C_i.

Section "3D Gaussian segmentation" (Li, Karaman, Sze, ICRA 2022): scanline segmentation divides every row into segments
that are lines in x and z, and segment fusion joins the segments of successive rows into planes. This is the vectorised
torch reference; ``docs/algorithm.md`` explains the method.

Moments are taken about a point of the surface (the first pixel of a segment, then the running mean, Chan et al.), never
about the camera, so that the distance from it causes no cancellation.
"""

from __future__ import annotations

import torch
from torch import Tensor

from ufmstar_torch.config import SPGFConfig
from ufmstar_torch.gaussians.mixture import GaussianMixture
from ufmstar_torch.steps.segment_fusion import GAUSSIAN_WIDTH, Gaussian, append, fuse_segments, parts, reads_are_free
from ufmstar_torch.steps.segment_scanline import Frame, Segments, scanlines


@torch.no_grad()
def segment(
    depth: Tensor, intrinsics: Tensor, limits: SPGFConfig, features: Tensor | None = None
) -> tuple[GaussianMixture, Tensor]:
    """Fit Gaussians to the surfaces of B depth maps, in float64.

    Not differentiable. Does not synchronise with an accelerator: there, loops and tables have static bounds.

    Args:
        depth: [B, H, W] [m], float32 or float64; pixels outside (0, ``limits.depth_limit``] are ignored.
        intrinsics: [B, 3, 3] [px], centre of the first pixel at (0, 0).
        limits: thresholds for H x W (``SPGFConfig.scaled_to``).
        features: [B, F, H, W], averaged over the pixels of each Gaussian, or None.

    Returns:
        The mixture [B, K] in the camera frame in order of emission: sample covariance (divisor N - 1; zeros for N = 1;
        eigenvalues not floored), weight = N [px], zeros for what views compare. Its dtype is that of the depth. K is
        the largest number of Gaussians of any stream, at least 1; on an accelerator, :func:`max_gaussians`.
        Labels [B, H, W] int64: each pixel's slot, -1 = none.
    """
    frame = Frame.of(depth, intrinsics, limits)
    segments = scanlines(frame)
    table, labels = _output(frame, segments, *fuse_segments(frame, segments))
    return _mixture(table, labels, features, depth.dtype), labels


def _output(
    frame: Frame, segments: Segments, emitted: Tensor, count: Tensor, member: Tensor
) -> tuple[Gaussian, Tensor]:
    """Prune the Gaussians: those that stay [B, K], and the labels [B, H, W]."""
    total = emitted.shape[1]
    g = parts(emitted)
    exists = torch.arange(total, device=count.device) < count[:, None]
    retained = exists & _keeps(g.n[..., 0], g.merged[..., 0], frame.limits)
    capacity = (
        max(1, int(retained.sum(1).max()))
        if reads_are_free(count.device)
        else min(total, max_gaussians(frame.limits, frame.height, frame.z.shape[1]))
    )
    table = emitted.new_zeros(emitted.shape[0], capacity + 1, GAUSSIAN_WIDTH)
    append(table, torch.zeros_like(count), emitted, retained)

    # From a pixel's segment to the Gaussian's index in order of creation, and from that to its slot.
    created = torch.where(exists, g.born[..., 0].to(torch.int64), total)
    slot = torch.where(retained, retained.cumsum(1) - 1, -1)
    slot_of = slot.new_zeros(slot.shape[0], total + 1).scatter(1, created, slot)
    segment = segments.pixel.view(len(count), frame.height, -1)
    gaussian = member.gather(2, segment.clamp_min(0)).flatten(1).clamp_min(0)
    labels = torch.where(segment < 0, -1, slot_of.gather(1, gaussian).view_as(segment))
    return parts(table[:, :capacity]), labels


def _keeps(pixels: Tensor, merged: Tensor, limits: SPGFConfig) -> Tensor:
    """[...] True where a Gaussian survives: "both" drops it if it is too small in pixels and in rows, "either" if it is
    too small in one of them."""
    large, tall = pixels >= limits.min_pixels, merged >= limits.min_rows
    if limits.prune == "none":
        return torch.ones_like(large)
    return large | tall if limits.prune == "both" else large & tall


def max_gaussians(limits: SPGFConfig, height: int, width: int) -> int:
    """Most Gaussians of an image of height x width that survive pruning, by the least number of pixels of each."""
    by_rows = limits.min_rows * (limits.sparse + 1)  # pixels of min_rows segments
    least = {"none": 1, "both": min(limits.min_pixels, by_rows), "either": max(limits.min_pixels, by_rows)}
    return max(1, height * width // least[limits.prune])


def _mixture(g: Gaussian, labels: Tensor, features: Tensor | None, dtype: torch.dtype) -> GaussianMixture:
    n = g.n[..., 0]
    covariance = torch.where(g.n > 1, g.scatter / (g.n - 1).clamp_min(1.0), 0)
    xx, xy, xz, yy, yz, zz = covariance.unbind(-1)
    full = torch.stack([xx, xy, xz, xy, yy, yz, xz, yz, zz], -1).unflatten(-1, (3, 3))
    means = n.new_zeros(*n.shape, 0) if features is None else _feature_means(features.to(n.dtype), labels, n)
    empty = GaussianMixture.empty(*n.shape, dtype=dtype, device=n.device)
    fields = {"mean": g.mean, "covariance": full, "weight": n, "features": means}
    return empty.replace(**{name: value.to(dtype) for name, value in fields.items()})


def _feature_means(features: Tensor, labels: Tensor, n: Tensor) -> Tensor:
    """[B, K, F] means of the features [B, F, H, W] over the pixels of each Gaussian."""
    b, channels = features.shape[:2]
    k = n.shape[1]
    at = torch.where(labels < 0, k, labels).flatten(1)[:, None].expand(-1, channels, -1)
    sums = features.new_zeros(b, channels, k + 1).scatter_add_(2, at, features.flatten(2))
    return sums[..., :k].mT / n.clamp_min(1.0)[..., None]

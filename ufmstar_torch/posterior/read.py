"""Interpolates node values to depth and variance at every pixel, without smoothing across depth edges."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from ufmstar_torch.anchors.anchors import FARTHEST_OFF
from ufmstar_torch.posterior.config import PosteriorConfig

# Upper limit of |y|: anchors that are off by more are not valid.
LARGEST = math.log(FARTHEST_OFF)


def read(
    depth: Tensor, valid: Tensor, claimed: Tensor, nodes: Tensor, coefficients: Tensor, mean: Tensor,
    size: tuple[int, int], config: PosteriorConfig,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:  # fmt: skip
    """Depth, variances and the probability of another surface at every pixel.

    The four nodes around a pixel have their bilinear weights times 1/(1 + (D/edge_contrast)^2); D is the difference
    between the pixel's log d and the node's.

    Args:
        depth, valid: [B, H, W].
        claimed: [B, H, W] UfM*'s variance [m^2]; its product with the share without evidence is a lower limit.
        nodes: [B, n, 6] log d, y - b . x, variance over the squared depth, the same on the evidence's surface,
            probability of another surface, and share without evidence.
        coefficients: [B, 4] of 1, log d - m_0, u, v.
        mean: [B] m_0.
        size: R and C of the nodes.
        config: of the posterior.

    Returns:
        Depth d e^y [m], its variance [m^2], that on the surface of the evidence, and the probability, [B, H, W] in
        depth's dtype, NaN where not valid.
    """
    rows, cols = size
    b, height, width = depth.shape
    d = torch.where(valid, depth, torch.ones_like(depth)).double()
    logs = d.log()
    v, u = ((torch.arange(n, dtype=d.dtype, device=d.device) + 0.5) / n for n in (height, width))
    (top, lower_weight), (left, right_weight) = _between(v, rows), _between(u, cols)
    total_weight = torch.zeros_like(d)
    sums = torch.zeros(5, *d.shape, dtype=d.dtype, device=d.device)
    for row, by_row in ((top, 1 - lower_weight), ((top + 1).clamp_max(rows - 1), lower_weight)):
        for column, by_column in ((left, 1 - right_weight), ((left + 1).clamp_max(cols - 1), right_weight)):
            node = nodes[:, (row[:, None] * cols + column).flatten()].view(b, height, width, 6)
            edge_weight = 1 / (1 + ((logs - node[..., 0]) / config.edge_contrast).square())
            weight = by_row[:, None] * by_column * edge_weight
            total_weight = total_weight + weight
            sums = sums + weight * node[..., 1:].permute(3, 0, 1, 2)
    offset, variance, inlier, p, unseen = sums / total_weight
    c = coefficients[:, None, None].expand(b, height, width, 4).unbind(-1)
    y = c[0] + c[1] * (logs - mean[:, None, None]) + c[2] * (2 * u - 1) + c[3] * (2 * v - 1)[:, None] + offset
    corrected = d * y.clamp(-LARGEST, LARGEST).exp()
    variance = torch.maximum(variance, unseen * claimed.double() / d.square())
    maps = corrected, corrected.square() * variance, corrected.square() * inlier, p
    corrected, variance, inlier, p = (torch.where(valid, x, torch.nan).to(depth.dtype) for x in maps)
    return corrected, variance, inlier, p


def _between(x: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Index of the node before each position in [0, 1], and the weight of the node after it."""
    position = (x * count - 0.5).clamp(0, count - 1)
    before = position.floor().long().clamp_max(max(count - 2, 0))
    return before, position - before

"""Components behind all that a frame sees (``config.occlusion_depth``), an extension.

The paper matches in the image plane: a component in the next room takes part like one on the wall, unless a single
nearer component of the same set covers it. With ``config.occlusion_depth`` = r a component is hidden besides where

1. the ellipsoid outside of which its density is negligible lies wholly beyond D, the largest depth seen in the region
   of the image that the ellipsoid projects to, so that the regression does not read it; and
2. its mean lies beyond r D.

A hidden component is no candidate for a match, and nothing else: so it can be left out of all that a frame computes.
Condition 2 keeps disagreement measurable: depths that one surface was given in two views are compared up to a ratio of
r at least. D is the largest depth of the blocks of 16 x 16 pixels that the ellipsoid's outline meets; a block of which
less than half has a depth sees infinitely far.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from ufmstar_torch.config import UfMStarConfig
from ufmstar_torch.frame import FrameInput
from ufmstar_torch.gaussian import cholesky3
from ufmstar_torch.mixture import GaussianMixture

BLOCK = 16  # [px]
NEGLIGIBLE = 1e-9  # density at a point, in units of the prior's weight


def seen_depth(depth: Tensor, valid: Tensor) -> Tensor:
    """[B, h, w] the depth that every block of pixels sees [m].

    Args:
        depth: [B, H, W] [m].
        valid: [B, H, W] bool.
    """
    height, width = depth.shape[1:]
    rows, columns = -(-height // BLOCK), -(-width // BLOCK)
    edge = (0, columns * BLOCK - width, 0, rows * BLOCK - height)

    def blocks(value: Tensor) -> Tensor:
        padded = torch.nn.functional.pad(value, edge).unflatten(2, (columns, BLOCK)).unflatten(1, (rows, BLOCK))
        return padded.transpose(2, 3).flatten(3)

    there = blocks(torch.ones_like(valid, dtype=torch.int32)).sum(-1)
    few = 2 * blocks(valid.to(torch.int32)).sum(-1) < there
    return torch.where(few, torch.inf, blocks(torch.where(valid, depth, 0.0)).amax(-1).double())


def square_reach(mixture: GaussianMixture, prior_weight: float) -> Tensor:
    """[B, K] r^2 = 2 log(peak / negligible), at least 0: outside of (x - mu)^T Sigma^-1 (x - mu) = r^2 the density is
    negligible. Empty slots have 0."""
    valid = mixture.valid
    eye = torch.eye(3, dtype=torch.float64, device=valid.device)
    L = cholesky3(torch.where(valid[..., None, None], mixture.covariance.double(), eye))
    half_log_det = torch.diagonal(L, dim1=-2, dim2=-1).log().sum(-1)
    weight = torch.where(valid, mixture.weight.double(), torch.full_like(half_log_det, 1e-300))
    log_peak = weight.log() - 1.5 * math.log(2 * math.pi) - half_log_det
    return (2 * (log_peak - math.log(NEGLIGIBLE * prior_weight))).clamp_min(0.0)


def hidden(mixture_cam: GaussianMixture, frame: FrameInput, config: UfMStarConfig) -> Tensor:
    """[B, K] True where a component is hidden, or projects nowhere into the image.

    Args:
        mixture_cam: in the camera frame, float64.
        frame: the same B streams.
        config: ``occlusion_depth`` r, which is not None; ``prior_weight``.
    """
    assert config.occlusion_depth is not None
    square, grid = square_reach(mixture_cam, config.prior_weight), seen_depth(frame.depth, frame.valid)
    z, szz = mixture_cam.mean[..., 2], mixture_cam.covariance[..., 2, 2]
    near = z - (square * szz).sqrt()
    met = [
        _outline(mixture_cam, square, frame.intrinsics, axis, blocks)
        for axis, blocks in ((0, grid.shape[2]), (1, grid.shape[1]))
    ]
    far = torch.full((), -torch.inf, dtype=torch.float64, device=z.device)
    rows = torch.where(met[0][:, :, None], grid[:, None], far).amax(-1)  # [B, K, h]
    depth = torch.where(met[1], rows, far).amax(-1)
    return mixture_cam.valid & (near > 0) & (near > depth) & (z > config.occlusion_depth * depth)


def _outline(mixture_cam: GaussianMixture, square: Tensor, intrinsics: Tensor, axis: int, blocks: int) -> Tensor:
    """[B, K, blocks] the blocks along an axis of the image that the ellipsoid's outline meets.

    It lies between the planes x = s z that touch it, (mu_x - s mu_z)^2 = r^2 (S_xx - 2 s S_xz + s^2 S_zz); behind the
    camera, anything.
    """
    mean, S = mixture_cam.mean, mixture_cam.covariance
    x, z = mean[..., axis], mean[..., 2]
    a = z * z - square * S[..., 2, 2]
    half_b, c = x * z - square * S[..., axis, 2], x * x - square * S[..., axis, axis]
    root = (half_b * half_b - a * c).clamp_min(0.0).sqrt()
    focal, centre = intrinsics[:, axis, axis, None], intrinsics[:, axis, 2, None]
    low = ((half_b - root) / a * focal + centre + 0.5) / BLOCK
    high = ((half_b + root) / a * focal + centre + 0.5) / BLOCK
    block = torch.arange(blocks, dtype=torch.float64, device=x.device)
    return (block + 1 >= low[..., None]) & (block <= high[..., None])

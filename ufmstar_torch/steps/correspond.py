"""Step 3, multiview Gaussian correspondence: match the image's Gaussians with components of the mixture.

Section "Multiview Gaussian Correspondence". The paper queries an R-tree for candidates. This module computes the whole
C x K overlap matrix, which gives the same pairs: the tree only skips pairs without overlap.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import pad

from ufmstar_torch.config import UfMStarConfig
from ufmstar_torch.gaussians.camera import project_gaussian
from ufmstar_torch.gaussians.gaussian import PIXEL_VARIANCE, bhattacharyya
from ufmstar_torch.gaussians.mixture import GaussianMixture

# Triples (c, k, k') compared at a time: bounds the temporary memory to some 100 MB.
_CHUNK = 2**24


@dataclass(frozen=True)
class Correspondence:
    """Pairs of current (c) and previous (k) components.

    Attributes:
        match: [B, C, K] True where k is in the correspondence set F_c after the occlusion filter.
        overlap: [B, C, K] Bhattacharyya coefficient beta_ck, 0 where c or k is no candidate.
    """

    match: Tensor
    overlap: Tensor

    def padded(self, capacity: int) -> Correspondence:
        """The pairs for a mixture that has grown to ``capacity`` slots: the new ones match nothing."""
        missing = capacity - self.match.shape[2]
        if not missing:
            return self
        return Correspondence(pad(self.match, (0, missing)), pad(self.overlap, (0, missing)))


def correspond(
    previous_cam: GaussianMixture, current_cam: GaussianMixture, intrinsics: Tensor, size: tuple[int, int],
    config: UfMStarConfig,
) -> Correspondence:  # fmt: skip
    """Match the current image's Gaussians with those of earlier views in the image plane.

    A component is a candidate where its mean lies beyond ``config.near_plane`` and projects into the image. k
    corresponds to c when beta_ck >= eta, unless k is hidden: another member k' of c's set is nearer (smaller depth of
    the mean) and overlaps k by more than eta_occl. All hidden members are removed at once, so the result does not
    depend on an order, and a hidden member can hide others. Correspondences are many-to-many.

    Args:
        previous_cam: M_(i-1) in the current camera frame, [B, K].
        current_cam: C_i in the current camera frame, [B, C].
        intrinsics: [B, 3, 3] [px].
        size: image height and width [px].
        config: eta, eta_occlusion, near_plane.
    """
    dtype = torch.float64
    seen_k, mean_k, cov_k = candidates(previous_cam, intrinsics.to(dtype), size, config.near_plane)
    seen_c, mean_c, cov_c = candidates(current_cam, intrinsics.to(dtype), size, config.near_plane)
    overlap = bhattacharyya(mean_c[:, :, None], cov_c[:, :, None], mean_k[:, None], cov_k[:, None])
    overlap = overlap * (seen_c[:, :, None] & seen_k[:, None])
    match = overlap >= config.eta
    return Correspondence(match & ~_hidden(match, mean_k, cov_k, previous_cam.mean[..., 2], config), overlap)


def _hidden(match: Tensor, mean: Tensor, covariance: Tensor, depth: Tensor, config: UfMStarConfig) -> Tensor:
    """[B, C, K] True where a nearer member of the same set covers k."""
    streams, capacity = depth.shape
    rows = max(1, _CHUNK // max(1, streams * capacity * match.shape[1]))
    hidden = []
    for k in range(0, capacity, rows):
        part = slice(k, k + rows)
        mutual = bhattacharyya(mean[:, part, None], covariance[:, part, None], mean[:, None], covariance[:, None])
        hides = (mutual > config.eta_occlusion) & (depth[:, None, :] < depth[:, part, None])  # k' hides k
        hidden.append((match[:, :, None] & hides[:, None]).any(3))
    return torch.cat(hidden, dim=2)


def candidates(
    mixture_cam: GaussianMixture, intrinsics: Tensor, size: tuple[int, int], near_plane: float
) -> tuple[Tensor, Tensor, Tensor]:
    """The mask of components in view [B, K], image-plane mean [B, K, 2] and covariance [B, K, 2, 2]; finite
    placeholders outside the mask."""
    height, width = size
    mean_cam = mixture_cam.mean.to(intrinsics.dtype)
    in_front = mixture_cam.valid & (mean_cam[..., 2] > near_plane)
    x, y, z = mean_cam.unbind(-1)
    safe_mean = torch.stack([x, y, torch.where(in_front, z, torch.ones_like(z))], dim=-1)
    mean, covariance = project_gaussian(safe_mean, mixture_cam.covariance.to(intrinsics.dtype), intrinsics)
    eye = torch.eye(2, dtype=intrinsics.dtype, device=intrinsics.device)
    u, v = mean.unbind(-1)
    inside = (u >= -0.5) & (u < width - 0.5) & (v >= -0.5) & (v < height - 0.5)
    return in_front & inside, mean, covariance + PIXEL_VARIANCE * eye

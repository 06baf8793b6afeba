"""Distance of two matched Gaussians in depth where both are seen: the alternative to W2^2 ("overlap").

The paper's W2^2 compares whole Gaussians. Two views segment one surface differently, so W2^2 includes the differences
in position and extent of the segments, even with perfect depth. The distance d^2 compares only the depths, and only
where both Gaussians lie in the image:

1. In the coordinates (u, z) of the current camera, u = (x/z, y/z), a Gaussian is linearised at its mean into
   N((u_0, z_0), S), S = J Sigma J^T.
2. Depth is regressed on the image position: slope b = S_uu^-1 S_uz, thickness tau^2 = S_zz - S_zu b. On a plane 1/z is
   linear in u, so z(u) = z_0 / (1 - b.(u - u_0)/z_0) continues a tilted plane exactly.
3. Both cover u ~ N(u*, S*), the normalised product of the two image-plane Gaussians: S* = (S_uu,1^-1 + S_uu,2^-1)^-1.
4. d^2 = E (z_1(u) - z_2(u))^2 + (tau_1 - tau_2)^2, with both curves linearised at u*:
   d^2 = (z_1 - z_2)^2 + (b_1 - b_2)^T S* (b_1 - b_2) + (tau_1 - tau_2)^2, values at u*, b_i(u*) = b_i (z_i / z_i0)^2.
   This is the mean squared Wasserstein distance of the two depths over u.

d^2 is 0 for two views of one plane, however each segments it, and delta^2 for frontal planes delta apart.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from ufmstar_torch.gaussians.fixed_order import apply, congruence
from ufmstar_torch.gaussians.mixture import GaussianMixture
from ufmstar_torch.steps.correspond import Correspondence

# The depth of an extrapolated plane is clamped to this factor of the depth at its mean. Matched Gaussians overlap, so
# u* lies within both; only a surface seen almost edge-on reaches the clamp.
_FARTHEST = 2.0


def with_overlap_disagreement(
    pairs: Correspondence, previous_cam: GaussianMixture, current_cam: GaussianMixture
) -> Correspondence:
    """The pairs with d^2 as the distance that fusion averages, in place of W2^2.

    Args:
        pairs: of the two mixtures.
        previous_cam: M_(i-1) in the current camera frame, [B, K].
        current_cam: C_i in the current camera frame, [B, C].
    """
    c, k = _profile(current_cam), _profile(previous_cam)
    c = [value.unsqueeze(2) for value in c]
    k = [value.unsqueeze(1) for value in k]
    squared = _squared_difference(c, k)
    return replace(pairs, distance=torch.where(pairs.match, squared, torch.zeros_like(squared)))


def overlap_disagreement(mean_a: Tensor, cov_a: Tensor, mean_b: Tensor, cov_b: Tensor) -> Tensor:
    """d^2 [...] [m^2] of Gaussians in the camera frame.

    Args:
        mean_a, mean_b: [..., 3] [m], z > 0.
        cov_a, cov_b: [..., 3, 3] [m^2], of positive extent across the line of sight.
    """
    return _squared_difference(_in_image(mean_a, cov_a), _in_image(mean_b, cov_b))


def _profile(mixture_cam: GaussianMixture) -> list[Tensor]:
    """:func:`_in_image` of a mixture, with placeholders for empty slots and components behind the camera."""
    usable = mixture_cam.valid & (mixture_cam.mean[..., 2] > 0)
    eye = torch.eye(3, dtype=torch.float64, device=usable.device)
    ahead = eye[2]
    mean = torch.where(usable[..., None], mixture_cam.mean.to(torch.float64), ahead)
    covariance = torch.where(usable[..., None, None], mixture_cam.covariance.to(torch.float64), eye)
    return _in_image(mean, covariance)


def _in_image(mean: Tensor, covariance: Tensor) -> list[Tensor]:
    """u_0 [..., 2], z_0 [...], precision S_uu^-1 [..., 2, 2], slope b [..., 2], thickness tau [...]."""
    x, y, z = mean.unbind(-1)
    zero, one = torch.zeros_like(z), torch.ones_like(z)
    J = torch.stack([1 / z, zero, -x / z**2, zero, 1 / z, -y / z**2, zero, zero, one], dim=-1).unflatten(-1, (3, 3))
    S = congruence(J, covariance)
    precision = _inverse2(S[..., :2, :2])
    S_uz = S[..., :2, 2]
    b = apply(precision, S_uz)
    thickness = (S[..., 2, 2] - (S_uz * b).sum(-1)).clamp_min(0).sqrt()
    return [torch.stack([x / z, y / z], dim=-1), z, precision, b, thickness]


def _squared_difference(one: list[Tensor], other: list[Tensor]) -> Tensor:
    """d^2 of broadcast profiles."""
    (u_1, _, P_1, _, tau_1), (u_2, _, P_2, _, tau_2) = one, other
    shared = _inverse2(P_1 + P_2)
    u = apply(shared, apply(P_1, u_1) + apply(P_2, u_2))
    z_1, b_1 = _continued(one, u)
    z_2, b_2 = _continued(other, u)
    slope = b_1 - b_2
    tilt = (slope * apply(shared, slope)).sum(-1)
    return (z_1 - z_2).square() + tilt + (tau_1 - tau_2).square()


def _continued(profile: list[Tensor], u: Tensor) -> tuple[Tensor, Tensor]:
    """Depth [...] and slope [..., 2] of the profile's plane at u."""
    u_0, z_0, _, b, _ = profile
    inverse = 1 - (b * (u - u_0)).sum(-1) / z_0
    ratio = 1 / inverse.clamp(1 / _FARTHEST, _FARTHEST)
    return z_0 * ratio, b * ratio[..., None].square()


def _inverse2(S: Tensor) -> Tensor:
    """Inverse of symmetric positive definite S [..., 2, 2]."""
    a, b, d = S[..., 0, 0], S[..., 0, 1], S[..., 1, 1]
    determinant = a * d - b * b
    return torch.stack([d, -b, -b, a], dim=-1).unflatten(-1, (2, 2)) / determinant[..., None, None]

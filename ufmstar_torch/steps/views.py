"""The weight of a comparison in step 4: two views from one place count as one view.

A network repeats its error in the same picture, so a comparison shows something only as far as the view changed. With
the camera's centre t, the centre t_ref of the component's reference view, and the distance r of its mean from t, the
change is

    q = 1 - exp(-(b/b_0)^2),   b = |t - t_ref| / r,

and a comparison has the weight w = q - q_max, where q_max is the largest q since the reference; 0 if that is below
``LEAST``. Once q_max reaches ``COMPLETE``, the present view becomes the reference, with q_max = 0. In this way a camera
that stands still, or trembles, adds nothing, and a slow one adds as much as a fast one on the same path. A comparison
with another network, or another random sample of one, has w = 1.

A component is fused only where w > 0. m is the mean of W2^2 with the weights w pi_c. The number of views of a component
is n = sum of w, each view once. In the paper every comparison has w = 1, and the first view has the distance 0 in m:
``view_baseline=None``.
"""

from __future__ import annotations

import torch
from torch import Tensor

from ufmstar_torch.config import UfMStarConfig
from ufmstar_torch.gaussians.mixture import GaussianMixture

# Change q of the view from which on it becomes the reference: 1.5 b_0.
COMPLETE = 0.9
# Least w: a tenth of b_0 from the reference. Without it, rounding would make a comparison of a first view.
LEAST = 0.01


def view_weights(mixture: GaussianMixture, view: Tensor, config: UfMStarConfig) -> Tensor:
    """w [B, K] float64 of a comparison of each component with a new view.

    Args:
        mixture: M_(i-1), [B, K], in the first camera's frame.
        view: [B, 4] the camera's centre in that frame [m] and the index of the network, float64.
        config: ``view_baseline`` is b_0; ``near_plane`` is the least r.
    """
    weight = torch.ones(mixture.weight.shape, dtype=torch.float64, device=view.device)
    if config.view_baseline is None:
        return weight
    reference, centre = mixture.reference.double(), view[:, None, :3]
    squared = (centre - reference[..., :3]).square().sum(-1)
    reach = (mixture.mean.double() - centre).square().sum(-1).clamp_min(config.near_plane**2)
    change = -torch.expm1(-squared / (reach * config.view_baseline**2))
    other = reference[..., 3] != view[:, None, 3]
    increase = change - reference[..., 4]
    return torch.where(other, weight, torch.where(increase < LEAST, torch.zeros_like(weight), increase))


def after_view(mixture: GaussianMixture, view: Tensor, weight: Tensor) -> Tensor:
    """The reference views [B, K, 5] after comparisons of ``weight`` [B, K] with a new ``view`` [B, 4]."""
    reference = mixture.reference.double()
    change = reference[..., 4] + weight
    new = torch.cat([view, torch.zeros_like(view[:, :1])], 1)[:, None].expand_as(reference)
    old = torch.cat([reference[..., :4], change[..., None]], -1)
    return torch.where((change >= COMPLETE)[..., None], new, old)


def first_weight(weight: Tensor, config: UfMStarConfig) -> Tensor:
    """Weight of m = 0 in a component of ``weight`` pi_c seen for the first time: pi_c in the paper, else 0."""
    return weight if config.view_baseline is None else torch.zeros_like(weight)


def measured_share(views: Tensor) -> Tensor:
    """Share in [0, 1] to which a component with n ``views`` [...] is measured: 1 - exp(-n)."""
    return -torch.expm1(-views)

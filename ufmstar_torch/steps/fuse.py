"""Step 4, multiview fusion: measure the disagreement of matched Gaussians and fold it into the mixture.

Section "Multiview Fusion". Both mixtures must be in one frame; distances are rigid invariants, so any frame will do.
Everything is computed in float64 and stored in the mixture's dtype. Eigenvalues that the rounding would destroy are
raised first, so that a thin covariance stays positive definite.

Two views from one place count as one view, which is not in the paper. A network repeats its error in the same picture,
so a comparison shows something only as far as the view changed. With the camera's centre t, the centre t_ref of the
component's reference view, and the distance r of its mean from t, the change is

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

from collections.abc import Mapping
from typing import NamedTuple

import torch
from torch import Tensor

from ufmstar_torch.config import UfMStarConfig
from ufmstar_torch.gaussians.gaussian import floor_covariance, geodesic, storage_floor
from ufmstar_torch.gaussians.mixture import GaussianMixture
from ufmstar_torch.steps.correspond import Correspondence

# Change q of the view from which on it becomes the reference: 1.5 b_0.
COMPLETE = 0.9
# Least w: a tenth of b_0 from the reference. Without it, rounding would make a comparison of a first view.
LEAST = 0.01


def fuse(
    mixture: GaussianMixture, current: GaussianMixture, pairs: Correspondence, view: Tensor, config: UfMStarConfig,
    *, rounds: int | None = None,
) -> GaussianMixture:  # fmt: skip
    """Fuse every matched pair into the mixture.

    For each k the matched c are applied one after the other in increasing index (SPGF's emission order);
    different k are independent. With pi_c (times beta_ck if ``config.overlap_weighted``) and
    lambda = pi_c / (pi_k + pi_c): mean and covariance move by lambda along the optimal-transport geodesic, features are
    averaged with lambda, pi_k <- pi_k + pi_c. With the weight w_k of the comparison (:func:`view_weights`; 1 in the
    paper) and rho = w_k pi_c / (W_k + w_k pi_c): m_k <- (1-rho) m_k + rho W2^2(G_k, G_c), W_k <- W_k + w_k pi_c; in the
    paper rho = lambda. n_k <- n_k + w_k. Where w_k = 0, k is unchanged: it would only outweigh its neighbours more.
    A c that matches several k is fused into each of them with its full weight.

    Args:
        mixture: M_(i-1), [B, K], in the first camera's frame.
        current: C_i, [B, C], likewise.
        pairs: their correspondence.
        view: [B, 4] the camera's centre in that frame [m] and the index of the network, float64.
        rounds: upper bound on the matches of any k; None = read it from the device (waits for an accelerator).

    Returns:
        The updated mixture, [B, K]; components without a match are unchanged to the last bit.
    """
    weight = view_weights(mixture, view, config)
    match = pairs.match & (weight > 0)[:, None]
    order = match.cumsum(dim=1)  # 1-based position of c among the matches of k
    if rounds is None:
        rounds = int(order[:, -1:].max()) if order.numel() else 0
    for position in range(1, rounds + 1):
        turn = match & (order == position)  # [B, C, K], at most one c for every k
        mixture = _fuse_one_each(mixture, current, turn, pairs, weight, config)
    counts = match.any(dim=1)
    changes = {"views": mixture.views.double() + weight, "reference": after_view(mixture, view, weight)}
    return mixture.replace(**{name: _where(counts, value, getattr(mixture, name)) for name, value in changes.items()})


def _fuse_one_each(
    mixture: GaussianMixture, current: GaussianMixture, turn: Tensor, pairs: Correspondence, counts: Tensor,
    config: UfMStarConfig,
) -> GaussianMixture:  # fmt: skip
    """Fuse at most one c into every k; ``counts`` [B, K] is the weight w of the comparison."""
    dtype = torch.float64
    used = turn.any(dim=1)
    c = turn.to(torch.uint8).argmax(dim=1)  # [B, K]

    def of_c(value: Tensor) -> Tensor:
        index = c.view(*c.shape, *[1] * (value.dim() - 2)).expand(*c.shape, *value.shape[2:])
        return torch.gather(value, 1, index).to(dtype)

    pi_c, pi_k = of_c(current.weight), mixture.weight.to(dtype)
    if config.overlap_weighted:
        pi_c = pi_c * torch.gather(pairs.overlap, 1, c[:, None])[:, 0].to(dtype)
    lam = torch.where(used, pi_c / (pi_k + pi_c).clamp_min(torch.finfo(dtype).tiny), torch.zeros_like(pi_c))

    # Empty slots get unit covariances, so that nothing divides by zero; `used` discards their results.
    eye = torch.eye(3, dtype=dtype, device=c.device)
    cov_k = torch.where(used[..., None, None], mixture.covariance.to(dtype), eye)
    cov_c = torch.where(used[..., None, None], of_c(current.covariance), eye)
    mean, covariance, distance = geodesic(mixture.mean.to(dtype), cov_k, of_c(current.mean), cov_c, lam)

    covariance = floor_covariance(covariance, storage_floor(covariance, mixture.covariance.dtype))

    added = torch.where(used, counts * pi_c, torch.zeros_like(pi_c))
    compared = mixture.compared.to(dtype) + added
    rho = added / compared.clamp_min(torch.finfo(dtype).tiny)

    def average(old: Tensor, new: Tensor, share: Tensor) -> Tensor:
        return (1 - share) * old.to(dtype) + share * new

    updated = {
        "mean": mean,
        "covariance": covariance,
        "weight": pi_k + pi_c,
        "disagreement": average(mixture.disagreement, distance, rho),
        "compared": compared,
        "features": average(mixture.features, of_c(current.features), lam[..., None]),
    }
    return mixture.replace(**{name: _where(used, value, getattr(mixture, name)) for name, value in updated.items()})


def _where(used: Tensor, new: Tensor, old: Tensor) -> Tensor:
    return torch.where(used.view(*used.shape, *[1] * (old.dim() - 2)), new.to(old.dtype), old)


def append(
    mixture: GaussianMixture, current: GaussianMixture, new: Tensor, view: Tensor, config: UfMStarConfig
) -> tuple[GaussianMixture, Tensor]:
    """Add first observations to the mixture, M_i <- M_(i-1) with G_c: m = 0, n = 0.

    Occupied slots come first; the new components follow in increasing c. Their covariances must survive rounding to the
    mixture's dtype (``gaussian.storage_floor``).

    Args:
        new: [B, C] True where c is to be added.
        view: [B, 4], see :func:`fuse`.

    Returns:
        The mixture [B, K] and the number of components per stream [B] without a free slot.
    """
    b, capacity = mixture.weight.shape
    slot = mixture.components[:, None] + new.cumsum(dim=1) - 1
    fits = new & (slot < capacity)
    slot = torch.where(fits, slot, torch.full_like(slot, capacity))  # an additional slot collects the rest

    def scattered(old: Tensor, value: Tensor) -> Tensor:
        padded = torch.cat([old, old.new_zeros(b, 1, *old.shape[2:])], dim=1)
        index = slot.view(*slot.shape, *[1] * (old.dim() - 2)).expand(*slot.shape, *old.shape[2:])
        return padded.scatter(1, index, value.to(old.dtype))[:, :capacity]

    placed = {name: scattered(old, getattr(current, name)) for name, old in mixture.tensors().items()}
    zero = torch.zeros_like(current.weight)
    placed["disagreement"], placed["views"] = (scattered(x, zero) for x in (mixture.disagreement, mixture.views))
    placed["compared"] = scattered(mixture.compared, first_weight(current.weight, config))
    first = torch.cat([view, torch.zeros_like(view[:, :1])], 1)
    placed["reference"] = scattered(mixture.reference, first[:, None].expand(b, current.capacity, first.shape[1]))
    return GaussianMixture(**placed), (new & ~fits).sum(dim=1)


class Room(NamedTuple):
    """A mixture from which components were dropped.

    Attributes:
        mixture: [B, K], the remaining components in their order.
        sums: [B, K, ...] by name, rows as in the mixture.
        slot: [B, K] the previous slot of each component; undefined for empty slots.
        dropped: [B] number of dropped components that existed before the frame.
    """

    mixture: GaussianMixture
    sums: dict[str, Tensor]
    slot: Tensor
    dropped: Tensor


def make_room(
    mixture: GaussianMixture, sums: Mapping[str, Tensor], old: Tensor, coming: Tensor, position: Tensor, limit: int
) -> Room:
    """Drop components beyond ``config.max_components``: the farthest from the camera first, among equally far ones the
    oldest. The others move up and keep their order, that of creation. Does not synchronise with the device.

    Args:
        mixture: after the fusion, [B, K].
        sums: tensors [B, K or less, ...] by name, whose rows belong to the components.
        old: [B] number of components before the frame; later ones are dropped last.
        coming: [B] number of components still to be appended.
        position: [B, 3] of the camera in the mixture's frame [m].
        limit: the largest number of components.
    """
    slot = torch.arange(mixture.capacity, device=position.device).expand(mixture.weight.shape)
    excess = (mixture.components + coming - limit)[:, None]
    key = (mixture.mean.double() - position[:, None]).square().sum(-1)
    key = torch.where(slot < old[:, None], key, slot / mixture.capacity - 2)
    order = torch.where(mixture.valid, key, -3.0).sort(dim=1, descending=True, stable=True).indices
    stays = mixture.valid & (torch.empty_like(order).scatter_(1, order, slot) >= excess)
    source = (~stays).to(torch.uint8).argsort(dim=1, stable=True)
    occupied = torch.gather(stays, 1, source)

    def moved(value: Tensor) -> Tensor:
        missing = mixture.capacity - value.shape[1]
        value = torch.cat([value, value.new_zeros(len(value), missing, *value.shape[2:])], 1) if missing else value
        shape = source.shape + (1,) * (value.dim() - 2)
        rows = torch.gather(value, 1, source.view(shape).expand(value.shape))
        return torch.where(occupied.view(shape), rows, torch.zeros_like(rows))

    dropped = (mixture.valid & ~stays & (slot < old[:, None])).sum(1)
    after = GaussianMixture(**{name: moved(value) for name, value in mixture.tensors().items()})
    return Room(after, {name: moved(value) for name, value in sums.items()}, source, dropped)


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

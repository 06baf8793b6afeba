"""Fewer components that read back the same map: an extension, not in the paper (``config.merge``).

Components are only ever added, and a surface that every view cuts in another way collects dozens of them. From time to
time two rules reduce the mixture; both are pure functions of it and need no history.

**Join.** Two components become one with their common moments,

    pi = pi_i + pi_j,   a = pi_i / pi,   mu = a mu_i + (1-a) mu_j,   m = a m_i + (1-a) m_j, features likewise,
    Sigma = a Sigma_i + (1-a) Sigma_j + a (1-a) (mu_i - mu_j)(mu_i - mu_j)^T,

so that the sums of pi, pi mu, pi (Sigma + mu mu^T) and pi m over the mixture stay. Runnalls (IEEE TAES 43, 2007) bounds
the Kullback-Leibler divergence of the reduced mixture from the former one; per pixel of the lighter component it is

    l(i, j) = [log|Sigma| - a log|Sigma_i| - (1-a) log|Sigma_j|] / (2 min(a, 1-a))   [nat],

0 for equal components and KL(lighter || heavier) where the lighter one weighs nothing. A pair within ``merge.loss``
overlaps so far that the regression mixed the two in any case. In each round those join who are each other's best.

A component seen from two views or more does not join a heavier one that was seen from one view: what was not measured
would read as measured. Of the counts c, c - 1 comparisons each stay: c = c_i + c_j - 1.

**Dissolve.** The share that a component has in explaining its own points, s_k = mean of w_k(x) over the cubature points
mu_k +- sqrt(3) L_k e_i (L_k L_k^T = Sigma_k), falls while others are observed again and again. Without it a regressed
quantity changes at these points by s_k times its difference to the others. Where s_k < ``merge.share``, and
those that stay explain the rest, its weight, its m and features with it, and the anchors' sums go to those that stay by
their shares at these points. Their means and covariances stay.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ufmstar_torch.config import UfMStarConfig
from ufmstar_torch.extension import Extension, FrameExtension, Total
from ufmstar_torch.fixed_order import total
from ufmstar_torch.frame import FrameInput
from ufmstar_torch.gaussian import cholesky3, floor_covariance, storage_floor
from ufmstar_torch.mixture import GaussianMixture
from ufmstar_torch.output import StepOutput
from ufmstar_torch.regress import shares
from ufmstar_torch.state import UfMStarState

# Pairs, and points x components, evaluated at a time: bounds the temporary memory to some 100 MB.
_CHUNK = 2**19
# Cubature points mu +- sqrt(3) L e_i: their mean and covariance are the component's.
_POINTS = 6
_REACH = 3**0.5


@dataclass(frozen=True)
class MergeKernels:
    """The parts of :func:`merge` that look at pairs of components; both take a float64 mixture.

    Attributes:
        partition: see :func:`partition`.
        own_shares: see :func:`own_shares`.
    """

    partition: Callable[[GaussianMixture, float], Tensor]
    own_shares: Callable[[GaussianMixture, UfMStarConfig], Tensor]


class MergeExtension(Extension):
    """Merging every some frames.

    Args:
        config: with ``merge``.
        kernels: makes the kernels for a backend and a device's type.
    """

    def __init__(self, config: UfMStarConfig, kernels: Callable[[str, str], MergeKernels]) -> None:
        self._config, self._kernels = config, kernels

    def of_frame(
        self, frame: FrameInput, own: Sequence[Tensor], given: object, before: Sequence[FrameExtension], *, dense: bool
    ) -> FrameExtension:
        """Merging after this frame."""
        return _MergeFrame(frame, self._config, self._kernels(self._config.backend, frame.depth.device.type))


class _MergeFrame(FrameExtension):
    """Merging after one frame."""

    changes_mixture = True

    def __init__(self, frame: FrameInput, config: UfMStarConfig, kernels: MergeKernels) -> None:
        self._frame, self._config, self._kernels = frame, config, kernels

    def after_frame(self, state: UfMStarState, out: StepOutput, total: Total) -> tuple[UfMStarState, StepOutput]:
        """Merge the streams that are due, and count the components."""
        state = merged(state, self._frame.fault == 0, self._config, self._kernels)
        counts = {"components": state.mixture.components, "single_view": (state.count == 1).sum(1)}
        return state, replace(out, statistics=replace(out.statistics, **counts))


def merged(state: UfMStarState, fine: Tensor, config: UfMStarConfig, kernels: MergeKernels) -> UfMStarState:
    """The state after a frame, merged every ``merge.every`` frames of a stream.

    Args:
        state: of B streams, after the step.
        fine: [B] True where the frame was used.
        config: with ``merge``. Checking which streams are due waits for an accelerator.
        kernels: which implementation of each part.
    """
    assert config.merge is not None
    if state.mean.device.type == "meta":
        return state
    due = fine & (state.frames % config.merge.every == 0)
    if not bool(due.any()):
        return state
    sums = torch.cat([state.mean.new_zeros(*state.weight.shape, 0), *state.by_component.values()], -1)
    mixture, sums = merge(state.mixture, sums, due, config, kernels)
    parts = sums.split([value.shape[-1] for value in state.by_component.values()], -1) if state.by_component else ()
    return state.with_tensors(mixture.tensors() | dict(zip(state.by_component, parts, strict=True)))


def merge(
    mixture: GaussianMixture, sums: Tensor, due: Tensor, config: UfMStarConfig, kernels: MergeKernels
) -> tuple[GaussianMixture, Tensor]:
    """Join, then dissolve; the components that are left move up and keep their order.

    Args:
        mixture: [B, K] in any frame: both rules are rigid invariants up to the choice of the cubature points.
        sums: [B, K, C] of observations beside it.
        due: [B] the streams to merge; the others stay as they are.
        config: ``merge``, which is not None, and ``prior_weight``.
        kernels: which implementation of each part.

    Returns:
        The mixture [B, K] and the sums. What neither joined nor received anything is unchanged to the last bit.
    """
    assert config.merge is not None
    before = mixture.to(torch.float64)
    joined, moved, changed = _joined(before, sums.double(), kernels.partition(before, config.merge.loss))
    floored = floor_covariance(joined.covariance, storage_floor(joined.covariance, mixture.covariance.dtype))
    joined = joined.replace(covariance=torch.where(changed[..., None, None], floored, joined.covariance))
    fewer, moved, received = _dissolved(joined, moved, kernels.own_shares(joined, config), config)
    changed = (changed | received | ~fewer.valid) & due[:, None]

    after, old = fewer.tensors() | {"sums": moved}, mixture.tensors() | {"sums": sums}
    kept = {name: _where(changed, value.to(old[name].dtype), old[name]) for name, value in after.items()}
    order = (kept["weight"] <= 0).to(torch.uint8).argsort(dim=1, stable=True)
    packed = {name: torch.gather(v, 1, _as_index(order, v)) for name, v in kept.items()}
    sums = packed.pop("sums")
    return GaussianMixture(**packed), sums


def partition(mixture: GaussianMixture, limit: float) -> Tensor:
    """[B, K] int64, the slot that each component joins, its own where it stays; the lower slot of a pair stays.

    Args:
        mixture: [B, K] float64.
        limit: largest loss l of a pair [nat].
    """
    slot = torch.arange(mixture.capacity, device=mixture.mean.device).expand(mixture.weight.shape)
    into = slot.clone()
    compared = mixture.count > 1
    while True:
        best, partner = _best(mixture, compared)
        mutual = (best <= limit) & (torch.gather(partner, 1, partner) == slot)
        if not bool(mutual.any()):
            return into
        stays, goes = mutual & (slot < partner), mutual & (slot > partner)
        redirect = torch.where(goes, partner, slot)
        into = torch.gather(redirect, 1, into)

        def of_partner(value: Tensor, partner: Tensor = partner) -> Tensor:
            return torch.gather(value, 1, _as_index(partner, value))

        weight, mean, covariance = mixture.weight, mixture.mean, mixture.covariance
        moments = _joint(
            *(weight, of_partner(weight)), *(mean, of_partner(mean)), *(covariance, of_partner(covariance))
        )
        new = {"weight": weight + of_partner(weight), "mean": moments[0], "covariance": moments[1]}
        old = mixture.tensors()
        mixture = mixture.replace(
            **{n: _where(goes, torch.zeros_like(v), _where(stays, v, old[n])) for n, v in new.items()}
        )
        compared = compared | (stays & of_partner(compared))


def _best(mixture: GaussianMixture, compared: Tensor) -> tuple[Tensor, Tensor]:
    """For each component, the least loss [B, K], infinite without a partner, and the first partner with it [B, K]."""
    k = mixture.capacity
    rows = max(1, _CHUNK // max(1, mixture.streams * k))
    eye = torch.eye(3, dtype=torch.float64, device=mixture.mean.device)
    covariance = torch.where(mixture.valid[..., None, None], mixture.covariance, eye)
    weight = torch.where(mixture.valid, mixture.weight, torch.ones_like(mixture.weight))
    log_det = _log_det(covariance)
    result = []
    for first in range(0, k, rows):
        i, j = (slice(None), slice(first, first + rows), None), (slice(None), None)
        _, S = _joint(weight[i], weight[j], mixture.mean[i], mixture.mean[j], covariance[i], covariance[j])
        a, b = _parts(weight[i], weight[j])
        loss = 0.5 * (_log_det(S) - a * log_det[i] - b * log_det[j]) / torch.minimum(a, b)
        lighter, heavier = (
            torch.where(weight[i] < weight[j], compared[i], compared[j]),
            torch.where(weight[i] < weight[j], compared[j], compared[i]),
        )
        fits = mixture.valid[i] & mixture.valid[j] & ~(lighter & ~heavier)
        own = torch.arange(k, device=loss.device)
        fits &= own[first : first + rows, None] != own
        result.append(torch.where(fits, loss, torch.inf).min(dim=2, keepdim=False))
    values = torch.cat([f.values for f in result], 1)
    return values, torch.cat([f.indices for f in result], 1)


def _parts(weight_a: Tensor, weight_b: Tensor) -> tuple[Tensor, Tensor]:
    """a and 1 - a."""
    both = weight_a + weight_b
    return weight_a / both, weight_b / both


def _joint(
    weight_a: Tensor, weight_b: Tensor, mean_a: Tensor, mean_b: Tensor, cov_a: Tensor, cov_b: Tensor
) -> tuple[Tensor, Tensor]:
    """Common mean and covariance of pairs; garbage, but no error, where both weights are 0."""
    a, b = _parts(weight_a, weight_b)
    d = mean_a - mean_b
    between = (a * b)[..., None, None] * d[..., :, None] * d[..., None, :]
    covariance = a[..., None, None] * cov_a + b[..., None, None] * cov_b + between
    return a[..., None] * mean_a + b[..., None] * mean_b, covariance


def _log_det(S: Tensor) -> Tensor:
    """log|S| of positive definite S [..., 3, 3], by the pivots of its Cholesky factor."""
    p0 = S[..., 0, 0]
    u, v = S[..., 1, 0] / p0, S[..., 2, 0] / p0
    p1 = S[..., 1, 1] - u * S[..., 1, 0]
    w = S[..., 2, 1] - v * S[..., 1, 0]
    p2 = S[..., 2, 2] - v * S[..., 2, 0] - w * w / p1
    return torch.log(p0 * p1 * p2)


def _joined(mixture: GaussianMixture, sums: Tensor, into: Tensor) -> tuple[GaussianMixture, Tensor, Tensor]:
    """The mixture with the parts of a partition joined, empty where a component has gone; and which slots changed."""
    w = mixture.weight[..., None]
    add = _Sums(into, mixture.valid)
    weight = add(w)
    safe = torch.where(weight > 0, weight, torch.ones_like(weight))
    mean = add(w * mixture.mean) / safe
    offset = mixture.mean - torch.gather(mean, 1, _as_index(into, mean))
    spread = mixture.covariance + offset[..., :, None] * offset[..., None, :]
    new = GaussianMixture(
        mean=mean,
        covariance=(add(w * spread.flatten(2)) / safe).unflatten(-1, (3, 3)),
        weight=weight[..., 0],
        disagreement=(add(w * mixture.disagreement[..., None]) / safe)[..., 0],
        count=add((mixture.count - 1)[..., None])[..., 0] + (weight[..., 0] > 0),
        features=add(w * mixture.features) / safe,
    )
    joined = add.parts > 1
    old, gone = mixture.tensors(), mixture.valid & (weight[..., 0] <= 0)
    kept = {n: _where(joined | gone, v, old[n]) for n, v in new.tensors().items()}
    return GaussianMixture(**kept), _where(joined | gone, add(sums), sums), joined


class _Sums:
    """Sums over the parts of a partition ``into`` [B, K] (:func:`partition`) of the slots that are ``valid`` [B, K],
    always in the order of the slots. ``parts`` [B, K]: how many slots went into each."""

    def __init__(self, into: Tensor, valid: Tensor) -> None:
        k = into.shape[1]
        target = torch.where(valid, into, torch.full_like(into, k))  # one slot more catches what does not count
        ordered, order = target.sort(dim=1, stable=True)
        first = torch.searchsorted(ordered, ordered)
        rank = torch.arange(k, device=into.device) - first
        self._target, self._rank = target, torch.zeros_like(into).scatter(1, order, rank)
        self._rounds = int(torch.where(valid, self._rank, torch.zeros_like(into)).max()) + 1 if into.numel() else 0
        self.parts = self(valid[..., None].long())[..., 0]

    def __call__(self, value: Tensor) -> Tensor:
        """[B, K, C] -> [B, K, C]."""
        k = value.shape[1]
        out = torch.zeros_like(value)
        for position in range(self._rounds):
            turn = torch.where(self._rank == position, self._target, torch.full_like(self._target, k))
            placed = value.new_zeros(value.shape[0], k + 1, value.shape[2])
            out = out + placed.scatter(1, _as_index(turn, value), value)[:, :k]
        return out


def own_shares(mixture: GaussianMixture, config: UfMStarConfig) -> Tensor:
    """[B, K] s_k, each component's share in explaining its own cubature points; 0 for empty slots.

    Args:
        mixture: [B, K] float64.
        config: ``prior_weight``; the sum is the exact one whatever ``regression`` is.
    """
    k = mixture.capacity
    rows = max(1, _CHUNK // max(1, mixture.streams * k * _POINTS))
    points = _cubature(mixture)
    result = []
    for first in range(0, k, rows):
        share = _mean_shares(mixture, points[:, first : first + rows], config)
        own = torch.arange(first, first + share.shape[1], device=share.device)
        result.append(torch.gather(share, 2, own.expand(share.shape[:2])[..., None])[..., 0])
    return torch.where(mixture.valid, torch.cat(result, 1), 0.0)


def _cubature(mixture: GaussianMixture) -> Tensor:
    """[B, K, 6, 3] mu + sqrt(3) L e_i for i = 0, 1, 2, then mu - sqrt(3) L e_i [m]."""
    steps = _REACH * cholesky3(mixture.covariance).mT
    return mixture.mean[:, :, None] + torch.cat([steps, -steps], dim=2)


def _mean_shares(mixture: GaussianMixture, points: Tensor, config: UfMStarConfig) -> Tensor:
    """[B, n, K] shares of all components at points [B, n, 6, 3], their mean over the six."""
    share = shares(mixture, points.flatten(1, 2), config.replace(regression="exact"))
    return total(share.unflatten(1, (-1, _POINTS)), 2) / _POINTS


def _dissolved(
    mixture: GaussianMixture, sums: Tensor, own: Tensor, config: UfMStarConfig
) -> tuple[GaussianMixture, Tensor, Tensor]:
    """The mixture and the sums without the components that others explain, and which slots received something."""
    assert config.merge is not None
    weak = mixture.valid & (own < config.merge.share)
    number = int(weak.sum(1).max()) if weak.numel() else 0
    if not number:
        return mixture, sums, torch.zeros_like(weak)
    slot = (~weak).to(torch.uint8).argsort(dim=1, stable=True)[:, :number]

    def of_weak(value: Tensor) -> Tensor:
        return torch.gather(value, 1, _as_index(slot, value))

    stays = mixture.valid & ~weak
    points = of_weak(_cubature(mixture))
    rows = max(1, _CHUNK // max(1, mixture.streams * mixture.capacity * _POINTS))
    share = torch.cat([_mean_shares(mixture, x, config) for x in points.split(rows, dim=1)], 1)
    share = torch.where(stays[:, None], share, 0.0)
    rest = total(share, 2)
    goes = of_weak(weak) & (rest >= 1 - config.merge.share)
    given = torch.where(goes[..., None], share / torch.where(goes, rest, torch.ones_like(rest))[..., None], 0.0)

    values = torch.cat([mixture.disagreement[..., None], mixture.features], -1)
    w = mixture.weight[..., None]
    gifts = of_weak(torch.cat([w, w * values, sums], -1))
    gain = torch.stack([total(given * gift[..., None], 1) for gift in gifts.unbind(-1)], -1)
    weight, more, learnt = gain.split([1, values.shape[2], sums.shape[2]], -1)
    received = weight[..., 0] > 0
    values = torch.where(
        received[..., None], (w * values + more) / torch.where(received[..., None], w + weight, 1), values
    )
    gone = torch.zeros_like(weak).scatter(1, slot, goes)
    after = mixture.replace(
        weight=mixture.weight + weight[..., 0], disagreement=values[..., 0], features=values[..., 1:]
    )
    left = {name: _where(gone, torch.zeros_like(value), value) for name, value in after.tensors().items()}
    return GaussianMixture(**left), _where(gone, torch.zeros_like(sums), sums + learnt), received


def _as_index(index: Tensor, value: Tensor) -> Tensor:
    """An index [B, n] for ``gather`` and ``scatter`` on [B, K, ...]."""
    return index.view(*index.shape, *[1] * (value.dim() - 2)).expand(*index.shape, *value.shape[2:])


def _where(mask: Tensor, new: Tensor, old: Tensor) -> Tensor:
    return torch.where(mask.view(*mask.shape, *[1] * (old.dim() - 2)), new, old)


REFERENCE = MergeKernels(partition, own_shares)

"""Reduction of the mixture with little change to the regressed map; not in the paper (``config.merge``).

The paper's method only adds components, and a surface that each view segments differently collects dozens of them.
Every ``merge.every`` frames, two rules reduce the mixture; both are pure functions of it.

**Join.** Two components become one with their joint moments,

    pi = pi_i + pi_j,   a = pi_i / pi,   mu = a mu_i + (1-a) mu_j,   features likewise,
    W = W_i + W_j,      m = (W_i m_i + W_j m_j) / W,                 n = n_i + n_j,
    Sigma = a Sigma_i + (1-a) Sigma_j + a (1-a) (mu_i - mu_j)(mu_i - mu_j)^T,

which preserve the sums of pi, pi mu, pi (Sigma + mu mu^T) and W m over the mixture (in the paper W = pi); the reference
view is that of the heavier component. Runnalls (IEEE TAES 43, 2007) bounds the Kullback-Leibler divergence of the
reduced mixture from the original; per pixel of the lighter component, the bound is

    l(i, j) = [log|Sigma| - a log|Sigma_i| - (1-a) log|Sigma_j|] / (2 min(a, 1-a))   [nat],

0 for equal components and KL(lighter || heavier) in the limit of a weightless lighter one. A pair within ``merge.loss``
overlaps so much that the regression mixes the two anyway. In each round, pairs join that are mutually best.

A component of which views were compared does not join a heavier one without, because the unmeasured surface would then
count as measured.

**Dissolve.** A component's weight share at its own points, s_k = mean of w_k(x) over the cubature points
mu_k +- sqrt(3) L_k e_i (L_k L_k^T = Sigma_k), falls as others are observed repeatedly. Removing it changes a regressed
quantity at these points by s_k times its difference to the others. Where s_k < ``merge.share`` and the remaining
components have the rest of the weight, they receive its weight, m, features and anchors' sums, in proportion to their
shares at these points. Their means and covariances do not change.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from ufmstar_torch.config import UfMStarConfig
from ufmstar_torch.frames.frame import FrameInput
from ufmstar_torch.gaussians.camera import relative_pose
from ufmstar_torch.gaussians.fixed_order import total
from ufmstar_torch.gaussians.gaussian import cholesky3, floor_covariance, inverse_lower3, storage_floor
from ufmstar_torch.gaussians.mixture import GaussianMixture
from ufmstar_torch.gaussians.state import UfMStarState
from ufmstar_torch.steps.regress import shares

# Components are merged within this multiple of the frame's largest depth from the camera: those in view, and around.
_NEAR = 2.0
# Most pairs, or points x components, evaluated at a time: bounds the temporary memory to some 100 MB.
_CHUNK = 2**19
# Cubature points mu +- sqrt(3) L e_i, which have the component's mean and covariance.
_POINTS = 6
_REACH = 3**0.5
# A component is omitted at another's point if its density is below this share of the other's density there. K omitted
# components change a share by less than K times this.
_LEAST_SHARE = 1e-9
# The components of one stream: the fields of its mixture and "sums" [n, C], in float64.
Components = dict[str, Tensor]


def after_frame(
    state: UfMStarState, frame: FrameInput, config: UfMStarConfig, kernels: MergeKernels | None = None
) -> tuple[UfMStarState, dict[str, Tensor]]:
    """Merge the streams that are due after a frame, and count the components."""
    after = merged(state, frame.fault, config, kernels, frame)
    if after is state:
        return state, {}
    mixture = after.mixture
    return after, {"components": mixture.components, "single_view": (mixture.valid & (mixture.views == 0)).sum(1)}


def merged(
    state: UfMStarState, fault: Tensor, config: UfMStarConfig, kernels: MergeKernels | None = None,
    frame: FrameInput | None = None,
) -> UfMStarState:  # fmt: skip
    """The state after a frame, with the streams merged whose frame count is a multiple of ``merge.every``.

    Args:
        state: of B streams, after the step.
        fault: [B] 0 where the frame was used (``frame.FRAME_FAULTS``).
        config: with ``merge``.
        kernels: as :func:`merge`.
        frame: components beyond ``_NEAR`` times its largest depth from the camera are left as they are, so that a
            merging takes as long in a building as in a room; None = all are merged.

    Checking which streams are due synchronises with an accelerator.
    """
    assert config.merge is not None
    if state.mean.device.type == "meta":
        return state
    frames, every = zip(fault.tolist(), state.frames.tolist(), strict=True), config.merge.every
    if True not in (due := [code == 0 and number % every == 0 for code, number in frames]):
        return state
    sums = torch.cat([state.mean.new_zeros(*state.weight.shape, 0), *state.by_component.values()], -1)
    near = None
    if frame is not None:
        centre = relative_pose(frame.T_world_cam, state.T_world_first)[1]
        distance = (state.mean.double() - centre[:, None]).square().sum(-1).sqrt()
        near = distance <= _NEAR * frame.depth.amax((1, 2))[:, None]
    mixture, sums = merge(state.mixture, sums, torch.tensor(due), config, kernels, near)
    parts = sums.split([value.shape[-1] for value in state.by_component.values()], -1) if state.by_component else ()
    return state.with_tensors(mixture.tensors() | dict(zip(state.by_component, parts, strict=True)))


def merge(
    mixture: GaussianMixture, sums: Tensor, due: Tensor, config: UfMStarConfig, kernels: MergeKernels | None = None,
    near: Tensor | None = None,
) -> tuple[GaussianMixture, Tensor]:  # fmt: skip
    """Join, then dissolve; the remaining components move up and keep their order.

    Args:
        mixture: [B, K] in any frame: both rules are rigid invariants up to the choice of the cubature points.
        sums: [B, K, C] sums over the observations of each component.
        due: [B] True for the streams to merge; the others are unchanged.
        config: ``merge``, which is not None, and ``prior_weight``.
        kernels: implementation of each part; None = the reference.
        near: [B, K] True for the components to merge, which then follow the others; None = all.

    Returns:
        The mixture [B, K] and the sums. Components that neither joined nor received anything are unchanged to the last
        bit.
    """
    assert config.merge is not None
    kernels = kernels or REFERENCE
    every = mixture.tensors() | {"sums": sums}
    after = {name: value.clone() for name, value in every.items()}
    for b in due.nonzero().flatten().tolist():
        n = int(mixture.components[b])
        before = {name: v[b, :n].double() if v.is_floating_point() else v[b, :n] for name, v in every.items()}
        chosen = torch.ones(n, dtype=torch.bool, device=sums.device) if near is None else near[b, :n]
        chosen_ones = {name: value[chosen] for name, value in before.items()}
        joined = join(chosen_ones, config.merge.loss, mixture.covariance.dtype, kernels)
        for name, value in dissolve(joined, config, kernels).items():
            retained = torch.cat([before[name][~chosen], value])
            after[name][b] = 0
            after[name][b, : len(retained)] = retained.to(after[name].dtype)
    sums = after.pop("sums")
    return GaussianMixture(**after), sums


def join(g: Components, limit: float, stored: torch.dtype, kernels: MergeKernels) -> Components:
    """Join mutually best pairs, in rounds, until no pair is within the limit; the first of a pair holds the result.

    Args:
        g: n components.
        limit: largest loss l of a pair [nat].
        stored: dtype to which the joint covariances will be rounded.
        kernels: implementation of each part.
    """
    n = len(g["weight"])
    fresh = torch.ones(n, dtype=torch.bool, device=g["weight"].device)
    joined, pairs, loss = ~fresh, torch.zeros(2, 0, dtype=torch.int64, device=fresh.device), g["weight"][:0]
    while True:
        log_det = _log_det(g["covariance"])
        found = kernels.pairs(g["mean"], g["covariance"], g["weight"], g["views"], log_det, fresh, limit)
        pairs, loss = torch.cat([pairs, found[0]], 1), torch.cat([loss, found[1]])
        mutual = _mutual(pairs, loss, len(fresh))
        if not bool(mutual.any()):
            break
        stays, goes = pairs[:, mutual]
        first, second = ({name: value[which] for name, value in g.items()} for which in (stays, goes))
        common = _joint(first, second)
        fresh = torch.zeros_like(fresh).index_fill(0, stays, True)
        remains = torch.ones_like(fresh).index_fill(0, goes, False)
        g = {name: value.index_copy(0, stays, common[name])[remains] for name, value in g.items()}
        same = (remains & ~fresh)[pairs].all(0)
        pairs, loss = (remains.cumsum(0) - 1)[pairs[:, same]], loss[same]
        joined, fresh = (joined | fresh)[remains], fresh[remains]
    covariance = g["covariance"][joined]
    floored = floor_covariance(covariance, storage_floor(covariance, stored))
    return g | {"covariance": g["covariance"].index_copy(0, joined.nonzero().flatten(), floored)}


def close_pairs(
    mean: Tensor, covariance: Tensor, weight: Tensor, views: Tensor, log_det: Tensor, fresh: Tensor, limit: float
) -> tuple[Tensor, Tensor]:
    """Pairs i < j [2, P] within the limit with at least one ``fresh`` [n] component, and their losses [P]; ``log_det``
    [n] is log|Sigma|.

    A bound excludes most pairs without their determinant: log|Sigma| >= a log|Sigma_i| + b log|Sigma_j| +
    log(1 + a b q) with q >= d_x^2 / (a Sigma_i + b Sigma_j)_xx for every axis, so l > limit where
    q > (exp(2 min(a, b) limit) - 1) / (a b), which is at most 4 (exp(limit) - 1).
    """
    slot = torch.arange(len(fresh), device=fresh.device)
    reach, spread = 4 * math.expm1(limit) * (1 + 1e-9), torch.diagonal(covariance, dim1=-2, dim2=-1)
    found = [(slot[:0].expand(2, 0), weight[:0])]
    for i in slot[fresh].split(max(1, _CHUNK // max(1, len(fresh)))):
        close = ~fresh | (slot > i[:, None])  # a pair of two fresh components once
        share = weight[i, None] / (weight[i, None] + weight)
        for axis in range(3):
            variance = share * spread[i, None, axis] + (1 - share) * spread[:, axis]
            close &= (mean[i, None, axis] - mean[:, axis]).square() <= reach * variance
        row, j = close.nonzero().unbind(1)
        pair = torch.stack([torch.minimum(i[row], j), torch.maximum(i[row], j)])
        (first, second), d = weight[pair], mean[pair[0]] - mean[pair[1]]
        a, b = first / (first + second), second / (first + second)
        volume = (
            _log_det(_joint_covariance(covariance[pair[0]], covariance[pair[1]], a, b, d))
            - a * log_det[pair[0]]
            - b * log_det[pair[1]]
        )
        loss = 0.5 * volume / torch.minimum(a, b)
        lighter, heavier = (
            torch.where(first < second, views[one], views[other]) for one, other in (pair, pair.flip(0))
        )
        within = (loss <= limit) & ~((lighter > 0) & (heavier == 0))
        found.append((pair[:, within], loss[within]))
    return torch.cat([pair for pair, _ in found], 1), torch.cat([loss for _, loss in found])


def _mutual(pairs: Tensor, loss: Tensor, n: int) -> Tensor:
    """[P] True for mutually best pairs; a component's best partner has the least loss, on a tie the lowest index."""
    ends, others, twice = pairs.flatten(), pairs.flip(0).flatten(), loss.repeat(2)
    best = loss.new_full((n,), torch.inf).scatter_reduce(0, ends, twice, "amin")
    others = torch.where(twice == best[ends], others, n)
    partner = torch.full((n,), n, device=ends.device).scatter_reduce(0, ends, others, "amin")
    return (partner[pairs[0]] == pairs[1]) & (partner[pairs[1]] == pairs[0])


def _parts(g: Components, h: Components) -> tuple[Tensor, Tensor]:
    """a and 1 - a."""
    both = g["weight"] + h["weight"]
    return g["weight"] / both, h["weight"] / both


def _joint(g: Components, h: Components) -> Components:
    """The components with the joint moments of pairs."""
    a, b = _parts(g, h)

    def average(name: str) -> Tensor:
        shape = (-1, *[1] * (g[name].dim() - 1))
        return a.view(shape) * g[name] + b.view(shape) * h[name]

    joint = _joint_covariance(g["covariance"], h["covariance"], a, b, g["mean"] - h["mean"])
    compared = g["compared"] + h["compared"]
    weighted = g["compared"] * g["disagreement"] + h["compared"] * h["disagreement"]
    return {name: average(name) for name in ("mean", "features")} | {
        "covariance": joint,
        "disagreement": torch.where(compared > 0, weighted / compared, torch.zeros_like(weighted)),
        "reference": torch.where((a >= b)[:, None], g["reference"], h["reference"]),
        **{name: g[name] + h[name] for name in ("weight", "compared", "views", "sums")},
    }


def _joint_covariance(S: Tensor, T: Tensor, a: Tensor, b: Tensor, d: Tensor) -> Tensor:
    """[P, 3, 3] of pairs of covariances S and T, parts a and b, and difference d [P, 3] of the means."""
    a, b = a[:, None, None], b[:, None, None]
    return a * S + b * T + a * b * d[:, :, None] * d[:, None, :]


def _log_det(S: Tensor) -> Tensor:
    """log|S| of positive definite S [..., 3, 3], by the pivots of its Cholesky factor."""
    p0 = S[..., 0, 0]
    u, v = S[..., 1, 0] / p0, S[..., 2, 0] / p0
    p1 = S[..., 1, 1] - u * S[..., 1, 0]
    w = S[..., 2, 1] - v * S[..., 1, 0]
    p2 = S[..., 2, 2] - v * S[..., 2, 0] - w * w / p1
    return torch.log(p0 * p1 * p2)


def self_shares(g: Components, prior_weight: float, kernels: MergeKernels) -> Tensor:
    """[n] s_k, each component's mean weight share at its own cubature points, by the exact sum over the components."""
    whitening = inverse_lower3(cholesky3(g["covariance"]))
    sigma = torch.diagonal(g["covariance"], dim1=-2, dim2=-1).sqrt()
    log_peak = torch.diagonal(whitening, dim1=-2, dim2=-1).log().sum(-1) - 1.5 * math.log(2 * math.pi)
    log_peak = log_peak + g["weight"].log()
    arguments = _cubature(g), g["mean"], sigma, whitening, log_peak, prior_weight, _REACH, _LEAST_SHARE
    return (torch.exp(log_peak - 1.5)[:, None] / kernels.evidence(*arguments)).mean(1)


def evidence(
    points: Tensor, mean: Tensor, sigma: Tensor, whitening: Tensor, log_peak: Tensor, prior: float, reach: float,
    least: float,
) -> Tensor:  # fmt: skip
    """[n, 6] the sum of all components' densities and the ``prior`` weight at each component's cubature points.

    Args:
        points: [n, 6, 3], ``reach`` standard deviations from the means [m].
        mean, sigma: [n, 3] of the components; sigma along the axes [m].
        whitening: [n, 3, 3] L^-1 [1/m].
        log_peak: [n] log of the peak densities.
        prior: of the regression.
        reach: see ``points``.
        least: share of a component's density at its own points below which others are omitted there.
    """
    out = mean.new_full(points.shape[:2], prior)
    for i in torch.arange(len(mean), device=mean.device).split(max(1, _CHUNK // max(1, len(mean)))):
        # Component i has the density peak exp(-3/2) at its six points. Beyond ``radius`` standard deviations, the
        # density of another component falls below ``least`` of that.
        radius = (2 * (log_peak - log_peak[i, None] + 1.5 - math.log(least))).clamp_min(0).sqrt()
        near = torch.ones_like(radius, dtype=torch.bool)
        for axis in range(3):
            gap = (mean[i, None, axis] - mean[:, axis]).abs()
            near &= gap <= reach * sigma[i, None, axis] + radius * sigma[:, axis]
        row, k = near.nonzero().unbind(1)
        squared = ((points[i[row]] - mean[k, None]) @ whitening[k].mT).square().sum(-1)
        out.index_add_(0, i[row], torch.exp(log_peak[k, None] - 0.5 * squared))
    return out


@dataclass(frozen=True)
class MergeKernels:
    """The implementations of the replaceable parts.

    Attributes:
        pairs: see :func:`close_pairs`.
        evidence: see :func:`evidence`.
    """

    pairs: Callable[..., tuple[Tensor, Tensor]]
    evidence: Callable[..., Tensor]


REFERENCE = MergeKernels(close_pairs, evidence)


def _cubature(g: Components) -> Tensor:
    """[n, 6, 3] mu + sqrt(3) L e_i for i = 0, 1, 2, then mu - sqrt(3) L e_i [m]."""
    steps = _REACH * cholesky3(g["covariance"]).mT
    return g["mean"][:, None] + torch.cat([steps, -steps], dim=1)


def _mean_shares(g: Components, points: Tensor, config: UfMStarConfig) -> Tensor:
    """[P, n] shares of all components at points [P, 6, 3], their mean over the six."""
    mixture = GaussianMixture(**{name: value[None] for name, value in g.items() if name != "sums"})
    exact, parts = config.replace(regression="exact"), points.split(max(1, _CHUNK // (_POINTS * mixture.capacity)))
    share = torch.cat([shares(mixture, part.flatten(0, 1)[None], exact)[0] for part in parts])
    return total(share.unflatten(0, (-1, _POINTS)), 1) / _POINTS


def dissolve(g: Components, config: UfMStarConfig, kernels: MergeKernels) -> Components:
    """Remove the components whose share at their own points is small, and distribute their sums to the others."""
    assert config.merge is not None
    weak = self_shares(g, config.prior_weight, kernels) < config.merge.share
    if not bool(weak.any()):
        return g
    share = _mean_shares(g, _cubature(g)[weak], config) * ~weak
    rest = total(share, 1)
    enough = rest >= 1 - config.merge.share
    split = share[enough] / rest[enough, None]
    goes = weak.nonzero().flatten()[enough]

    # Averages, each with its weight; the others are sums.
    means = (("weight", "features"), ("compared", "disagreement"))
    products = [g[w][:, None] * g[name].view(len(weak), -1) for w, name in means]
    gifts = torch.cat([g["weight"][:, None], g["compared"][:, None], *products, g["sums"]], -1)[goes]
    gain = torch.stack([total(split * gift[:, None], 0) for gift in gifts.unbind(-1)], -1)
    weight, compared, *more, learnt = gain.split([1, 1, *(p.shape[1] for p in products), g["sums"].shape[1]], -1)
    after = g | {"sums": g["sums"] + learnt}
    for (w, name), gained, product, added in zip(means, (weight, compared), products, more, strict=True):
        after[w] = g[w] + gained[:, 0]
        mean = (product + added) / after[w].clamp_min(torch.finfo(gain.dtype).tiny)[:, None]
        after[name] = torch.where(gained > 0, mean, g[name].view(mean.shape)).view(g[name].shape)
    remains = torch.ones_like(weak).index_fill(0, goes, False)
    return {name: value[remains] for name, value in after.items()}

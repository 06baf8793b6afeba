"""Training losses: per-pixel negative log likelihoods and their mean over the valid pixels of a batch.

Gaussian: Kendall and Gal 2017, Eq. 8. Evidential: Amini et al. 2020, Eq. 8 to 10; torch-uncertainty's ``DERLoss`` is
not used, since on pixels it divides by the wrong number and has no mask. All computations are at least in float32, also
under autocast: the square of an error overflows float16 at 256 m, and bfloat16 has three digits.
"""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor

from ufmstar_torch.models.distribution import DepthDistribution, EvidentialDepth, GaussianDepth
from ufmstar_torch.runtime.kinds import check_kinds

# [1] The regulariser's lambda, the weight of evidence at wrong pixels.
EVIDENCE_WEIGHT = 0.01
# [log m^2] Log-variances are clamped to +-40 (standard deviations of 2 nm and 500,000 km), where exp(-s) times the
# square of an error of 10 km is far from float32's largest number.
_LOG_VARIANCE_LIMIT = 40.0
# [m^2] Added to squared errors before their logarithm: negligible, and far above float32's smallest normal number.
_SQUARE_FLOOR = 1e-30
# [1] Above this a, the series of log Gamma(a + 1/2) - log Gamma(a) is exact in float32 (its next term is below 5e-8);
# the difference of the functions is not: at a = 1e6 each is about 1e7.
_SERIES_FROM = 8.0


def loss_of(
    distribution: DepthDistribution, target: Tensor, valid: Tensor, *, evidence_weight: float = EVIDENCE_WEIGHT
) -> Tensor:
    """The distribution's loss, averaged over the pixels with ground truth.

    Depth without variance: |error| [m]. Gaussian: negative log likelihood [nat]. Evidential: negative log likelihood of
    its Student-t marginal, plus the evidence regulariser.

    Args:
        distribution: parameters, each [B, H, W].
        target: [B, H, W] ground truth depth [m]; ignored where not valid.
        valid: [B, H, W] bool, True = use; pixels whose target is not finite and positive are ignored, too.
        evidence_weight: lambda of :func:`evidential_loss`.

    Returns:
        A scalar. Without any valid pixel it is 0 and its gradient is 0 everywhere (not absent: a distributed run waits
        for every process's gradient).

    Raises:
        ValueError: shapes differ, ``valid`` is not bool, a weight is out of range.
    """
    total, count = loss_sums(distribution, target, valid, evidence_weight=evidence_weight)
    return total / count.clamp(min=1)


@check_kinds
def loss_sums(
    distribution: DepthDistribution, target: Tensor, valid: Tensor, *, evidence_weight: float = EVIDENCE_WEIGHT
) -> tuple[Tensor, Tensor]:
    """The sum of the loss over valid pixels and their number (int64); arguments as :func:`loss_of`.

    Processes that share a batch have unequal numbers of valid pixels, so the mean of their means is not the mean over
    the batch. With ``total`` the sum of all processes' counts, ``world`` the number of processes, and gradients
    averaged over processes (DistributedDataParallel), the loss ``sum * world / total`` in each process gives the
    gradient of the whole batch.
    """
    _check(distribution, target, valid, evidence_weight)
    usable = valid & target.isfinite() & (target > 0)

    def at_valid(values: Tensor, elsewhere: float = 1.0) -> Tensor:
        # Mask before the loss, because the gradient NaN times 0 is NaN.
        return torch.where(usable, values.to(torch.promote_types(values.dtype, torch.float32)), elsewhere)

    # Autocast does not change the dtype of the following operations, only of matrix products and convolutions.
    goal = at_valid(target)
    depth = at_valid(distribution.depth)
    if isinstance(distribution, GaussianDepth):
        loss = gaussian_nll(depth, at_valid(distribution.log_variance, 0.0), goal)
    elif isinstance(distribution, EvidentialDepth):
        nu, beta = at_valid(distribution.nu), at_valid(distribution.beta)
        loss = evidential_loss(depth, nu, at_valid(distribution.alpha, 2.0), beta, goal, evidence_weight)
    else:
        loss = depth_l1(depth, goal)
    return torch.where(usable, loss, 0.0).sum(), usable.sum()


def depth_l1(depth: Tensor, target: Tensor) -> Tensor:
    """|target - depth| [m] per pixel, FastDepth's loss."""
    return (target - depth).abs()


def gaussian_nll(depth: Tensor, log_variance: Tensor, target: Tensor) -> Tensor:
    """-log N(target; depth, exp(s)) = ((target - depth)^2 exp(-s) + s + log 2 pi) / 2 per pixel [nat].

    Args:
        depth: [...] mean [m].
        log_variance: [...] s, of the variance in m^2. Outside +-40, value and gradient are those at +-40.
        target: [...] [m].
    """
    s = log_variance + (log_variance.clamp(-_LOG_VARIANCE_LIMIT, _LOG_VARIANCE_LIMIT) - log_variance).detach()
    return 0.5 * ((target - depth).square() * (-s).exp() + s + math.log(2 * math.pi))


def evidential_nll(depth: Tensor, nu: Tensor, alpha: Tensor, beta: Tensor, target: Tensor) -> Tensor:
    """-log of the Student-t marginal of the Normal-Inverse-Gamma, per pixel [nat] (Amini et al. 2020, Eq. 8).

    St(target; depth, scale^2 = beta (1 + nu) / (nu alpha), 2 alpha degrees of freedom). With Omega = 2 beta (1 + nu)
    and e the error, Eq. 8 is rewritten to avoid cancellation and overflow:

        (log pi - log nu + log Omega) / 2 + (alpha + 1/2) log(1 + e^2 nu / Omega)
        + log Gamma(alpha) - log Gamma(alpha + 1/2)

    Args:
        depth: [...] gamma [m].
        nu, alpha: [...] positive.
        beta: [...] positive [m^2].
        target: [...] [m].
    """
    log_omega = math.log(2) + beta.log() + nu.log1p()
    log_ratio = ((target - depth).square() + _SQUARE_FLOOR).log() + nu.log() - log_omega
    scale = 0.5 * (math.log(math.pi) - nu.log() + log_omega)
    return scale + (alpha + 0.5) * F.softplus(log_ratio) - _log_gamma_half_step(alpha)


def evidential_loss(
    depth: Tensor, nu: Tensor, alpha: Tensor, beta: Tensor, target: Tensor, evidence_weight: float = EVIDENCE_WEIGHT
) -> Tensor:
    """:func:`evidential_nll` + evidence_weight |target - depth| (2 nu + alpha) per pixel (Eq. 9 and 10).

    The regulariser reduces the evidence where the depth is wrong, which the likelihood does not.
    """
    evidence = (target - depth).abs() * (2 * nu + alpha)
    return evidential_nll(depth, nu, alpha, beta, target) + evidence_weight * evidence


def _log_gamma_half_step(a: Tensor) -> Tensor:
    """log Gamma(a + 1/2) - log Gamma(a), a > 0, without cancellation for large a."""
    large = a > _SERIES_FROM
    big, small = torch.where(large, a, _SERIES_FROM), torch.where(large, 1.0, a)
    r = 1 / big
    series = 0.5 * big.log() - r / 8 + r**3 / 192
    return torch.where(large, series, torch.lgamma(small + 0.5) - torch.lgamma(small))


def _check(distribution: DepthDistribution, target: Tensor, valid: Tensor, evidence_weight: float) -> None:
    if valid.dtype != torch.bool:
        raise ValueError(f"valid must be bool (True = use), got {valid.dtype}")
    shape = distribution.depth.shape
    if target.shape != shape or valid.shape != shape:
        raise ValueError(
            f"target and valid must have the depth's shape {tuple(shape)}, got {tuple(target.shape)} and "
            f"{tuple(valid.shape)}"
        )
    if not evidence_weight >= 0:
        raise ValueError(f"evidence_weight must be >= 0, got {evidence_weight}")

"""Linear least squares that survives outliers: minimal samples, then trimmed refits.

Rousseeuw's least median of squares gives a start that up to half of the points may contradict (or Torr's MSAC, where
the largest residual of an inlier is known); least squares on the points near it, repeated, restores the efficiency
that a median lacks.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

# 256 pairs miss 30 % outliers with probability 1e-75, 256 triples 60 % outliers with 4e-8.
_HYPOTHESES = 256
# Points that judge a hypothesis; the median of 1024 is known to about 3 %.
_JUDGES = 1024
_REFITS = 10
# A normal residual's standard deviation per median of its magnitude, and the usual cut at 3 deviations.
_MAD_TO_STD = 1.4826
_CUT = 3.0
# Of the target's size: exact data leave residuals of float64 rounding, which must not be trimmed.
_ROUNDING = 1e-9
# Smallest eigenvalue of the Gram matrix with unit diagonal; 1e-10 is a relative spread of 1e-5, where what
# float32 predictions resolve (1e-7) still fixes a slope to 1 %.
_RANK = 1e-10


@dataclass(frozen=True)
class LinearFit:
    """target = design @ theta on the inliers."""

    theta: Tensor  # [B, p]
    inlier: Tensor  # [B, P] points used
    determined: Tensor  # [B] whether the inliers fix all p values


def least_squares(design: Tensor, target: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    """theta [B, p] (NaN where undetermined) = argmin sum_i weight_i (target_i - design_i . theta)^2 by the normal
    equations, and determined [B]; of design [B, P, p] in float64, as the condition is squared, target and weight [B,
    P], not negative."""
    weighted = design * weight[..., None]
    return solve_normal(weighted.mT @ design, (weighted.mT @ target[..., None])[..., 0])


def solve_normal(gram: Tensor, moment: Tensor) -> tuple[Tensor, Tensor]:
    """theta [..., p] of gram [..., p, p] theta = moment [..., p], NaN where undetermined, and determined [...]."""
    size = gram.diagonal(dim1=-2, dim2=-1).clamp_min(torch.finfo(gram.dtype).tiny).sqrt()
    unit = gram / (size[..., :, None] * size[..., None, :])
    determined = torch.linalg.eigvalsh(unit)[..., 0] > _RANK
    eye = torch.eye(unit.shape[-1], dtype=unit.dtype, device=unit.device)
    theta = torch.linalg.solve(torch.where(determined[..., None, None], unit, eye), moment / size) / size
    return torch.where(determined[..., None], theta, torch.nan), determined


def robust_fit(
    design: Tensor,
    target: Tensor,
    valid: Tensor,
    weight: Tensor,
    *,
    tolerance: Tensor | None = None,
    admissible: Callable[[Tensor], Tensor] | None = None,
    seed: int = 0,
) -> LinearFit:
    """A linear model of the points that agree; each row of the batch on its own, reproducibly.

    Args:
        design: [B, P, p].
        target: [B, P].
        valid: [B, P] points to use; every row needs at least p.
        weight: [B, P] inverse variances up to a common factor, positive where valid.
        tolerance: [B, P] largest residual of an inlier; None: three standard deviations, estimated from the
            median, which needs more than half of the points to follow the model. With a tolerance, the points
            within it are the majority, and what stands out among them is left out as well.
        admissible: whether theta [..., p] is possible at all, [...] bool.
        seed: of the samples.
    """
    unit = weight.sqrt() if tolerance is None else 1 / tolerance.clamp_min(torch.finfo(tolerance.dtype).tiny)
    # Residuals in units of their expected size (up to a factor), or of the tolerance.
    scaled, goal = design * unit[..., None], target * unit
    theta = _best_hypothesis(scaled, goal, valid, tolerance is not None, admissible, seed)
    inlier, determined = valid, valid.new_zeros(len(valid))
    for _ in range(_REFITS):
        previous, residual = inlier, (goal - (scaled @ theta[..., None])[..., 0]).abs()
        near = valid if tolerance is None else valid & (residual <= 1)
        inlier = near & (residual <= _cut(residual, goal, near, design.shape[-1]))
        refit, determined = least_squares(design, target, weight * inlier)
        theta = torch.where(determined[:, None], refit, theta)
        if torch.equal(inlier, previous):
            break
    return LinearFit(theta, inlier, determined)


def masked_median(value: Tensor, valid: Tensor) -> Tensor:
    """[...] the lower median of the valid entries along the last dimension; infinite where there are none."""
    return torch.where(valid, value, torch.nan).nanmedian(-1).values.nan_to_num(torch.inf)


def _best_hypothesis(
    design: Tensor,
    target: Tensor,
    valid: Tensor,
    bounded: bool,
    admissible: Callable[[Tensor], Tensor] | None,
    seed: int,
) -> Tensor:
    """theta [B, p] of the minimal sample with the smallest residuals: in the median, or where ``bounded`` in the sum
    of squares, each at most 1. The samples of a row do not depend on the others in the batch."""
    generator, unknowns = torch.Generator().manual_seed(seed), design.shape[-1]
    row = torch.arange(len(design), device=design.device)
    keys = torch.rand(valid.shape[1], generator=generator, dtype=torch.float64).to(design.device)
    judges = torch.where(valid, keys, -1.0).topk(min(_JUDGES, valid.shape[1])).indices  # valid ones first
    design, target, valid = (value[row[:, None], judges] for value in (design, target, valid))
    share = torch.rand(_HYPOTHESES, unknowns, generator=generator, dtype=torch.float64).to(design.device)
    chosen = (share * valid.sum(1)[:, None, None]).long()  # [B, N, p]
    sample = row[:, None, None], chosen
    theta, _ = torch.linalg.solve_ex(design[sample], target[sample])  # of repeated points: not finite, or judged bad
    usable = theta.isfinite().all(-1)
    theta = theta.nan_to_num()
    if admissible is not None:
        usable = usable & admissible(theta)
    residual = (target[:, None] - theta @ design.mT).abs()  # [B, N, P]
    if bounded:
        score = (residual.clamp_max(1).square() * valid[:, None]).sum(-1)
    else:
        score = masked_median(residual, valid[:, None].expand_as(residual))
    return theta[row, torch.where(usable, score, torch.inf).argmin(1)]


def _cut(residual: Tensor, target: Tensor, valid: Tensor, unknowns: int) -> Tensor:
    """[B, 1] the largest residual of an inlier."""
    freedom = (valid.sum(1) - unknowns).clamp_min(1)
    # Few points lie closer to their own fit than to the truth: Rousseeuw's correction.
    std = _MAD_TO_STD * (1 + 5 / freedom) * masked_median(residual, valid)
    return torch.maximum(_CUT * std, _ROUNDING * masked_median(target.abs(), valid))[:, None]

"""Linear least squares that survives outliers: minimal samples, then trimmed refits.

Rousseeuw's least median of squares finds a start that up to half of the points may contradict (or, where
the user knows how far an inlier may lie, Torr's MSAC does); least squares on the points near it, repeated,
gives back the efficiency that a median lacks.
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
    """target = design @ theta on the inliers.

    Attributes:
        theta: [B, p].
        inlier: [B, P] points used.
        determined: [B] whether the inliers fix all p values.
    """

    theta: Tensor
    inlier: Tensor
    determined: Tensor


def least_squares(design: Tensor, target: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    """argmin sum_i weight_i (target_i - design_i . theta)^2 by the normal equations.

    Args:
        design: [B, P, p]; use float64, the condition is squared.
        target: [B, P].
        weight: [B, P] >= 0.

    Returns:
        theta [B, p] (NaN where undetermined) and determined [B].
    """
    weighted = design * weight[..., None]
    gram = weighted.mT @ design
    size = gram.diagonal(dim1=-2, dim2=-1).clamp_min(torch.finfo(gram.dtype).tiny).sqrt()
    unit = gram / (size[..., :, None] * size[..., None, :])
    determined = torch.linalg.eigvalsh(unit)[..., 0] > _RANK
    eye = torch.eye(unit.shape[-1], dtype=unit.dtype, device=unit.device)
    solvable = torch.where(determined[..., None, None], unit, eye)
    theta = torch.linalg.solve(solvable, (weighted.mT @ target[..., None])[..., 0] / size) / size
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
    root = weight.sqrt()
    pick = _random_points(valid, min(_JUDGES, valid.shape[1]), seed)
    count = valid.sum(1).clamp_max(pick.shape[1])
    judge_design = design.gather(1, pick[..., None].expand(-1, -1, design.shape[-1]))
    judge_target, judge_root, judge_valid = (value.gather(1, pick) for value in (target, root, valid))
    bound = None if tolerance is None else tolerance.gather(1, pick)
    theta = _best_hypothesis(judge_design, judge_target, judge_root, judge_valid, count, bound, admissible, seed)
    inlier, determined = valid, valid.new_zeros(len(valid))
    # Residuals in units of their expected size (up to a factor), or of the tolerance.
    unit = root if tolerance is None else 1 / tolerance.clamp_min(torch.finfo(tolerance.dtype).tiny)
    for _ in range(_REFITS):
        previous, residual = inlier, (target - (design @ theta[..., None])[..., 0]).abs() * unit
        near = valid if tolerance is None else valid & (residual <= 1)
        inlier = near & (residual <= _cut(residual, target * unit, near, design.shape[-1]))
        refit, determined = least_squares(design, target, weight * inlier)
        theta = torch.where(determined[:, None], refit, theta)
        if torch.equal(inlier, previous):
            break
    return LinearFit(theta, inlier, determined)


def masked_median(value: Tensor, valid: Tensor) -> Tensor:
    """[...] the lower median of the valid entries along the last dimension; infinite where there are none."""
    return torch.where(valid, value, torch.nan).nanmedian(-1).values.nan_to_num(torch.inf)


def _random_points(valid: Tensor, number: int, seed: int) -> Tensor:
    """[B, number] indices, valid ones first, in random order; a row's choice does not depend on the batch."""
    generator = torch.Generator().manual_seed(seed)
    keys = torch.rand(valid.shape[1], generator=generator, dtype=torch.float64).to(valid.device)
    return torch.where(valid, keys, -1.0).topk(number, dim=1).indices


def _best_hypothesis(
    design: Tensor,
    target: Tensor,
    root: Tensor,
    valid: Tensor,
    count: Tensor,
    tolerance: Tensor | None,
    admissible: Callable[[Tensor], Tensor] | None,
    seed: int,
) -> Tensor:
    """theta [B, p] of the minimal sample that the judges like best."""
    unknowns = design.shape[-1]
    generator = torch.Generator().manual_seed(seed + 1)
    share = torch.rand(_HYPOTHESES, unknowns, generator=generator, dtype=torch.float64).to(design.device)
    chosen = (share * count[:, None, None]).long().clamp_max(design.shape[1] - 1).flatten(1)  # [B, N p]
    rows = design.gather(1, chosen[..., None].expand(-1, -1, unknowns)).unflatten(1, (-1, unknowns))
    values = target.gather(1, chosen).unflatten(1, (-1, unknowns))
    theta, _ = torch.linalg.solve_ex(rows, values)  # repeated points make singular systems: not finite, or judged bad
    usable = theta.isfinite().all(-1)
    if admissible is not None:
        usable = usable & admissible(theta)
    residual = (target[:, None] - theta.nan_to_num() @ design.mT).abs()
    if tolerance is None:
        score = masked_median(residual * root[:, None], valid[:, None].expand_as(residual))
    else:
        relative = (residual / tolerance.clamp_min(torch.finfo(tolerance.dtype).tiny)[:, None]).clamp_max(1)
        score = (relative.square() * valid[:, None]).sum(-1)
    best = torch.where(usable, score, torch.inf).argmin(1)
    return theta.nan_to_num()[torch.arange(len(theta), device=theta.device), best]


def _cut(residual: Tensor, target: Tensor, valid: Tensor, unknowns: int) -> Tensor:
    """[B, 1] the largest residual of an inlier."""
    freedom = (valid.sum(1) - unknowns).clamp_min(1)
    # Few points lie closer to their own fit than to the truth: Rousseeuw's correction.
    std = _MAD_TO_STD * (1 + 5 / freedom) * masked_median(residual, valid)
    return torch.maximum(_CUT * std, _ROUNDING * masked_median(target.abs(), valid))[:, None]

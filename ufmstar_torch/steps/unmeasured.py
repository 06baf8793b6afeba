"""Detects the pixels where M was not measured, and sets their M (``config.unmeasured``), before and after step 5.

A surface seen from one view has m = 0 because nothing was compared. Far from all components, M is the prior's mean. In
the paper both count as certain. The share of a pixel's M that rests on surfaces seen from different places,

    s(x) = sum of w_k(x) (1 - exp(-n_k))  with the number of views n_k (``views``),

is regressed as an additional feature. It is 0 for an image that shows nothing (``FrameInput.informative``). A pixel
counts as measured where s is at least one half.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from ufmstar_torch.config import UfMStarConfig
from ufmstar_torch.gaussians.mixture import GaussianMixture
from ufmstar_torch.steps.regress import Regression
from ufmstar_torch.steps.views import measured_share

HALF = 0.5


def before_regression(mixture: GaussianMixture) -> GaussianMixture:
    """The mixture [B, K] with an additional feature, the share 1 - exp(-n) to which a component is measured."""
    share = measured_share(mixture.views).to(mixture.features.dtype)
    return mixture.replace(features=torch.cat([mixture.features, share[..., None]], dim=-1))


def after_regression(
    result: Regression, depth: Tensor | None, config: UfMStarConfig, informative: Tensor | None = None
) -> tuple[Regression, Tensor]:
    """Separate the share s from the regressed features, and set M where it was not measured.

    Args:
        result: of the mixture of :func:`before_regression`.
        depth: of the same pixels [m]; None = points without a depth, for which "relative" acts as "nan".
        config: of UfM*.
        informative: [B] False for the streams whose image shows nothing; None = all True.

    Returns:
        The regression without the share, and s, NaN where not valid.
    """
    measured = result.features[..., -1]
    if informative is not None:
        measured = measured * informative.view(-1, *[1] * (measured.dim() - 1)).to(measured.dtype)
    disagreement = result.disagreement
    if config.unmeasured == "nan" or (config.unmeasured == "relative" and depth is None):
        disagreement = torch.where(measured < HALF, torch.nan, disagreement)
    elif config.unmeasured == "relative" and depth is not None:
        share = (1 - measured).clamp_min(0)
        disagreement = disagreement.add(share * depth * depth, alpha=config.unmeasured_relative**2)
    return replace(result, disagreement=disagreement, features=result.features[..., :-1]), measured

"""Maps with a known error, and the metrics by kind."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from ufmstar_torch.eval.metrics import (
    NLL,
    DepthAccuracy,
    ECEDelta,
    ECEQuantile,
    EntropyHistogram,
    NLLByError,
    Sparsification,
    SpearmanCorrelation,
)
from ufmstar_torch.eval.metrics.base import SumMetric

RANKING = [Sparsification, SpearmanCorrelation, NLLByError]

ALL = [DepthAccuracy, NLL, ECEDelta, ECEQuantile, EntropyHistogram, *RANKING]

UNCERTAIN = ALL[1:]

JUDGED = [kind for kind in ALL if kind is not EntropyHistogram]  # on pixels with ground truth alone


def maps(*shape: int, seed: int = 0, scale: float = 1.0) -> tuple[Tensor, Tensor, Tensor]:
    """Depth, variance and ground truth with g ~ N(d, scale^2 v) [float64]."""
    rng = np.random.default_rng(seed)
    depth = rng.uniform(2.0, 6.0, shape)
    variance = rng.uniform(0.05, 1.0, shape) ** 2 * (depth / 6) ** 2
    target = np.maximum(depth + scale * np.sqrt(variance) * rng.standard_normal(shape), 0.01)
    return torch.tensor(depth), torch.tensor(variance), torch.tensor(target)


def figures(metric: SumMetric, *args: Tensor | None) -> dict[str, Tensor]:
    metric.update(*args)
    return metric.compute()

"""The pixels of which a reference method is confident, for the figure of NLL by error.

The paper looks at the pixels where the ensemble (left panel) or UfM-Ensemble (right) is confident and shows what the
other methods say there. Which pixels these are it leaves open; here, of every frame, the share ``confident`` of the
reference's pixels with the smallest variance. All rows on the same frames are judged on the same pixels.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from ufmstar_torch.eval.engine.estimators import Estimate
from ufmstar_torch.eval.methods.method import ALONE, UFM
from ufmstar_torch.eval.methods.row import Row


def references(row: Row, rows: Sequence[Row]) -> list[Row]:
    """Whose confidence a row is judged by: its base alone, and behind UfM with the fewest points that are among
    ``rows`` and see the same frames; of several settings the row's own, or else the default."""
    same = [other for other in rows if other.method.base == row.method.base and _frames(other) == _frames(row)]
    alone = [other for other in same if other.method.fusion == ALONE and other.method.uses_aleatoric]
    pointwise = [other for other in same if other.method.fusion == UFM and not other.method.full]
    fewest = min((_points(other) for other in pointwise), default=0)
    chosen = []
    for kind in (alone, [other for other in pointwise if _points(other) == fewest]):
        if kind:
            chosen.append(
                min(kind, key=lambda other: (other.setting.pose_noise != row.setting.pose_noise, other.setting.slug))
            )
    return chosen


def confident_pixels(estimate: Estimate, truth: Tensor, share: float) -> Tensor:
    """[h, w] bool, of the pixels with ground truth [h, w] [m] (0 = none) those whose variance is at or below the
    frame's ``share`` quantile, in (0, 1]."""
    assert estimate.variance is not None
    judged = estimate.valid & (truth > 0)
    values = estimate.variance[judged]
    if not len(values):
        return judged
    threshold = values.kthvalue(max(1, math.ceil(share * len(values)))).values
    return judged & (torch.where(judged, estimate.variance, torch.inf) <= threshold)


def _frames(row: Row) -> tuple[int, str]:
    """What decides which frames a row sees, and which part of them."""
    return row.setting.skip, row.setting.preprocess


def _points(row: Row) -> float:
    return math.inf if row.method.max_points is None else row.method.max_points

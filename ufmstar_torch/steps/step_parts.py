"""The replaceable parts of a step: their interfaces, and the reference implementation."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from torch import Tensor

from ufmstar_torch.config import UfMStarConfig
from ufmstar_torch.gaussians import gaussian
from ufmstar_torch.gaussians.mixture import GaussianMixture
from ufmstar_torch.steps import correspond, fuse, regress, segment
from ufmstar_torch.steps.correspond import Correspondence
from ufmstar_torch.steps.regress import Regression
from ufmstar_torch.steps.segment_input import SegmentInput


class StepObserver(Protocol):
    """Receives the end of each stage of a step, to time it; it changes no result."""

    def stage(self, name: str) -> None:
        """Called at the end of a stage: check, segment, correspond, fuse, append, regress or average, in this order.

        Work between two kernels belongs to the later stage. segment: SPGF and the floor of its covariances.
        correspond: the transformation of the mixture into the camera frame, and the matching. fuse: the disagreement of
        overlaps, the transformation of the segments into the first camera's frame, growth, and the fusion. append: the
        new components, the transformation of the mixture into the camera frame, and the columns of anchors. regress:
        the regression. average: the moving average, statistics and the new state. The caller of the step ends "check".
        """
        ...


# C_i in the camera frame, and labels [B, H, W].
SegmentKernel = Callable[[SegmentInput], tuple[GaussianMixture, Tensor]]


@dataclass(frozen=True)
class Kernels:
    """The replaceable parts of :func:`step`. Signatures as in ``REFERENCE``; all inputs are checked."""

    spgf: SegmentKernel  # step 2, without a floor
    floor_covariance: Callable[[Tensor, Tensor], Tensor]
    correspond: Callable[[GaussianMixture, GaussianMixture, Tensor, tuple[int, int], UfMStarConfig], Correspondence]
    fuse: Callable[..., GaussianMixture]
    regress_image: Callable[..., Regression]


REFERENCE = Kernels(
    spgf=segment.segment,
    floor_covariance=gaussian.floor_covariance,
    correspond=correspond.correspond,
    fuse=fuse.fuse,
    regress_image=regress.regress_image,
)

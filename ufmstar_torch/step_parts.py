"""The replaceable parts of a step: what each computes, and the reference implementation of all."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from torch import Tensor

from ufmstar_torch import correspond, fuse, gaussian, regress, segment
from ufmstar_torch.config import UfMStarConfig
from ufmstar_torch.correspond import Correspondence
from ufmstar_torch.mixture import GaussianMixture
from ufmstar_torch.regress import Regression
from ufmstar_torch.segment_input import SegmentInput


class StepObserver(Protocol):
    """Follows a step from stage to stage, to time it; it changes no result."""

    def stage(self, name: str) -> None:
        """A stage has ended: check, segment, correspond, fuse, append, regress or average, in this order.

        Work between two kernels belongs to the stage that needs it. segment: SPGF and the floor of its
        covariances. correspond: the mixture into the camera frame, and the matching. fuse: the disagreement of
        overlaps, the segments into the first camera's frame, growth, and the fusion. append: the new components, the
        mixture into the camera frame, and the columns of extensions. regress: the regression. average: the moving
        average, statistics and the new state. The caller of a step ends "check" itself.
        """
        ...


# Step 2: C_i in the camera frame without a floor, and labels [B, H, W] (segment.segment).
SegmentKernel = Callable[[SegmentInput], tuple[GaussianMixture, Tensor]]
# Covariances [..., 3, 3] whose eigenvalues are at least a floor [...] [m^2] (gaussian.floor_covariance).
FloorKernel = Callable[[Tensor, Tensor], Tensor]
# Step 3: M_(i-1) and C_i in the camera frame, K, (H, W) -> pairs (correspond.correspond).
CorrespondKernel = Callable[[GaussianMixture, GaussianMixture, Tensor, tuple[int, int], UfMStarConfig], Correspondence]


class FuseKernel(Protocol):
    """Step 4 for the matched pairs (:func:`ufmstar_torch.fuse.fuse`)."""

    def __call__(
        self,
        mixture: GaussianMixture,
        current: GaussianMixture,
        pairs: Correspondence,
        config: UfMStarConfig,
        /,
        *,
        rounds: int | None = None,
    ) -> GaussianMixture: ...


class RegressKernel(Protocol):
    """Step 5 at every pixel, or at some (:func:`ufmstar_torch.regress.regress_image`)."""

    def __call__(
        self,
        mixture_cam: GaussianMixture,
        depth: Tensor,
        intrinsics: Tensor,
        valid: Tensor,
        config: UfMStarConfig,
        /,
        pixels: Tensor | None = None,
    ) -> Regression: ...


@dataclass(frozen=True)
class Kernels:
    """The replaceable parts of :func:`step`; all take checked input."""

    spgf: SegmentKernel
    floor_covariance: FloorKernel
    correspond: CorrespondKernel
    fuse: FuseKernel
    regress_image: RegressKernel


REFERENCE = Kernels(
    spgf=segment.segment,
    floor_covariance=gaussian.floor_covariance,
    correspond=correspond.correspond,
    fuse=fuse.fuse,
    regress_image=regress.regress_image,
)

"""The replaceable parts of a step: what each computes, and the reference implementation of all."""

from __future__ import annotations

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


class SegmentKernel(Protocol):
    """Step 2: C_i in the camera frame without a floor, and labels [B, H, W] (:func:`ufmstar_torch.segment.segment`)."""

    def __call__(self, given: SegmentInput, /) -> tuple[GaussianMixture, Tensor]: ...


class FloorKernel(Protocol):
    """Covariances [..., 3, 3] whose eigenvalues are at least a floor [...] [m^2]
    (:func:`ufmstar_torch.gaussian.floor_covariance`)."""

    def __call__(self, covariance: Tensor, floor: Tensor, /) -> Tensor: ...


class CorrespondKernel(Protocol):
    """Step 3: M_(i-1) and C_i in the camera frame, K, (H, W) -> pairs (:func:`ufmstar_torch.correspond.correspond`)."""

    def __call__(
        self,
        previous_cam: GaussianMixture,
        current_cam: GaussianMixture,
        intrinsics: Tensor,
        size: tuple[int, int],
        config: UfMStarConfig,
        /,
    ) -> Correspondence: ...


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


class SmoothKernel(Protocol):
    """Memory, map, alpha -> new memory, map to show (:func:`ufmstar_torch.regress.smooth`)."""

    def __call__(self, previous: Tensor, current: Tensor, alpha: float, /) -> tuple[Tensor, Tensor]: ...


class DistributeKernel(Protocol):
    """Values at points, summed by component (:func:`ufmstar_torch.regress.distribute`)."""

    def __call__(
        self, mixture_cam: GaussianMixture, points: Tensor, values: Tensor, config: UfMStarConfig, /
    ) -> Tensor: ...


@dataclass(frozen=True)
class Kernels:
    """The replaceable parts of :func:`step`; all take checked input."""

    spgf: SegmentKernel
    floor_covariance: FloorKernel
    correspond: CorrespondKernel
    fuse: FuseKernel
    regress_image: RegressKernel
    smooth: SmoothKernel
    distribute: DistributeKernel


REFERENCE = Kernels(
    spgf=segment.segment,
    floor_covariance=gaussian.floor_covariance,
    correspond=correspond.correspond,
    fuse=fuse.fuse,
    regress_image=regress.regress_image,
    smooth=regress.smooth,
    distribute=regress.distribute,
)

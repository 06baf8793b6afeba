"""One image through steps 2 to 5: a pure function from state and frame to state and output.

The mixture is kept in the frame of each stream's first camera: poses are taken relative to it in
float64, so large world coordinates never reach the float32 state, and what a frame does not update never changes.

:class:`Step` is what ``UfMStar`` calls; :func:`step` is the reference. Its kernels can be replaced one by one
(:class:`Kernels`); another implementation of the whole step has the same signature.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass, fields
from functools import partial
from typing import Any, Protocol

import torch
from torch import Tensor

from ufmstar_torch import correspond, fuse, gaussian, regress, segment, unmeasured
from ufmstar_torch.anchors.hook import AnchorInput, Evidence, after_regression, before_regression, learn
from ufmstar_torch.camera import focal_and_centre, relative_pose
from ufmstar_torch.config import UfMStarConfig
from ufmstar_torch.correspond import Correspondence
from ufmstar_torch.disagree import with_overlap_disagreement
from ufmstar_torch.frame import FrameInput
from ufmstar_torch.gaussian import pixel_footprint, storage_floor
from ufmstar_torch.mixture import GaussianMixture
from ufmstar_torch.output import FrameStatistics, StepOutput, given
from ufmstar_torch.regress import Regression, moving_average
from ufmstar_torch.segment_input import SegmentInput
from ufmstar_torch.state import UfMStarState


class StepObserver(Protocol):
    """Follows a step from stage to stage, to time it; it changes no result."""

    def stage(self, name: str) -> None:
        """A stage has ended: check, segment, correspond, fuse, append, regress or average, in this order.

        What lies between two kernels belongs to the stage that needs it. segment: SPGF and the floor of its
        covariances. correspond: the mixture into the camera frame, and the matching. fuse: the disagreement of
        overlaps, the segments into the first camera's frame, growth, and the fusion. append: the new components, the
        mixture into the camera frame, and the evidence of anchors. regress: the regression. average: the moving
        average, statistics and the new state. The caller of a step ends "check" itself.
        """
        ...

    def kernel(self, name: str) -> AbstractContextManager[object]:
        """Around the kernel of this name, a field of :class:`Kernels`.

        A compiled step names spgf, correspond, fuse (which appends as well) and regress_image.
        """
        ...


class Step(Protocol):
    """One image through steps 2 to 5; see :func:`step`."""

    def __call__(
        self,
        state: UfMStarState,
        frame: FrameInput,
        config: UfMStarConfig,
        *,
        pixels: Tensor | None = None,
        smooth: bool = True,
        anchors: AnchorInput | None = None,
        observer: StepObserver | None = None,
    ) -> tuple[UfMStarState, StepOutput]: ...


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

    def observed(self, observer: StepObserver) -> Kernels:
        """The same kernels, with the observer around every call."""

        def around(name: str, kernel: Callable[..., Any]) -> Callable[..., Any]:
            def call(*args: Any, **kwargs: Any) -> Any:
                with observer.kernel(name):
                    return kernel(*args, **kwargs)

            return call

        kernels: dict[str, Any] = {f.name: around(f.name, getattr(self, f.name)) for f in fields(self)}
        return Kernels(**kernels)


REFERENCE = Kernels(
    spgf=segment.segment,
    floor_covariance=gaussian.floor_covariance,
    correspond=correspond.correspond,
    fuse=fuse.fuse,
    regress_image=regress.regress_image,
    smooth=regress.smooth,
    distribute=regress.distribute,
)


def step(
    state: UfMStarState,
    frame: FrameInput,
    config: UfMStarConfig,
    *,
    pixels: Tensor | None = None,
    smooth: bool = True,
    anchors: AnchorInput | None = None,
    observer: StepObserver | None = None,
    kernels: Kernels = REFERENCE,
) -> tuple[UfMStarState, StepOutput]:
    """Segment, correspond, fuse, regress (section "Uncertainty from Motion*", steps 2 to 5).

    Args:
        state: of the previous image; not modified.
        frame: checked input of B streams.
        config: of UfM*.
        pixels: [B, n] indices into the flattened image to regress only there; None = every pixel.
        smooth: apply the exponential moving average.
        anchors: of this frame; only with ``config.anchors``.
        observer: is called after every stage and around every kernel.
        kernels: which implementation of each part.

    Returns:
        The new state and the output. A stream whose frame is at fault keeps its state and gets NaN.
    """
    stage = _unobserved
    if observer is not None:
        stage, kernels = observer.stage, kernels.observed(observer)
    fine = frame.fault == 0
    first = torch.where((fine & ~state.started)[:, None, None], frame.T_world_cam, state.T_world_first)

    current_cam, labels = _segment(frame, config, kernels, state.covariance.dtype)
    stage("segment")

    mixture = state.mixture
    R_cam, t_cam = relative_pose(first, frame.T_world_cam)
    previous_cam = mixture.to(torch.float64).rigid(R_cam, t_cam)
    pairs = kernels.correspond(previous_cam, current_cam, frame.intrinsics, frame.size, config)
    stage("correspond")

    if config.disagreement == "overlap":
        pairs = with_overlap_disagreement(pairs, previous_cam, current_cam)
    matched = pairs.match.any(dim=2)
    # What is nearer than the near plane could never be matched again: it is not remembered.
    far_enough = current_cam.mean[..., 2] > config.near_plane
    new = current_cam.valid & far_enough & ~matched
    current_first = current_cam.rigid(*relative_pose(frame.T_world_cam, first))
    needed, rounds = _room(mixture, pairs, new, config)
    mixture = mixture.grown(needed, config.max_components)
    mixture = kernels.fuse(mixture, current_first, pairs.padded(mixture.capacity), config, rounds=rounds)
    stage("fuse")

    mixture, dropped = fuse.append(mixture, current_first, new)
    evidence, used, mixture_cam, stream = before_regression(
        Evidence(state.evidence, state.overall_evidence), mixture.to(torch.float64).rigid(R_cam, t_cam),
        frame, anchors, config, functools.partial(learn, distribute=kernels.distribute),
    )  # fmt: skip
    mixture_cam = unmeasured.before_regression(mixture_cam)
    stage("append")

    result = kernels.regress_image(mixture_cam, frame.depth, frame.intrinsics, frame.valid, config, pixels)
    result, residual, measured = after_regress(result, stream, frame, config, pixels)
    stage("regress")

    counts = {
        "components": mixture.components,
        "segments": current_cam.components,
        "matched": matched.sum(1),
        "pairs": pairs.match.sum((1, 2)),
        "new": new.sum(1) - dropped,
        "dropped": dropped + (current_cam.valid & ~far_enough).sum(1),
        "valid_pixels": frame.valid.sum((1, 2)),
        "unmeasured": (measured < unmeasured.HALF).flatten(1).sum(1),
        "anchors": torch.zeros_like(used) if anchors is None else anchors.valid.sum(1),
        "anchors_used": used,
    }
    disagreement, smoothed = result.disagreement, state.smoothed
    if smooth and config.ema_alpha < 1.0:
        smoothed, disagreement = moving_average(
            smoothed, disagreement, frame.size, config.ema_alpha, pixels, kernels.smooth
        )
    updated = after_frame(state, frame, mixture.tensors(), first, smoothed, evidence)
    out = StepOutput(
        disagreement, result.features, residual, measured, partial(given, labels), current_cam,
        frame_statistics(frame, counts),
    )  # fmt: skip
    stage("average")
    return updated, out


def after_regress(
    result: Regression, stream: Tensor | None, frame: FrameInput, config: UfMStarConfig, pixels: Tensor | None
) -> tuple[Regression, Tensor | None, Tensor]:
    """Separate what was regressed beside the disagreement, and fill in what was not measured.

    Args:
        result: of the mixture as ``anchors.hook`` and ``unmeasured`` made it ready.
        stream: from ``anchors.hook.before_regression``.
        frame, config, pixels: as :func:`step`.

    Returns:
        The regression of M and the caller's features; the residual and the share that was measured, as in
        :class:`~ufmstar_torch.output.StepOutput`.
    """
    depth = frame.depth
    if pixels is not None and config.unmeasured == "relative":  # nothing else reads it
        depth = torch.gather(depth.flatten(1), 1, pixels)
    result, measured = unmeasured.after_regression(result, depth, config)
    result, residual = after_regression(result, stream)
    return result, residual, measured


def frame_statistics(frame: FrameInput, counts: Mapping[str, Tensor]) -> FrameStatistics:
    """The statistics of a frame, of which the step counted ``counts`` and the check the others."""
    return FrameStatistics(
        **counts,
        beyond=frame.beyond,
        out_of_range=frame.out_of_range,
        fault=frame.fault,
        rotation_deviation=frame.rotation_deviation,
    )


def after_frame(
    state: UfMStarState, frame: FrameInput, mixture: dict[str, Tensor], first: Tensor, smoothed: Tensor,
    evidence: Evidence,
) -> UfMStarState:  # fmt: skip
    """The state after a frame: the mixture's tensors, the first camera's pose, the moving average and the evidence are
    given; a frame at fault counts as skipped."""
    fine = frame.fault == 0
    return UfMStarState(
        **mixture,
        T_world_first=first,
        started=state.started | fine,
        frames=state.frames + fine,
        skipped=state.skipped + ~fine,
        smoothed=smoothed,
        evidence=evidence.component,
        overall_evidence=evidence.overall,
        posterior=state.posterior,
    )


def _unobserved(name: str) -> None:
    """Without an observer nothing happens between stages."""


def _segment(
    frame: FrameInput, config: UfMStarConfig, kernels: Kernels, stored: torch.dtype
) -> tuple[GaussianMixture, Tensor]:
    """Step 2: C_i in the camera frame, float64, and its labels.

    SPGF's raw moments have no floor, and an exactly flat surface is singular. Eigenvalues are lifted to
    the variance across one pixel at that depth, (z/f)^2/12: the depth map resolves nothing finer. A covariance that is
    far longer than thick (``config.aleatoric_in_moments`` with a large A) would lose its least eigenvalue in the dtype
    ``stored`` of the mixture; it is lifted to what that dtype holds, as the fusion does.
    """
    mixture, labels = kernels.spgf(SegmentInput.of_frame(frame, config))
    mixture = mixture.to(torch.float64)
    fx, fy, _, _ = focal_and_centre(frame.intrinsics)
    # Nearer than the near plane nothing is ever matched; the footprint there keeps the floor above zero.
    z = mixture.mean[..., 2].clamp_min(config.near_plane)
    floor = pixel_footprint(z, torch.minimum(fx, fy)[:, None])
    floor = torch.maximum(floor, storage_floor(mixture.covariance, stored))
    floor = torch.where(mixture.valid, floor, torch.zeros_like(floor))  # an empty slot holds zeros
    return mixture.replace(covariance=kernels.floor_covariance(mixture.covariance, floor)), labels


def _room(
    mixture: GaussianMixture, pairs: Correspondence, new: Tensor, config: UfMStarConfig
) -> tuple[int, int | None]:
    """Slots that the frame needs, and a bound on the matches of any one component (None: the kernel reads it).

    This is the step's only wait for an accelerator: one small read, which growth needs. With a capacity that cannot
    grow nothing is read and the static bounds serve.

    Raises:
        ValueError: growth on the meta device, which has no values.
    """
    device, limit = mixture.mean.device.type, config.max_components
    if device != "cpu" and limit is not None and mixture.capacity >= limit:
        return mixture.capacity, pairs.match.shape[1]
    if device == "meta":
        raise ValueError("device 'meta' needs max_components <= initial_capacity")
    needed = mixture.components + new.sum(1)
    if device == "cpu":
        return int(needed.max()), None
    slots, most = torch.stack([needed, pairs.match.sum(1).amax(1)]).amax(1).tolist()
    return slots, most

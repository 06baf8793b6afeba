"""Steps 2 to 5 for one image: a pure function from state and frame to state and output.

The mixture is stored in the frame of each stream's first camera. Poses are converted to that frame in float64, so large
world coordinates never reach the float32 state, and components that a frame does not update never change.

``UfMStar`` calls a :class:`Step`; :func:`step` is the reference. Its kernels can be replaced individually
(:class:`Kernels`); another implementation of the whole step has the same signature.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from ufmstar_torch.anchors import learn as anchors
from ufmstar_torch.config import SPGFConfig, UfMStarConfig
from ufmstar_torch.frames.frame import FrameInput
from ufmstar_torch.frames.output import FrameStatistics, UncertaintyOutput
from ufmstar_torch.gaussians import gaussian
from ufmstar_torch.gaussians.camera import focal_and_centre, relative_pose
from ufmstar_torch.gaussians.gaussian import pixel_footprint, storage_floor
from ufmstar_torch.gaussians.mixture import GaussianMixture
from ufmstar_torch.gaussians.state import UfMStarState
from ufmstar_torch.steps import correspond, fuse, regress, segment
from ufmstar_torch.steps.correspond import Correspondence
from ufmstar_torch.steps.regress import Regression


class StepObserver(Protocol):
    """Receives the end of each stage of a step, to time it; it changes no result."""

    def stage(self, name: str) -> None:
        """Called at the end of a stage: check, segment, correspond, fuse, append, regress or average, in this order.

        Work between two kernels belongs to the later stage. segment: SPGF and the floor of its covariances.
        correspond: the transformation of the mixture into the camera frame, and the matching. fuse: the transformation
        of the segments into the first camera's frame, growth, and the fusion. append: the new components, the
        transformation of the mixture into the camera frame, and the columns of anchors. regress: the regression.
        average: the moving average, statistics and the new state. The caller of the step ends "check".
        """
        ...


# C_i in the camera frame, and labels [B, H, W].
SegmentKernel = Callable[[Tensor, Tensor, SPGFConfig, Tensor | None], tuple[GaussianMixture, Tensor]]


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


class Step(Protocol):
    """Steps 2 to 5 for one image; see :func:`step`."""

    def __call__(
        self, state: UfMStarState, frame: FrameInput, config: UfMStarConfig, *, pixels: Tensor | None = None,
        observer: StepObserver | None = None,
    ) -> tuple[UfMStarState, UncertaintyOutput]: ...  # fmt: skip


def step(
    state: UfMStarState, frame: FrameInput, config: UfMStarConfig, *, pixels: Tensor | None = None,
    observer: StepObserver | None = None, kernels: Kernels = REFERENCE, grow: bool = True,
) -> tuple[UfMStarState, UncertaintyOutput]:  # fmt: skip
    """Segment, correspond, fuse, regress (section "Uncertainty from Motion*", steps 2 to 5).

    Args:
        state: of the previous image; not modified.
        frame: checked input of B streams.
        config: of UfM*.
        pixels: [B, n] indices into the flattened image to regress only there, without the moving average; None = every
            pixel.
        observer: called after every stage.
        kernels: implementation of each part.
        grow: whether the mixture may get more slots; False: the caller has provided enough.

    Returns:
        The new state, and the output with the variance M, or M + B with anchors; without A and E. For a stream with a
        faulty frame, the state is unchanged and the output is NaN.
    """
    stage = unobserved if observer is None else observer.stage
    fine = frame.fault == 0
    first = torch.where((fine & ~state.started)[:, None, None], frame.T_world_cam, state.T_world_first)

    current_cam = _segment(frame, config, kernels, state.covariance.dtype)
    stage("segment")

    to_camera, to_first = relative_pose(first, frame.T_world_cam), relative_pose(frame.T_world_cam, first)
    previous_cam = state.mixture.to(torch.float64).rigid(*to_camera)
    pairs = kernels.correspond(previous_cam, current_cam, frame.intrinsics, frame.size, config)
    stage("correspond")

    # A Gaussian nearer than the near plane is not appended: it could never be matched.
    far_enough = current_cam.mean[..., 2] > config.near_plane
    new = current_cam.valid & far_enough & ~pairs.match.any(2)
    current_first, view = current_cam.rigid(*to_first), _view(frame, to_first[1])
    needed, rounds = _room(state.mixture, pairs, new, config, grow)
    mixture = state.mixture.grown(needed, config.max_components)
    mixture = kernels.fuse(mixture, current_first, pairs.padded(mixture.capacity), view, config, rounds=rounds)
    stage("fuse")

    sums, limit, gone = dict(state.by_component), config.max_components, torch.zeros_like(state.frames)
    if limit is not None and needed >= limit:
        mixture, sums, _, gone = fuse.make_room(mixture, sums, mixture.components, new.sum(1), to_first[1], limit)
    mixture, without_slot = fuse.append(mixture, current_first, new, view, config)
    mixture_cam = mixture.to(torch.float64).rigid(*to_camera)
    learnt = None
    if config.anchors is not None:
        learnt = anchors.learn({**state.by_stream, **sums}, mixture_cam, frame, config, regress.distribute)
    stage("append")

    maps, residual = _regress(mixture_cam, frame, config, kernels, pixels, learnt)
    stage("regress")

    smoothed = state.smoothed
    if pixels is None and config.ema_alpha < 1.0:
        memory = regress.memory_for(smoothed, frame.size)
        smoothed, maps["disagreement"] = regress.smooth(memory, maps["disagreement"], config.ema_alpha)
    dropped = gone + without_slot + (current_cam.valid & ~far_enough).sum(1)
    counts = _counts(mixture, current_cam, pairs, maps["measured"], new.sum(1) - without_slot, dropped)
    of_anchors = {} if learnt is None else learnt.tensors()
    updated = state.with_tensors({
        **mixture.tensors(), **sums, **of_anchors, "T_world_first": first, "started": state.started | fine,
        "frames": state.frames + fine, "skipped": state.skipped + ~fine, "smoothed": smoothed,
    })  # fmt: skip
    maps |= {"depth": regress.at_pixels(frame.depth, pixels), "valid": regress.at_pixels(frame.valid, pixels)}
    out = step_output(frame, maps, residual, counts, learnt)
    stage("average")
    return updated, out


def step_output(
    frame: FrameInput, maps: dict[str, Tensor], residual: Tensor | None, counts: Mapping[str, Tensor],
    learnt: anchors.Learnt | None = None,
) -> UncertaintyOutput:  # fmt: skip
    """The output of a step from its maps, and from the check of the frame and its anchors.

    Args:
        frame: of B streams.
        maps: "depth", "valid", "disagreement", "measured" and "features" of every pixel, or [B, n] at some; changed.
        residual: [..., 2] the relative error r and its excess e that anchors let expect; None without anchors.
        counts: of the step, by name.
        learnt: from the anchors; None without.
    """
    depth, valid, variance = maps.pop("depth"), maps.pop("valid"), maps["disagreement"]
    if residual is not None:
        maps["bias"], excess = residual.unbind(-1)
        contradiction = None if frame.anchors is None else frame.anchors.contradiction
        maps["anchored"], variance = anchors.anchored_term(depth, excess, variance, contradiction)
    checked = {
        "valid_pixels": frame.valid_pixels, "beyond": frame.beyond, "out_of_range": frame.out_of_range,
        "fault": frame.fault, "rotation_deviation": frame.rotation_deviation,
    }  # fmt: skip
    of_anchors = {} if learnt is None else anchors.counts(frame.anchors, learnt.used)
    statistics = FrameStatistics({**counts, **checked, **of_anchors})
    return UncertaintyOutput(depth, variance, valid, maps, statistics)


def unobserved(name: str) -> None:
    """The stage callback without an observer: does nothing."""


def _segment(frame: FrameInput, config: UfMStarConfig, kernels: Kernels, stored: torch.dtype) -> GaussianMixture:
    """Step 2: C_i in the camera frame, float64.

    SPGF's raw moments have no floor. Eigenvalues are raised to the variance across one pixel at that depth, (z/f)^2/12,
    and to the least value that survives rounding to the mixture's dtype ``stored``, as in the fusion.
    """
    limits = config.segment.scaled_to(*frame.size)
    mixture = kernels.spgf(frame.informative_depth, frame.intrinsics, limits, frame.features)[0].to(torch.float64)
    fx, fy, _, _ = focal_and_centre(frame.intrinsics)
    # Gaussians nearer than the near plane are never matched; clamping z keeps their floor above zero.
    z = mixture.mean[..., 2].clamp_min(config.near_plane)
    floor = pixel_footprint(z, torch.minimum(fx, fy)[:, None])
    floor = torch.maximum(floor, storage_floor(mixture.covariance, stored))
    floor = torch.where(mixture.valid, floor, torch.zeros_like(floor))  # an empty slot holds zeros
    return mixture.replace(covariance=kernels.floor_covariance(mixture.covariance, floor))


def _view(frame: FrameInput, centre: Tensor) -> Tensor:
    """[B, 4] the camera's centre [B, 3] in the first camera's frame [m], and the index of the network."""
    member = torch.zeros_like(centre[:, 0]) if frame.member is None else frame.member
    return torch.cat([centre, member[:, None]], 1)


def _regress(
    mixture_cam: GaussianMixture, frame: FrameInput, config: UfMStarConfig, kernels: Kernels, pixels: Tensor | None,
    learnt: anchors.Learnt | None,
) -> tuple[dict[str, Tensor], Tensor | None]:  # fmt: skip
    """Step 5: the maps of :func:`step_output`, and the residual that anchors let expect, which is regressed with H."""
    if learnt is not None:
        columns = learnt.beyond.to(mixture_cam.features.dtype)
        mixture_cam = mixture_cam.replace(features=torch.cat([mixture_cam.features, columns], -1))
    mixture_cam = regress.with_measured_share(mixture_cam)
    result = kernels.regress_image(mixture_cam, frame.depth, frame.intrinsics, frame.valid, config, pixels)
    depth = regress.at_pixels(frame.depth, pixels)
    result, measured = regress.set_unmeasured(result, depth, config, frame.informative)
    features, residual = result.features, None
    if learnt is not None:
        features, columns = features.split([features.shape[-1] - anchors.COLUMNS, anchors.COLUMNS], -1)
        residual = learnt.residual(columns)
    return {"disagreement": result.disagreement, "measured": measured, "features": features}, residual


def _counts(
    mixture: GaussianMixture, current_cam: GaussianMixture, pairs: Correspondence, measured: Tensor, new: Tensor,
    dropped: Tensor,
) -> dict[str, Tensor]:  # fmt: skip
    """The numbers [B] of a step by their name in ``frames.output.COUNTS``."""
    return {
        "components": mixture.components,
        "segments": current_cam.components,
        "matched": pairs.match.any(2).sum(1),
        "pairs": pairs.match.sum((1, 2)),
        "new": new,
        "dropped": dropped,
        "unmeasured": (measured < regress.HALF).flatten(1).sum(1),
        "single_view": (mixture.valid & (mixture.views == 0)).sum(1),
    }


def _room(
    mixture: GaussianMixture, pairs: Correspondence, new: Tensor, config: UfMStarConfig, grow: bool
) -> tuple[int, int | None]:
    """The number of slots that the frame needs, and a bound on the matches of a component (None: the kernel reads it).

    Growth needs the step's only synchronisation with an accelerator, a read of two numbers. If the capacity cannot
    grow, the static bounds are returned without a read. Raises ValueError: growth on the meta device.
    """
    device, limit = mixture.mean.device.type, config.max_components
    if not grow or (device != "cpu" and limit is not None and mixture.capacity >= limit):
        return mixture.capacity, pairs.match.shape[1]
    if device == "meta":
        raise ValueError("device 'meta' needs max_components <= initial_capacity")
    needed = mixture.components + new.sum(1)
    if device == "cpu":
        return int(needed.max()), None
    slots, most = torch.stack([needed, pairs.match.sum(1).amax(1)]).amax(1).tolist()
    return slots, most

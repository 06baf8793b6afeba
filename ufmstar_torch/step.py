"""One image through steps 2 to 5: a pure function from state and frame to state and output.

The mixture is kept in the frame of each stream's first camera: poses are taken relative to it in
float64, so large world coordinates never reach the float32 state, and components nobody touches never change.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from ufmstar_torch.anchors.evidence import Evidence
from ufmstar_torch.anchors.given import AnchorInput
from ufmstar_torch.backend import Backend
from ufmstar_torch.camera import focal_and_centre, relative_pose
from ufmstar_torch.config import UfMStarConfig
from ufmstar_torch.correspond import Correspondence
from ufmstar_torch.disagree import with_overlap_disagreement
from ufmstar_torch.frame import FRAME_FAULTS, FrameInput
from ufmstar_torch.fuse import append
from ufmstar_torch.gaussian import pixel_footprint
from ufmstar_torch.mixture import GaussianMixture
from ufmstar_torch.read_out import average, learn, read_out


@dataclass(frozen=True)
class UfMStarState:
    """All that is remembered between images.

    Attributes:
        mixture: M_i in the frame of each stream's first camera.
        T_world_first: [B, 4, 4] float64 pose of that camera; identity before the first frame.
        started: [B] bool, True once a stream has seen a frame.
        frames: [B] int64 number of frames used.
        skipped: [B] int64 number of frames skipped for a fault.
        smoothed: [B, H, W] moving average of the dense disagreement [m^2] in the mixture's dtype, NaN without a
            value; None at the start.
        evidence: what anchors have taught; None unless ``config.anchored``.
    """

    mixture: GaussianMixture
    T_world_first: Tensor
    started: Tensor
    frames: Tensor
    skipped: Tensor
    smoothed: Tensor | None
    evidence: Evidence | None = None

    @classmethod
    def initial(
        cls, streams: int, config: UfMStarConfig, dtype: torch.dtype, device: torch.device | str
    ) -> UfMStarState:
        """The empty state of ``streams`` independent streams."""
        capacity = min(config.initial_capacity, config.max_components or config.initial_capacity)
        counter = torch.zeros(streams, dtype=torch.int64, device=device)
        return cls(
            mixture=GaussianMixture.empty(streams, capacity, features=config.features, dtype=dtype, device=device),
            T_world_first=torch.eye(4, dtype=torch.float64, device=device).repeat(streams, 1, 1),
            started=counter.bool(),
            frames=counter,
            skipped=counter.clone(),
            smoothed=None,
            evidence=Evidence.empty(streams, capacity, dtype=dtype, device=device) if config.anchored else None,
        )


@dataclass(frozen=True)
class FrameStatistics:
    """What happened to one frame, per stream [B].

    Attributes:
        components: K, occupied components after the frame.
        segments: C, Gaussians segmented from the frame.
        matched: segments fused with at least one earlier component.
        pairs: fused (c, k) pairs.
        new: segments appended to the mixture.
        dropped: segments not remembered: ``max_components`` was reached, or nearer than the near plane.
        valid_pixels: pixels used.
        fault: index into ``ufmstar_torch.frame.FRAME_FAULTS``; not 0 = the frame was skipped.
        rotation_deviation: max |R^T R - I| of the pose, removed by projection onto SO(3).
        anchors: given and usable; 0 for a standing camera, say.
        anchors_used: of those, no gross outliers. 0 = nothing new was learnt: M + A + E is plain UfM*'s and B what had
            been learnt before, which at the start is nothing.
    """

    components: Tensor
    segments: Tensor
    matched: Tensor
    pairs: Tensor
    new: Tensor
    dropped: Tensor
    valid_pixels: Tensor
    fault: Tensor
    rotation_deviation: Tensor
    anchors: Tensor
    anchors_used: Tensor


@dataclass(frozen=True)
class StepOutput:
    """The regressed disagreement and what led to it.

    Attributes:
        disagreement: M [B, H, W] [m^2] after the moving average, NaN where not valid; [B, n] on a subset.
        features: regressed features [B, H, W, F] or [B, n, F].
        residual: [B, H, W, 2] or [B, n, 2] from anchors, the mean relative error r and mean square excess e expected at
            each pixel (``evidence``); None unless ``config.anchored``.
        labels: [B, H, W] int64 the segment of every pixel, -1 = none.
        current_cam: C_i in the camera frame.
        statistics: of this frame.
    """

    disagreement: Tensor
    features: Tensor
    residual: Tensor | None
    labels: Tensor
    current_cam: GaussianMixture
    statistics: FrameStatistics


def step(
    state: UfMStarState,
    frame: FrameInput,
    config: UfMStarConfig,
    backend: Backend,
    *,
    pixels: Tensor | None = None,
    smooth: bool = True,
    anchors: AnchorInput | None = None,
) -> tuple[UfMStarState, StepOutput]:
    """Segment, correspond, fuse, regress (section "Uncertainty from Motion*", steps 2 to 5).

    Args:
        state: of the previous image; not modified.
        frame: checked input of B streams.
        config, backend: what to do and by which kernels.
        pixels: [B, n] indices into the flattened image to regress only there; None = every pixel.
        smooth: apply the exponential moving average.
        anchors: of this frame; only with ``config.anchored``.

    Returns:
        The new state and the output. A stream whose frame is at fault keeps its state and gets NaN.

    Raises:
        ValueError: a frame is at fault and ``config.on_bad_frame == "raise"``, before anything changes.
    """
    if config.on_bad_frame == "raise" and frame.fault.device.type == "cpu":
        raise_faults(frame.fault.tolist())
    fine = frame.fault == 0
    first = torch.where((fine & ~state.started)[:, None, None], frame.T_world_cam, state.T_world_first)

    current_cam, labels = segment(frame, config, backend)
    R_cam, t_cam = relative_pose(first, frame.T_world_cam)
    previous_cam = state.mixture.to(torch.float64).rigid(R_cam, t_cam)
    pairs = backend.correspond(previous_cam, current_cam, frame.intrinsics, frame.size, config)
    if config.disagreement == "overlap":
        pairs = with_overlap_disagreement(pairs, previous_cam, current_cam)
    # What is nearer than the near plane could never be matched again: it is not remembered.
    far_enough = current_cam.mean[..., 2] > config.near_plane
    new = current_cam.valid & far_enough & ~pairs.match.any(dim=2)

    current_first = current_cam.rigid(*relative_pose(frame.T_world_cam, first))
    mixture, dropped = _remember(state.mixture, current_first, pairs, new, frame.fault, config, backend)

    mixture_cam = mixture.to(torch.float64).rigid(R_cam, t_cam)
    evidence, used = learn(state.evidence, mixture_cam, frame, anchors, config, backend)
    result, residual = read_out(mixture_cam, evidence, frame, config, backend, pixels)
    disagreement, smoothed = result.disagreement, state.smoothed
    if smooth and config.ema_alpha < 1.0:
        dtype = state.mixture.mean.dtype
        disagreement, smoothed = average(smoothed, dtype, disagreement, frame, config, backend, pixels)

    statistics = FrameStatistics(
        components=mixture.components,
        segments=current_cam.components,
        matched=pairs.match.any(dim=2).sum(1),
        pairs=pairs.match.sum((1, 2)),
        new=new.sum(1) - dropped,
        dropped=dropped + (current_cam.valid & ~far_enough).sum(1),
        valid_pixels=frame.valid.sum((1, 2)),
        fault=frame.fault,
        rotation_deviation=frame.rotation_deviation,
        anchors=torch.zeros_like(fine, dtype=torch.int64) if anchors is None else anchors.valid.sum(1),
        anchors_used=used,
    )
    frames, skipped = state.frames + fine, state.skipped + ~fine
    updated = UfMStarState(mixture, first, state.started | fine, frames, skipped, smoothed, evidence)
    return updated, StepOutput(disagreement, result.features, residual, labels, current_cam, statistics)


def raise_faults(faults: list[int]) -> None:
    """Raise a ValueError that names every stream at fault.

    Raises:
        ValueError: an entry of ``faults`` is not 0.
    """
    bad = [f"stream {b}: {FRAME_FAULTS[code]}" for b, code in enumerate(faults) if code]
    if bad:
        raise ValueError("; ".join(bad))


def segment(frame: FrameInput, config: UfMStarConfig, backend: Backend) -> tuple[GaussianMixture, Tensor]:
    """Step 2: C_i in the camera frame, float64, and its labels.

    SPGF's raw moments have no floor, and an exactly flat surface is singular. Eigenvalues are lifted to
    the variance across one pixel at that depth, (z/f)^2/12: the depth map resolves nothing finer.
    """
    variance = frame.aleatoric.detach() if config.aleatoric_in_moments and frame.aleatoric is not None else None
    mixture, labels = backend.spgf(
        frame.depth, frame.intrinsics, config.segment, variance=variance, valid=frame.valid, features=frame.features
    )
    mixture = mixture.to(torch.float64)
    fx, fy, _, _ = focal_and_centre(frame.intrinsics)
    # Nearer than the near plane nothing is ever matched; the footprint there keeps the floor above zero.
    z = mixture.mean[..., 2].clamp_min(config.near_plane)
    floor = pixel_footprint(z, torch.minimum(fx, fy)[:, None])
    return mixture.replace(covariance=backend.floor_covariance(mixture.covariance, floor)), labels


def _remember(
    mixture: GaussianMixture,
    current: GaussianMixture,
    pairs: Correspondence,
    new: Tensor,
    fault: Tensor,
    config: UfMStarConfig,
    backend: Backend,
) -> tuple[GaussianMixture, Tensor]:
    """Step 4, M_i from M_(i-1) and C_i in one frame, and how many new components [B] found no room."""
    mixture, rounds = _make_room(mixture, pairs, new, fault, config)
    pairs = _pad_pairs(pairs, mixture.capacity)
    mixture = backend.fuse(mixture, current, pairs, config, rounds=rounds)
    return append(mixture, current, new)


def _make_room(
    mixture: GaussianMixture, pairs: Correspondence, new: Tensor, fault: Tensor, config: UfMStarConfig
) -> tuple[GaussianMixture, int]:
    """Double the capacity as often as needed, and bound the rounds of fusion.

    This holds the only wait for an accelerator: one small read, which growth needs, and which also
    brings the number of rounds and, where they are to raise, the faults. With a capacity that cannot grow
    and faults that skip, nothing is read and the static bounds serve.
    """
    limit = config.max_components
    fixed = limit is not None and mixture.capacity >= limit and config.on_bad_frame == "skip"
    if fixed and mixture.mean.device.type != "cpu":
        return mixture, pairs.match.shape[1]
    if mixture.mean.device.type == "meta":
        raise ValueError("device 'meta' needs max_components <= initial_capacity and on_bad_frame='skip'")
    needed = mixture.components + new.sum(1)
    most = pairs.match.sum(1).amax(1) if mixture.capacity else torch.zeros_like(needed)
    needed_, rounds, faults = torch.stack([needed, most, fault]).tolist()
    if config.on_bad_frame == "raise":
        raise_faults(faults)
    capacity = mixture.capacity
    while capacity < max(needed_):
        capacity *= 2
    return mixture.padded(capacity if limit is None else min(capacity, limit)), max(rounds)


def _pad_pairs(pairs: Correspondence, capacity: int) -> Correspondence:
    """The pairs for a mixture that has grown: the new slots match nothing."""
    missing = capacity - pairs.match.shape[2]
    if not missing:
        return pairs
    pad = torch.nn.functional.pad
    distance = None if pairs.distance is None else pad(pairs.distance, (0, missing))
    return Correspondence(pad(pairs.match, (0, missing)), pad(pairs.overlap, (0, missing)), distance)

"""One image through steps 2 to 5 on the CPU (numba): the whole step, a few compiled calls for a stage of a stream.

The reference is :func:`ufmstar_torch.step.step`. The pairs are a list, and what is out of view or unchanged is not
computed again. Streams are independent and share the threads that torch may use: neither the number of streams nor that
of threads changes a bit.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import fields, replace
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ufmstar_torch import unmeasured
from ufmstar_torch.anchors.hook import AnchorInput, Evidence, Learnt
from ufmstar_torch.config import UfMStarConfig
from ufmstar_torch.disagree import overlap_disagreement
from ufmstar_torch.frame import FrameInput
from ufmstar_torch.gaussian import PIXEL_VARIANCE
from ufmstar_torch.kernels.anchors_cpu import learn, learn_in_view
from ufmstar_torch.kernels.arrays_cpu import array
from ufmstar_torch.kernels.regress_cpu import EPSILON, Seen, View, in_slots, look, regress_maps
from ufmstar_torch.kernels.regress_cpu import smooth as smooth_maps
from ufmstar_torch.kernels.rigid_cpu import COVARIANCE, WEIGHT
from ufmstar_torch.kernels.segment_cpu import feature_means, fit, most_gaussians
from ufmstar_torch.kernels.stream_cpu import describe, join, match, tally
from ufmstar_torch.kernels.threads_cpu import each
from ufmstar_torch.mixture import GaussianMixture
from ufmstar_torch.output import StepOutput
from ufmstar_torch.regress import moving_average
from ufmstar_torch.segment_input import SegmentInput
from ufmstar_torch.state import UfMStarState
from ufmstar_torch.step import StepObserver, after_regress, frame_statistics

Floats = NDArray[np.floating[Any]]
_NAMES = tuple(field.name for field in fields(GaussianMixture))
_COUNTS: tuple[str, ...] = ("components", "segments", "matched", "pairs", "new", "dropped", "valid_pixels")
_COUNTS += ("unmeasured", "anchors", "anchors_used")


class _Pairs(NamedTuple):
    """What :func:`match` returns of a stream."""

    c: NDArray[np.int64]
    k: NDArray[np.int64]
    overlap: NDArray[np.float64]
    new: NDArray[np.bool_]
    found: int
    matched: int
    created: int
    occupied: int
    near: NDArray[np.int64]
    here: NDArray[np.float64]


class _Joined(NamedTuple):
    """The mixture after the fusion by field; of each stream the slots within reach [n], and what is in them."""

    mixture: dict[str, Tensor]
    slots: list[NDArray[np.int64]]
    seen: list[Seen]


def step(
    state: UfMStarState,
    frame: FrameInput,
    config: UfMStarConfig,
    *,
    pixels: Tensor | None = None,
    smooth: bool = True,
    anchors: AnchorInput | None = None,
    observer: StepObserver | None = None,
) -> tuple[UfMStarState, StepOutput]:
    """As :func:`ufmstar_torch.step.step`, for CPU tensors."""
    stage, kernel = (observer.stage, observer.kernel) if observer is not None else (_unobserved, nullcontext)
    segments, labels = _segment(frame, array(frame.intrinsics), config, state.covariance.dtype, kernel)
    current_cam = GaussianMixture(*map(torch.from_numpy, segments))
    stage("segment")

    with kernel("correspond"):
        cameras, pairs = _match(state, frame, segments, config)
    stage("correspond")

    with kernel("fuse"):
        joined = _join(state, frame, segments, cameras[0], pairs, config)
    stage("fuse")

    learnt: Learnt | None = None
    views: list[View] | None = None
    if config.anchors is not None:
        learnt, views = _learn(state, joined, frame, anchors, config)
    stage("append")

    with kernel("regress_image"):
        shift = None if learnt is None or views is None else array(learnt.stream)
        result = regress_maps(joined.seen, frame.depth, frame.intrinsics, config, pixels, views, shift)
    if learnt is not None and views is None:
        shape = -1, *[1] * (result.features.dim() - 2), 2
        result.features[..., -3:-1] += learnt.stream.to(frame.depth.dtype).view(shape)
    result, _, measured = after_regress(result, None, frame, config, pixels)
    residual = None
    if learnt is not None:
        residual, result = result.features[..., -2:], replace(result, features=result.features[..., :-2])
    stage("regress")

    disagreement, smoothed = result.disagreement, state.smoothed
    if smooth and config.ema_alpha < 1.0:
        smoothed, disagreement = moving_average(
            smoothed, disagreement, frame.size, config.ema_alpha, pixels, smooth_maps
        )
    counts = _counts(frame, pairs, joined.seen, measured, anchors, None if learnt is None else learnt.used)
    evidence = Evidence(state.evidence, state.overall_evidence) if learnt is None else learnt.evidence
    first, started, frames, skipped = map(torch.from_numpy, cameras)
    state_after = UfMStarState(
        **joined.mixture,
        T_world_first=first,
        started=started,
        frames=frames,
        skipped=skipped,
        smoothed=smoothed,
        evidence=evidence.component,
        overall_evidence=evidence.overall,
        posterior=state.posterior,
    )
    out = StepOutput(
        disagreement, result.features, residual, measured, labels, current_cam, frame_statistics(frame, counts)
    )
    stage("average")
    return state_after, out


def _unobserved(name: str) -> None:
    """Without an observer nothing happens between stages."""


def _segment(
    frame: FrameInput,
    intrinsics: Floats,
    config: UfMStarConfig,
    stored: torch.dtype,
    kernel: Callable[[str], AbstractContextManager],
) -> tuple[tuple[NDArray[Any], ...], Callable[[], Tensor]]:
    """Step 2: the fields of C_i in the camera frame, float64, its covariances lifted to the floor that the reference
    states, and its labels."""
    given = SegmentInput.of_frame(frame, config)
    with kernel("spgf"):
        fits, labels = fit(given)
    rounding = np.float32 if given.dtype == torch.float32 else np.float64
    b, n = len(fits), most_gaussians(fits)
    mean, covariance, weight, zero = np.zeros((b, n, 3)), np.zeros((b, n, 3, 3)), np.zeros((b, n)), np.zeros((b, n))
    count, rounded = np.zeros((b, n), np.int64), np.empty(13 * n, rounding)
    scratch = rounded[: 3 * n].reshape(n, 3), rounded[3 * n : 12 * n].reshape(n, 3, 3), rounded[12 * n :]
    epsilon = 8 * torch.finfo(stored).eps
    for i, K in enumerate(intrinsics.tolist()):
        written = (mean[i], covariance[i], weight[i], count[i])
        describe(fits[i], scratch, config.near_plane, min(K[0][0], K[1][1]), PIXEL_VARIANCE, epsilon, *written)
    features = np.empty((b, n, 0))
    if given.features is not None:
        features = feature_means(array(given.features), labels, weight.astype(rounding)).astype(np.float64)
    return (mean, covariance, weight, zero, count, features), labels


def _match(
    state: UfMStarState, frame: FrameInput, segments: Sequence[NDArray[Any]], config: UfMStarConfig
) -> tuple[tuple[NDArray[Any], ...], list[_Pairs]]:
    """Step 3: of the state after the frame, camera-to-world of the first camera, started, frames and skipped; and what
    each stream matches."""
    fine, poses, cameras = array(frame.fault) == 0, array(frame.T_world_cam), array(frame.intrinsics)
    first_before, started, frames, skipped = map(
        array, (state.T_world_first, state.started, state.frames, state.skipped)
    )
    first = np.empty_like(first_before)
    mixture = tuple(array(value) for value in (state.mean, state.covariance, state.weight))
    thresholds = (config.eta, config.eta_occlusion, config.near_plane, PIXEL_VARIANCE)
    least = min(EPSILON[frame.depth.dtype], EPSILON[state.covariance.dtype] if config.anchors is not None else 1.0)
    reach = config.prior_weight, least if config.regression == "exact" else 0.0
    calls = [
        (
            (bool(fine[b]), poses[b], cameras[b]), bool(started[b]), first_before[b], first[b],
            tuple(value[b] for value in mixture), tuple(value[b] for value in segments[:3]),
            frame.size, thresholds, reach,
        )
        for b in range(len(fine))
    ]  # fmt: skip
    after = first, started | fine, frames + fine, skipped + ~fine
    return after, [_Pairs(*found) for found in each(match, calls)]


def _join(
    state: UfMStarState,
    frame: FrameInput,
    segments: Sequence[NDArray[Any]],
    first: Floats,
    pairs: Sequence[_Pairs],
    config: UfMStarConfig,
) -> _Joined:
    """Step 4, and the mixture as the regression takes it; ``first`` is camera-to-world of the first cameras."""
    slots = tuple(array(getattr(state, name)) for name in _NAMES)
    needed = max(pair.occupied + pair.created for pair in pairs)
    capacity = _capacity(slots[0].shape[1], needed, config.max_components)
    updated = tuple(_extended(value, capacity) for value in slots)
    settings = config.overlap_weighted, float(np.finfo(slots[1].dtype).eps)
    poses, given = array(frame.T_world_cam), (*segments[:3], segments[5])
    calls = [
        (
            poses[b], first[b], tuple(value[b] for value in updated), tuple(value[b] for value in given), pair[:3],
            _distance(b, pair, segments, config), pair.new, pair.occupied, pair.near, pair.here,
            settings, 3 if config.anchors is not None else 1,
        )
        for b, pair in enumerate(pairs)
    ]  # fmt: skip
    joined = each(join, calls)
    mixture = dict(zip(_NAMES, map(torch.from_numpy, updated), strict=True))
    seen = [Seen(pair.here, *one[1:]) for pair, one in zip(pairs, joined, strict=True)]
    return _Joined(mixture, [one[0] for one in joined], seen)


def _extended(value: NDArray[Any], capacity: int) -> NDArray[Any]:
    """A copy of slots [B, K, ...] with empty ones behind them up to the capacity."""
    out = np.empty((value.shape[0], capacity, *value.shape[2:]), value.dtype)
    present = value.shape[1]
    out[:, :present], out[:, present:] = value, 0
    return out


def _learn(
    state: UfMStarState, joined: _Joined, frame: FrameInput, anchors: AnchorInput | None, config: UfMStarConfig
) -> tuple[Learnt, list[View] | None]:
    """What anchors teach, and what is in view (None unless the regression is the exact sum). By how much each
    component's error exceeds the stream's is written to the features before the last, in the order of
    ``hook.before_regression``."""
    evidence, capacity = Evidence(state.evidence, state.overall_evidence), joined.mixture["weight"].shape[1]
    if config.regression == "exact":
        views = look(joined.seen, frame.depth, frame.intrinsics, config, evidence.overall.dtype)
        return learn_in_view(evidence, capacity, joined.slots, joined.seen, views, frame, anchors, config), views
    learnt = learn(evidence, in_slots(joined.seen, joined.slots, capacity), frame, anchors, config)
    for slots, one, beyond in zip(joined.slots, joined.seen, array(learnt.beyond), strict=True):
        one.features[:, -3:-1] = beyond[slots]
    return learnt, None


def _distance(b: int, pair: _Pairs, segments: Sequence[Floats], config: UfMStarConfig) -> NDArray[np.float64]:
    """The disagreement [P] of the pairs of a stream where the step does not take W2^2, else [0]."""
    if config.disagreement != "overlap":
        return np.empty(0)
    mean, covariance = pair.here[:COVARIANCE, pair.k].T, pair.here[COVARIANCE:WEIGHT, pair.k].T.reshape(-1, 3, 3)
    both = segments[0][b][pair.c], segments[1][b][pair.c], mean, covariance
    return overlap_disagreement(*map(torch.from_numpy, both)).numpy()


def _capacity(present: int, needed: int, limit: int | None) -> int:
    """As ``GaussianMixture.grown``: doubled until what is needed fits, or to the limit; never less than at present."""
    capacity = present
    while capacity < needed:
        capacity *= 2
    return capacity if limit is None else max(present, min(capacity, limit))


def _counts(
    frame: FrameInput,
    pairs: Sequence[_Pairs],
    seen: Sequence[Seen],
    measured: Tensor,
    anchors: AnchorInput | None,
    used: Tensor | None,
) -> dict[str, Tensor]:
    """The statistics [B] that the step counts itself."""
    totals = np.zeros((len(_COUNTS), len(pairs)), np.int64)
    valid, shares = array(frame.valid), array(measured)
    for b, (pair, one) in enumerate(zip(pairs, seen, strict=True)):
        new = one.occupied - pair.occupied
        totals[:8, b] = (
            one.occupied,
            pair.found,
            pair.matched,
            pair.c.size,
            new,
            pair.found - pair.matched - new,  # without a slot, or too near
            *tally(valid[b].reshape(-1), shares[b].reshape(-1), unmeasured.HALF),
        )
    if anchors is not None:
        totals[-2] = array(anchors.valid).sum(1)
    if used is not None:
        totals[-1] = array(used)
    return dict(zip(_COUNTS, map(torch.from_numpy, totals), strict=True))

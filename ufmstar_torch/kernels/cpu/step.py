"""Steps 2 to 5 of one image on the CPU (numba): a few compiled calls for each stage and stream.

The reference is :func:`ufmstar_torch.steps.step.step`. The pairs are a list; components out of view and unchanged
ones are not computed again. Streams are independent and share the threads that torch may use: neither the number of
streams nor that of threads changes a bit.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ufmstar_torch.anchors.kernels.learn import inliers, learn_in_view
from ufmstar_torch.anchors.learn import COLUMNS, Learnt, learn
from ufmstar_torch.config import UfMStarConfig
from ufmstar_torch.frames.frame import FrameInput
from ufmstar_torch.frames.output import UncertaintyOutput
from ufmstar_torch.gaussians.camera import relative_pose
from ufmstar_torch.gaussians.gaussian import PIXEL_VARIANCE
from ufmstar_torch.gaussians.mixture import GaussianMixture
from ufmstar_torch.gaussians.state import UfMStarState
from ufmstar_torch.kernels.cpu.calls import array, each
from ufmstar_torch.kernels.cpu.regress import Seen, View, fill_and_smooth, regress_maps, views_of
from ufmstar_torch.kernels.cpu.rigid import COVARIANCE, FIELDS, WEIGHT, padded
from ufmstar_torch.kernels.cpu.segment import gaussians
from ufmstar_torch.kernels.cpu.stream import join, lift, match
from ufmstar_torch.steps.disagree import overlap_disagreement
from ufmstar_torch.steps.fuse import make_room
from ufmstar_torch.steps.regress import at_pixels, distribute, memory_for, with_pixels
from ufmstar_torch.steps.step import StepObserver, step_output, unobserved

Floats = NDArray[np.floating[Any]]
_NAMES = tuple(field.name for field in fields(GaussianMixture))
_COUNTS: tuple[str, ...] = ("components", "segments", "matched", "pairs", "new", "dropped", "valid_pixels")
_COUNTS += ("unmeasured", "single_view")


class _Pairs(NamedTuple):
    """The result of :func:`match` for a stream."""

    c: NDArray[np.int64]
    k: NDArray[np.int64]
    overlap: NDArray[np.float64]
    new: NDArray[np.bool_]
    segments: int
    matched: int
    created: int
    occupied: int
    fields: NDArray[np.float64]


class _Joined(NamedTuple):
    """The mixture after the fusion by field, and in the form for the regression; the sums over anchors by name; the
    numbers of new and of dropped components."""

    mixture: dict[str, Tensor]
    seen: list[Seen]
    sums: dict[str, Tensor]
    new: list[int]
    dropped: list[int]


def step(
    state: UfMStarState,
    frame: FrameInput,
    config: UfMStarConfig,
    *,
    pixels: Tensor | None = None,
    smooth: bool = True,
    observer: StepObserver | None = None,
) -> tuple[UfMStarState, UncertaintyOutput]:
    """As :func:`ufmstar_torch.steps.step.step`, for CPU tensors."""
    stage = unobserved if observer is None else observer.stage
    segments = _segment(frame, array(frame.intrinsics), config, state.covariance.dtype)
    current_cam = GaussianMixture(*map(torch.from_numpy, segments))
    stage("segment")

    cameras, pairs = _match(state, frame, segments, config)
    stage("correspond")

    columns = 0 if config.anchors is None else COLUMNS
    joined = _join(state, frame, segments, cameras[0], pairs, config, columns)
    stage("fuse")

    learnt, views, shift = None, None, None
    if columns:
        learnt, views = _learn(state, joined, frame, config, torch.from_numpy(cameras[0]))
        shift = None if views is None else array(learnt.stream)  # which the regression then adds
    stage("append")

    result = regress_maps(joined.seen, frame.depth, frame.intrinsics, config, pixels, views, shift)
    measured, disagreement = result.features[..., -1], result.disagreement
    if frame.informative is not None:
        measured = measured * frame.informative.view(-1, *[1] * (measured.dim() - 1)).to(measured.dtype)
    features, expected, _ = result.features.split([result.features.shape[-1] - columns - 1, columns, 1], -1)
    residual = None if learnt is None else expected if shift is not None else learnt.residual(expected)
    stage("regress")

    smoothed, alpha, previous = state.smoothed, config.ema_alpha if smooth else 1.0, disagreement
    if alpha < 1:
        smoothed = memory_for(smoothed, frame.size)
        previous = at_pixels(smoothed, pixels)
    after, disagreement, unmeasured = fill_and_smooth(
        disagreement, measured, at_pixels(frame.depth, pixels), previous, config, alpha
    )
    if alpha < 1:
        smoothed = with_pixels(smoothed, pixels, after)
    names = ("T_world_first", "started", "frames", "skipped")
    stream_fields = dict(zip(names, map(torch.from_numpy, cameras), strict=True))
    of_anchors = {} if learnt is None else learnt.tensors()
    changed = {**joined.mixture, **joined.sums, **of_anchors, **stream_fields, "smoothed": smoothed}
    updated = state.with_tensors(changed)
    maps = {"disagreement": disagreement, "measured": measured, "features": features}
    counts = _counts(frame, pairs, joined, unmeasured)
    out = step_output(frame, maps, residual, pixels, current_cam, counts, learnt)
    stage("average")
    return updated, out


def _segment(
    frame: FrameInput, intrinsics: Floats, config: UfMStarConfig, stored: torch.dtype
) -> tuple[NDArray[Any], ...]:
    """Step 2: the fields of C_i in the camera frame, float64, with the covariances lifted to the reference's floor."""
    limits = config.segment.scaled_to(*frame.size)
    features = None if frame.features is None else array(frame.features)
    mixture, _ = gaussians(array(frame.informative_depth), intrinsics, limits, features)
    segments = tuple(value.astype(np.float64) for value in mixture)
    epsilon = 8 * torch.finfo(stored).eps
    for K, *written in zip(intrinsics.tolist(), *segments[:3], strict=True):
        lift(*written, config.near_plane, min(K[0][0], K[1][1]), PIXEL_VARIANCE, epsilon)
    return segments


def _match(
    state: UfMStarState, frame: FrameInput, segments: Sequence[NDArray[Any]], config: UfMStarConfig
) -> tuple[tuple[NDArray[Any], ...], list[_Pairs]]:
    """Step 3: the state's T_world_first, started, frames and skipped after the frame, and the pairs of each stream."""
    valid, poses, cameras = array(frame.fault) == 0, array(frame.T_world_cam), array(frame.intrinsics)
    first_before, started, frames, skipped = map(
        array, (state.T_world_first, state.started, state.frames, state.skipped)
    )
    first = np.empty_like(first_before)
    mixture = tuple(array(value) for value in (state.mean, state.covariance, state.weight))
    thresholds = (config.eta, config.eta_occlusion, config.near_plane, PIXEL_VARIANCE)
    calls = [
        (
            (bool(valid[b]), poses[b], cameras[b]), bool(started[b]), first_before[b], first[b],
            tuple(value[b] for value in mixture), tuple(value[b] for value in segments[:3]),
            frame.size, thresholds,
        )
        for b in range(len(valid))
    ]  # fmt: skip
    after = first, started | valid, frames + valid, skipped + ~valid
    return after, [_Pairs(*pairs) for pairs in each(match, calls)]


def _join(
    state: UfMStarState,
    frame: FrameInput,
    segments: Sequence[NDArray[Any]],
    first: Floats,
    pairs: Sequence[_Pairs],
    config: UfMStarConfig,
    columns: int,
) -> _Joined:
    """Step 4, and the mixture in the form for the regression, with ``columns`` for anchors; ``first`` is
    camera-to-world of the first cameras."""
    slots = tuple(array(getattr(state, name)) for name in _NAMES)
    needed = max(pair.occupied + pair.created for pair in pairs)
    capacity = slots[0].shape[1]
    while capacity < needed:
        capacity *= 2
    updated = tuple(_extended(value, capacity) for value in slots)
    epsilon = float(np.finfo(slots[1].dtype).eps)
    settings = config.overlap_weighted, epsilon, config.view_baseline or 0.0, config.near_plane
    poses, current = array(frame.T_world_cam), (*segments[:3], segments[_NAMES.index("features")])
    members = np.zeros(len(poses)) if frame.member is None else array(frame.member)
    calls = [
        (
            poses[b], first[b], members[b], tuple(value[b] for value in updated),
            tuple(value[b] for value in current), pair[:3],
            _distance(b, pair, segments, config), pair.new, pair.occupied,
            settings, columns + 1,
        )
        for b, pair in enumerate(pairs)
    ]  # fmt: skip
    mixture = dict(zip(_NAMES, map(torch.from_numpy, updated), strict=True))
    seen = [Seen(*one) for one in each(join, calls)]
    sums = dict(state.by_component)
    unlimited = _Joined(mixture, seen, sums, [p.created for p in pairs], [0] * len(seen))
    limit = config.max_components
    if limit is None or capacity <= limit:
        return unlimited
    position = relative_pose(frame.T_world_cam, torch.from_numpy(first))[1]
    return _within_limit(unlimited, [pair.occupied for pair in pairs], position, limit)


def _extended(value: NDArray[Any], capacity: int) -> NDArray[Any]:
    """A copy of slots [B, K, ...], followed by empty ones up to the capacity."""
    out = np.empty((value.shape[0], capacity, *value.shape[2:]), value.dtype)
    occupied = value.shape[1]
    out[:, :occupied], out[:, occupied:] = value, 0
    return out


def _within_limit(joined: _Joined, old: Sequence[int], position: Tensor, limit: int) -> _Joined:
    """At most ``limit`` components and slots (``steps.fuse.make_room``); the first ``old`` components of
    each stream were in the mixture before."""
    before = torch.tensor(old)
    coming = torch.zeros_like(before)
    room = make_room(GaussianMixture(**joined.mixture), joined.sums, before, coming, position, limit)
    seen = []
    for one, source, components in zip(joined.seen, array(room.slot), room.mixture.components.tolist(), strict=True):
        retained = source[:components]
        by_field = np.zeros((FIELDS, padded(components)))
        by_field[:, :components] = one.components[:, retained]
        seen.append(Seen(by_field, one.disagreement[retained], one.features[retained]))
    return _Joined(
        {name: value[:, :limit].contiguous() for name, value in room.mixture.tensors().items()},
        seen,
        {name: value[:, :limit].contiguous() for name, value in room.sums.items()},
        (room.mixture.components - before + room.dropped).tolist(),
        room.dropped.tolist(),
    )


def _learn(
    state: UfMStarState, joined: _Joined, frame: FrameInput, config: UfMStarConfig, first: Tensor
) -> tuple[Learnt, list[View] | None]:
    """Learn from the frame's anchors, and write the columns for the regression to the features before the last. The
    views are those of the exact regression, which are built here already."""
    capacity, tensors = joined.mixture["weight"].shape[1], {**state.by_stream, **joined.sums}
    if config.regression == "exact":
        views = views_of(joined.seen, frame.depth, frame.intrinsics, config, state.covariance.dtype)
        return learn_in_view(tensors, capacity, joined.seen, views, frame, config), views
    mixture = GaussianMixture(**joined.mixture).to(torch.float64)
    mixture_cam = mixture.rigid(*relative_pose(first, frame.T_world_cam))
    learnt = learn(tensors, mixture_cam, frame, config, distribute, inliers)
    for one, values in zip(joined.seen, array(learnt.beyond), strict=True):
        one.features[:, -COLUMNS - 1 : -1] = values[: len(one.disagreement)]
    return learnt, None


def _distance(b: int, pair: _Pairs, segments: Sequence[Floats], config: UfMStarConfig) -> NDArray[np.float64]:
    """The overlap disagreement [P] of the pairs of a stream, or [0] where the step uses W2^2."""
    if config.disagreement != "overlap":
        return np.empty(0)
    mean, covariance = pair.fields[:COVARIANCE, pair.k].T, pair.fields[COVARIANCE:WEIGHT, pair.k].T.reshape(-1, 3, 3)
    both = segments[0][b][pair.c], segments[1][b][pair.c], mean, covariance
    return overlap_disagreement(*map(torch.from_numpy, both)).numpy()


def _counts(
    frame: FrameInput, pairs: Sequence[_Pairs], joined: _Joined, unmeasured: Sequence[int]
) -> dict[str, Tensor]:
    """Count the step's statistics [B]; ``unmeasured`` holds the pixels that no two views compare."""
    totals = np.zeros((len(_COUNTS), len(pairs)), np.int64)
    valid, views = array(frame.valid), array(joined.mixture["views"])
    for b, (pair, one, new, removed) in enumerate(zip(pairs, joined.seen, joined.new, joined.dropped, strict=True)):
        totals[:, b] = (
            len(one.disagreement),
            pair.segments,
            pair.matched,
            pair.c.size,
            new,
            removed + pair.segments - pair.matched - new,  # too many, or too near
            np.count_nonzero(valid[b]),
            unmeasured[b],
            np.count_nonzero(views[b, : len(one.disagreement)] == 0),
        )
    return dict(zip(_COUNTS, map(torch.from_numpy, totals), strict=True))

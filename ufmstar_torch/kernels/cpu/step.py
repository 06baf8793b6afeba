"""Steps 2 to 5 of one image on the CPU (numba): a few compiled calls for each stage and stream.

The reference is :func:`ufmstar_torch.steps.step.step`. The pairs are a list; components out of view and unchanged
ones are not computed again. Streams are independent and share the threads that torch may use: neither the number of
streams nor that of threads changes a bit.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields
from operator import attrgetter
from typing import Any

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
from ufmstar_torch.kernels.cpu.calls import array, arrays, each
from ufmstar_torch.kernels.cpu.regress import at_pixels, regress_maps, views_of
from ufmstar_torch.kernels.cpu.regress_cull import Seen, View
from ufmstar_torch.kernels.cpu.rigid import FIELDS, padded
from ufmstar_torch.kernels.cpu.segment import gaussians
from ufmstar_torch.kernels.cpu.stream import COMPONENTS, COUNTS, DROPPED, NEW, SINGLE_VIEW, UNMEASURED, join, match
from ufmstar_torch.steps.fuse import Room, make_room
from ufmstar_torch.steps.regress import distribute, memory_for
from ufmstar_torch.steps.step import StepObserver, step_output, unobserved

_MIXTURE = tuple(field.name for field in fields(GaussianMixture))
_STREAM = ("T_world_first", "started", "frames", "skipped")
_EPSILON = {dtype: torch.finfo(dtype).eps for dtype in (torch.float32, torch.float64)}
_of_mixture, _of_stream = attrgetter(*_MIXTURE), attrgetter(*_STREAM)
_Arrays = Sequence[NDArray[Any]]
_Match = tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.bool_], int]  # the result of ``match``


def step(
    state: UfMStarState, frame: FrameInput, config: UfMStarConfig, *, pixels: Tensor | None = None,
    observer: StepObserver | None = None,
) -> tuple[UfMStarState, UncertaintyOutput]:  # fmt: skip
    """As :func:`ufmstar_torch.steps.step.step`, for CPU tensors."""
    stage = unobserved if observer is None else observer.stage
    depth, K, *rest = arrays(frame.depth, frame.intrinsics, frame.fault, frame.T_world_cam)
    camera, counts = (*rest, K), np.zeros((len(COUNTS), len(depth)), np.int64)
    informative = None if frame.informative is None else array(frame.informative)
    segments = _segment(frame, depth if informative is None else array(frame.informative_depth), K, config, state)
    stage("segment")

    slots, after = arrays(*_of_mixture(state)), [value.copy() for value in arrays(*_of_stream(state))]
    thresholds = config.eta, config.eta_occlusion, config.near_plane, PIXEL_VARIANCE
    arguments = camera, tuple(after), tuple(slots[:3]), segments[:3], frame.size, thresholds, counts
    matched = each(match, [(b, *arguments) for b in range(len(depth))])
    stage("correspond")

    columns = 0 if config.anchors is None else COLUMNS
    updated, seen = _join(state, frame, camera, after[0], slots, segments, matched, counts, config, columns)
    stage("fuse")

    learnt, views, shift = None, None, None
    if columns:
        learnt, views = _learn({**state.by_stream, **updated}, seen, frame, config, torch.from_numpy(after[0]))
        shift = None if views is None else array(learnt.stream)  # which the regression then adds
    elif config.regression == "exact":
        views = views_of(seen, depth, K, config)
    stage("append")

    smoothed = arrays(memory_for(state.smoothed, frame.size))[0] if pixels is None and config.ema_alpha < 1 else None
    at = None if pixels is None else array(pixels)
    shown, regressed, memory, counts[UNMEASURED] = regress_maps(
        seen, depth, K, config, at, views=views, shift=shift, informative=informative, smoothed=smoothed
    )
    stage("regress")

    parts = regressed.swapaxes(1, -1) if at is not None else regressed.transpose(0, 2, 3, 1)
    last = parts.shape[-1] - 1
    of_maps = shown, parts[..., last], parts[..., : last - columns]
    maps = dict(zip(("disagreement", "measured", "features"), map(torch.from_numpy, of_maps), strict=True))
    changed = dict(zip(_STREAM, map(torch.from_numpy, after), strict=True)) | updated
    if memory is not None:
        changed["smoothed"] = torch.from_numpy(memory)
    residual = None
    if learnt is not None:
        residual = torch.from_numpy(parts[..., last - columns : last])
        residual = residual if shift is not None else learnt.residual(residual)
        changed |= learnt.tensors()
    counted = dict(zip(COUNTS, map(torch.from_numpy, counts), strict=True))
    z = None if at is None else at_pixels(depth, at)
    maps["depth"], maps["valid"] = (frame.depth, frame.valid) if z is None else map(torch.from_numpy, (z, z > 0))
    out = step_output(frame, maps, residual, counted, learnt)
    stage("average")
    return state.with_tensors(changed), out


def _segment(
    frame: FrameInput, depth: NDArray[Any], K: NDArray[np.float64], config: UfMStarConfig, state: UfMStarState
) -> _Arrays:
    """Step 2: the fields of C_i in the camera frame, float64, with the covariances lifted to the reference's floor."""
    features = None if frame.features is None else array(frame.features)
    floor = config.near_plane, PIXEL_VARIANCE, 8 * _EPSILON[state.covariance.dtype]
    return gaussians(depth, K, config.segment.scaled_to(*frame.size), features, floor)[0]


def _join(
    state: UfMStarState, frame: FrameInput, camera: _Arrays, first: NDArray[np.float64], slots: _Arrays,
    segments: _Arrays, matched: Sequence[_Match], counts: NDArray[np.int64], config: UfMStarConfig, columns: int,
) -> tuple[dict[str, Tensor], list[Seen]]:  # fmt: skip
    """Step 4: the mixture after the frame with the sums over anchors, by name; and the mixture in the form for the
    regression, with ``columns`` for anchors. ``first`` is camera-to-world of the first cameras."""
    b, capacity = slots[2].shape
    needed = max([occupied + int(counts[NEW, i]) for i, (*_, occupied) in enumerate(matched)])
    while capacity < needed:
        capacity *= 2
    updated = tuple([value.copy() if value.shape[1] == capacity else _extended(value, capacity) for value in slots])
    settings = (
        config.overlap_weighted, _EPSILON[state.covariance.dtype], config.view_baseline or 0.0, config.near_plane
    )  # fmt: skip
    members = np.zeros(b) if frame.member is None else array(frame.member)
    rest = settings, slots[-1].shape[2] + columns + 1, counts
    fixed, current = (camera, first, members, updated), (*segments[:3], segments[-1])
    joined = each(join, [(i, *fixed, current, matched[i], *rest) for i in range(b)])
    seen = [Seen(*one) for one in joined]
    mixture, sums = dict(zip(_MIXTURE, map(torch.from_numpy, updated), strict=True)), dict(state.by_component)
    limit = config.max_components
    if limit is None or capacity <= limit:
        return mixture | sums, seen
    position = relative_pose(frame.T_world_cam, torch.from_numpy(first))[1]
    before = torch.tensor([occupied for *_, occupied in matched])
    room = make_room(GaussianMixture(**mixture), sums, before, torch.zeros_like(before), position, limit)
    return _within_limit(room, before, seen, limit, counts)


def _extended(value: NDArray[Any], capacity: int) -> NDArray[Any]:
    """A copy of slots [B, K, ...], followed by empty ones up to the capacity."""
    occupied = value.shape[1]
    out = np.zeros((len(value), capacity, *value.shape[2:]), value.dtype)
    out[:, :occupied] = value
    return out


def _within_limit(
    room: Room, before: Tensor, seen: Sequence[Seen], limit: int, counts: NDArray[np.int64]
) -> tuple[dict[str, Tensor], list[Seen]]:
    """The results of :func:`_join` with at most ``limit`` components and slots, of which ``before`` [B] were in the
    mixture before the frame; changes the counts."""
    mixture, retained = room.mixture, []
    for one, source, components in zip(seen, array(room.slot), mixture.components.tolist(), strict=True):
        chosen = source[:components]
        by_field = np.zeros((FIELDS, padded(components)))
        by_field[:, :components] = one.components[:, chosen]
        retained.append(Seen(by_field, one.disagreement[chosen], one.features[chosen]))
    single_view = (mixture.valid & (mixture.views == 0)).sum(1)
    new, removed = mixture.components - before + room.dropped, array(room.dropped)
    counts[DROPPED] += removed + counts[NEW] - array(new)
    counts[NEW], counts[COMPONENTS], counts[SINGLE_VIEW] = array(new), array(mixture.components), array(single_view)
    tensors = mixture.tensors() | dict(room.sums)
    return {name: value[:, :limit].contiguous() for name, value in tensors.items()}, retained


def _learn(
    tensors: Mapping[str, Tensor], seen: Sequence[Seen], frame: FrameInput, config: UfMStarConfig, first: Tensor
) -> tuple[Learnt, list[View] | None]:
    """Learn from the frame's anchors, and write the columns for the regression to the features before the last. The
    views are those of the exact regression, which are built here already."""
    if config.regression == "exact":
        dtype, depth, K = tensors["covariance"].dtype, array(frame.depth), array(frame.intrinsics)
        views = views_of(seen, depth, K, config, dtype)
        return learn_in_view(tensors, tensors["weight"].shape[1], seen, views, frame, config), views
    mixture = GaussianMixture(**{name: tensors[name] for name in _MIXTURE}).to(torch.float64)
    mixture_cam = mixture.rigid(*relative_pose(first, frame.T_world_cam))
    learnt = learn(tensors, mixture_cam, frame, config, distribute, inliers)
    for one, values in zip(seen, array(learnt.beyond), strict=True):
        one.features[:, -COLUMNS - 1 : -1] = values[: len(one.disagreement)]
    return learnt, None

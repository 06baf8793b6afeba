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
from ufmstar_torch.anchors.hook import AnchorInput, Evidence
from ufmstar_torch.config import UfMStarConfig
from ufmstar_torch.disagree import overlap_disagreement
from ufmstar_torch.frame import FrameInput
from ufmstar_torch.gaussian import PIXEL_VARIANCE
from ufmstar_torch.kernels.anchors_cpu import learn
from ufmstar_torch.kernels.arrays_cpu import array
from ufmstar_torch.kernels.regress_cpu import EPSILON, regress_maps
from ufmstar_torch.kernels.regress_cpu import smooth as smooth_maps
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
    """The matched pairs [P] of one stream; which segments [C] are new; how many segments there are, how many of them
    are matched, how many new, and how many components the mixture had; the slots within reach of the frame [n]."""

    c: NDArray[np.int64]
    k: NDArray[np.int64]
    overlap: NDArray[np.float64]
    new: NDArray[np.bool_]
    found: int
    matched: int
    created: int
    occupied: int
    near: NDArray[np.int64]


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
    streams = range(len(frame.depth))
    camera = _, present, intrinsics = array(frame.fault), array(frame.T_world_cam), array(frame.intrinsics)

    segments, labels = _segment(frame, intrinsics, config, state.covariance.dtype, kernel)
    current_cam = GaussianMixture(*map(torch.from_numpy, segments))
    stage("segment")

    slots = tuple(array(getattr(state, name)) for name in _NAMES)
    before = tuple(array(value) for value in (state.T_world_first, state.started, state.frames, state.skipped))
    after = first, started, frames, skipped = tuple(map(np.empty_like, before))
    mean_cam, covariance_cam = np.empty(slots[0].shape), np.empty(slots[1].shape)
    thresholds = (config.eta, config.eta_occlusion, config.near_plane, PIXEL_VARIANCE)
    least = min(EPSILON[frame.depth.dtype], EPSILON[state.covariance.dtype] if config.anchored else 1.0)
    reach = config.prior_weight, least if config.regression == "exact" else 0.0
    given = (camera, before, after, slots[:3], segments[:3], frame.size, thresholds, reach, mean_cam, covariance_cam)
    with kernel("correspond"):
        pairs = [_Pairs(*found) for found in each(match, [(b, *given) for b in streams])]
    stage("correspond")

    needed = max(pair.occupied + pair.created for pair in pairs)
    capacity = _capacity(slots[0].shape[1], needed, config.max_components)
    updated = tuple(np.empty((value.shape[0], capacity, *value.shape[2:]), value.dtype) for value in slots)
    regressed = (
        _grown(mean_cam, capacity), _grown(covariance_cam, capacity), np.empty(updated[2].shape),
        np.empty(updated[2].shape), np.empty((*updated[2].shape, config.features + (3 if config.anchored else 1))),
    )  # fmt: skip
    stated = config.prior_mean if config.unmeasured == "prior" else -1.0
    settings = config.overlap_weighted, float(np.finfo(slots[1].dtype).eps), stated
    fused = present, first, slots, updated, (*segments[:3], segments[5])
    with kernel("fuse"):
        distances = [_distance(b, pair, segments, regressed, config) for b, pair in enumerate(pairs)]
        joining = zip(streams, pairs, distances, strict=True)
        joined = each(
            join,
            [
                (b, *fused, pair[:3], d, pair.new, pair.occupied, pair.near, settings, regressed)
                for b, pair, d in joining
            ],
        )
    stage("fuse")

    mean, covariance, weight, disagreement, features = map(torch.from_numpy, regressed)
    mixture = dict(zip(_NAMES, map(torch.from_numpy, updated), strict=True))
    mixture_cam = GaussianMixture(mean, covariance, weight, disagreement, mixture["count"], features)
    evidence, stream = Evidence(state.evidence, state.overall_evidence), None
    totals = np.zeros((len(_COUNTS), len(streams)), np.int64)
    counts = dict(zip(_COUNTS, map(torch.from_numpy, totals), strict=True))
    if config.anchored:
        learnt = learn(evidence, mixture_cam, frame, anchors, config, joined)
        features[..., -3:-1] = learnt.beyond  # before the share that was measured, as `before_regression` has them
        evidence, stream = learnt.evidence, learnt.stream
        counts["anchors_used"].copy_(learnt.used)
    if anchors is not None:
        counts["anchors"].copy_(anchors.valid.sum(1))
    stage("append")

    with kernel("regress_image"):
        result = regress_maps(mixture_cam, frame.depth, frame.intrinsics, config, pixels, joined)
    if stream is not None:
        result.features[..., -3:-1] += stream.to(frame.depth.dtype).view(-1, *[1] * (result.features.dim() - 2), 2)
    result, _, measured = after_regress(result, None, frame, config, pixels)
    residual = None
    if stream is not None:
        residual, result = result.features[..., -2:], replace(result, features=result.features[..., :-2])
    stage("regress")

    disagreement, smoothed = result.disagreement, state.smoothed
    if smooth and config.ema_alpha < 1.0:
        smoothed, disagreement = moving_average(
            smoothed, disagreement, frame.size, config.ema_alpha, pixels, smooth_maps
        )
    _count(totals, frame, pairs, [components for _, components in joined], measured)
    state_after = UfMStarState(
        **mixture,
        T_world_first=torch.from_numpy(first),
        started=torch.from_numpy(started),
        frames=torch.from_numpy(frames),
        skipped=torch.from_numpy(skipped),
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


def _distance(
    b: int, pair: _Pairs, segments: Sequence[Floats], mixture_cam: Sequence[Floats], config: UfMStarConfig
) -> NDArray[np.float64]:
    """The disagreement [P] of the pairs of a stream where the step does not take W2^2, else [0]."""
    if config.disagreement != "overlap":
        return np.empty(0)
    both = [value[b][at] for values, at in ((segments, pair.c), (mixture_cam, pair.k)) for value in values[:2]]
    return overlap_disagreement(*map(torch.from_numpy, both)).numpy()


def _capacity(present: int, needed: int, limit: int | None) -> int:
    """As ``GaussianMixture.grown``: doubled until what is needed fits, or to the limit; never less than at present."""
    capacity = present
    while capacity < needed:
        capacity *= 2
    return capacity if limit is None else max(present, min(capacity, limit))


def _grown(value: Floats, capacity: int) -> Floats:
    """[B, K, ...] with ``capacity`` slots, new ones zero."""
    missing = capacity - value.shape[1]
    if missing <= 0:
        return value
    return np.concatenate([value, np.zeros((value.shape[0], missing, *value.shape[2:]))], axis=1)


def _count(
    totals: NDArray[np.int64], frame: FrameInput, pairs: list[_Pairs], components: list[int], measured: Tensor
) -> None:
    """Write the statistics [n, B] that the step counts itself, in the order of ``_COUNTS``."""
    valid, shares = array(frame.valid), array(measured)
    for b, (pair, occupied) in enumerate(zip(pairs, components, strict=True)):
        new = occupied - pair.occupied
        totals[:8, b] = (
            occupied,
            pair.found,
            pair.matched,
            pair.c.size,
            new,
            pair.found - pair.matched - new,  # without a slot, or too near
            *tally(valid[b].reshape(-1), shares[b].reshape(-1), unmeasured.HALF),
        )

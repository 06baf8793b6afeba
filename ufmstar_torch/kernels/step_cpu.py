"""One image through steps 2 to 5 on the CPU (numba): the whole step, a few compiled calls for a stage of a stream.

The reference is :func:`ufmstar_torch.step.step`. The pairs are a list, and what is out of view or unchanged is not
computed again. Streams are independent and share the threads that torch may use: neither the number of streams nor that
of threads changes a bit.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from contextlib import AbstractContextManager, nullcontext
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ufmstar_torch import unmeasured
from ufmstar_torch.anchors.hook import AnchorInput, Evidence, after_regression, before_regression
from ufmstar_torch.config import UfMStarConfig
from ufmstar_torch.disagree import overlap_disagreement
from ufmstar_torch.frame import FrameInput
from ufmstar_torch.gaussian import PIXEL_VARIANCE
from ufmstar_torch.kernels.anchors_cpu import learn
from ufmstar_torch.kernels.correspond_cpu import matches
from ufmstar_torch.kernels.fuse_cpu import append, floored, fuse_pairs
from ufmstar_torch.kernels.regress_cpu import regress_image
from ufmstar_torch.kernels.regress_cpu import smooth as smooth_maps
from ufmstar_torch.kernels.rigid_cpu import move, relative
from ufmstar_torch.kernels.segment_cpu import segment
from ufmstar_torch.kernels.threads_cpu import each
from ufmstar_torch.mixture import GaussianMixture
from ufmstar_torch.output import FrameStatistics, StepOutput, given
from ufmstar_torch.regress import moving_average
from ufmstar_torch.segment_input import SegmentInput
from ufmstar_torch.state import UfMStarState
from ufmstar_torch.step import StepObserver

Floats = NDArray[np.floating[Any]]


class _Slots(NamedTuple):
    """The fields of a mixture [B, K, ...], or of one stream [K, ...], as arrays."""

    mean: Floats
    covariance: Floats
    weight: Floats
    disagreement: Floats
    observations: NDArray[np.int64]
    features: Floats

    @classmethod
    def of(cls, mixture: GaussianMixture) -> _Slots:
        return cls(*(value.detach().contiguous().numpy() for value in mixture.tensors().values()))

    def stream(self, b: int) -> _Slots:
        return _Slots(*(value[b] for value in self))

    def mixture(self) -> GaussianMixture:
        return GaussianMixture(*map(torch.from_numpy, self))


class _Stream(NamedTuple):
    """One stream of a frame: its intrinsics, the poses of its first camera and of this one, the motion [3, 4] from the
    one to the other, and C_i in the camera frame."""

    K: Floats
    first: Floats
    present: Floats
    into_camera: Floats
    segments: _Slots


class _Pairs(NamedTuple):
    """The matched pairs [P] of one stream, and which segments [C] are matched, and new."""

    c: NDArray[np.int64]
    k: NDArray[np.int64]
    overlap: NDArray[np.float64]
    matched: NDArray[np.bool_]
    new: NDArray[np.bool_]


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
    fine = frame.fault == 0
    first = torch.where((fine & ~state.started)[:, None, None], frame.T_world_cam, state.T_world_first)

    current_cam, labels = _segment(frame, config, state.covariance.dtype, kernel)
    stage("segment")

    streams = _streams(frame, first, current_cam)
    old = _Slots.of(state.mixture)
    in_camera = np.zeros(old.mean.shape), np.zeros(old.covariance.shape)
    with kernel("correspond"):
        matching = zip(map(old.stream, range(len(streams))), *in_camera, streams, strict=True)
        pairs = each(_correspond, [(*given, frame.size, config) for given in matching])
    stage("correspond")

    occupied = [int(np.count_nonzero(weight)) for weight in old.weight]
    needed = max(n + int(pair.new.sum()) for n, pair in zip(occupied, pairs, strict=True))
    capacity = _capacity(old.weight.shape[1], needed, config.max_components)
    updated = _Slots(*(_grown(value, capacity) for value in old))
    in_camera = _grown(in_camera[0], capacity), _grown(in_camera[1], capacity)
    with kernel("fuse"):
        fusing = zip(map(updated.stream, range(len(streams))), *in_camera, streams, pairs, occupied, strict=True)
        dropped = np.array(each(_fuse, [(*given, config) for given in fusing]))
    stage("fuse")

    mixture = updated.mixture()
    moved = mixture.replace(mean=torch.from_numpy(in_camera[0]), covariance=torch.from_numpy(in_camera[1]))
    evidence, used, mixture_cam, stream = before_regression(
        Evidence(state.evidence, state.overall_evidence), moved.to(torch.float64), frame, anchors, config, learn
    )  # fmt: skip
    mixture_cam = unmeasured.before_regression(mixture_cam, config)
    stage("append")

    with kernel("regress_image"):
        result = regress_image(mixture_cam, frame.depth, frame.intrinsics, frame.valid, config, pixels)
    chosen = frame.depth if pixels is None else torch.gather(frame.depth.flatten(1), 1, pixels)
    result, measured = unmeasured.after_regression(result, chosen, config)
    result, residual = after_regression(result, stream)
    stage("regress")

    disagreement, smoothed = result.disagreement, state.smoothed
    if smooth and config.ema_alpha < 1.0:
        smoothed, disagreement = moving_average(
            smoothed, disagreement, frame.size, config.ema_alpha, pixels, smooth_maps
        )
    counts = _counts(frame, current_cam, mixture, pairs, dropped, measured)
    statistics = FrameStatistics(
        **counts,
        beyond=frame.beyond,
        out_of_range=frame.out_of_range,
        fault=frame.fault,
        rotation_deviation=frame.rotation_deviation,
        anchors=torch.zeros_like(used) if anchors is None else anchors.valid.sum(1),
        anchors_used=used,
    )
    state = UfMStarState(
        **mixture.tensors(),
        T_world_first=first,
        started=state.started | fine,
        frames=state.frames + fine,
        skipped=state.skipped + ~fine,
        smoothed=smoothed,
        evidence=evidence.component,
        overall_evidence=evidence.overall,
        posterior=state.posterior,
    )
    stage("average")
    out = StepOutput(disagreement, result.features, residual, measured, partial(given, labels), current_cam, statistics)
    return state, out


def _unobserved(name: str) -> None:
    """Without an observer nothing happens between stages."""


def _segment(
    frame: FrameInput, config: UfMStarConfig, stored: torch.dtype, kernel: Callable[[str], AbstractContextManager]
) -> tuple[GaussianMixture, Tensor]:
    """Step 2: C_i in the camera frame, float64, its covariances lifted to the floor that the reference states."""
    with kernel("spgf"):
        raw, labels = segment(SegmentInput.of_frame(frame, config))
    mixture = raw.to(torch.float64)
    covariance = torch.zeros_like(mixture.covariance)
    epsilon = 8 * torch.finfo(stored).eps
    given = (value.numpy() for value in (mixture.mean, mixture.covariance, mixture.weight, covariance))
    for K, mean, cov, weight, out in zip(frame.intrinsics.tolist(), *given, strict=True):
        floored(mean, cov, weight, config.near_plane, min(K[0][0], K[1][1]), PIXEL_VARIANCE, epsilon, out)
    return mixture.replace(covariance=covariance), labels


def _streams(frame: FrameInput, first: Tensor, current_cam: GaussianMixture) -> list[_Stream]:
    given = (value.contiguous().numpy() for value in (frame.intrinsics, first, frame.T_world_cam))
    segments = _Slots.of(current_cam)
    return [
        _Stream(K, start, present, relative(start, present), segments.stream(b))
        for b, (K, start, present) in enumerate(zip(*given, strict=True))
    ]


def _correspond(
    old: _Slots, mean_cam: Floats, covariance_cam: Floats, stream: _Stream, size: tuple[int, int], config: UfMStarConfig
) -> _Pairs:
    """Step 3 of one stream; M_(i-1) in the camera frame is written to ``mean_cam`` and ``covariance_cam``."""
    current = stream.segments
    everyone = np.empty(0, np.bool_)
    move(stream.into_camera, *old[:3], 0, everyone, mean_cam, covariance_cam)
    thresholds = (config.eta, config.eta_occlusion, config.near_plane, PIXEL_VARIANCE)
    weight = np.asarray(old.weight, np.float64)  # the segments' dtype: one kernel to compile instead of two
    c, k, overlap = matches(mean_cam, covariance_cam, weight, *current[:3], stream.K, *size, *thresholds)
    matched = np.zeros(current.weight.shape, np.bool_)
    matched[c] = True
    # What is nearer than the near plane could never be matched again: it is not remembered.
    new = (current.weight > 0) & (current.mean[:, 2] > config.near_plane) & ~matched
    return _Pairs(c, k, overlap, matched, new)


def _fuse(
    updated: _Slots, mean_cam: Floats, covariance_cam: Floats, stream: _Stream, pairs: _Pairs, occupied: int,
    config: UfMStarConfig,
) -> int:  # fmt: skip
    """Step 4 of one stream, in place: fuse, append, and bring into the camera frame what has changed.

    Returns how many segments found no free slot.
    """
    current, none = stream.segments, np.empty(0, np.bool_)
    mean_c, cov_c = np.zeros(current.mean.shape), np.zeros(current.covariance.shape)
    move(relative(stream.present, stream.first), *current[:3], 0, none, mean_c, cov_c)
    distance = np.empty(0)
    if config.disagreement == "overlap":
        k = (torch.from_numpy(value[pairs.k]) for value in (mean_cam, covariance_cam))
        c = (torch.from_numpy(value[pairs.c]) for value in current[:2])
        distance = overlap_disagreement(*c, *k).numpy()
    changed = np.zeros(updated.weight.shape, np.bool_)
    epsilon = float(np.finfo(updated.covariance.dtype).eps)
    given = (mean_c, cov_c, current.weight, current.features)
    fuse_pairs(*updated, *given, *pairs[:3], distance, config.overlap_weighted, epsilon, changed)
    dropped = append(*updated, *given, pairs.new, occupied)
    move(stream.into_camera, *updated[:3], occupied, changed, mean_cam, covariance_cam)
    return dropped


def _capacity(present: int, needed: int, limit: int | None) -> int:
    """As ``GaussianMixture.grown``: doubled until what is needed fits, or to the limit; never less than at present."""
    capacity = present
    while capacity < needed:
        capacity *= 2
    return capacity if limit is None else max(present, min(capacity, limit))


def _grown(value: NDArray[Any], capacity: int) -> NDArray[Any]:
    """A copy of [B, K, ...] with ``capacity`` slots, new ones zero."""
    out = np.empty((value.shape[0], capacity, *value.shape[2:]), value.dtype)
    out[:, : value.shape[1]], out[:, value.shape[1] :] = value, 0
    return out


def _counts(
    frame: FrameInput, current_cam: GaussianMixture, mixture: GaussianMixture, pairs: list[_Pairs],
    dropped: NDArray[np.int64], measured: Tensor,
) -> dict[str, Tensor]:  # fmt: skip
    """The statistics [B] that the step counts itself."""

    def each_stream(values: Iterable[NDArray[Any]]) -> NDArray[np.int64]:
        return np.array([int(np.count_nonzero(value)) for value in values], np.int64)

    segments = each_stream(current_cam.weight.numpy())
    new, matched = (each_stream(value) for value in ([p.new for p in pairs], [p.matched for p in pairs]))
    counts = {
        "components": each_stream(mixture.weight.numpy()),
        "segments": segments,
        "matched": matched,
        "pairs": np.array([p.c.size for p in pairs], np.int64),
        "new": new - dropped,
        "dropped": dropped + segments - matched - new,  # too near, or without a slot
        "valid_pixels": each_stream(frame.valid.numpy()),
        "unmeasured": each_stream(measured.numpy() < unmeasured.HALF),
    }
    return {name: torch.from_numpy(value) for name, value in counts.items()}

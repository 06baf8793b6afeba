"""One image through steps 2 to 5 on the CPU (numba): the whole step, a few compiled calls for a stage of a stream.

The reference is :func:`ufmstar_torch.step.step`. The pairs are a list, and what is out of view or unchanged is not
computed again. Streams are independent and share the threads that torch may use: neither the number of streams nor that
of threads changes a bit.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import fields
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ufmstar_torch import unmeasured
from ufmstar_torch.anchors.hook import AnchorInput, Evidence, before_regression
from ufmstar_torch.config import UfMStarConfig
from ufmstar_torch.disagree import overlap_disagreement
from ufmstar_torch.frame import FrameInput
from ufmstar_torch.gaussian import PIXEL_VARIANCE
from ufmstar_torch.kernels.anchors_cpu import learn
from ufmstar_torch.kernels.regress_cpu import EPSILON, regress_maps
from ufmstar_torch.kernels.regress_cpu import smooth as smooth_maps
from ufmstar_torch.kernels.segment_cpu import feature_means, fit, most_gaussians
from ufmstar_torch.kernels.stream_cpu import describe, join, match
from ufmstar_torch.kernels.threads_cpu import each
from ufmstar_torch.mixture import GaussianMixture
from ufmstar_torch.output import StepOutput
from ufmstar_torch.regress import moving_average
from ufmstar_torch.segment_input import SegmentInput
from ufmstar_torch.state import UfMStarState
from ufmstar_torch.step import StepObserver, after_frame, after_regress, frame_statistics

Floats = NDArray[np.floating[Any]]
_NAMES = tuple(field.name for field in fields(GaussianMixture))


class _Slots(NamedTuple):
    """The fields of a mixture [B, K, ...], or of one stream [K, ...], as arrays."""

    mean: Floats
    covariance: Floats
    weight: Floats
    disagreement: Floats
    observations: NDArray[np.int64]
    features: Floats

    @classmethod
    def of(cls, state: UfMStarState | GaussianMixture) -> _Slots:
        return cls(*(getattr(state, name).detach().contiguous().numpy() for name in _NAMES))

    def stream(self, b: int) -> tuple[NDArray[Any], ...]:
        return tuple([value[b] for value in self])


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

    def after(self, dropped: int) -> tuple[NDArray[np.int64], int]:
        """The slots within reach with those of the new components, and how many are occupied."""
        components = self.occupied + self.created - dropped
        return np.append(self.near, np.arange(self.occupied, components)), components


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
    present = frame.T_world_cam.contiguous().numpy()
    starts = (frame.fault.numpy() == 0) & ~state.started.numpy()
    first = np.where(starts[:, None, None], present, state.T_world_first.numpy())

    current_cam, labels = _segment(frame, config, state.covariance.dtype, kernel)
    stage("segment")

    old, segments, K = _Slots.of(state), _Slots.of(current_cam), frame.intrinsics.contiguous().numpy()
    mean_cam, covariance_cam = np.zeros(old.mean.shape), np.zeros(old.covariance.shape)
    thresholds = (config.eta, config.eta_occlusion, config.near_plane, PIXEL_VARIANCE)
    # Anchors and the neighbourhood look at every component.
    narrow = config.regression == "exact" and not config.anchored
    epsilon, ratio = EPSILON[frame.depth.dtype] if narrow else 0.0, config.occlusion_depth
    reach = (config.prior_weight, epsilon, float("inf") if ratio is None else ratio)
    depth = frame.depth.contiguous().numpy()
    with kernel("correspond"):
        matching = [
            (
                first[b], present[b], *old.stream(b)[:3], *segments.stream(b)[:3], K[b], depth[b], thresholds,
                reach, mean_cam[b], covariance_cam[b],
            )
            for b in range(len(K))
        ]  # fmt: skip
        pairs = [_Pairs(*found) for found in each(match, matching)]
    stage("correspond")

    needed = max(pair.occupied + pair.created for pair in pairs)
    capacity = _capacity(old.weight.shape[1], needed, config.max_components)
    slots = _Slots(*(_grown(value, capacity) for value in old))
    mean_cam, covariance_cam = _grown(mean_cam, capacity), _grown(covariance_cam, capacity)
    epsilon = float(np.finfo(slots.covariance.dtype).eps)
    with kernel("fuse"):
        joining = []
        for b, pair in enumerate(pairs):
            mean, covariance, weight, _, _, features = segments.stream(b)
            distance = np.empty(0)
            if config.disagreement == "overlap":
                both = (mean[pair.c], covariance[pair.c], mean_cam[b][pair.k], covariance_cam[b][pair.k])
                distance = overlap_disagreement(*map(torch.from_numpy, both)).numpy()
            joining.append(
                (
                    first[b], present[b], slots.stream(b), (mean, covariance, weight, features), tuple(pair[:3]),
                    distance, pair.new, pair.occupied, config.overlap_weighted, epsilon, mean_cam[b],
                    covariance_cam[b],
                )
            )  # fmt: skip
        dropped = each(join, joining)
    stage("fuse")

    mixture = {name: torch.from_numpy(value) for name, value in zip(_NAMES, slots, strict=True)}
    moved = GaussianMixture(
        torch.from_numpy(mean_cam), torch.from_numpy(covariance_cam), mixture["weight"].double(),
        mixture["disagreement"].double(), mixture["count"], mixture["features"].double(),
    )  # fmt: skip
    evidence, used, mixture_cam, stream = before_regression(
        Evidence(state.evidence, state.overall_evidence), moved, frame, anchors, config, learn
    )
    mixture_cam = unmeasured.before_regression(mixture_cam, config)
    stage("append")

    near = [pair.after(lost) for pair, lost in zip(pairs, dropped, strict=True)]
    with kernel("regress_image"):
        result = regress_maps(mixture_cam, frame.depth, frame.intrinsics, config, pixels, near)
    result, residual, measured = after_regress(result, stream, frame, config, pixels)
    stage("regress")

    disagreement, smoothed = result.disagreement, state.smoothed
    if smooth and config.ema_alpha < 1.0:
        smoothed, disagreement = moving_average(
            smoothed, disagreement, frame.size, config.ema_alpha, pixels, smooth_maps
        )
    counts = _counts(frame, pairs, dropped, measured)
    counts |= {"anchors": torch.zeros_like(used) if anchors is None else anchors.valid.sum(1), "anchors_used": used}
    updated = after_frame(state, frame, mixture, torch.from_numpy(first), smoothed, evidence)
    out = StepOutput(
        disagreement, result.features, residual, measured, labels, current_cam, frame_statistics(frame, counts)
    )
    stage("average")
    return updated, out


def _unobserved(name: str) -> None:
    """Without an observer nothing happens between stages."""


def _segment(
    frame: FrameInput, config: UfMStarConfig, stored: torch.dtype, kernel: Callable[[str], AbstractContextManager]
) -> tuple[GaussianMixture, Callable[[], Tensor]]:
    """Step 2: C_i in the camera frame, float64, its covariances lifted to the floor that the reference states."""
    given = SegmentInput.of_frame(frame, config)
    with kernel("spgf"):
        fits, labels = fit(given)
    rounding = np.float32 if given.dtype == torch.float32 else np.float64
    b, n = len(fits), most_gaussians(fits)
    mean, covariance, weight, zero = np.zeros((b, n, 3)), np.zeros((b, n, 3, 3)), np.zeros((b, n)), np.zeros((b, n))
    count, rounded = np.zeros((b, n), np.int64), np.empty(13 * n, rounding)
    scratch = rounded[: 3 * n].reshape(n, 3), rounded[3 * n : 12 * n].reshape(n, 3, 3), rounded[12 * n :]
    epsilon = 8 * float(torch.finfo(stored).eps)
    for i, K in enumerate(frame.intrinsics.tolist()):
        written = (mean[i], covariance[i], weight[i], count[i])
        describe(fits[i], scratch, config.near_plane, min(K[0][0], K[1][1]), PIXEL_VARIANCE, epsilon, *written)
    features = feature_means(given, labels, weight.astype(rounding)).astype(np.float64)
    return GaussianMixture(*map(torch.from_numpy, (mean, covariance, weight, zero, count, features))), labels


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


def _counts(frame: FrameInput, pairs: list[_Pairs], dropped: list[int], measured: Tensor) -> dict[str, Tensor]:
    """The statistics [B] that the step counts itself."""
    valid, unseen = frame.valid.numpy(), measured.numpy() < unmeasured.HALF
    rows = [
        (
            pair.occupied + pair.created - lost,
            pair.found,
            pair.matched,
            pair.c.size,
            pair.created - lost,
            lost + pair.found - pair.matched - pair.created,  # without a slot, or too near
            np.count_nonzero(valid[b]),
            np.count_nonzero(unseen[b]),
        )
        for b, (pair, lost) in enumerate(zip(pairs, dropped, strict=True))
    ]
    names = ("components", "segments", "matched", "pairs", "new", "dropped", "valid_pixels", "unmeasured")
    return dict(zip(names, torch.tensor(rows, dtype=torch.int64).unbind(1), strict=True))

"""The record of a frame of ``ufmstar run``: a line of frames.jsonl, and the arrays of its file."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ufmstar_torch.eval.engine.rows import RowResult
from ufmstar_torch.eval.engine.stream import FrameResult
from ufmstar_torch.eval.sequences.frame import Frame
from ufmstar_torch.frames.output import EVERY_FRAME, MAPS

_OF_NETWORK = ("aleatoric", "epistemic", "confidence", "features")  # maps that are not stored
_BEFORE = ("network_depth", "ufm_variance")  # maps that are stored where a posterior corrects them
# [m] No depth network is more accurate than this sigma.
NEAR_ZERO = 1e-3


def frame_arrays(frame: Frame | None, row: RowResult) -> dict[str, NDArray[Any]]:
    """The arrays of a frame's file, by name: maps, pose, intrinsics and anchors (``writers``)."""
    left_out = _OF_NETWORK if row.corrected else (*_OF_NETWORK, *_BEFORE)
    maps = {name: value for name in MAPS if name not in left_out and (value := row.map(name)) is not None}
    arrays: dict[str, NDArray[Any]]
    arrays = {name: value.numpy().astype(np.float32, copy=False) for name, value in maps.items()}
    arrays |= {"valid": row.valid.numpy(), "T_world_cam": row.T_world_cam, "intrinsics": row.intrinsics}
    if row.landmarks is None or frame is None:
        return arrays
    anchors = row.landmarks.anchors(frame.intrinsics, torch.from_numpy(row.intrinsics))
    columns = (anchors.pixel[0], anchors.depth[0, :, None], anchors.variance[0, :, None].sqrt())
    return arrays | {"anchors": torch.cat(columns, dim=1).float().numpy()}


def frame_record(result: FrameResult, key: str, ms: Mapping[str, float]) -> dict[str, Any]:
    """The line of frames.jsonl of a frame: state, figures and times [ms] of the row ``key``, or why it was skipped.
    ``ms`` has the times of "metrics" and "write" [ms]."""
    about: dict[str, Any] = {"index": result.index, "name": result.name}
    if result.frame is not None and result.frame.timestamp is not None:
        about["timestamp"] = result.frame.timestamp
    if key not in result.rows:
        return {**about, "state": "skipped", "reason": result.skipped[key]}
    row = result.rows[key]
    times = {"ms": _times(result, row, ms)}
    return {**about, "state": "done", **_figures(row), **times, **_anchor_figures(row)}


def _figures(row: RowResult) -> dict[str, Any]:
    """Counts and means of a frame."""
    statistics, network_variance, K = row.out.statistics, row.network_variance, row.intrinsics.tolist()
    std, valid, disagreement = row.out.std[0], row.valid, row.map("disagreement")
    assert disagreement is not None
    return {
        "size": list(row.size),
        "intrinsics": [K[0][0], K[1][1], K[0][2], K[1][2]],
        "T_world_cam": row.T_world_cam,
        "member": row.out.member,
        **{name: getattr(statistics, name)[0].item() for name in EVERY_FRAME},
        "mean_disagreement": _mean(disagreement, valid),
        "mean_sigma": _mean(std, valid),
        "mean_network_sigma": None if network_variance is None else _mean(network_variance.sqrt(), valid),
        "near_zero": int(((std > 0) & (std < NEAR_ZERO)).sum()),
        "ground_truth": row.truth is not None,
    }


def _times(result: FrameResult, row: RowResult, after: Mapping[str, float]) -> dict[str, float]:
    """Times by stage [ms]; stages overlap. "prepare" is the prediction's time without the network's, "cycle" the time
    since the previous frame."""
    ms = result.ms
    return {
        "read": ms["read"],
        **{stage: row.ms[stage] for stage in ("network", "anchors") if stage in row.ms},
        "ufm": row.ms["uncertainty"],
        "metrics": ms["truth"] + after["metrics"],
        "write": after["write"],
        "prepare": ms["predict"] - row.ms.get("network", 0.0),
        "cycle": ms["cycle"],
    }


def _anchor_figures(row: RowResult) -> dict[str, Any]:
    """The frame's counts of anchors, and the means of B [m^2] and of r; {} without anchors.

    ``tracked``: corners tracked from the previous frame (for a map of landmarks: all); ``found``: of these,
    triangulated ones (in view); ``usable``: of these, on a pixel with a depth; ``used``: of these, consistent with
    others. ``without``: why no anchor is used; ``confidence``: True if the network's confidence was used.
    """
    landmarks, statistics, anchored, bias = row.landmarks, row.out.statistics, row.map("anchored"), row.map("bias")
    if landmarks is None or anchored is None or bias is None:
        return {}
    assert statistics.anchors is not None
    assert statistics.anchors_used is not None
    used, usable, found = int(statistics.anchors_used[0]), int(statistics.anchors[0]), len(landmarks.depth)
    why = landmarks.none
    if found:
        why = "they contradict each other" if usable else "none lies on a pixel with a depth"
    counts: dict[str, Any] = {"tracked": landmarks.tracked, "found": found, "usable": usable, "used": used}
    if statistics.confidence is not None:
        counts["confidence"] = bool(statistics.confidence[0] > 0)
    return {
        "anchors": {**counts, "without": None if used else why},
        "mean_anchored": _mean(anchored, row.valid),
        "mean_bias": _mean(bias, row.valid),
        **_posterior_figures(row),
    }


def _posterior_figures(row: RowResult) -> dict[str, Any]:
    """Figures of held-out anchors (``FrameStatistics``), the quantiles of intervals, and the mean of sqrt(V) of UfM*
    [m], which ``mean_sigma`` is not; {} without a posterior."""
    variance, statistics, quantiles = row.map("ufm_variance"), row.out.statistics, row.out.quantiles
    if variance is None or quantiles is None or statistics.calibration is None or statistics.unseen is None:
        return {}
    calibration = float(statistics.calibration[0])
    figures = {
        "calibration": calibration if math.isfinite(calibration) else None,
        "unseen": float(statistics.unseen[0]),
        "quantiles": quantiles[0].tolist() if row.out.has_intervals else None,
    }
    return {"posterior": figures, "mean_ufm_sigma": _mean(variance.sqrt(), row.valid)}


def _mean(values: Tensor, valid: Tensor) -> float:
    return float(values[valid].double().mean()) if bool(valid.any()) else float("nan")

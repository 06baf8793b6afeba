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

_MAPS = ("disagreement", "measured", "anchored", "bias", "posterior_inlier_variance", "posterior_outlier")
_COUNTS = ("components", "segments", "matched", "pairs", "new", "dropped", "valid_pixels", "unmeasured", "single_view")
# [m] No depth network is more accurate than this sigma.
NEAR_ZERO = 1e-3


def frame_arrays(frame: Frame | None, row: RowResult) -> dict[str, NDArray[Any]]:
    """The arrays of a frame's file, by name: maps, pose, intrinsics and anchors (``writers``)."""
    depth, variance = row.best
    of_network = {} if row.posterior_depth is None else {"network_depth": row.depth, "ufm_variance": row.variance}
    named = {"depth": depth, "variance": variance, **of_network, **{name: getattr(row, name) for name in _MAPS}}
    maps = {name: value for name, value in named.items() if value is not None}
    arrays = {name: value.cpu().numpy().astype(np.float32, copy=False) for name, value in maps.items()}
    arrays |= {"valid": row.valid.cpu().numpy(), "T_world_cam": row.T_world_cam, "intrinsics": row.intrinsics}
    if row.landmarks is None or frame is None:
        return arrays
    anchors = row.landmarks.anchors(frame.intrinsics, torch.from_numpy(row.intrinsics))
    columns = (anchors.pixel[0], anchors.depth[0, :, None], anchors.variance[0, :, None].sqrt())
    return arrays | {"anchors": torch.cat(columns, dim=1).float().numpy()}


def frame_record(result: FrameResult, key: str, writing: float, saving: float) -> dict[str, Any]:
    """The line of frames.jsonl of a frame: state, figures and times [ms] of the row ``key``, or why it was skipped.
    ``writing`` and ``saving`` are the times to write its files and the previous checkpoint [ms]."""
    about: dict[str, Any] = {"index": result.index, "name": result.name}
    if result.frame is not None and result.frame.timestamp is not None:
        about["timestamp"] = result.frame.timestamp
    if key not in result.rows:
        return {**about, "state": "skipped", "reason": result.skipped[key]}
    row = result.rows[key]
    times = {"ms": _times(result, row, writing, saving)}
    return {**about, "state": "done", **_figures(row), **times, **_anchor_figures(row)}


def missing_figure(record: Mapping[str, Any]) -> str | None:
    """The first figure that the record of a finished frame lacks, or that is no number, or None."""
    means = ("mean_disagreement", "mean_sigma", "mean_network_sigma")
    for name in (*_COUNTS, "near_zero", *means):
        value = record.get(name, "none")
        if not (isinstance(value, int | float) or (value is None and name in means)):
            return name
    complete = isinstance(record.get("ground_truth"), bool) and isinstance(record.get("ms"), Mapping)
    return None if complete and isinstance(record.get("size"), list) else "ground_truth, ms or size"


def _figures(row: RowResult) -> dict[str, Any]:
    """Counts and means of a frame."""
    statistics, network_variance, K = row.statistics, row.network_variance, row.intrinsics.tolist()
    variance = row.best[1]
    assert statistics is not None
    assert variance is not None
    assert row.disagreement is not None
    std, valid = variance.sqrt(), row.valid
    return {
        "size": list(row.size),
        "intrinsics": [K[0][0], K[1][1], K[0][2], K[1][2]],
        "T_world_cam": row.T_world_cam,
        "member": row.member,
        **{count: int(getattr(statistics, count)[0]) for count in _COUNTS},
        "mean_disagreement": _mean(row.disagreement, valid),
        "mean_sigma": _mean(std, valid),
        "mean_network_sigma": None if network_variance is None else _mean(network_variance.sqrt(), valid),
        "near_zero": int(((std > 0) & (std < NEAR_ZERO)).sum()),
        "ground_truth": row.truth is not None,
    }


def _times(result: FrameResult, row: RowResult, writing: float, saving: float) -> dict[str, float]:
    """Times by stage [ms]; stages overlap. "prepare" is the prediction's time without the network's, "save" the
    previous frame's, "cycle" the time since the previous frame."""
    ms = result.ms
    return {
        "read": ms["read"],
        **{stage: row.ms[stage] for stage in ("network", "anchors") if stage in row.ms},
        "ufm": row.ms["uncertainty"],
        "metrics": ms["truth"] + ms["metrics"],
        "write": writing,
        "save": saving,
        "prepare": ms["predict"] - row.ms.get("network", 0.0),
        "cycle": ms["cycle"],
    }


def _anchor_figures(row: RowResult) -> dict[str, Any]:
    """The frame's counts of anchors, and the means of B [m^2] and of r; {} without anchors.

    ``tracked``: corners tracked from the previous frame (for a map of landmarks: all); ``found``: of these,
    triangulated ones (in view); ``usable``: of these, on a pixel with a depth; ``used``: of these, consistent with
    others. ``without``: why no anchor is used; ``confidence``: True if the network's confidence was used.
    """
    landmarks, statistics = row.landmarks, row.statistics
    if landmarks is None or statistics is None or row.anchored is None or row.bias is None:
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
        "mean_anchored": _mean(row.anchored, row.valid),
        "mean_bias": _mean(row.bias, row.valid),
        **_posterior_figures(row),
    }


def _posterior_figures(row: RowResult) -> dict[str, Any]:
    """Figures of held-out anchors (``FrameStatistics``), the quantiles of intervals, and the mean of sqrt(V) of UfM*
    [m], which ``mean_sigma`` is not; {} without a posterior."""
    variance, statistics = row.variance, row.statistics
    if variance is None or statistics is None or statistics.calibration is None or statistics.unseen is None:
        return {}
    calibration = float(statistics.calibration[0])
    figures = {
        "calibration": calibration if math.isfinite(calibration) else None,
        "unseen": float(statistics.unseen[0]),
        "quantiles": None if row.distribution is None else row.distribution.quantiles[0].tolist(),
    }
    return {"posterior": figures, "mean_ufm_sigma": _mean(variance.sqrt(), row.valid)}


def _mean(values: Tensor, valid: Tensor) -> float:
    return float(values[valid].double().mean()) if bool(valid.any()) else float("nan")

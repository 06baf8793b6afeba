"""The sink of ``ufmstar run``: writes every frame's maps and record, and now and then a checkpoint and the summary."""

from __future__ import annotations

import math
from time import perf_counter
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ufmstar_torch.eval.engine.judge import UFM, RunMetrics
from ufmstar_torch.eval.engine.rows import RowResult
from ufmstar_torch.eval.engine.stream import FrameResult, FrameSink, FrameStream
from ufmstar_torch.eval.run.job import RunJob
from ufmstar_torch.eval.run.run_folder import Checkpoint, RunFolder
from ufmstar_torch.eval.run.summary import GOING_ON, NEAR_ZERO, write_summary
from ufmstar_torch.eval.run.writers import frame_file, write_frame, write_pngs
from ufmstar_torch.eval.sequences.frame import Frame

_MAPS = (
    "depth", "variance", "disagreement", "measured", "anchored", "bias",
    "posterior_depth", "posterior_variance", "posterior_inlier_variance", "posterior_outlier",
)  # fmt: skip
_COUNTS = ("components", "segments", "matched", "pairs", "new", "dropped", "valid_pixels", "unmeasured", "single_view")
_SUMMARY_EVERY = 30.0  # [s] between two summaries of an unfinished run


class FrameRecorder(FrameSink):
    """Writes every frame's maps, adds its record to the run's folder, and hands the folder a checkpoint."""

    def __init__(self, job: RunJob, folder: RunFolder, metrics: RunMetrics) -> None:
        self._job, self._folder, self._metrics = job, folder, metrics
        self._earlier, self._unit = list(folder.checkpoint.sessions), folder.checkpoint.unit
        self._saving = 0.0

    def begin(self, stream: FrameStream) -> None:
        """Start the clock of this session."""
        self._first, self._started = stream.position, perf_counter()
        self._summarised = self._started

    def take(self, result: FrameResult) -> None:
        """Write and record a frame. Raises OSError."""
        record, frames = self._record(result), result.number + 1 - self._first
        session = {"first": self._first, "frames": frames, "seconds": perf_counter() - self._started}
        sessions, state = [*self._earlier, session], dict(result.state[UFM])
        checkpoint = Checkpoint(result.number + 1, self._unit, state, self._metrics.sums(), sessions)
        before = perf_counter()
        self._folder.add(record, checkpoint)
        after = perf_counter()
        self._saving = 1000 * (after - before)
        if after - self._summarised > _SUMMARY_EVERY:
            write_summary(self._job, self._folder, *GOING_ON)
            self._summarised = perf_counter()

    def end(self) -> None:
        """Store the last state before pictures are drawn."""
        self._folder.store()

    def _record(self, result: FrameResult) -> dict[str, Any]:
        """The frame's line of frames.jsonl, once its maps are written."""
        about: dict[str, Any] = {"index": result.index, "name": result.name}
        if result.frame is not None and result.frame.timestamp is not None:
            about["timestamp"] = result.frame.timestamp
        if UFM not in result.rows:
            return {**about, "state": "skipped", "reason": result.skipped[UFM]}
        row, before = result.rows[UFM], perf_counter()
        maps = {name: getattr(row, name) for name in _MAPS}
        camera: dict[str, NDArray[Any]] = {"T_world_cam": row.T_world_cam, "intrinsics": row.intrinsics}
        camera |= _anchor_array(result.frame, row)
        written = write_frame(frame_file(self._folder.path, result.name), row.valid, camera, **maps)
        self._unit = write_pngs(self._folder.path, result.name, written, self._unit)
        times = {"ms": _times(result, row, 1000 * (perf_counter() - before), self._saving)}
        return {**about, "state": "done", **_figures(row), **times, **_anchor_figures(row)}


def _figures(row: RowResult) -> dict[str, Any]:
    """Counts and means of a frame."""
    statistics, network_variance, K = row.statistics, row.network_variance, row.intrinsics.tolist()
    assert statistics is not None
    assert row.variance is not None
    assert row.disagreement is not None
    std, valid = row.variance.sqrt(), row.valid
    return {
        "size": list(row.size),
        "intrinsics": [K[0][0], K[1][1], K[0][2], K[1][2]],
        "T_world_cam": row.T_world_cam,
        "member": row.member,
        **{count: int(getattr(statistics, count)[0]) for count in _COUNTS},
        "rotation_deviation": float(statistics.rotation_deviation[0]),
        "mean_disagreement": _mean(row.disagreement, valid),
        "mean_sigma": _mean(std, valid),
        "mean_network_sigma": None if network_variance is None else _mean(network_variance.sqrt(), valid),
        "near_zero": int(((std > 0) & (std < NEAR_ZERO)).sum()),
        "ground_truth": row.truth is not None,
    }


def _times(result: FrameResult, row: RowResult, writing: float, saving: float) -> dict[str, float]:
    """Times by stage [ms]; stages overlap. "prepare" is the prediction's time without the network's. "save" is the
    previous frame's, and "cycle" the time since the previous frame."""
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

    ``tracked`` corners were followed from the frame before (of a map of landmarks: all), ``found`` of them triangulated
    (in view); ``usable`` lie on a pixel with a depth, and ``used`` agree with others. ``without`` is the reason where
    none is used, ``confidence`` whether the network's was used.
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


def _anchor_array(frame: Frame | None, row: RowResult) -> dict[str, NDArray[np.float32]]:
    """With anchors: [N, 4] their u, v in the maps [px], depth and its standard deviation [m]."""
    if row.landmarks is None or frame is None:
        return {}
    anchors = row.landmarks.anchors(frame.intrinsics, torch.from_numpy(row.intrinsics))
    columns = (anchors.pixel[0], anchors.depth[0, :, None], anchors.variance[0, :, None].sqrt())
    return {"anchors": torch.cat(columns, dim=1).float().numpy()}


def _posterior_figures(row: RowResult) -> dict[str, Any]:
    """The posterior's mean sigma [m] and figures of held-out anchors (``FrameStatistics``); {} without one."""
    variance, statistics = row.posterior_variance, row.statistics
    if variance is None or statistics is None or statistics.calibration is None or statistics.unseen is None:
        return {}
    calibration = float(statistics.calibration[0])
    figures = {
        "mean_sigma": _mean(variance.sqrt(), row.valid),
        "calibration": calibration if math.isfinite(calibration) else None,
        "unseen": float(statistics.unseen[0]),
    }
    return {"posterior": figures}


def _mean(values: Tensor, valid: Tensor) -> float:
    return float(values[valid].double().mean()) if bool(valid.any()) else float("nan")

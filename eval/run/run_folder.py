"""The output folder of ``ufmstar run``, and what it keeps of a frame.

```
OUT/run.json       the run's inputs; the same command may compute its results again
OUT/run.lock       locked during a run
OUT/cache          the networks' predictions, with which an interrupted run is soon where it was
OUT/frames.jsonl   one line per frame, in order: pose, intrinsics, counts, means, times; or why it was skipped
```
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ufmstar_torch.eval.check.image_fit import DepthFit, depth_at_pixels, depth_fit
from ufmstar_torch.eval.engine.files import to_json, write_bytes_atomic
from ufmstar_torch.eval.engine.judge import UFM, judge_run
from ufmstar_torch.eval.engine.rows import RowResult
from ufmstar_torch.eval.engine.stream import FrameResult
from ufmstar_torch.eval.metrics.sequence import SequenceMetrics
from ufmstar_torch.eval.run.folder import FolderKind
from ufmstar_torch.eval.run.job import RunJob
from ufmstar_torch.eval.run.writers import (
    FRAMES,
    PNGS,
    frame_file,
    is_frame,
    is_length_png,
    output_arrays,
    write_frame,
    write_pngs,
)
from ufmstar_torch.eval.sequences.frame import Frame
from ufmstar_torch.eval.sequences.own_output import RECORDS
from ufmstar_torch.eval.sequences.plugins import load_plugins
from ufmstar_torch.frames.output import EVERY_FRAME

CACHE = "cache"
NEAR_ZERO = 1e-3  # [m] no depth network is more accurate than this sigma
# Outputs that are made from the finished frames.
_MADE_AT_END = ("preview.mp4", "contact_sheet.png", "mixture.ply", "mixture.npz")
RUN = FolderKind(
    program="ufmstar run",
    noun="run",
    manifest="run.json",
    format=7,
    lock="run.lock",
    files=(f"{FRAMES}/*.npz", *(f"{f}/*.png" for f in PNGS), "summary.json", RECORDS, *_MADE_AT_END),
    recognise={f"{FRAMES}/*.npz": is_frame, **{f"{folder}/*.png": is_length_png for folder in PNGS}},
    allowed=(CACHE,),
    temporary=(".*.tmp", "*/.*.tmp", f"{CACHE}/*/*/.*.tmp"),
)


class RunFolder:
    """Writes the frames of a job into its output folder.

    Attributes:
        records: the lines of frames.jsonl so far.
        metrics: of these frames, by the names of ``judge_run``; {} without ground truth.
        seconds: time from the beginning to the last of these frames.
        outputs: by file that is made from all frames None, or why it was not made.
        first_maps: of ``keep_first_map``.
    """

    def __init__(self, job: RunJob, path: Path) -> None:
        self.job, self.path, self.seconds = job, path, 0.0
        self.records: list[dict[str, Any]] = []
        self.outputs: dict[str, str | None] = {}
        self.metrics: dict[str, SequenceMetrics] = {}
        self._plugins = load_plugins(job.settings.get("plugin", ())).metrics
        self.first_maps: FirstMaps = {}
        self._unit: float | None = None  # of the depth PNGs [m per count]
        RUN.clear(path)  # of an earlier run with the same values
        (path / FRAMES).mkdir(exist_ok=True)
        write_bytes_atomic(path / RECORDS, b"")

    def write(self, result: FrameResult, then: Callable[..., None]) -> None:
        """Write a frame's files, and ``then`` call :meth:`record`. Raises OSError."""
        started = perf_counter()
        if (row := result.rows.get(UFM)) is not None:
            arrays = frame_arrays(result.frame, row)
            write_frame(frame_file(self.path, result.name), arrays)
            self._unit = write_pngs(self.path, result.name, arrays, self._unit)
        then(self.record, result, 1000 * (perf_counter() - started))

    def record(self, result: FrameResult, write_ms: float) -> None:
        """Judge and record a frame, whose files took ``write_ms`` [ms]. Raises OSError."""
        started = perf_counter()
        if (row := result.rows.get(UFM)) is not None:
            judge_run(self.metrics, row, self._plugins)
        ms = {"metrics": 1000 * (perf_counter() - started), "write": write_ms}
        keep_first_map(self.job, result, self.first_maps)
        record: dict[str, Any] = to_json(frame_record(result, UFM, ms))
        with (self.path / RECORDS).open("ab") as file:
            file.write(json.dumps(record, allow_nan=False).encode() + b"\n")
        self.records.append(record)
        self.seconds += result.ms["cycle"] / 1000


# By index of a frame: the network's depth map [h, w], its valid pixels, and the intrinsics of map and image.
FirstMaps = dict[int, tuple[NDArray[Any], NDArray[np.bool_], NDArray[np.float64], NDArray[np.float64]]]


def keep_first_map(job: RunJob, result: FrameResult, maps: FirstMaps) -> None:
    """Add the depth map of a frame in which tracked corners of the job begin."""
    row = result.rows.get(UFM)
    if row is not None and result.frame is not None and any(result.index == one.first for one in job.corners):
        depth, valid = row.prediction.depth[0].numpy(), row.valid.numpy()
        maps[result.index] = depth, valid, row.intrinsics, result.frame.intrinsics


def fitted_depth(job: RunJob, maps: FirstMaps) -> DepthFit | None:
    """Compare maps with the depth of the corners that begin in them; None if the motion is too small, or if the poses
    contradict the images."""
    if job.image_fit is None or job.image_fit.problem:
        return None

    def depth_at(index: int, pixel: NDArray[np.float64]) -> NDArray[Any] | None:
        return depth_at_pixels(*maps[index], pixel) if index in maps else None

    return depth_fit(job.sequence, job.corners, depth_at)


def frame_arrays(frame: Frame | None, row: RowResult) -> dict[str, NDArray[Any]]:
    """The arrays of a frame's file, by name: those of ``output_arrays``, and anchors."""
    arrays = output_arrays(row.out, row.T_world_cam)
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
    count = int(valid.count_nonzero())
    return float(values.where(valid, 0.0).sum(dtype=torch.float64)) / count if count else float("nan")

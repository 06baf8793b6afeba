"""The output folder of ``ufmstar run``.

```
OUT/run.json       the run's inputs; the same command may compute its results again
OUT/run.lock       locked during a run
OUT/cache          the networks' predictions, with which an interrupted run is soon where it was
OUT/frames.jsonl   one line per frame, in order: pose, intrinsics, counts, means, times; or why it was skipped
```
"""

from __future__ import annotations

import json
from pathlib import Path
from time import perf_counter
from typing import Any

from ufmstar_torch.eval.engine.files import to_json, write_bytes_atomic
from ufmstar_torch.eval.engine.judge import UFM, RunMetrics
from ufmstar_torch.eval.engine.stream import FrameResult
from ufmstar_torch.eval.run.folder import FolderKind
from ufmstar_torch.eval.run.frame_record import frame_arrays, frame_record
from ufmstar_torch.eval.run.job import RunJob
from ufmstar_torch.eval.run.writers import (
    FRAMES,
    PNGS,
    frame_file,
    is_frame,
    is_length_png,
    write_frame,
    write_pngs,
)
from ufmstar_torch.eval.sequences.own_output import RECORDS
from ufmstar_torch.eval.sequences.plugins import load_plugins

CACHE = "cache"
# Outputs that are made from the finished frames.
_MADE_AT_END = ("preview.mp4", "contact_sheet.png", "mixture.ply", "mixture.npz")
RUN = FolderKind(
    program="ufmstar run",
    noun="run",
    manifest="run.json",
    format=7,
    lock="run.lock",
    repeats=True,
    files=(f"{FRAMES}/*.npz", *(f"{f}/*.png" for f in PNGS), "summary.json", RECORDS, *_MADE_AT_END),
    recognise={f"{FRAMES}/*.npz": is_frame, **{f"{folder}/*.png": is_length_png for folder in PNGS}},
    allowed=(CACHE,),
    temporary=(".*.tmp", "*/.*.tmp", f"{CACHE}/*/*/.*.tmp"),
)


class RunFolder:
    """Writes the frames of a job into its output folder.

    Attributes:
        records: the lines of frames.jsonl so far.
        metrics: of these frames.
        seconds: time from the beginning to the last of these frames.
        outputs: by file that is made from all frames None, or why it was not made.
    """

    def __init__(self, job: RunJob, path: Path) -> None:
        self.job, self.path, self.seconds = job, path, 0.0
        self.records: list[dict[str, Any]] = []
        self.outputs: dict[str, str | None] = {}
        self.metrics = RunMetrics(load_plugins(job.settings.get("plugin", ())).metrics)
        self._unit: float | None = None  # of the depth PNGs [m per count]
        (path / FRAMES).mkdir(exist_ok=True)
        write_bytes_atomic(path / RECORDS, b"")

    def write(self, result: FrameResult) -> None:
        """Judge, write and record a frame. Raises OSError."""
        started, judged = perf_counter(), 0.0
        if (row := result.rows.get(UFM)) is not None:
            self.metrics.add(row)
            judged = perf_counter() - started
            arrays = frame_arrays(result.frame, row)
            write_frame(frame_file(self.path, result.name), arrays)
            self._unit = write_pngs(self.path, result.name, arrays, self._unit)
        ms = {"metrics": 1000 * judged, "write": 1000 * (perf_counter() - started - judged)}
        record: dict[str, Any] = to_json(frame_record(result, UFM, ms))
        with (self.path / RECORDS).open("ab") as file:
            file.write(json.dumps(record, allow_nan=False).encode() + b"\n")
        self.records.append(record)
        self.seconds += result.ms["cycle"] / 1000

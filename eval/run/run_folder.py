"""The output folder of ``ufmstar run``, and its checkpoint, from which an interrupted run continues.

```
OUT/frames.jsonl       one line per frame, in order: pose, intrinsics, counts, means, times; or why it was skipped
OUT/resume/run.json    the run's inputs
OUT/resume/state.pt    the checkpoint, replaced every few seconds and at the end
OUT/resume/lock        locked during a run
```
A killed run computes the frames after its checkpoint again and writes the same files.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from time import monotonic, perf_counter
from typing import Any

import torch

from ufmstar_torch.eval.engine.judge import UFM
from ufmstar_torch.eval.engine.stream import FrameResult, FrameSink, FrameStream
from ufmstar_torch.eval.metrics.packed_sums import pack, unpack
from ufmstar_torch.eval.run.files import to_json, write_atomic, write_bytes_atomic
from ufmstar_torch.eval.run.folder import FolderError, FolderKind
from ufmstar_torch.eval.run.frame_record import frame_arrays, frame_record, missing_figure
from ufmstar_torch.eval.run.job import Checkpoint, RunJob
from ufmstar_torch.eval.run.writers import (
    FRAMES,
    PNGS,
    frame_file,
    is_frame,
    is_length_png,
    write_frame,
    write_pngs,
)
from ufmstar_torch.eval.sequences.own_output import RECORDS, read_records
from ufmstar_torch.files.tensors import read_tensors

# Outputs that are made from the finished frames.
_MADE_AT_END = ("preview.mp4", "contact_sheet.png", "mixture.ply", "mixture.npz")
CHECKPOINT_EVERY = 2.0  # [s]
RUN = FolderKind(
    program="ufmstar run",
    noun="run",
    manifest="resume/run.json",
    format=6,
    lock="resume/lock",
    files=(f"{FRAMES}/*.npz", *(f"{f}/*.png" for f in PNGS), "summary.json", RECORDS, "resume/state.pt", *_MADE_AT_END),
    recognise={f"{FRAMES}/*.npz": is_frame, **{f"{folder}/*.png": is_length_png for folder in PNGS}},
    temporary=(".*.tmp", "*/.*.tmp"),
)


class RunFolder(FrameSink):
    """The output folder of a new or ``resumed`` job: a sink that writes every frame, and a context manager.

    Attributes:
        checkpoint: the state after the last finished frame; on disk it may be some seconds older.
        records: the lines of frames.jsonl up to that frame.
        metrics: of the frames up to that frame; a sink that must precede this one.

    Raises:
        FolderError: the checkpoint cannot be read.
    """

    def __init__(self, job: RunJob, path: Path, resumed: bool) -> None:
        self.job, self.path = job, path
        self.checkpoint, self.records = _load(path) if resumed else (Checkpoint(), [])
        self.metrics = job.metrics(self.checkpoint)
        (self.path / FRAMES).mkdir(exist_ok=True)
        lines = b"".join(_line(record) for record in self.records)
        write_bytes_atomic(self.path / RECORDS, lines)
        self._stored, self._stored_at, self._saving = self.checkpoint, monotonic(), 0.0

    def __enter__(self) -> RunFolder:
        return self

    def __exit__(self, *_: object) -> None:
        with suppress(OSError):  # a full disk: the run continues from the earlier checkpoint
            self.store()

    def begin(self, stream: FrameStream) -> None:
        """Start the clock of this session."""
        self._earlier, self._first, self._started = list(self.checkpoint.sessions), stream.position, monotonic()

    def take(self, result: FrameResult) -> None:
        """Write and record a frame, and store the checkpoint if the stored one is old. Raises OSError."""
        started, unit, name = perf_counter(), self.checkpoint.unit, result.name
        if (row := result.rows.get(UFM)) is not None:
            arrays = frame_arrays(result.frame, row)
            write_frame(frame_file(self.path, name), arrays)
            unit = write_pngs(self.path, name, arrays, unit)
        done = perf_counter()
        line = _line(frame_record(result, UFM, 1000 * (done - started), self._saving))
        frames, seconds = result.number + 1 - self._first, monotonic() - self._started
        sessions = [*self._earlier, {"first": self._first, "frames": frames, "seconds": seconds}]
        sums = self.metrics.sums()
        checkpoint = Checkpoint(result.number + 1, unit, dict(result.state[UFM]), sums, sessions)
        with (self.path / RECORDS).open("ab") as file:
            file.write(line)
        # Through JSON, so that this run and a resumed one use the same numbers.
        self.records.append(json.loads(line))
        self.checkpoint = checkpoint
        if monotonic() - self._stored_at >= CHECKPOINT_EVERY:
            self.store()
        self._saving = 1000 * (perf_counter() - done)

    def end(self) -> None:
        """Store the last state before pictures are drawn."""
        self.store()

    def store(self) -> None:
        """Write the checkpoint to disk, atomically. Raises OSError; the earlier one stays."""
        if self._stored is self.checkpoint:
            return
        checkpoint = self.checkpoint
        sums = {name: {key: pack(value) for key, value in state.items()} for name, state in checkpoint.metrics.items()}
        content = {**vars(checkpoint), "metrics": sums}
        write_atomic(self.path / "resume" / "state.pt", lambda file: torch.save(content, file))
        self._stored, self._stored_at = checkpoint, monotonic()


def _line(record: Mapping[str, Any]) -> bytes:
    return json.dumps(to_json(record), allow_nan=False).encode() + b"\n"


def _load(out: Path) -> tuple[Checkpoint, list[dict[str, Any]]]:
    """The checkpoint on disk, and the records up to it. Raises FolderError: it is damaged, or frames are missing."""
    file, lines = out / "resume" / "state.pt", out / RECORDS
    if not file.is_file():
        return Checkpoint(), []
    try:
        with file.open("rb") as opened:
            stored = read_tensors(opened, "it")
        sums = {name: {key: unpack(v) for key, v in state.items()} for name, state in stored.pop("metrics").items()}
        checkpoint = Checkpoint(metrics=sums, **stored)
        content = b"".join(lines.read_bytes().splitlines(keepends=True)[: checkpoint.position])
        records = read_records(content, lines)
        for number, record in enumerate(records, start=1):
            if record["state"] == "done" and (figure := missing_figure(record)) is not None:
                raise ValueError(f"{lines}, line {number} has no {figure}")
    except (OSError, RuntimeError, LookupError, TypeError, ValueError) as e:
        raise FolderError(f"--resume: the state in {out} cannot be read ({e}); --overwrite starts again") from e
    if len(records) != checkpoint.position:
        raise FolderError(f"--resume: the state in {out} is incomplete; --overwrite starts again")
    lost = [r["name"] for r in records if r["state"] == "done" and not frame_file(out, r["name"]).is_file()]
    if lost:
        shown = ", ".join(lost[:3])
        raise FolderError(
            f"--resume: {len(lost)} finished frames are gone from {out} ({shown}); --overwrite starts again"
        )
    return checkpoint, records

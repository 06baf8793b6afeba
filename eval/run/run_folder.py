"""The output folder of ``ufmstar run``, and its checkpoint, from which an interrupted run continues.

```
OUT/frames.jsonl       one line per frame, in order: pose, intrinsics, counts, means, times; or why it was skipped
OUT/resume/run.json    what the run was started with
OUT/resume/state.pt    the checkpoint, replaced every few seconds and at the end
OUT/resume/lock        locked during a run
```
A killed run computes the frames after its checkpoint again and writes the same files.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from time import monotonic
from typing import Any

import torch
from torch import Tensor

from ufmstar_torch.eval.metrics.packed_sums import pack, unpack
from ufmstar_torch.eval.run.files import to_json, write_atomic
from ufmstar_torch.eval.run.folder import FolderError, FolderKind, remover
from ufmstar_torch.eval.run.writers import FRAMES, PNGS, frame_file
from ufmstar_torch.eval.sequences.own_output import RECORDS, read_records
from ufmstar_torch.models.checkpoints import read_tensors

# Outputs that are made from the finished frames.
_MADE_AT_END = ("preview.mp4", "contact_sheet.png", "mixture.ply", "mixture.npz", "curves.json")
CHECKPOINT_EVERY = 2.0  # [s]
RUN = FolderKind(
    program="ufmstar run",
    noun="run",
    manifest="resume/run.json",
    format=4,
    lock="resume/lock",
    clear=remover(
        f"{FRAMES}/*.npz",
        *(f"{folder}/*.png" for folder in PNGS),
        "summary.json",
        RECORDS,
        "resume/state.pt",
        *_MADE_AT_END,
    ),
    temporary=(".*.tmp", "*/.*.tmp", ".preview.*.tmp.mp4"),
)


@dataclass(frozen=True)
class Checkpoint:
    """The state of a run after a frame."""

    position: int = 0  # number of frames handled, skipped ones included
    unit: float | None = None  # of the depth PNGs [m per count]; None: no frame is written yet
    state: dict[str, Tensor] = field(default_factory=dict)  # of the run's row: UfM*, alternation, tracks
    metrics: dict[str, dict[str, Tensor]] = field(default_factory=dict)  # sums of the metrics, by name
    # {"first", "frames", "seconds"} of every start of the program.
    sessions: list[dict[str, float]] = field(default_factory=list)


class RunFolder:
    """The output folder of a new or ``resumed`` run, for use with ``with``. ``checkpoint`` is that after the last
    finished frame (on disk it may be some seconds older), ``records`` the lines of frames.jsonl up to there. Raises
    FolderError: the checkpoint cannot be read."""

    def __init__(self, path: Path, resumed: bool) -> None:
        self.path = path
        self.checkpoint, self.records = _load(path) if resumed else (Checkpoint(), [])
        (self.path / FRAMES).mkdir(exist_ok=True)
        lines = b"".join(_line(record) for record in self.records)
        write_atomic(self.path / RECORDS, lambda file: file.write(lines))
        self._stored, self._stored_at = self.checkpoint, monotonic()

    def __enter__(self) -> RunFolder:
        return self

    def __exit__(self, *_: object) -> None:
        with suppress(OSError):  # a full disk: the run continues from the earlier checkpoint
            self.store()

    def add(self, record: Mapping[str, Any], checkpoint: Checkpoint) -> None:
        """Record a frame whose files are written, and store the checkpoint if the last one is old. Raises OSError."""
        line = _line(record)
        with (self.path / RECORDS).open("ab") as file:
            file.write(line)
        # Through JSON, so that this run and one that is continued compute with the same numbers.
        self.records.append(json.loads(line))
        self.checkpoint = checkpoint
        if monotonic() - self._stored_at >= CHECKPOINT_EVERY:
            self.store()

    def store(self) -> None:
        """Write the checkpoint to disk, atomically. Raises OSError; the earlier one stays."""
        if self._stored is self.checkpoint:
            return
        checkpoint = self.checkpoint
        sums = {name: {key: pack(value) for key, value in own.items()} for name, own in checkpoint.metrics.items()}
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
        sums = {name: {key: unpack(v) for key, v in own.items()} for name, own in stored.pop("metrics").items()}
        checkpoint = Checkpoint(metrics=sums, **stored)
        content = b"".join(lines.read_bytes().splitlines(keepends=True)[: checkpoint.position])
        records = read_records(content, lines)
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

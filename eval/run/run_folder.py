"""The output folder of a run, and what is needed to continue the run after any kind of end.

```
OUT/frames.jsonl       one line per frame, in order: counts, means, times; or why it was skipped
OUT/resume/run.json    what the run was started with
OUT/resume/state.pt    UfM*'s state, the metrics' sums and the position, after the last finished frame
OUT/resume/lock        held while a run is going on
OUT/resume/reserve     space that is given back when the disk is full, so that the summary can be written
```
state.pt is replaced every second and at the end. What a killed run wrote after that is written again, with the same
content.
"""

from __future__ import annotations

import json
import math
import zipfile
from collections.abc import Mapping
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from pathlib import Path
from pickle import UnpicklingError
from time import monotonic
from typing import Any

import torch
from torch import Tensor

from ufmstar_torch.eval.metrics.packed_sums import pack, unpack
from ufmstar_torch.eval.run.files import to_json, write_atomic, write_json_atomic
from ufmstar_torch.eval.run.folder import FolderError, FolderKind, OutputFolder, remover
from ufmstar_torch.eval.run.writers import FrameWriter
from ufmstar_torch.eval.sequences.own_output import read_journal

FORMAT = 1
# Outputs that are made from the finished frames.
_MADE_AT_END = ("preview.mp4", "contact_sheet.png", "mixture.ply", "ellipsoids.ply", "mixture.npz", "curves.json")
_FRAMES = ("frames/*.npz", "depth/*.png", "sigma/*.png")
_RESERVE_BYTES = 2**20
STATE_EVERY = 1.0  # [s] between two states on disk: storing one takes some 3 ms, a third of a network's time
RUN = FolderKind(
    program="ufmstar run",
    noun="run",
    manifest="resume/run.json",
    format=FORMAT,
    lock="resume/lock",
    clear=remover(*_FRAMES, "summary.json", "frames.jsonl", "resume/state.pt", "resume/reserve", *_MADE_AT_END),
    temporary=(".*.tmp", "*/.*.tmp", ".preview.*.tmp.mp4"),
)


@dataclass
class Checkpoint:
    """What a run needs to go on."""

    position: int = 0  # number of frames handled, skipped ones included
    journal_bytes: int = 0  # length of frames.jsonl then
    module: dict[str, Tensor] = field(default_factory=dict)  # state of UfM* and of the alternation
    metrics: dict[str, dict[str, Tensor]] = field(default_factory=dict)  # sums of the metrics, by name
    # {"first", "frames", "seconds"} of every start of the program.
    sessions: list[dict[str, float]] = field(default_factory=list)


class RunFolder:
    """The output folder of a new or continued run. Use ``with RunFolder.open(...)``.

    Attributes:
        path: the folder.
        writer: of the frames.
        checkpoint: of the last finished frame (a fresh one at the start).
        records: the lines of frames.jsonl up to there.
    """

    def __init__(self, folder: OutputFolder) -> None:
        self.path, self._folder = folder.path, folder
        self.writer = FrameWriter(folder.path)
        self.checkpoint, self.records = _load(self.writer) if folder.resumed else (Checkpoint(), [])
        self._stored, self._stored_at = self.checkpoint, -math.inf
        # The journal ends at the last finished frame; space is set aside for the summary.
        self._journal = (self.path / "frames.jsonl").open("ab")
        self._journal.truncate(self.checkpoint.journal_bytes)
        write_atomic(self.path / "resume" / "reserve", lambda file: file.write(bytes(_RESERVE_BYTES)))

    @classmethod
    def open(cls, path: str | Path, identity: Mapping[str, Any], *, resume: bool, overwrite: bool) -> RunFolder:
        """Prepare the folder; see ``OutputFolder.open``. ``identity`` holds plain values that must be those of the run
        that is to be continued. Raises FolderError also where the state in the folder cannot be read."""
        folder = OutputFolder.open(Path(path), RUN, {"identity": identity}, resume=resume, overwrite=overwrite)
        with ExitStack() as held:
            held.enter_context(folder)
            run = cls(folder)
            held.pop_all()
        return run

    def __enter__(self) -> RunFolder:
        return self

    def __exit__(self, *_: object) -> None:
        self.release_reserve()
        with suppress(OSError):  # no space even so: the run goes on from the state that is there
            self.store()
        self._journal.truncate(self._stored.journal_bytes)
        self._journal.close()
        self._folder.close()

    def commit(self, record: Mapping[str, Any], checkpoint: Checkpoint) -> None:
        """Record a frame as handled, once its files are written; now and then, :meth:`store`. Raises OSError: a full
        disk, say; the folder stays at the frame before."""
        line = json.dumps(to_json(record), allow_nan=False).encode() + b"\n"
        self._journal.truncate(self.checkpoint.journal_bytes)
        self._journal.write(line)
        self._journal.flush()
        checkpoint.journal_bytes = self.checkpoint.journal_bytes + len(line)
        if monotonic() - self._stored_at >= STATE_EVERY:
            self.store(checkpoint)
        # Through JSON, so that this run and one that is continued compute with the same numbers.
        self.records.append(json.loads(line))
        self.checkpoint = checkpoint

    def store(self, checkpoint: Checkpoint | None = None) -> None:
        """Keep a state on disk, for a run that goes on from it: None = that after the last finished frame. Raises
        OSError: a full disk, say; the state before stays."""
        checkpoint = checkpoint or self.checkpoint
        if self._stored is checkpoint:
            return
        # Plain values and tensors, large ones by their non-zero entries.
        sums = {name: {key: pack(value) for key, value in own.items()} for name, own in checkpoint.metrics.items()}
        content = {**checkpoint.__dict__, "format": FORMAT, "metrics": sums}
        write_atomic(self.path / "resume" / "state.pt", lambda file: torch.save(content, file))
        self._stored, self._stored_at = checkpoint, monotonic()

    def release_reserve(self) -> None:
        """Give the space back that was set aside."""
        (self.path / "resume" / "reserve").unlink(missing_ok=True)

    def write_summary(self, summary: Mapping[str, Any]) -> None:
        """Replace summary.json, on a full disk from the space set aside."""
        try:
            write_json_atomic(self.path / "summary.json", summary)
        except OSError:
            self.release_reserve()
            write_json_atomic(self.path / "summary.json", summary)


def _load(writer: FrameWriter) -> tuple[Checkpoint, list[dict[str, Any]]]:
    """The state after the last finished frame, and the records up to there."""
    out = writer.out_dir
    file, journal = out / "resume" / "state.pt", out / "frames.jsonl"
    if not file.is_file():
        return Checkpoint(), []
    try:
        stored = torch.load(file, map_location="cpu", weights_only=True)
        stored_format = stored.pop("format")
        text = journal.read_bytes()[: stored["journal_bytes"]]
        records = read_journal(text, journal)
    except (OSError, EOFError, RuntimeError, KeyError, UnpicklingError, zipfile.BadZipFile, ValueError) as error:
        raise FolderError(f"--resume: the state in {out} cannot be read ({error}); --overwrite starts again") from error
    lost = [r["name"] for r in records if r["state"] == "done" and not writer.finished(r["name"])]
    if stored_format != FORMAT or len(records) != stored["position"]:
        raise FolderError(f"--resume: the state in {out} is incomplete; --overwrite starts again")
    if lost:
        shown = ", ".join(lost[:3])
        raise FolderError(
            f"--resume: {len(lost)} finished frames are gone from {out} ({shown}); --overwrite starts again"
        )
    sums = {name: {key: unpack(v) for key, v in values.items()} for name, values in stored.pop("metrics").items()}
    return Checkpoint(metrics=sums, **stored), records

"""The output folder of a run: whose it is, and what is needed to go on in it after any kind of end.

```
OUT/frames.jsonl       one line per frame, in order: counts, means, times; or why it was skipped
OUT/resume/run.json    what the run was started with
OUT/resume/state.pt    UfM*'s state, the metrics' sums and the position, after the last finished frame
OUT/resume/lock        held while a run is going on
OUT/resume/reserve     space that is given back when the disk is full, so that the summary can be written
```
state.pt is replaced after every frame, last of all: a frame counts as finished once it is there. What a
killed run wrote after that is written again, with the same content.
"""

from __future__ import annotations

import json
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from pickle import UnpicklingError
from typing import Any, BinaryIO

import torch
from torch import Tensor

from ufmstar_torch.eval.metrics.packed_sums import pack, unpack
from ufmstar_torch.eval.results.files import to_json, write_atomic, write_json_atomic
from ufmstar_torch.eval.results.output_folder import FolderError as FolderError
from ufmstar_torch.eval.results.output_folder import differences, hold
from ufmstar_torch.eval.results.output_folder import flatten as flatten
from ufmstar_torch.eval.results.writers import FrameWriter

FORMAT = 1
PROGRAM = "ufmstar run"
# Outputs that are made from the finished frames; the frames themselves are FrameWriter's.
MADE_AT_END = ("preview.mp4", "contact_sheet.png", "mixture.ply", "ellipsoids.ply", "mixture.npz", "curves.json")
_RESERVE_BYTES = 2**20


@dataclass
class Checkpoint:
    """What a run needs to go on.

    Attributes:
        position: number of frames handled, skipped ones included.
        journal_bytes: length of frames.jsonl then.
        module: state of UfM* and of the alternation.
        metrics: sums of the metrics, by name.
        sessions: {"first", "frames", "seconds"} of every start of the program.
    """

    position: int = 0
    journal_bytes: int = 0
    module: dict[str, Tensor] = field(default_factory=dict)
    metrics: dict[str, dict[str, Tensor]] = field(default_factory=dict)
    sessions: list[dict[str, float]] = field(default_factory=list)


class RunFolder:
    """An output folder, opened for a new run or to go on with one. Use :meth:`open`.

    Attributes:
        path: the folder.
        writer: of the frames.
        checkpoint: of the last finished frame (a fresh one at the start).
        records: the lines of frames.jsonl up to there.
    """

    def __init__(self, path: Path, lock: BinaryIO, checkpoint: Checkpoint, records: list[dict[str, Any]]) -> None:
        self.path = path
        self._lock = lock
        self.writer = FrameWriter(path)
        self.checkpoint = checkpoint
        self.records = records
        self._journal: BinaryIO | None = None

    @classmethod
    def open(cls, path: str | Path, identity: Mapping[str, Any], *, resume: bool, overwrite: bool) -> RunFolder:
        """Prepare the folder; files that are not this program's are never touched.

        Args:
            path: created if missing.
            identity: plain values that must be those of the run that is to be continued.
            resume: go on where an earlier run in the folder stopped; without one, start.
            overwrite: remove what an earlier run left, and start.

        Raises:
            FolderError: the folder holds an earlier run and neither was asked for; other files; a run that was
                started with other values (they are named), is still going on, or whose state cannot be read.
            OSError: the folder cannot be made.
        """
        out, identity = Path(path), to_json(identity)
        if out.exists() and not out.is_dir():
            raise FolderError(f"--out {out} is a file, expected a folder")
        manifest = out / "resume" / "run.json"
        if not manifest.is_file():
            if out.is_dir() and any(out.iterdir()):
                raise FolderError(f"--out {out} holds files of someone else: choose an empty or a new folder")
        elif resume:
            _require_same(out, identity, _read_manifest(manifest))
            lock = _lock(out)
            try:
                return cls(out, lock, *_load(out))
            except FolderError:
                lock.close()
                raise
        elif not overwrite:
            raise FolderError(f"--out {out} holds an earlier run: --resume goes on with it, --overwrite replaces it")
        (out / "resume").mkdir(parents=True, exist_ok=True)
        lock = _lock(out)
        _clear(out)
        write_json_atomic(manifest, {"program": PROGRAM, "format": FORMAT, "identity": identity})
        return cls(out, lock, Checkpoint(), [])

    def __enter__(self) -> RunFolder:
        """Make the journal end at the last finished frame, and set space aside for the summary."""
        self._journal = (self.path / "frames.jsonl").open("ab")
        self._journal.truncate(self.checkpoint.journal_bytes)
        reserve = bytes(_RESERVE_BYTES)
        write_atomic(self.path / "resume" / "reserve", lambda file: file.write(reserve))
        return self

    def __exit__(self, *_: object) -> None:
        self.release_reserve()
        if self._journal is not None:
            self._journal.truncate(self.checkpoint.journal_bytes)
            self._journal.close()
        self._lock.close()

    def commit(self, record: Mapping[str, Any], checkpoint: Checkpoint) -> None:
        """Note a frame as handled, once its files are written.

        Raises:
            OSError: a full disk, say; the folder stays at the frame before.
        """
        if self._journal is None:
            raise ValueError("commit needs an open folder: use `with folder:`")
        line = json.dumps(to_json(record), allow_nan=False).encode() + b"\n"
        self._journal.truncate(self.checkpoint.journal_bytes)
        self._journal.write(line)
        self._journal.flush()
        checkpoint.journal_bytes = self.checkpoint.journal_bytes + len(line)
        stored = _storable(checkpoint)
        write_atomic(self.path / "resume" / "state.pt", lambda file: torch.save(stored, file))
        # Through JSON, so that this run and one that is continued compute with the same numbers.
        self.records.append(json.loads(line))
        self.checkpoint = checkpoint

    def release_reserve(self) -> None:
        """Give the space back that was set aside."""
        (self.path / "resume" / "reserve").unlink(missing_ok=True)

    def write_summary(self, summary: Mapping[str, Any]) -> None:
        """Replace summary.json, on a full disk from the space set aside."""
        try:
            self.writer.write_summary(summary)
        except OSError:
            self.release_reserve()
            self.writer.write_summary(summary)


def _storable(checkpoint: Checkpoint) -> dict[str, Any]:
    """The checkpoint as it is stored: plain values and tensors, large ones by their non-zero entries."""
    metrics = {name: {key: pack(value) for key, value in sums.items()} for name, sums in checkpoint.metrics.items()}
    return {**checkpoint.__dict__, "format": FORMAT, "metrics": metrics}


def _load(out: Path) -> tuple[Checkpoint, list[dict[str, Any]]]:
    """The state after the last finished frame, and the records up to there."""
    file, journal = out / "resume" / "state.pt", out / "frames.jsonl"
    if not file.is_file():
        return Checkpoint(), []
    try:
        stored = torch.load(file, map_location="cpu", weights_only=True)
        stored_format = stored.pop("format")
        text = journal.read_bytes()[: stored["journal_bytes"]]
        records = [json.loads(line) for line in text.splitlines()]
    except (OSError, EOFError, RuntimeError, KeyError, UnpicklingError, zipfile.BadZipFile, ValueError) as error:
        raise FolderError(f"--resume: the state in {out} cannot be read ({error}); --overwrite starts again") from error
    writer = FrameWriter(out)
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


def _lock(out: Path) -> BinaryIO:
    """Hold the folder; the lock goes with the process, however it ends.

    Raises:
        FolderError: another process holds it.
    """
    file = hold(out / "resume" / "lock")
    if file is None:
        raise FolderError(f"--out {out}: another run is writing there now")
    return file


def _clear(out: Path) -> None:
    """Remove what the earlier run left: the frames in its three folders, and its files by their names."""
    FrameWriter(out).clear()
    for name in ("frames.jsonl", "resume/state.pt", "resume/reserve", *MADE_AT_END):
        (out / name).unlink(missing_ok=True)


def _read_manifest(path: Path) -> dict[str, Any]:
    try:
        manifest = json.loads(path.read_text(encoding="utf-8"))
        if manifest["program"] != PROGRAM or manifest["format"] != FORMAT:
            raise ValueError(f"made by {manifest['program']}, format {manifest['format']}")
        return dict(manifest["identity"])
    except (ValueError, KeyError, TypeError) as error:
        raise FolderError(f"--resume: {path} is not a run's that can be continued ({error})") from error


def _require_same(out: Path, now: Mapping[str, Any], then: Mapping[str, Any]) -> None:
    """Raise FolderError, naming every value that differs."""
    told = differences(then, now)
    if told:
        raise FolderError(f"--resume: the run in {out} was started with other input: {told}")

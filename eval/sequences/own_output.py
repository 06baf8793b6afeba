"""The depth that ``ufmstar run`` has written, to be read as predicted maps: with the intrinsics of each."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ufmstar_torch.eval.sequences.intrinsics import pinhole

JOURNAL = "frames.jsonl"


@dataclass(frozen=True, eq=False)
class OwnOutput:
    """An output folder of a run.

    Attributes:
        frames: the folder of its maps, NAME.npz.
        intrinsics: [3, 3] of the map of every finished frame, by name [px].
        skipped: why the others were skipped, by name.
    """

    frames: Path
    intrinsics: Mapping[str, np.ndarray]
    skipped: Mapping[str, str]


def own_output(path: Path) -> OwnOutput | None:
    """The output of a run in a folder, or around it where it is OUT/frames or OUT/depth; None: it is none.

    Raises:
        ValueError: a line of frames.jsonl is none of a run's; file and line are named.
    """
    for out in (path, path.parent) if path.name in ("frames", "depth") else (path,):
        if (out / JOURNAL).is_file() and (out / "frames").is_dir():
            records = read_journal((out / JOURNAL).read_bytes(), out / JOURNAL)
            done = [record for record in records if record["state"] == "done"]
            return OwnOutput(
                out / "frames",
                {record["name"]: pinhole(*record["intrinsics"]) for record in done},
                {record["name"]: record["reason"] for record in records if record["state"] == "skipped"},
            )
    return None


def read_journal(content: bytes, file: Path) -> list[dict]:
    """The lines of frames.jsonl, each with "name" and "state", and "intrinsics" or "reason".

    Args:
        content: of the file, or a part of it.
        file: its name, for the message.

    Raises:
        ValueError: another line; it is named.
    """
    records = []
    for number, line in enumerate(content.splitlines(), start=1):
        try:
            record = json.loads(line)
        except ValueError:
            record = None
        if not (isinstance(record, dict) and isinstance(record.get("name"), str) and _has_outcome(record)):
            raise ValueError(
                f"{file}, line {number} is not the record of a frame: {line[:60].decode(errors='replace')}"
            )
        records.append(record)
    return records


def _has_outcome(record: Mapping) -> bool:
    if record.get("state") == "skipped":
        return isinstance(record.get("reason"), str)
    K = record.get("intrinsics")
    numbers = isinstance(K, list) and len(K) == 4 and all(isinstance(value, int | float) for value in K)
    return record.get("state") == "done" and numbers

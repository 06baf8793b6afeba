"""Reads the output of ``ufmstar run`` as predicted maps with their intrinsics."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ufmstar_torch.eval.sequences.intrinsics import pinhole

RECORDS = "frames.jsonl"


class OwnOutput(NamedTuple):
    """The maps NAME.npz of a run: their folder; the name in them of the network's depth, which is not that of the
    posterior; by frame name the intrinsics [3, 3] of finished frames' maps [px], and the reasons of skipped frames."""

    frames: Path
    depth: str
    intrinsics: Mapping[str, np.ndarray]
    skipped: Mapping[str, str]


def own_output(path: Path) -> OwnOutput | None:
    """The output of a run in a folder, which may also be OUT/frames or OUT/depth; None if there is none. Raises
    ValueError: a line of frames.jsonl is no record; the message names file and line."""
    for out in (path, path.parent) if path.name in ("frames", "depth") else (path,):
        if (out / RECORDS).is_file() and (out / "frames").is_dir():
            records = read_records((out / RECORDS).read_bytes(), out / RECORDS)
            done = [record for record in records if record["state"] == "done"]
            return OwnOutput(
                out / "frames",
                "network_depth" if any("posterior" in record for record in done) else "depth",
                {record["name"]: pinhole(*record["intrinsics"]) for record in done},
                {record["name"]: record["reason"] for record in records if record["state"] == "skipped"},
            )
    return None


def read_records(content: bytes, file: Path) -> list[dict]:
    """The lines of frames.jsonl, each with "name" and "state", and "intrinsics" or "reason"; ``file`` is its name for
    messages. Raises ValueError: a line has another form; the message names it."""
    records = []
    for number, line in enumerate(content.splitlines(), start=1):
        try:
            record = json.loads(line)
            _ = record["name"], record["intrinsics" if record["state"] == "done" else "reason"]
        except (ValueError, KeyError, TypeError, RecursionError) as error:
            shown = line[:60].decode(errors="replace")
            raise ValueError(f"{file}, line {number} is not the record of a frame: {shown}") from error
        records.append(record)
    return records

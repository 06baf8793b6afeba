"""Reads the output of ``ufmstar run`` as predicted maps with their intrinsics."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

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
    """The lines of frames.jsonl, each with "name", "state" and "index", and "intrinsics" or "reason"; ``file`` is its
    name for messages. Raises ValueError: a line has another form; the message names line and field."""
    records = []
    for number, line in enumerate(content.splitlines(), start=1):
        shown = line[:60].decode(errors="replace")
        try:
            record = json.loads(line)
        except (ValueError, RecursionError) as error:
            raise ValueError(f"{file}, line {number} is not the record of a frame: {shown}") from error
        if (wrong := _wrong_field(record)) is not None:
            raise ValueError(f"{file}, line {number} is not the record of a frame ({wrong}): {shown}")
        records.append(record)
    return records


def _wrong_field(record: Any) -> str | None:
    """The first field of a record that is missing or has another form, or None."""
    if not isinstance(record, dict):
        return "an object is expected"
    name, state, index, K = (record.get(field) for field in ("name", "state", "index", "intrinsics"))
    done = state == "done"
    fine = {
        "name": isinstance(name, str) and name != "" and not name.startswith(".") and not set(name) & set("/\\\0"),
        "state": state in ("done", "skipped"),
        "index": not done or (type(index) is int and index >= 0),
        "timestamp": "timestamp" not in record or is_number(record["timestamp"]),
        "intrinsics": not done or (isinstance(K, list) and len(K) == 4 and all(map(is_number, K)) and min(K[:2]) > 0),
        "reason": done or isinstance(record.get("reason"), str),
    }
    return next((f"its {field}" for field, right in fine.items() if not right), None)


def is_number(value: object) -> bool:
    """True for a finite number of JSON."""
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < math.inf

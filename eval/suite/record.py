"""The record of one row on one sequence: the line from which every table and figure is made."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields
from functools import cached_property
from pathlib import Path
from typing import Any

from ufmstar_torch.eval.methods.row import Row, row_from
from ufmstar_torch.eval.run.files import write_json_atomic

FORMAT = 1


@dataclass(frozen=True)
class Record:
    """One row of a table on one sequence."""

    suite: str  # its name, as "paper-table-1"
    dataset: str  # as "scannet"; ``sequence``: its name within it
    sequence: str  # see ``dataset``
    network: str  # as shown, "FastDepth" or "ResNet50-Monodepth2"
    method: str  # the row's name, ``Method.name``
    setting: Mapping[str, Any] = field(default_factory=dict)  # ``Setting.to_dict()``; {} = as the paper runs it
    # "selected", "done", "judged", "skipped" (counts) and "reasons" (count by reason); of UfM* "without_segment" and
    # "without_match", frames that added nothing to the mixture or met nothing in it.
    frames: Mapping[str, Any] = field(default_factory=dict)
    # ``SequenceMetrics.compute()``: "delta1", "nll", "ece_delta", ... (NaN is kept as None).
    figures: Mapping[str, float | None] = field(default_factory=dict)
    # ``SequenceMetrics.curves()``, and "nll_by_error:REFERENCE" over the pixels of which REFERENCE is confident.
    curves: Mapping[str, Any] = field(default_factory=dict)
    # of the multiview method: "bytes_mean", "bytes_max", "bytes_end" [B], "count_mean", "count_max", "count_end"
    # (points or components), "smoothing_bytes" (the map kept for smoothing) [B]; {} if alone.
    state: Mapping[str, float] = field(default_factory=dict)
    # median time per frame [ms] by stage: "network" (one inference, or all of them), "uncertainty".
    ms: Mapping[str, float] = field(default_factory=dict)
    # "versions", "machine", "device", "runtime" of the networks, digests of networks and sequence.
    provenance: Mapping[str, Any] = field(default_factory=dict)

    @cached_property
    def row(self) -> Row:
        """Its row of the table. Raises ValueError: there is no such row."""
        return row_from({"method": self.method, "setting": self.setting})

    @cached_property
    def values(self) -> dict[str, float | None]:
        """All its numbers by name: the figures, "frames.done", "state.bytes_mean", "ms.network" and the like."""
        counts = {f"{group}.{key}": v for group in ("frames", "state", "ms") for key, v in getattr(self, group).items()}
        return {**self.figures, **{name: v for name, v in counts.items() if isinstance(v, int | float)}}

    def save(self, path: Path) -> None:
        """Write it as JSON, whole or not at all."""
        write_json_atomic(path, {"format": FORMAT, **asdict(self)})

    @classmethod
    def load(cls, path: Path) -> Record:
        """Read one. Raises ValueError: the file is not a record of this format; the message names it."""
        try:
            values = json.loads(path.read_text(encoding="utf-8"))
        except (ValueError, RecursionError) as error:
            raise ValueError(f"{path} is not a record: {error}") from error
        names = {f.name for f in fields(cls)}
        if not isinstance(values, dict) or values.pop("format", None) != FORMAT or values.keys() != names:
            raise ValueError(f"{path} is not a record of format {FORMAT}")
        return cls(**values)

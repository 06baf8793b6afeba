"""The record of one row on one sequence, the source of all tables and figures, and its sums."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ufmstar_torch.eval.engine.files import write_atomic, write_json_atomic
from ufmstar_torch.eval.methods.row import Row, row_from
from ufmstar_torch.files.limits import read_json
from ufmstar_torch.files.read import read_npz_whole

FORMAT = 2
SUMS = ".npz"  # suffix of a record's sums
METRICS = "metrics"  # name of the sums of ``SequenceMetrics``
# States of metrics on the CPU by name, to be added over sequences: "metrics" (``SequenceMetrics``) and
# "nll_by_error:REFERENCE" (``NLLByError``); and "confidence", samples of pixels for a recalibration.
Sums = Mapping[str, Mapping[str, Tensor]]
_NOT_STORED = ("path", "sums")


class ResultsError(ValueError):
    """A folder is no evaluation, or its records are inconsistent; the message names the file."""


@dataclass(frozen=True)
class Record:
    """One row of a table on one sequence."""

    method: str  # ``Method.name``
    setting: Mapping[str, Any] = field(default_factory=dict)  # ``Setting.to_dict()``; {} = the default
    # "selected", "done", "judged", "skipped" (counts) and "reasons" (count by reason); for UfM* "without_segment" and
    # "without_match", frames without a segment or without a match in the mixture.
    frames: Mapping[str, Any] = field(default_factory=dict)
    # ``SequenceMetrics.compute()``: "delta1", "nll", "ece_delta", ... (None = NaN).
    figures: Mapping[str, float | None] = field(default_factory=dict)
    # ``SequenceMetrics.curves()``, and "nll_by_error:REFERENCE" over the pixels where REFERENCE is confident.
    curves: Mapping[str, Any] = field(default_factory=dict)
    # Of UfM or UfM*: "bytes_mean", "bytes_max", "bytes_end" [B], "count_mean", "count_max", "count_end" (points or
    # components), "smoothing_bytes" (of the smoothing map) [B]; {} for the network alone.
    state: Mapping[str, float] = field(default_factory=dict)
    # Median time per frame [ms] by stage: "network" (one inference, or all), "uncertainty".
    ms: Mapping[str, float] = field(default_factory=dict)
    suite: str = ""  # name, as "paper-table-1"
    dataset: str = ""  # as "scannet"
    sequence: str = ""  # name in the data set
    network: str = ""  # label, "FastDepth" or "ResNet50-Monodepth2"
    # "versions", "machine", "device", "runtime" of the networks, digests of networks and sequence.
    provenance: Mapping[str, Any] = field(default_factory=dict)
    path: Path = field(default=Path(), compare=False)  # of ROW.json; ROW.npz in the same folder has the sums
    sums: Sums = field(default_factory=dict, compare=False, repr=False)  # of a new record; see :meth:`load_sums`

    @cached_property
    def row(self) -> Row:
        """The row of the table. Raises ValueError: no such row."""
        return row_from({"method": self.method, "setting": self.setting})

    @cached_property
    def values(self) -> dict[str, float | None]:
        """All numbers by name: the figures, "frames.done", "state.bytes_mean", "ms.network" and the like."""
        counts = {f"{group}.{key}": v for group in ("frames", "state", "ms") for key, v in getattr(self, group).items()}
        return {**self.figures, **{name: v for name, v in counts.items() if isinstance(v, int | float)}}

    def save(self, path: Path) -> None:
        """Write the sums, then the record as JSON, each atomically: if the record exists, both are complete."""
        path.unlink(missing_ok=True)  # an unreadable record
        states = ((name, state.items()) for name, state in self.sums.items())
        sums: dict[str, Any] = {f"{name}/{key}": value.numpy() for name, of_name in states for key, value in of_name}
        # Compressed, since Spearman's 514 x 514 counts are mostly 0.
        write_atomic(path.with_suffix(SUMS), lambda file: np.savez_compressed(file, **sums), durable=True)
        names = [f.name for f in fields(self) if f.name not in _NOT_STORED]
        write_json_atomic(path, {"format": FORMAT, **{name: getattr(self, name) for name in names}})

    def load_sums(self) -> Sums:
        """The sums of a stored record. Raises ResultsError: the file has none."""
        path, sums = self.path.with_suffix(SUMS), {METRICS: dict[str, Tensor]()}
        try:
            for key, value in read_npz_whole(path).items():
                name, _, state = key.partition("/")
                sums.setdefault(name, {})[state] = torch.from_numpy(value)
        except (OSError, TypeError, ValueError) as error:
            raise ResultsError(f"{path} does not hold the sums of metrics: {error}") from error
        return sums

    @classmethod
    def load(cls, path: Path) -> Record:
        """Read a record. Raises ResultsError: the file is not a record of this format, or its row does not exist; the
        message names the file."""
        try:
            values = read_json(path)
        except ValueError as error:
            raise ResultsError(f"{path} is not a record: {error}") from error
        names = {f.name for f in fields(cls)} - set(_NOT_STORED)
        if not isinstance(values, dict) or values.pop("format", None) != FORMAT or values.keys() != names:
            raise ResultsError(f"{path} is not a record of format {FORMAT}")
        texts = ("suite", "dataset", "sequence", "network", "method")
        for name, value in values.items():
            if not isinstance(value, str if name in texts else dict):
                raise ResultsError(f"{path} is not a record: {name} is {type(value).__name__}")
        if wrong := [name for name, v in values["figures"].items() if not isinstance(v, int | float | None)]:
            raise ResultsError(f"{path} is not a record: figure {wrong[0]} is no number")
        record = cls(**values, path=path)
        try:
            _ = record.row
        except (ValueError, TypeError, LookupError, AttributeError) as error:
            raise ResultsError(f"{path}: {error}") from error
        return record

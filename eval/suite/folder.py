"""The output folder of ``ufmstar eval`` and its finished records.

```
OUT/eval.json                          suite, rows, networks, sequences, settings
OUT/eval.lock                          locked during an evaluation
OUT/eval.stop                          exists while tasks in other processes must end
OUT/records/DATASET/SEQUENCE/ROW.json  a record, written after ROW.npz: if it exists, both are complete
OUT/records/DATASET/SEQUENCE/failed.json
```
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ufmstar_torch.eval.engine.files import remove_temporaries, write_json_atomic
from ufmstar_torch.eval.engine.record import FORMAT, SUMS, Record, ResultsError
from ufmstar_torch.eval.methods.row import Row
from ufmstar_torch.eval.run.folder import FolderError, FolderKind
from ufmstar_torch.eval.suite.work_items import WorkItem
from ufmstar_torch.files.limits import read_json

FAILED, CACHE, STOP = "failed.json", "cache", "eval.stop"
# Files of a report; --overwrite removes them.
_REPORT = ("efficiency.json", "results.csv", "report.html", "tables/*.tex", "figures/*.png", "figures/*.svg")
_OF_SEQUENCE = ("*.json", f"*{SUMS}", "examples/*.npz")


@dataclass(frozen=True)
class EvalFolder:
    """The records in the output folder ``path`` of ``ufmstar eval``."""

    path: Path

    def sequence_folder(self, item: WorkItem) -> Path:
        """The folder of a sequence."""
        return self.path / "records" / item.folder

    def begin(self, item: WorkItem, rows: Iterable[Row]) -> list[Row]:
        """Create the folder of a sequence, remove temporary files of killed processes, and return the missing rows."""
        folder = self.sequence_folder(item)
        folder.mkdir(parents=True, exist_ok=True)
        remove_temporaries(path for pattern in (".*.tmp", "*/.*.tmp") for path in folder.glob(pattern))
        return self.missing(item, rows)

    def has_begun(self, item: WorkItem, rows: Iterable[Row]) -> bool:
        """True if the sequence has a folder, but neither all records nor the reason of a failure."""
        folder = self.sequence_folder(item)
        return folder.is_dir() and not (folder / FAILED).exists() and bool(self.missing(item, rows))

    def missing(self, item: WorkItem, rows: Iterable[Row]) -> list[Row]:
        """The rows without a readable record."""
        finished = self.records(item)
        return [row for row in rows if row.slug not in finished]

    def records(self, item: WorkItem) -> dict[str, Record]:
        """The finished rows of a sequence, by slug."""
        records = {}
        for path in sorted(self.sequence_folder(item).glob("*.json")):
            if path.name != FAILED and path.with_suffix(SUMS).is_file():
                with suppress(ResultsError):
                    records[path.stem] = Record.load(path)
        return records

    def require_same_sequence(self, item: WorkItem, digest: str, landmarks: Mapping[str, str]) -> None:
        """Raises FolderError: finished rows were computed from other frames, cameras, poses or ``landmarks`` (digests
        by row)."""
        for slug, record in self.records(item).items():
            if slug in landmarks and record.provenance.get("landmarks") != landmarks[slug]:
                raise FolderError(
                    f"{item.label} has other landmarks in {record.setting['anchors']} than when "
                    f"{record.method} was computed there; --overwrite starts again"
                )
            then = record.provenance.get("sequence")
            if then != digest:
                raise FolderError(
                    f"{item.label} has other frames, cameras or poses than when {record.method} was "
                    f"computed there (digest was {str(then)[:16]}, now {digest[:16]}); --overwrite starts again"
                )

    def write(self, item: WorkItem, record: Record) -> None:
        """Store a row, atomically. Raises OSError: it cannot be written."""
        record.save(self.sequence_folder(item) / f"{record.row.slug}.json")

    def fail(self, item: WorkItem, error: Exception | str, rows: Sequence[Row]) -> str:
        """Store why rows of a sequence cannot be computed, and return a line about it."""
        reason = " ".join(str(error).split()) or type(error).__name__
        failure = {"dataset": item.dataset, "sequence": item.sequence, "reason": reason}
        write_json_atomic(self.sequence_folder(item) / FAILED, {**failure, "rows": [row.slug for row in rows]})
        return f"{item.label}: failed: {reason}"

    def failures(self) -> dict[tuple[str, str], str]:
        """By data set and sequence, the reasons for failures, as stored by :meth:`fail`. Raises ResultsError: a file
        has another form."""
        reasons = {}
        for path in sorted(self.path.glob(f"records/*/*/{FAILED}")):
            try:
                stored = read_json(path)
                dataset, sequence, reason = (stored[name] for name in ("dataset", "sequence", "reason"))
                if not all(isinstance(text, str) for text in (dataset, sequence, reason)):
                    raise TypeError("a data set, a sequence and a reason are texts")
            except (ValueError, LookupError, TypeError) as error:
                raise ResultsError(f"{path} is not the record of a failure: {error}") from error
            reasons[dataset, sequence] = reason
        return reasons

    def succeeded(self, item: WorkItem) -> None:
        """Remove the record of an earlier failure."""
        (self.sequence_folder(item) / FAILED).unlink(missing_ok=True)


def _identity(about: Mapping[str, Any], other: Mapping[str, Any]) -> dict[str, Any]:
    """The values that must be equal: suite, settings, and the networks of common bases."""
    networks = {base: made for base, made in about["networks"].items() if base in other["networks"]}
    return {"suite": about["suite"], "settings": about["settings"], "networks": networks}


def _merged(earlier: Mapping[str, Any], current: Mapping[str, Any]) -> dict[str, Any]:
    """The earlier evaluation extended by the current one."""
    networks = {**earlier["networks"], **current["networks"]}
    return {
        **current,
        "networks": networks,
        "missing_bases": [base for base in current["missing_bases"] if base not in networks],
        **{
            name: [*earlier[name], *(value for value in current[name] if value not in earlier[name])]
            for name in ("rows", "sequences", "datasets")
        },
    }


# Rows, sequences and networks are added to the earlier evaluation; suite, settings and the networks of the same base
# must be equal. The cache of predictions is never removed.
EVALUATION = FolderKind(
    program="ufmstar eval",
    noun="evaluation",
    manifest="eval.json",
    format=FORMAT,
    lock="eval.lock",
    files=(STOP, *(f"records/*/*/{pattern}" for pattern in _OF_SEQUENCE), *_REPORT),
    allowed=(CACHE,),
    temporary=(".eval.json.*.tmp",),
    identity=_identity,
    merge=_merged,
)

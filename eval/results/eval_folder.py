"""The output folder of ``ufmstar eval``: what is finished in it, and which process works on which sequence.

```
OUT/eval.json                       what is evaluated: suite, rows, networks, sequences, settings
OUT/eval.lock                       held while eval.json is made or extended
OUT/records/DATASET/SEQUENCE/.claim-N  names the process that works on the sequence; see ``claim``
OUT/records/DATASET/SEQUENCE/ROW.json  a record, written after ROW.pt: where it exists, both are complete
OUT/records/DATASET/SEQUENCE/failed.json
```
Several processes may work in one folder, on one computer or many that see it.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import torch

from ufmstar_torch.eval.engine.evaluate import RowResult
from ufmstar_torch.eval.methods.row import Row
from ufmstar_torch.eval.metrics.packed_sums import pack
from ufmstar_torch.eval.results.claim import PATTERN, Claim, claim
from ufmstar_torch.eval.results.record import FORMAT, Record
from ufmstar_torch.eval.results.worklist import WorkItem
from ufmstar_torch.eval.run.files import remove_temporaries, write_atomic, write_json_atomic
from ufmstar_torch.eval.run.folder import FolderError, FolderKind, OutputFolder, remover

FAILED, CACHE = "failed.json", "cache"
# What a report leaves; removed by --overwrite.
_REPORT: tuple[str, ...] = ("efficiency.json", "results.json", "results.csv", "table.csv", "report.html")
_REPORT += ("tables/*.md", "tables/*.tex", "figures/*.png", "figures/*.svg", "figures/*.json")
_OF_SEQUENCE = ("*.json", "*.pt", "examples/*.npz", "room/*.npz", PATTERN)


class EvalFolder:
    """An output folder of ``ufmstar eval``, which :meth:`open` makes; ``path`` is the folder."""

    def __init__(self, path: Path) -> None:
        self.path = path

    @classmethod
    def open(cls, out: Path, about: Mapping[str, Any], *, resume: bool, overwrite: bool) -> EvalFolder:
        """Make the folder, or go on in it; see ``OutputFolder.open``. When going on, rows, sequences and networks of
        ``about`` (eval.json) are added to those of the earlier evaluation; suite, settings and the networks of the same
        base must be the same. The cache of predictions is never removed. Raises FolderError also where a process is at
        one of the sequences."""
        with OutputFolder.open(out, EVALUATION, about, resume=resume, overwrite=overwrite):
            return cls(out)

    def place(self, item: WorkItem) -> Path:
        """The folder of a sequence."""
        return self.path / "records" / item.folder

    def claim(self, item: WorkItem, launch: str) -> Claim | None:
        """Claim a sequence; None while another process has it. ``launch`` as :func:`claim` takes it."""
        place = self.place(item)
        place.mkdir(parents=True, exist_ok=True)
        claimed = claim(place, launch)
        if claimed is not None:
            remove_temporaries(path for pattern in (".*.tmp", "*/.*.tmp") for path in place.glob(pattern))
        return claimed

    def missing(self, item: WorkItem, rows: Iterable[Row]) -> list[Row]:
        """The rows without a record; a record that cannot be read counts as none."""
        finished = self.records(item)
        return [row for row in rows if row.slug not in finished]

    def records(self, item: WorkItem) -> dict[str, Record]:
        """The finished rows of a sequence, by slug."""
        records = {}
        for path in sorted(self.place(item).glob("*.json")):
            if path.name != FAILED and path.with_suffix(".pt").is_file():
                try:
                    records[path.stem] = Record.load(path)
                except ValueError:
                    continue
        return records

    def require_same_sequence(self, item: WorkItem, digest: str, landmarks: Mapping[str, str]) -> None:
        """Raises FolderError where finished rows were computed from other frames, cameras, poses or ``landmarks``,
        whose digests are by row."""
        for slug, record in self.records(item).items():
            if slug in landmarks and record.provenance.get("landmarks") != landmarks[slug]:
                raise FolderError(
                    f"--resume: {item.label} has other landmarks in {record.setting['anchors']} than when "
                    f"{record.method} was computed there; --overwrite starts again"
                )
            then = record.provenance.get("sequence")
            if then != digest:
                raise FolderError(
                    f"--resume: {item.label} has other frames, cameras or poses than when {record.method} was "
                    f"computed there (digest was {str(then)[:16]}, now {digest[:16]}); --overwrite starts again"
                )

    def keep(self, item: WorkItem, record: Record, result: RowResult) -> None:
        """Store a row, completely or not at all. Raises OSError: it cannot be written."""
        path = self.place(item) / f"{result.row.slug}.json"
        sums = {name: {key: pack(value) for key, value in states.items()} for name, states in result.sums.items()}
        path.unlink(missing_ok=True)  # one that could not be read
        write_atomic(path.with_suffix(".pt"), lambda file: torch.save(sums, file), durable=True)
        record.save(path)

    def fail(self, item: WorkItem, reason: str, rows: Sequence[Row], launch: str) -> None:
        """Store why a sequence could not be evaluated."""
        about = {"dataset": item.dataset, "sequence": item.sequence, "reason": reason}
        rest = {"rows": [row.slug for row in rows], "launch": launch}
        write_json_atomic(self.place(item) / FAILED, {**about, **rest})

    def failure(self, item: WorkItem) -> dict[str, Any] | None:
        """What :meth:`fail` has stored about a sequence; None if nothing."""
        path = self.place(item) / FAILED
        try:
            failure = json.loads(path.read_text(encoding="utf-8"))
        except FileNotFoundError:
            return None
        except ValueError:
            return {"reason": f"{path} cannot be read", "rows": [], "launch": ""}
        return failure if isinstance(failure, dict) else None

    def failures(self, items: Iterable[WorkItem]) -> dict[str, str]:
        """Why a sequence is broken, by its label."""
        stored = {item.label: self.failure(item) for item in items}
        return {label: str(failure.get("reason")) for label, failure in stored.items() if failure is not None}

    def succeeded(self, item: WorkItem) -> None:
        """Forget an earlier failure."""
        (self.place(item) / FAILED).unlink(missing_ok=True)


def _identity(about: Mapping[str, Any], other: Mapping[str, Any]) -> dict[str, Any]:
    """The values that must be the same: suite, settings, and the networks of bases that both have."""
    networks = {base: made for base, made in about["networks"].items() if base in other["networks"]}
    return {"suite": about["suite"], "settings": about["settings"], "networks": networks}


def _merged(then: Mapping[str, Any], now: Mapping[str, Any]) -> dict[str, Any]:
    """An earlier evaluation together with what the present one adds."""
    networks = {**then["networks"], **now["networks"]}
    return {
        **now,
        "networks": networks,
        "missing_bases": [base for base in now["missing_bases"] if base not in networks],
        **{name: _union(then[name], now[name]) for name in ("rows", "sequences", "datasets", "sweep")},
    }


def _union(first: list[Any], second: list[Any]) -> list[Any]:
    return [*first, *(value for value in second if value not in first)]


def _clear(out: Path) -> None:
    """Remove what an earlier evaluation and its report left, by their names; the cache stays. Raises FolderError: a
    process is at one of its sequences."""
    places = sorted({path.parent for path in out.glob(f"records/*/*/{PATTERN}")})
    with ExitStack() as held:
        for place in places:
            own = claim(place, "")
            if own is None:
                raise FolderError(f"--out {out}: another process is evaluating {place.name} there now")
            held.enter_context(own)
    for place in places:
        remover(*_OF_SEQUENCE)(place)
        for folder in (place / "examples", place / "room", place, place.parent, out / "records"):
            if folder.is_dir() and not any(folder.iterdir()):
                folder.rmdir()
    remover(*_REPORT)(out)


EVALUATION = FolderKind(
    program="ufmstar eval",
    noun="evaluation",
    manifest="eval.json",
    format=FORMAT,
    lock="eval.lock",
    held="opening",
    wait=60.0,
    clear=_clear,
    allowed=(CACHE,),
    temporary=(".eval.json.*.tmp",),
    identity=_identity,
    merge=_merged,
)

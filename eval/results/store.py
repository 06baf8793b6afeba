"""The output folder of ``ufmstar eval``: whose it is, what is finished in it, who is at which sequence.

```
OUT/eval.json                       what is evaluated: suite, rows, networks, sequences, settings
OUT/eval.lock                       held while eval.json is made or extended
OUT/records/DATASET/SEQUENCE/.claim    held while a process is at the sequence; says which launch took it last
OUT/records/DATASET/SEQUENCE/ROW.json  a record, written after ROW.pt: its presence says that both are there
OUT/records/DATASET/SEQUENCE/failed.json
```
Several processes may work in one folder, on one computer or many that see it.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import torch

from ufmstar_torch.eval.engine.evaluate import RowResult
from ufmstar_torch.eval.methods.row import Row
from ufmstar_torch.eval.metrics.packed_sums import pack
from ufmstar_torch.eval.results.files import to_json, write_atomic, write_json_atomic
from ufmstar_torch.eval.results.output_folder import FolderError, differences, hold
from ufmstar_torch.eval.results.record import FORMAT, Record
from ufmstar_torch.eval.results.worklist import WorkItem

PROGRAM = "ufmstar eval"
MANIFEST, LOCK, CLAIM, FAILED, CACHE = "eval.json", "eval.lock", ".claim", "failed.json", "cache"
_WAIT_SECONDS = 60.0  # for another process that is just making eval.json
# What a report leaves; removed by --overwrite.
_REPORT = ("efficiency.json", "results.json", "results.csv", "table.csv", "report.html")
_REPORT_PARTS = {"tables": (".md", ".tex"), "figures": (".png", ".svg", ".json")}


@dataclass
class Claim:
    """A sequence that this process is at, to be used with ``with``.

    Attributes:
        died: whether a process of the same launch took it before and ended in the middle.
    """

    file: BinaryIO
    died: bool

    def __enter__(self) -> Claim:
        return self

    def __exit__(self, *_: object) -> None:
        # Emptied: the sequence was left in good order.
        self.file.truncate(0)
        self.file.close()


class EvalFolder:
    """An output folder that is this program's. Use :meth:`open`.

    Attributes:
        path: the folder.
        about: eval.json.
    """

    def __init__(self, path: Path, about: Mapping[str, Any]) -> None:
        self.path, self.about = path, about

    @classmethod
    def open(cls, out: Path, about: Mapping[str, Any], *, resume: bool, overwrite: bool) -> EvalFolder:
        """Make the folder, or go on in it; files that are not this program's are never touched.

        Args:
            out: created if missing.
            about: eval.json. Rows, sequences and networks are added to those that are there; suite, settings and
                the networks of the same base must be the same.
            resume: go on with what is there; without anything, start.
            overwrite: remove what is there but for the cache of predictions, and start.

        Raises:
            FolderError: the folder holds an earlier evaluation and neither was asked for, one of something else
                (what differs is named), one that is going on, or other files.
            OSError: the folder cannot be made.
        """
        if out.exists() and not out.is_dir():
            raise FolderError(f"--out {out} is a file, expected a folder")
        manifest = out / MANIFEST
        if not manifest.is_file() and out.is_dir() and _foreign(out):
            raise FolderError(f"--out {out} holds files of someone else: choose an empty or a new folder")
        if manifest.is_file() and not (resume or overwrite):
            raise FolderError(
                f"--out {out} holds an earlier evaluation: --resume goes on with it, --overwrite replaces it"
            )
        out.mkdir(parents=True, exist_ok=True)
        lock = hold(out / LOCK, wait=_WAIT_SECONDS)
        if lock is None:
            raise FolderError(f"--out {out}: another process is preparing it for over {_WAIT_SECONDS:g} s")
        with lock:
            # Asked again: another process may have made it while this one waited.
            if manifest.is_file() and not (resume or overwrite):
                raise FolderError(f"--out {out}: another evaluation has begun there; --resume joins it")
            if overwrite:
                _clear(out)
            now = to_json({"program": PROGRAM, "format": FORMAT, **about})
            then = _read_manifest(manifest) if manifest.is_file() else None
            if then is not None:
                now = _extended(out, then, now)
            if now != then:
                write_json_atomic(manifest, now)
        return cls(out, now)

    def place(self, item: WorkItem) -> Path:
        """The folder of a sequence."""
        return self.path / "records" / item.folder

    def claim(self, item: WorkItem, launch: str) -> Claim | None:
        """Take a sequence; None while another process has it.

        Args:
            item: the sequence.
            launch: the same for all processes that were started together.
        """
        place = self.place(item)
        place.mkdir(parents=True, exist_ok=True)
        file = hold(place / CLAIM)
        if file is None:
            return None
        file.seek(0)
        before = file.read().decode(errors="replace")
        file.truncate(0)
        file.write(launch.encode())
        file.flush()
        return Claim(file, before == launch)

    def missing(self, item: WorkItem, rows: Iterable[Row]) -> list[Row]:
        """The rows without a record; a record that cannot be read counts as none."""
        there = self.records(item)
        return [row for row in rows if row.slug not in there]

    def records(self, item: WorkItem) -> dict[str, Record]:
        """The finished rows of a sequence, by slug."""
        found = {}
        for path in sorted(self.place(item).glob("*.json")):
            if path.name != FAILED and path.with_suffix(".pt").is_file():
                try:
                    found[path.stem] = Record.load(path)
                except ValueError:
                    continue
        return found

    def require_same_sequence(self, item: WorkItem, digest: str) -> None:
        """Raises FolderError where the finished rows were computed from other frames, cameras or poses."""
        for record in self.records(item).values():
            then = record.provenance.get("sequence")
            if then != digest:
                raise FolderError(
                    f"--resume: {item.label} has other frames, cameras or poses than when {record.method} was "
                    f"computed there (digest was {str(then)[:16]}, now {digest[:16]}); --overwrite starts again"
                )

    def keep(self, item: WorkItem, record: Record, result: RowResult) -> None:
        """Keep a row, whole or not at all.

        Raises:
            OSError: it cannot be written.
        """
        path = self.place(item) / f"{result.row.slug}.json"
        sums = {name: {key: pack(value) for key, value in states.items()} for name, states in result.sums.items()}
        path.unlink(missing_ok=True)  # one that could not be read
        write_atomic(path.with_suffix(".pt"), lambda file: torch.save(sums, file), durable=True)
        record.save(path)

    def fail(self, item: WorkItem, reason: str, rows: Sequence[Row], launch: str) -> None:
        """Keep why a sequence could not be evaluated."""
        about = {"dataset": item.dataset, "sequence": item.sequence, "reason": reason}
        rest = {"rows": [row.slug for row in rows], "launch": launch}
        write_json_atomic(self.place(item) / FAILED, {**about, **rest})

    def failure(self, item: WorkItem) -> dict[str, Any] | None:
        """What :meth:`fail` has kept of a sequence."""
        path = self.place(item) / FAILED
        try:
            found = json.loads(path.read_text(encoding="utf-8"))
        except FileNotFoundError:
            return None
        except ValueError:
            return {"reason": f"{path} cannot be read", "rows": [], "launch": ""}
        return found if isinstance(found, dict) else None

    def succeeded(self, item: WorkItem) -> None:
        """Forget an earlier failure."""
        (self.place(item) / FAILED).unlink(missing_ok=True)


def _foreign(out: Path) -> list[str]:
    """Names that this program did not make, in a folder without eval.json."""
    own = (LOCK, CACHE)
    return [path.name for path in out.iterdir() if path.name not in own and not path.name.startswith(f".{MANIFEST}.")]


def _read_manifest(path: Path) -> dict[str, Any]:
    try:
        about = json.loads(path.read_text(encoding="utf-8"))
        if about["program"] != PROGRAM or about["format"] != FORMAT:
            raise ValueError(f"made by {about['program']}, format {about['format']}")
        return dict(about)
    except (ValueError, KeyError, TypeError) as error:
        raise FolderError(f"--resume: {path} is not an evaluation's that can be continued ({error})") from error


def _extended(out: Path, then: Mapping[str, Any], now: Mapping[str, Any]) -> dict[str, Any]:
    """What is there and what is new together.

    Raises:
        FolderError: they contradict each other.
    """
    told = differences(_identity(then, now), _identity(now, then))
    if told:
        raise FolderError(f"--resume: the evaluation in {out} was started with other input: {told}")
    networks = {**then["networks"], **now["networks"]}
    return {
        **now,
        "networks": networks,
        "missing_bases": [base for base in now["missing_bases"] if base not in networks],
        **{name: _union(then[name], now[name]) for name in ("rows", "sequences", "datasets", "sweep")},
    }


def _identity(about: Mapping[str, Any], other: Mapping[str, Any]) -> dict[str, Any]:
    """What must be the same: suite, settings, and the networks that both have."""
    networks = {base: made for base, made in about["networks"].items() if base in other["networks"]}
    return {"suite": about["suite"], "settings": about["settings"], "networks": networks}


def _union(first: list[Any], second: list[Any]) -> list[Any]:
    return [*first, *(value for value in second if value not in first)]


def _clear(out: Path) -> None:
    """Remove what an earlier evaluation and its report left, by their names; the cache stays.

    Raises:
        FolderError: a process is at one of its sequences.
    """
    places = sorted(path.parent for path in out.glob(f"records/*/*/{CLAIM}"))
    claims = [hold(place / CLAIM) for place in places]
    try:
        if None in claims:
            raise FolderError(f"--out {out}: another process is evaluating {places[claims.index(None)].name} there now")
        for place in places:
            for pattern in ("*.json", "*.pt", "examples/*.npz", "room/*.npz", CLAIM):
                for file in place.glob(pattern):
                    file.unlink()
            for folder in (place / "examples", place / "room", place, place.parent, out / "records"):
                if folder.is_dir() and not any(folder.iterdir()):
                    folder.rmdir()
    finally:
        for claim in claims:
            if claim is not None:
                claim.close()
    for name in (*_REPORT, MANIFEST):
        (out / name).unlink(missing_ok=True)
    for name, endings in _REPORT_PARTS.items():
        for file in (out / name).glob("*"):
            if file.suffix in endings:
                file.unlink()

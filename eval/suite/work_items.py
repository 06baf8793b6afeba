"""The sequences of an evaluation."""

from __future__ import annotations

import hashlib
import random
import re
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path

from ufmstar_torch.eval.sequences.frame import FrameSequence
from ufmstar_torch.eval.sequences.options import Options
from ufmstar_torch.files.limits import read_text

TOUR = "tour"
_ROOT = re.compile(r"(?P<dataset>[A-Za-z0-9][A-Za-z0-9._-]*)=(?P<path>.+)")
_AS_THEY_ARE = Options()
_UNSAFE = re.compile(r"[^A-Za-z0-9._+-]+")


@dataclass(frozen=True, order=True)
class WorkItem:
    """A sequence that is not open; items are ordered by data set and name."""

    dataset: str  # as "scannet"
    sequence: str  # name, unique within the data set
    path: str  # argument of ``open_sequence``, may be ``tour:SEED``
    opening: Options = field(default=_AS_THEY_ARE, compare=False)  # options of ``open_sequence``

    @property
    def folder(self) -> Path:
        """DATASET/SEQUENCE below "records", both in characters that every file system accepts."""
        return Path(_safe(self.dataset), _safe(self.sequence))

    @property
    def label(self) -> str:
        """The displayed name, "DATASET/SEQUENCE"."""
        return f"{self.dataset}/{self.sequence}"

    def open(self) -> FrameSequence:
        """Open the sequence. Raises FileNotFoundError, ValueError: it cannot be opened, or its scale is unknown."""
        from ufmstar_torch.eval.run.scale import require_metric
        from ufmstar_torch.eval.sequences.open import open_sequence

        sequence = open_sequence(self.path, **self.opening.changed())
        require_metric(sequence)
        return sequence


def find_work(
    roots: Iterable[str],
    *,
    sample: int | None = None,
    seed: int = 0,
    only: Iterable[str] | None = None,
    opening: Options = _AS_THEY_ARE,
) -> list[WorkItem]:
    """All sequences below the roots, data sets in the order of the roots, sequences by name.

    Args:
        roots: ``[DATASET=]PATH``: a folder with sequences below it, a sequence, or ``tour:SEED``. DATASET is the
            layout's name by default. Write "./" before a path that contains "=".
        sample: largest number of sequences of each data set, chosen at random; None = all.
        seed: of the sample, which depends on the names alone and not on folders.
        only: names of sequences (or DATASET/NAME) to use; the sample is drawn from them. None = all.
        opening: options of all sequences; only its layout is searched for ("auto" = any).

    Raises:
        FileNotFoundError: no such root.
        ValueError: no sequence below a root, an unknown name in ``only``, or one name twice in a data set.
    """
    found = [item for root in roots for item in _below(root, opening)]
    order_of_dataset = {name: number for number, name in enumerate(dict.fromkeys(item.dataset for item in found))}
    items = sorted(set(found), key=lambda item: (order_of_dataset[item.dataset], item))
    twice = [key for key, n in Counter(item.folder for item in items).items() if n > 1]
    if twice:
        paths = ", ".join(item.path for item in items if item.folder == twice[0])
        raise ValueError(f"--root: {twice[0].as_posix()} stands for {paths}: name their data sets, DATASET=DIR")
    if only is not None:
        chosen = _chosen(items, list(only))
        items = [item for item in items if item in chosen]
    if sample is None:
        return items
    sampled: list[WorkItem] = []
    for dataset in dict.fromkeys(item.dataset for item in items):
        of_dataset = [item for item in items if item.dataset == dataset]
        # random.sample draws positions in the list, which is sorted by name.
        sampled += sorted(random.Random(seed).sample(of_dataset, min(sample, len(of_dataset))))
    return sampled


def read_names(file: Path) -> list[str]:
    """The lines of a file, without comments (# ...) and empty ones.

    Raises:
        FileNotFoundError: no such file.
        ValueError: it names nothing.
    """
    lines = [line.partition("#")[0].strip() for line in read_text(file).splitlines()]
    names = [line for line in lines if line]
    if not names:
        raise ValueError(f"--sequence-list {file} names no sequence")
    return names


def _below(root: str, opening: Options) -> list[WorkItem]:
    """The sequences of one root."""
    match = _ROOT.fullmatch(root)
    dataset, path = (match["dataset"], match["path"]) if match else (None, root)
    if path.startswith(f"{TOUR}:"):
        return [WorkItem(dataset or TOUR, path, path, replace(opening, layout="auto"))]
    from ufmstar_torch.eval.sequences.layout import find_sequences

    found = find_sequences(path, layout=opening.layout, plugin=opening.plugin)
    if not found:
        raise ValueError(f"--root {root}: no sequence of a known layout is there or below")
    each = ((one, replace(opening, layout=one.layout)) for one in found)
    return [WorkItem(dataset or one.layout, one.name, str(one.path.absolute()), how) for one, how in each]


def _chosen(items: list[WorkItem], only: list[str]) -> set[WorkItem]:
    """The items with the names ``only``. Raises ValueError: a name without an item."""
    named = {name: [item for item in items if name in (item.sequence, item.label)] for name in only}
    missing = [name for name, chosen in named.items() if not chosen]
    if missing:
        shown = ", ".join(missing[:3]) + (f" and {len(missing) - 3} more" if len(missing) > 3 else "")
        raise ValueError(f"--sequence-list names sequences that are not there: {shown}")
    return {item for chosen in named.values() for item in chosen}


def _safe(name: str) -> str:
    """The name if every file system accepts it, else with dashes and a few hex digits that keep it unique."""
    plain = _UNSAFE.sub("-", name).strip(".-")[:100]
    return name if plain == name else f"{plain}-{hashlib.sha256(name.encode()).hexdigest()[:8]}"

"""The sequences of an evaluation, one after another: whatever is missing of each is computed and kept."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch

from ufmstar_torch.eval.engine.confident import references
from ufmstar_torch.eval.engine.evaluate import RowResult, SequenceError, evaluate_sequence
from ufmstar_torch.eval.engine.load import NetworkChoice
from ufmstar_torch.eval.engine.predictions import DepthSource
from ufmstar_torch.eval.engine.stream import Stopped
from ufmstar_torch.eval.methods.method import ALONE
from ufmstar_torch.eval.methods.row import Row
from ufmstar_torch.eval.methods.suite import Suite
from ufmstar_torch.eval.results.cache import PredictionCache
from ufmstar_torch.eval.results.eval_folder import CACHE, EvalFolder
from ufmstar_torch.eval.results.examples import Examples, ExampleWriter
from ufmstar_torch.eval.results.machine import hardware, versions
from ufmstar_torch.eval.results.record import Record
from ufmstar_torch.eval.results.worklist import Shard, WorkItem, content_digest
from ufmstar_torch.eval.sequences.frame import FrameError

Evaluate = Callable[..., list[RowResult]]
# What a sequence that cannot be used raises when it is opened or evaluated. A mistake in this program raises others,
# and ends it.
_BROKEN = (SequenceError, FrameError, RuntimeError, ValueError)
_POLL_SECONDS = 0.2
DIED = "the process that evaluated it was killed (for want of memory?)"
# Of a sequence of single images.
_NO_POSES = "its images have no poses: the rows of networks alone are finished, {} that compare views cannot be had"


@dataclass(frozen=True)
class EvalJob:
    """What is evaluated.

    Attributes:
        suite: its rows are those whose networks there are.
        missing_bases: bases of rows that were left out.
        networks: chosen, by base.
        items: the sequences.
        out: the folder for everything that is written.
        frames: which of each sequence.
        cache: folder of predictions; None = in ``out``.
        device: "cpu", "cuda", "cuda:1".
        confident: share of a frame's pixels of which a reference method counts as confident.
        examples: of each data set, sequences of which a few frames are kept for pictures.
        samples: passes of MC-Dropout.
    """

    suite: Suite
    networks: Mapping[str, NetworkChoice]
    items: tuple[WorkItem, ...]
    out: Path
    missing_bases: tuple[str, ...] = ()
    frames: slice = field(default_factory=lambda: slice(None))
    cache: Path | None = None
    device: str = "cpu"
    confident: float = 0.5
    examples: int = 3
    samples: int | None = None

    def load(self, device: torch.device) -> dict[str, DepthSource]:
        """The networks that the rows need.

        Raises:
            FileNotFoundError, ValueError, ImportError: see ``NetworkChoice.load``.
        """
        passes = {} if self.samples is None else {"samples": self.samples}
        needed = [self.networks[base] for base in self.suite.bases]
        return {choice.base: choice.load(device, **passes) for choice in needed}

    def about(self, networks: Mapping[str, DepthSource]) -> dict[str, Any]:
        """eval.json."""
        suite, f = self.suite, self.frames
        opening = {name: value for item in self.items for name, value in item.opening}
        return {
            "suite": suite.name,
            "title": suite.title,
            "sweep": list(suite.sweep),
            "networks": {base: network.identity for base, network in networks.items()},
            "rows": [{"method": row.method.name, "setting": row.setting.to_dict()} for row in suite.rows],
            "datasets": sorted({item.dataset for item in self.items}),
            "sequences": [{"dataset": item.dataset, "sequence": item.sequence} for item in self.items],
            "missing_bases": list(self.missing_bases),
            "settings": {"frames": [f.start, f.stop, f.step], "confident": self.confident, **opening},
            "versions": versions(),
            "machine": hardware(),
        }

    def keeps_examples(self, item: WorkItem) -> bool:
        """Whether the sequence is one of the first of its data set, which pictures are drawn of."""
        same = [other for other in self.items if other.dataset == item.dataset]
        return item in same[: self.examples]


@dataclass(frozen=True)
class Conduct:
    """How one process takes part.

    Attributes:
        shard: the part that it begins with.
        helps: take sequences of other parts afterwards; for processes that were started together.
        waits: stay until the sequences that others are at are finished.
        launch: the same for all processes that were started together.
        stop: asked before every frame.
        tell: gets a line when a sequence is finished.
        progress: called with a sequence's label, its frames that are done, and all of them.
    """

    shard: Shard = field(default_factory=Shard)
    helps: bool = False
    waits: bool = False
    launch: str = ""
    stop: Callable[[], bool] = lambda: False
    tell: Callable[[str], None] = lambda line: None
    progress: Callable[[str, int, int], None] = lambda label, done, total: None


def run_job(
    job: EvalJob,
    folder: EvalFolder,
    networks: Mapping[str, DepthSource],
    conduct: Conduct,
    evaluate: Evaluate = evaluate_sequence,
) -> bool:
    """Go through the sequences.

    Args:
        job: what is evaluated.
        folder: opened for the job.
        networks: loaded for the job.
        conduct: this process's part in it.
        evaluate: judges the rows on a sequence; see ``evaluate_sequence``.

    Returns:
        Whether it came to the end; False = ``stop`` said so. Broken sequences are told by ``folder.failure``.

    Raises:
        FolderError: results that are there were computed from another sequence of that name.
        CacheError, OSError: nothing can be written.
    """
    cache = PredictionCache(job.cache or job.out / CACHE)
    own = conduct.shard.of(job.items)
    queue = [*own, *(item for item in job.items if conduct.helps and item not in own)]
    launch = conduct.launch or f"{os.getpid()} {time.time_ns()}"
    while queue:
        taken: list[WorkItem] = []
        for item in queue:
            if conduct.stop():
                return False
            claim = folder.claim(item, launch)
            if claim is None:
                taken.append(item)
                continue
            with claim:
                try:
                    _take(job, folder, networks, item, _Turn(conduct, cache, launch, evaluate, claim.died))
                except Stopped:
                    return False
        queue = taken if conduct.waits else []
        if queue:
            time.sleep(_POLL_SECONDS)
        elif taken and not conduct.helps:
            conduct.tell(f"left to another process that is at it: {', '.join(item.label for item in taken)}")
    return True


@dataclass(frozen=True)
class _Turn:
    """What the work on one sequence needs beside the job."""

    conduct: Conduct
    cache: PredictionCache
    launch: str
    evaluate: Evaluate
    died: bool


def _take(job: EvalJob, folder: EvalFolder, networks: Mapping[str, DepthSource], item: WorkItem, turn: _Turn) -> None:
    """Compute and keep what is missing of a sequence, or why it cannot be had."""
    failure = folder.failure(item)
    if failure is not None and failure.get("launch") == turn.launch:
        return  # by another process of this launch
    missing = folder.missing(item, job.suite.rows)
    if turn.died and missing:
        folder.fail(item, DIED, missing, turn.launch)
        turn.conduct.tell(f"{item.label}: failed: {DIED}")
        return
    started = time.monotonic()
    try:
        sequence = item.open()
        digest = content_digest(sequence)
    except (*_BROKEN, OSError) as error:
        _fail(folder, item, error, missing, turn)
        return
    folder.require_same_sequence(item, digest)
    if not missing:
        folder.succeeded(item)
        return
    # Images without poses are for the networks alone; what compares views stays undone, and is told.
    possible = [row for row in job.suite.rows if sequence.posed or row.method.fusion == ALONE]
    left_out = [row for row in missing if row not in possible]
    todo = [row for row in missing if row in possible]
    sinks = [ExampleWriter(Examples(folder.place(item)))] if job.keeps_examples(item) else []
    try:
        results = turn.evaluate(
            sequence,
            with_references(todo, possible) if todo else missing,
            networks,
            store=turn.cache,
            device=torch.device(job.device),
            limit=job.frames,
            sinks=sinks,
            confident=job.confident,
            stop=turn.conduct.stop,
            progress=lambda done, total: turn.conduct.progress(item.label, done, total),
        )
    except _BROKEN as error:
        _fail(folder, item, error, missing, turn)
        return
    provenance = {"versions": versions(), "machine": hardware(), "device": job.device, "sequence": digest}
    for result in results:
        if result.row in missing:
            folder.keep(item, _record(job, item, networks, result, provenance), result)
    frames = results[0].frames.get("done", 0) if results else 0
    turn.conduct.tell(f"{item.label}: {len(todo)} rows, {frames} frames, {time.monotonic() - started:.1f} s")
    if left_out:
        _fail(folder, item, ValueError(_NO_POSES.format(len(left_out))), left_out, turn)
    else:
        folder.succeeded(item)


def with_references(missing: Sequence[Row], rows: Sequence[Row]) -> list[Row]:
    """The missing rows and those whose confidence they are judged by, in the order of ``rows``."""
    needed = {*missing, *(reference for row in missing for reference in references(row, rows))}
    return [row for row in rows if row in needed]


def failures(folder: EvalFolder, items: Iterable[WorkItem]) -> dict[str, str]:
    """Why a sequence is broken, by its label."""
    found = {item.label: folder.failure(item) for item in items}
    return {label: str(failure.get("reason")) for label, failure in found.items() if failure is not None}


def _fail(folder: EvalFolder, item: WorkItem, error: Exception, rows: Sequence[Row], turn: _Turn) -> None:
    reason = " ".join(str(error).split()) or type(error).__name__
    folder.fail(item, reason, rows, turn.launch)
    turn.conduct.tell(f"{item.label}: failed: {reason}")


def _record(
    job: EvalJob,
    item: WorkItem,
    networks: Mapping[str, DepthSource],
    result: RowResult,
    provenance: Mapping[str, Any],
) -> Record:
    network = networks[result.row.method.base]
    return Record(
        suite=job.suite.name,
        dataset=item.dataset,
        sequence=item.sequence,
        network=network.label,
        method=result.row.method.name,
        setting=result.row.setting.to_dict(),
        frames=result.frames,
        figures=result.figures,
        curves=result.curves,
        state=result.state,
        ms=result.ms,
        provenance={**provenance, "network": network.digest, "threads": torch.get_num_threads()},
    )

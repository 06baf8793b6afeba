"""The work of an evaluation: for one sequence after another, the rows that are missing are computed and stored."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch

from ufmstar_torch.eval.engine.anchors import landmark_digests
from ufmstar_torch.eval.engine.evaluate import BROKEN, Judge, RowResult, SequenceTask, evaluate_sequences
from ufmstar_torch.eval.engine.judge import references
from ufmstar_torch.eval.engine.load import NetworkChoice
from ufmstar_torch.eval.engine.predictions import DepthSource
from ufmstar_torch.eval.engine.stream import Stopped
from ufmstar_torch.eval.methods.method import ALONE
from ufmstar_torch.eval.methods.row import Row
from ufmstar_torch.eval.methods.suite import Suite
from ufmstar_torch.eval.results.cache import PredictionCache
from ufmstar_torch.eval.results.claim import Claim
from ufmstar_torch.eval.results.eval_folder import CACHE, EvalFolder
from ufmstar_torch.eval.results.examples import ExampleWriter
from ufmstar_torch.eval.results.machine import hardware, versions
from ufmstar_torch.eval.results.record import Record
from ufmstar_torch.eval.results.worklist import Shard, WorkItem, content_digest
from ufmstar_torch.models.inference import Inference
from ufmstar_torch.recalibrate import read_recalibration

Evaluate = Callable[..., None]
_POLL_SECONDS = 0.2
DIED = "the process that evaluated it was killed (for want of memory?)"
# Of a sequence of single images.
_NO_POSES = "its images have no poses: the rows of networks alone are finished, {} that compare views cannot be had"
_FITTED = "{} recalibrated rows were fitted to this sequence and are not judged on it"


@dataclass(frozen=True)
class EvalJob:
    """What is evaluated."""

    suite: Suite  # its rows, of the bases that have a network
    networks: Mapping[str, NetworkChoice]  # chosen, by base
    items: tuple[WorkItem, ...]  # the sequences
    out: Path  # the folder for everything that is written
    missing_bases: tuple[str, ...] = ()  # bases of rows that were left out
    frames: slice = field(default_factory=lambda: slice(None))  # which of each sequence
    cache: Path | None = None  # folder of predictions; None = in ``out``
    device: str = "cpu"  # "cpu", "cuda", "cuda:1"
    confident: float = 0.5  # share of a frame's pixels of which a reference method counts as confident
    bins: str = "ours"  # of the calibration errors: "ours" or "authors", see ``SequenceMetrics``
    examples: int = 3  # of each data set, sequences of which a few frames are stored for pictures
    samples: int | None = None  # passes of MC-Dropout
    # runtime, precision: of the networks (``Inference``).
    runtime: str = "auto"
    precision: str = "float32"
    streams: int = 1  # sequences that a process evaluates at the same time

    @property
    def unused(self) -> tuple[str, ...]:
        """Bases with a network that no row of the suite has."""
        return tuple(base for base in self.networks if base not in self.suite.bases)

    def load(self, device: torch.device) -> dict[str, DepthSource]:
        """The networks that the rows need. Raises FileNotFoundError, ValueError, ImportError, see
        ``NetworkChoice.load``."""
        passes = {} if self.samples is None else {"samples": self.samples}
        needed = [self.networks[base] for base in self.suite.bases]
        inference = Inference(self.runtime, self.precision)
        return {choice.base: choice.load(device, inference=inference, **passes) for choice in needed}

    def about(self, networks: Mapping[str, DepthSource]) -> dict[str, Any]:
        """eval.json."""
        suite, f = self.suite, self.frames
        bins = {} if self.bins == "ours" else {"bins": self.bins}  # as folders have it that were written before
        opening = {name: value for item in self.items for name, value in item.opening}
        return {
            "suite": suite.name,
            "title": suite.title,
            "sweep": list(suite.sweep),
            "networks": {base: network.identity for base, network in networks.items()},
            "rows": [row.to_dict() for row in suite.rows],
            "datasets": sorted({item.dataset for item in self.items}),
            "sequences": [{"dataset": item.dataset, "sequence": item.sequence} for item in self.items],
            "missing_bases": list(self.missing_bases),
            "settings": {"frames": [f.start, f.stop, f.step], "confident": self.confident, **bins, **opening},
            "versions": versions(),
            "machine": hardware(),
        }

    def keeps_examples(self, item: WorkItem) -> bool:
        """Whether the sequence is one of the first of its data set, from which pictures are drawn."""
        same = [other for other in self.items if other.dataset == item.dataset]
        return item in same[: self.examples]


@dataclass(frozen=True)
class WorkerContext:
    """How one process takes part in an evaluation."""

    shard: Shard = field(default_factory=Shard)  # the part of the sequences that it begins with
    helps: bool = False  # take sequences of other parts afterwards; for processes that were started together
    waits: bool = False  # stay until the sequences that other processes work on are finished
    launch: str = ""  # the same for all processes that were started together; "" = one of its own
    stop: Callable[[], bool] = lambda: False  # asked before every frame
    report: Callable[[str], None] = lambda line: None  # receives a line when a sequence is finished
    # called with a sequence's label, its number of finished frames, and the number of all of them.
    progress: Callable[[str, int, int], None] = lambda label, done, total: None
    evaluate: Evaluate = evaluate_sequences  # computes rows on sequences; see ``evaluate_sequences``


def run_job(job: EvalJob, folder: EvalFolder, networks: Mapping[str, DepthSource], context: WorkerContext) -> bool:
    """Evaluate the sequences one after another, with the folder opened and the networks loaded for the job; whether it
    came to the end (False: ``context.stop`` ended it). ``folder.failure`` reports broken sequences.

    Raises:
        FolderError: earlier results were computed from another sequence of that name.
        CacheError, OSError: nothing can be written.
    """
    context = replace(context, launch=context.launch or f"{os.getpid()} {time.time_ns()}")
    worker = _Worker(job, folder, networks, context)
    cache = PredictionCache(job.cache or job.out / CACHE)
    judge = Judge(networks, torch.device(job.device), cache, job.frames, job.confident, job.bins, job.streams)
    own = context.shard.of(job.items)
    queue = [*own, *(item for item in job.items if context.helps and item not in own)]
    try:
        while queue:
            taken: list[WorkItem] = []
            context.evaluate(worker.tasks(queue, taken), judge, worker.finish, stop=context.stop)
            queue = taken if context.waits else []
            if queue:
                time.sleep(_POLL_SECONDS)
            elif taken and not context.helps:
                context.report(f"left to another process that is at it: {', '.join(item.label for item in taken)}")
    except Stopped:
        return False
    finally:
        worker.release()
    return True


@dataclass(frozen=True, eq=False)
class _InHand:
    """A sequence that is evaluated."""

    # item, claim: which, and the claim to it.
    item: WorkItem
    claim: Claim
    # digest, landmarks: what its rows are computed from.
    digest: str
    landmarks: Mapping[str, str]
    missing: Sequence[Row]  # rows to store
    left_out: Sequence[Row]  # those of them that cannot be had of this sequence, and why
    why: str
    started: float  # [s] ``time.monotonic``


class _Worker:
    """One process at its work; see ``run_job``."""

    def __init__(
        self, job: EvalJob, folder: EvalFolder, networks: Mapping[str, DepthSource], context: WorkerContext
    ) -> None:
        self.job, self.folder, self.networks, self.context = job, folder, networks, context
        self._in_hand: dict[SequenceTask, _InHand] = {}

    def tasks(self, queue: Iterable[WorkItem], taken: list[WorkItem]) -> Iterator[SequenceTask]:
        """Claim one sequence of the queue after another; those with rows to compute are opened. ``taken`` gets the
        sequences that another process has.

        Raises:
            Stopped: the caller asked to stop.
            FolderError: as :func:`run_job`.
        """
        for item in queue:
            if self.context.stop():
                raise Stopped
            claim = self.folder.claim(item, self.context.launch)
            if claim is None:
                taken.append(item)
                continue
            task = None
            try:
                task = self._begin(item, claim)
            finally:
                if task is None:
                    claim.release()
            if task is not None:
                yield task

    def release(self) -> None:
        """Give up the sequences in hand."""
        for one in self._in_hand.values():
            one.claim.release()

    def _begin(self, item: WorkItem, claim: Claim) -> SequenceTask | None:
        """Open a sequence; None: nothing is to be computed of it."""
        failure = self.folder.failure(item)
        if failure is not None and failure.get("launch") == self.context.launch:
            return None  # of another process of this launch
        missing = self.folder.missing(item, self.job.suite.rows)
        if claim.died and missing:
            self._fail(item, DIED, missing)
            return None
        try:
            sequence = item.open()
            digest = content_digest(sequence)
            landmarks = landmark_digests(self.job.suite.rows, sequence.folder)
        except (*BROKEN, OSError) as error:
            self._fail(item, error, missing)
            return None
        self.folder.require_same_sequence(item, digest, landmarks)
        posed = [row for row in self.job.suite.rows if sequence.posed or row.method.fusion == ALONE]
        possible = [row for row in posed if not _fitted_to(row, digest)]
        left_out = [row for row in missing if row not in possible]
        why = (_FITTED if sequence.posed else _NO_POSES).format(len(left_out))
        one = _InHand(item, claim, digest, landmarks, missing, left_out, why, time.monotonic())
        if not missing:
            self._settle(one)
            return None
        todo = [row for row in missing if row in possible]
        rows = with_references(todo, possible) if todo else missing
        sinks = [ExampleWriter(self.folder.place(item))] if self.job.keeps_examples(item) else []
        task = SequenceTask(sequence, rows, sinks, partial(self.context.progress, item.label))
        self._in_hand[task] = one
        return task

    def finish(self, task: SequenceTask, outcome: list[RowResult] | Exception) -> None:
        """Store the missing rows of a sequence, or the reason why they cannot be had."""
        one = self._in_hand[task]
        if isinstance(outcome, Exception):
            self._fail(one.item, outcome, one.missing)
        else:
            self._store(one, [result for result in outcome if result.row in one.missing])
            frames = outcome[0].frames.get("done", 0) if outcome else 0
            rows, seconds = len(one.missing) - len(one.left_out), time.monotonic() - one.started
            self.context.report(f"{one.item.label}: {rows} rows, {frames} frames, {seconds:.1f} s")
            self._settle(one)
        del self._in_hand[task]
        one.claim.release()

    def _settle(self, one: _InHand) -> None:
        """All possible rows are stored."""
        if one.left_out:
            self._fail(one.item, one.why, one.left_out)
        else:
            self.folder.succeeded(one.item)

    def _fail(self, item: WorkItem, error: Exception | str, rows: Sequence[Row]) -> None:
        reason = " ".join(str(error).split()) or type(error).__name__
        self.folder.fail(item, reason, rows, self.context.launch)
        self.context.report(f"{item.label}: failed: {reason}")

    def _store(self, one: _InHand, results: Iterable[RowResult]) -> None:
        """Store rows with what they were computed from."""
        item, landmarks = one.item, one.landmarks
        common = {"versions": versions(), "machine": hardware(), "device": self.job.device, "sequence": one.digest}
        many: dict[str, Any] = {"streams": self.job.streams} if self.job.streams > 1 else {}
        for result in results:
            row, network = result.row, self.networks[result.row.method.base]
            own = {"landmarks": landmarks[row.slug]} if row.slug in landmarks else {}
            record = Record(
                suite=self.job.suite.name,
                dataset=item.dataset,
                sequence=item.sequence,
                network=network.label,
                method=row.method.name,
                setting=row.setting.to_dict(),
                frames=result.frames,
                figures=result.figures,
                curves=result.curves,
                state=result.state,
                ms=result.ms,
                provenance={
                    **common,
                    **many,
                    "network": network.digest,
                    "runtime": network.runtime,
                    "threads": torch.get_num_threads(),
                    **own,
                },
            )
            self.folder.keep(item, record, result)


def _fitted_to(row: Row, digest: str) -> bool:
    """Whether the row's recalibration was fitted to the sequence with this digest."""
    name = row.setting.recalibration
    return bool(name) and digest in read_recalibration(name).digests


def with_references(missing: Sequence[Row], rows: Sequence[Row]) -> list[Row]:
    """The missing rows and those whose confidence they are judged by, in the order of ``rows``."""
    needed = {*missing, *(reference for row in missing for reference in references(row, rows))}
    return [row for row in rows if row in needed]


def failures(folder: EvalFolder, items: Iterable[WorkItem]) -> dict[str, str]:
    """Why a sequence is broken, by its label."""
    stored = {item.label: folder.failure(item) for item in items}
    return {label: str(failure.get("reason")) for label, failure in stored.items() if failure is not None}

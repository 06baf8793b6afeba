"""The work of an evaluation: for one sequence after another, the rows that are missing are computed and stored."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch

from ufmstar_torch.eval.engine.anchors import landmark_digests
from ufmstar_torch.eval.engine.evaluate import BROKEN, Judge, RowResult, evaluate_sequence
from ufmstar_torch.eval.engine.judge import references
from ufmstar_torch.eval.engine.load import NetworkChoice
from ufmstar_torch.eval.engine.predictions import DepthSource
from ufmstar_torch.eval.engine.stream import FrameSink, Stopped
from ufmstar_torch.eval.methods.method import ALONE
from ufmstar_torch.eval.methods.row import Row
from ufmstar_torch.eval.methods.suite import Suite
from ufmstar_torch.eval.results.cache import PredictionCache
from ufmstar_torch.eval.results.claim import Claim
from ufmstar_torch.eval.results.eval_folder import CACHE, EvalFolder
from ufmstar_torch.eval.results.examples import ExampleWriter
from ufmstar_torch.eval.results.record import Record
from ufmstar_torch.eval.results.worklist import Shard, WorkItem, content_digest
from ufmstar_torch.eval.run.machine import hardware, versions
from ufmstar_torch.eval.sequences.frame import FrameSequence
from ufmstar_torch.models.inference import Inference
from ufmstar_torch.recalibrate import read_recalibration

Evaluate = Callable[..., list[RowResult]]
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
class WorkerTask:
    """What one process does of an evaluation; pickled for another process."""

    job: EvalJob  # what is evaluated
    shard: Shard = field(default_factory=Shard)  # the part of the sequences that it begins with
    local: int = 0  # number of the process on its computer, which decides its GPU
    helps: bool = False  # take sequences of other parts afterwards; for processes that were started together
    waits: bool = False  # stay until the sequences that other processes work on are finished
    launch: str = ""  # the same for all processes that were started together; "" = one of its own
    threads: int | None = None  # of the CPU; None = torch's own choice
    debug: bool = False  # show tracebacks


@dataclass(frozen=True, eq=False, kw_only=True)
class _InHand:
    """A sequence that is evaluated."""

    sequence: FrameSequence
    rows: Sequence[Row]  # to compute
    sinks: Sequence[FrameSink]
    # item, claim: which, and the claim to it.
    item: WorkItem
    claim: Claim
    # digest, landmarks: what its rows are computed from.
    digest: str
    landmarks: Mapping[str, str]
    missing: Sequence[Row]  # rows to store
    left_out: Sequence[Row]  # those of them that cannot be had of this sequence
    started: float  # [s] ``time.monotonic``


class Worker:
    """A process that takes part in an evaluation.

    Args:
        task: its part.
        folder: opened for the job.
        networks: of the job, loaded.
        stop: asked before every frame; True ends the work.
        report: receives a line when a sequence is finished.
        progress: called with a sequence's label, its number of finished frames, and the number of all of them.
        evaluate: computes rows on a sequence; see ``evaluate_sequence``.
    """

    def __init__(
        self,
        task: WorkerTask,
        folder: EvalFolder,
        networks: Mapping[str, DepthSource],
        *,
        stop: Callable[[], bool] = lambda: False,
        report: Callable[[str], None] = lambda line: None,
        progress: Callable[[str, int, int], None] = lambda label, done, total: None,
        evaluate: Evaluate = evaluate_sequence,
    ) -> None:
        self.task, self.job, self.folder, self.networks = task, task.job, folder, networks
        self.stop, self.report, self.progress, self.evaluate = stop, report, progress, evaluate
        self._launch = task.launch or f"{os.getpid()} {time.time_ns()}"
        self._in_hand: list[_InHand] = []

    def run(self) -> bool:
        """Evaluate the sequences one after another; whether it came to the end (False: ``stop`` ended it).
        ``EvalFolder.failure`` reports broken sequences.

        Raises:
            FolderError: earlier results were computed from another sequence of that name.
            CacheError, OSError: nothing can be written.
        """
        job, task = self.job, self.task
        cache = PredictionCache(job.cache or job.out / CACHE)
        device = torch.device(job.device)
        judge = Judge(self.networks, device, cache, job.frames, job.confident, job.bins)
        own = task.shard.of(job.items)
        queue = [*own, *(item for item in job.items if task.helps and item not in own)]
        try:
            while queue:
                taken: list[WorkItem] = []
                for one in self._tasks(queue, taken):
                    self._evaluate(one, judge)
                queue = taken if task.waits else []
                if queue:
                    time.sleep(_POLL_SECONDS)
                elif taken and not task.helps:
                    self.report(f"left to another process that is at it: {', '.join(item.label for item in taken)}")
        except Stopped:
            return False
        finally:
            for one in self._in_hand:
                one.claim.release()
        return True

    def _tasks(self, queue: Iterable[WorkItem], taken: list[WorkItem]) -> Iterator[_InHand]:
        """Claim one sequence of the queue after another; those with rows to compute are opened. ``taken`` gets the
        sequences that another process has. Raises Stopped, FolderError, as :meth:`run`."""
        for item in queue:
            if self.stop():
                raise Stopped
            claim = self.folder.claim(item, self._launch)
            if claim is None:
                taken.append(item)
                continue
            one = None
            try:
                one = self._begin(item, claim)
            finally:
                if one is None:
                    claim.release()
            if one is not None:
                self._in_hand.append(one)
                yield one

    def _begin(self, item: WorkItem, claim: Claim) -> _InHand | None:
        """Open a sequence; None: nothing is to be computed of it."""
        failure, rows = self.folder.failure(item), self.job.suite.rows
        if failure is not None and failure.get("launch") == self._launch:
            return None  # of another process of this launch
        missing = self.folder.missing(item, rows)
        if claim.died and missing:
            self._fail(item, DIED, missing)
            return None
        try:
            sequence = item.open()
            digest = content_digest(sequence)
            landmarks = landmark_digests(rows, sequence.folder)
        except (*BROKEN, OSError) as error:
            self._fail(item, error, missing)
            return None
        self.folder.require_same_sequence(item, digest, landmarks)
        posed = [row for row in rows if sequence.posed or row.method.fusion == ALONE]
        possible = [row for row in posed if not _fitted_to(row, digest)]
        todo = [row for row in missing if row in possible]
        one = _InHand(
            sequence=sequence,
            rows=with_references(todo, possible) if todo else missing,
            sinks=[ExampleWriter(self.folder.place(item))] if self.job.keeps_examples(item) else [],
            item=item,
            claim=claim,
            digest=digest,
            landmarks=landmarks,
            missing=missing,
            left_out=[row for row in missing if row not in possible],
            started=time.monotonic(),
        )
        if missing:
            return one
        self._settle(one)
        return None

    def _evaluate(self, one: _InHand, judge: Judge) -> None:
        outcome: list[RowResult] | Exception
        how: dict[str, Any] = {"sinks": one.sinks, "stop": self.stop}
        how["progress"] = lambda now: self.progress(one.item.label, now.done, now.total)
        try:
            outcome = self.evaluate(one.sequence, one.rows, judge, **how)
        except BROKEN as error:
            outcome = error
        self._finish(one, outcome)

    def _finish(self, one: _InHand, outcome: list[RowResult] | Exception) -> None:
        """Store the missing rows of a sequence, or the reason why they cannot be had."""
        if isinstance(outcome, Exception):
            self._fail(one.item, outcome, one.missing)
        else:
            self._store(one, [result for result in outcome if result.row in one.missing])
            frames = outcome[0].frames.get("done", 0) if outcome else 0
            rows, seconds = len(one.missing) - len(one.left_out), time.monotonic() - one.started
            self.report(f"{one.item.label}: {rows} rows, {frames} frames, {seconds:.1f} s")
            self._settle(one)
        self._in_hand.remove(one)
        one.claim.release()

    def _settle(self, one: _InHand) -> None:
        """All possible rows are stored."""
        if one.left_out:
            why = _FITTED if one.sequence.posed else _NO_POSES
            self._fail(one.item, why.format(len(one.left_out)), one.left_out)
        else:
            self.folder.succeeded(one.item)

    def _fail(self, item: WorkItem, error: Exception | str, rows: Sequence[Row]) -> None:
        reason = " ".join(str(error).split()) or type(error).__name__
        self.folder.fail(item, reason, rows, self._launch)
        self.report(f"{item.label}: failed: {reason}")

    def _store(self, one: _InHand, results: Iterable[RowResult]) -> None:
        """Store rows with what they were computed from."""
        item, landmarks = one.item, one.landmarks
        common: dict[str, Any] = {"versions": versions(), "machine": hardware(), "device": self.job.device}
        common |= {"sequence": one.digest}
        for result in results:
            row, network = result.row, self.networks[result.row.method.base]
            made_of = {"network": network.digest, "runtime": network.runtime, "threads": torch.get_num_threads()}
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
                provenance={**common, **made_of, **own},
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

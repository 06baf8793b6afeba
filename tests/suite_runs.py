"""Evaluations of a second: rooms of 48x64, rows that are judged by a stub or on ground truth."""

from __future__ import annotations

import hashlib
import json
import shutil
from dataclasses import replace

import torch
from layouts import write_generic

from ufmstar_torch.eval.engine.judge import RowFigures
from ufmstar_torch.eval.engine.load import NetworkChoice
from ufmstar_torch.eval.engine.progress import Progress
from ufmstar_torch.eval.engine.stream import Stopped
from ufmstar_torch.eval.methods.suite import suite_named
from ufmstar_torch.eval.metrics import SequenceMetrics
from ufmstar_torch.eval.suite.job import EvalJob
from ufmstar_torch.eval.suite.shards import evaluate_suite
from ufmstar_torch.eval.suite.work_items import ALL, find_work

TRUTH = "depth_only=ground-truth:24x32"
NAMES = ("ash", "birch", "cedar")


def write_rooms(root, names=NAMES, frames=4):
    """Generic sequences of the same walk; those that are there are written anew."""
    first, _ = write_generic(root, frames, folder=names[0])
    for name in names[1:]:
        shutil.copytree(first, root / name, dirs_exist_ok=True)
    return root


def job_on(root, out, **changes):
    """The first four rows of depth alone on the sequences of a folder."""
    whole = suite_named("depth-only")
    job = EvalJob(
        suite=replace(whole, rows=whole.rows[:4]),
        networks={"depth_only": NetworkChoice.parse(TRUTH)},
        items=tuple(find_work([f"rooms={root}"])),
        out=out,
        examples=0,
    )
    return replace(job, **changes)


class Stub:
    """Judges nothing: figures are numbers drawn from the names of row and sequence.

    Args:
        before: called with the sequence's name and the frames that are done.

    Attributes:
        asked: (sequence, rows) of each call.
    """

    def __init__(self, before=lambda name, done: None):
        self.before, self.asked = before, []

    def __call__(self, sequence, rows, networks, *, stop, progress, **_):
        self.asked.append((sequence.name, [row.method.name for row in rows]))
        for done in range(len(sequence)):
            self.before(sequence.name, done)
            if stop():
                raise Stopped
            progress(Progress("frames", done + 1, len(sequence)))
        return [_drawn(sequence, row) for row in rows]


def _drawn(sequence, row):
    seed = int(hashlib.sha256(f"{sequence.name} {row.slug}".encode()).hexdigest()[:8], 16)
    target = torch.rand(50, generator=torch.Generator().manual_seed(seed)) + 1
    metrics = SequenceMetrics(with_variance=row.method.name != "DepthOnly", ranking=False)
    variance = torch.full_like(target, 0.01) if metrics.with_variance else None
    metrics.update(target + 0.1, variance, target)
    counts = {"selected": len(sequence), "done": len(sequence), "skipped": 0, "reasons": {}}
    return RowFigures(row, counts, metrics.compute(), metrics.curves(), {}, {}, {"metrics": metrics.state_dict()})


def go(job, evaluate=None, **how):
    """Evaluate in this process by a judge of one sequence (None: :class:`Stub`): (outcome, lines that were
    reported)."""
    lines: list[str] = []
    outcome = evaluate_suite(job, **{"shard": ALL, **how}, report=lines.append, evaluate=evaluate or Stub())
    return outcome, lines


def kept(out):
    """What does not depend on who computed it, or when: figures, curves and sums by file."""
    result = {}
    for path in sorted((out / "records").rglob("*.json")):
        values = json.loads(path.read_text())
        if path.name != "failed.json":
            sums = torch.load(path.with_suffix(".pt"), weights_only=True)
            plain = {name: values[name] for name in ("frames", "figures", "curves", "state")}
            result[str(path.relative_to(out))] = (plain, _bytes(sums))
    return result


def _bytes(value):
    """Tensors as their type, shape and bytes, at any depth."""
    if isinstance(value, torch.Tensor):
        return str(value.dtype), tuple(value.shape), value.numpy().tobytes()
    return {key: _bytes(item) for key, item in value.items()} if isinstance(value, dict) else value

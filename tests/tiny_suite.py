"""Small networks in files, rows on small sequences, and fast evaluations: rooms of 48x64, a stub for the evaluation."""

from __future__ import annotations

import hashlib
import json
import shutil
from dataclasses import replace
from types import SimpleNamespace
from unittest import mock

import numpy as np
import torch
from layouts import write_generic

from ufmstar_torch.eval.engine.evaluate import evaluate_sequence
from ufmstar_torch.eval.engine.load import NetworkChoice
from ufmstar_torch.eval.engine.progress import Progress
from ufmstar_torch.eval.engine.record import Record
from ufmstar_torch.eval.engine.stream import Stopped
from ufmstar_torch.eval.methods.method import Method
from ufmstar_torch.eval.methods.row import Row
from ufmstar_torch.eval.methods.setting import Setting
from ufmstar_torch.eval.methods.suite import suite_named
from ufmstar_torch.eval.metrics import SequenceMetrics
from ufmstar_torch.eval.suite.job import EvalJob
from ufmstar_torch.eval.suite.tasks import evaluate_suite
from ufmstar_torch.eval.suite.work_items import find_work
from ufmstar_torch.frames.prediction import DepthPrediction
from ufmstar_torch.models import NetworkSpec, build_network, save_trained

CPU = torch.device("cpu")
TRUTH = "depth_only=ground-truth:24x32"
NAMES = ("ash", "birch", "cedar")
SPECS = {
    "depth": {},
    "aleatoric": {},
    "evidential": {},
    "mc_dropout": {"dropout": 0.2},
    "batch_ensemble": {"members": 3},
}


def spec_of(method="aleatoric"):
    """FastDepth with a twentieth of the channels, input 32 x 64."""
    return NetworkSpec(
        method=method, widths=0.05, positive="softplus", size=(32, 64), preprocess="resize", **SPECS[method]
    )


def make_networks(spec, count=2, seed=0):
    """Networks in eval mode with non-initial weights and statistics."""
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        networks = [build_network(spec) for _ in range(count)]
        with torch.no_grad():
            for network in networks:
                network.distribution(torch.rand(4, 3, *spec.size))
                for parameter in network.parameters():
                    parameter += 0.05 * torch.randn_like(parameter)
    return [network.eval() for network in networks]


def write_network(path, method="aleatoric", count=1, seed=0):
    """Write such networks to a file, and return its path."""
    path.parent.mkdir(parents=True, exist_ok=True)
    save_trained(path, make_networks(spec_of(method), count, seed), spec_of(method))
    return path


def write_networks(folder):
    """Write one file for every base: {base: "BASE=trained:FILE"}."""
    kinds = {
        "ensemble": ("aleatoric", 3),
        "mc_dropout": ("mc_dropout", 1),
        "batch_ensemble": ("batch_ensemble", 1),
        "evidential": ("evidential", 1),
        "aleatoric": ("aleatoric", 1),
        "depth_only": ("depth", 1),
    }
    files = {base: write_network(folder / f"{base}.safetensors", *kind) for base, kind in kinds.items()}
    return {base: f"{base}=trained:{file}" for base, file in files.items()}


def base_network(text, **options):
    """Load a network from an argument of ``--network``."""
    return NetworkChoice.parse(text).load(CPU, **options)


def row(name, **setting):
    """The row with this name and setting."""
    return Row(Method.parse(name), Setting(**setting))


def rows_of(*names, **setting):
    """The rows with these names and one setting."""
    return tuple(row(name, **setting) for name in names)


def evaluate(sequence, rows, networks, store=None, *, progress=lambda _: None, stop=lambda: False, **options):
    """Evaluate a sequence on the CPU: {slug of the row: result}."""
    results = evaluate_sequence(sequence, rows, networks, cache=store, progress=progress, stop=stop, **options)
    assert [result.row for result in results] == list(rows)
    return {result.row.slug: result for result in results}


def unbatched(source, frame, n=0):
    """A source's prediction for a frame without the leading dimension."""
    maps = source.one(frame, n)
    variances = {"aleatoric": maps.aleatoric_variance, "epistemic": maps.epistemic_variance}
    variances = {name: None if value is None else value[0] for name, value in variances.items()}
    return SimpleNamespace(depth=maps.depth[0], intrinsics=maps.K[0], size=maps.size, **variances)


def same(one, other):
    """Return True if two results agree to the last bit, times left aside."""
    return (
        one.frames == other.frames
        and repr(one.figures) == repr(other.figures)
        and repr(one.curves) == repr(other.curves)
        and one.state == other.state
        and one.sums.keys() == other.sums.keys()
        and all(torch.equal(one.sums[m][k], other.sums[m][k]) for m in one.sums for k in one.sums[m])
    )


class Biased:
    """A minimal ``DepthSource``: the true depth, but 40 % too far beyond 2 m."""

    digest, passes, needs_image, cacheable, networks, runtime = "biased", 1, False, False, (), None
    max_depth, states_confidence, stochastic = None, False, False

    def prepared(self, how):
        return self

    def turn(self, position):
        return 0

    def prepare(self, frame):
        pass

    def one(self, frame, n):
        depth = np.where(frame.depth > 2, 1.4, 1.0) * frame.depth
        K = torch.from_numpy(frame.intrinsics)[None]
        return DepthPrediction(torch.from_numpy(depth).float()[None], intrinsics=K)


# ---- evaluations ----


def write_rooms(root, names=NAMES, frames=4):
    """Write generic sequences of one walk, replacing existing ones."""
    first, _ = write_generic(root, frames, folder=names[0])
    for name in names[1:]:
        shutil.copytree(first, root / name, dirs_exist_ok=True)
    return root


def job_on(root, out, **changes):
    """A job: the first four rows of the suite ``depth-only`` on the sequences of a folder."""
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
    """Replaces the evaluation of a sequence: random figures, seeded by the names of row and sequence.

    Args:
        before: called with the sequence's name and the number of finished frames.

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
    metrics = SequenceMetrics(with_variance=False)  # small sums: a forked process must not use torch's threads
    metrics.update(target + 0.1, None, target)
    counts = {"selected": len(sequence), "done": len(sequence), "skipped": 0, "reasons": {}}
    how = {"figures": metrics.compute(), "curves": metrics.curves(), "sums": {"metrics": metrics.state_dict()}}
    return Record(row.method.name, row.setting.to_dict(), counts, **how)


def go(job, evaluate=None, **how):
    """Run the job in this process: (outcome, reported lines). ``evaluate`` evaluates one sequence (None:
    :class:`Stub`)."""
    lines: list[str] = []
    with mock.patch("ufmstar_torch.eval.suite.evaluate.evaluate_sequence", evaluate or Stub()):
        outcome = evaluate_suite(job, **how, report=lines.append)
    return outcome, lines


def stored_results(out):
    """Return the stored figures, curves and sums by file; they do not depend on processes or clocks."""
    result = {}
    for path in sorted((out / "records").rglob("*.json")):
        values = json.loads(path.read_text())
        if path.name != "failed.json":
            plain = {name: values[name] for name in ("frames", "figures", "curves", "state")}
            result[str(path.relative_to(out))] = plain, path.with_suffix(".npz").read_bytes()
    return result

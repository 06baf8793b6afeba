"""Small networks in files, and rows on small sequences, for the tests of the evaluation."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import torch

from ufmstar_torch.eval.engine.evaluate import Judge, evaluate_sequence
from ufmstar_torch.eval.engine.load import NetworkChoice
from ufmstar_torch.eval.engine.predictions import Predicted
from ufmstar_torch.eval.methods.method import Method
from ufmstar_torch.eval.methods.row import Row
from ufmstar_torch.eval.methods.setting import DEFAULT, Setting
from ufmstar_torch.eval.sequences.frame import Entry
from ufmstar_torch.models import NetworkSpec, build_network, save_trained
from ufmstar_torch.prediction import DepthPrediction

CPU = torch.device("cpu")
SPECS = {
    "depth": {},
    "aleatoric": {},
    "evidential": {},
    "mc_dropout": {"dropout": 0.2},
    "batch_ensemble": {"members": 3},
}


def write_network(path, method="aleatoric", count=1, seed=0):
    """A file of FastDepths of a twentieth of the width, 32 x 64, moved from where they began; the file."""
    spec = NetworkSpec(
        method=method, widths=0.05, positive="softplus", size=(32, 64), preprocess="resize", **SPECS[method]
    )
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        networks = [build_network(spec) for _ in range(count)]
        with torch.no_grad():
            for network in networks:
                network.distribution(torch.rand(4, 3, *spec.size))
                for parameter in network.parameters():
                    parameter += 0.05 * torch.randn_like(parameter)
    path.parent.mkdir(parents=True, exist_ok=True)
    save_trained(path, [network.eval() for network in networks], spec)
    return path


def write_networks(folder):
    """One file for every base: {base: what a user types}."""
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
    """What a user typed, loaded."""
    return NetworkChoice.parse(text).load(CPU, **options)


def row(name, **setting):
    """The row of a name, under a setting."""
    return Row(Method.parse(name), Setting(**setting))


def rows_of(names, setting=DEFAULT):
    """The rows of some names, under one setting."""
    return tuple(Row(Method.parse(name), setting) for name in names)


def evaluate(sequence, rows, networks, store=None, *, sinks=(), progress=lambda _: None, stop=lambda: False, **judge):
    """The results of a sequence on the CPU, by the row's slug."""
    how = Judge(networks, CPU, store, **judge)
    results = evaluate_sequence(sequence, rows, how, sinks=sinks, progress=progress, stop=stop)
    assert [result.row for result in results] == list(rows)
    return {result.row.slug: result for result in results}


def unbatched(source, frame, n=0):
    """A source's prediction for a frame without the leading dimension."""
    maps, K, _ = source.one(frame, n)
    own = {"aleatoric": maps.aleatoric_variance, "epistemic": maps.epistemic_variance}
    own = {name: None if value is None else value[0] for name, value in own.items()}
    return SimpleNamespace(depth=maps.depth[0], intrinsics=K[0], size=tuple(maps.depth.shape[1:]), **own)


def same(one, other):
    """Whether two results agree to the last bit, times left aside."""
    return (
        one.frames == other.frames
        and repr(one.figures) == repr(other.figures)
        and repr(one.curves) == repr(other.curves)
        and one.state == other.state
        and one.sums.keys() == other.sums.keys()
        and all(torch.equal(one.sums[m][k], other.sums[m][k]) for m in one.sums for k in one.sums[m])
    )


class Biased:
    """The truth, but what is farther than 2 m is put 40 % too far; as much of a ``DepthSource`` as is asked of it."""

    digest, passes, needs_image, cacheable, networks, runtime = "biased", 1, False, False, (), None
    max_depth = None

    def prepared(self, how):
        return self

    def turn(self, position):
        return 0

    def prepare(self, frame):
        pass

    def one(self, frame, n):
        depth = np.where(frame.depth > 2, 1.4, 1.0) * frame.depth
        maps = DepthPrediction(torch.from_numpy(depth).float()[None])
        return Predicted(maps, torch.from_numpy(frame.intrinsics)[None])


def in_memory(sequence, part):
    """Some frames of a sequence, decoded: to render them again for every test would take most of the time."""
    frames = [sequence[i] for i in range(len(sequence))[part]]
    entries = (Entry(f.name, f.T_world_cam, lambda f=f: f.image.copy(), lambda f=f: f.depth.copy()) for f in frames)
    return replace(sequence, entries=tuple(entries), names_on_disk=tuple(f.name for f in frames))

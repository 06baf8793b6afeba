"""Small jobs for the tests of the runner and the command line, and the outputs that an interruption must not change."""

from __future__ import annotations

import hashlib
import json

import numpy as np
import torch
from torch import nn

from ufmstar_torch import DepthPrediction, UfMStarConfig
from ufmstar_torch.eval.engine.maps import own_depth
from ufmstar_torch.eval.engine.networks import NetworkSource
from ufmstar_torch.eval.run.job import RunJob
from ufmstar_torch.eval.sequences import open_sequence
from ufmstar_torch.frames.prediction import NetworksInTurn
from ufmstar_torch.models import Preprocess

CONFIG = UfMStarConfig(on_bad_frame="skip")


class Brightness(nn.Module):
    """A "network": depth from brightness and, optionally, a variance proportional to it."""

    def __init__(self, gain=1.0, spread=None, at=None, then=None):
        super().__init__()
        self.gain, self.spread = gain, spread
        self.at, self.then, self.calls = at, then, 0

    def forward(self, image):
        if self.calls == self.at:
            self.then()
        self.calls += 1
        depth = self.gain * (1 + 2 * image.mean(1))
        return DepthPrediction(depth, None if self.spread is None else self.spread * depth)


def networks(*members, preprocess=None, identity=()):
    """A source of networks on the CPU; their input is 24x32 unless another preprocessing is given."""
    turns = NetworksInTurn(list(members), preprocess=preprocess or Preprocess(size=(24, 32)))
    return NetworkSource(turns, torch.device("cpu"), dict(identity))


def network_job(path, *members, mode="alternate", **options):
    """A job with networks, at 24x32 so that prediction and image differ in size."""
    members = members or (Brightness(),)
    source = networks(*members, identity={"networks": [network.gain for network in members]})
    source.digest = hashlib.sha256(repr([(n.gain, n.spread) for n in members]).encode()).hexdigest()
    return job_of(open_sequence(path), source, every=mode == "full", **options)


def own_depth_job(path, **options):
    """A job with the sequence's own depth as the prediction."""
    return job_of(open_sequence(path), own_depth(), **options)


def job_of(sequence, source, frames=slice(None), config=CONFIG, **options):
    """A job, by default without pictures."""
    options = {"video": False, "sheet": False, **options}
    indices, settings = range(len(sequence))[frames], {"note": "a test"}
    return RunJob(sequence, indices, source, config, torch.device("cpu"), settings, **options)


def outputs(out):
    """By file, every output that must not depend on interruptions: exact bytes, or values without times."""
    result = {}
    for file in sorted(path for path in out.rglob("*") if "cache" not in path.parts):
        name = str(file.relative_to(out))
        if file.suffix == ".npz":
            with np.load(file) as stored:
                result[name] = {key: stored[key].tobytes() for key in stored.files}
        elif name == "frames.jsonl":
            result[name] = [without_times(json.loads(line)) for line in file.read_text().splitlines()]
        elif name == "summary.json":
            result[name] = without_times(json.loads(file.read_text()))
        elif file.is_file():
            result[name] = file.read_bytes()
    return result


def without_times(record):
    """A record or summary without its measured times."""
    return {key: value for key, value in record.items() if key not in ("ms", "time")}


def records(out):
    """The lines of frames.jsonl."""
    return [json.loads(line) for line in (out / "frames.jsonl").read_text().splitlines()]


def read_summary(out):
    """Read summary.json as strict JSON."""

    def refuse(constant):
        raise AssertionError(f"summary.json holds {constant}")

    return json.loads((out / "summary.json").read_text(), parse_constant=refuse)

"""What the tests of the runner and of the command line share: small jobs, and what must not depend on interruptions."""

from __future__ import annotations

import json

import numpy as np
import torch
from torch import nn

from ufmstar_torch import DepthPrediction, UfMStarConfig, UncertainDepth
from ufmstar_torch.eval.commands.run import Job
from ufmstar_torch.eval.engine.run_maps import MapSource, own_depth_source
from ufmstar_torch.eval.engine.run_source import NetworkSource
from ufmstar_torch.eval.sequences import open_sequence
from ufmstar_torch.models import Preprocess

CONFIG = UfMStarConfig(on_bad_frame="skip")


class Brightness(nn.Module):
    """A "network": depth from brightness, and, if asked, a variance that is a share of the depth."""

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


def network_job(path, *networks, config=CONFIG, frames=slice(None), mode="alternate", **options):
    """A job with networks, at 24x32 so that prediction and image differ in size."""
    sequence = open_sequence(path)
    members = networks or (Brightness(),)
    pipeline = UncertainDepth(list(members), config, mode=mode, preprocess=Preprocess(size=(24, 32)))
    identity = {"networks": [network.gain for network in members]}
    source = NetworkSource(pipeline, torch.device("cpu"), identity)
    return job_of(sequence, source, frames=frames, **options)


def own_depth_job(path, config=CONFIG, frames=slice(None), **options):
    """A job with the sequence's own depth as the prediction."""
    return job_of(open_sequence(path), own_depth_source(config), frames=frames, **options)


def job_of(sequence, source: NetworkSource | MapSource, frames=slice(None), **options):
    """Without pictures, unless they are asked for."""
    options = {"video": False, "sheet": False, **options}
    return Job(sequence, range(len(sequence))[frames], source, {"note": "a test"}, **options)


def outputs(out):
    """Every output that must not depend on interruptions, by file: exact bytes, or values without times."""
    found = {}
    for file in sorted(out.rglob("*")):
        name = str(file.relative_to(out))
        if file.suffix == ".npz":
            with np.load(file) as stored:
                found[name] = {key: stored[key].tobytes() for key in stored.files}
        elif name == "frames.jsonl":
            found[name] = [without_times(json.loads(line)) for line in file.read_text().splitlines()]
        elif name == "summary.json":
            found[name] = without_times(json.loads(file.read_text()))
        elif file.is_file() and file.parent.name != "resume":
            found[name] = file.read_bytes()
    return found


def without_times(record):
    """A record or summary without what a clock says."""
    return {key: value for key, value in record.items() if key not in ("ms", "time")}


def read_summary(out):
    """summary.json, which must be strict JSON."""

    def refuse(constant):
        raise AssertionError(f"summary.json holds {constant}")

    return json.loads((out / "summary.json").read_text(), parse_constant=refuse)

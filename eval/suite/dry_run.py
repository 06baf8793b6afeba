"""The plan of an evaluation: its rows with their networks, and its sequences with their number of frames."""

from __future__ import annotations

from collections.abc import Iterator

import torch

from ufmstar_torch.eval.methods.method import NETWORKS
from ufmstar_torch.eval.methods.suite import Suite
from ufmstar_torch.eval.suite.job import EvalJob


def network_lines(job: EvalJob, suite: Suite) -> Iterator[str]:
    """The rows of the job, then those of the whole ``suite`` that it leaves out, and the networks that are missing.
    Raises as ``EvalJob.load``."""
    networks = job.load(torch.device("cpu"))
    rows = [*job.suite.rows, *(row for row in suite.rows if row not in job.suite.rows)]
    yield f"{job.suite.name}: {job.suite.title}"
    yield f"{len(rows)} rows:"
    for row in rows:
        network = networks.get(row.method.base)
        yield f"  {row.label}  [{'no network' if network is None else network.label}]  needs {row.needs}"
    if job.missing_bases:
        yield "left out, without a --network:"
        yield from (f"  --network {base}=MODEL:FILE: {NETWORKS[base]}" for base in job.missing_bases)
    if job.suite.efficiency:
        yield "measures time, energy and memory: energy needs zeus and a meter (NVML, AMD SMI, RAPL, Jetson's rails)"


def sequence_lines(job: EvalJob) -> Iterator[str]:
    """The sequences with their number of selected frames, or why they cannot be opened; and the sums."""
    yield f"{len(job.items)} sequences:"
    total = 0
    for item in job.items:
        try:
            frames = len(range(len(item.open()))[job.frames])
        except (OSError, ValueError) as error:
            yield f"  {item.label}: cannot be opened: {' '.join(str(error).split())}"
            continue
        yield f"  {item.label}: {frames} frames"
        total += frames
    yield f"{total} frames, {len(job.items) * len(job.suite.rows)} records"

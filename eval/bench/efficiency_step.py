"""The measurement of time, energy and memory that belongs to a suite about efficiency."""

from __future__ import annotations

from dataclasses import replace

import torch

from ufmstar_torch.eval.bench.contender import contenders
from ufmstar_torch.eval.bench.measure import Plan, measure
from ufmstar_torch.eval.results.files import write_json_atomic
from ufmstar_torch.eval.results.work import EvalJob
from ufmstar_torch.eval.results.worker import device_of

EFFICIENCY = "efficiency.json"


def measure_job(job: EvalJob, plan: Plan | None = None) -> None:
    """Measure the rows on the first sequence that can be opened, and write OUT/efficiency.json.

    UfM and UfM* run on the CPU, as the paper's do, the networks on the job's device.

    Args:
        job: whose sequences have been evaluated.
        plan: how much is measured; None = the defaults, with fewer frames where the sequence has no more.

    Raises:
        ValueError: no sequence can be opened, it has no frames enough, or no row can be measured.
        OSError: the file cannot be written.
    """
    plan = plan or Plan()
    device = device_of(job.device, 0)
    failed = []
    for item in job.items:
        try:
            sequence = item.open()
            break
        except (OSError, ValueError) as error:
            failed.append(f"{item.label}: {error}")
    else:
        raise ValueError(f"no sequence can be opened: {'; '.join(failed[:3])}")
    frames = max(1, min(plan.frames, len(sequence) - plan.warm_up))
    networks = contenders(job.load(torch.device(device)))
    found = measure(job.suite.rows, networks, sequence, device=device, plan=replace(plan, frames=frames))
    write_json_atomic(job.out / EFFICIENCY, found)

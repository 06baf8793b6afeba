"""Describes an evaluation without running it."""

from __future__ import annotations

from collections.abc import Mapping

from ufmstar_torch.eval.engine.predictions import DepthSource
from ufmstar_torch.eval.suite.job import EvalJob
from ufmstar_torch.eval.suite.work_items import Shard


def dry_run(job: EvalJob, networks: Mapping[str, DepthSource], shard: Shard) -> str:
    """List the rows of a job with their networks, and the sequences of a shard with their number of frames."""
    lines = [f"{job.suite.name}: {job.suite.title}", f"{len(job.suite.rows)} rows:"]
    lines += [f"  {row.label}  [{networks[row.method.base].label}]" for row in job.suite.rows]
    if job.missing_bases:
        lines.append(f"left out, without a network: the rows of {', '.join(job.missing_bases)}")
    items = shard.of(job.items)
    lines.append(f"{len(items)} sequences:" if len(items) == len(job.items) else f"{len(items)} of {len(job.items)}:")
    frames = 0
    for item in items:
        try:
            sequence = item.open()
        except (OSError, ValueError) as error:
            lines.append(f"  {item.label}: cannot be opened: {' '.join(str(error).split())}")
            continue
        count = len(range(len(sequence))[job.frames])
        lines.append(f"  {item.label}: {count} frames")
        frames += count
    lines.append(f"{frames} frames, {len(items) * len(job.suite.rows)} records")
    return "\n".join(lines)

"""Describes an evaluation without running it: its rows, its sequences, and how large the cache of predictions gets."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from ufmstar_torch.eval.engine.predictions import DepthSource
from ufmstar_torch.eval.methods.perturb import selects
from ufmstar_torch.eval.methods.row import Row
from ufmstar_torch.eval.sequences.frame import FrameError, FrameSequence
from ufmstar_torch.eval.suite.job import EvalJob
from ufmstar_torch.eval.suite.work_items import Shard
from ufmstar_torch.prediction import DepthPrediction

_FILE_BYTES = 2048  # of a cached file beside its maps, rounded up to what file systems allot


def dry_run(job: EvalJob, networks: Mapping[str, DepthSource], shard: Shard) -> str:
    """Open every sequence of a shard of the job, predict one frame with its networks, and describe the work."""
    lines = [f"{job.suite.name}: {job.suite.title}", f"{len(job.suite.rows)} rows:"]
    lines += [f"  {row.label}  [{networks[row.method.base].label}]" for row in job.suite.rows]
    if job.missing_bases:
        lines.append(f"left out, without a network: the rows of {', '.join(job.missing_bases)}")
    items = shard.of(job.items)
    lines.append(f"{len(items)} sequences:" if len(items) == len(job.items) else f"{len(items)} of {len(job.items)}:")
    frames, size = 0, 0
    sample: dict[str, int] | None = None
    for item in items:
        try:
            sequence = item.open()
        except (OSError, ValueError) as error:
            lines.append(f"  {item.label}: cannot be opened: {' '.join(str(error).split())}")
            continue
        count = len(range(len(sequence))[job.frames])
        lines.append(f"  {item.label}: {count} frames")
        sample = _bytes_per_file(sequence, networks) if sample is None else sample
        frames += count
        for base, bytes_ in (sample or {}).items():
            rows = [row for row in job.suite.rows if row.method.base == base]
            size += predictions(rows, networks[base], count) * bytes_
    lines.append(f"{frames} frames, {len(items) * len(job.suite.rows)} records")
    cached = "no frame can be read" if sample is None else f"up to {size / 1e6:.1f} MB"
    lines.append(f"cache of predictions: {cached}")
    return "\n".join(lines)


def predictions(rows: Iterable[Row], network: DepthSource, frames: int) -> int:
    """How many predictions of a network the rows need on so many frames, all members on an image counting as one."""
    needed: set[tuple[str, int, int | None]] = set()
    for row in rows:
        every = row.method.every_member and network.passes > 1
        numbers = [number for number in range(frames) if selects(row.setting, number)]
        how = row.setting.preprocess
        needed |= {(how, number, None if every else network.turn(position)) for position, number in enumerate(numbers)}
    return len(needed)


def _bytes_per_file(sequence: FrameSequence, networks: Mapping[str, DepthSource]) -> dict[str, int] | None:
    """By base, from the first frame that can be read; None if none can."""
    for index in range(len(sequence)):
        try:
            frame = sequence[index]
            made = {base: network.one(frame, 0) for base, network in networks.items() if network.cacheable}
        except FrameError:
            continue
        return {base: _FILE_BYTES + _maps(one.maps, networks[base].passes > 1) for base, one in made.items()}
    return None


def _maps(maps: DepthPrediction, several: bool) -> int:
    """Bytes of the maps in single precision; all of several members have an epistemic variance together."""
    variances = [value for value in (maps.aleatoric_variance, maps.epistemic_variance) if value is not None]
    return 4 * maps.depth.numel() * (3 if several else 1 + len(variances))

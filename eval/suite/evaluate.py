"""One sequence of an evaluation: computes and stores the rows without a record."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import torch

from ufmstar_torch.eval.check.check import check_sequence
from ufmstar_torch.eval.engine.anchors import landmark_digests
from ufmstar_torch.eval.engine.evaluate import BROKEN, evaluate_sequence
from ufmstar_torch.eval.engine.judge import references
from ufmstar_torch.eval.engine.predictions import DepthSource, PredictionCache, content_digest
from ufmstar_torch.eval.engine.progress import Progress
from ufmstar_torch.eval.engine.record import Record
from ufmstar_torch.eval.engine.stream import Stopped
from ufmstar_torch.eval.methods.method import ALONE
from ufmstar_torch.eval.methods.row import Row
from ufmstar_torch.eval.run.machine import hardware, versions
from ufmstar_torch.eval.sequences.plugins import load_plugins
from ufmstar_torch.eval.suite.folder import CACHE
from ufmstar_torch.eval.suite.job import EvalJob
from ufmstar_torch.eval.suite.work_items import TOUR, WorkItem
from ufmstar_torch.frames.warnings import LOGGER

_NO_POSES = "its images have no poses: the rows of networks alone are finished, {} that compare views cannot be had"


def evaluate_item(
    job: EvalJob,
    item: WorkItem,
    networks: Mapping[str, DepthSource],
    device: torch.device,
    *,
    stop: Callable[[], bool] = lambda: False,
    progress: Callable[[Progress], object] = lambda _: None,
) -> str:
    """Compute and store the missing rows of a sequence, or why they cannot be computed.

    Args:
        job: its folder is open.
        item: the sequence.
        networks: of the job, by base, loaded onto a device.
        device: of UfM and UfM*.
        stop: see ``evaluate_sequence``; a stopped sequence stores nothing.
        progress: see ``evaluate_sequence``; its stage is the sequence's label.

    Returns:
        A line about the sequence, "" if no row was missing.

    Raises:
        Stopped: ``stop`` returned True.
        FolderError: earlier results were computed from another sequence of that name.
        CacheError, OSError: a file cannot be written.
    """
    if stop():
        raise Stopped
    folder, started = job.folder, time.monotonic()
    missing = folder.begin(item, job.suite.rows)
    try:
        sequence = item.open()
        made_of = {"sequence": content_digest(sequence), "device": str(device)}
        landmarks = landmark_digests(job.suite.rows, sequence.folder, sequence.pose_scale)
    except (*BROKEN, OSError) as error:
        return folder.fail(item, error, missing)
    folder.require_same_sequence(item, made_of["sequence"], landmarks)
    possible = [row for row in job.suite.rows if sequence.posed or row.method.fusion == ALONE]
    todo = [row for row in missing if row in possible]
    left_out = [row for row in missing if row not in possible]
    lines = []
    if todo:
        how: dict[str, Any] = {"device": device, "cache": PredictionCache(job.cache or job.out / CACHE)}
        how |= {"frames": job.frames, "bins": job.bins, "plugins": load_plugins(job.plugin)}
        how["examples"] = folder.sequence_folder(item) if job.stores_examples(item) else None
        how |= {"stop": stop, "progress": lambda state: progress(replace(state, stage=item.label))}
        try:
            if sequence.layout != TOUR:
                for problem in check_sequence(sequence).problems:
                    LOGGER.warning("%s: %s (ufmstar data check)", item.label, problem)
            records = evaluate_sequence(sequence, with_references(todo, possible), networks, **how)
        except BROKEN as error:
            return folder.fail(item, error, missing)
        for record in records:
            if record.row in todo:
                slug = record.row.slug
                anchors = {"landmarks": landmarks[slug]} if slug in landmarks else {}
                folder.write(item, _complete(job, item, networks, record, made_of | anchors))
        frames, seconds = records[0].frames.get("done", 0), time.monotonic() - started
        lines.append(f"{item.label}: {len(todo)} rows, {frames} frames, {seconds:.1f} s")
    if left_out:
        lines.append(folder.fail(item, _NO_POSES.format(len(left_out)), left_out))
    else:
        folder.succeeded(item)
    return "; ".join(lines)


def with_references(missing: Sequence[Row], rows: Sequence[Row]) -> list[Row]:
    """The missing rows and their references (``engine.judge.references``), in the order of ``rows``."""
    needed = {*missing, *(reference for row in missing for reference in references(row, rows))}
    return [row for row in rows if row in needed]


def _complete(
    job: EvalJob, item: WorkItem, networks: Mapping[str, DepthSource], record: Record, made_of: Mapping[str, Any]
) -> Record:
    """The record with its names and provenance."""
    network = networks[record.row.method.base]
    computed_with = {"versions": versions(), "machine": hardware(), "threads": torch.get_num_threads()}
    return replace(
        record,
        suite=job.suite.name,
        dataset=item.dataset,
        sequence=item.sequence,
        network=network.label,
        provenance={**computed_with, "network": network.digest, "runtime": network.runtime, **made_of},
    )

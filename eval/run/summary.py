"""The data of a run's summary.json: results, provenance, settings and versions."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import mean, median
from typing import Any

import numpy as np

from ufmstar_torch.eval.check.depth_image_fit import image_at_map, part_of_image
from ufmstar_torch.eval.check.image_fit import DepthFit
from ufmstar_torch.eval.engine.files import to_json, write_json_atomic
from ufmstar_torch.eval.engine.judge import ALONE, POSTERIOR, UFM
from ufmstar_torch.eval.engine.maps import MapSource
from ufmstar_torch.eval.run.job import RunJob
from ufmstar_torch.eval.run.machine import hardware, versions
from ufmstar_torch.eval.run.run_folder import RUN, RunFolder, fitted_depth
from ufmstar_torch.eval.run.writers import frame_file, read_frame
from ufmstar_torch.eval.sequences import FrameSequence
from ufmstar_torch.eval.sequences.intrinsics import pinhole
from ufmstar_torch.eval.sequences.own_output import is_number
from ufmstar_torch.files.limits import read_json
from ufmstar_torch.frames.warnings import hardly_compared
from ufmstar_torch.gaussians.mixture import GaussianMixture

SUMMARY = "summary.json"
FINISHED, INTERRUPTED, FAILED = "finished", "interrupted", "failed"
Records = Sequence[Mapping[str, Any]]
_MAPS = 12  # depth maps that are compared with their images
STAGES = ("read", "prepare", "network", "anchors", "ufm", "metrics", "write")


def write_summary(folder: RunFolder, mixture: GaussianMixture, state: str, reason: str) -> dict[str, Any]:
    """Write summary.json from the run's records and figures, and return its content as plain values. Raises OSError:
    the summary cannot be written."""
    job, records = folder.job, folder.records
    done = [record for record in records if record["state"] == "done"]
    figures = {name: metrics.compute() for name, metrics in folder.metrics.items()}
    parts = {name: values for name, values in figures.items() if "." in name}  # what moves, what stands still
    result = UFM if job.config.posterior is None else POSTERIOR
    no_truth = "no ground truth" if job.sensor is None else "the recording's depth serves as anchors"
    alone_reason = "the depth comes without a variance of its own"
    if any(record["mean_network_sigma"] is not None for record in done):
        alone_reason = "no variance where there is ground truth" if UFM in figures else no_truth
    summary = {
        "program": RUN.program,
        "state": state,
        "reason": reason,
        "sequence": _sequence(job.sequence),
        **_scale(job),
        "frames": _frames(records, len(job.indices)),
        "source": job.source_identity,
        "runtime": job.source.runtime,
        "prediction": {key: done[-1][key] for key in ("size", "intrinsics")} if done else None,
        "result": result,  # of which depth and sigma are, in the files and below
        "metrics": figures.get(result),
        "metrics_reason": None if UFM in figures else no_truth,
        "network_alone": figures.get(ALONE),
        "network_alone_reason": None if ALONE in figures else alone_reason,
        **_posterior(done, figures.get(UFM)),
        **({"parts": parts} if parts else {}),
        "uncertainty": _uncertainty(done),
        "recalibrated": job.recalibration is not None,
        "anchors": _anchors(done),
        "mixture": _mixture(done, mixture),
        "time": _time(done, folder.seconds),
        "outputs": folder.outputs,
        "settings": job.settings,
        "versions": versions(),
        "machine": hardware(),
    }
    depth = fitted_depth(job, folder.first_maps)
    summary |= {"image_fit": job.image_fit, "depth_fit": depth, "warnings": _warnings(folder, depth, done)}
    plain: dict[str, Any] = to_json(summary)
    write_json_atomic(folder.path / SUMMARY, plain)
    return plain


def read_summary(out: Path) -> dict[str, Any]:
    """The summary of a run. Raises ValueError: it cannot be read, or what is read of an earlier run has another form;
    the message names file and field."""
    try:
        summary = read_json(out / SUMMARY)
    except (OSError, ValueError) as error:
        raise ValueError(f"{out}/{SUMMARY} is not that of a run: {error}") from error
    content = summary if isinstance(summary, dict) else {}
    sequence, posterior = content.get("sequence"), content.get("posterior")
    calibration = posterior.get("calibration") if isinstance(posterior, dict) else None
    fine = {
        "program": content.get("program") == RUN.program,
        "sequence.name": isinstance(sequence, dict) and isinstance(sequence.get("name"), str),
        "posterior": posterior is None or isinstance(posterior, dict),
        "posterior.calibration": calibration is None or is_number(calibration),
    }
    if wrong := [field for field, right in fine.items() if not right]:
        raise ValueError(f"{out}/{SUMMARY} is not that of a run (its {wrong[0]})")
    return content


def _part_of_image(folder: RunFolder, done: Records) -> str:
    """A warning where maps from files look as if they showed a part of their images."""
    job, source, shown = folder.job, folder.job.source, list[tuple[np.ndarray, np.ndarray]]()
    if not isinstance(source, MapSource) or source.is_truth or not done:
        return ""
    for record in (done[i] for i in np.unique(np.linspace(0, len(done) - 1, _MAPS).astype(int))):
        frame, stored = job.sequence[record["index"]], read_frame(frame_file(folder.path, record["name"]))
        if frame.image is not None:
            of_network = stored.get("network_depth", stored["depth"])
            depth, K_map = np.where(stored["valid"], of_network, 0.0), pinhole(*record["intrinsics"])
            shown.append((image_at_map(frame.image, frame.intrinsics, K_map, depth.shape), depth))
    return part_of_image(shown) if shown else ""


def _travelled(folder: RunFolder, done: Records) -> float:
    """Length of the camera's path over the mean depth of the last frame; 0 without a depth."""
    entries, stored = folder.job.sequence.entries, read_frame(frame_file(folder.path, done[-1]["name"]))
    path = np.stack([entries[record["index"]].T_world_cam[:3, 3] for record in done])
    depth = stored["depth"][stored["valid"]]
    return float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum() / depth.mean()) if depth.size else 0.0


def _warnings(folder: RunFolder, depth: DepthFit | None, done: Records) -> list[str]:
    """Likely mistakes in the run's input, one line each."""
    job = folder.job
    fits = [fit.problem for fit in (job.image_fit, depth) if fit is not None]
    without_depth = len(job.sequence.without_depth) == len(job.sequence)
    fits.append(_part_of_image(folder, done))
    if done:
        last = done[-1]["single_view"], done[-1]["components"]
        fits.append(hardly_compared(*last, len(done), _travelled(folder, done)))
        if without_depth and job.sequence.layout == "generic" and (depth is None or depth.problem):
            fits.append("nothing ties the poses to metres: sigma and disagreement are in the poses' unit")
    fitted = () if job.recalibration is None else job.recalibration.sequences
    if not without_depth and job.sequence.name in [label.partition("/")[2] for label in fitted]:
        fits.append("the recalibration was fitted to this sequence: metrics on it are too good")
    return [text for text in fits if text]


def _posterior(done: Records, figures: Mapping[str, float] | None) -> dict[str, Any]:
    """The last frame's figures of held-out anchors; and the figures of UfM* for the network's depth, before its
    correction."""
    if not done or "posterior" not in done[-1]:
        return {}
    before = {"metrics": figures, "mean_sigma": _pixel_mean(done, "mean_ufm_sigma")}
    return {"posterior": done[-1]["posterior"], "ufm": before}


def _sequence(sequence: FrameSequence) -> dict[str, Any]:
    names = ("name", "layout", "image_size", "intrinsics", "depth_intrinsics")
    return {
        **{name: getattr(sequence, name) for name in names},
        "frames": len(sequence),
        "without_depth": len(sequence.without_depth),
        "left_out": dict(Counter(frame.reason for frame in sequence.skipped)),
    }


def _scale(job: RunJob) -> dict[str, Any]:
    """The origin of the poses' unit, unless it is the recording. A network's error of scale is then in the anchors
    too."""
    if job.scale is None:
        return {} if job.sequence.pose_scale == 1 else {"scale_from": "--pose-scale"}
    scale = {"metres_per_unit": job.scale.metres, "spread": job.scale.spread, "frames": job.scale.frames}
    return {"scale_from": "network", "scale": scale, "anchors_show": "shape only"}


def _frames(records: Records, selected: int) -> dict[str, Any]:
    skipped = [record for record in records if record["state"] == "skipped"]
    return {
        "selected": selected,
        "done": len(records) - len(skipped),
        "skipped": dict(Counter(record["reason"] for record in skipped)),
        "skipped_frames": [{"name": record["name"], "reason": record["reason"]} for record in skipped],
        "with_ground_truth": sum(record.get("ground_truth", False) for record in records),
    }


def _uncertainty(done: Records) -> dict[str, Any]:
    """Means over all valid pixels of all frames. With perfect depth, those of a plain run are the method's lower
    bound."""
    pixels = sum(record["valid_pixels"] for record in done)
    return {
        "mean_disagreement": _pixel_mean(done, "mean_disagreement"),
        "mean_sigma": _pixel_mean(done, "mean_sigma"),
        "mean_network_sigma": _pixel_mean(done, "mean_network_sigma"),
        "units": "disagreement m^2, sigma m",
        # Share of valid pixels with 0 < sigma < ``NEAR_ZERO``: no component is near, and the prior is 0.
        "near_zero_share": sum(record["near_zero"] for record in done) / pixels if pixels else None,
        # Share of valid pixels not seen from two places; their M is ``UfMStarConfig.unmeasured``.
        "unmeasured_share": sum(record["unmeasured"] for record in done) / pixels if pixels else None,
        "valid_pixels": pixels,
    }


def _anchors(done: Records) -> dict[str, Any] | None:
    """Means over all frames of the anchors' figures; None without anchors."""
    records = [record["anchors"] for record in done if "anchors" in record]
    if not records:
        return None
    first = next((number for number, record in enumerate(records) if record["used"]), None)
    stated = [record for record in records if "confidence" in record]
    means = {f"{key}_per_frame": mean(r[key] for r in records) for key in ("tracked", "found", "usable", "used")}
    return {
        **means,
        "frames_before_the_first": len(records) if first is None else first,
        # Reasons without figures of single frames, which are in frames.jsonl.
        "frames_without": dict(Counter(r["without"].partition(":")[0] for r in records if r["without"] is not None)),
        **({"frames_with_confidence": sum(r["confidence"] for r in stated)} if stated else {}),
        "mean_anchored": _pixel_mean(done, "mean_anchored"),
        "mean_bias": _pixel_mean(done, "mean_bias"),
        "units": "mean_anchored m^2 (B), mean_bias 1 (r: true depth over predicted, less 1)",
    }


def _pixel_mean(done: Records, key: str) -> float | None:
    """Mean over pixels; a frame without a valid pixel has no mean."""
    weighted = [(record[key], record["valid_pixels"]) for record in done if record[key] is not None]
    pixels = sum(count for _, count in weighted)
    return sum(mean * count for mean, count in weighted) / pixels if pixels else None


def _mixture(done: Records, mixture: GaussianMixture) -> dict[str, Any]:
    last = done[-1]["components"] if done else 0
    counts = {key: sum(record[key] for record in done) for key in ("segments", "matched", "pairs", "new", "dropped")}
    size = mixture.bytes_per_component()
    return {
        "components": last,
        "components_over_time": [record["components"] for record in done],
        **counts,
        "bytes_in_use": last * size,
        "bytes_allocated": mixture.capacity * size,
    }


def _time(done: Records, seconds: float) -> dict[str, Any]:
    """Medians by stage. "frame" is the time between two frames, which is shorter than the sum of the stages, because
    threads read and write frames. The rate is that of the median frame, because the first one also loads libraries and
    compiled kernels."""
    stages = {stage: [record["ms"][stage] for record in done if stage in record["ms"]] for stage in STAGES}
    total = median(record["ms"]["cycle"] for record in done) if done else None
    return {
        "median_ms": {stage: median(times) if times else None for stage, times in stages.items()} | {"frame": total},
        "frames_per_second": 1000 / total if total else None,
        "wall_seconds": seconds,
    }

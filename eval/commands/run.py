"""A sequence through a depth source and UfM*, onto disk: the runner behind ``ufmstar run``.

Every frame is finished or not there, and a run that was stopped, by whatever, goes on with the same
results as if it had not been.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
from torch import Tensor

from ufmstar_torch.eval.engine.judge import Judge
from ufmstar_torch.eval.engine.run_source import Source
from ufmstar_torch.eval.report.run_pictures import Finished, common_scales, draw_sheet, draw_video, write_mixture
from ufmstar_torch.eval.results.files import to_json, write_json_atomic
from ufmstar_torch.eval.results.run_folder import Checkpoint, RunFolder
from ufmstar_torch.eval.results.summary import FAILED, FINISHED, INTERRUPTED, NEAR_ZERO, Ending, summarise
from ufmstar_torch.eval.results.writers import WrittenFrame
from ufmstar_torch.eval.sequences.frame import Frame, FrameError, FrameSequence
from ufmstar_torch.eval.sequences.ground_truth import truth_at
from ufmstar_torch.frame import FRAME_FAULTS
from ufmstar_torch.pipeline import UncertainPrediction

# [s] between two updates of the summary of a run that is going on.
_SUMMARY_EVERY = 30.0
_GOING_ON = Ending(INTERRUPTED, "no orderly end: the program was killed, or is still running")


@dataclass(frozen=True, eq=False)
class Job:
    """What to run.

    Attributes:
        sequence: the posed frames.
        indices: which of them, in order.
        source: the depth; in its initial state.
        settings: everything the user chose, as plain values, for the summary.
        video: whether to make preview.mp4.
        sheet: whether to make contact_sheet.png.
    """

    sequence: FrameSequence
    indices: range
    source: Source
    settings: Mapping[str, Any]
    video: bool = True
    sheet: bool = True

    def identity(self) -> dict[str, Any]:
        """Plain values on which the results depend: a run can only go on with the same ones."""
        sequence, digest = self.sequence, hashlib.sha256()
        for index in self.indices:
            entry = sequence.entries[index]
            digest.update(entry.name.encode() + entry.T_world_cam.tobytes())
        return {
            "sequence": {
                "name": sequence.name,
                "layout": sequence.layout,
                "frames": len(self.indices),
                "names_and_poses": digest.hexdigest(),
                "intrinsics": sequence.intrinsics,
                "depth_intrinsics": sequence.depth_intrinsics,
                "first_frame": self._first_frame(),
            },
            "ufm": self.source.ufm.config.to_dict(),
            "source": self.source.identity,
            "device": self.source.device.type,
        }

    def _first_frame(self) -> str | None:
        """A digest of the first frame's pixels, which other data under the same names would not have."""
        try:
            frame = self.sequence[self.indices[0]]
        except FrameError:
            return None
        maps = [array for array in (frame.image, frame.depth) if array is not None]
        return hashlib.sha256(b"".join(np.ascontiguousarray(array).tobytes() for array in maps)).hexdigest()


@dataclass(frozen=True)
class Progress:
    """How far a run is.

    Attributes:
        stage: "frames" or "pictures".
        done: of this stage, skipped frames included.
        total: of this stage.
        components: K after this frame, None if it was skipped or nothing has been done yet.
        skipped: frames so far.
    """

    stage: str
    done: int
    total: int
    components: int | None
    skipped: int


class _Stopped(Exception):
    """The caller asked to stop, between two frames."""


def run(
    job: Job,
    out: str | Path,
    *,
    resume: bool = False,
    overwrite: bool = False,
    progress: Callable[[Progress], None] = lambda _: None,
    stop: Callable[[], bool] = lambda: False,
) -> dict[str, Any]:
    """Run a job and leave its frames, pictures, mixture and summary in a folder.

    KeyboardInterrupt and OSError (a full disk) end the run in order: finished frames stay, and the summary
    says so. A frame that cannot be read, or whose pose or intrinsics are unusable, is skipped and counted.

    Args:
        job: what to run.
        out: the folder; see ``RunFolder.open`` for whose it may be.
        resume: go on where an earlier run stopped.
        overwrite: replace an earlier run.
        progress: called at the start of each stage and after every frame.
        stop: asked before every frame; True ends the run as KeyboardInterrupt does.

    Returns:
        What summary.json holds; ``state`` is "finished", "interrupted" or "failed", ``reason`` says why.

    Raises:
        FolderError: the folder cannot be used.
        OSError: not even the summary can be written.
        Exception: whatever else the network or UfM* raise, after the summary was written.
    """
    folder = RunFolder.open(out, job.identity(), resume=resume, overwrite=overwrite)
    _rewind(job.source, folder)
    with folder:
        _write_summary(job, folder, _GOING_ON)
        ending, outputs = Ending(FAILED, "an error in the program"), {}
        try:
            _all_frames(job, folder, progress, stop)
            ending = _ending(job, folder)
            outputs = _outputs(job, folder, progress, stop)
        except (KeyboardInterrupt, _Stopped):
            ending = Ending(INTERRUPTED, f"stopped by the user after {_counts(folder, job)}; --resume goes on")
        except OSError as error:
            ending = Ending(FAILED, f"{error}; stopped after {_counts(folder, job)}; --resume goes on")
        except BaseException as error:
            ending = Ending(FAILED, f"{type(error).__name__}: {error}")
            raise
        finally:
            # A frame in hand may have changed the state already; what is reported is what is on disk.
            _rewind(job.source, folder)
            summary = _write_summary(job, folder, ending, outputs)
    return summary


def _rewind(source: Source, folder: RunFolder) -> None:
    """Bring the source to the state after the last finished frame."""
    source.reset()
    if folder.checkpoint.module:
        source.load_state(folder.checkpoint.module)


def _all_frames(job: Job, folder: RunFolder, progress: Callable[[Progress], None], stop: Callable[[], bool]) -> None:
    """The frames that are left."""
    judge = Judge(folder.checkpoint.metrics)
    first, earlier = folder.checkpoint.position, list(folder.checkpoint.sessions)
    skipped = sum(record["state"] == "skipped" for record in folder.records)
    started = reported = perf_counter()
    saving = 0.0
    progress(Progress("frames", first, len(job.indices), None, skipped))
    for position in range(first, len(job.indices)):
        if stop():
            raise _Stopped
        record = _one_frame(job, folder, judge, job.indices[position], saving)
        session = {"first": first, "frames": position + 1 - first, "seconds": perf_counter() - started}
        state = Checkpoint(
            position=position + 1,
            module=job.source.state(),
            metrics=judge.state(),
            sessions=[*earlier, session],
        )
        before = perf_counter()
        folder.commit(record, state)
        saving = 1000 * (perf_counter() - before)
        skipped += record["state"] == "skipped"
        progress(Progress("frames", position + 1, len(job.indices), record.get("components"), skipped))
        if perf_counter() - reported > _SUMMARY_EVERY:
            _write_summary(job, folder, _GOING_ON)
            reported = perf_counter()


def _one_frame(job: Job, folder: RunFolder, judge: Judge, index: int, saving: float) -> dict[str, Any]:
    """Predict, judge and write one frame; its line for frames.jsonl.

    Args:
        saving: [ms] what it took to save the state after the frame before; this frame's is not known yet.
    """
    clock, name = job.source.clock, job.sequence.entries[index].name
    clock.take()
    try:
        with clock.stage("read"):
            frame = job.sequence[index]
        with clock.stage("predict"):
            result = job.source.predict(frame)
        with clock.stage("metrics"):
            truth = _truth(frame, result)
    except FrameError as error:
        return {"index": index, "name": name, "state": "skipped", "reason": error.reason}
    fault = int(result.ufm.statistics.fault[0])
    if fault:
        if job.source.anchors is not None:
            job.source.anchors.undo()
        return {"index": index, "name": name, "state": "skipped", "reason": FRAME_FAULTS[fault]}
    with clock.stage("metrics"):
        judge.update(result, truth)
    with clock.stage("write"):
        written = folder.writer.write(
            name,
            depth=result.depth[0],
            variance=result.variance[0],
            disagreement=result.disagreement[0],
            anchored=None if result.ufm.anchored is None else result.ufm.anchored[0],
            bias=None if result.ufm.bias is None else result.ufm.bias[0],
            valid=result.ufm.valid[0],
        )
    ms = {**clock.take(), "save": saving}
    return _record(index, name, result, truth is not None, written, ms) | _anchors(job.source, result)


def _truth(frame: Frame, result: UncertainPrediction) -> np.ndarray | None:
    height, width = result.depth.shape[-2:]
    return truth_at(frame, result.intrinsics[0].cpu().double().numpy(), (height, width))


def _record(
    index: int, name: str, result: UncertainPrediction, judged: bool, written: WrittenFrame, ms: dict[str, float]
) -> dict[str, Any]:
    """What is remembered of a frame. "prepare" is what a prediction takes beside network, anchors and UfM*."""
    statistics, K = result.ufm.statistics, result.intrinsics[0].tolist()
    counts = ("components", "segments", "matched", "pairs", "new", "dropped", "valid_pixels")
    prepare = ms["predict"] - ms.get("network", 0.0) - ms.get("anchors", 0.0) - ms["ufm"]
    times = {stage: time for stage, time in {**ms, "prepare": prepare}.items() if stage != "predict"}
    own = result.prediction.variance
    return {
        "index": index,
        "name": name,
        "state": "done",
        "size": list(result.depth.shape[-2:]),
        "intrinsics": [K[0][0], K[1][1], K[0][2], K[1][2]],
        "member": result.member,
        **{count: int(getattr(statistics, count)[0]) for count in counts},
        "rotation_deviation": float(statistics.rotation_deviation[0]),
        "mean_disagreement": _mean(result.disagreement, result.ufm.valid),
        "mean_sigma": _mean(result.std, result.ufm.valid),
        "mean_network_sigma": None if own is None else _mean(own.sqrt(), result.ufm.valid),
        "near_zero": int(((result.std > 0) & (result.std < NEAR_ZERO)).sum()),
        "ground_truth": judged,
        "saturated": {"depth": written.depth_saturated, "sigma": written.sigma_saturated},
        "ms": times,
    }


def _anchors(source: Source, result: UncertainPrediction) -> dict[str, Any]:
    """What a run with anchors remembers besides: their counts, and the means of B [m^2] and of r."""
    anchored, bias, valid = result.ufm.anchored, result.ufm.bias, result.ufm.valid
    if source.anchors is None or anchored is None or bias is None:
        return {}
    means = {"mean_anchored": _mean(anchored, valid), "mean_bias": _mean(bias, valid)}
    return {"anchors": source.anchors.counts(result.ufm.statistics), **means}


def _mean(values: Tensor, valid: Tensor) -> float:
    return float(values[valid].double().mean()) if bool(valid.any()) else float("nan")


def _ending(job: Job, folder: RunFolder) -> Ending:
    """Of a run that went through all frames."""
    if any(record["state"] == "done" for record in folder.records):
        return Ending(FINISHED, _counts(folder, job))
    reasons = sorted({record["reason"] for record in folder.records})
    return Ending(FAILED, f"no frame could be used: {'; '.join(reasons[:3])}")


def _counts(folder: RunFolder, job: Job) -> str:
    skipped = sum(record["state"] == "skipped" for record in folder.records)
    done = f"{len(folder.records) - skipped} of {len(job.indices)} frames"
    return f"{done} ({skipped} skipped)" if skipped else done


def _outputs(
    job: Job, folder: RunFolder, progress: Callable[[Progress], None], stop: Callable[[], bool]
) -> dict[str, str | None]:
    """Mixture, curves and pictures of all finished frames: by file, None if made, else why not."""
    done = [record for record in folder.records if record["state"] == "done"]
    if not done:
        return {}
    write_mixture(folder.path, job.source.ufm)
    write_json_atomic(folder.path / "curves.json", Judge(folder.checkpoint.metrics).curves())
    made: dict[str, str | None] = dict.fromkeys(("mixture.ply", "ellipsoids.ply", "mixture.npz", "curves.json"))
    with_error = any(record["ground_truth"] for record in done) and not job.source.is_truth
    finished = Finished(folder.path, job.sequence, done, with_error)
    try:
        if job.sheet or job.video:
            scales = common_scales(finished)
        if job.sheet:
            draw_sheet(finished, scales, f"{job.sequence.name}: {_counts(folder, job)}")
            made["contact_sheet.png"] = None
        for drawn in draw_video(finished, scales) if job.video else ():
            progress(Progress("pictures", drawn, len(done), None, 0))
            if stop():
                raise _Stopped
        if job.video:
            made["preview.mp4"] = None
    except ImportError as error:  # an optional package; the frames are what a run is for
        wanted = {"contact_sheet.png": job.sheet, "preview.mp4": job.video}
        made |= {name: str(error) for name, asked in wanted.items() if asked and name not in made}
    return made


def _write_summary(
    job: Job, folder: RunFolder, ending: Ending, outputs: Mapping[str, str | None] | None = None
) -> dict[str, Any]:
    """From what is on disk, so that a continued run says the same."""
    summary = summarise(
        ending=ending,
        settings=job.settings,
        sequence=job.sequence,
        selected=len(job.indices),
        source=job.source.identity,
        records=folder.records,
        sessions=folder.checkpoint.sessions,
        mixture=job.source.ufm.mixture,
        figures=Judge(folder.checkpoint.metrics).figures(),
        outputs=outputs or {},
    )
    folder.write_summary(summary)
    plain: dict[str, Any] = to_json(summary)
    return plain

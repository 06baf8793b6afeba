"""``ufmstar run``: a sequence through a depth source and UfM*, onto disk.

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
import torch
from torch import Tensor

from ufmstar_torch.anchors.dense import DenseEvidence
from ufmstar_torch.anchors.landmarks import LandmarkSource
from ufmstar_torch.anchors.tracker import LandmarkTracker
from ufmstar_torch.config import UfMStarConfig
from ufmstar_torch.eval.engine.anchors import AnchorSource, Tracks
from ufmstar_torch.eval.engine.behind import Behind
from ufmstar_torch.eval.engine.estimators import Gaussians
from ufmstar_torch.eval.engine.judge import UFM, RunMetrics
from ufmstar_torch.eval.engine.predictions import DepthSource
from ufmstar_torch.eval.engine.rows import RowRunner
from ufmstar_torch.eval.engine.stream import FrameResult, FrameSink, FrameStream, Stopped
from ufmstar_torch.eval.engine.warm_up import warm_up_command
from ufmstar_torch.eval.methods.setting import TRACKED, Setting
from ufmstar_torch.eval.report.outputs import Finished, common_columns, draw_sheet, draw_video, mixture_writers
from ufmstar_torch.eval.results.files import to_json, write_json_atomic
from ufmstar_torch.eval.results.journal import Journal, row_state
from ufmstar_torch.eval.results.run_folder import RunFolder
from ufmstar_torch.eval.results.summary import FAILED, FINISHED, INTERRUPTED, Ending, summarise
from ufmstar_torch.eval.sequences.frame import FrameError, FrameSequence
from ufmstar_torch.recalibrate import read_recalibration, split_name
from ufmstar_torch.ufmstar import UfMStar

# [s] between two updates of the summary of a run that is going on.
_SUMMARY_EVERY = 30.0
_GOING_ON = Ending(INTERRUPTED, "no orderly end: the program was killed, or is still running")


@dataclass(frozen=True, eq=False)
class RunJob:
    """What to run."""

    sequence: FrameSequence  # the posed frames
    indices: range  # which of them, in order
    source: DepthSource  # of the depth
    config: UfMStarConfig  # of UfM*
    device: torch.device  # of UfM*
    settings: Mapping[str, Any]  # everything the user chose, as plain values, for the summary
    recalibration: str = ""  # FILE@DIGEST of a map of the variance; "" = none
    every: bool = False  # all members predict on every image, instead of one in turn
    video: bool = True  # whether to make preview.mp4
    sheet: bool = True  # whether to make contact_sheet.png
    # makes the source of the anchors, in its initial state; for ``config.anchored``.
    landmarks: Callable[[], LandmarkSource] = LandmarkTracker

    def row(self, module: Mapping[str, Tensor], position: int) -> RowRunner:
        """UfM* on the source after ``position`` frames, in the state that a checkpoint holds; {} at the start."""
        mapped = read_recalibration(self.recalibration) if self.recalibration else None
        row = RowRunner(
            UFM,
            self.source,
            Gaussians(self.config, self.device, recalibration=mapped),
            every=self.every,
            anchors=AnchorSource(Setting(anchors=TRACKED), Tracks(self.landmarks())) if self.config.anchored else None,
            skips_faults=True,
            device=self.device,
        )
        if module:
            row.load_state(row_state(module, bare=not self.source.needs_image, images=torch.tensor(position)))
        return row

    @property
    def source_identity(self) -> dict[str, Any]:
        """Plain values on which depth and anchors depend."""
        return {**self.source.identity, **(self.landmarks().identity if self.config.anchored else {})}

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
            "ufm": self.config.to_dict(),
            "source": self.source_identity,
            "device": self.device.type,
            **({"recalibration": split_name(self.recalibration)[1]} if self.recalibration else {}),
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
    """How far a run is."""

    stage: str  # "kernels" (compiled on a machine's first run), "frames" or "pictures"
    done: int  # of this stage, skipped frames included
    total: int  # of this stage
    components: int | None  # K after this frame, None if it was skipped or nothing has been done yet
    skipped: int  # frames so far


def run(
    job: RunJob,
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
    with folder:
        _write_summary(job, folder, _GOING_ON)
        ending, outputs = Ending(FAILED, "an error in the program"), {}
        try:
            _frames(job, folder, progress, stop)
            ending = _ending(job, folder)
            outputs = _outputs(job, folder, progress, stop)
        except (KeyboardInterrupt, Stopped):
            ending = Ending(INTERRUPTED, f"stopped by the user after {_counts(folder, job)}; --resume goes on")
        except OSError as error:
            ending = Ending(FAILED, f"{error}; stopped after {_counts(folder, job)}; --resume goes on")
        except BaseException as error:
            ending = Ending(FAILED, f"{type(error).__name__}: {error}")
            raise
        finally:
            summary = _write_summary(job, folder, ending, outputs)
    return summary


def _frames(job: RunJob, folder: RunFolder, progress: Callable[[Progress], None], stop: Callable[[], bool]) -> None:
    """The frames that are left."""

    def compiling(done: int, total: int) -> None:
        progress(Progress("kernels", done, total, None, 0))

    dense = job.config.anchored and isinstance(job.landmarks(), DenseEvidence)
    warm_up_command(job.config, job.device, compiling, images=job.source.needs_image, dense=dense)
    position = folder.checkpoint.position
    row = job.row(folder.checkpoint.module, position)
    metrics = RunMetrics(UFM, folder.checkpoint.metrics)
    journal = Journal(UFM, folder, metrics.figures.state, bare=not job.source.needs_image)
    stream = FrameStream(job.sequence, job.indices, [row], device=job.device, start=position)
    with Behind([metrics, journal, _Summaries(job, folder)]) as behind:
        stream.drive([behind, _Reports(job, folder, progress)], stop=stop)


class _Reports(FrameSink):
    """The progress after every frame."""

    def __init__(self, job: RunJob, folder: RunFolder, progress: Callable[[Progress], None]) -> None:
        self._job, self._progress = job, progress
        self._skipped = sum(record["state"] == "skipped" for record in folder.records)

    def begin(self, stream: FrameStream) -> None:
        self._progress(Progress("frames", stream.position, len(self._job.indices), None, self._skipped))

    def take(self, result: FrameResult) -> None:
        self._skipped += len(result.skipped)
        statistics = result.rows[UFM].estimate.statistics if UFM in result.rows else None
        components = None if statistics is None else int(statistics.components[0])
        self._progress(Progress("frames", result.number + 1, len(self._job.indices), components, self._skipped))


class _Summaries(FrameSink):
    """Now and then the summary of a run that is going on."""

    def __init__(self, job: RunJob, folder: RunFolder) -> None:
        self._job, self._folder = job, folder

    def begin(self, stream: FrameStream) -> None:
        self._reported = perf_counter()

    def take(self, result: FrameResult) -> None:
        if perf_counter() - self._reported > _SUMMARY_EVERY:
            _write_summary(self._job, self._folder, _GOING_ON)
            self._reported = perf_counter()


def _ending(job: RunJob, folder: RunFolder) -> Ending:
    """Of a run that went through all frames."""
    if any(record["state"] == "done" for record in folder.records):
        return Ending(FINISHED, _counts(folder, job))
    reasons = sorted({record["reason"] for record in folder.records})
    return Ending(FAILED, f"no frame could be used: {'; '.join(reasons[:3])}")


def _counts(folder: RunFolder, job: RunJob) -> str:
    skipped = sum(record["state"] == "skipped" for record in folder.records)
    done = f"{len(folder.records) - skipped} of {len(job.indices)} frames"
    return f"{done} ({skipped} skipped)" if skipped else done


def _outputs(
    job: RunJob, folder: RunFolder, progress: Callable[[Progress], None], stop: Callable[[], bool]
) -> dict[str, str | None]:
    """Mixture, curves and pictures of all finished frames: by file, None if made, else why not."""
    done = [record for record in folder.records if record["state"] == "done"]
    if not done:
        return {}
    for name, write in mixture_writers(_ufm(job, folder)).items():
        write(folder.path / name)
    write_json_atomic(folder.path / "curves.json", RunMetrics(UFM, folder.checkpoint.metrics).figures.curves())
    made: dict[str, str | None] = dict.fromkeys(("mixture.ply", "ellipsoids.ply", "mixture.npz", "curves.json"))
    with_error = any(record["ground_truth"] for record in done) and not job.source.is_truth
    finished = Finished(folder.path, job.sequence, done, with_error)
    try:
        if job.sheet or job.video:
            columns = common_columns(finished)
        if job.sheet:
            draw_sheet(finished, columns, f"{job.sequence.name}: {_counts(folder, job)}")
            made["contact_sheet.png"] = None
        for drawn in draw_video(finished, columns) if job.video else ():
            progress(Progress("pictures", drawn, len(done), None, 0))
            if stop():
                raise Stopped
        if job.video:
            made["preview.mp4"] = None
    except ImportError as error:  # an optional package; the frames are what a run is for
        expected = {"contact_sheet.png": job.sheet, "preview.mp4": job.video}
        made |= {name: str(error) for name, requested in expected.items() if requested and name not in made}
    return made


def _write_summary(
    job: RunJob, folder: RunFolder, ending: Ending, outputs: Mapping[str, str | None] | None = None
) -> dict[str, Any]:
    """From what is on disk, so that a continued run says the same."""
    summary = summarise(
        ending=ending,
        settings=job.settings,
        sequence=job.sequence,
        selected=len(job.indices),
        source=job.source_identity,
        runtime=job.source.runtime,
        records=folder.records,
        sessions=folder.checkpoint.sessions,
        mixture=_ufm(job, folder).mixture,
        figures=RunMetrics(UFM, folder.checkpoint.metrics).figures.figures(),
        outputs=outputs or {},
    )
    folder.write_summary(summary)
    plain: dict[str, Any] = to_json(summary)
    return plain


def _ufm(job: RunJob, folder: RunFolder) -> UfMStar:
    """UfM* after the last finished frame. A frame in hand may have changed the running one already."""
    estimator = job.row(folder.checkpoint.module, folder.checkpoint.position).estimator
    assert isinstance(estimator, Gaussians)
    return estimator.ufm

"""``run``: processes a sequence with a depth source and UfM*, and writes the results.

A frame's files are complete or absent. An interrupted run continues with the same results.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from ufmstar_torch.eval.engine.progress import Progress, ProgressSink
from ufmstar_torch.eval.engine.stream import FrameStream, Stopped
from ufmstar_torch.eval.engine.warm_up import warm_up_command
from ufmstar_torch.eval.engine.writer_thread import WriterThread
from ufmstar_torch.eval.run.folder import output_folder
from ufmstar_torch.eval.run.gaussians import write_mixture_npz, write_mixture_ply
from ufmstar_torch.eval.run.job import RunJob
from ufmstar_torch.eval.run.pictures import FinishedRun, common_columns, draw_sheet, draw_video
from ufmstar_torch.eval.run.run_folder import RUN, RunFolder
from ufmstar_torch.eval.run.summary import FAILED, FINISHED, INTERRUPTED, write_summary
from ufmstar_torch.frames.warnings import LOGGER

Show = Callable[[Progress], None]
Stop = Callable[[], bool]


def run(
    job: RunJob,
    out: str | Path,
    *,
    resume: bool = False,
    overwrite: bool = False,
    progress: Show = lambda _: None,
    stop: Stop = lambda: False,
) -> dict[str, Any]:
    """Run a job and write its frames, pictures, mixture and summary to a folder. Returns the content of summary.json.

    After KeyboardInterrupt and OSError (a full disk) finished frames stay, and the summary states the reason. A frame
    that cannot be read, or whose pose or intrinsics are unusable, is skipped and counted.

    ``progress`` is called at the start of each stage and after every frame, ``stop`` before every frame: True ends the
    run like KeyboardInterrupt.

    Raises:
        FolderError: the folder cannot be used (``output_folder``).
        OSError: the summary cannot be written.
        Exception: any other error of the network or UfM*, after the summary was written.
    """
    path, identity = Path(out), {"identity": job.identity()}
    how = {"resume": resume, "overwrite": overwrite}
    with output_folder(path, RUN, identity, **how) as resumed, RunFolder(job, path, resumed) as folder:
        no_end = "no orderly end: the program was killed, or is still running"
        for text in write_summary(folder, INTERRUPTED, no_end)["warnings"]:
            LOGGER.warning("%s", text)
        ending, outputs = (FAILED, "an error in the program"), {}
        try:
            _frames(folder, progress, stop)
            ending = _ending(folder)
            outputs = _outputs(folder, progress, stop)
        except (KeyboardInterrupt, Stopped):
            ending = INTERRUPTED, f"stopped by the user after {_counts(folder)}; --resume goes on"
        except OSError as error:
            ending = FAILED, f"{error}; stopped after {_counts(folder)}; --resume goes on"
        except BaseException as error:
            ending = FAILED, f"{type(error).__name__}: {error}"
            raise
        finally:
            summary = write_summary(folder, *ending, outputs)
    return summary


def _frames(folder: RunFolder, progress: Show, stop: Stop) -> None:
    """Process the remaining frames."""
    job = folder.job
    warm_up_job(job, progress)
    row, position = job.row(folder.checkpoint), folder.checkpoint.position
    stream = FrameStream(job.sequence, job.indices, [row], start=position)
    with WriterThread([folder.metrics, folder]) as writer:
        stream.drive([writer, ProgressSink(progress, _skipped(folder))], stop=stop)


def warm_up_job(job: RunJob, progress: Show) -> None:
    """Compile a job's kernels before its first frame."""
    warm_up_command(job.config, progress, [] if job.config.anchors is None else [job.landmarks])


def _ending(folder: RunFolder) -> tuple[str, str]:
    """State and message of a run that has processed all frames."""
    if any(record["state"] == "done" for record in folder.records):
        return FINISHED, _counts(folder)
    reasons = sorted({record["reason"] for record in folder.records})
    return FAILED, f"no frame could be used: {'; '.join(reasons[:3])}"


def _skipped(folder: RunFolder) -> int:
    return sum(record["state"] == "skipped" for record in folder.records)


def _counts(folder: RunFolder) -> str:
    skipped = _skipped(folder)
    done = f"{len(folder.records) - skipped} of {len(folder.job.indices)} frames"
    return f"{done} ({skipped} skipped)" if skipped else done


def _outputs(folder: RunFolder, progress: Show, stop: Stop) -> dict[str, str | None]:
    """Write the mixture and pictures of all finished frames. Returns by file None, or why it was not made."""
    job = folder.job
    done = [record for record in folder.records if record["state"] == "done"]
    if not done:
        return {}
    ufm = job.ufm(folder.checkpoint)
    write_mixture_ply(folder.path / "mixture.ply", ufm.mixture, T_world_first=ufm.T_world_first)
    write_mixture_npz(folder.path / "mixture.npz", ufm.mixture, T_world_first=ufm.T_world_first)
    made: dict[str, str | None] = dict.fromkeys(("mixture.ply", "mixture.npz"))
    with_error = any(record["ground_truth"] for record in done) and not job.source.is_truth
    finished = FinishedRun(folder.path, job.sequence, done, with_error)
    try:
        if job.sheet or job.video:
            columns = common_columns(finished)
        if job.sheet:
            draw_sheet(finished, columns, f"{job.sequence.name}: {_counts(folder)}")
            made["contact_sheet.png"] = None
        for drawn in draw_video(finished, columns) if job.video else ():
            progress(Progress("pictures", drawn, len(done)))
            if stop():
                raise Stopped
        if job.video:
            made["preview.mp4"] = None
    except ImportError as error:  # an optional package is missing; the frames are complete
        expected = {"contact_sheet.png": job.sheet, "preview.mp4": job.video}
        made |= {name: str(error) for name, requested in expected.items() if requested and name not in made}
    return made

"""``run``: processes a sequence with a depth source and UfM*, and writes the results.

A frame's files are complete or absent. The same command, after an interruption too, computes the same results; it
reuses the networks' predictions.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

from ufmstar_torch.eval.engine.predictions import CacheError, PredictionCache
from ufmstar_torch.eval.engine.progress import Progress, warm_up_command
from ufmstar_torch.eval.engine.stream import Stopped, frame_progress, frame_results
from ufmstar_torch.eval.engine.threads import call_behind
from ufmstar_torch.eval.run.folder import output_folder
from ufmstar_torch.eval.run.gaussians import write_mixture_npz, write_mixture_ply
from ufmstar_torch.eval.run.job import RunJob
from ufmstar_torch.eval.run.pictures import SHEET, VIDEO, FinishedRun, common_columns, draw_sheet, draw_video
from ufmstar_torch.eval.run.run_folder import CACHE, RUN, RunFolder
from ufmstar_torch.eval.run.summary import FAILED, FINISHED, INTERRUPTED, read_summary, write_summary
from ufmstar_torch.frames.warnings import LOGGER
from ufmstar_torch.ufmstar import UfMStar

Show = Callable[[Progress], None]
Stop = Callable[[], bool]
_AGAIN = "the same command computes the rest, with the predictions so far"


def run(
    job: RunJob,
    out: str | Path,
    *,
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
        CacheError: predictions cannot be stored there.
        OSError: the summary cannot be written.
        Exception: any other error of the network or UfM*, after the summary was written.
    """
    path = Path(out)
    with output_folder(path, RUN, {"identity": job.identity()}, overwrite=overwrite):
        folder, row, ufm = RunFolder(job, path), *job.row()
        cache = PredictionCache(path / CACHE) if job.source.cacheable else None
        with _summarised(folder, ufm):
            warm_up_job(job, progress)
            shown = frame_progress(progress, len(job.indices))
            results = frame_results(job.sequence, job.indices, [row], cache=cache, stop=stop)
            with closing(results), call_behind() as judge, call_behind() as write:
                for result in results:  # read, predict, find anchors, update
                    write(folder.write, result, judge)
                    shown(result)
            _write_outputs(folder, ufm, progress, stop)
    return read_summary(path)


@contextmanager
def _summarised(folder: RunFolder, ufm: UfMStar) -> Iterator[None]:
    """Write the summary before the frames, with what is wrong with the input, and after them, whatever ends them."""
    no_end = f"no orderly end: the program was killed ({_AGAIN}), or is still running"
    for text in write_summary(folder, ufm.mixture, INTERRUPTED, no_end)["warnings"]:
        LOGGER.warning("%s", text)
    ending = FAILED, "an error in the program"
    try:
        yield
        ending = _ending(folder)
    except (KeyboardInterrupt, Stopped):
        ending = INTERRUPTED, f"stopped by the user after {_counts(folder)}; {_AGAIN}"
    except (OSError, CacheError) as error:
        ending = FAILED, f"{error}; stopped after {_counts(folder)}; {_AGAIN}"
    except BaseException as error:
        ending = FAILED, f"{type(error).__name__}: {error}"
        raise
    finally:
        write_summary(folder, ufm.mixture, *ending)


def warm_up_job(job: RunJob, progress: Show) -> None:
    """Compile a job's kernels before its first frame."""
    warm_up_command(job.config, progress, [] if job.config.anchors is None else [job.landmarks])


def _ending(folder: RunFolder) -> tuple[str, str]:
    """State and message of a run that has processed all frames."""
    if any(record["state"] == "done" for record in folder.records):
        return FINISHED, _counts(folder)
    reasons = sorted({record["reason"] for record in folder.records})
    return FAILED, f"no frame could be used: {'; '.join(reasons[:3])}"


def _counts(folder: RunFolder) -> str:
    skipped = sum(record["state"] == "skipped" for record in folder.records)
    done = f"{len(folder.records) - skipped} of {len(folder.job.indices)} frames"
    return f"{done} ({skipped} skipped)" if skipped else done


def _write_outputs(folder: RunFolder, ufm: UfMStar, progress: Show, stop: Stop) -> None:
    """Write the mixture and pictures of all finished frames, and note them in ``folder.outputs``."""
    job, made = folder.job, folder.outputs
    done = [record for record in folder.records if record["state"] == "done"]
    if not done:
        return
    write_mixture_ply(folder.path / "mixture.ply", ufm.mixture, T_world_first=ufm.T_world_first)
    write_mixture_npz(folder.path / "mixture.npz", ufm.mixture, T_world_first=ufm.T_world_first)
    made |= dict.fromkeys(("mixture.ply", "mixture.npz"))
    with_error = any(record["ground_truth"] for record in done) and not job.source.is_truth
    finished = FinishedRun(folder.path, job.sequence, done, with_error)
    try:
        if job.sheet or job.video:
            columns = common_columns(finished)
        if job.sheet:
            draw_sheet(finished, columns, f"{job.sequence.name}: {_counts(folder)}")
            made[SHEET] = None
        for drawn in draw_video(finished, columns) if job.video else ():
            progress(Progress("pictures", drawn, len(done)))
            if stop():
                raise Stopped
        if job.video:
            made[VIDEO] = None
    except ImportError as error:  # an optional package is missing; the frames are complete
        requested = {SHEET: job.sheet, VIDEO: job.video}
        made |= {name: str(error) for name, wanted in requested.items() if wanted and name not in made}

"""``ufmstar run``: a sequence through a depth source and UfM*, onto disk.

Every frame is finished or not there, and a run that was stopped, by whatever, goes on with the same
results as if it had not been.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import torch

from ufmstar_torch.anchors.dense import DenseEvidence
from ufmstar_torch.anchors.landmarks import DENSE, LandmarkSource
from ufmstar_torch.anchors.tracker import LandmarkTracker
from ufmstar_torch.eval.commands.run_command import OWN_DEPTH, RunOptions
from ufmstar_torch.eval.engine.anchors import landmarks_of
from ufmstar_torch.eval.engine.judge import UFM, RunMetrics
from ufmstar_torch.eval.engine.load import network_source
from ufmstar_torch.eval.engine.maps import folder_source, own_depth
from ufmstar_torch.eval.engine.predictions import DepthSource
from ufmstar_torch.eval.engine.progress import Progress, ProgressSink
from ufmstar_torch.eval.engine.stream import FrameStream, Stopped
from ufmstar_torch.eval.engine.warm_up import warm_up_command
from ufmstar_torch.eval.engine.writer_thread import WriterThread
from ufmstar_torch.eval.run.files import write_json_atomic
from ufmstar_torch.eval.run.journal import Journal
from ufmstar_torch.eval.run.pictures import Finished, common_columns, draw_sheet, draw_video, mixture_writers
from ufmstar_torch.eval.run.run_folder import RunFolder
from ufmstar_torch.eval.run.run_job import RunJob
from ufmstar_torch.eval.run.summary import FAILED, FINISHED, GOING_ON, INTERRUPTED, write_summary
from ufmstar_torch.eval.sequences.frame import FrameSequence, parse_size, parse_slice
from ufmstar_torch.eval.sequences.intrinsics import parse_intrinsics
from ufmstar_torch.eval.sequences.open import open_sequence
from ufmstar_torch.models.inference import Inference
from ufmstar_torch.recalibrate import beside, named, read_recalibration


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
    with RunFolder.open(out, job.identity(), resume=resume, overwrite=overwrite) as folder:
        write_summary(job, folder, *GOING_ON)
        ending, outputs = (FAILED, "an error in the program"), {}
        try:
            _frames(job, folder, progress, stop)
            ending = _ending(job, folder)
            outputs = _outputs(job, folder, progress, stop)
        except (KeyboardInterrupt, Stopped):
            ending = INTERRUPTED, f"stopped by the user after {_counts(folder, job)}; --resume goes on"
        except OSError as error:
            ending = FAILED, f"{error}; stopped after {_counts(folder, job)}; --resume goes on"
        except BaseException as error:
            ending = FAILED, f"{type(error).__name__}: {error}"
            raise
        finally:
            summary = write_summary(job, folder, *ending, outputs)
    return summary


def _frames(job: RunJob, folder: RunFolder, progress: Callable[[Progress], None], stop: Callable[[], bool]) -> None:
    """The frames that are left."""

    def compiling(done: int, total: int) -> None:
        progress(Progress("kernels", done, total))

    dense = job.config.anchors is not None and isinstance(job.landmarks(), DenseEvidence)
    warm_up_command(job.config, job.device, compiling, images=job.source.needs_image, dense=dense)
    row, metrics = job.row(folder.checkpoint), RunMetrics(UFM, folder.checkpoint.metrics)
    stream = FrameStream(job.sequence, job.indices, [row], device=job.device, start=folder.checkpoint.position)
    with WriterThread([metrics, Journal(job, folder, metrics)]) as behind:
        stream.drive([behind, ProgressSink(progress, _skipped(folder))], stop=stop)


def _ending(job: RunJob, folder: RunFolder) -> tuple[str, str]:
    """Of a run that went through all frames."""
    if any(record["state"] == "done" for record in folder.records):
        return FINISHED, _counts(folder, job)
    reasons = sorted({record["reason"] for record in folder.records})
    return FAILED, f"no frame could be used: {'; '.join(reasons[:3])}"


def _skipped(folder: RunFolder) -> int:
    return sum(record["state"] == "skipped" for record in folder.records)


def _counts(folder: RunFolder, job: RunJob) -> str:
    skipped = _skipped(folder)
    done = f"{len(folder.records) - skipped} of {len(job.indices)} frames"
    return f"{done} ({skipped} skipped)" if skipped else done


def _outputs(
    job: RunJob, folder: RunFolder, progress: Callable[[Progress], None], stop: Callable[[], bool]
) -> dict[str, str | None]:
    """Mixture, curves and pictures of all finished frames: by file, None if made, else why not."""
    done = [record for record in folder.records if record["state"] == "done"]
    if not done:
        return {}
    for name, write in mixture_writers(job.ufm(folder.checkpoint)).items():
        write(folder.path / name)
    write_json_atomic(folder.path / "curves.json", RunMetrics(UFM, folder.checkpoint.metrics).curves())
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
            progress(Progress("pictures", drawn, len(done)))
            if stop():
                raise Stopped
        if job.video:
            made["preview.mp4"] = None
    except ImportError as error:  # an optional package; the frames are what a run is for
        expected = {"contact_sheet.png": job.sheet, "preview.mp4": job.video}
        made |= {name: str(error) for name, requested in expected.items() if requested and name not in made}
    return made


def job_from(chosen: RunOptions) -> RunJob:
    """The job that the options describe.

    Raises:
        ValueError: options that do not go together, files that do not fit, no frame selected.
        FileNotFoundError, NotADirectoryError: something that was named does not exist.
        ModuleNotFoundError: an optional package is missing.
    """
    options, config, device = chosen.settings(), chosen.config, chosen.device
    sequence = open_sequence(chosen.sequence, **chosen.opening.given())
    if not sequence.posed:
        raise ValueError(f"{sequence.name!r} holds single images without poses, which UfM* needs to compare views")
    landmarks = (
        _landmarks(chosen.uncertainty.anchors or DENSE, sequence) if config.anchors is not None else LandmarkTracker
    )
    indices = range(len(sequence))[parse_slice(options["frames"])]
    if not indices:
        raise ValueError(f"--frames {options['frames']} selects none of the {len(sequence)} frames")
    source = _source(options, sequence, indices, device)
    return RunJob(
        sequence=sequence,
        indices=indices,
        source=source,
        config=config.within(source.max_depth),
        recalibration=_recalibration(chosen, source),
        device=torch.device(device),
        settings=options,
        every=options["model"] is not None and options["mode"] == "full",
        video=not options["no_video"],
        sheet=not options["no_sheet"],
        landmarks=landmarks,
    )


def _recalibration(chosen: RunOptions, source: DepthSource) -> str:
    """FILE@DIGEST of the map that is named or lies beside the weights; "" = none.

    Raises:
        FileNotFoundError: the named file does not exist.
        ValueError: it is no recalibration, or was fitted under other settings or to another network.
    """
    name, weights = chosen.uncertainty.recalibration, chosen.network.weights
    if name == "none" or (name is None and not (weights and beside(weights[0]).is_file())):
        return ""
    file = beside(weights[0]) if name is None else Path(name)
    try:
        files = source.identity.get("weights", ())
        read_recalibration(str(file)).require(chosen.config, [one["sha256"] for one in files])
    except ValueError as error:
        raise ValueError(f"{file}: {error}; --recalibration none runs without it") from error
    return named(file)


def _landmarks(value: str | bool, sequence: FrameSequence) -> Callable[[], LandmarkSource]:
    """Makes the source of anchors in its initial state.

    Raises:
        FileNotFoundError: no such file.
        ValueError: an unknown source, or the sequence has no images to track in.
        ModuleNotFoundError: OpenCV is not installed.
    """
    source = landmarks_of(value, sequence.folder)
    if source.needs_image and all(entry.load_image is None for entry in sequence.entries):
        raise ValueError(f"--anchors tracks corners of images, of which the sequence {sequence.name!r} has none")
    if source.needs_image and find_spec("cv2") is None:
        raise ModuleNotFoundError("--anchors needs OpenCV: pip install 'ufmstar-torch[eval]'")
    # A map of landmarks remembers no image, and is read once.
    return (lambda: landmarks_of(value, sequence.folder)) if source.needs_image else (lambda: source)


def _source(options: Mapping[str, Any], sequence: FrameSequence, indices: range, device: str) -> DepthSource:
    size = parse_size(options["size"])
    if options["model"] is not None:
        return network_source(
            options["model"],
            options["weights"],
            spec=options["spec"],
            mode=options["mode"],
            samples=options["samples"],
            offload=options["offload"],
            inference=Inference(options["runtime"], options["precision"], options["threads"]),
            device=device,
        )
    if options["depth"] in OWN_DEPTH:
        if len(sequence.without_depth) == len(sequence):
            raise ValueError(f"--depth {options['depth']}: the sequence {sequence.name!r} has no depth maps")
        return own_depth(size)
    return folder_source(
        sequence,
        options["depth"],
        variance=options["variance"],
        scale=options["depth_scale"],
        intrinsics=parse_intrinsics(options["map_intrinsics"], "--map-intrinsics"),
        size=size,
        indices=indices,
    )

"""``ufmstar run``: its options and printed output."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, TypeVar

from ufmstar_torch.config import UfMStarConfig
from ufmstar_torch.eval.commands.depth import (
    OWN_DEPTH,
    SECTIONS,
    MapOptions,
    NetworkOptions,
    PosteriorOptions,
    UfMOptions,
)
from ufmstar_torch.eval.commands.opening import Recording
from ufmstar_torch.eval.commands.options import Flag, MachineOptions, Positional, Text, arg, as_dict, reader
from ufmstar_torch.eval.commands.terminal import Bars, stop_signals, usage_errors
from ufmstar_torch.eval.sequences.frame import FrameSequence, parse_slice

if TYPE_CHECKING:
    from ufmstar_torch.anchors.landmarks import LandmarkSource
    from ufmstar_torch.eval.engine.predictions import DepthSource
    from ufmstar_torch.eval.run.job import RunJob


@dataclass(frozen=True, kw_only=True)
class StreamOptions(MachineOptions):
    """Depth and UfM* on recordings.

    Attributes:
        frames: Take the frames START:STOP:STEP, counted from 0 as Python does.
        threads: Network and step use this many CPU threads (default: all cores but one).
    """

    frames: Text = None
    opening: Recording
    network: NetworkOptions
    maps: MapOptions
    uncertainty: UfMOptions

    def __post_init__(self) -> None:
        parse_slice(self.frames)
        if (model := self.network.model) is None and self.maps.depth is None:
            expected = "--model NAME --weights FILE for a network, or --depth DIR for maps that are already predicted"
            raise ValueError(f"the depth must come from one place: give {expected}")
        if model is not None and self.maps.depth is not None:
            raise ValueError(f"the depth must come from one place: --model {model} or --depth, not both")

    @property
    def config(self) -> UfMStarConfig:
        """The configuration of UfM*."""
        return self.uncertainty.config()

    def settings(self) -> dict[str, Any]:
        """Return the options that define the result, as plain values of a configuration file."""
        left_out = ("overwrite", "sequence", "sequences")
        plain = {name: value for name, value in as_dict(self).items() if name not in left_out}
        ufm = {name: value for name, value in self.config.to_dict().items() if value or name not in SECTIONS}
        return plain | {"set": ufm}


@dataclass(frozen=True, kw_only=True)
class RunOptions(StreamOptions):
    """Depth with a standard deviation for every pixel of a sequence of posed images.

    Depths that are searched in earlier images correct the predicted depth and its sigma; --plain is UfM* alone. The
    predicted depth comes from a network (--model, --weights), from maps that another program predicted (--depth DIR),
    or from the sequence itself (--depth self), which no anchors correct unless --anchors names them.

    Attributes:
        sequence: The folder of the sequence, or a video file, or tour:SEED for rendered rooms.
        out: Write everything to this folder; after an interruption, the same command computes the rest.
        overwrite: Replace another run in --out; the predictions in its cache are kept.
        no_video: Leave preview.mp4 out.
        no_sheet: Leave contact_sheet.png out.
    """

    USAGE: ClassVar[str] = "ufmstar run SEQUENCE (--model NAME --weights FILE... | --depth DIR) --out OUT [options]"

    sequence: Annotated[Positional[str], arg(metavar="SEQUENCE")]
    out: str
    overwrite: Flag = False
    no_video: Flag = False
    no_sheet: Flag = False
    uncertainty: PosteriorOptions


read = reader(RunOptions, "ufmstar run")
Stream = TypeVar("Stream", bound=StreamOptions)


def main(options: RunOptions) -> int:
    """Run, and print the results' table; the exit code."""
    from ufmstar_torch.eval.engine.predictions import CacheError
    from ufmstar_torch.eval.run.folder import FolderError
    from ufmstar_torch.eval.run.machine import share_threads
    from ufmstar_torch.eval.run.run import run

    if options.threads is None:
        share_threads()
    with usage_errors(ImportError, OSError, ValueError):
        job = replace(job_from(options, options.sequence), video=not options.no_video, sheet=not options.no_sheet)
    with usage_errors(CacheError, FolderError), Bars() as bars, stop_signals(bars.say) as stop:
        summary = run(job, options.out, overwrite=options.overwrite, progress=bars.show, stop=stop)
    return _report(summary, options.out)


def job_from(options: StreamOptions, path: str, networks: DepthSource | None = None) -> RunJob:
    """Open a sequence, load the networks (unless ``networks`` of an earlier job are passed) or maps, and make the job.

    Raises:
        ValueError: files do not fit, there are no poses, or no frame is selected; others as ``open_sequence``.
        FileNotFoundError, NotADirectoryError: no such file or folder.
        ModuleNotFoundError: an optional package is missing.
    """
    import torch

    from ufmstar_torch.anchors.sources import DENSE
    from ufmstar_torch.eval.run.job import RunJob
    from ufmstar_torch.eval.run.scale import network_scale, require_metric
    from ufmstar_torch.eval.sequences.open import open_sequence, scale_poses

    sequence = open_sequence(path, **options.opening.changed())
    options = _without_posterior(options, sequence)
    ufm, config = options.uncertainty, options.config
    if not sequence.posed:
        raise ValueError(f"{sequence.name!r} holds single images without poses, which UfM* needs to compare views")
    indices = range(len(sequence))[parse_slice(options.frames)]
    if not indices:
        raise ValueError(f"--frames {options.frames} selects none of the {len(sequence)} frames")
    if ufm.scale_from is None:
        require_metric(sequence)
    source = _source(options, sequence, indices, networks)
    sensor, scale = _sensor(options, sequence, source), None
    if ufm.scale_from is not None:
        scale = network_scale(sequence, source, indices, options.opening.of_reader.model_index)
        sequence = scale_poses(sequence, scale.metres)
    return RunJob(
        sequence=sequence,
        indices=indices,
        source=source,
        config=config.within(source.max_depth, source.states_confidence),
        recalibration=ufm.load_recalibration(config, source),
        device=torch.device(options.device),
        settings=options.settings(),
        every=options.network.mode == "full",
        landmarks=DENSE if config.anchors is None else _landmarks(ufm.anchors or DENSE, sequence),
        sensor=sensor,
        scale=scale,
    )


def _source(
    options: StreamOptions, sequence: FrameSequence, indices: range, networks: DepthSource | None
) -> DepthSource:
    """The networks of the options (``networks`` if they are loaded), or the maps of the sequence."""
    if options.network.model is not None:
        return options.network.load(options) if networks is None else networks
    return options.maps.source(sequence, indices)


def _sensor(options: StreamOptions, sequence: FrameSequence, source: DepthSource) -> str | None:
    """The kind of depth camera whose depth serves as anchors, or None. Raises ValueError: that depth is predicted."""
    from ufmstar_torch.eval.engine.anchors import sensor_of

    sensor = sensor_of(options.uncertainty.anchors, sequence) if options.config.anchors else None
    if sensor is not None and source.is_truth:
        raise ValueError("--anchors sensor goes with the depth of a network: with --depth self, nothing is to correct")
    return sensor


def _without_posterior(options: Stream, sequence: FrameSequence) -> Stream:
    """The options, plain where the default anchors serve nothing: the depth is the sequence's own, which a correction
    makes worse, or the sequence lacks the images in which they are searched."""
    from ufmstar_torch.frames.warnings import LOGGER

    ufm = options.uncertainty
    if not isinstance(ufm, PosteriorOptions) or ufm.plain or ufm.chosen:
        return options
    if options.maps.depth in OWN_DEPTH:
        LOGGER.warning(
            "UfM* alone: the recording's own depth is not corrected (--anchors dense corrects it all the same)"
        )
    elif _has_images(sequence):
        return options
    else:
        missed = "UfM* alone, without anchors and the depth that the posterior corrects with them"
        LOGGER.warning("%s: the sequence %r has no images", missed, sequence.name)
    return replace(options, uncertainty=replace(ufm, plain=True))


def _has_images(sequence: FrameSequence) -> bool:
    return any(entry.load_image is not None for entry in sequence.entries)


def _landmarks(value: str, sequence: FrameSequence) -> str | LandmarkSource:
    """The source of anchors of ``--anchors``. Raises ValueError: the images to search are missing; others as
    ``landmarks_of``."""
    from ufmstar_torch.anchors.sources import DENSE
    from ufmstar_torch.eval.engine.anchors import landmarks_of, sensor_of

    if sensor_of(value, sequence) is not None:
        return DENSE
    source = landmarks_of(value, sequence.folder, sequence.pose_scale)
    if not source.needs_image:
        return source
    if not _has_images(sequence):
        raise ValueError(f"--anchors {value} searches images, of which the sequence {sequence.name!r} has none")
    return value


def _report(summary: Mapping[str, Any], out: str) -> int:
    """Print the table and where the outputs are; the exit code."""
    from ufmstar_torch.eval.report.text import run_table
    from ufmstar_torch.eval.run.summary import FINISHED, INTERRUPTED

    if summary["frames"]["done"]:
        print(run_table(summary))
    made = [name for name, reason in summary["outputs"].items() if reason is None]
    for name, reason in summary["outputs"].items():
        if reason is not None:
            print(f"no {name}: {reason}")
    maps = ["depth/", "sigma/"]
    if "ufm" in summary:
        maps = ["depth/ and sigma/ (of the posterior)", "network_depth/", "ufm_sigma/"]
    print(f"{out}: {', '.join(['summary.json', 'frames.jsonl', 'frames/', *maps, *made])}")
    state = f"ufmstar run: {summary['state']}: {summary['reason']}"
    if summary["state"] == FINISHED:
        print(state)
        return 0
    print(state, file=sys.stderr)
    return 130 if summary["state"] == INTERRUPTED else 1

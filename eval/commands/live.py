"""``ufmstar live``: its options, sources and printed output; ``LiveDepth`` does the work."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, nullcontext, suppress
from dataclasses import dataclass
from time import monotonic
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

from ufmstar_torch.eval.commands.depth import NetworkOptions, PosteriorOptions
from ufmstar_torch.eval.commands.opening import Recording
from ufmstar_torch.eval.commands.options import (
    File,
    Flag,
    Folder,
    MachineOptions,
    Positional,
    arg,
    reader,
    require_least,
    require_positive,
)
from ufmstar_torch.eval.commands.terminal import Bars, interrupted_by_sigterm, usage_errors
from ufmstar_torch.eval.sequences.intrinsics import read_intrinsics

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from ufmstar_torch.eval.engine.realtime import RealTime
    from ufmstar_torch.eval.run.rerun_log import RerunLog
    from ufmstar_torch.eval.sequences.live import LiveEvent
    from ufmstar_torch.live import LiveDepth, LiveResult, LiveStatistics
    from ufmstar_torch.uncertain_depth import UncertainDepth

_STANDARD_INPUT, _SUMMARY = "-", "realtime.json"
_SILENCE = 10.0  # [s] without an image after the start, until a line says so
# Options for opening that are also valid for a source that is no recording.
_OF_LIVE = ("intrinsics", "trajectory", "poses", "pose_scale", "max_pose_gap")


@dataclass(frozen=True, kw_only=True)
class LiveOptions(MachineOptions):
    """Depth with a standard deviation for the newest image, as images and poses come.

    Depths that are searched in earlier images correct the network's; --plain is UfM* alone. A recording is replayed at
    its pace. A camera, and a folder with --follow, take their poses from the file --trajectory, to which another
    program adds lines. On standard input, a line is
    {"stamp": s, "pose": [x, y, z, qx, qy, qz, qw], "image": "file", "intrinsics": [fx, fy, cx, cy]} or a part of it;
    intrinsics hold for later lines too.
    Ends with its source, or with Ctrl-C.

    Attributes:
        source: A recording (folder, video, bag, tour:SEED), the number of a camera, or - for lines of JSON.
        follow: The source is a folder to which another program adds images, which are named by their time.
        speed: Replay a recording this many times as fast.
        seconds: Stop this many seconds after the first image.
        idle: With --follow, stop after this many seconds without a new image.
        max_wait: An image waits at most this long for a pose after it [s].
        state: Save the state to this file, from which the next command continues.
        save_every: Save the state at this interval [s].
        out: Write realtime.json to this folder and, for each image, a .npz of maps, pose and intrinsics, as `ufmstar
            run` does.
        overwrite: Replace the results in --out.
        view: Show the images, depth and plots in rerun, on this computer alone.
        json: Print a line of JSON per image instead of the status.
    """

    USAGE: ClassVar[str] = "ufmstar live SOURCE --model NAME --weights FILE... [options]"

    source: Annotated[Positional[str], arg(metavar="SOURCE")]
    follow: Flag = False
    speed: float = 1.0
    seconds: float = float("inf")
    idle: float = float("inf")
    max_wait: float = 0.2
    state: File = None
    save_every: float = 10.0
    out: Folder = None
    overwrite: Flag = False
    view: Flag = False
    json: Flag = False
    opening: Recording
    network: NetworkOptions
    uncertainty: PosteriorOptions

    def __post_init__(self) -> None:
        require_least(self, max_wait=0, save_every=0)
        require_positive(self, "speed", "seconds", "idle")
        if self.network.model is None:
            raise ValueError("live needs a network: --model NAME --weights FILE")
        if self.overwrite and self.out is None:
            raise ValueError("--overwrite goes with --out")
        if self.uncertainty.scale_from is not None:
            raise ValueError("--scale-from goes with ufmstar run, which sees the whole recording")
        if self.recorded:
            return
        if self.source == _STANDARD_INPUT and self.opening.trajectory is not None:
            raise ValueError("--trajectory does not go with -: each line has its pose")
        if wrong := sorted(self.opening.changed().keys() - set(_OF_LIVE)):
            name = wrong[0]
            option = f"--{name.replace('_', '-')}" if hasattr(self.opening, name) else f"--reader {name}"
            raise ValueError(f"{option} goes with recordings, not with {self.source}")
        if self.source != _STANDARD_INPUT and (self.opening.trajectory is None or not self.opening.intrinsics):
            raise ValueError(f"{self.source} needs --trajectory FILE (lines may be added) and --intrinsics fx fy cx cy")

    @property
    def recorded(self) -> bool:
        """True if the source is a recording."""
        return not (self.follow or self.source == _STANDARD_INPUT or self.source.isdecimal())


read = reader(LiveOptions, "ufmstar live")


def main(options: LiveOptions) -> int:
    """Run until the source ends, and print the real-time table; the exit code."""
    from ufmstar_torch.eval.engine.files import write_json_atomic
    from ufmstar_torch.eval.engine.realtime import RealTime
    from ufmstar_torch.eval.report.text import realtime_table
    from ufmstar_torch.eval.run.folder import FolderKind, output_folder
    from ufmstar_torch.eval.run.machine import share_threads
    from ufmstar_torch.eval.run.rerun_log import RerunLog, open_viewer
    from ufmstar_torch.eval.run.writers import is_frame
    from ufmstar_torch.live import LiveDepth, LiveResult

    if options.threads is None:
        share_threads()
    kind = FolderKind("ufmstar live", "live run", _SUMMARY, ("*.npz",), recognise={"*.npz": is_frame}, lock=".lock")
    started = {"state": "started"}  # a later run may replace finished results only
    with ExitStack() as stack:
        with usage_errors(ImportError, OSError, ValueError):
            if options.out is not None:
                kind.earlier(options.out, overwrite=options.overwrite)
            K = None if (intrinsics := options.opening.of_reader.intrinsics) is None else read_intrinsics(intrinsics)
            events = _events(options, K)
            model = _model(options)
            view = RerunLog(open_viewer()[0]) if options.view else None
            times, shown = RealTime(model), list[Callable[[LiveResult], None]]()
            how: dict[str, Any] = {"max_wait": options.max_wait, "max_gap": options.opening.of_reader.max_pose_gap}
            how |= {"state": options.state, "save_every": options.save_every}
            # Reads and locks the state, before --out is replaced.
            live = stack.enter_context(LiveDepth(model, lambda result: shown[0](result), K, **how))
            if options.out is not None:
                stack.enter_context(output_folder(options.out, kind, started, overwrite=options.overwrite))
        shown.append(_shown_by(options, live, times, view))
        statistics, failure = _run(options, live, events)
        summary = times.summary(statistics)
        print(realtime_table(summary), file=sys.stderr if options.json else sys.stdout)
        ending = {"state": "failed", "reason": str(failure)} if failure else {"state": "finished"}
        if options.out is not None:
            with suppress(OSError) if failure else nullcontext():  # the disk may be full
                write_json_atomic(options.out / _SUMMARY, {"program": kind.program, **ending, **summary})
    if failure is not None:
        raise failure
    return 0 if summary["results"] else 1


def _shown_by(
    options: LiveOptions, live: LiveDepth, times: RealTime, view: RerunLog | None
) -> Callable[[LiveResult], None]:
    """A function that writes and shows the result of an image."""
    from ufmstar_torch.eval.engine.realtime import figures_of
    from ufmstar_torch.eval.run.rerun_log import viewer_frame
    from ufmstar_torch.eval.run.writers import output_arrays, write_frame

    def on_result(result: LiveResult) -> None:
        times.take(result)
        if options.out is not None:
            write_frame(options.out / f"{result.stamp:.6f}.npz", output_arrays(result.out, result.T_world_cam))
        figures = figures_of(result, live.statistics)
        if view is not None:
            view.add(viewer_frame(result, len(times.latency), figures))
        if options.json:
            print(json.dumps(figures), flush=True)
        elif len(times.latency) % 30 == 1:
            print("  ".join(f"{name} {value}" for name, value in figures.items()), file=sys.stderr, flush=True)

    return on_result


def _run(
    options: LiveOptions, live: LiveDepth, events: Iterator[LiveEvent | None]
) -> tuple[LiveStatistics, Exception | None]:
    """Push the events until they end, the time is over, or a signal comes. Returns the counts, and the error if any."""
    deadline, told, warm = math.inf, monotonic() + _SILENCE, False
    try:
        with interrupted_by_sigterm(), live, suppress(KeyboardInterrupt):
            for event in events:
                if monotonic() >= deadline:
                    break
                if not warm and monotonic() >= told:
                    told = math.inf
                    print(f"ufmstar live: no image yet from {options.source}", file=sys.stderr, flush=True)
                if event is None:
                    continue
                if event.T_world_cam is not None:
                    live.push_pose(event.stamp, event.T_world_cam)
                if event.image is not None:
                    if not warm:  # the first inference takes seconds; a recording's clock starts after it
                        height, width = event.image.shape[:2]
                        live.model.warm_up((height, width))
                        deadline, warm = monotonic() + options.seconds, True
                    live.push_image(event.stamp, event.image, event.intrinsics)
            live.wait_idle()
    except (OSError, RuntimeError, TypeError, ValueError) as error:
        return live.statistics, error
    return live.statistics, None


def _events(options: LiveOptions, K: NDArray[np.float64] | None) -> Iterator[LiveEvent | None]:
    """The source's images and poses; errors as ``open_sequence``. ``K``: intrinsics of the option."""
    from ufmstar_torch.eval.check.image_fit import image_fit, track_corners
    from ufmstar_torch.eval.sequences import live as sources
    from ufmstar_torch.eval.sequences.open import open_sequence
    from ufmstar_torch.frames.warnings import LOGGER

    opening = options.opening
    if options.recorded:
        sequence = open_sequence(options.source, **opening.changed())
        if not sequence.posed:
            raise ValueError(f"{options.source} has no poses; ufmstar poses computes them")
        if (fit := image_fit(sequence, track_corners(sequence))) is not None and fit.problem:
            LOGGER.warning("%s: %s", options.source, fit.problem)
        return sources.replay(sequence, options.speed)
    scale = 1.0 if opening.pose_scale is None else opening.pose_scale
    if options.source == _STANDARD_INPUT:
        return sources.json_lines(sources.lines_of(sys.stdin), ".", opening.poses, scale, K)
    poses = sources.PoseFile(str(opening.trajectory), opening.poses, scale)
    if options.follow:
        return sources.growing_folder(options.source, poses, options.idle)
    return sources.camera(int(options.source), poses)


def _model(options: LiveOptions) -> UncertainDepth:
    """The networks with UfM*, warmed up; errors as ``NetworkChoice.load``."""
    from ufmstar_torch.anchors.sources import DENSE
    from ufmstar_torch.eval.engine.anchors import landmarks_of
    from ufmstar_torch.eval.engine.progress import warm_up_command
    from ufmstar_torch.uncertain_depth import UncertainDepth

    chosen, source = options.network, options.network.load(options)
    config, anchors = options.uncertainty.config(), options.uncertainty.anchors
    model = UncertainDepth(
        source.networks,
        config,
        mode="full" if chosen.mode == "full" else "alternate",
        posterior=options.uncertainty.posterior,
        samples=source.passes if len(source.networks) == 1 and chosen.mode == "full" else None,
        anchors=None if anchors is None else landmarks_of(anchors, None),
        recalibration=options.uncertainty.load_recalibration(config, source),
        check_poses=0 if options.recorded else 40,  # those of a recording are compared before
        multiview_device="cpu",  # for one camera faster than a GPU
    ).to(options.device)
    with Bars() as bars:
        warm_up_command(model.ufm.config, bars.show, [] if config.anchors is None else [anchors or DENSE])
    return model

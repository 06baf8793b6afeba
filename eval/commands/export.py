"""``ufmstar export``: its options, and what is printed."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, ClassVar

from ufmstar_torch.eval.commands.opening import SequenceOptions
from ufmstar_torch.eval.commands.options import option, positional, reader, usage_errors
from ufmstar_torch.eval.run import export
from ufmstar_torch.eval.run.export_bag import export_bag
from ufmstar_torch.eval.run.rerun_log import export_rerun
from ufmstar_torch.eval.sequences.frame import FrameSequence
from ufmstar_torch.eval.sequences.open import open_sequence


@dataclass(frozen=True, kw_only=True)
class ExportOptions:
    """A run's result for other programs, in OUT/export.

    Depth and sigma are the posterior's, where the run has one. Pixels beyond a limit are left out.

    Attributes:
        out: folder of `ufmstar run`
        to: depth: depth and sigma as 16-bit PNGs, 0 = left out; cloud: cloud.ply with sigma and colour; tum:
            trajectory.txt; transforms: images, depth, sigma and poses for nerfstudio; mcap: a ROS 2 bag; rrd: a rerun
            recording
        max_sigma: largest standard deviation of a pixel [m]
        max_relative_sigma: largest standard deviation of a pixel, as a share of its depth
        voxel: side of the cloud's voxels [m], each of which has one point
        debug: show tracebacks
    """

    USAGE: ClassVar[str] = "ufmstar export OUT --to depth|cloud|tum|transforms|mcap|rrd [options]"

    out: Path = positional()
    to: str = option(choices=("depth", "cloud", "tum", "transforms", "mcap", "rrd"))
    max_sigma: float = option(float("inf"), positive=True)
    max_relative_sigma: float = option(float("inf"), positive=True)
    voxel: float = option(0.02, positive=True)
    debug: bool = False


read = reader(ExportOptions, "ufmstar export")


def main(options: ExportOptions) -> int:
    """Export, and print what was written; the exit code."""
    out = options.out
    with usage_errors(FileNotFoundError, ValueError):
        frames = export.gated_frames(out, options.max_sigma, options.max_relative_sigma)
        if options.to == "depth":
            print(export.export_depth(frames, out))
        elif options.to == "tum":
            print(export.export_trajectory(frames, out))
        elif options.to == "transforms":
            print(export.export_transforms(frames, out, _sequence(out)))
        else:
            print(_with_images(options, frames))
    return 0


def _with_images(options: ExportOptions, frames: Iterator[export.Gated]) -> str:
    """Export to a format that has the recording's images where they can be read; what was written."""
    try:
        sequence: FrameSequence | None = _sequence(options.out)
    except (OSError, ValueError) as error:
        print(f"no colours: {error}")
        sequence = None
    if options.to == "cloud":
        return export.export_cloud(frames, options.out, options.voxel, sequence)
    return (export_bag if options.to == "mcap" else export_rerun)(frames, options.out, sequence)


def _sequence(out: Path) -> FrameSequence:
    """The recording of a run. Raises FileNotFoundError, ValueError: it is there no more, or the summary is damaged."""
    settings = export.run_settings(out)
    names = [f.name for f in fields(SequenceOptions) if f.name in settings]
    values: dict[str, Any] = {name: tuple(v) if isinstance(v := settings[name], list) else v for name in names}
    return open_sequence(settings["sequence"], **SequenceOptions(**values).given())

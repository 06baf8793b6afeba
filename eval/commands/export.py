"""``ufmstar export``: its options and printed output."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from ufmstar_torch.eval.commands.options import option, positional, reader, usage_errors
from ufmstar_torch.eval.run import export
from ufmstar_torch.eval.run.export_bag import export_bag
from ufmstar_torch.eval.run.rerun_log import export_rerun
from ufmstar_torch.eval.sequences.open import open_sequence
from ufmstar_torch.eval.sequences.options import Options

_EXPORTERS: dict[str, Callable[..., str]] = {
    "depth": export.export_depth, "cloud": export.export_cloud, "tum": export.export_trajectory,
    "transforms": export.export_transforms, "mcap": export_bag, "rrd": export_rerun,
}  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class ExportOptions:
    """A run's result for other programs, in OUT/export.

    Depth and sigma are the posterior's, where the run has one. Pixels beyond a limit are left out. The images come from
    the recording that --sequence names, opened with the same options as for `ufmstar run`.

    Attributes:
        out: folder of `ufmstar run`
        sequence: the run's recording, for the colours of cloud, mcap and rrd, and the images of transforms
        to: depth: depth and sigma as 16-bit PNGs, 0 = left out; cloud: cloud.ply with sigma and colour; tum:
            trajectory.txt; transforms: images, depth, sigma and poses for nerfstudio; mcap: a ROS 2 bag; rrd: a rerun
            recording
        max_sigma: largest standard deviation of a pixel [m]
        max_relative_sigma: largest standard deviation of a pixel, as a share of its depth
        voxel: side of the cloud's voxels [m], each of which has one point
    """

    USAGE: ClassVar[str] = "ufmstar export OUT --to depth|cloud|tum|transforms|mcap|rrd [--sequence SEQUENCE] [options]"

    out: Path = positional()
    sequence: str | None = None
    to: str = option(choices=tuple(_EXPORTERS))
    max_sigma: float = option(float("inf"), positive=True)
    max_relative_sigma: float = option(float("inf"), positive=True)
    voxel: float = option(0.02, positive=True)
    opening: Options

    def __post_init__(self) -> None:
        if self.sequence is None and self.to == "transforms":
            raise ValueError("--to transforms needs the images: --sequence SEQUENCE, the recording of the run")
        if self.sequence is None and (names := self.opening.changed()):
            raise ValueError(f"--{next(iter(names)).replace('_', '-')} goes with --sequence")


read = reader(ExportOptions, "ufmstar export")


def main(options: ExportOptions) -> int:
    """Export, and print what was written; the exit code."""
    out, to = options.out, options.to
    with usage_errors(FileNotFoundError, ValueError):
        frames = export.gated_frames(out, options.max_sigma, options.max_relative_sigma)
        if to not in ("depth", "tum") and options.sequence is not None:
            frames = export.with_images(frames, open_sequence(options.sequence, **options.opening.changed()))
        elif to not in ("depth", "tum"):
            print("no colours: --sequence SEQUENCE names the recording with the images")
        how = {"voxel": options.voxel} if to == "cloud" else {}
        print(_EXPORTERS[to](frames, out, **how))
    return 0

"""``ufmstar export``: its options and printed output."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

from ufmstar_torch.eval.commands.opening import Recording
from ufmstar_torch.eval.commands.options import Positional, Text, arg, reader, require_positive
from ufmstar_torch.eval.commands.terminal import usage_errors


@dataclass(frozen=True, kw_only=True)
class ExportOptions:
    """A run's result for other programs, in OUT/export.

    Depth and sigma are the posterior's, where the run has one. Pixels beyond a limit are left out; the share of the
    others is printed, with a warning if no held-out anchors and no recalibration support sigma. The images come from
    the recording that --sequence names, opened with the same options as for `ufmstar run`.

    Attributes:
        out: The folder of `ufmstar run`.
        to: Write depth and sigma as 16-bit PNGs (depth; 0 = left out), cloud.ply with sigma and colour (cloud),
            trajectory.txt (tum), images, depth, sigma and poses for nerfstudio (transforms), a ROS 2 bag (mcap), or a
            rerun recording (rrd).
        sequence: Take colours and images from this recording, that of the run.
        max_sigma: Leave pixels with a larger standard deviation out [m].
        max_relative_sigma: Leave pixels with a larger standard deviation out, as a share of the depth.
        voxel: The cloud has one point in each voxel of this side [m].
    """

    USAGE: ClassVar[str] = "ufmstar export OUT --to depth|cloud|tum|transforms|mcap|rrd [--sequence SEQUENCE] [options]"

    out: Annotated[Positional[Path], arg(metavar="OUT")]
    to: Literal["depth", "cloud", "tum", "transforms", "mcap", "rrd"]
    sequence: Text = None
    max_sigma: float = float("inf")
    max_relative_sigma: float = float("inf")
    voxel: float = 0.02
    opening: Recording

    def __post_init__(self) -> None:
        require_positive(self, "max_sigma", "max_relative_sigma", "voxel")
        if self.sequence is None and self.to == "transforms":
            raise ValueError("--to transforms needs the images: --sequence SEQUENCE, the recording of the run")
        if self.sequence is None and (names := self.opening.changed()):
            raise ValueError(f"--{next(iter(names)).replace('_', '-')} goes with --sequence")


read = reader(ExportOptions, "ufmstar export")


def main(options: ExportOptions) -> int:
    """Export, and print what was written; the exit code."""
    from ufmstar_torch.eval.run.export import gated_frames, with_images
    from ufmstar_torch.eval.run.summary import read_summary
    from ufmstar_torch.eval.sequences.open import open_sequence

    out, to = options.out, options.to
    with usage_errors(FileNotFoundError, ValueError):
        pixels = Counter[str]()
        frames = gated_frames(out, options.max_sigma, options.max_relative_sigma, pixels)
        summary = read_summary(out)
        if to not in ("depth", "tum") and options.sequence is not None:
            frames = with_images(frames, open_sequence(options.sequence, **options.opening.changed()))
        elif to not in ("depth", "tum"):
            was = summary["sequence"]["name"]  # shown, never opened
            print(f"no colours: --sequence SEQUENCE names the recording with the images, in the run {was!r:.200}")
        how = {"voxel": options.voxel} if to == "cloud" else {}
        print(_exporter(to)(frames, out, **how))
        if min(options.max_sigma, options.max_relative_sigma) < math.inf and to != "tum":
            share = pixels["kept"] / pixels["all"] if pixels["all"] else math.nan
            print(f"the limits of sigma keep {share:.1%} of the pixels with a depth")
            if reason := _unsupported(summary):
                remedy = "`ufmstar run` without --plain makes a sigma that anchors test (docs/thresholds.md)"
                print(f"warning: nothing supports this sigma, {reason}: the pixels that are left may be bad; {remedy}")
    return 0


def _exporter(to: str) -> Callable[..., str]:
    """The function that writes frames in the form ``to`` into a folder, and returns a line about it."""
    from ufmstar_torch.eval.run.export import export_cloud, export_depth, export_trajectory, export_transforms
    from ufmstar_torch.eval.run.export_bag import export_bag
    from ufmstar_torch.eval.run.rerun_log import export_rerun

    exporters: dict[str, Callable[..., str]] = {
        "depth": export_depth, "cloud": export_cloud, "tum": export_trajectory,
        "transforms": export_transforms, "mcap": export_bag, "rrd": export_rerun,
    }  # fmt: skip
    return exporters[to]


def _unsupported(summary: Mapping[str, Any]) -> str:
    """Why nothing supports the sigma of a run; "" if held-out anchors or a recalibration do."""
    from ufmstar_torch.eval.report.text import supported

    if supported(summary) if "posterior" in summary else summary.get("recalibrated"):
        return ""
    calibration = (summary.get("posterior") or {}).get("calibration")
    if calibration is not None:
        return f"since held-out anchors have a mean z^2 of {calibration:.2g} instead of 1"
    return "since the run has neither a posterior with held-out anchors nor a recalibration"

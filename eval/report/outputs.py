"""The demo's files: the sheet of its panels, calibration curves and the mixture."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from ufmstar_torch.eval.engine.stream import FrameResult
from ufmstar_torch.eval.methods.method import UFM_STAR
from ufmstar_torch.eval.metrics import SequenceMetrics
from ufmstar_torch.eval.report.figures_curves import write_curves
from ufmstar_torch.eval.run.colours import known_where
from ufmstar_torch.eval.run.files import write_json_atomic
from ufmstar_torch.eval.run.panels import FramePanel, contact_sheet
from ufmstar_torch.eval.run.pictures import ELLIPSOIDS, NPZ, PLY, SHEET, absolute_error, mixture_writers
from ufmstar_torch.ufmstar import UfMStar

# Rows of the demo beside UfM and UfM*: the member in turn alone, its posterior, and all members on every image.
NETWORK, POSTERIOR, ENSEMBLE = "network", "posterior", "ensemble"
CURVES = "calibration.png"
DEMO_FILES = (SHEET, CURVES, PLY, ELLIPSOIDS, NPZ, "curves.json")


def panel(name: str, note: str, result: FrameResult) -> FramePanel:
    """One row of the demo's sheet: depth, sigma and true error, of UfM* and of the posterior, for a frame (with an
    image and ground truth) through the demo's rows; ``note`` is the kind of room.
    """
    star: Any = result.rows[UFM_STAR]
    valid, maps = star.estimate.valid.numpy(), {}
    for prefix, row in (("", star), ("posterior_", result.rows[POSTERIOR])):
        estimate: Any = row.estimate
        depth = estimate.depth.float().numpy()
        maps[prefix.rstrip("_") or "depth"] = depth
        maps[f"{prefix}sigma"] = estimate.variance.float().sqrt().numpy()
        maps[f"{prefix}error"] = absolute_error(depth, star.truth)
    frame: Any = result.frame
    return FramePanel(name, frame.image, {key: known_where(valid, values) for key, values in maps.items()}, note)


def write_pictures(
    out: Path, panels: Sequence[FramePanel], metrics: Mapping[str, SequenceMetrics], ufm_star: UfMStar, title: str
) -> dict[str, str | None]:
    """Write all of :data:`DEMO_FILES` into an existing folder: the sheet of the panels, the curves of the metrics by
    name, and the mixture. By file: None if it was written, else why not (an optional package is missing).
    """
    curves = {name: values.curves() for name, values in metrics.items()}
    todo: dict[str, Callable[[Path], object]] = {
        SHEET: lambda path: contact_sheet(panels, path, title=title),
        CURVES: lambda path: write_curves(path, curves, title=title),
        **mixture_writers(ufm_star),
        "curves.json": lambda path: write_json_atomic(path, curves),
    }
    made: dict[str, str | None] = {}
    for name, write in todo.items():
        try:
            write(out / name)
            made[name] = None
        except ImportError as error:  # the demo's figures need no pictures
            made[name] = str(error)
    return made

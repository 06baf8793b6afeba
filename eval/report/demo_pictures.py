"""What the demo leaves to look at: contact sheet, calibration curves, and the mixture for viewers."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ufmstar_torch.eval.engine.stream import FrameResult
from ufmstar_torch.eval.gaussians import write_ellipsoids_ply, write_mixture_npz, write_mixture_ply
from ufmstar_torch.eval.methods.method import UFM_STAR
from ufmstar_torch.eval.metrics import SequenceMetrics
from ufmstar_torch.eval.report.calibration_plot import draw_calibration
from ufmstar_torch.eval.report.colours import DEPTH_MAP, ERROR_MAP, ColourScale, robust_range
from ufmstar_torch.eval.report.plots import Column, FramePanel, PanelScales, contact_sheet
from ufmstar_torch.eval.results.files import write_json_atomic
from ufmstar_torch.ufmstar import UfMStar

# Rows of the demo beside UfM and UfM*: the member in turn alone, and all members on every image.
NETWORK, ENSEMBLE = "network", "ensemble"
SHEET, CURVES, PLY, ELLIPSOIDS = "contact_sheet.png", "calibration.png", "mixture.ply", "ellipsoids.ply"
FILES = (SHEET, CURVES, PLY, ELLIPSOIDS, "mixture.npz", "curves.json")


@dataclass(frozen=True)
class DemoPanel(FramePanel):
    """A frame with the standard deviation of the network alone beside that of UfM*.

    Attributes:
        own_sigma: [h, w] of the network alone [m].
    """

    own_sigma: NDArray[np.float32] | None = None


def panel(name: str, note: str, result: FrameResult) -> DemoPanel:
    """One row of the sheet: the alternated network's depth, its own sigma, that of UfM*, and the true error.

    Args:
        name: of the frame.
        note: what kind of room it is in.
        result: the frame through all rows, with an image and ground truth.
    """
    row, own = result.rows[UFM_STAR], result.rows[NETWORK].estimate
    star, truth = row.estimate, row.truth
    assert result.frame is not None
    assert result.frame.image is not None
    assert truth is not None
    assert star.variance is not None
    assert own.variance is not None
    depth = star.depth.float().numpy()
    return DemoPanel(
        name=name,
        note=note,
        image=result.frame.image,
        depth=depth,
        sigma=star.variance.float().sqrt().numpy(),
        own_sigma=own.variance.float().sqrt().numpy(),
        error=np.where(truth > 0, np.abs(depth - truth), np.nan).astype(np.float32),
        valid=star.valid.numpy(),
    )


def write_pictures(
    out: Path,
    panels: Sequence[DemoPanel],
    metrics: Mapping[str, SequenceMetrics],
    ufm_star: UfMStar,
    title: str,
) -> dict[str, str | None]:
    """Write all of :data:`FILES`.

    Args:
        out: an existing folder.
        panels: rows of the contact sheet.
        metrics: by the name that the legend shows.
        ufm_star: at the end of the tour.
        title: of the pictures.

    Returns:
        By file: None if it is there, else why not (an optional package is missing).

    Raises:
        OSError: a full disk, say.
    """
    curves = {name: values.curves() for name, values in metrics.items()}
    mixture, first = ufm_star.mixture, ufm_star.T_world_first
    todo: dict[str, Callable[[Path], object]] = {
        SHEET: lambda file: draw_sheet(file, panels, title),
        CURVES: lambda file: draw_calibration(file, curves, title=title),
        PLY: lambda file: write_mixture_ply(file, mixture, T_world_first=first),
        ELLIPSOIDS: lambda file: write_ellipsoids_ply(file, mixture, T_world_first=first),
        "mixture.npz": lambda file: write_mixture_npz(file, mixture, T_world_first=first),
        "curves.json": lambda file: write_json_atomic(file, curves),
    }
    made: dict[str, str | None] = {}
    for name, write in todo.items():
        try:
            write(out / name)
            made[name] = None
        except ImportError as error:  # what the demo is for, the figures, needs no pictures
            made[name] = str(error)
    return made


def draw_sheet(file: Path, panels: Sequence[DemoPanel], title: str) -> None:
    """Image, depth, both sigmas and the true error; the last three share one scale, so that they can be compared.

    Raises:
        ImportError: matplotlib is missing.
    """
    depth = ColourScale(*robust_range([(p.depth, p.valid) for p in panels], from_zero=False), DEPTH_MAP)
    lengths = [(value, p.valid) for p in panels for value in (p.sigma, p.own_sigma, p.error) if value is not None]
    metres = ColourScale(*robust_range(lengths, from_zero=True), ERROR_MAP)
    columns = [
        Column("depth", depth, "depth"),
        Column("σ, network alone", metres, "own_sigma"),
        Column("σ, UfM*", metres, "sigma"),
        Column("|true error|", metres, "error"),
    ]
    contact_sheet(panels, file, title=title, scales=PanelScales(depth, metres, metres), columns=columns)

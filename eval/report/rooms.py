"""The paper's figure of a room as Gaussians: an oblique view at several times, coloured by disagreement."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ufmstar_torch.eval.report.examples import load_arrays
from ufmstar_torch.eval.run.colours import ERROR_MAP, INK, ColourScale, plain, robust_range, save_png
from ufmstar_torch.eval.run.panels import Bar, axes_at, draw_bar, new_sheet

Array = NDArray[np.float64]
# A uniform patch from -a to a has sigma = a / sqrt(3): with this factor, an ellipse is as large as its patch.
SIGMAS = float(np.sqrt(3.0))
# Gaussians higher than this above the highest camera are omitted, because a ceiling hides the room from above [m].
HEADROOM = 0.3
ELEVATION = 35.0  # degrees
_PATH = "#00a6d6"
_STORED = ("mean_world", "covariance_world", "disagreement", "views", "T_world_cam", "path")
_CELL, _LEFT, _TOP, _BOTTOM = 3.1, 0.1, 0.62, 0.66  # inches


@dataclass(frozen=True, eq=False)
class Snapshot:
    """The mixture after a frame, in world coordinates, and the camera of that frame."""

    frame: str
    mean: Array  # [K, 3] [m]
    covariance: Array  # [K, 3, 3] [m^2]
    disagreement: Array  # [K] m [m^2]
    views: Array  # [K], 0 = seen from one view only
    T_world_cam: Array  # [4, 4]
    path: Array  # [n, 3] positions of the camera up to the frame [m]

    @property
    def root(self) -> Array:
        """[K] sqrt(m) [m], NaN for Gaussians seen from one view only."""
        root: Array = np.where(self.views > 0, np.sqrt(np.maximum(self.disagreement, 0)), np.nan)
        return root

    def take(self, chosen: NDArray[Any]) -> Snapshot:
        """The snapshot with the Gaussians chosen by an index or a mask."""
        arrays = {name: getattr(self, name)[chosen] for name in ("mean", "covariance", "disagreement", "views")}
        return replace(self, **arrays)


def find_rooms(folder: Path) -> dict[str, list[Snapshot]]:
    """The snapshots of one sequence, ``OUT/records/DATASET/SEQUENCE``, by row, in the order of their frames. Raises
    ValueError: a file cannot be read or is no snapshot; the message names it.
    """
    rooms: dict[str, list[Snapshot]] = {}
    for file in sorted((folder / "room").glob("*.npz")):
        row, _, frame = file.stem.partition("_")
        if row and frame:
            stored = load_arrays(file, _STORED)
            rooms.setdefault(row, []).append(Snapshot(frame, *(stored[name].astype(np.float64) for name in _STORED)))
    return {row: sorted(snapshots, key=lambda snapshot: len(snapshot.path)) for row, snapshots in rooms.items()}


def draw_room(path: Path, snapshots: Sequence[Snapshot], title: str) -> ColourScale:
    """Draw the snapshots in columns, with the camera's path, on one scale of sqrt(m) [m], and write the picture (PNG).
    Returns the scale. Raises ValueError: no snapshot has a Gaussian.
    """
    if not any(len(snapshot.mean) for snapshot in snapshots):
        raise ValueError("snapshots must hold at least one Gaussian")
    scale = ColourScale(*robust_range([snapshot.root for snapshot in snapshots], from_zero=True), ERROR_MAP)
    view, vertical = oblique_view(np.stack([snapshot.T_world_cam for snapshot in snapshots]))
    ceiling = max(float((snapshot.path @ vertical).max()) for snapshot in snapshots) + HEADROOM
    shown = [snapshot.take(snapshot.mean @ vertical <= ceiling) for snapshot in snapshots]
    low, high = _limits(view, shown)
    height = _CELL * (high[1] - low[1]) / (high[0] - low[0])
    width = 2 * _LEFT + len(snapshots) * _CELL
    figure = new_sheet(width, _TOP + height + _BOTTOM, title)
    for column, (before, snapshot) in enumerate(zip(snapshots, shown, strict=True)):
        axes = axes_at(figure, _LEFT + column * _CELL, _BOTTOM, _CELL, height)
        axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal", xticks=[], yticks=[])
        _draw_view(axes, view, snapshot, scale)
        label = f"after frame {snapshot.frame}: {len(before.mean)} Gaussians"
        axes.set_title(plain(label), size=8.5, color=INK, pad=4)
    bar = axes_at(figure, 3 * _LEFT, 0.42, min(4.0, width - 6 * _LEFT), 0.1)
    draw_bar(bar, Bar("√m, disagreement between the views [m]", scale, 0))
    save_png(figure, path)
    return scale


def _draw_view(axes: Any, view: Array, snapshot: Snapshot, scale: ColourScale) -> None:
    from matplotlib.collections import EllipseCollection

    painted = snapshot.take(np.argsort(snapshot.mean @ view[2], kind="stable"))  # from far to near
    semi_axes, angle = project(view, painted.covariance)
    wide, narrow = 2 * semi_axes.T
    drawn = EllipseCollection(
        wide,
        np.maximum(narrow, 0.01),  # a plane seen edge-on would vanish
        angle,
        units="xy",
        offsets=painted.mean @ view[:2].T,
        offset_transform=axes.transData,
        facecolors=np.concatenate([scale.rgb(painted.root) / 255, np.full((len(angle), 1), 0.85)], axis=1),
        edgecolors=(1, 1, 1, 0.55),
        linewidths=0.4,
    )
    axes.add_collection(drawn, autolim=False)
    axes.plot(*view[:2] @ snapshot.path.T, color=_PATH, linewidth=1.3)
    axes.plot(*view[:2] @ snapshot.T_world_cam[:3, 3], "o", markersize=5, color=_PATH, markeredgecolor="white")


def _limits(view: Array, snapshots: Sequence[Snapshot]) -> tuple[Array, Array]:
    """[2] lower and upper corner of the picture, equal for all snapshots [m].

    Percentiles exclude Gaussians of wrong depth, which can be far outside; the camera's whole path is included.
    """
    plane = np.concatenate([snapshot.mean for snapshot in snapshots]) @ view[:2].T
    reach = np.concatenate([project(view, snapshot.covariance)[0][:, :1] for snapshot in snapshots])
    walked = np.concatenate([snapshot.path for snapshot in snapshots]) @ view[:2].T
    low, high = np.percentile(plane - reach, 1, axis=0), np.percentile(plane + reach, 99, axis=0)
    low, high = np.minimum(low, walked.min(0)) - 0.2, np.maximum(high, walked.max(0)) + 0.2
    # Limit the aspect ratio.
    size, middle = high - low, (low + high) / 2
    size = np.maximum(size, [size[1] / 1.4, size[0] / 2.5])
    return middle - size / 2, middle + size / 2


# ---- orthographic projection of Gaussians to ellipses ----


def project(view: Array, covariance: Array) -> tuple[Array, Array]:
    """The ellipses of Gaussians of covariance [K, 3, 3] [m^2] in the picture of a view [3, 3] (:func:`oblique_view`).

    Returns [K, 2] semi-axes of ``SIGMAS`` standard deviations, the longer first [m], and [K] the angle of the longer
    one, from right towards up [degrees].
    """
    variances, axes = np.linalg.eigh(view[:2] @ covariance @ view[:2].T)
    # Rounding can leave the smaller eigenvalue of a line just below 0.
    semi_axes = SIGMAS * np.sqrt(np.maximum(variances[:, ::-1], 0))
    return semi_axes, np.degrees(np.arctan2(axes[:, 1, 1], axes[:, 0, 1]))


def oblique_view(T_world_cam: Array) -> tuple[Array, Array]:
    """A view from behind the first of cameras [n, 4, 4], ``ELEVATION`` over the horizon.

    The mean of the cameras' up vectors (-y) is the world's, because data sets have different vertical axes.

    Returns [3, 3] the unit vectors of the world that point right and up in the picture and towards the viewer, and [3]
    the world's up vector.
    """
    up = _unit(-T_world_cam[:, :3, 1].mean(0), np.array([0.0, 0.0, 1.0]))
    first = T_world_cam[0, :3, 2]
    # A camera that looks straight down has no horizontal direction: use any.
    fallback = np.eye(3)[np.argmin(np.abs(up))]
    forward = _unit(first - up * (first @ up), _unit(fallback - up * (fallback @ up), fallback))
    tilt = np.radians(ELEVATION)
    right, above = np.cross(forward, up), np.cos(tilt) * up + np.sin(tilt) * forward
    return np.stack([right, above, np.cross(right, above)]), up


def _unit(vector: Array, otherwise: Array) -> Array:
    """The normalised vector, or ``otherwise`` if its length is 0."""
    length = float(np.linalg.norm(vector))
    return vector / length if length > 1e-6 else otherwise

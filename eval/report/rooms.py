"""The Gaussians of a room at several times, from above and obliquely, coloured by the disagreement of the views."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ufmstar_torch.eval.report.colours import (
    ERROR_MAP,
    FAINT,
    INK,
    ColourScale,
    plain,
    require_matplotlib,
    robust_range,
    save_png,
)
from ufmstar_torch.eval.report.examples import load_arrays
from ufmstar_torch.eval.report.panels import Bar, draw_bar

Array = NDArray[np.float64]
# A patch that is evenly covered from -a to a has sigma = a / sqrt(3): so drawn, an ellipse is as large as its patch.
SIGMAS = float(np.sqrt(3.0))
# A ceiling hides the room from above; the highest camera is held well below it [m].
HEADROOM = 0.3
MOST_TIMES = 4
_PATH = "#00a6d6"
_CELL, _LEFT, _TOP, _BOTTOM = 3.1, 0.3, 0.62, 0.66  # inches


@dataclass(frozen=True, eq=False)
class Snapshot:
    """A mixture after some frame, in world coordinates.

    Attributes:
        frame: its name.
        mean: [K, 3] [m].
        covariance: [K, 3, 3] [m^2].
        disagreement: [K] m [m^2].
        T_world_cam: [4, 4] the camera then.
        path: [n, 3] where the camera has been until then [m]; n may be 1.
    """

    frame: str
    mean: Array
    covariance: Array
    disagreement: Array
    T_world_cam: Array
    path: Array


def find_rooms(folder: Path) -> dict[str, list[Snapshot]]:
    """The snapshots of one sequence, ``OUT/records/DATASET/SEQUENCE``, by row, in the order of their frames.

    Raises:
        ValueError: a file cannot be read or holds something else; the message names it.
    """
    rooms: dict[str, list[Snapshot]] = {}
    for file in sorted((folder / "room").glob("*.npz"), key=lambda f: _natural(f.stem)):
        row, _, frame = file.stem.partition("_")
        if row and frame:
            rooms.setdefault(row, []).append(_load(file, frame))
    return rooms


def choose_times(snapshots: Sequence[Snapshot], most: int = MOST_TIMES) -> list[Snapshot]:
    """Spread over the sequence, the last one included."""
    if len(snapshots) <= most:
        return list(snapshots)
    chosen = np.linspace(0, len(snapshots) - 1, most).round().astype(int)
    return [snapshots[i] for i in chosen]


def draw_room(path: Path, snapshots: Sequence[Snapshot], title: str) -> ColourScale:
    """Draw each time in a column, from above and obliquely, with the camera's path; one scale for all of them.

    Args:
        path: the picture (PNG).
        snapshots: at least one; times of the same room.
        title: over the picture.

    Returns:
        The scale of sqrt(m) [m].

    Raises:
        ValueError: there is no snapshot, or none with a Gaussian.
        ImportError: matplotlib is missing.
    """
    if not any(len(snapshot.mean) for snapshot in snapshots):
        raise ValueError("snapshots must hold at least one Gaussian")
    require_matplotlib()
    from matplotlib.figure import Figure

    roots = [np.sqrt(np.maximum(snapshot.disagreement, 0)) for snapshot in snapshots]
    scale = ColourScale(*robust_range([(root, None) for root in roots], from_zero=True), ERROR_MAP)
    views = views_of(np.stack([snapshot.T_world_cam for snapshot in snapshots]))
    shown = [below_ceiling(snapshot, views[0].towards, snapshots) for snapshot in snapshots]
    limits = [_limits(view, shown) for view in views]
    tall = [_CELL * (high[1] - low[1]) / (high[0] - low[0]) for low, high in limits]
    width = _LEFT + len(snapshots) * _CELL + 0.1
    height = _TOP + sum(tall) + _BOTTOM
    figure = Figure(figsize=(width, height), dpi=110, facecolor="white")
    figure.text(0.1 / width, 1 - 0.2 / height, plain(title), size=11, weight="bold", color=INK, va="center")
    for line, (view, (low, high)) in enumerate(zip(views, limits, strict=True)):
        bottom = height - _TOP - sum(tall[: line + 1])
        side: dict[str, Any] = {"size": 8, "color": FAINT, "rotation": 90, "va": "center", "ha": "center"}
        figure.text(0.2 / width, (bottom + tall[line] / 2) / height, view.name, **side)
        for column, snapshot in enumerate(shown):
            box = ((_LEFT + column * _CELL) / width, bottom / height, _CELL / width, tall[line] / height)
            axes = figure.add_axes(box)
            axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
            _draw_view(axes, view, snapshot, scale)
            if line == 0:
                label = f"after frame {snapshot.frame}: {len(snapshots[column].mean)} Gaussians"
                axes.set_title(plain(label), size=8.5, color=INK, pad=4)
            if line == 0 and column == 0:
                _draw_ruler(axes, low, high)
    bar = figure.add_axes((_LEFT / width, 0.42 / height, min(4.0, width - 2 * _LEFT) / width, 0.1 / height))
    draw_bar(bar, Bar("√m, disagreement between the views [m]", scale, 0))
    save_png(figure, path)
    return scale


def below_ceiling(snapshot: Snapshot, up: Array, all_times: Sequence[Snapshot]) -> Snapshot:
    """The snapshot without the Gaussians that lie above every camera by more than ``HEADROOM``."""
    highest = max(float((other.path @ up).max()) for other in all_times)
    kept = snapshot.mean @ up <= highest + HEADROOM
    chosen = (snapshot.mean[kept], snapshot.covariance[kept], snapshot.disagreement[kept])
    return Snapshot(snapshot.frame, *chosen, snapshot.T_world_cam, snapshot.path)


def painted(view: Projection, snapshot: Snapshot) -> tuple[Ellipses, NDArray[np.intp]]:
    """The ellipses in the order in which they are painted, the farthest first, and that order [K]."""
    order = np.argsort(view.nearness(snapshot.mean), kind="stable")
    return project(view, snapshot.mean[order], snapshot.covariance[order]), order


def _draw_view(axes: Any, view: Projection, snapshot: Snapshot, scale: ColourScale) -> None:
    from matplotlib.collections import EllipseCollection

    axes.set_aspect("equal", adjustable="box")
    axes.set_xticks([])
    axes.set_yticks([])
    for side in axes.spines.values():
        side.set_color("#d9d9d9")
    ellipses, order = painted(view, snapshot)
    colours = scale.rgb(np.sqrt(np.maximum(snapshot.disagreement, 0)))[order] / 255
    wide, narrow = 2 * ellipses.axes.T
    drawn = EllipseCollection(
        wide,
        np.maximum(narrow, 0.01),  # a plane seen edge-on would vanish
        ellipses.angle,
        units="xy",
        offsets=ellipses.centre,
        offset_transform=axes.transData,
        facecolors=np.concatenate([colours, np.full((len(colours), 1), 0.85)], axis=1),
        edgecolors=(1, 1, 1, 0.55),
        linewidths=0.4,
    )
    axes.add_collection(drawn, autolim=False)
    walked = view.plane(snapshot.path)
    axes.plot(*walked.T, color="white", linewidth=2.6)
    axes.plot(*walked.T, color=_PATH, linewidth=1.3)
    _draw_camera(axes, view, snapshot.T_world_cam)


def _draw_camera(axes: Any, view: Projection, T_world_cam: Array) -> None:
    """A dot where the camera is, and which way it looks."""
    here = view.plane(T_world_cam[:3, 3])
    ahead = view.plane(T_world_cam[:3, 3] + 0.45 * T_world_cam[:3, 2])
    axes.plot(*here, "o", markersize=5, color=_PATH, markeredgecolor="white", markeredgewidth=0.8)
    arrow = {"arrowstyle": "-|>", "color": _PATH, "linewidth": 1.4, "shrinkA": 0, "shrinkB": 0}
    axes.annotate("", xy=ahead, xytext=here, arrowprops=arrow)


def _draw_ruler(axes: Any, low: Array, high: Array) -> None:
    """One metre, or ten where the room is wide."""
    length = 1.0 if high[0] - low[0] < 15 else 10.0
    x, y = low + 0.04 * (high - low)
    axes.plot([x, x + length], [y, y], color=INK, linewidth=2, solid_capstyle="butt")
    axes.text(x + length / 2, y + 0.02 * (high[1] - low[1]), f"{length:g} m", size=7.5, color=INK, ha="center")


def _limits(view: Projection, snapshots: Sequence[Snapshot]) -> tuple[Array, Array]:
    """[2] lower and upper corner of what the picture shows, the same at all times [m].

    A Gaussian of a wrong depth can lie far outside; hence percentiles, and all of the camera's path.
    """
    plane = np.concatenate([view.plane(snapshot.mean) for snapshot in snapshots])
    reach = np.concatenate([project(view, s.mean, s.covariance).axes[:, :1] for s in snapshots])
    walked = np.concatenate([view.plane(snapshot.path) for snapshot in snapshots])
    low, high = np.percentile(plane - reach, 1, axis=0), np.percentile(plane + reach, 99, axis=0)
    low, high = np.minimum(low, walked.min(0)) - 0.2, np.maximum(high, walked.max(0)) + 0.2
    # Not flatter or taller than can be looked at.
    size, middle = high - low, (low + high) / 2
    size = np.maximum(size, [size[1] / 1.4, size[0] / 2.5])
    return middle - size / 2, middle + size / 2


def _natural(name: str) -> list[tuple[int, str]]:
    """A key that puts frame 9 before frame 10."""
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", name)]


def _load(file: Path, frame: str) -> Snapshot:
    stored = load_arrays(file)
    missing = [name for name in ("mean_world", "covariance_world", "disagreement", "T_world_cam") if name not in stored]
    if missing:
        raise ValueError(f"{file} must hold a mixture; {', '.join(missing)} is missing")
    mean, covariance, disagreement, T = (
        stored[name].astype(np.float64) for name in ("mean_world", "covariance_world", "disagreement", "T_world_cam")
    )
    path = stored["path"].astype(np.float64) if "path" in stored else T[None, :3, 3]
    return Snapshot(frame, mean, covariance, disagreement, T, path)


# ---- Gaussians seen from far away: an orthographic camera, and the ellipses that covariances leave on its image ----


@dataclass(frozen=True, eq=False)
class Projection:
    """An orthographic camera.

    Attributes:
        right: [3] unit vector that points right in the picture, in the world.
        up: [3] the one that points up.
        name: "from above", say.
    """

    right: Array
    up: Array
    name: str

    @property
    def towards(self) -> Array:
        """[3] unit vector from the scene to the viewer."""
        return np.cross(self.right, self.up)

    def plane(self, points: Array) -> Array:
        """[..., 2] coordinates of world points [..., 3] in the picture [m]."""
        return np.stack([points @ self.right, points @ self.up], axis=-1)

    def nearness(self, points: Array) -> Array:
        """[...] how near world points [..., 3] are to the viewer [m]; what is larger hides what is smaller."""
        nearness: Array = points @ self.towards
        return nearness


@dataclass(frozen=True, eq=False)
class Ellipses:
    """Ellipses in a picture.

    Attributes:
        centre: [K, 2] [m].
        axes: [K, 2] semi-axes, the longer first [m].
        angle: [K] of the longer one, from right towards up, in (-90, 90] [degrees].
    """

    centre: Array
    axes: Array
    angle: Array


def project(view: Projection, mean: Array, covariance: Array, sigmas: float = SIGMAS) -> Ellipses:
    """The ellipses of Gaussians: P Sigma P^T is the covariance in the picture, P the view's two rows.

    Args:
        view: the camera.
        mean: [K, 3] in the world [m].
        covariance: [K, 3, 3] [m^2].
        sigmas: semi-axes in standard deviations.
    """
    P = np.stack([view.right, view.up])
    flat = P @ covariance @ P.T
    a, b, c = flat[:, 0, 0], (flat[:, 0, 1] + flat[:, 1, 0]) / 2, flat[:, 1, 1]
    middle, spread = (a + c) / 2, np.hypot((a - c) / 2, b)
    # Rounding can leave the smaller eigenvalue of a line just below 0.
    axes = sigmas * np.sqrt(np.maximum(np.stack([middle + spread, middle - spread], axis=-1), 0))
    return Ellipses(view.plane(mean), axes, np.degrees(np.arctan2(2 * b, a - c) / 2))


def views_of(T_world_cam: Array, elevation: float = 35.0) -> tuple[Projection, Projection]:
    """From above, and obliquely from behind the first camera.

    Data sets differ in which axis points up; a camera's own up (-y) is right on average.

    Args:
        T_world_cam: [n, 4, 4] poses of cameras.
        elevation: of the oblique view over the horizon [degrees].
    """
    up = _unit(-T_world_cam[:, :3, 1].mean(0), np.array([0.0, 0.0, 1.0]))
    first = T_world_cam[0, :3, 2]
    # A camera that looks straight down has no forward on the floor: any direction serves then.
    fallback = np.eye(3)[np.argmin(np.abs(up))]
    forward = _unit(first - up * (first @ up), _unit(fallback - up * (fallback @ up), fallback))
    right = np.cross(forward, up)
    tilt = np.radians(elevation)
    oblique = Projection(right, np.cos(tilt) * up + np.sin(tilt) * forward, "obliquely")
    return Projection(right, forward, "from above"), oblique


def _unit(vector: Array, otherwise: Array) -> Array:
    """The vector at length 1, or another one where it has no direction."""
    length = float(np.linalg.norm(vector))
    return vector / length if length > 1e-6 else otherwise

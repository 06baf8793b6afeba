"""Gaussians seen from far away: an orthographic camera, and the ellipses that covariances leave on its image."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
# A patch that is evenly covered from -a to a has sigma = a / sqrt(3): so drawn, an ellipse is as large as its patch.
SIGMAS = float(np.sqrt(3.0))


@dataclass(frozen=True, eq=False)
class View:
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


def project(view: View, mean: Array, covariance: Array, sigmas: float = SIGMAS) -> Ellipses:
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


def views_of(T_world_cam: Array, elevation: float = 35.0) -> tuple[View, View]:
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
    oblique = View(right, np.cos(tilt) * up + np.sin(tilt) * forward, "obliquely")
    return View(right, forward, "from above"), oblique


def _unit(vector: Array, otherwise: Array) -> Array:
    """The vector at length 1, or another one where it has no direction."""
    length = float(np.linalg.norm(vector))
    return vector / length if length > 1e-6 else otherwise

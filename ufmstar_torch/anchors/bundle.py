"""Poses of a window of views, refined by the corners that are tracked through them: bundle adjustment.

The given poses of the views are off by independent errors, a rotation w and a shift s each, of standard deviations
sigma_w and sigma_s. They are the prior, so that the refined poses neither drift nor change the scale: only what the
images show about them changes. In a view, a corner's position has a Student-t distribution about its point's projection,
of a variance that grows with the number of views between, since errors of tracking add up. Gauss-Newton steps on poses
and inverse depths, these eliminated, lead to the most likely poses (``kernels.bundle_cpu``).

sigma_w, sigma_s and the noise of the corners are learnt from every frame (EM): with the error d of the newest pose, of
which the posterior variance c remains, E[d^2] = sigma^2 - c under the prior.
"""

from __future__ import annotations

from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from ufmstar_torch.anchors.saved_state import SavedState

# [px] Standard deviations before anything is learnt, of a position by errors of the poses and by tracking; the least.
_FIRST, _TRACKING, _LEAST = 0.1, 0.35, 0.003
# Share of the learnt numbers that remains after a frame.
_MEMORY = 0.8
# The variance of a corner's position v views before is 1 + _DRIFT (v - 1) times that of the view before.
_DRIFT = 0.6
# What a position says about a pose, over that of an independent one: neighbouring corners, and the same corner in
# several views, err alike. Fitted on tours, whose poses have no error: with 1, they are moved by .3 px.
_INFORMATION = 0.1
# Degrees of freedom of the corners' errors, steps for poses and, before, for inverse depths alone.
_CAP = 5.0
_STUDENT, _STEPS, _DEPTH_STEPS = 4.0, 4, 6
# Tracks and views from which on poses are refined.
_ENOUGH, _VIEWS = 8, 3
# The median of a chi-squared variable of two degrees of freedom.
_MEDIAN_SQUARE = 1.386


class PoseRefinement(SavedState):
    """Refines poses; remembers how large their errors are.

    Attributes:
        shared: variance of the corners' inverse depths by the errors that remain in the refined poses, the median over
            the last corners [1/m^2]; the same error for all of them. 0 where nothing was refined.
        smooth: variance of a position by errors of the given poses that successive views share [px^2]: the images show
            little of them, while independent ones they show well.
    """

    HELD: ClassVar = {"_variance": "given_pose_variance", "shared": "remaining_pose_variance", "smooth": "smooth_pose_error", "_last": "last_pose_error"}

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Forget everything."""
        self._variance = np.full(2, _FIRST**2 / 2)  # of w and of s over the scene's depth, in px^2 of a view
        self.shared, self.smooth, self._last = 0.0, 0.0, np.zeros(6)

    def refine(
        self, pixel: NDArray[np.float64], seen: NDArray[np.bool_], T_world_cam: NDArray[np.float64],
        K: NDArray[np.float64], depth: float, most: float,
    ) -> NDArray[np.float64]:  # fmt: skip
        """Most likely poses of some views.

        Args:
            pixel: [N, W, 2] (u, v) of corners; the newest view is the last.
            seen: [N, W] which views show them.
            T_world_cam: [W, 4, 4] given poses, camera-to-world [m].
            K: [3, 3] [px].
            depth: median of the scene [m].
            most: largest standard deviation of a position by errors of the poses [px].

        Returns:
            [W, 4, 4] the refined poses; the given ones where too few corners are seen.
        """
        from ufmstar_torch.kernels.bundle_cpu import POSE, equations, inverse_depths  # compiles when first needed

        self.shared = 0.0
        views = np.flatnonzero(seen.any(0))
        tracks = seen[:, -1] & (seen.sum(1) > 1)
        if tracks.sum() < _ENOUGH or len(views) < _VIEWS:
            return T_world_cam
        f = K[0, 0]
        ray = (pixel[np.ix_(tracks, views)] - K[:2, 2]) / K.diagonal()[:2]
        growth = 1 + _DRIFT * np.arange(len(views) - 2, -1, -1)
        shown = seen[np.ix_(tracks, views[:-1])] / growth
        precision = shown * (f / _TRACKING) ** 2
        sigma2 = self._variance / f**2 * [1, depth**2]
        given, poses, prior = T_world_cam[views], T_world_cam[views], np.tile(np.repeat(1 / sigma2, 3), len(views))
        error, start = np.zeros(len(prior)), 1 / depth
        rho = inverse_depths(ray, precision, poses, start, _STUDENT, _DEPTH_STEPS)
        for _ in range(_STEPS):
            A, b, h, v, squares = equations(ray, precision, poses, rho, start, _STUDENT)
            A, b = _INFORMATION * A, _INFORMATION * b - prior * error
            A[np.diag_indices(len(A))] += prior
            L = np.linalg.cholesky(A)
            step = np.linalg.solve(L.T, np.linalg.solve(L, b))
            error += step
            poses = moved(poses, step)
            rho = (rho + v - h @ step).clip(0.02 * start, 20 * start)
        if not np.isfinite(poses).all():
            return T_world_cam
        remains = np.linalg.inv(L)
        self._learn(error[-POSE:], remains[-POSE:, -POSE:], sigma2, f, depth, most)
        self.shared = float(np.median(np.square(h @ remains.T).sum(1)))
        result = T_world_cam.copy()
        result[views] = poses
        return result

    def _learn(
        self, error: NDArray[np.float64], remains: NDArray[np.float64], sigma2: NDArray[np.float64],
        f: float, depth: float, most: float,
    ) -> None:  # fmt: skip
        """Follow the errors of the given poses by the newest one's: ``error`` [6] and L^-1 of its precision [6, 6]."""
        shown = 3 - np.square(remains).sum(0).reshape(2, 3).sum(1) / sigma2  # of the three numbers, what images showed
        change = np.square(error).reshape(2, 3).sum(1) - shown * sigma2
        now = (sigma2 + (1 - _MEMORY) * change / np.maximum(shown, 1)) * f**2 / [1, depth**2]
        moves = error / np.repeat([1, depth], 3) * f  # [px]
        self.smooth = max(_MEMORY * self.smooth + (1 - _MEMORY) * float(moves @ self._last) / 3, 0.0)
        self._last = moves
        self._variance = now.clip(_LEAST**2 / 2, (_CAP * most)**2 / 2)


def moved(T_world_cam: NDArray[np.float64], error: NDArray[np.float64]) -> NDArray[np.float64]:
    """Poses [W, 4, 4] after a rotation about their own axes and a shift along the world's, [6 W] one after the other."""
    w, s = error.reshape(-1, 2, 3).swapaxes(0, 1)
    angle = np.linalg.norm(w, axis=1)[:, None, None]
    x, y, z = w.T
    zero = np.zeros_like(x)
    cross = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).reshape(-1, 3, 3)
    first = np.sinc(angle / np.pi)  # sin(angle)/angle
    second = np.square(np.sinc(angle / (2 * np.pi))) / 2  # (1 - cos(angle))/angle^2
    turned = T_world_cam.copy()
    turned[:, :3, :3] = T_world_cam[:, :3, :3] @ (np.eye(3) + first * cross + second * cross @ cross)
    turned[:, :3, 3] += s
    return turned

"""Ablations of the input: noise and drift of the poses."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ufmstar_torch.eval.methods.setting import Setting

# Third number of the seed of drift. Anchors use 1 and 2; the seed of noise has two numbers.
_DRIFT = 3


def perturbed(T_world_cam: NDArray[np.float64], setting: Setting, index: int) -> NDArray[np.float64]:
    """A pose with noise, (R exp([w]x), t + n), w and n drawn from normal distributions.

    The random numbers depend on the setting's seed and the frame's index alone; the setting's standard deviations scale
    them. A sweep of standard deviations therefore scales the same noise.

    Args:
        T_world_cam: [4, 4] camera-to-world [m].
        setting: with the standard deviations of w [deg], about the camera's axes, and n [m], along the world's.
        index: of the frame in its sequence.

    Returns:
        [4, 4] the noisy pose; ``T_world_cam`` if the setting has no noise.
    """
    if not (setting.rotation_noise or setting.translation_noise):
        return T_world_cam
    drawn = np.random.default_rng([setting.seed, index]).standard_normal(6)
    noisy = T_world_cam.copy()
    noisy[:3, :3] = T_world_cam[:3, :3] @ rotation(math.radians(setting.rotation_noise) * drawn[:3])
    noisy[:3, 3] += setting.translation_noise * drawn[3:]
    return noisy


class Drift:
    """Poses with the drift of odometry: each relative pose has a small error, which moves all later poses.

    Frame j after frame i has the pose T'_j = T'_i (T_i^-1 T_j) (exp([w]x), n). The noise w, n is about and along the
    camera's axes. Both are sums of one normal increment for every frame of the sequence from i + 1 to j, used or not,
    so variances grow linearly with frames. The random numbers of an increment depend on the seed and its frame's index
    alone; the setting scales them. The first pose is exact. Orientations err by a random walk, positions by another one
    and by the wrong orientations.

    Nearby views stay nearly consistent, as in a SLAM system between two loops; independent noise makes neighbours as
    inconsistent as distant frames.

    Args:
        setting: with the standard deviations of an increment of w [deg] and n [m].
    """

    def __init__(self, setting: Setting) -> None:
        self._setting = setting
        self._last: tuple[int, NDArray[np.float64], NDArray[np.float64]] | None = None

    def of(self, T_world_cam: NDArray[np.float64], index: int) -> NDArray[np.float64]:
        """The pose with drift [4, 4] of the next frame at camera-to-world [4, 4] [m]; ``T_world_cam`` itself without
        drift. Raises ValueError: ``index`` is not larger than that of the previous frame."""
        setting = self._setting
        if not (setting.rotation_drift or setting.translation_drift):
            return T_world_cam
        if self._last is None:
            drifted = T_world_cam
        else:
            before, T_before, drifted_before = self._last
            if index <= before:
                raise ValueError(f"frames with drift must come in order, got index {index} after {before}")
            drawn = np.sum([self._increment(i) for i in range(before + 1, index + 1)], axis=0)
            step = np.eye(4)
            step[:3, :3] = rotation(math.radians(setting.rotation_drift) * drawn[:3])
            step[:3, 3] = setting.translation_drift * drawn[3:]
            drifted = drifted_before @ np.linalg.solve(T_before, T_world_cam) @ step
        self._last = index, T_world_cam, drifted
        return drifted

    def _increment(self, index: int) -> NDArray[np.float64]:
        return np.random.default_rng([self._setting.seed, index, _DRIFT]).standard_normal(6)


def rotation(w: NDArray[np.float64]) -> NDArray[np.float64]:
    """[3, 3] exp([w]x) of a rotation vector [3] [rad]."""
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_rotvec(w).as_matrix())

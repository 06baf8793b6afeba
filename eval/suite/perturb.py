"""What an ablation does to the frames: leaves some out, and disturbs the poses of the others."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ufmstar_torch.eval.suite.setting import Setting


def selects(setting: Setting, number: int) -> bool:
    """Whether image ``number`` (0, 1, ... of those to be judged) is used: ``skip`` are left out after each one."""
    return number % (setting.skip + 1) == 0


def perturbed(T_world_cam: NDArray[np.float64], setting: Setting, index: int) -> NDArray[np.float64]:
    """A pose with noise, (R exp([w]x), t + n), w and n drawn from normal distributions.

    The noise depends on the setting's seed and the frame's index alone, not on what was run before, and only its size
    on the setting's standard deviations: along a sweep it is the same noise, stronger and stronger.

    Args:
        T_world_cam: [4, 4] camera-to-world [m].
        setting: with the standard deviations of w [deg], about the camera's axes, and n [m], along the world's.
        index: of the frame in its sequence.

    Returns:
        [4, 4], the pose itself where the setting has no noise.
    """
    if not (setting.rotation_noise or setting.translation_noise):
        return T_world_cam
    drawn = np.random.default_rng([setting.seed, index]).standard_normal(6)
    noisy = T_world_cam.copy()
    noisy[:3, :3] = T_world_cam[:3, :3] @ rotation(math.radians(setting.rotation_noise) * drawn[:3])
    noisy[:3, 3] += setting.translation_noise * drawn[3:]
    return noisy


def rotation(w: NDArray[np.float64]) -> NDArray[np.float64]:
    """[3, 3] exp([w]x) of a rotation vector [3] [rad], by Rodrigues' formula."""
    angle = float(np.linalg.norm(w))
    if angle == 0:
        return np.eye(3)
    x, y, z = w / angle
    K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + math.sin(angle) * K + (1 - math.cos(angle)) * (K @ K)

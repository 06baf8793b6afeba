"""A camera's poses over time, and their interpolation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ufmstar_torch.frames.arguments import require_number
from ufmstar_torch.runtime.kinds import require

# [s] An image this close to a sample has the sample's pose, whatever the gap around it: timestamps are printed with
# four to six decimals, and at 1 m/s the camera moves 1 mm in that time.
SAME_TIME = 1e-3
# [s] An image between samples that are too far apart, or outside the trajectory, has the pose of a sample this close:
# at 1 m/s the camera moves 5 mm in that time.
_NEAREST = 5e-3


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Camera-to-world poses, in order."""

    # [N] float64, strictly increasing [s] (or frame numbers, if the file has those). None: pose i is that of frame i.
    timestamps: np.ndarray | None
    T_world_cam: np.ndarray  # [N, 4, 4] float64; a pose that was not finite in the file is all NaN

    def __len__(self) -> int:
        return len(self.T_world_cam)


def interpolate_pose(trajectory: Trajectory, time: float, max_gap: float = 0.1) -> np.ndarray | None:
    """The camera-to-world pose [4, 4] at ``time`` [s], between the samples before and after it.

    The position is interpolated linearly, the rotation along the shortest arc (slerp). A sample within 1 ms is returned
    unchanged. If the samples before and after lie more than ``max_gap`` [s] apart, or at an end of the trajectory, a
    sample within 5 ms is returned. The pose is NaN if a sample that it needs is not finite.

    Returns:
        The pose; None if there is no sample close enough.

    Raises:
        ValueError: the trajectory has no timestamps.
    """
    time, max_gap = require_number("time", time), require_number("max_gap", max_gap)
    times = require("trajectory", trajectory, Trajectory).timestamps
    if times is None:
        raise ValueError("trajectory has no timestamps, so it cannot be interpolated")
    after = int(np.searchsorted(times, time))
    around = [i for i in (after - 1, after) if 0 <= i < len(times)]
    if not around:
        return None
    nearest = min(around, key=lambda i: abs(times[i] - time))
    if abs(times[nearest] - time) <= SAME_TIME:
        return trajectory.T_world_cam[nearest].copy()
    if len(around) < 2 or times[after] - times[after - 1] > max_gap:
        return trajectory.T_world_cam[nearest].copy() if abs(times[nearest] - time) <= _NEAREST else None
    first, second = trajectory.T_world_cam[after - 1], trajectory.T_world_cam[after]
    if not (np.isfinite(first).all() and np.isfinite(second).all()):
        return np.full((4, 4), np.nan)
    share = (time - times[after - 1]) / (times[after] - times[after - 1])
    T = np.eye(4)
    T[:3, :3] = first[:3, :3] @ _part_of_turn(first[:3, :3].T @ second[:3, :3], share)
    T[:3, 3] = (1 - share) * first[:3, 3] + share * second[:3, 3]
    return T


def _part_of_turn(R: np.ndarray, share: float) -> np.ndarray:
    """A rotation [3, 3] about the axis of R by a share of its angle (Rodrigues' formula). R's quaternion is the
    eigenvector of the largest eigenvalue of a symmetric matrix (Bar-Itzhack 2000), also for an angle of pi."""
    skew = np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    matrix = np.zeros((4, 4))
    matrix[:3, :3] = R + R.T - np.trace(R) * np.eye(3)
    matrix[:3, 3] = matrix[3, :3] = skew
    matrix[3, 3] = np.trace(R)
    x, y, z, w = np.linalg.eigh(matrix)[1][:, -1]
    axis = np.array([x, y, z]) * (-1 if w < 0 else 1)  # the shorter way round
    length = float(np.linalg.norm(axis))
    if length == 0:
        return np.eye(3)
    angle = share * 2 * np.arctan2(length, abs(w))
    a, b, c = axis / length
    cross = np.array([[0, -c, b], [c, 0, -a], [-b, a, 0]])
    turned: np.ndarray = np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
    return turned

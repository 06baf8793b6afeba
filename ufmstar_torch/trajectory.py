"""A camera's poses over time, and the pose between two of them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

# An image this close to a sample takes its pose as it is, whatever the gap around it [s]: timestamps are
# printed with four to six decimals, and at 1 m/s the camera moves 1 mm in that time.
SAME_TIME = 1e-3
# An image between samples that are too far apart, or outside the trajectory, takes a sample this close as it is [s]:
# a camera at 1 m/s is 5 mm away from it.
_NEAREST = 5e-3


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Camera-to-world poses, in order."""

    # [N] float64, strictly increasing [s] (or frame numbers, if the file has those), or None where pose i belongs to
    # frame i.
    timestamps: np.ndarray | None
    T_world_cam: np.ndarray  # [N, 4, 4] float64; a pose that was not finite in the file is all NaN

    def __len__(self) -> int:
        return len(self.T_world_cam)


def interpolate_pose(trajectory: Trajectory, time: float, max_gap: float = 0.1) -> np.ndarray | None:
    """The camera-to-world pose [4, 4] at ``time`` [s], between the samples before and after it.

    The position is interpolated linearly, the rotation along the shortest arc (slerp). A sample within 1 ms is taken as
    it is; and where the samples before and after lie more than ``max_gap`` [s] apart, or one of them is missing at the
    end of the trajectory, one within 5 ms. NaN where a sample that is needed is not finite.

    Returns:
        The pose; None where there is none.

    Raises:
        ValueError: the trajectory has no timestamps.
    """
    times = trajectory.timestamps
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
    """A share of a rotation [3, 3] about its own axis. Its quaternion is the eigenvector of the largest eigenvalue of a
    symmetric matrix (Bar-Itzhack 2000), which also holds at half a turn; rotated about the axis by Rodrigues."""
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

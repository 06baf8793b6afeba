"""UfM (ICRA 2022) in NumPy float64 loops over points, straight from its description; slow, plain, and independent.

Imports neither torch nor the package. The points are dicts with keys mean, cov, count, transformed from camera to
camera as in the original. Rotations are assumed exact."""

from __future__ import annotations

import numpy as np


class UfM:
    """One stream."""

    def __init__(self, max_points=None):
        self.max_points = max_points
        self.points = []
        self.pose = None

    def step(self, depth, s2, valid, T_world_cam, K):
        """Variance [H, W], NaN where not valid."""
        height, width = depth.shape
        if self.pose is not None:
            self._carry(np.linalg.inv(T_world_cam) @ self.pose)
        self.pose = T_world_cam
        variance = np.where(valid, s2, np.nan)
        hit = np.zeros((height, width), dtype=bool)
        for point in self.points:
            point["seen"], u, v = self._land(point["mean"], K, height, width)
            if point["seen"] and valid[v, u]:
                p, A = self._observe(depth[v, u], s2[v, u], u, v, K)
                self._fuse(point, p, A)
                variance[v, u] = point["cov"][2, 2]  # a later point is newer and overwrites
                hit[v, u] = True
        for v in range(height):
            for u in range(width):
                if valid[v, u] and not hit[v, u]:
                    p, A = self._observe(depth[v, u], s2[v, u], u, v, K)
                    self.points.append({"mean": p, "cov": A, "count": 1, "seen": True})
        self._prune()
        return variance

    def _carry(self, T):
        R, t = T[:3, :3], T[:3, 3]
        for point in self.points:
            point["mean"] = R @ point["mean"] + t
            point["cov"] = R @ point["cov"] @ R.T

    @staticmethod
    def _land(mean, K, height, width):
        x, y, z = mean
        if z <= 0:
            return False, -1, -1
        u, v = np.rint(K[0, 0] * x / z + K[0, 2]), np.rint(K[1, 1] * y / z + K[1, 2])
        if not (0 <= u < width and 0 <= v < height):
            return False, -1, -1
        return True, int(u), int(v)

    @staticmethod
    def _observe(z, s2, u, v, K):
        ray = np.array([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], 1.0])
        return z * ray, s2 * np.outer(ray, ray)

    @staticmethod
    def _fuse(point, p, A):
        M = point["count"] + 1
        step = p - point["mean"]
        point["mean"] = point["mean"] + step / M
        point["cov"] = (M - 1) / M * point["cov"] + A / M + (M - 1) / M**2 * np.outer(step, step)
        point["count"] = M

    def _prune(self):
        if self.max_points is None:
            return
        while len(self.points) > self.max_points:
            oldest_unseen = next((n for n, point in enumerate(self.points) if not point["seen"]), 0)
            self.points.pop(oldest_unseen)

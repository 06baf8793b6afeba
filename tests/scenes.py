"""Rendered scenes with known answers: boxes in a room, exact depth and poses, NumPy only."""

from __future__ import annotations

import numpy as np

ROOM = ((-2.5, -1.4, -2.5), (2.5, 1.4, 3.5))
FURNITURE = (
    ((-1.6, 0.2, 1.2), (-0.6, 1.4, 2.0)),
    ((0.5, -0.3, 1.6), (0.9, 1.4, 2.0)),  # a pillar that hides the wall behind it
    ((1.2, 0.6, 0.4), (2.2, 1.4, 1.4)),
    ((-0.5, 0.7, 2.4), (0.4, 1.4, 3.2)),
)


def intrinsics(height, width, fov_degrees=70.0):
    """A centred pinhole camera [px], first pixel's centre at (0, 0)."""
    f = 0.5 * width / np.tan(np.radians(fov_degrees) / 2)
    return np.array([[f, 0, (width - 1) / 2], [0, f, (height - 1) / 2], [0, 0, 1.0]])


def camera_pose(position, yaw, pitch=0.0):
    """Camera-to-world pose; yaw turns right about the vertical axis y (down), pitch looks down [rad]."""
    cy, sy, cp, sp = np.cos(yaw), np.sin(yaw), np.cos(pitch), np.sin(pitch)
    R_yaw = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    R_pitch = np.array([[1, 0, 0], [0, cp, sp], [0, -sp, cp]])
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R_yaw @ R_pitch, position
    return T


def _entry_exit(origin, directions, box):
    low, high = (np.asarray(corner, dtype=np.float64) for corner in box)
    with np.errstate(divide="ignore", invalid="ignore"):
        a, b = (low - origin) / directions, (high - origin) / directions
    return np.nanmax(np.minimum(a, b), axis=-1), np.nanmin(np.maximum(a, b), axis=-1)


def render(T_world_cam, K, height, width, boxes=FURNITURE, room=ROOM):
    """Exact depth [H, W] along the optical axis [m]."""
    v, u = np.mgrid[0:height, 0:width].astype(np.float64)
    rays = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones_like(u)], axis=-1)
    directions, origin = rays @ T_world_cam[:3, :3].T, T_world_cam[:3, 3]
    depth = _entry_exit(origin, directions, room)[1]  # the ray parameter is the depth: ray_z = 1
    for box in boxes:
        near, far = _entry_exit(origin, directions, box)
        depth = np.where((near < far) & (near > 0) & (near < depth), near, depth)
    return depth


def tour(frames=30):
    """Poses that pan over the room, walk past the pillar, and come back to the start (revisits)."""
    phase = np.linspace(0, 2 * np.pi, frames)
    return [
        camera_pose((0.9 * np.sin(p), -0.1 + 0.1 * np.sin(2 * p), -0.6 * (1 - np.cos(p))), 0.35 * np.sin(p), 0.08)
        for p in phase
    ]


def flicker(depth, amount, seed):
    """Add a smooth random relative error that differs from frame to frame, like a network's."""
    rng = np.random.default_rng(seed)
    height, width = depth.shape
    y, x = np.linspace(0, 1, height)[:, None], np.linspace(0, 1, width)[None]
    a, b, c, d = rng.normal(size=4)
    field = a + b * np.sin(2 * np.pi * x + d) + c * np.cos(2 * np.pi * y + d)
    return depth * (1 + amount * field / 2)


def sequence(frames=30, height=48, width=64, amount=0.03, seed=0):
    """Depths, poses and intrinsics of the tour, with flicker and a few holes."""
    K = intrinsics(height, width)
    poses = tour(frames)
    rng = np.random.default_rng(seed)
    depths = []
    for i, T in enumerate(poses):
        depth = flicker(render(T, K, height, width), amount, seed * 1000 + i)
        depth[rng.random(depth.shape) < 0.01] = np.nan
        depths.append(depth)
    return depths, poses, K

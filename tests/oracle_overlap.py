"""The share of a view whose scale no evidence has confirmed, of the posterior's oracle."""

from __future__ import annotations

import numpy as np
from oracle_field import REACH, ratio

LEVEL = np.eye(4), np.array([[20.0, 0, 8], [0, 20, 6], [0, 0, 1]])


def new_share(logs, size, last, pose, K, scale):
    """Share of the image outside of the view of the pose ``last``, for nodes at e^(logs + scale)."""
    cells, shape = np.array(logs.shape)[::-1], np.array(size)[::-1]
    seen = 0.0
    for (r, c), log in np.ndenumerate(logs):
        pixel = (np.array([c, r]) + 0.5) / cells * shape - 0.5
        point = np.linalg.solve(K, [*pixel, 1]) * np.exp(log + scale)
        x, y, z, _ = np.linalg.solve(last, pose @ [*point, 1])
        if z > 0:
            u, v, w = K @ [x, y, z]
            at = (np.array([u, v]) / w + 0.5) / shape * cells
            seen += np.prod(np.clip(np.minimum(at, cells - at) + 0.5, 0, 1))
    return 1 - seen / logs.size


def confirmed(state, after, logs, size, away, view):
    """Write the share after a frame with anchors, and its pose."""
    pose, K = view
    q = state.get("unconfirmed", 0.0)
    if state["frames"]:
        q = 1 - (1 - q) * (1 - new_share(logs, size, state["pose"], pose, K, after["b"][0]))
    after["unconfirmed"], after["pose"] = (away / REACH).mean() ** 4 * q, pose


def scale_elsewhere(after, share):
    """Variance of the scale at nodes at the distance ``share`` from evidence."""
    return after["unconfirmed"] * min(3 * ratio(after, "between"), 0.25) * share

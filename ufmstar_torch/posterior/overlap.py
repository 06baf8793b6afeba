"""The network's scale in a view that shares little with the evidence (numba).

Between two views, the mean of y differs the more, the less they overlap. In a turn in place, new directions have no
parallax and no anchors, and the constant of b is that of views behind the camera. The scale follows a Gauss-Markov
process over the view. q is the share of the view whose scale no evidence has confirmed: with the share n of the image
that the frame before did not show, and the mean distance a of a frame's nodes from evidence, over ``reach``,

    q <- 1 - (1 - q)(1 - n),      and in a frame with anchors q <- a^``confirmed`` q.

A node at the distance x from evidence has the additional variance q min(``places`` between, sigma_b^2) x/reach of y:
"between" is the squared scale by which surfaces differ in this stream (``motion``).
"""

from __future__ import annotations

import math

from ufmstar_torch.kernels.compile_cpu import leaf, part
from ufmstar_torch.posterior.running import BETWEEN


@part
def confirm(memory, view, size, grid, anchors, away, config):
    """Change the share q and the pose of a :class:`~ufmstar_torch.posterior.running.Memory` after a frame.

    Args:
        memory: changed.
        view: pose [4, 4] camera-to-world [m] and K [3, 3] [px].
        size: H and W.
        grid: of the frame.
        anchors: number of valid anchors in the frame.
        away: [n] distances of the nodes from evidence.
        config: of the posterior.
    """
    total, n = 0.0, away.size
    if memory.frames[0] > (anchors > 0):  # evidence before this frame
        memory.frames[2] += (1 - memory.frames[2]) * _new(memory, view, size, grid)
    if anchors:
        for i in range(n):
            total += away[i] / config.reach
        memory.frames[2] *= (total / n) ** config.confirmed
    for k in range(memory.pose.size):
        memory.pose[k] = view[0][k // 4, k % 4] if memory.frames[0] > 0 else 0.0


@part
def _new(memory, view, size, grid):
    """Share of the image in [0, 1] whose points, at the depth of the stream's scale, lie outside the last frame's view;
    cells at a border count in part."""
    (T, K), last, seen = view, memory.pose, 0.0
    a, b = size[1] / grid.cols, size[0] / grid.rows
    for i in range(grid.log_depth.size):
        row = i // grid.cols
        z = math.exp(grid.log_depth[i] + memory.coefficients[0])
        x = ((i - row * grid.cols + 0.5) * a - 0.5 - K[0, 2]) / K[0, 0] * z
        y = ((row + 0.5) * b - 0.5 - K[1, 2]) / K[1, 1] * z
        X = T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3] - last[3]
        Y = T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3] - last[7]
        Z = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3] - last[11]
        x, y = last[0] * X + last[4] * Y + last[8] * Z, last[1] * X + last[5] * Y + last[9] * Z
        z = last[2] * X + last[6] * Y + last[10] * Z
        if z > 0:
            u, v = K[0, 0] * x / z + K[0, 2] + 0.5, K[1, 1] * y / z + K[1, 2] + 0.5
            seen += _inside(u / a, grid.cols) * _inside(v / b, grid.rows)
    return max(1 - seen / grid.log_depth.size, 0.0)


@leaf
def _inside(centre, count):
    """Share of a cell that lies between 0 and ``count``, in cells, for its centre."""
    return min(max(min(centre, count - centre) + 0.5, 0.0), 1.0)


@leaf
def scale_elsewhere(config, unconfirmed, ratios):
    """Variance of y at ``reach`` from evidence, for the share q = ``unconfirmed``."""
    return unconfirmed * min(config.places * ratios[BETWEEN], config.prior_sigma**2)

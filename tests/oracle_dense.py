"""Dense evidence in NumPy loops: the search along an epipolar line and its refinement, one pixel against one view."""

from __future__ import annotations

import numpy as np

SIDE, FIRST = 8, -3.5


def project(pixel, rho, H, b):
    """Where a pixel (u, v) at an inverse depth rho [1/m] lies in the view."""
    x = H @ np.array([*pixel, 1.0]) + rho * b
    return x[:2] / x[2]


def bilinear(image, u, v):
    i, j = int(np.floor(u)), int(np.floor(v))
    a, c = u - i, v - j
    top = (1 - a) * float(image[j, i]) + a * float(image[j, i + 1])
    bottom = (1 - a) * float(image[j + 1, i]) + a * float(image[j + 1, i + 1])
    return (1 - c) * top + c * bottom


def warp(pixel, rho, H, b, step=1e-4):
    """[2, 2] by how much the pixel moves in the image for a pixel in the view, by differences."""
    columns = [project(pixel + step * e, rho, H, b) - project(pixel - step * e, rho, H, b) for e in np.eye(2)]
    return np.linalg.inv(np.stack(columns, axis=1) / (2 * step))


def patch(image, pixel, rho, H, b):
    """[10, 10] the image around a pixel as the view sees it at rho."""
    back, result = warp(np.asarray(pixel, float), rho, H, b), np.empty((SIDE + 2, SIDE + 2))
    for j in range(SIDE + 2):
        for i in range(SIDE + 2):
            result[j, i] = bilinear(image, *(pixel + back @ [i + FIRST - 1, j + FIRST - 1]))
    return result


def zncc(one, other):
    one, other = one - one.mean(), other - other.mean()
    return (one * other).sum() / np.sqrt((one**2).sum() * (other**2).sum())


def window(view, u, v):
    """[8, 8] around a centre, between pixels."""
    return np.array([[bilinear(view, u + i + FIRST, v + j + FIRST) for i in range(SIDE)] for j in range(SIDE)])


def along_line(image, view, pixel, H, b, low, high):
    """The best inverse depth in [low, high], and its ZNCC: every twentieth of a pixel is tried."""
    reference = patch(image, pixel, 0.5 * (low + high), H, b)[1:-1, 1:-1]
    ends = project(pixel, low, H, b), project(pixel, high, H, b)
    steps = int(np.ceil(20 * np.linalg.norm(ends[1] - ends[0])))
    best, at = -2.0, ends[0]
    for s in range(steps + 1):
        p = ends[0] + (ends[1] - ends[0]) * s / steps
        score = zncc(reference, window(view, *p))
        if score > best:
            best, at = score, p
    rays = H @ np.array([*pixel, 1.0])
    axis = int(np.abs(ends[1] - ends[0]).argmax())
    return (at[axis] * rays[2] - rays[axis]) / (b[axis] - at[axis] * b[2]), best

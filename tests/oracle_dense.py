"""Dense evidence in NumPy loops: the search along an epipolar line, errors of poses and camera, neighbours."""

from __future__ import annotations

import numpy as np

SIDE, FIRST = 8, -3.5


def project(pixel, rho, H, b):
    """Pixel of the view that shows a pixel (u, v) at an inverse depth rho [1/m]."""
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


def displaced(pixel, rho, H, b, K, error):
    """Pixel in a view whose pose and camera are wrong by ``error`` [10]: w, s, f, cx, cy, k."""
    w, s, (focal, cu, cv, k) = error[:3], error[3:6], error[6:]
    R, t = np.linalg.inv(K) @ H @ K, np.linalg.inv(K) @ b
    fu, fv, u0, v0 = K[0, 0] * (1 + focal), K[1, 1] * (1 + focal), K[0, 2] + cu, K[1, 2] + cv
    x, y = (pixel[0] - u0) / fu, (pixel[1] - v0) / fv
    back = 1 - k * (x * x + y * y)
    q = R @ np.array([x * back, y * back, 1]) + rho * t
    q = q + np.cross(w, q) + rho * s
    p, q = q[0] / q[2], q[1] / q[2]
    out = 1 + k * (p * p + q * q)
    return np.array([fu * p * out + u0, fv * q * out + v0])


def by_errors(pixel, rho, H, b, K, step=1e-5):
    """[2, 10] by how much a pixel moves with the errors, by differences."""
    columns = [
        (displaced(pixel, rho, H, b, K, step * e) - displaced(pixel, rho, H, b, K, -step * e)) for e in np.eye(10)
    ]
    return np.stack(columns, axis=1) / (2 * step)


def errors_and_depths(change, value, variance, across_change, across, across_variance, precision, start, rounds=3):
    """Errors [6 V + 4], their covariance, depths [N] and their variances [N]: one system of all of them. Views show
    nothing where the variance is infinite."""
    count, views, _ = change.shape
    size = len(start)
    weight, weight_across = np.ones((count, views)), np.ones((count, views))
    for _ in range(rounds):
        A = np.zeros((size + count, size + count))
        A[:size, :size] = precision
        r = np.concatenate([precision @ start, np.zeros(count)])
        rows = {}
        for n in range(count):
            for k in range(views):
                place = [*range(6 * k, 6 * k + 6), *range(6 * views, size)]
                row, beside = np.zeros(size + count), np.zeros(size + count)
                row[place], row[size + n], beside[place] = change[n, k], 1, across_change[n, k]
                rows[n, k] = row, beside
                for each, seen, w in (
                    (row, value[n, k], weight[n, k] / variance[n, k]),
                    (beside, across[n, k], weight_across[n, k] / across_variance[n, k]),
                ):
                    A += w * np.outer(each, each)
                    r += w * seen * each
        covariance = np.linalg.inv(A)
        x = covariance @ r
        for n in range(count):
            for k in range(views):
                row, beside = rows[n, k]
                weight[n, k] = 5 / (4 + (value[n, k] - row @ x) ** 2 / variance[n, k])
                weight_across[n, k] = 5 / (4 + (across[n, k] - beside @ x) ** 2 / across_variance[n, k])
    return x[:size], covariance[:size, :size], x[size:], covariance.diagonal()[size:]


def alone(pixel, rho, variance, cell):
    """[N] squared errors to expect by the anchors in the 5 x 5 cells around each: the probability to be wrong, .026 in
    the mean, which goes with the eighth power of the share of others, times their mean squared difference. No two
    anchors have a cell in common."""
    cells, power, square = np.floor(pixel / cell), np.zeros(len(rho)), np.zeros(len(rho))
    for n in range(len(rho)):
        near = [m for m in range(len(rho)) if m != n and np.abs(cells[m] - cells[n]).max() <= 2]
        others = [
            (rho[m] - rho[n]) ** 2
            for m in near
            if (rho[m] - rho[n]) ** 2 >= max(9 * (variance[m] + variance[n]), (0.05 * rho[n]) ** 2)
        ]
        if others:
            power[n], square[n] = (len(others) / (len(near) + 1)) ** 8, np.mean(others)
    return (0.026 * power / max(power.mean(), 0.026)) ** 2 * square


def confirmed(pixel, rho, variance, agreed, contradicted, cell):
    """[N] measurements that hold: two views agree; or one, which is not certain to 20 %, or with which at least three
    others in the 5 x 5 cells around agree, 90 % of all there, each certain to 20 %. No two have a cell in common."""
    cells, fine = np.floor(pixel / cell), (agreed > 1) & (contradicted == 0)
    found = [n for n in range(len(rho)) if agreed[n] > 0 and contradicted[n] == 0]
    for n in found:
        near = [m for m in found if m != n and np.abs(cells[m] - cells[n]).max() <= 2]
        alike = [
            m
            for m in near
            if (rho[m] - rho[n]) ** 2 < max(9 * (variance[m] + variance[n]), (0.05 * rho[n]) ** 2)
            and variance[m] < (0.2 * rho[m]) ** 2
        ]
        supported = len(alike) >= 3 and len(alike) >= 0.9 * len(near)
        fine[n] |= agreed[n] == 1 and (supported or variance[n] >= (0.2 * rho[n]) ** 2)
    return fine

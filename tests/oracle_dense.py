"""Dense evidence in NumPy loops: the search along an epipolar line, errors of poses and camera, neighbours."""

from __future__ import annotations

import numpy as np

SIDE, FIRST = 8, -3.5


def project(pixel, rho, H, b):
    """Project pixel (u, v) with inverse depth rho [1/m] into the view."""
    x = H @ np.array([*pixel, 1.0]) + rho * b
    return x[:2] / x[2]


def bilinear(image, u, v):
    i, j = int(np.floor(u)), int(np.floor(v))
    a, c = u - i, v - j
    top = (1 - a) * float(image[j, i]) + a * float(image[j, i + 1])
    bottom = (1 - a) * float(image[j + 1, i]) + a * float(image[j + 1, i + 1])
    return (1 - c) * top + c * bottom


def warp(pixel, rho, H, b, step=1e-4):
    """[2, 2] derivative of the image position by the position in the view, by finite differences."""
    columns = [project(pixel + step * e, rho, H, b) - project(pixel - step * e, rho, H, b) for e in np.eye(2)]
    return np.linalg.inv(np.stack(columns, axis=1) / (2 * step))


def patch(image, pixel, rho, H, b):
    """[10, 10] image patch around a pixel, warped into the view at rho."""
    back, result = warp(np.asarray(pixel, float), rho, H, b), np.empty((SIDE + 2, SIDE + 2))
    for j in range(SIDE + 2):
        for i in range(SIDE + 2):
            result[j, i] = bilinear(image, *(pixel + back @ [i + FIRST - 1, j + FIRST - 1]))
    return result


def zncc(one, other):
    one, other = one - one.mean(), other - other.mean()
    return (one * other).sum() / np.sqrt((one**2).sum() * (other**2).sum())


def window(view, u, v):
    """[8, 8] window around a centre, interpolated."""
    return np.array([[bilinear(view, u + i + FIRST, v + j + FIRST) for i in range(SIDE)] for j in range(SIDE)])


def along_line(image, view, pixel, H, b, low, high):
    """The inverse depth in [low, high] with the best ZNCC, and that ZNCC: exhaustive search in steps of a twentieth of
    a pixel."""
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


def centre_of_texture(image, pixel, rho, H, b):
    """[2] mean position of the squared gradients along the line of a pixel's window, from the pixel, in its image."""
    reference = patch(image, pixel, rho, H, b)
    ahead, behind = project(pixel, rho + 1e-4, H, b), project(pixel, rho - 1e-4, H, b)
    direction = (ahead - behind) / np.linalg.norm(ahead - behind)
    down, right = np.gradient(reference)
    inside = reference[1:-1, 1:-1]
    contrast = np.linalg.norm(inside - inside.mean())
    right, down = (g[1:-1, 1:-1] / contrast for g in (right, down))
    weight = (direction[0] * (right - right.mean()) + direction[1] * (down - down.mean())) ** 2
    row, column = np.mgrid[:SIDE, :SIDE] + FIRST
    mean = np.array([(weight * column).sum(), (weight * row).sum()]) / weight.sum()
    return warp(np.asarray(pixel, float), rho, H, b) @ mean


def displaced(pixel, rho, H, b, K, error):
    """Projection into a view whose pose and camera have the ``error`` [10]: w, s, f, cx, cy, k."""
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
    """[2, 10] derivative of the projection by the errors, by finite differences."""
    columns = [
        (displaced(pixel, rho, H, b, K, step * e) - displaced(pixel, rho, H, b, K, -step * e)) for e in np.eye(10)
    ]
    return np.stack(columns, axis=1) / (2 * step)


def errors_and_depths(change, value, variance, across_change, across, across_variance, precision, start, rounds=3):
    """Errors [6 V + 4], their covariance, inverse depths [N] and their variances [N], from one joint system. An
    infinite variance marks a view without a measurement."""
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
                columns = [*range(6 * k, 6 * k + 6), *range(6 * views, size)]
                row, row_across = np.zeros(size + count), np.zeros(size + count)
                row[columns], row[size + n], row_across[columns] = change[n, k], 1, across_change[n, k]
                rows[n, k] = row, row_across
                for each, seen, w in (
                    (row, value[n, k], weight[n, k] / variance[n, k]),
                    (row_across, across[n, k], weight_across[n, k] / across_variance[n, k]),
                ):
                    A += w * np.outer(each, each)
                    r += w * seen * each
        covariance = np.linalg.inv(A)
        x = covariance @ r
        for n in range(count):
            for k in range(views):
                row, row_across = rows[n, k]
                weight[n, k] = 5 / (4 + (value[n, k] - row @ x) ** 2 / variance[n, k])
                weight_across[n, k] = 5 / (4 + (across[n, k] - row_across @ x) ** 2 / across_variance[n, k])
    return x[:size], covariance[:size, :size], x[size:], covariance.diagonal()[size:]


def alone(pixel, rho, variance, cell):
    """[N] expected squared errors from the anchors in the 5 x 5 cells around each: the probability of an outlier (mean
    .026, proportional to the eighth power of the share of contradicting anchors) times their mean squared difference. A
    cell has at most one anchor."""
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
    """[N] accepted measurements: two views agree; or one view agrees, and the measurement is not certain to 20 %, or at
    least three measurements in the 5 x 5 cells around it agree, 90 % of all, each certain to 20 %. A cell has at most
    one measurement."""
    cells, fine = np.floor(pixel / cell), (agreed > 1) & (contradicted == 0)
    found = [n for n in range(len(rho)) if agreed[n] > 0 and contradicted[n] == 0]
    for n in found:
        near = [m for m in found if m != n and np.abs(cells[m] - cells[n]).max() <= 2]
        agreeing = [
            m
            for m in near
            if (rho[m] - rho[n]) ** 2 < max(9 * (variance[m] + variance[n]), (0.05 * rho[n]) ** 2)
            and variance[m] < (0.2 * rho[m]) ** 2
        ]
        supported = len(agreeing) >= 3 and len(agreeing) >= 0.9 * len(near)
        fine[n] |= agreed[n] == 1 and (supported or variance[n] >= (0.2 * rho[n]) ** 2)
    return fine


def chosen(poses, T, K, size, depth, baselines):
    """Pairs (index of the baseline, keyframe), the shortest first: the keyframe, not chosen before, whose baseline over
    the depth differs from the requested one by the smallest factor, at most 2.5, where a frame of age counts as .2 %. A
    keyframe shows at least half of 16 points of the view at the depth."""
    height, width = size
    points = [
        T[:3, :3] @ (np.linalg.inv(K) @ [(i + 0.5) / 4 * width, (j + 0.5) / 4 * height, 1]) * depth + T[:3, 3]
        for j in range(4)
        for i in range(4)
    ]
    baseline, candidates, result = [], [], []
    for n, pose in enumerate(poses):
        baseline.append(np.linalg.norm(pose[:3, 3] - T[:3, 3]) / depth)
        seen = [K @ pose[:3, :3].T @ (x - pose[:3, 3]) for x in points]
        inside = [z > 0.2 * depth and 0 < u / z < width - 1 and 0 < v / z < height - 1 for u, v, z in seen]
        if np.mean(inside) >= 0.5:
            candidates.append(n)
    for index, wanted in enumerate(baselines):
        mismatch = {n: abs(np.log(baseline[n] / wanted)) for n in candidates if n not in [m for _, m in result]}
        fine = {n: m + 0.002 * (len(poses) - 1 - n) for n, m in mismatch.items() if m < np.log(2.5)}
        if fine:
            result.append((index, min(fine, key=fine.get)))
    return sorted(result, key=lambda pair: baseline[pair[1]])

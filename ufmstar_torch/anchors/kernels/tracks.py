"""Tracks of corners: predicted, tested, compared with the poses, and accepted as landmarks; on the CPU (numba)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ufmstar_torch.anchors.kernels.epipolar import FAR, NEAR, NEAREST, matched, off_lines, on_lines, weighted_quantile
from ufmstar_torch.anchors.kernels.numbers import finite, median
from ufmstar_torch.kernels.compile_cpu import empty, reordered, reordered_leaf

# Least number of tracks for a comparison with the poses.
_ENOUGH = 5
# Upper limit of depths over the median in an image without motion: all points of a frozen image would lie beyond it,
# but only half of a scene's points do.
_MEDIAN_DEPTH = 1.0
# Least motion of a corner that determines a depth, and median motion below which an image stands still [px].
_MOVES, _STILL = 1.0, 0.2
# The median of the absolute value of a standard normal variable.
_MEDIAN = 0.6745
# Half width of the window of a local mean of brightness [px], and range of the means in use [gray levels].
_HALF, _DARKEST, _BRIGHTEST = 8, 8, 240


@reordered
def predict(position, point, last, T, K, K_inverse, expected):
    """Predict the positions of corners in the image of another camera; a corner without a point gets the median depth
    of the others.

    Args:
        position: [N, 2] (u, v) in the camera ``last`` [px].
        point: [N, 3] in the world [m], NaN = unknown.
        last, T: [4, 4] camera-to-world of both cameras [m].
        K, K_inverse: [3, 3] [px].
        expected: [N, 2] (u, v) in the camera ``T``, overwritten [px].

    Returns:
        False if too few corners have a point.
    """
    count, values, world = 0, empty(len(position), np.float64), empty(3, np.float64)
    has_point = empty(len(position), np.bool_)
    for n in range(len(position)):
        depth = 0.0
        for i in range(3):
            depth += (point[n, i] - last[i, 3]) * last[i, 2]
        has_point[n] = finite(depth)
        if has_point[n]:
            values[count] = depth
            count += 1
    if count < _ENOUGH:
        return False
    middle = median(values, count)
    for n in range(len(position)):
        u, v = position[n, 0], position[n, 1]
        x, y = K_inverse[0, 0] * u + K_inverse[0, 1] * v + K_inverse[0, 2], K_inverse[1, 1] * v + K_inverse[1, 2]
        for i in range(3):
            if has_point[n]:
                world[i] = point[n, i]
            else:
                world[i] = middle * (last[i, 0] * x + last[i, 1] * y + last[i, 2]) + last[i, 3]
        from_u, from_v = _projected(world, last, K, NEAREST * middle)
        to_u, to_v = _projected(world, T, K, NEAREST * middle)
        expected[n, 0], expected[n, 1] = u + to_u - from_u, v + to_v - from_v
    return True


@reordered_leaf
def _projected(point, T, K, least):
    """The pixel (u, v) of a point [3] in a camera T [4, 4]; its depth is at least ``least``."""
    a, b, c = point[0] - T[0, 3], point[1] - T[1, 3], point[2] - T[2, 3]
    x, y = T[0, 0] * a + T[1, 0] * b + T[2, 0] * c, T[0, 1] * a + T[1, 1] * b + T[2, 1] * c
    z = T[0, 2] * a + T[1, 2] * b + T[2, 2] * c
    over = 1 / max(z, least)
    return (K[0, 0] * x + K[0, 1] * y + K[0, 2] * z) * over, (K[1, 1] * y + K[1, 2] * z) * over


@reordered
def returned(start, forward, back, tracked, tracked_back, shape, tolerance, position, fine):
    """Write the positions [N, 2] of corners tracked from ``start`` to ``forward`` and ``back`` [N, 1, 2], and [N] True
    where tracked both ways (1 in [N, 1] each), back to the start up to a tolerance [px], and inside the image of a
    ``shape`` (H, W). Returns how many."""
    height, width = shape
    count = 0
    for n in range(len(start)):
        u, v = np.float64(forward[n, 0, 0]), np.float64(forward[n, 0, 1])
        du, dv = back[n, 0, 0] - start[n, 0, 0], back[n, 0, 1] - start[n, 0, 1]
        near = np.sqrt(du * du + dv * dv) < tolerance
        inside = 0 <= u <= width - 1 and 0 <= v <= height - 1
        fine[n] = tracked[n, 0] == 1 and tracked_back[n, 0] == 1 and near and inside
        position[n, 0], position[n, 1] = u, v
        count += fine[n]
    return count


@reordered
def brightness_ratio(before, after, position, found, fine):
    """The median ratio of brightness around corners, from ``position`` to ``found`` [N, 2], where ``fine`` [N]; 1 where
    no corner's neighbourhood is of medium brightness in both images [H, W]."""
    values, count = empty(len(position), np.float64), 0
    for n in range(len(position)):
        if fine[n]:
            one, other = _local_mean(before, position[n]), _local_mean(after, found[n])
            if min(one, other) > _DARKEST and max(one, other) < _BRIGHTEST:
                values[count] = other / one
                count += 1
    return median(values, count) if count > 0 else 1.0


@reordered_leaf
def _local_mean(image, position):
    """The mean of the gray levels around a position, rounded; the image is mirrored at its border pixels."""
    height, width = image.shape
    u, v = int(np.rint(position[0])), int(np.rint(position[1]))
    total = np.int32(0)
    if _HALF <= u < width - _HALF:
        for j in range(v - _HALF, v + _HALF + 1):
            row = image[_mirrored(j, height)]
            for i in range(u - _HALF, u + _HALF + 1):
                total += np.int32(row[i])
    else:
        for j in range(v - _HALF, v + _HALF + 1):
            row = image[_mirrored(j, height)]
            for i in range(u - _HALF, u + _HALF + 1):
                total += np.int32(row[_mirrored(i, width)])
    return np.rint(total / (2 * _HALF + 1) ** 2)


@reordered_leaf
def _mirrored(i, size):
    """An index into a row of pixels that is mirrored at its first and last one."""
    if size == 1:
        return 0
    i %= 2 * size - 2
    return min(i, 2 * size - 2 - i)


@reordered
def cover(free, disc, followed, factor):
    """Set the mask ``free`` [H, W] to 0 in discs [2 r + 1, 2 r + 1] around corners [N, 2] (u, v) [px] of an image that
    is ``factor`` times as large."""
    radius = len(disc) // 2
    for n in range(len(followed)):
        u, v = int(np.rint((followed[n, 0] + 0.5) / factor - 0.5)), int(np.rint((followed[n, 1] + 0.5) / factor - 0.5))
        for j in range(max(-radius, -v), min(radius + 1, len(free) - v)):
            for i in range(max(-radius, -u), min(radius + 1, free.shape[1] - u)):
                if disc[j + radius, i + radius] > 0:
                    free[v + j, u + i] = 0


@reordered
def compare(pixel, seen, poses, K, K_inverse, size, depth, noise):
    """Compare the corners of the newest view with its pose, each from the first view that shows it.

    Args:
        pixel: [N, W, 2] positions (u, v); the newest view is the last.
        seen: [N, W] bool, True where the view shows the corner.
        poses: [W, 4, 4] camera-to-world [m].
        K, K_inverse: [3, 3] [px].
        size: width and height of the image [px].
        depth: median of the scene [m].
        noise: standard deviation of a tracked position [px].

    Returns:
        The standard deviation of corners from their epipolar lines [px], negative if there are too few; their median
        baseline [m]; the median inverse depth of those that determine one [1/m], negative if there are too few.
    """
    last, most = seen.shape[1] - 1, len(seen)
    track, first, order = empty(most, np.int64), empty(most, np.int64), empty(most, np.int64)
    distance, rho, baseline = empty(most, np.float64), empty(most, np.float64), empty(most, np.float64)
    motion, values, weight = empty(most, np.float64), empty(most, np.float64), empty(most, np.float64)
    fits, newest = empty(most, np.bool_), empty((most, 2), np.float64)
    count = matched(seen, track, first)
    if count < _ENOUGH:
        return -1.0, 0.0, -1.0
    for i in range(count):
        n, k = track[i], first[i]
        du, dv = pixel[n, last, 0] - pixel[n, k, 0], pixel[n, last, 1] - pixel[n, k, 1]
        values[i] = motion[i] = np.sqrt(du * du + dv * dv)
    far = depth * (_MEDIAN_DEPTH if median(values, count) < _STILL else FAR)
    found, cameras = (track[:count], first[:count]), (poses, K, K_inverse, NEAR * depth, far)
    off_lines(pixel, *found, *cameras, newest, distance, rho, baseline)
    return _compared(distance[:count], rho[:count], baseline, motion, newest, size, noise, fits, weight, order)


@reordered_leaf
def _compared(distance, rho, baseline, motion, newest, size, noise, fits, weight, order):
    """The results of :func:`compare`, from the distances [N] of tracks from their lines."""
    count, determined = len(distance), 0
    middle = median(baseline, count)
    on_lines(distance, newest, size, noise / 2, fits, weight, order)
    error = weighted_quantile(distance, weight, fits, 0.5, order) / _MEDIAN
    for i in range(count):
        fits[i] = rho[i] > 0 and motion[i] > _MOVES
        determined += fits[i]
    if determined < _ENOUGH:
        return error, middle, -1.0
    return error, middle, weighted_quantile(rho, weight, fits, 0.5, order)


# Errors of a tracked position add up from view to view: the variance of a track of v views is _DRIFT (v - 1) times that
# of independent positions. The squared errors on four rendered tours confirm both the growth with v and the factor.
_DRIFT = 0.6
# Share of the running estimate of the residuals' variance that remains after a frame; least number of views of the
# tracks for that estimate.
_MEMORY, _LONG = 0.8, 4
# Least share of the corners with clear parallax. Where the share is smaller, the parallax is mostly error, and corners
# seem too near: by a factor of 7 with a share of .05, of 1.2 with .3 (a turning camera, on tours). Where the camera
# moves, the share exceeds one half.
_CLEAR_SHARE = 1 / 3


class Limits(NamedTuple):
    """Limits that a track must keep to become a landmark; see ``tracker.TrackerConfig``."""

    pixel_noise: float
    max_relative_sigma: float
    max_error: float
    min_share: float


@reordered
def accept(points, seen, T, limits, noise, depth, variance, fine):
    """Write the depths of triangulated tracks in the newest view.

    Args:
        points: N tracks (``triangulate.Triangulated``).
        seen: [N, W] bool, True where the view shows the corner.
        T: [4, 4] camera-to-world of the newest view [m].
        limits: see :class:`Limits`.
        noise: running estimate of the variance of a position [px^2].
        depth, variance: [N] along the optical axis [m] and its variance by independent errors [m^2], overwritten.
        fine: [N] True for landmarks, overwritten.

    Returns:
        The updated ``noise``.
    """
    count, long, values = len(seen), 0, empty(len(seen), np.float64)
    views, residual, one_pixel = empty(count, np.int64), empty(count, np.float64), empty(count, np.float64)
    decisive = decisive_fits = fits = 0
    for n in range(count):
        views[n], depth[n], one_pixel[n] = 0, 0.0, 0.0
        for k in range(seen.shape[1]):
            views[n] += seen[n, k]
        for i in range(3):
            depth[n] += (points.point[n, i] - T[i, 3]) * T[i, 2]
            for j in range(3):
                one_pixel[n] += T[i, 2] * points.covariance[n, i, j] * T[j, 2]
        residual[n] = points.error[n] * points.error[n] * 2 * views[n] / max(2 * views[n] - 3, 1)
        fine[n] = points.error[n] <= limits.max_error
        fits += fine[n]
        decisive += views[n] > 2
        decisive_fits += views[n] > 2 and fine[n]
        if fine[n] and points.ahead[n] and views[n] >= _LONG:
            values[long] = residual[n]
            long += 1
    if long >= _ENOUGH:
        noise = _MEMORY * noise + (1 - _MEMORY) * median(values, long)
    # Two views can only disagree across the epipolar line. Tracks of three views decide, if there are enough.
    if decisive < _ENOUGH:
        decisive, decisive_fits = count, fits
    trusted, clear = decisive_fits >= limits.min_share * decisive, 0
    for n in range(count):
        # A residual above the noise increases the variance of the track.
        variance[n] = _DRIFT * (views[n] - 1) * max(residual[n], noise) * one_pixel[n]
        fine[n] = trusted and fine[n] and points.ahead[n] and depth[n] > 0
        # Degenerate geometry can make the covariance indefinite.
        independent = max(residual[n], limits.pixel_noise**2) * one_pixel[n]
        fine[n] &= variance[n] >= 0 and independent <= (limits.max_relative_sigma * max(depth[n], 1e-9)) ** 2
        clear += fine[n]
    if clear < _CLEAR_SHARE * count:
        for n in range(count):
            fine[n] = False
    return noise

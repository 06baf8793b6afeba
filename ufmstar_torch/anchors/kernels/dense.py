"""Inverse depths of pixels from keyframes: a search along the epipolar line by ZNCC, refined to a fraction of a pixel.

On the CPU (numba). A pixel x of the image and an inverse depth rho [1/m] project into a keyframe at
p(rho) = (H x + rho b)/(.)_z, with H = K R K^-1 and b = K t of the relative pose. The patch around x, warped by dp/dx,
is compared with windows of the keyframe along the line, a pixel apart. Gauss-Newton steps along the line refine the
position of the best window (``windows``). ``tests/oracle_dense.py`` is the same in NumPy.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ufmstar_torch.anchors.kernels.windows import (
    COUNT,
    FIRST,
    LARGEST_SCALE,
    MARGIN,
    SIDE,
    WIDE,
    correlate,
    eights,
    normalised,
    refined,
    sampled,
)
from ufmstar_torch.kernels.compile_cpu import empty, reordered, reordered_leaf
from ufmstar_torch.kernels.cpu.vectors import LANES

# Most steps of a search; a rival is more than APART steps away.
LONGEST, APART = 192, 2
# The first searched view shows the line from infinity to this multiple of the starting inverse depth: a better match
# could lie outside of the image.
WHOLE = 2.0
# [px] Distance from the border within which a view does not show a line.
_BORDER = 3.0
# [px^2] Variance of a match without residual, from interpolation.
LEAST_MATCH = 0.03**2
# [px] A match measures the poses across the line where its noise there is below this.
SHOWS = 0.25
# Columns of :attr:`Measured.each`.
VALUE, NOISE, ALONG, SPEED, SLOPE, ACROSS, ACROSS_NOISE = 0, 1, 2, 4, 5, 6, 7


class Views(NamedTuple):
    """V keyframes to search, the shortest baseline first.

    Attributes:
        image: [R, H, W] uint8, of more keyframes.
        slot: [V] indices of their images.
        share: [V] indices of their baselines among the requested ones.
        H: [V, 3, 3] of a pixel at infinity into the view.
        b: [V, 3] [px m].
        noise: [V] variance of a position from errors of the poses [px^2].
    """

    image: NDArray[np.uint8]
    slot: NDArray[np.int64]
    share: NDArray[np.int64]
    H: NDArray[np.float64]
    b: NDArray[np.float64]
    noise: NDArray[np.float64]

    def first(self, count: int) -> Views:
        """The first ``count`` keyframes."""
        numbers = self.slot[:count], self.share[:count]
        return Views(self.image, *numbers, self.H[:count], self.b[:count], self.noise[:count])


class Search(NamedTuple):
    """Settings of the search for a depth and of its acceptance.

    Attributes:
        start: inverse depth at which the first patch is warped [1/m].
        low, high: range of the first search [1/m].
        sigmas: half width of later searches, and largest difference between views, in standard deviations.
        least_score: least ZNCC of a match.
        rival: least ratio of 1 - ZNCC between the best match elsewhere on the first line and the best one.
    """

    start: float
    low: float
    high: float
    sigmas: float
    least_score: float
    rival: float


class Measured(NamedTuple):
    """Inverse depths of N pixels.

    Attributes:
        rho: [N] [1/m].
        variance: [N] of ``rho`` [1/m^2]: the smallest of the agreeing views. It does not fall with their number,
            because they share the patch.
        agreed: [N] number of agreeing views; 0 = not measured.
        contradicted: [N] number of views that disagree.
        shown: [N] number of views that show the line from infinity to ``WHOLE`` times the starting inverse depth.
        each: [N, V, 8] of the agreeing views, NaN of others, by column: ``VALUE`` inverse depth [1/m]; ``NOISE``
            variance of the position along the line from the match alone [px^2]; ``ALONG``, two columns, unit direction
            (u, v) in which the point moves along the line; ``SPEED`` derivative of the position along the line by the
            inverse depth [px m]; ``SLOPE`` shift of the match along the line per unit of error across it; ``ACROSS``
            position across the line [px], NaN where the patch does not determine it; ``ACROSS_NOISE`` variance of that
            from the match alone [px^2].
        centre: [N, 2] (u, v) from the pixel to the mean position of the texture that determines the match: the squared
            gradients along the line. On a blank surface beside an edge, the match measures the edge.
    """

    rho: NDArray[np.float64]
    variance: NDArray[np.float64]
    agreed: NDArray[np.int64]
    contradicted: NDArray[np.int64]
    shown: NDArray[np.int64]
    each: NDArray[np.float64]
    centre: NDArray[np.float64]


def measure(image: NDArray[np.uint8], pixel: NDArray[np.float64], views: Views, search: Search) -> Measured:
    """Inverse depths along the optical axis.

    Args:
        image: [H, W] uint8.
        pixel: [N, 2] (u, v).
        views: in the same pixels.
        search: settings.
    """
    n, v = len(pixel), len(views.slot)
    (rho, variance), (agreed, contradicted, shown) = np.zeros((2, n)), np.zeros((3, n), np.int64)
    result = Measured(rho, variance, agreed, contradicted, shown, np.full((n, v, 8), np.nan), np.zeros((n, 2)))
    _measure(image, pixel, eights(views.image), views, search, *result)
    return result


def cells(shape: tuple[int, ...], cell: int) -> tuple[int, int]:
    """Rows and columns of cells in an image of a shape (H, W)."""
    return -(-shape[0] // cell), -(-shape[1] // cell)


def free_pixels(image: NDArray[np.uint8], cell: int, occupied: NDArray[np.float64]) -> NDArray[np.float64]:
    """The pixel (u, v) of the largest gradient in every cell with a gradient and no ``occupied`` pixel [M, 2]: [N, 2].
    Cells are ``cell`` px wide; occupied pixels may lie outside of the image."""
    rows, columns = cells(image.shape, cell)
    pixel = np.empty((rows * columns, 2))
    return pixel[: _free_pixels(image, cell, occupied, (rows, columns), pixel)]


@reordered
def _free_pixels(image, cell, occupied, shape, pixel):
    free, count = empty(shape, np.bool_), 0
    free[:] = True
    for m in range(len(occupied)):
        if 0 <= occupied[m, 0] < image.shape[1] and 0 <= occupied[m, 1] < image.shape[0]:
            free[int(occupied[m, 1]) // cell, int(occupied[m, 0]) // cell] = False
    for row in range(shape[0]):
        for column in range(shape[1]):
            if free[row, column] and steepest(image, cell, row, column, pixel[count]):
                count += 1
    return count


@reordered_leaf
def steepest(image, cell, row, column, pixel):
    """Write the pixel (u, v) of the largest squared gradient in a cell, ``MARGIN`` from the border or more; False where
    there is no gradient."""
    height, width = image.shape
    best = np.int32(0)
    for v in range(max(row * cell, MARGIN), min((row + 1) * cell, height - MARGIN)):
        for u in range(max(column * cell, MARGIN), min((column + 1) * cell, width - MARGIN)):
            du = np.int32(image[v, u + 1]) - np.int32(image[v, u - 1])
            dv = np.int32(image[v + 1, u]) - np.int32(image[v - 1, u])
            if du * du + dv * dv > best:
                best, pixel[0], pixel[1] = du * du + dv * dv, u, v
    return best > 0


@reordered
def _measure(image, pixel, keys, views, search, rho, variance, agreed, contradicted, shown, each, centre):
    H, b, noise = views.H, views.b, views.noise
    start, first_low, first_high, sigmas, least_score, least_rival = search
    height, width = image.shape
    flat = image.reshape(image.size)
    corner, share = empty(WIDE * WIDE, np.uint32), empty((2, WIDE * WIDE), np.float32)
    template, patch = empty(WIDE * WIDE, np.float32), empty(COUNT, np.float32)
    along_u, along_v = empty(COUNT, np.float32), empty(COUNT, np.float32)
    warp = empty(4, np.float64)
    rows, best, out = empty((2, SIDE + 1), np.uint64), empty(4, np.float64), empty(8, np.float64)
    pixels, windows = views.image.reshape(views.image.size), empty((2, LONGEST + 1), np.int64)
    sums, scores = empty((LONGEST + 1, 3, LANES), np.float32), empty(LONGEST + 1, np.float32)
    for n in range(len(pixel)):
        u, v, weight = pixel[n, 0], pixel[n, 1], 0.0
        for k in range(len(H)):
            key = keys[views.slot[k]]
            first = agreed[n] == 0
            at = start if first else rho[n]
            x, y = H[k, 0, 0] * u + H[k, 0, 1] * v + H[k, 0, 2], H[k, 1, 0] * u + H[k, 1, 1] * v + H[k, 1, 2]
            z = H[k, 2, 0] * u + H[k, 2, 1] * v + H[k, 2, 2]
            low, high = first_low, first_high
            line, size = (x, y, z, b[k]), (width, height)
            shown[n] += _within(*line, 0.0, *size, _BORDER) and _within(*line, WHOLE * start, *size, _BORDER)
            if first and not (_within(*line, 0.0, *size, -FIRST) and _within(*line, WHOLE * start, *size, -FIRST)):
                continue
            if not first:
                speed = _speed(x, y, z, b[k], at)[2]
                half = max(sigmas * np.sqrt(variance[n] + noise[k] / speed**2), 1 / speed)
                low, high = at - half, at + half
            if not (
                _warped(flat, width, height, u, v, H[k], b[k], at, corner, share, template, warp)
                and normalised(template, patch, along_u, along_v)
                and _search(
                    patch, pixels, views.slot[k], width, height, x, y, z, b[k], low, high, windows, sums, scores, best
                )
            ):
                continue
            if best[2] < least_score or (first and 1 - best[3] < least_rival * (1 - best[2])):
                continue
            eu, ev, speed = _speed(x, y, z, b[k], _inverse_depth(x, y, z, b[k], best[0], best[1]))
            if not refined(patch, along_u, along_v, key, width, height, best[0], best[1], eu, ev, rows, out):
                continue
            if out[5] < least_score:
                continue
            # G of the normalised window along and across the line; a pixel's variance from the remaining differences.
            g_ee, g_ep, g_pp = out[1], out[2], out[3]
            pixel_noise = 2 * max(1 - out[5], 0.0) / (COUNT - 4)  # rounding can put a ZNCC above 1
            slope = g_ep / g_ee
            schur = g_pp - g_ep * slope
            along = pixel_noise / g_ee + LEAST_MATCH
            spread = (along + noise[k] * (1 + slope * slope)) / (speed * speed)
            value = _inverse_depth(x, y, z, b[k], best[0] + out[0] * eu, best[1] + out[0] * ev)
            if not first and (value - rho[n]) ** 2 > sigmas * sigmas * (spread + variance[n]):
                contradicted[n] += 1
                continue
            agreed[n] += 1
            each[n, k, VALUE], each[n, k, NOISE], each[n, k, ALONG], each[n, k, ALONG + 1] = value, along, eu, ev
            each[n, k, SPEED], each[n, k, SLOPE] = speed, slope
            if schur > 0 and pixel_noise < SHOWS * SHOWS * schur:
                each[n, k, ACROSS], each[n, k, ACROSS_NOISE] = -out[4] / schur, pixel_noise / schur
            if first or spread < variance[n]:
                variance[n] = spread
                centre[n, 0] = warp[0] * out[6] + warp[1] * out[7]
                centre[n, 1] = warp[2] * out[6] + warp[3] * out[7]
            rho[n] = (rho[n] * weight + value / spread) / (weight + 1 / spread)
            weight += 1 / spread


@reordered_leaf
def _within(x, y, z, b, rho, width, height, border):
    """True if the view shows the point at inverse depth rho, and ``border`` px around it."""
    z += rho * b[2]
    if z <= 1e-6:
        return False
    u, v = (x + rho * b[0]) / z, (y + rho * b[1]) / z
    return border <= u <= width - 1 - border and border <= v <= height - 1 - border


@reordered_leaf
def _speed(x, y, z, b, rho):
    """Derivative of a point's position by its inverse depth: unit direction, and length [px m]."""
    over = 1 / (z + rho * b[2])
    u, v = (x + rho * b[0]) * over, (y + rho * b[1]) * over
    du, dv = (b[0] - u * b[2]) * over, (b[1] - v * b[2]) * over
    speed = max(np.sqrt(du * du + dv * dv), 1e-12)
    return du / speed, dv / speed, speed


@reordered_leaf
def _inverse_depth(x, y, z, b, u, v):
    """The inverse depth of a position near the line, from the image axis along which the line is longer."""
    du, dv = b[0] - u * b[2], b[1] - v * b[2]
    return (u * z - x) / du if abs(du) > abs(dv) else (v * z - y) / dv


@reordered_leaf
def _warped(flat, width, height, u, v, H, b, rho, corner, share, template, warp):
    """The template around (u, v) as a view sees it at inverse depth rho; see :func:`sampled`, which has the meaning of
    the four numbers ``warp``. False where it leaves the image or changes its scale too much."""
    z = H[2, 0] * u + H[2, 1] * v + H[2, 2] + rho * b[2]
    if z <= 1e-6:
        return False
    pu = (H[0, 0] * u + H[0, 1] * v + H[0, 2] + rho * b[0]) / z
    pv = (H[1, 0] * u + H[1, 1] * v + H[1, 2] + rho * b[1]) / z
    a, b_, c, d = H[0, 0] - pu * H[2, 0], H[0, 1] - pu * H[2, 1], H[1, 0] - pv * H[2, 0], H[1, 1] - pv * H[2, 1]
    determinant = a * d - b_ * c
    if not z * z / LARGEST_SCALE**2 < determinant < z * z * LARGEST_SCALE**2:
        return False
    over = z / determinant
    warp[0], warp[1], warp[2], warp[3] = d * over, -b_ * over, -c * over, a * over
    return sampled(flat, width, height, u, v, warp[0], warp[1], warp[2], warp[3], corner, share, template)


@reordered_leaf
def _search(patch, pixels, slot, width, height, x, y, z, b, low, high, windows, sums, scores, found):
    """Write the best window between two inverse depths to ``found``: its centre on the line (u, v), its ZNCC, and the
    ZNCC of its rival, the best window more than APART steps away. False where no window is inside the image. The view's
    image is that of the ``slot`` in ``pixels``; the three arguments before ``found`` are buffers."""
    z_low, z_high = z + low * b[2], z + high * b[2]
    if z_low <= 1e-3 or z_high <= 1e-3:
        return False
    u_low, v_low = (x + low * b[0]) / z_low, (y + low * b[1]) / z_low
    du, dv = (x + high * b[0]) / z_high - u_low, (y + high * b[1]) / z_high - v_low
    longest = max(abs(du), abs(dv))
    if not longest <= LONGEST:
        return False
    steps = max(int(np.ceil(longest)), 1)
    du, dv = du / steps, dv / steps
    starts, step, count = windows[0], windows[1], 0
    for s in range(steps + 1):
        left, top = int(np.floor(u_low + s * du + FIRST + 0.5)), int(np.floor(v_low + s * dv + FIRST + 0.5))
        if left >= 0 and top >= 0 and left + SIDE <= width and top + SIDE <= height:
            starts[count], step[count] = (slot * height + top) * width + left, s
            count += 1
    correlate(patch, pixels, starts, count, width, sums, scores)
    best, at = np.float32(-2), -1
    for w in range(count):
        if scores[w] > best:
            best, at = scores[w], step[w]
    if at < 0:
        return False
    rival = np.float32(-1)
    for w in range(count):
        if abs(step[w] - at) > APART and scores[w] > rival:
            rival = scores[w]
    found[0], found[1], found[2], found[3] = u_low + at * du, v_low + at * dv, best, rival
    return True

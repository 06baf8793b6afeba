"""Checks each anchor against its neighbours: which side of a depth edge it lies on, and whether it is an outlier.

A pixel of large gradient often lies on the edge of an object. The patch around it is matched as a whole, but the pixel
shows one of two surfaces. Neighbouring anchors of the same depth show on which side of the edge that surface lies.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ufmstar_torch.anchors.kernels.dense import Measured
from ufmstar_torch.kernels.compile_cpu import empty, reordered

# Two anchors agree within so many standard deviations of their difference, or within this share of the inverse depth.
_SIGMAS, _SHARE = 3.0, 0.05
# Share of wrong anchors in a frame. The probability that an anchor is wrong is proportional to the eighth power of the
# share of its neighbours that disagree, counted with one virtual neighbour that agrees.
_WRONG, _POWER = 0.026, 8
# A single match needs this number and this share of agreeing neighbours whose standard deviation is below this share of
# their inverse depth. A match with a larger standard deviation needs none.
_LEAST, _MOST, CERTAIN = 3, 0.9, 0.2
# The side of the surface is certain where the mean directions to agreeing and to other neighbours differ by this much
# along the gradient (2 = opposite); the pixel then moves to it by 1 px, or by 2 px where they differ by _FAR.
_APART, _FAR = 0.25, 1.0
# Half width of the window of the gradient [px]; neighbours lie within this number of cells from an anchor's cell.
_HALF, _CELLS = 2, 2


def check_anchors(
    image: NDArray[np.uint8], pixel: NDArray[np.float64], rho: NDArray[np.float64], variance: NDArray[np.float64],
    cell: int,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:  # fmt: skip
    """Move anchors onto their surfaces, and estimate the errors of outliers.

    Args:
        image: [H, W] uint8.
        pixel: [N, 2] (u, v), 3 px from the border or more.
        rho: [N] [1/m].
        variance: [N] of it [1/m^2].
        cell: side of a cell [px]; in a cell with two anchors, only the second is a neighbour of others.

    Returns:
        [N, 2] pixels on the surface, and [N] the expected squared error of ``rho`` [1/m^2]: the square of the product
        of the probability that the anchor is wrong and its RMS difference from disagreeing neighbours; 0 without any.
    """
    shape = (image.shape[0] // cell + 1, image.shape[1] // cell + 1)
    moved, squared_error, in_cell = pixel.copy(), np.zeros(len(pixel)), np.full(shape, -1, np.int64)
    _check_anchors(image, pixel, rho, variance, cell, in_cell, moved, squared_error)
    return moved, squared_error


def confirmed(
    pixel: NDArray[np.float64], measured: Measured, cell: int
) -> tuple[NDArray[np.bool_], tuple[int, int, int]]:
    """The mask of reliable measurements: two views agree, or nearly all neighbours agree with a single view, or a
    single view states a large error. A single match may be wrong, but neighbouring wrong matches have different depths,
    and with little parallax no match is far off. Without the last kind, the first views of a scene would measure only
    near surfaces.

    Args:
        pixel: [N, 2] (u, v).
        measured: N pixels.
        cell: side of a cell [px]; in a cell with two, only the second is a neighbour of others.

    Returns:
        [N]; the numbers of pixels with two or more matches, of the reliable ones of these, and of those that a view
        contradicts.
    """
    reliable = np.zeros(len(pixel), np.bool_)
    views = measured.agreed, measured.contradicted
    return reliable, _confirm(pixel, measured.rho, measured.variance, *views, cell, reliable)


def farther(pixel: NDArray[np.float64], occupied: NDArray[np.float64], distance: float) -> NDArray[np.bool_]:
    """Which pixels [N, 2] lie farther than a distance [px] from all ``occupied`` ones [M, 2]."""
    far = np.ones(len(pixel), np.bool_)
    _farther(pixel, occupied, distance * distance, far)
    return far


@reordered
def _farther(pixel, occupied, square, far):
    for n in range(len(pixel)):
        for m in range(len(occupied)):
            du, dv = pixel[n, 0] - occupied[m, 0], pixel[n, 1] - occupied[m, 1]
            if du * du + dv * dv <= square:
                far[n] = False
                break


@reordered
def _confirm(pixel, rho, variance, agreed, contradicted, cell, reliable):
    rows = columns = 0
    for n in range(len(pixel)):
        rows, columns = max(rows, int(pixel[n, 1]) // cell + 1), max(columns, int(pixel[n, 0]) // cell + 1)
    in_cell = empty((rows, columns), np.int64)
    in_cell[:] = -1
    for n in range(len(pixel)):
        if agreed[n] > 0 and contradicted[n] == 0:
            in_cell[int(pixel[n, 1]) // cell, int(pixel[n, 0]) // cell] = n
    for n in range(len(pixel)):
        reliable[n] = agreed[n] > 1 and contradicted[n] == 0
        if agreed[n] != 1 or contradicted[n] > 0:
            continue
        row, column = int(pixel[n, 1]) // cell, int(pixel[n, 0]) // cell
        agreeing = count = 0
        for j in range(max(row - _CELLS, 0), min(row + _CELLS + 1, in_cell.shape[0])):
            for i in range(max(column - _CELLS, 0), min(column + _CELLS + 1, in_cell.shape[1])):
                m = in_cell[j, i]
                if m < 0 or m == n:
                    continue
                count += 1
                limit = max(_SIGMAS**2 * (variance[n] + variance[m]), (_SHARE * rho[n]) ** 2)
                if (rho[m] - rho[n]) ** 2 < limit and variance[m] < (CERTAIN * rho[m]) ** 2:
                    agreeing += 1
        reliable[n] = agreeing >= _LEAST and agreeing >= _MOST * count
        reliable[n] |= variance[n] >= (CERTAIN * rho[n]) ** 2
    several = fine = disagree = 0
    for n in range(len(pixel)):
        several += agreed[n] + contradicted[n] > 1
        fine += agreed[n] + contradicted[n] > 1 and reliable[n]
        disagree += contradicted[n] > 0
    return several, fine, disagree


@reordered
def _check_anchors(image, pixel, rho, variance, cell, in_cell, moved, squared_error):
    differs = np.zeros(len(pixel))
    for n in range(len(pixel)):
        in_cell[int(pixel[n, 1]) // cell, int(pixel[n, 0]) // cell] = n
    for n in range(len(pixel)):
        u, v = pixel[n, 0], pixel[n, 1]
        agreeing_u = agreeing_v = other_u = other_v = 0.0
        count_agreeing = count_other = 0
        row, column = int(v) // cell, int(u) // cell
        for j in range(max(row - _CELLS, 0), min(row + _CELLS + 1, in_cell.shape[0])):
            for i in range(max(column - _CELLS, 0), min(column + _CELLS + 1, in_cell.shape[1])):
                m = in_cell[j, i]
                if m < 0 or m == n:
                    continue
                du, dv, difference = pixel[m, 0] - u, pixel[m, 1] - v, (rho[m] - rho[n]) ** 2
                over = 1 / max(np.sqrt(du * du + dv * dv), 1.0)
                if difference < max(_SIGMAS**2 * (variance[n] + variance[m]), (_SHARE * rho[n]) ** 2):
                    count_agreeing += 1
                    agreeing_u += du * over
                    agreeing_v += dv * over
                else:
                    count_other += 1
                    other_u += du * over
                    other_v += dv * over
                    squared_error[n] += difference
        if count_other == 0:
            continue
        squared_error[n] /= count_other
        differs[n] = (count_other / (count_agreeing + count_other + 1)) ** _POWER
        if count_agreeing == 0:
            continue
        eu, ev = _gradient(image, int(u + 0.5), int(v + 0.5))
        apart = (agreeing_u * eu + agreeing_v * ev) / count_agreeing - (other_u * eu + other_v * ev) / count_other
        if abs(apart) >= _APART:
            step = np.sign(apart) * (2.0 if abs(apart) >= _FAR else 1.0)
            moved[n, 0] += step * eu
            moved[n, 1] += step * ev
    mean_differs = max(differs.sum() / max(len(differs), 1), _WRONG)
    for n in range(len(pixel)):
        squared_error[n] *= (_WRONG * differs[n] / mean_differs) ** 2


@reordered
def _gradient(image, u, v):
    """Direction of the gradient around a pixel, of either sign: the structure tensor's main axis. 0 without one."""
    uu = uv = vv = 0.0
    for j in range(v - _HALF, v + _HALF + 1):
        for i in range(u - _HALF, u + _HALF + 1):
            du = np.float64(image[j, i + 1]) - np.float64(image[j, i - 1])
            dv = np.float64(image[j + 1, i]) - np.float64(image[j - 1, i])
            uu += du * du
            uv += du * dv
            vv += dv * dv
    if uu + vv == 0:
        return 0.0, 0.0
    angle = 0.5 * np.arctan2(2 * uv, uu - vv)
    return np.cos(angle), np.sin(angle)

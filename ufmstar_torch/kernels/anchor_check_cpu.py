"""Checks each anchor against its neighbours: which side of a depth edge it lies on, and whether it is an outlier.

A pixel of large gradient lies on an edge of a thing. The patch is matched as a whole, but the pixel shows one surface
or the other. Of the anchors around it, some have its depth: on their side of the edge is its surface.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ufmstar_torch.kernels.compile_cpu import reordered
from ufmstar_torch.kernels.dense_cpu import Measured

# Two anchors are alike within so many standard deviations of their difference, or this share of the inverse depth.
_SIGMAS, _SHARE = 3.0, 0.05
# Share of wrong anchors in a frame; they are those that differ from most of the anchors around them: each one's part of
# that share goes with the eighth power of the share of others around it, counted with one more that is alike.
_WRONG, _POWER = 0.026, 8
# Least number of neighbours that support a single match, their least share, and the largest standard deviation of one
# that does, as a share. A match beyond it needs no support.
_LEAST, _MOST, CERTAIN = 3, 0.9, 0.2
# A side is that of the surface where the mean directions of those alike and of the others differ by this much along the
# gradient (2 = opposite); the pixel then moves to it by 1 px, or by 2 px where they differ by _FAR.
_APART, _FAR = 0.25, 1.0
# Half width of the window of the gradient [px]; cells around an anchor's own that are asked.
_HALF, _CELLS = 2, 2


def check_anchors(
    image: NDArray[np.uint8],
    pixel: NDArray[np.float64],
    rho: NDArray[np.float64],
    variance: NDArray[np.float64],
    cell: int,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Positions of the surfaces of anchors, and bounds of their errors.

    Args:
        image: [H, W] uint8.
        pixel: [N, 2] (u, v), 3 px from the border or more.
        rho: [N] [1/m].
        variance: [N] of it [1/m^2].
        cell: side of a cell [px]; of two anchors in a cell, the second one counts for others.

    Returns:
        [N, 2] pixels on the surface, and [N] the square of the error of ``rho`` to expect [1/m^2]: the probability that
        the anchor is wrong times the root mean squared difference from the others around it; 0 without others.
    """
    shape = (image.shape[0] // cell + 1, image.shape[1] // cell + 1)
    moved, alone, lies_in = pixel.copy(), np.zeros(len(pixel)), np.full(shape, -1, np.int64)
    _check_anchors(image, pixel, rho, variance, cell, lies_in, moved, alone)
    return moved, alone


def confirmed(pixel: NDArray[np.float64], measured: Measured, cell: int) -> NDArray[np.bool_]:
    """Which measurements hold: those on which two views agree, those of one view that nearly all others around them
    support, and those of one view that state a large error themselves. A single match may be wrong; but wrong ones
    beside each other have different depths, and where there is little parallax no match is far off. Without the last
    kind, the first views of a place would measure its near surfaces alone.

    Args:
        pixel: [N, 2] (u, v).
        measured: N pixels.
        cell: side of a cell [px]; of two in a cell, the second one counts for others.
    """
    found = np.flatnonzero((measured.agreed > 0) & (measured.contradicted == 0))
    fine = (measured.agreed > 1) & (measured.contradicted == 0)
    lies_in = np.full((pixel.max(0, initial=0) // cell + 1).astype(np.int64)[::-1], -1)
    _confirm(pixel, measured.rho, measured.variance, found, cell, lies_in, fine)
    return fine


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
def _confirm(pixel, rho, variance, found, cell, lies_in, fine):
    for n in found:
        lies_in[int(pixel[n, 1]) // cell, int(pixel[n, 0]) // cell] = n
    for n in found:
        if fine[n]:
            continue
        row, column = int(pixel[n, 1]) // cell, int(pixel[n, 0]) // cell
        agreeing = count = 0
        for j in range(max(row - _CELLS, 0), min(row + _CELLS + 1, lies_in.shape[0])):
            for i in range(max(column - _CELLS, 0), min(column + _CELLS + 1, lies_in.shape[1])):
                m = lies_in[j, i]
                if m < 0 or m == n:
                    continue
                count += 1
                limit = max(_SIGMAS**2 * (variance[n] + variance[m]), (_SHARE * rho[n]) ** 2)
                if (rho[m] - rho[n]) ** 2 < limit and variance[m] < (CERTAIN * rho[m]) ** 2:
                    agreeing += 1
        fine[n] = agreeing >= _LEAST and agreeing >= _MOST * count
        fine[n] |= variance[n] >= (CERTAIN * rho[n]) ** 2


@reordered
def _check_anchors(image, pixel, rho, variance, cell, lies_in, moved, alone):
    differs = np.zeros(len(pixel))
    for n in range(len(pixel)):
        lies_in[int(pixel[n, 1]) // cell, int(pixel[n, 0]) // cell] = n
    for n in range(len(pixel)):
        u, v = pixel[n, 0], pixel[n, 1]
        alike_u = alike_v = other_u = other_v = 0.0
        count_alike = count_other = 0
        row, column = int(v) // cell, int(u) // cell
        for j in range(max(row - _CELLS, 0), min(row + _CELLS + 1, lies_in.shape[0])):
            for i in range(max(column - _CELLS, 0), min(column + _CELLS + 1, lies_in.shape[1])):
                m = lies_in[j, i]
                if m < 0 or m == n:
                    continue
                du, dv, difference = pixel[m, 0] - u, pixel[m, 1] - v, (rho[m] - rho[n]) ** 2
                over = 1 / max(np.sqrt(du * du + dv * dv), 1.0)
                if difference < max(_SIGMAS**2 * (variance[n] + variance[m]), (_SHARE * rho[n]) ** 2):
                    count_alike += 1
                    alike_u += du * over
                    alike_v += dv * over
                else:
                    count_other += 1
                    other_u += du * over
                    other_v += dv * over
                    alone[n] += difference
        if count_other == 0:
            continue
        alone[n] /= count_other
        differs[n] = (count_other / (count_alike + count_other + 1)) ** _POWER
        if count_alike == 0:
            continue
        eu, ev = _gradient(image, int(u + 0.5), int(v + 0.5))
        apart = (alike_u * eu + alike_v * ev) / count_alike - (other_u * eu + other_v * ev) / count_other
        if abs(apart) >= _APART:
            into = np.sign(apart) * (2.0 if abs(apart) >= _FAR else 1.0)
            moved[n, 0] += into * eu
            moved[n, 1] += into * ev
    usual = max(differs.sum() / max(len(differs), 1), _WRONG)
    for n in range(len(pixel)):
        alone[n] *= (_WRONG * differs[n] / usual) ** 2


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

"""Whitening and silhouettes of components, several at a time, as vector instructions: selects those in the image.

Components are in the camera's frame by field [13, stride] (``rigid_cpu``). Each number has the bits that scalar code
gives it: ``regress_near_cpu`` whitens by the same sums.
"""

from __future__ import annotations

import functools
import math

from ufmstar_torch.kernels.rigid_cpu import COVARIANCE, WEIGHT
from ufmstar_torch.kernels.vectors_cpu import vectors

# Rows of what is written: whitening (6), log2 of the peak, and the squared radius of the ellipsoid that counts, in
# standard deviations.
WHITENED, PEAK, SQUARE = 8, 6, 7
_SCALE = math.sqrt(0.5 * math.log2(math.e))
_exactly = functools.partial(vectors, joined=False)


def _covariance(code, components, stride, at, *entries):
    """Entries (i, j) of the covariance, and what is added to its diagonal."""
    S = [components.load(code.plus(at, code.times(stride, COVARIANCE + 4 * i))) for i in range(3)]
    rest = [components.load(code.plus(at, code.times(stride, COVARIANCE + 3 * i + j))) for i, j in entries]
    return S, S[0].at_least(S[1]).at_least(S[2]) * 1e-14, rest


@_exactly
def whiten(code, components, stride, n, whitened):
    """Write the inverse Cholesky factor (row by row, 6 numbers), so scaled that densities are powers of two, and weight
    over its determinant, of n components."""
    with code.loop(n, code.lanes) as at:
        (xx, yy, zz), least, (yx, zx, zy) = _covariance(code, components, stride, at, (1, 0), (2, 0), (2, 1))
        l00 = xx.at_least(least).root()
        l10, l20 = yx.over(l00), zx.over(l00)
        l11 = (yy - l10 * l10).at_least(least).root()
        l21 = (zy - l20 * l10).over(l11)
        l22 = (zz - l20 * l20 - l21 * l21).at_least(least).root()
        one = l00 * 0.0 + 1.0
        a, c, f = one.over(l00), one.over(l11), one.over(l22)
        b, e = (l10 * -1.0).over(l00 * l11), (l21 * -1.0).over(l11 * l22)
        d = ((l20 * a + l21 * b) * -1.0).over(l22)
        for row, value in enumerate((a, b, c, d, e, f)):
            whitened.store(value * _SCALE, code.plus(at, code.times(stride, row)))
        weight = components.load(code.plus(at, code.times(stride, WEIGHT)))
        whitened.store(weight.over(l00 * l11 * l22), code.plus(at, code.times(stride, PEAK)))


@_exactly
def meets(code, components, stride, n, whitened, view):
    """Set the squared radius to 0 of components whose ellipsoid (x - mu)^T S^-1 (x - mu) = square has no point in view.

    Its silhouette lies between the planes x = s z (and y = s z) that touch it, (mu_x - s mu_z)^2 =
    square (S_xx - 2 s S_xz + s^2 S_zz): a quadratic equation in s. One that reaches z = 0 may be anywhere.

    Args:
        view: [2, 3] along each axis focal length, centre and size of the image [px].
    """
    with code.loop(n, code.lanes) as at:
        (*diagonal, zz), least, mixed = _covariance(code, components, stride, at, (0, 2), (1, 2))
        place = code.plus(at, code.times(stride, SQUARE))
        square = whitened.load(place)
        *means, z = (components.load(code.plus(at, code.times(stride, axis))) for axis in range(3))
        depth, none = square * (zz + least), square * 0.0
        a, inside = z * z - depth, square
        for axis in range(2):
            x, half_b = means[axis], means[axis] * z - square * mixed[axis]
            root = (half_b * half_b - a * (x * x - square * (diagonal[axis] + least))).at_least(0.0).root()
            root = root + (half_b.size() + root) * 1e-9
            focal, centre, size = (view.one(3 * axis + i) for i in range(3))
            p, q = ((b.over(a) * focal + centre) for b in (half_b - root, half_b + root))
            inside = (p.at_least(q) * -1.0 > 1.0).select(none, inside)
            inside = (p.at_most(q) > size).select(none, inside)
        whole = a > depth * 1e-6  # else it reaches the camera's plane
        whitened.store(whole.select((z * -1.0 > 0.0).select(none, inside), square), place)

"""Exact intersections of rays with a tour's surfaces: closed forms in unit coordinates, in float64.

A ray is origin + t direction, in the unit coordinates of the surface (see ``shapes``). An affine map does not change t,
so with directions of camera z = 1, t is the depth. A miss is infinity.
"""

from __future__ import annotations

import torch
from torch import Tensor

from ufmstar_torch.eval.tour.shapes import BOX, ELLIPSOID, FRUSTUM, QUAD

Scalars = tuple[float, float, float] | tuple[Tensor, Tensor, Tensor]
Components = tuple[Tensor, Tensor, Tensor]

# Added to directions: makes the inverse of an exact 0 finite, and does not change others, which are above 1e-13.
_NOT_ZERO = 1e-30
_MISS = float("inf")


def entry(kind: int, origin: Scalars, direction: Components, taper: float) -> Tensor:
    """The ray parameter t > 0 at which rays first hit a unit shape (QUAD, BOX, ELLIPSOID or FRUSTUM with its ``taper``)
    from outside; infinity = miss. Origin and direction are x, y, z; the origin is common to all rays or one per ray."""
    return _ENTRIES[kind](origin, direction, taper)


def _quad(o: Scalars, d: Components, taper: float) -> Tensor:
    t = -o[1] / (d[1] + _NOT_ZERO)
    x, z = t * d[0] + o[0], t * d[2] + o[2]
    outside = torch.maximum(x.abs_(), z.abs_()) > 1
    return t.masked_fill_(outside | (t <= 0) | (d[1] <= 0), _MISS)


def _slab(o: float | Tensor, d: Tensor) -> tuple[Tensor, Tensor]:
    inverse = (d + _NOT_ZERO).reciprocal_()
    middle, reach = inverse * -o, inverse.abs()
    return middle - reach, middle + reach


def _box(o: Scalars, d: Components, taper: float) -> Tensor:
    near, far = _slab(o[0], d[0])
    for axis in (1, 2):
        a, b = _slab(o[axis], d[axis])
        near, far = torch.maximum(near, a, out=a), torch.minimum(far, b, out=b)
    return near.masked_fill_((near > far) | (near <= 0), _MISS)


def _ellipsoid(o: Scalars, d: Components, taper: float) -> Tensor:
    a = d[0] * d[0] + d[1] * d[1] + d[2] * d[2]
    b = d[0] * o[0] + d[1] * o[1] + d[2] * o[2]
    c = o[0] * o[0] + o[1] * o[1] + o[2] * o[2] - 1
    discriminant = b * b - a * c
    # From outside c > 0 and b < 0 towards the ball: c / (-b + root) is the nearer root without cancellation.
    t = c / (discriminant.clamp_min(0).sqrt_() - b)
    return t.masked_fill_((discriminant < 0) | (b >= 0), _MISS)


def _frustum(o: Scalars, d: Components, taper: float) -> Tensor:
    """x^2 + z^2 = (m + n y)^2 between the planes y = -1 and 1."""
    m, n = (1 + taper) / 2, (1 - taper) / 2
    radius = o[1] * n + m
    a = d[0] * d[0] + d[2] * d[2] - d[1] * d[1] * (n * n)
    b = d[0] * o[0] + d[2] * o[2] - d[1] * (radius * n)
    c = o[0] * o[0] + o[2] * o[2] - radius * radius
    discriminant = b * b - a * c
    root = discriminant.clamp_min(0).sqrt_()
    q = -(b + torch.copysign(root, b))  # both roots without cancellation: q / a and c / q
    best = torch.full_like(b, _MISS)
    for t in (q / (a + _NOT_ZERO), c / (q + _NOT_ZERO)):
        outside = (t * d[1] + o[1]).abs_() > 1
        best = torch.minimum(best, t.masked_fill(outside | (discriminant < 0) | (t <= 0), _MISS))
    inverse = (d[1] + _NOT_ZERO).reciprocal_()
    for y, r in ((-1.0, taper), (1.0, 1.0)):
        t = inverse * (y - o[1])
        x, z = t * d[0] + o[0], t * d[2] + o[2]
        outside = x * x + z * z > r * r
        best = torch.minimum(best, t.masked_fill(outside | (t <= 0), _MISS))
    return best


_ENTRIES = {QUAD: _quad, BOX: _box, ELLIPSOID: _ellipsoid, FRUSTUM: _frustum}

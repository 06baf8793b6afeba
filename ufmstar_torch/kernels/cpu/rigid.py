"""Changes of frame on the CPU (numba): components from one camera's frame into another's.

Products and sums are in the order of ``gaussians.fixed_order``, so that the results equal the reference's to
the last bit. Components in a camera's frame are stored by field, [13, n]: mean (3), covariance row by row (9) and
weight, so that a vector instruction handles several of them; n is padded (:func:`padded`).
"""

from __future__ import annotations

import functools

from ufmstar_torch.kernels.compile_cpu import leaf
from ufmstar_torch.kernels.cpu.vectors import LANES, vectors

FIELDS = 13  # of a component: mean (3), covariance (9), weight
COVARIANCE, WEIGHT = 3, 12  # the first field of the covariance, and the weight's


@leaf
def padded(n):
    """n, rounded up to a multiple of a vector loop's step: a loop over the remainder would take as long again."""
    return (n + LANES - 1) // LANES * LANES


@leaf
def relative(T_a, T_b, motion):
    """Write the motion (R, t) [3, 4] that takes points of camera a into camera b (``camera.relative_pose``)."""
    x, y, z = T_a[0, 3] - T_b[0, 3], T_a[1, 3] - T_b[1, 3], T_a[2, 3] - T_b[2, 3]
    for i in range(3):
        for j in range(3):
            motion[i, j] = T_b[0, i] * T_a[0, j] + T_b[1, i] * T_a[1, j] + T_b[2, i] * T_a[2, j]
        motion[i, 3] = T_b[0, i] * x + T_b[1, i] * y + T_b[2, i] * z


@leaf
def gather(n, mean, covariance, weight, fields):
    """Write the first n slots by field, and zeros after them up to the padded number."""
    for j in range(n):
        for i in range(3):
            fields[i, j] = mean[j, i]
            for axis in range(3):
                fields[COVARIANCE + 3 * i + axis, j] = covariance[j, i, axis]
        fields[WEIGHT, j] = weight[j]
    for j in range(n, padded(n)):
        for i in range(FIELDS):
            fields[i, j] = 0.0


@functools.partial(vectors, joined=False)
def turn(code, motion, n, stride, fields):
    """Move the first n columns, a multiple of a vector's length, of fields [13, stride] in place by (R, t) [3, 4]."""
    R = [[motion.one(4 * i + j) for j in range(4)] for i in range(3)]
    with code.loop(n, code.lanes) as column:
        at = [code.plus(column, code.times(stride, i)) for i in range(WEIGHT)]
        x, y, z, *S = (fields.load(row) for row in at)
        half = [[a * S[j] + b * S[3 + j] + c * S[6 + j] for j in range(3)] for a, b, c, _ in R]
        for i, (a, b, c, t) in enumerate(R):
            fields.store(a * x + b * y + c * z + t, at[i])
            for j, (d, e, f, _) in enumerate(R):
                fields.store(half[i][0] * d + half[i][1] * e + half[i][2] * f, at[COVARIANCE + 3 * i + j])


@leaf
def scatter(n, fields, mean, covariance):
    """Write mean and covariance of the first n columns of fields [13, n and more] to slots; inverse of
    :func:`gather`."""
    for j in range(n):
        for i in range(3):
            mean[j, i] = fields[i, j]
            for axis in range(3):
                covariance[j, i, axis] = fields[COVARIANCE + 3 * i + axis, j]

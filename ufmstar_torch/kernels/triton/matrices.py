"""Symmetric 3x3 matrices in registers: functions of ``ufmstar_torch.gaussians.gaussian`` for Triton kernels.

A symmetric matrix is stored as its upper triangle (xx, xy, xz, yy, yz, zz), a lower triangular one as its rows
(00, 10, 11, 20, 21, 22), any other as its nine entries, row by row. The entries are float64 blocks of one shape.
"""

from __future__ import annotations

import triton
import triton.language as tl

_SWEEPS = tl.constexpr(6)  # of cyclic Jacobi; gaussian._SWEEPS is enough, one more for safety


@triton.jit
def exact(number: tl.constexpr, like):
    """A constant in the dtype of ``like``. Triton 3.6 rounds a Python float to float32 in comparisons and maxima."""
    return tl.full([], number, like.dtype)


@triton.jit
def lowest_bit(mask):
    """Index of the lowest set bit of int64 ``mask`` (not 0, bits 0 to 62), and the mask without this bit."""
    low = mask & -mask
    return ((low.to(tl.float64).to(tl.int64, bitcast=True) >> 52) & 0x7FF) - 1023, mask ^ low


@triton.jit
def load_symmetric(pointer, mask):
    """The upper triangle of full matrices [..., 3, 3], contiguous, as float64."""
    xx = tl.load(pointer, mask=mask, other=0.0).to(tl.float64)
    xy = tl.load(pointer + 1, mask=mask, other=0.0).to(tl.float64)
    xz = tl.load(pointer + 2, mask=mask, other=0.0).to(tl.float64)
    yy = tl.load(pointer + 4, mask=mask, other=0.0).to(tl.float64)
    yz = tl.load(pointer + 5, mask=mask, other=0.0).to(tl.float64)
    zz = tl.load(pointer + 8, mask=mask, other=0.0).to(tl.float64)
    return xx, xy, xz, yy, yz, zz


@triton.jit
def store_symmetric(pointer, xx, xy, xz, yy, yz, zz, mask):
    """Write full matrices [..., 3, 3], contiguous."""
    tl.store(pointer, xx, mask=mask)
    tl.store(pointer + 1, xy, mask=mask)
    tl.store(pointer + 2, xz, mask=mask)
    tl.store(pointer + 3, xy, mask=mask)
    tl.store(pointer + 4, yy, mask=mask)
    tl.store(pointer + 5, yz, mask=mask)
    tl.store(pointer + 6, xz, mask=mask)
    tl.store(pointer + 7, yz, mask=mask)
    tl.store(pointer + 8, zz, mask=mask)


@triton.jit
def moved(R, t, x, y, z):
    """R (x, y, z) + t for R [3, 3] and t [3] in memory, summed in the order of ``fixed_order.apply``."""
    u = tl.load(R) * x + tl.load(R + 1) * y + tl.load(R + 2) * z + tl.load(t)
    v = tl.load(R + 3) * x + tl.load(R + 4) * y + tl.load(R + 5) * z + tl.load(t + 1)
    w = tl.load(R + 6) * x + tl.load(R + 7) * y + tl.load(R + 8) * z + tl.load(t + 2)
    return u, v, w


@triton.jit
def turned(R, xx, xy, xz, yy, yz, zz):
    """R S R^T for R [3, 3] in memory, in the order of ``fixed_order.congruence``."""
    a, b, c = tl.load(R), tl.load(R + 1), tl.load(R + 2)
    d, e, f = tl.load(R + 3), tl.load(R + 4), tl.load(R + 5)
    g, h, i = tl.load(R + 6), tl.load(R + 7), tl.load(R + 8)
    p0, p1, p2 = a * xx + b * xy + c * xz, a * xy + b * yy + c * yz, a * xz + b * yz + c * zz
    q0, q1, q2 = d * xx + e * xy + f * xz, d * xy + e * yy + f * yz, d * xz + e * yz + f * zz
    r0, r1, r2 = g * xx + h * xy + i * xz, g * xy + h * yy + i * yz, g * xz + h * yz + i * zz
    return (
        p0 * a + p1 * b + p2 * c, p0 * d + p1 * e + p2 * f, p0 * g + p1 * h + p2 * i,
        q0 * d + q1 * e + q2 * f, q0 * g + q1 * h + q2 * i, r0 * g + r1 * h + r2 * i,
    )  # fmt: skip


@triton.jit
def cholesky(xx, xy, xz, yy, yz, zz):
    """Lower Cholesky factor of a positive semidefinite matrix; a pivot within rounding errors sets its column to 0."""
    negligible = 16 * 2.220446049250313e-16 * tl.maximum(xx, tl.maximum(yy, zz))
    positive = xx > negligible
    root = tl.sqrt(tl.where(positive, xx, 1.0))
    l00, l10 = tl.where(positive, xx / root, 0.0), tl.where(positive, xy / root, 0.0)
    l20 = tl.where(positive, xz / root, 0.0)
    pivot = yy - l10 * l10
    positive = pivot > negligible
    root = tl.sqrt(tl.where(positive, pivot, 1.0))
    l11, l21 = tl.where(positive, pivot / root, 0.0), tl.where(positive, (yz - l20 * l10) / root, 0.0)
    pivot = zz - l20 * l20 - l21 * l21
    positive = pivot > negligible
    l22 = tl.where(positive, pivot / tl.sqrt(tl.where(positive, pivot, 1.0)), 0.0)
    return l00, l10, l11, l20, l21, l22


@triton.jit
def _angle(a0, a1, a2, b0, b1, b2):
    """Cosine and sine of the smaller rotation that makes columns a and b orthogonal."""
    gamma = a0 * b0 + a1 * b1 + a2 * b2
    zeta = (b0 * b0 + b1 * b1 + b2 * b2) - (a0 * a0 + a1 * a1 + a2 * a2)
    zeta = zeta / (2 * tl.where(gamma == 0, 1.0, gamma))
    t = tl.where(zeta < 0, -1.0, 1.0) / (tl.abs(zeta) + tl.sqrt(1 + zeta * zeta))
    t = tl.where(gamma == 0, 0.0, t)
    c = 1.0 / tl.sqrt(1 + t * t)
    return c, c * t


@triton.jit
def right_singular(m00, m01, m02, m10, m11, m12, m20, m21, m22):
    """Singular values (3, not sorted) and right singular vectors (columns of 9 entries) by one-sided Jacobi."""
    zero = m00 * 0.0
    one = zero + 1.0
    v00, v01, v02, v10, v11, v12, v20, v21, v22 = one, zero, zero, zero, one, zero, zero, zero, one
    for _ in range(_SWEEPS):
        c, s = _angle(m00, m10, m20, m01, m11, m21)
        m00, m01 = c * m00 - s * m01, s * m00 + c * m01
        m10, m11 = c * m10 - s * m11, s * m10 + c * m11
        m20, m21 = c * m20 - s * m21, s * m20 + c * m21
        v00, v01 = c * v00 - s * v01, s * v00 + c * v01
        v10, v11 = c * v10 - s * v11, s * v10 + c * v11
        v20, v21 = c * v20 - s * v21, s * v20 + c * v21
        c, s = _angle(m00, m10, m20, m02, m12, m22)
        m00, m02 = c * m00 - s * m02, s * m00 + c * m02
        m10, m12 = c * m10 - s * m12, s * m10 + c * m12
        m20, m22 = c * m20 - s * m22, s * m20 + c * m22
        v00, v02 = c * v00 - s * v02, s * v00 + c * v02
        v10, v12 = c * v10 - s * v12, s * v10 + c * v12
        v20, v22 = c * v20 - s * v22, s * v20 + c * v22
        c, s = _angle(m01, m11, m21, m02, m12, m22)
        m01, m02 = c * m01 - s * m02, s * m01 + c * m02
        m11, m12 = c * m11 - s * m12, s * m11 + c * m12
        m21, m22 = c * m21 - s * m22, s * m21 + c * m22
        v01, v02 = c * v01 - s * v02, s * v01 + c * v02
        v11, v12 = c * v11 - s * v12, s * v11 + c * v12
        v21, v22 = c * v21 - s * v22, s * v21 + c * v22
    s0 = tl.sqrt(m00 * m00 + m10 * m10 + m20 * m20)
    s1 = tl.sqrt(m01 * m01 + m11 * m11 + m21 * m21)
    s2 = tl.sqrt(m02 * m02 + m12 * m12 + m22 * m22)
    return s0, s1, s2, v00, v01, v02, v10, v11, v12, v20, v21, v22


@triton.jit
def floored(xx, xy, xz, yy, yz, zz, floor):
    """Raise the eigenvalues of a positive semidefinite matrix to ``floor``; unchanged if all are above."""
    s0, s1, s2, v00, v01, v02, v10, v11, v12, v20, v21, v22 = right_singular(xx, xy, xz, xy, yy, yz, xz, yz, zz)
    low = tl.minimum(s0, tl.minimum(s1, s2)) < floor
    s0, s1, s2 = tl.maximum(s0, floor), tl.maximum(s1, floor), tl.maximum(s2, floor)
    return (
        tl.where(low, v00 * s0 * v00 + v01 * s1 * v01 + v02 * s2 * v02, xx),
        tl.where(low, v00 * s0 * v10 + v01 * s1 * v11 + v02 * s2 * v12, xy),
        tl.where(low, v00 * s0 * v20 + v01 * s1 * v21 + v02 * s2 * v22, xz),
        tl.where(low, v10 * s0 * v10 + v11 * s1 * v11 + v12 * s2 * v12, yy),
        tl.where(low, v10 * s0 * v20 + v11 * s1 * v21 + v12 * s2 * v22, yz),
        tl.where(low, v20 * s0 * v20 + v21 * s1 * v21 + v22 * s2 * v22, zz),
    )


@triton.jit
def _solve_transposed(l00, l10, l11, l20, l21, l22, x0, x1, x2):
    """L^-T x."""
    y2 = x2 / l22
    y1 = (x1 - l21 * y2) / l11
    return (x0 - l10 * y1 - l20 * y2) / l00, y1, y2


@triton.jit
def geodesic(ax, ay, az, a0, a1, a2, a3, a4, a5, bx, by, bz, b0, b1, b2, b3, b4, b5, lam):
    """Mean (3) and covariance (6) of Gaussian a moved by ``lam`` towards b, and W2^2 between a and b."""
    l0, l1, l2, l3, l4, l5 = cholesky(a0, a1, a2, a3, a4, a5)
    k0, k1, k2, k3, k4, k5 = cholesky(b0, b1, b2, b3, b4, b5)
    s0, s1, s2, v00, v01, v02, v10, v11, v12, v20, v21, v22 = right_singular(
        k0 * l0 + k1 * l1 + k3 * l3, k1 * l2 + k3 * l4, k3 * l5,
        k2 * l1 + k4 * l3, k2 * l2 + k4 * l4, k4 * l5,
        k5 * l3, k5 * l4, k5 * l5,
    )  # fmt: skip
    shape = (a0 + a3 + a5) + (b0 + b3 + b5) - 2 * (s0 + s1 + s2)
    dx, dy, dz = ax - bx, ay - by, az - bz
    distance = dx * dx + dy * dy + dz * dz + tl.maximum(shape, 0.0)
    h00, h10, h20 = _solve_transposed(l0, l1, l2, l3, l4, l5, v00, v10, v20)
    h01, h11, h21 = _solve_transposed(l0, l1, l2, l3, l4, l5, v01, v11, v21)
    h02, h12, h22 = _solve_transposed(l0, l1, l2, l3, l4, l5, v02, v12, v22)
    rest = 1 - lam
    t0 = lam * (h00 * s0 * h00 + h01 * s1 * h01 + h02 * s2 * h02) + rest
    t1 = lam * (h00 * s0 * h10 + h01 * s1 * h11 + h02 * s2 * h12)
    t2 = lam * (h00 * s0 * h20 + h01 * s1 * h21 + h02 * s2 * h22)
    t3 = lam * (h10 * s0 * h10 + h11 * s1 * h11 + h12 * s2 * h12) + rest
    t4 = lam * (h10 * s0 * h20 + h11 * s1 * h21 + h12 * s2 * h22)
    t5 = lam * (h20 * s0 * h20 + h21 * s1 * h21 + h22 * s2 * h22) + rest
    # T L, so that T Sigma T^T = (T L)(T L)^T is symmetric by construction.
    m00, m01, m02 = t0 * l0 + t1 * l1 + t2 * l3, t1 * l2 + t2 * l4, t2 * l5
    m10, m11, m12 = t1 * l0 + t3 * l1 + t4 * l3, t3 * l2 + t4 * l4, t4 * l5
    m20, m21, m22 = t2 * l0 + t4 * l1 + t5 * l3, t4 * l2 + t5 * l4, t5 * l5
    return (
        rest * ax + lam * bx, rest * ay + lam * by, rest * az + lam * bz,
        m00 * m00 + m01 * m01 + m02 * m02, m00 * m10 + m01 * m11 + m02 * m12, m00 * m20 + m01 * m21 + m02 * m22,
        m10 * m10 + m11 * m11 + m12 * m12, m10 * m20 + m11 * m21 + m12 * m22, m20 * m20 + m21 * m21 + m22 * m22,
        distance,
    )  # fmt: skip

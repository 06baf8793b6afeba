"""Changes of frame on the CPU (numba): components from one camera's frame into another's.

Products and sums are in the order of ``ufmstar_torch.fixed_order``, so that the results equal the reference's to the
last bit.
"""

from __future__ import annotations

import numpy as np

from ufmstar_torch.kernels.compile_cpu import part


@part
def relative(T_a, T_b):
    """[3, 4] the motion (R, t) that takes points of camera a into camera b (``camera.relative_pose``)."""
    motion = np.empty((3, 4))
    x, y, z = T_a[0, 3] - T_b[0, 3], T_a[1, 3] - T_b[1, 3], T_a[2, 3] - T_b[2, 3]
    for i in range(3):
        for j in range(3):
            motion[i, j] = T_b[0, i] * T_a[0, j] + T_b[1, i] * T_a[1, j] + T_b[2, i] * T_a[2, j]
        motion[i, 3] = T_b[0, i] * x + T_b[1, i] * y + T_b[2, i] * z
    return motion


@part
def move(motion, mean, covariance, weight, first, changed, mean_out, covariance_out):
    """Write the moved mean [K, 3] and covariance [K, 3, 3] of occupied slots, before slot ``first`` only where
    ``changed`` [K] is True. What is not written stays as it is."""
    half = np.empty((3, 3))
    for k in range(weight.size):
        if not weight[k] > 0 or (k < first and not changed[k]):
            continue
        x, y, z = np.float64(mean[k, 0]), np.float64(mean[k, 1]), np.float64(mean[k, 2])
        S = covariance[k]
        for i in range(3):
            a, b, c = motion[i, 0], motion[i, 1], motion[i, 2]
            mean_out[k, i] = a * x + b * y + c * z + motion[i, 3]
            for j in range(3):
                half[i, j] = a * np.float64(S[0, j]) + b * np.float64(S[1, j]) + c * np.float64(S[2, j])
        for i in range(3):
            for j in range(3):
                value = half[i, 0] * motion[j, 0] + half[i, 1] * motion[j, 1] + half[i, 2] * motion[j, 2]
                covariance_out[k, i, j] = value

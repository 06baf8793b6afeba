"""Triangulation in NumPy, all tracks at once, from its derivation in ``ufmstar_torch/anchors/kernels/triangulate.py``;
imports neither torch nor the package."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

STEPS, DAMPING = 3, 1e-12  # Gauss-Newton steps; share of the normal matrix's trace that is added to its diagonal


class Triangulated(NamedTuple):
    """N points in world coordinates: position [N, 3] [m], covariance [N, 3, 3] [m^2] for a noise of one pixel, root
    mean square error [N] [px], and whether in front of every camera that saw it [N]."""

    point: NDArray[np.float64]
    covariance: NDArray[np.float64]
    error: NDArray[np.float64]
    ahead: NDArray[np.bool_]


def triangulate(
    pixel: NDArray[np.float64], seen: NDArray[np.bool_], T_world_cam: NDArray[np.float64], K: NDArray[np.float64]
) -> Triangulated:
    """Triangulate points from their positions in several views of one camera.

    Args:
        pixel: [N, W, 2] positions (u, v) [px].
        seen: [N, W] True where the position is valid; at least two per track.
        T_world_cam: [W, 4, 4] poses of the views.
        K: [3, 3] [px].
    """
    R, centre = T_world_cam[:, :3, :3], T_world_cam[:, :3, 3]
    # Relative to the mean camera, to keep digits far from the world's origin.
    origin = centre.mean(0)
    centre = centre - origin
    homogeneous = np.concatenate([pixel, np.ones((*pixel.shape[:2], 1))], axis=-1)
    rays = np.einsum("wij,nwj->nwi", R, homogeneous @ np.linalg.inv(K).T)
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    across = (np.eye(3) - rays[..., :, None] * rays[..., None, :]) * seen[..., None, None]
    point = _solve(across.sum(1), np.einsum("nwij,wj->ni", across, centre))
    for _ in range(STEPS):
        residual, J, _ = _reprojection(point, pixel, seen, R, centre, K)
        point = point - _solve(np.einsum("nwai,nwaj->nij", J, J), np.einsum("nwai,nwa->ni", J, residual))
    residual, J, z = _reprojection(point, pixel, seen, R, centre, K)
    information = np.einsum("nwai,nwaj->nij", J, J)
    return Triangulated(
        point=point + origin,
        covariance=np.linalg.inv(_damped(information)),
        error=np.sqrt(np.square(residual).sum((1, 2)) / np.maximum(2 * seen.sum(1), 1)),
        ahead=np.asarray(((z > 0) | ~seen).all(1), dtype=bool),
    )


def _reprojection(
    point: NDArray, pixel: NDArray, seen: NDArray, R: NDArray, centre: NDArray, K: NDArray
) -> tuple[NDArray, NDArray, NDArray]:
    """Residual [N, W, 2] [px], Jacobian [N, W, 2, 3] [px/m], both 0 where not seen, and depth z [N, W]."""
    cam = np.einsum("wji,nwj->nwi", R, point[:, None] - centre)
    x, y, z = np.moveaxis(cam, -1, 0)
    safe = np.where(np.abs(z) > 1e-9, z, 1e-9)
    fx, fy, skew, cx, cy = K[0, 0], K[1, 1], K[0, 1], K[0, 2], K[1, 2]
    u, v = (fx * x + skew * y) / safe + cx, fy * y / safe + cy
    zero = np.zeros_like(z)
    row_u = np.stack([fx / safe, skew / safe + zero, -(u - cx) / safe], axis=-1)
    row_v = np.stack([zero, fy / safe, -(v - cy) / safe], axis=-1)
    J = np.einsum("nwai,wji->nwaj", np.stack([row_u, row_v], axis=2), R) * seen[..., None, None]
    residual = (np.stack([u, v], axis=-1) - pixel) * seen[..., None]
    return residual, J, z


def _damped(normal: NDArray) -> NDArray:
    scale = np.maximum(np.trace(normal, axis1=-2, axis2=-1), np.finfo(np.float64).tiny)
    return normal + DAMPING * scale[:, None, None] * np.eye(3)


def _solve(normal: NDArray, right: NDArray) -> NDArray:
    return np.linalg.solve(_damped(normal), right[..., None])[..., 0]

"""Pinhole geometry: poses, projection of points and Gaussians, intrinsics under resize and crop.

Camera frame: x right, y down, z forward [m]. Intrinsics are in pixels with the centre of the first
pixel at (0, 0). Poses are camera-to-world, 4x4 (``T_world_cam``).
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ufmstar_torch.frames.arguments import require_float, require_number, require_size
from ufmstar_torch.gaussians.fixed_order import apply, congruence, product

# Newton-Schulz contracts a deviation e of R^T R from I to about 0.75 e^2. From the largest tolerance, 0.1, it reaches
# float64 rounding within five steps.
POLAR_STEPS = 6


def unproject(depth: Tensor, intrinsics: Tensor) -> Tensor:
    """Points of a depth map, x = ((u-cx)/fx d, (v-cy)/fy d, d) (section "Uncertainty Regression").

    Args:
        depth: [B, H, W] [m].
        intrinsics: [B, 3, 3] [px].

    Returns:
        [B, H, W, 3] points in the camera frame [m].
    """
    b, height, width = depth.shape
    index = torch.arange(height * width, device=depth.device).expand(b, -1)
    return unproject_at(depth.flatten(1), index, width, intrinsics).unflatten(1, (height, width))


def unproject_at(depth: Tensor, index: Tensor, width: int, intrinsics: Tensor) -> Tensor:
    """:func:`unproject` at some pixels, in the dtype of ``depth``.

    Args:
        depth: [B, N] of the pixels [m].
        index: [B, N] of the pixels in the flattened image.
        width: of the image [px].
        intrinsics: [B, 3, 3] [px].

    Returns:
        [B, N, 3] points in the camera frame [m].
    """
    fx, fy, cx, cy = (value.to(depth.dtype)[:, None] for value in focal_and_centre(intrinsics))
    u, v = index % width, index.div(width, rounding_mode="floor")
    return torch.stack([(u - cx) / fx * depth, (v - cy) / fy * depth, depth], dim=-1)


def focal_and_centre(intrinsics: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """fx, fy, cx, cy [px], each with the leading dimensions of ``intrinsics`` [..., 3, 3]."""
    return intrinsics[..., 0, 0], intrinsics[..., 1, 1], intrinsics[..., 0, 2], intrinsics[..., 1, 2]


def inverse_intrinsics(K: NDArray[np.float64]) -> NDArray[np.float64]:
    """The inverse of intrinsics [3, 3], whose last row is (0, 0, 1); LAPACK takes ten times as long."""
    (fx, skew, cx), (_, fy, cy), _ = K.tolist()
    return np.array([[1 / fx, -skew / (fx * fy), (skew * cy / fy - cx) / fx], [0, 1 / fy, -cy / fy], [0, 0, 1]])


def nearest_rotation(R: Tensor) -> Tensor:
    """The rotation nearest to an almost orthonormal R [..., 3, 3], in its own dtype (polar factor).

    Newton-Schulz, R <- R (3 I - R^T R) / 2, needs no decomposition and therefore no synchronisation with the device.
    It converges to the polar factor when |R^T R - I| is well below 1, which the callers check.
    """
    eye = torch.eye(3, dtype=R.dtype, device=R.device)
    for _ in range(POLAR_STEPS):
        R = product(R, 1.5 * eye - 0.5 * product(R.mT, R))
    return R


def rotation_deviation(R: Tensor) -> Tensor:
    """[...] max |R^T R - I| of R [..., 3, 3]: how far R is from a rotation or reflection."""
    eye = torch.eye(3, dtype=R.dtype, device=R.device)
    return (product(R.mT, R) - eye).abs().amax((-2, -1))


def invert_rigid(T: Tensor) -> Tensor:
    """The inverse [..., 4, 4] of rigid transforms [..., 4, 4], or without their last row [..., 3, 4]."""
    if not isinstance(T, Tensor) or T.shape[-2:] not in ((4, 4), (3, 4)):
        raise ValueError(f"T must be a tensor [..., 4, 4] or [..., 3, 4], got {getattr(T, 'shape', type(T).__name__)}")
    R_inv = T[..., :3, :3].mT
    t_inv = -apply(R_inv, T[..., :3, 3])
    last = T[..., 3:, :] if T.shape[-2] == 4 else T.new_tensor([[0, 0, 0, 1]]).expand(*T.shape[:-2], 1, 4)
    return torch.cat([torch.cat([R_inv, t_inv[..., None]], dim=-1), last], dim=-2)


def relative_pose(T_world_a: Tensor, T_world_b: Tensor) -> tuple[Tensor, Tensor]:
    """R_rel [..., 3, 3] and t_rel [..., 3] [m] that transform points from camera a to camera b.

    The translations are subtracted first, so that large world coordinates cancel before they are rotated.
    """
    R_b_world = T_world_b[..., :3, :3].mT
    R_rel = product(R_b_world, T_world_a[..., :3, :3])
    return R_rel, apply(R_b_world, T_world_a[..., :3, 3] - T_world_b[..., :3, 3])


def project_gaussian(mean_cam: Tensor, covariance_cam: Tensor, intrinsics: Tensor) -> tuple[Tensor, Tensor]:
    """Gaussians in the image plane (Eq. proj_to_image_plane_mean and _covar).

    Args:
        mean_cam: [B, K, 3] [m], z > 0 (callers mask Gaussians behind the near plane).
        covariance_cam: [B, K, 3, 3] [m^2].
        intrinsics: [B, 3, 3] [px].

    Returns:
        mean [B, K, 2] [px] and covariance A Sigma A^T [B, K, 2, 2] [px^2], A the Jacobian of the projection.
    """
    fx, fy, cx, cy = (value[:, None] for value in focal_and_centre(intrinsics))
    x, y, z = mean_cam.unbind(-1)
    mean = torch.stack([fx * x / z + cx, fy * y / z + cy], dim=-1)
    zero = torch.zeros_like(z)
    A = torch.stack([fx / z, zero, -fx * x / z**2, zero, fy / z, -fy * y / z**2], dim=-1).unflatten(-1, (2, 3))
    return mean, congruence(A, covariance_cam)


def resize_intrinsics(intrinsics: Tensor, old: tuple[int, int], new: tuple[int, int]) -> Tensor:
    """Intrinsics [..., 3, 3] after an image of ``old`` (H, W) was resized to ``new`` (H, W).

    Resizing maps the image's borders, half a pixel outside the first pixel's centre (0, 0), onto each other:
    u' + 1/2 = s (u + 1/2), so c' = s (c + 1/2) - 1/2 and f' = s f. OpenCV, Pillow and
    ``interpolate(align_corners=False)`` resample this way.

    Raises:
        TypeError, ValueError: no tensor, or a size is not (H, W) in positive numbers.
    """
    _require_matrix(intrinsics)
    old, new = require_size("old", old), require_size("new", new)
    sy, sx = new[0] / old[0], new[1] / old[1]
    scale = intrinsics.new_tensor([[sx, sx, sx], [sy, sy, sy], [1.0, 1.0, 1.0]])
    shift = intrinsics.new_tensor([[0.0, 0.0, (sx - 1) / 2], [0.0, 0.0, (sy - 1) / 2], [0.0, 0.0, 0.0]])
    return intrinsics * scale + shift


def crop_intrinsics(intrinsics: Tensor, top: int, left: int) -> Tensor:
    """Intrinsics [..., 3, 3] after ``top`` rows and ``left`` columns [px] were cut off (negative: padded)."""
    _require_matrix(intrinsics)
    x, y = require_number("left", left), require_number("top", top)
    shift = intrinsics.new_tensor([[0.0, 0.0, x], [0.0, 0.0, y], [0.0, 0.0, 0.0]])
    return intrinsics - shift


def _require_matrix(intrinsics: Tensor) -> None:
    """Raises TypeError, ValueError: no floating-point tensor [..., 3, 3]."""
    if require_float("intrinsics", intrinsics).shape[-2:] != (3, 3):
        raise ValueError(f"intrinsics must be [..., 3, 3], got {tuple(intrinsics.shape)}")


def camera_of(size: tuple[int, int]) -> Tensor:
    """[3, 3] intrinsics [px] of a camera with images of ``size`` (H, W), 53 degrees wide."""
    height, width = size
    return torch.tensor([[float(width), 0, width / 2], [0, float(width), height / 2], [0, 0, 1]])

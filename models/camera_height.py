"""Relative depth made metric by the camera's height above the ground.

A plane n . P = h (n its unit normal, pointing down; P = d r, r = ((u-cx)/fx, (v-cy)/fy, 1)) has inverse depth
1/d = (n . r) / h, which is linear in the ray r, and so is a prediction that is inverse depth up to scale and
shift. One plane determines:

- The scale, where the prediction at infinite distance is known (0: inverse depth up to scale). The plane's
  direction is estimated as well.
- Scale and shift, where the direction "up" is known exactly (an accelerometer, a calibrated mount, the pose of
  a gravity-aligned SLAM): the horizon is where inverse depth is 0. Without it a shift looks just like a tilt
  of the plane, since the third component of r is 1 everywhere.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from ufmstar_torch.camera import unproject
from ufmstar_torch.models.alignment import KINDS, Alignment, require_each, require_maps
from ufmstar_torch.models.robust_fit import robust_fit

# [rad] The ground is looked for 10 degrees and more below the horizon, nearer than six heights away.
_BELOW_HORIZON = math.radians(10)


@dataclass(frozen=True, eq=False)
class GroundFit:
    """An alignment with the ground plane it comes from."""

    alignment: Alignment  # one for each image, or a single one if pooled
    down_cam: Tensor  # [B, 3] the ground's unit normal, downwards, in the camera frame (x right, y down, z forward)
    ground: Tensor  # [B, H, W] bool, the pixels taken for ground


def align_to_camera_height(
    prediction: Tensor,
    intrinsics: Tensor,
    height_m: float,
    *,
    kind: str = "inverse",
    at_infinity: float | None = 0.0,
    up_cam: Tensor | None = None,
    valid: Tensor | None = None,
    pooled: bool = False,
    max_tilt_deg: float = 20.0,
    tolerance: float = 0.03,
    min_share: float = 0.3,
    max_depth: float | None = None,
    seed: int = 0,
) -> GroundFit:
    """Scale (and shift) such that the ground lies ``height_m`` below the camera.

    It assumes that the ground is flat and the largest plane about that far from level in the lower part of
    the image: a table in front of a robot, or a ramp, is taken for it. Look at ``ground``.

    Args:
        prediction: [B, H, W] as the network returns it.
        intrinsics: [B, 3, 3] or [3, 3] of ``prediction`` [px].
        height_m: [m] of the camera's centre above the ground, along the ground's normal.
        kind: "inverse", or "affine" for depth up to scale.
        at_infinity: the prediction at infinite distance (in the open, that of the sky), 0 for inverse depth up
            to scale; None = estimated with ``up_cam``. Not with "affine", which is up to scale here.
        up_cam: [3] or [B, 3] upwards in the camera frame (R_world_cam^T e_z in a world with z up). None: a level
            camera, (0, -1, 0), as a first guess.
        valid: [B, H, W] bool, where ground is looked for; None = wherever the camera looks 10 degrees or more
            below the horizon.
        pooled: one alignment, the median over the images, as UfM* needs it, instead of one for each.
        max_tilt_deg: [deg] largest angle between the ground's normal and ``up_cam``; not used if that is exact.
        tolerance: relative error of inverse depth up to which a pixel belongs to the plane; not used with
            ``at_infinity=None``, where more than half of the pixels looked at must be ground.
        min_share: less ground than this among the pixels looked at is an error.
        max_depth: [m] of the resulting alignment.
        seed: of the robust fit's samples.

    Raises:
        ValueError: wrong shapes, values out of range, or no such plane; the image is named.
    """
    require_maps("prediction", prediction)
    _require_options(kind, height_m, at_infinity, up_cam, max_tilt_deg, tolerance, min_share)
    x = prediction.detach().double().flatten(1)
    rays = _rays(prediction, intrinsics)
    down = _down(up_cam, len(x), x)
    predicted = x.isfinite() & (x > (-math.inf if at_infinity is None else at_infinity))
    use = _searched(prediction, valid, rays, down) & predicted
    count = use.sum(1)
    require_each(count >= 10, count, "needs at least 10 pixels that look at the ground with a prediction, has")
    if at_infinity is None:
        reciprocal, infinity, inlier = _line(x, rays, down, use, seed)
    else:
        y = torch.where(use, x - at_infinity if kind == "inverse" else 1 / x, 1)
        reciprocal, down, inlier = _plane(y, rays, down, use, max_tilt_deg, tolerance, seed)
        infinity = torch.full_like(reciprocal, at_infinity)
    share = inlier.sum(1) / count
    lacking = f"shows no ground plane on {min_share:.0%} of the pixels looked at; the share is"
    require_each(share >= min_share, share, lacking)
    alignment = _alignment(kind, reciprocal, infinity, height_m, pooled, max_depth)
    return GroundFit(alignment, down, inlier.view(prediction.shape))


def _rays(prediction: Tensor, intrinsics: Tensor) -> Tensor:
    """[B, P, 3] float64, third component 1."""
    batch = len(prediction)
    if tuple(intrinsics.shape) not in ((3, 3), (batch, 3, 3)):
        raise ValueError(f"intrinsics must be [3, 3] or [{batch}, 3, 3], got {tuple(intrinsics.shape)}")
    K = intrinsics.to(prediction.device, torch.float64).expand(batch, 3, 3)
    return unproject(torch.ones_like(prediction, dtype=torch.float64), K).flatten(1, 2)


def _searched(prediction: Tensor, valid: Tensor | None, rays: Tensor, down: Tensor) -> Tensor:
    """[B, P] bool, where ground is looked for."""
    if valid is None:
        return (rays @ down[..., None])[..., 0] > math.sin(_BELOW_HORIZON) * rays.norm(dim=-1)
    if valid.dtype != torch.bool or valid.shape != prediction.shape:
        raise ValueError(f"valid must be bool {tuple(prediction.shape)}, got {valid.dtype} {tuple(valid.shape)}")
    return valid.flatten(1)


def _alignment(
    kind: str, reciprocal: Tensor, infinity: Tensor, height_m: float, pooled: bool, max_depth: float | None
) -> Alignment:
    """The alignment with which planes y = (n . r) / h' lie ``height_m`` below: y has slope 1/h' [B] (``reciprocal``) in
    the prediction's units, and 1/d = scale y must have slope 1/height; ``infinity`` [B]: the prediction there."""
    scale = 1 / (reciprocal * height_m) if kind == "inverse" else reciprocal * height_m
    if pooled:
        scale, infinity = scale.median(), infinity.median()
    return Alignment(kind, scale, -scale * infinity if kind == "inverse" else torch.zeros_like(scale), max_depth)


def _plane(
    y: Tensor, rays: Tensor, down: Tensor, use: Tensor, max_tilt_deg: float, tolerance: float, seed: int
) -> tuple[Tensor, Tensor, Tensor]:
    """1/h' [B], the normal [B, 3] and the inliers [B, P] of y = (n . r) / h'."""
    cosine = math.cos(math.radians(max_tilt_deg))

    def level_enough(m: Tensor) -> Tensor:
        towards = down if m.dim() == 2 else down[:, None]
        return (m * towards).sum(-1) >= cosine * m.norm(dim=-1)

    fit = robust_fit(
        rays, y, use, torch.ones_like(y), tolerance=tolerance * y.abs(), admissible=level_enough, seed=seed
    )
    size = fit.theta.norm(dim=-1)
    fine = fit.determined & (size > 0) & level_enough(fit.theta)
    require_each(fine, size, "shows no plane within max_tilt_deg of level; the best plane's 1/h is")
    return size, fit.theta / size[:, None], fit.inlier


def _line(x: Tensor, rays: Tensor, down: Tensor, use: Tensor, seed: int) -> tuple[Tensor, Tensor, Tensor]:
    """1/h' [B], x at infinity [B] and the inliers [B, P] of x = (n . r) / h' + x_infinity, n known."""
    below = (rays @ down[..., None])[..., 0]
    design = torch.stack([below, torch.ones_like(below)], -1)
    fit = robust_fit(design, torch.where(use, x, 0), use, torch.ones_like(x), seed=seed)
    slope, infinity = fit.theta.unbind(1)
    fine = fit.determined & (slope > 0)
    require_each(fine, slope, "does not grow downwards as inverse depth of a ground would; slope")
    return slope, infinity, fit.inlier


def _down(up_cam: Tensor | None, batch: int, like: Tensor) -> Tensor:
    """[B, 3] unit vectors."""
    up = like.new_tensor([0.0, -1.0, 0.0]) if up_cam is None else up_cam.to(like)
    if tuple(up.shape) not in ((3,), (batch, 3)):
        raise ValueError(f"up_cam must be [3] or [{batch}, 3], got {tuple(up.shape)}")
    size = up.norm(dim=-1, keepdim=True)
    if not ((size > 0) & size.isfinite()).all():
        raise ValueError(f"up_cam must be a direction, got {up.tolist()}")
    return (-up / size).expand(batch, 3)


def _require_options(
    kind: str,
    height_m: float,
    at_infinity: float | None,
    up_cam: Tensor | None,
    max_tilt_deg: float,
    tolerance: float,
    min_share: float,
) -> None:
    """Raises ValueError for the first option that is out of range or contradicts another."""
    if kind not in KINDS:
        raise ValueError(f"kind must be one of {KINDS}, got {kind!r}")
    if not 0 < height_m < math.inf:
        raise ValueError(f"height_m must be positive metres, got {height_m}")
    if kind == "affine" and at_infinity != 0:
        raise ValueError(f"at_infinity must be 0 for kind 'affine', as no plane fixes its shift, got {at_infinity}")
    if at_infinity is None and up_cam is None:
        raise ValueError(
            "one height gives one number: with at_infinity=None the exact up_cam is needed, since without it an "
            "unknown shift looks like a tilt of the ground"
        )
    limits = {"max_tilt_deg": (max_tilt_deg, 90), "tolerance": (tolerance, 1), "min_share": (min_share, 1)}
    for name, (value, limit) in limits.items():
        if not 0 < value < limit:
            raise ValueError(f"{name} must be between 0 and {limit}, got {value}")

"""Random augmentation of training frames: image, depth and intrinsics together, from a seed.

FastDepth's augmentation of NYU Depth V2 (scale 1 to 1.5 with the depth divided by it, rotation by up to 5 degrees,
flip, colour jitter .4; its code discards the rotated image, this one applies it). The result is the view of another
pinhole camera at the same position: rolled about its optical axis, mirrored, zoomed, and shifted in its image plane. So
its intrinsics are exact, and depths stay depths along the optical axis.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ufmstar_torch.runtime.checked import Checked, choice, number


@dataclass(frozen=True)
class AugmentationConfig(Checked):
    """Ranges of the augmentation of a frame, each sampled uniformly.

    Attributes:
        scale: range of the zoom factor s, at least 1, so that the image has no borders.
        rotation: largest rotation about the image's centre, in both directions. Corners from outside the image are
            black and have no depth.
        flip: probability of a mirrored image.
        crop: part of the zoomed image: "centre", or anywhere, "random".
        zoom: meaning of a zoom. "depth": the camera is unchanged and everything is s times nearer, so depth is divided
            by s (FastDepth): for a network without intrinsics as input, which learns the relation of size and depth for
            one camera. "focal": the focal length is s times longer and depth is unchanged (exact optics, but another
            camera).
        brightness, contrast, saturation: range x of the factor, 1 - x to 1 + x; applied in random order.

    Raises:
        ValueError: an invalid value; the message names the field.
    """

    scale: tuple[float, float] = (1.0, 1.5)
    rotation: float = number(5.0, "angle", "degrees", 0, 180)
    flip: float = number(0.5, "p", "1", 0, 1)
    crop: str = choice("centre", "random")
    zoom: str = choice("depth", "focal")
    brightness: float = number(0.4, "x", "1", 0, 1)
    contrast: float = number(0.4, "x", "1", 0, 1)
    saturation: float = number(0.4, "x", "1", 0, 1)

    def __post_init__(self) -> None:
        super().__post_init__()
        if len(self.scale) != 2 or not 1 <= self.scale[0] <= self.scale[1] < math.inf:
            raise ValueError(f"AugmentationConfig.scale must be (low, high), 1 <= low <= high, got {self.scale}")


@dataclass(frozen=True)
class Change:
    """One sample of the augmentation."""

    scale: float = 1.0  # zoom factor s
    angle: float = 0.0  # [rad] roll of the camera
    flip: bool = False  # mirrored or not
    shift: tuple[float, float] = (0.0, 0.0)  # [px] (right, down) of the zoomed content
    colour: tuple[tuple[str, float], ...] = ()  # (kind, factor) in the order of application; kinds as in the config


class Augmentation:
    """A random change of a frame with the ranges of ``config``, which depends only on the seed."""

    def __init__(self, config: AugmentationConfig | None = None) -> None:
        self.config = config or AugmentationConfig()

    def __call__(
        self, image: Tensor, depth: Tensor, intrinsics: Tensor, seed: tuple[int, ...]
    ) -> tuple[Tensor, Tensor, Tensor]:
        """An augmented copy, of the same size, of image [3, H, W] floating-point in [0, 1], depth [H, W] [m], 0 = none,
        and intrinsics [3, 3] float64 [px]; depth is 0 outside the original image. ``seed``: whole numbers >= 0, for
        example (seed, epoch, index)."""
        height, width = depth.shape
        change = draw(self.config, seed, height, width)
        new_image, new_depth, K = apply_geometry(image, depth, intrinsics, change, self.config.zoom)
        return apply_colour(new_image, change.colour), new_depth, K


def draw(config: AugmentationConfig, seed: tuple[int, ...], height: int, width: int) -> Change:
    """Sample the change of a frame of height x width [px]."""
    rng = np.random.default_rng(seed)
    scale = rng.uniform(*config.scale)
    angle = math.radians(rng.uniform(-config.rotation, config.rotation))
    flip = bool(rng.random() < config.flip)
    room = (scale - 1) / 2 * np.array([width, height]) if config.crop == "random" else np.zeros(2)
    shift = rng.uniform(-1, 1, 2) * room
    factors = [(name, float(1 + getattr(config, name) * rng.uniform(-1, 1))) for name in _COLOUR]
    colour = tuple(factors[i] for i in rng.permutation(len(factors)) if getattr(config, factors[i][0]) > 0)
    return Change(float(scale), angle, flip, (float(shift[0]), float(shift[1])), colour)


def camera_change(intrinsics: Tensor, change: Change, height: int, width: int, zoom: str) -> tuple[Tensor, Tensor]:
    """The map of the pixels, p' = A p + b, and the corresponding intrinsics K'.

    With K = (L, c), L its upper left 2x2 part, c the principal point, a point at x = (X/Z, Y/Z) projects to
    p = L x + c. The new camera is rolled by R and mirrored by F, so A = s F L R L^-1. The image's centre m moves by the
    shift t only, hence c' = A (c - m) + m + t. L' = F L F, times s for zoom "focal"; for zoom "depth" the points are
    nearer instead: (F R (X, Y), Z / s) projects by K' to p'. Returns [2, 3] (A, b) and [3, 3] K', float64, for
    ``intrinsics`` [3, 3] float64 of an image of height x width [px].
    """
    L, c = intrinsics[:2, :2], intrinsics[:2, 2]
    m = intrinsics.new_tensor([(width - 1) / 2, (height - 1) / 2])
    cos, sin = math.cos(change.angle), math.sin(change.angle)
    R = intrinsics.new_tensor([[cos, -sin], [sin, cos]])
    F = intrinsics.new_tensor([[-1.0 if change.flip else 1.0, 0.0], [0.0, 1.0]])
    A = change.scale * F @ L @ R @ torch.linalg.inv(L)
    centre = m + intrinsics.new_tensor(change.shift)
    K = torch.eye(3, dtype=intrinsics.dtype)
    K[:2, :2] = F @ L @ F * (change.scale if zoom == "focal" else 1.0)
    K[:2, 2] = A @ (c - m) + centre
    return torch.cat([A, (centre - A @ m)[:, None]], dim=1), K


def apply_geometry(
    image: Tensor, depth: Tensor, intrinsics: Tensor, change: Change, zoom: str = "depth"
) -> tuple[Tensor, Tensor, Tensor]:
    """Warp a frame to the changed camera: colour bilinearly, depth from the nearest pixel.

    Shapes as in :meth:`Augmentation.__call__`.
    """
    from kornia.geometry.transform import warp_affine  # lazy: takes a second

    height, width = depth.shape
    M, K = camera_change(intrinsics, change, height, width, zoom)

    def warp(x: Tensor, mode: str) -> Tensor:  # align_corners: coordinates of pixel centres, as here
        return warp_affine(x[None], M[None].to(x.dtype), (height, width), mode=mode, align_corners=True)[0]

    new_depth = warp(depth[None], "nearest")[0]
    return warp(image, "bilinear"), new_depth / change.scale if zoom == "depth" else new_depth, K


def apply_colour(image: Tensor, colour: tuple[tuple[str, float], ...]) -> Tensor:
    """Brightness, contrast and saturation of an image [3, H, W], as defined by torchvision and Pillow.

    kornia's functions with long names follow that definition; its ``adjust_brightness`` adds instead of multiplying.
    (torchvision.transforms.v2 cannot replace ``apply_geometry``: its affine transform has no mirror, and no rotation
    for pixels that are not square.)
    """
    from kornia import enhance

    adjust = {
        "brightness": enhance.adjust_brightness_accumulative,
        "contrast": enhance.adjust_contrast_with_mean_subtraction,
        "saturation": enhance.adjust_saturation_with_gray_subtraction,
    }
    for name, factor in colour:
        image = adjust[name](image, factor)
    return image


_COLOUR = ("brightness", "contrast", "saturation")

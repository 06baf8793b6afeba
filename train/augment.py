"""Random changes of training frames: image, depth and intrinsics together, drawn from a seed.

FastDepth's augmentation of NYU Depth V2 (scale 1 to 1.5 with the depth divided by it, rotation by up to 5
degrees, flip, colour jitter .4; its code draws the rotation and then discards the rotated image, here it is
applied). The changed frame is what another pinhole camera would see from the same place: rolled about its
optical axis, mirrored, zoomed, and shifted in its image plane. So its intrinsics are known exactly, and a
depth along the optical axis stays one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ufmstar_torch.checked import Checked, choice, number


@dataclass(frozen=True)
class AugmentationConfig(Checked):
    """Ranges from which the changes of a frame are drawn, each uniformly.

    Attributes:
        scale: range of the zoom factor s, at least 1, so that no border comes into the image.
        rotation: the image rotates by up to this, either way, about its centre. Corners from outside are black and
            have no depth.
        flip: probability of a mirrored image.
        crop: which part of the zoomed image is kept: "centre", or anywhere, "random".
        zoom: meaning of a zoom. "depth": the camera stays as it is and everything is s times nearer, so depth is
            divided by s (FastDepth): right for a network that has no intrinsics as input and has to learn one camera's
            relation of size and depth. "focal": the camera's focal length is s times as long and depth stays (exact
            optics, but another camera).
        brightness, contrast, saturation: range x of the factor, 1 - x to 1 + x; applied in random order.

    Raises:
        ValueError: a value is impossible; the message names the field.
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
    """One draw."""

    scale: float = 1.0  # zoom factor s
    angle: float = 0.0  # [rad] by which the camera is rolled
    flip: bool = False  # mirrored or not
    shift: tuple[float, float] = (0.0, 0.0)  # [px] (right, down) of the zoomed content
    colour: tuple[tuple[str, float], ...] = ()  # (kind, factor) in the order of application; kinds as in the config


class Augmentation:
    """A random change of a frame, drawn as ``config`` has it, that depends on nothing but the numbers of its seed."""

    def __init__(self, config: AugmentationConfig | None = None) -> None:
        self.config = config or AugmentationConfig()

    def __call__(
        self, image: Tensor, depth: Tensor, intrinsics: Tensor, seed: tuple[int, ...]
    ) -> tuple[Tensor, Tensor, Tensor]:
        """A changed copy, at the same size, of image [3, H, W] floating-point in [0, 1], depth [H, W] [m], 0 = none,
        and intrinsics [3, 3] float64 [px]; depth is 0 where the frame shows nothing. ``seed``: whole numbers >= 0, such
        as (seed, epoch, index)."""
        height, width = depth.shape
        change = draw(self.config, seed, height, width)
        new_image, new_depth, K = apply_geometry(image, depth, intrinsics, change, self.config.zoom)
        return apply_colour(new_image, change.colour), new_depth, K


def draw(config: AugmentationConfig, seed: tuple[int, ...], height: int, width: int) -> Change:
    """The change of a frame of height x width [px] with this seed."""
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
    """The map of the pixels, p' = A p + b, and the intrinsics K' that belong to it.

    With K = (L, c), L its upper left 2x2 part, c the principal point, a point at x = (X/Z, Y/Z) is seen at
    p = L x + c. The new camera is rolled by R and mirrored by F, so A = s F L R L^-1. The image's centre m stays
    where it is but for the shift t, hence c' = A (c - m) + m + t. And L' = F L F, times s where the zoom is
    focal; else the points have come nearer: (F R (X, Y), Z / s) projects by K' to p'. Returns [2, 3] (A, b) and
    [3, 3] K', float64, for ``intrinsics`` [3, 3] float64 of an image of height x width [px].
    """
    L, c = intrinsics[:2, :2], intrinsics[:2, 2]
    m = intrinsics.new_tensor([(width - 1) / 2, (height - 1) / 2])
    cos, sin = math.cos(change.angle), math.sin(change.angle)
    R = intrinsics.new_tensor([[cos, -sin], [sin, cos]])
    F = intrinsics.new_tensor([[-1.0 if change.flip else 1.0, 0.0], [0.0, 1.0]])
    A = change.scale * F @ L @ R @ torch.linalg.inv(L)
    to = m + intrinsics.new_tensor(change.shift)
    K = torch.eye(3, dtype=intrinsics.dtype)
    K[:2, :2] = F @ L @ F * (change.scale if zoom == "focal" else 1.0)
    K[:2, 2] = A @ (c - m) + to
    return torch.cat([A, (to - A @ m)[:, None]], dim=1), K


def apply_geometry(
    image: Tensor, depth: Tensor, intrinsics: Tensor, change: Change, zoom: str = "depth"
) -> tuple[Tensor, Tensor, Tensor]:
    """The frame that the changed camera sees: colour bilinear, depth from the nearest pixel, never mixed.

    Shapes as in :meth:`Augmentation.__call__`.
    """
    from kornia.geometry.transform import warp_affine  # a second of import time, at the first call only

    height, width = depth.shape
    M, K = camera_change(intrinsics, change, height, width, zoom)

    def warp(x: Tensor, mode: str) -> Tensor:  # align_corners: coordinates count from pixel centres, as ours do
        return warp_affine(x[None], M[None].to(x.dtype), (height, width), mode=mode, align_corners=True)[0]

    new_depth = warp(depth[None], "nearest")[0]
    return warp(image, "bilinear"), new_depth / change.scale if zoom == "depth" else new_depth, K


def apply_colour(image: Tensor, colour: tuple[tuple[str, float], ...]) -> Tensor:
    """Brightness, contrast and saturation [3, H, W] as torchvision and Pillow define them.

    Those are kornia's functions with the long names; its ``adjust_brightness`` adds instead of multiplying.
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

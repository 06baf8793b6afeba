"""Random augmentation of a batch on its device by kornia: image, depth and intrinsics together.

FastDepth's augmentation of NYU Depth V2: scale 1 to 1.5 with the depth divided by it, rotation by up to 5 degrees (its
code discards the rotated image, this one applies it), flip, colours by up to .4. kornia draws the parameters on the CPU
from torch's generator, whose seed decides the samples, and copies them to the device without waiting for it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from ufmstar_torch.runtime.checked import Checked, choice, number
from ufmstar_torch.runtime.kinds import check_fields


@dataclass(frozen=True)
class AugmentationConfig(Checked):
    """Ranges of the augmentation, each sampled uniformly for every image.

    Attributes:
        scale: range of the zoom factor s, at least 1, so that the image has no borders.
        rotation: largest rotation about the image's centre, in both directions. Corners from outside the image are
            black and have no depth.
        flip: probability of a mirrored image.
        zoom: meaning of a zoom. "depth": the camera is unchanged and everything is s times nearer, so depth is divided
            by s (FastDepth): for a network without intrinsics as input, which learns the relation of size and depth for
            one camera. "focal": the focal length is s times longer and depth is unchanged (exact optics, but another
            camera).
        brightness, contrast, saturation: range x of the factor, 1 - x to 1 + x; applied in this order.

    Raises:
        ValueError: an invalid value; the message names the field.
    """

    scale: tuple[float, float] = (1.0, 1.5)
    rotation: float = number(5.0, "angle", "degrees", 0, 180)
    flip: float = number(0.5, "p", "1", 0, 1)
    zoom: str = choice("depth", "focal")
    brightness: float = number(0.4, "x", "1", 0, 1)
    contrast: float = number(0.4, "x", "1", 0, 1)
    saturation: float = number(0.4, "x", "1", 0, 1)

    def __post_init__(self) -> None:
        check_fields(self)
        super().__post_init__()
        if len(self.scale) != 2 or not 1 <= self.scale[0] <= self.scale[1] < math.inf:
            raise ValueError(f"AugmentationConfig.scale must be (low, high), 1 <= low <= high, got {self.scale}")


class Augmentation:
    """A random change of every image of a batch, with the ranges of ``config``.

    Attributes:
        transform: kornia's ``AugmentationSequential``; its ``transform_matrix`` [B, 3, 3] maps the pixels of the last
            batch, p' = M p.
    """

    def __init__(self, config: AugmentationConfig | None = None) -> None:
        from kornia.augmentation import AugmentationSequential, ColorJitter, RandomAffine, RandomHorizontalFlip
        from kornia.constants import DataKey, Resample

        self.config = c = config or AugmentationConfig()
        # align_corners: coordinates of pixel centres, as everywhere in this package.
        geometry = RandomAffine(c.rotation, scale=c.scale, align_corners=True, p=1.0)
        # A drawn order of the colours would be read back by the CPU.
        colours = ColorJitter(c.brightness, c.contrast, c.saturation, order=(0, 1, 2), p=1.0)
        nearest: dict[Any, dict[str, Any]] = {DataKey.MASK: {"resample": Resample.NEAREST, "align_corners": True}}
        steps = (geometry, RandomHorizontalFlip(p=c.flip), colours)
        self.transform: Any = AugmentationSequential(*steps, data_keys=["input", "mask"], extra_args=nearest)

    def __call__(self, image: Tensor, depth: Tensor, intrinsics: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """An augmented copy, of the same size, of image [B, 3, H, W] floating-point in [0, 1], depth [B, H, W] [m], 0 =
        none, copied from the nearest pixel, and intrinsics [B, 3, 3] [px]; depth is 0 outside the original image."""
        new_image, new_depth = self.transform(image, depth[:, None])
        M = self.transform.transform_matrix.to(intrinsics.dtype)
        K = camera_of(M @ intrinsics)
        if self.config.zoom == "depth":
            zoom = (M[:, 0, 0] * M[:, 1, 1] - M[:, 0, 1] * M[:, 1, 0]).abs().sqrt()[:, None, None]
            new_depth = new_depth / zoom[..., None].to(depth)
            K = torch.cat([torch.cat([K[:, :2, :2] / zoom, K[:, :2, 2:]], -1), K[:, 2:]], 1)
        return new_image, new_depth[:, 0], K


def camera_of(projection: Tensor) -> Tensor:
    """The intrinsics K' of a camera [B, 3, 3] whose image was changed by an affine map M of its pixels.

    The changed image shows the same points from the same position: M K = K' G, where G turns or mirrors the camera
    about its optical axis, and K' is upper triangular with positive focal lengths. An RQ decomposition yields both;
    depths along the optical axis stay. K' has skew where pixels that are not square are rotated.

    Args:
        projection: M K [B, 3, 3].
    """
    (a, b), (c, d) = (projection[:, row, :2].unbind(-1) for row in (0, 1))
    height = (c * c + d * d).sqrt()
    zero, one = torch.zeros_like(height), torch.ones_like(height)
    first = [(a * d - b * c).abs() / height, (a * c + b * d) / height, projection[:, 0, 2]]
    rows = (first, [zero, height, projection[:, 1, 2]], [zero, zero, one])
    return torch.stack([torch.stack(row, -1) for row in rows], 1)

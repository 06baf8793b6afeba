"""The raw depth of a ``transformers`` model as one map per image, per architecture.

What a model's ``predicted_depth`` is, ``transformers`` states in the image processor's
``post_process_depth_estimation``; here the same is part of the network, at the resolution of its input.
"""

from __future__ import annotations

import math
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ufmstar_torch.models.network import require_image
from ufmstar_torch.models.outputs import as_map

# [1/m] Depth Pro's inverse depth is kept between these: 0.1 mm and 10 km.
_INVERSE_RANGE = (1e-4, 1e4)
# [sqrt(px)] ZoeDepth pads each border by this times the square root of half the side.
_PADDING = 3.0


class RawDepth(nn.Module):
    """A depth model as an image-to-map network: its own units, the input's resolution, float32.

    Args:
        model: has ``predicted_depth`` [B, h, w] in what it returns for ``pixel_values``.
        multiple: [px] what the input's sides have to be multiples of.
    """

    def __init__(self, model: nn.Module, multiple: int = 1) -> None:
        super().__init__()
        self.model = model
        self.multiple = multiple

    def forward(self, image: Tensor) -> Tensor:
        """[B, H, W] of ``image`` [B, 3, H, W]; a smaller output is enlarged bilinearly. Raises ValueError: the image
        has another shape, or sides that are no multiples of ``multiple``."""
        size = require_image(image, self.multiple)
        return _resized(self.predicted(image)[0], size, "bilinear")

    def predicted(self, image: Tensor) -> tuple[Tensor, Any]:
        """``predicted_depth`` [B, h, w], at least in single precision, and the model's whole output."""
        outputs = self.model(pixel_values=image.to(next(self.model.parameters()).dtype))
        depth = as_map(outputs.predicted_depth, "predicted_depth")
        return depth if depth.dtype == torch.float64 else depth.float(), outputs


class CanonicalInverseDepth(RawDepth):
    """Depth Pro (Bochkovskii et al. 2025): its output is inverse depth for a focal length of one image width, and
    becomes metric by the horizontal field of view that the model estimates as well."""

    def forward(self, image: Tensor) -> Tensor:
        """Depth [B, H, W] [m]; errors as :class:`RawDepth`."""
        size = require_image(image, self.multiple)
        canonical, outputs = self.predicted(image)
        width_per_focal = 2 * (outputs.field_of_view.to(canonical) * (math.pi / 360)).tan()
        inverse = _resized(canonical * width_per_focal.reshape(-1, 1, 1), size, "bilinear")
        return 1 / inverse.clamp(*_INVERSE_RANGE)


class PaddedDepth(RawDepth):
    """ZoeDepth (Bhat et al. 2023): the model sees the image with reflected borders, which are cut off its depth."""

    def forward(self, image: Tensor) -> Tensor:
        """Depth [B, H, W] [m]; errors as :class:`RawDepth`."""
        height, width = require_image(image, self.multiple)
        down, right = (int(math.sqrt(side / 2) * _PADDING) for side in (height, width))
        padded = F.pad(image, (right, right, down, down), mode="reflect")
        resized = F.interpolate(padded, (height, width), mode="bilinear", align_corners=True)
        depth = _resized(self.predicted(resized)[0], (padded.shape[-2], padded.shape[-1]), "bicubic")
        return depth[:, down : down + height, right : right + width]


def _resized(depth: Tensor, size: tuple[int, int], mode: str) -> Tensor:
    """[B, H, W] of [B, h, w]."""
    if depth.shape[-2:] == size:
        return depth
    return F.interpolate(depth[:, None], size, mode=mode, align_corners=False)[:, 0]

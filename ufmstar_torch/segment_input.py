"""The input of every implementation of SPGF, checked once: shapes, dtypes, and thresholds for this image."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import torch
from torch import Tensor

from ufmstar_torch.arguments import require_float, require_mask
from ufmstar_torch.config import SPGFConfig, UfMStarConfig
from ufmstar_torch.frame import FrameInput

# Bins are walked one by one; more than this would be a mistake in the units, not a wish.
MAX_DEPTH_BINS = 10_000


@dataclass(frozen=True)
class SegmentInput:
    """Checked arguments of SPGF, detached from any graph.

    Attributes:
        depth: [B, H, W] [m], float32 or float64 (float64 where half or bfloat16 was given).
        intrinsics: [B, 3, 3] [px], in the dtype that was given.
        config: thresholds scaled to H x W.
        variance: [B, H, W] [m^2] or None.
        valid: [B, H, W] bool or None.
        features: [B, F, H, W] or None.
        dtype: of the mixture to return: depth's, float32 for half and bfloat16.
    """

    depth: Tensor
    intrinsics: Tensor
    config: SPGFConfig
    variance: Tensor | None
    valid: Tensor | None
    features: Tensor | None
    dtype: torch.dtype

    @classmethod
    def checked(
        cls,
        depth: Tensor,
        intrinsics: Tensor,
        config: SPGFConfig | UfMStarConfig | None = None,
        variance: Tensor | None = None,
        valid: Tensor | None = None,
        features: Tensor | None = None,
    ) -> SegmentInput:
        """Check the arguments of ``spgf``; see there.

        Raises:
            TypeError: an argument is no tensor or has the wrong kind of dtype, or config is no config.
            ValueError: a wrong shape, another device than depth's, or (CPU tensors only, elsewhere the check
                would wait for the device) intrinsics that are not finite with fx, fy > 0.
        """
        require_float("depth", depth)
        if depth.dim() != 3 or 0 in depth.shape:
            raise ValueError(f"depth must be [B, H, W] with no empty dimension, got {tuple(depth.shape)}")
        b, height, width = depth.shape
        require_float("intrinsics", intrinsics, [(b, 3, 3)], depth)
        if variance is not None:
            require_float("variance", variance, [(b, height, width)], depth)
        if features is not None:
            channels = features.shape[1] if isinstance(features, Tensor) and features.dim() == 4 else -1
            require_float("features", features, [(b, channels, height, width)], depth)
        if valid is not None:
            require_mask("valid", valid, [(b, height, width)], depth)
        if depth.device.type == "cpu":
            _require_camera(intrinsics)
        stored = depth.dtype in (torch.float32, torch.float64)
        return cls(
            depth=depth.detach() if stored else depth.detach().to(torch.float64),
            intrinsics=intrinsics.detach(),
            config=_scaled(_spgf_config(config), height, width),
            variance=None if variance is None else variance.detach(),
            valid=valid,
            features=None if features is None else features.detach(),
            dtype=depth.dtype if stored else torch.float32,
        )

    @classmethod
    def of_frame(cls, frame: FrameInput, config: UfMStarConfig) -> SegmentInput:
        """The input of step 2 from a checked frame, whose depth is 0 where a pixel is not valid."""
        variance = None
        if config.aleatoric_in_moments and frame.aleatoric is not None:
            variance = frame.aleatoric.detach()
        thresholds = _scaled(config.segment, *frame.size)
        return cls(frame.depth, frame.intrinsics, thresholds, variance, None, frame.features, frame.depth.dtype)

    @property
    def segments_per_row(self) -> int:
        """Most segments that one row can hold: each has more than ``sparse`` pixels. At least 1."""
        return max(1, self.depth.shape[2] // (self.config.sparse + 1))

    @property
    def depth_bins(self) -> int:
        """Enough depth bins to reach max_depth whatever the camera: none is shorter than L0."""
        return math.ceil(self.config.depth_limit / self.config.min_gaussian_length) + 2


@functools.lru_cache(maxsize=16)  # a frame's worth of checks, for a value that never changes
def _scaled(config: SPGFConfig, height: int, width: int) -> SPGFConfig:
    if config.depth_limit > MAX_DEPTH_BINS * config.min_gaussian_length:
        raise ValueError(
            f"config.min_gaussian_length = {config.min_gaussian_length} m would cut config.max_depth = "
            f"{config.depth_limit} m into more than {MAX_DEPTH_BINS} bins; are both in metres?"
        )
    return config.scaled_to(height, width)


def _spgf_config(config: SPGFConfig | UfMStarConfig | None) -> SPGFConfig:
    if config is None:
        return SPGFConfig()
    if isinstance(config, UfMStarConfig):
        return config.segment
    if not isinstance(config, SPGFConfig):
        raise TypeError(f"config must be an SPGFConfig, a UfMStarConfig or None, got {type(config).__name__}")
    return config


def _require_camera(intrinsics: Tensor) -> None:
    for b, (row_x, row_y, _) in enumerate(intrinsics.tolist()):
        values = (row_x[0], row_y[1], row_x[2], row_y[2])
        if not all(map(math.isfinite, values)) or min(values[:2]) <= 0:
            raise ValueError(f"intrinsics must be finite with fx, fy > 0, got fx, fy, cx, cy = {values} in stream {b}")

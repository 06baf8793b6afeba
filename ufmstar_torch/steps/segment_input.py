"""The input of every implementation of SPGF: depth maps, cameras, and thresholds for these images."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import torch
from torch import Tensor

from ufmstar_torch.config import SPGFConfig, UfMStarConfig
from ufmstar_torch.frames.frame import FrameInput

# Implementations iterate over the bins; more than this indicate a mistake in the units.
MAX_DEPTH_BINS = 10_000


@dataclass(frozen=True)
class SegmentInput:
    """Checked arguments of SPGF, detached from any graph.

    Attributes:
        depth: [B, H, W] [m], float32 or float64; pixels outside (0, ``config.depth_limit``] are ignored.
        intrinsics: [B, 3, 3] [px], centre of the first pixel at (0, 0).
        config: thresholds scaled to H x W.
        features: [B, F, H, W], averaged over the pixels of each Gaussian, or None.
    """

    depth: Tensor
    intrinsics: Tensor
    config: SPGFConfig
    features: Tensor | None

    @classmethod
    def of(cls, depth: Tensor, intrinsics: Tensor, config: SPGFConfig, features: Tensor | None = None) -> SegmentInput:
        """The input for maps of any size; ``config`` has the thresholds for its reference size.

        Raises:
            ValueError: the thresholds divide the depth into too many bins.
        """
        return cls(depth, intrinsics, _scaled(config, *depth.shape[1:]), features)

    @classmethod
    def of_frame(cls, frame: FrameInput, config: UfMStarConfig) -> SegmentInput:
        """The input of step 2 from a checked frame, whose depth is 0 at invalid pixels; nothing of an image that shows
        nothing."""
        depth = frame.depth
        if frame.informative is not None:
            depth = torch.where(frame.informative[:, None, None], depth, torch.zeros_like(depth))
        return cls.of(depth, frame.intrinsics, config.segment, frame.features)

    @property
    def segments_per_row(self) -> int:
        """Most segments in a row, each of which has more than ``sparse`` pixels; at least 1."""
        return max(1, self.depth.shape[2] // (self.config.sparse + 1))

    @property
    def depth_bins(self) -> int:
        """Number of depth bins that reaches max_depth for every camera, since no bin is shorter than L0."""
        return math.ceil(self.config.depth_limit / self.config.min_gaussian_length) + 2


@functools.lru_cache(maxsize=16)  # constructing a config repeats its checks in every frame
def _scaled(config: SPGFConfig, height: int, width: int) -> SPGFConfig:
    if config.depth_limit > MAX_DEPTH_BINS * config.min_gaussian_length:
        raise ValueError(
            f"config.min_gaussian_length = {config.min_gaussian_length} m would cut config.max_depth = "
            f"{config.depth_limit} m into more than {MAX_DEPTH_BINS} bins; are both in metres?"
        )
    return config.scaled_to(height, width)

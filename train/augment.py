"""Random changes of training frames: image, depth and intrinsics together, drawn from a seed."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor


@dataclass(frozen=True)
class AugmentationConfig:
    """What is drawn."""

    flip: float = 0.5


class Augmentation:
    """Skeleton."""

    def __init__(self, config: AugmentationConfig) -> None:
        self.config = config

    def __call__(
        self, image: Tensor, depth: Tensor, intrinsics: Tensor, seed: tuple[int, ...]
    ) -> tuple[Tensor, Tensor, Tensor]:
        return image, depth, intrinsics

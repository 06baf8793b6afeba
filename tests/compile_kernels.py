"""``compile_kernels.py float32|float64``: compile the kernels that many tests use into the cache on disk."""

from __future__ import annotations

import gc
import sys
from pathlib import Path

import torch

from ufmstar_torch import AnchorConfig, PosteriorConfig, UfMStar, UfMStarConfig, kernels
from ufmstar_torch.anchors import Anchors
from ufmstar_torch.anchors.dense import DenseEvidence
from ufmstar_torch.anchors.tracker import LandmarkTracker
from ufmstar_torch.runtime.warm_up import along_wall

NEAR = UfMStarConfig(backend="numba", regression="neighbourhood")
EXACT = UfMStarConfig(backend="numba")


def two_frames(config: UfMStarConfig, dtype: torch.dtype) -> None:
    """A wall seen twice, and an average of its image."""
    depth, pose = torch.full((1, 24, 32), 2.0, dtype=dtype), torch.eye(4)
    K = torch.tensor([[30.0, 0.0, 16.0], [0.0, 30.0, 12.0], [0.0, 0.0, 1.0]])
    row = depth[:, 0].double()
    anchors = (
        Anchors(torch.arange(32.0)[None, :, None].expand(1, 32, 2) / 2, row, row / 100)
        if config.anchors is not None
        else None
    )
    ufm = UfMStar(config, dtype=dtype)
    for _ in range(2):
        ufm(depth, pose, K, anchors=anchors)
    ufm.mean_uncertainty(depth, pose, K, anchors=anchors, pixels=3)
    ufm.query(torch.zeros(1, 1, 3))


if __name__ == "__main__":
    gc.disable()
    if sys.argv[1] == "float32":
        two_frames(NEAR, torch.float32)
        two_frames(EXACT, torch.float32)
        along_wall(LandmarkTracker())
        along_wall(DenseEvidence())
    else:  # anchors first, so that only one of the two processes compiles the kernels without a dtype
        two_frames(EXACT.replace(anchors=AnchorConfig(), posterior=PosteriorConfig()), torch.float64)
        two_frames(NEAR, torch.float64)
    folder = Path(kernels.__file__).with_name("__pycache__")
    folder.mkdir(exist_ok=True)
    (folder / f"{sys.argv[1]}.compiled").touch()

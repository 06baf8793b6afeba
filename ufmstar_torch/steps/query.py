"""M at any 3D point: step 5 without a depth map."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from ufmstar_torch.config import UfMStarConfig
from ufmstar_torch.gaussians.camera import invert_rigid
from ufmstar_torch.gaussians.fixed_order import apply
from ufmstar_torch.gaussians.state import UfMStarState
from ufmstar_torch.runtime.stateful import full_precision
from ufmstar_torch.steps import unmeasured
from ufmstar_torch.steps.regress import Regression, regress


def query(state: UfMStarState, points: Tensor, frame: str, config: UfMStarConfig) -> Regression:
    """See :meth:`ufmstar_torch.UfMStar.query`, of a state of B streams."""
    if not isinstance(frame, str) or frame not in ("world", "first"):
        raise ValueError(f"frame must be 'world' or 'first', got {frame!r}")
    streams = len(state.weight)
    if streams == 0:
        raise ValueError("query needs a mixture: call the module on a frame first")
    if points.dim() != 3 or points.shape[0] != streams or points.shape[2] != 3:
        raise ValueError(f"points must be [{streams}, N, 3], got {tuple(points.shape)}")
    with full_precision(points.device):
        local = points.detach()
        if frame == "world":
            T = invert_rigid(state.T_world_first)
            local = apply(T[:, None, :3, :3], local.double()) + T[:, None, :3, 3]
        dtype = torch.float64 if points.dtype == torch.float64 else torch.float32
        result = regress(unmeasured.before_regression(state.mixture), local.to(dtype), config)
        result = unmeasured.after_regression(result, None, config)[0]
        return replace(result, features=result.features[..., : config.features])

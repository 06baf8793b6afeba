"""Calls that launch every Triton kernel once, on small inputs."""

from __future__ import annotations

from collections.abc import Callable

import torch
from random_gaussians import mixture

import scenes
from ufmstar_torch import UfMStarConfig

SIZE = (37, 52)
K = torch.tensor(scenes.intrinsics(*SIZE)).expand(2, 3, 3)


def cases() -> dict[str, Callable[[], object]]:
    """By name."""
    from ufmstar_torch.kernels.triton import regress

    m = mixture(2, 40, 3, features=1)
    depth = torch.full((2, *SIZE), 2.0)
    config = UfMStarConfig()
    return {
        "regress": lambda: regress.regress_image(m, depth, K, depth > 0, config),
        "regress_subset": lambda: regress.regress_image(
            m, depth, K, depth > 0, config, torch.zeros(2, 300, dtype=torch.int64)
        ),
    }

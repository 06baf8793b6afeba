"""A short rendered sequence, and a comparison of a module's state."""

from __future__ import annotations

import torch
from walks import SPGF as SPGF

import scenes
from ufmstar_torch import UfMStarConfig

H, W = 30, 40

CONFIG = UfMStarConfig(segment=SPGF, unmeasured="paper")

DEPTHS, POSES, K_ = scenes.sequence(8, H, W, 0.05)

K = torch.tensor(K_)


def frame(i: int, dtype=torch.float32):
    return torch.tensor(DEPTHS[i], dtype=dtype)[None], torch.tensor(POSES[i])[None], K[None]


def same(a: torch.Tensor, b: torch.Tensor) -> bool:
    return torch.equal(a.nan_to_num(-1.0), b.nan_to_num(-1.0)) and torch.equal(a.isnan(), b.isnan())


def snapshot(ufm: torch.nn.Module) -> dict[str, torch.Tensor]:
    return {name: value.clone() for name, value in ufm.state_dict().items()}


def unchanged(ufm: torch.nn.Module, before: dict[str, torch.Tensor]) -> bool:
    after = ufm.state_dict()
    return after.keys() == before.keys() and all(same(v.double(), before[k].double()) for k, v in after.items())

"""Calls that launch every Triton kernel once, on small inputs."""

from __future__ import annotations

from collections.abc import Callable

import torch
from random_gaussians import mixture

import scenes
from ufmstar_torch import UfMStarConfig
from ufmstar_torch.correspond import Correspondence
from ufmstar_torch.segment_input import SegmentInput

SIZE = (37, 52)
K = torch.tensor(scenes.intrinsics(*SIZE)).expand(2, 3, 3)


def cases() -> dict[str, Callable[[], object]]:
    """By name."""
    from ufmstar_torch.kernels.triton import correspond, distribute, fuse, regress, segment

    m = mixture(2, 40, 3, features=1)
    current = mixture(2, 20, 4, features=1)
    depth = torch.full((2, *SIZE), 2.0)
    config = UfMStarConfig()
    still = torch.eye(3, dtype=torch.float64).repeat(2, 1, 1), torch.zeros(2, 3, dtype=torch.float64)
    pairs = Correspondence(torch.zeros(2, 20, 40, dtype=torch.bool), torch.zeros(2, 20, 40, dtype=torch.float64))

    def bits() -> None:
        previous, new = correspond.candidates(m.to(torch.float32), still, current, K.contiguous(), SIZE, config)
        words, _, _ = correspond.match_bits(previous, new, config)
        matches = words, new.index, previous.place, new.count
        fuse.fuse_bits(m.to(torch.float32), current, still, matches, config)

    given = SegmentInput.checked(depth, K, None, depth, depth > 0, depth[:, None])
    return {
        "regress": lambda: regress.regress_image(m, depth, K, depth > 0, config),
        "regress_subset": lambda: regress.regress_image(
            m, depth, K, depth > 0, config, torch.zeros(2, 300, dtype=torch.int64)
        ),
        "correspond": lambda: correspond.correspond(m, current, K, SIZE, config),
        "bits": bits,
        "fuse": lambda: fuse.fuse(m, current, pairs, config.replace(overlap_weighted=True)),
        "smooth": lambda: regress.smooth(depth, depth, 0.5),
        "distribute": lambda: distribute.distribute(m, m.mean, m.covariance[..., 0], config),
        "floor": lambda: fuse.floor_covariance(m.covariance, m.weight),
        "segment": lambda: segment.segment(given),
        "fit": lambda: segment.fit(SegmentInput.checked(depth, K), labels=False, floor=segment.Floor(0.05, 1e-6)),
    }

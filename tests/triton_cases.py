"""Calls that launch every Triton kernel once, on small inputs."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from random_gaussians import mixture

import scenes
from ufmstar_torch import UfMStarConfig
from ufmstar_torch.correspond import Correspondence
from ufmstar_torch.frame import FrameMaps, check_frame
from ufmstar_torch.kernels.select import select_kernels
from ufmstar_torch.segment_input import SegmentInput
from ufmstar_torch.state import UfMStarState

SIZE = (37, 52)
K = torch.tensor(scenes.intrinsics(*SIZE)).expand(2, 3, 3)


def cases() -> dict[str, Callable[[], object]]:
    """By name."""
    from ufmstar_torch.kernels import step_device
    from ufmstar_torch.kernels.triton import append, check, correspond, distribute, fuse, regress, segment

    m = mixture(2, 40, 3, features=1)
    current = mixture(2, 20, 4, features=1)
    depth = torch.full((2, *SIZE), 2.0)
    config = UfMStarConfig()
    still = torch.eye(3, dtype=torch.float64).repeat(2, 1, 1), torch.zeros(2, 3, dtype=torch.float64)
    pairs = Correspondence(torch.zeros(2, 20, 40, dtype=torch.bool), torch.zeros(2, 20, 40, dtype=torch.float64))

    def bits() -> None:
        previous, new = correspond.candidates(m.to(torch.float32), still, current, K.contiguous(), SIZE, config)
        words, _ = correspond.match_bits(previous, new, config, torch.zeros(2, dtype=torch.int64))
        matches = words, new.index, previous.place, new.count
        fuse.fuse_bits(m.to(torch.float32), current, still, matches, config)

    def device(streams: int = 2, **settings: Any) -> None:
        depth = torch.full((streams, *(SIZE if streams > 1 else (1, 1))), 2.0)
        kernels = select_kernels("triton", "cuda")
        chosen = UfMStarConfig(features=1, **settings)
        frame = check_frame(
            depth, torch.eye(4), K[:streams], None, None, None, depth[:, None], feature_count=1, rotation_tolerance=0.01
        )
        late = step_device.DeviceStep(kernels)
        state, _ = late(UfMStarState.initial(streams, chosen, torch.float32, "cpu"), frame, chosen)
        waiting = late._waiting
        assert waiting is not None
        assert waiting.rest is not None
        rest = waiting.rest
        append.append(
            state.mixture, rest.current, rest.to_first, rest.left, state.frames, near_plane=0.05, again=True,
            last=False,
        )  # fmt: skip

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
        "check": lambda: check.check_values(
            FrameMaps(depth, depth, depth, depth[:, None], depth > 0),
            torch.eye(4).double().expand(2, 4, 4),
            K,
            rotation_tolerance=0.01,
            max_depth=20.0,
        ),
        "floor": lambda: fuse.floor_covariance(m.covariance, m.weight),
        "segment": lambda: segment.segment(given),
        "device": device,
        "device_one": lambda: device(1),
        "device_relative": lambda: device(unmeasured="relative"),
        "fit": lambda: segment.fit(SegmentInput.checked(depth, K), floor=segment.Floor(0.05, 1e-6)),
    }

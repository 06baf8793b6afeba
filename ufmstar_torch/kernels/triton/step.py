"""A step on a GPU without synchronisation: 11 compiled kernels, and with torch's operations some 90 launches.

The mixture grows one frame ahead: before a frame it has slots for all Gaussians that the frame can have, so that the
host needs only the number of components after the frame before. The device copies this number to the host after every
frame, and the host waits for it only if it is more than a frame ahead of the device.

Anchors, a subset of pixels and ``config.overlap_weighted`` run as ``step.step`` with the GPU's kernels.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from ufmstar_torch.config import UfMStarConfig
from ufmstar_torch.frames.frame import FrameInput
from ufmstar_torch.frames.output import UncertaintyOutput
from ufmstar_torch.gaussians.state import UfMStarState
from ufmstar_torch.kernels.triton import append as ends
from ufmstar_torch.kernels.triton.append import append, cameras
from ufmstar_torch.kernels.triton.correspond import candidates, match_bits
from ufmstar_torch.kernels.triton.fuse import fuse_bits
from ufmstar_torch.kernels.triton.regress import regress_frame
from ufmstar_torch.kernels.triton.segment import Floor, fit
from ufmstar_torch.steps.fuse import make_room
from ufmstar_torch.steps.segment import max_gaussians
from ufmstar_torch.steps.step import Kernels, StepObserver, step, step_output


@dataclass(frozen=True)
class Count:
    """The number of components after a frame, on its way to the host.

    Attributes:
        mean: of the mixture that was counted, which identifies it.
        components: [B] integers on the host, valid after ``copied``.
        copied: event at the end of the copy; None on the CPU.
    """

    mean: Tensor
    components: Tensor
    copied: torch.cuda.Event | None

    @classmethod
    def of(cls, state: UfMStarState, components: Tensor) -> Count:
        """Queue the copy of the numbers [B] of the state's components."""
        if components.device.type != "cuda":
            return cls(state.mean, components.cpu(), None)
        on_host = torch.empty(components.shape, dtype=components.dtype, pin_memory=True)
        on_host.copy_(components, non_blocking=True)
        copied = torch.cuda.Event()
        copied.record(torch.cuda.current_stream(components.device))
        return cls(state.mean, on_host, copied)

    def most(self) -> int:
        """The components of the fullest stream; waits for the copy."""
        if self.copied is not None:
            self.copied.synchronize()
        return int(self.components.max())


class DeviceStep:
    """:class:`ufmstar_torch.steps.step.Step` that lets the mixture grow one frame ahead.

    Args:
        kernels: for the configurations that :func:`device_step` does not support.
    """

    def __init__(self, kernels: Kernels) -> None:
        self._kernels = kernels
        self._count: Count | None = None

    def __call__(
        self,
        state: UfMStarState,
        frame: FrameInput,
        config: UfMStarConfig,
        *,
        pixels: Tensor | None = None,
        observer: StepObserver | None = None,
    ) -> tuple[UfMStarState, UncertaintyOutput]:
        state = self._with_room(state, frame, config)
        plain = config.anchors is None and not config.overlap_weighted
        if plain and pixels is None and observer is None:
            updated, out = device_step(state, frame, config)
        else:
            updated, out = step(
                state, frame, config, pixels=pixels, observer=observer, kernels=self._kernels, grow=False
            )
        self._count = None if _full(state, config) else Count.of(updated, out.statistics.components)
        return updated, out

    def _with_room(self, state: UfMStarState, frame: FrameInput, config: UfMStarConfig) -> UfMStarState:
        """The state with slots for all Gaussians that the frame can have, as far as ``config.max_components`` allows.
        Reads from the device if the state is not the one that the step returned last."""
        if _full(state, config):
            return state
        if self._count is not None and self._count.mean is state.mean:
            present = self._count.most()
        else:
            present = int(state.mixture.components.max())
        coming = max_gaussians(config.segment.scaled_to(*frame.size), *frame.size)
        return state.with_tensors(state.mixture.grown(present + coming, config.max_components).tensors())


def device_step(
    state: UfMStarState, frame: FrameInput, config: UfMStarConfig
) -> tuple[UfMStarState, UncertaintyOutput]:
    """One image through steps 2 to 5 with the slots that the state has; see :func:`ufmstar_torch.steps.step.step`."""
    b = frame.depth.shape[0]
    stored = state.covariance.dtype
    eps = 8 * torch.finfo(stored).eps
    limits = config.segment.scaled_to(*frame.size)
    current, _ = fit(
        frame.informative_depth, frame.intrinsics, limits, frame.features, floor=Floor(config.near_plane, eps)
    )
    poses = cameras(state, frame)
    camera = frame.intrinsics.contiguous()
    previous, new = candidates(state.mixture, poses.to_camera, current, camera, frame.size, config)
    counts = torch.zeros(ends.COUNTS, b, dtype=torch.int64, device=frame.depth.device)
    bits, matched = match_bits(previous, new, config, counts[ends.PAIRS])
    matches = bits, new.index, previous.position, new.count
    mixture = fuse_bits(state.mixture, current, poses.to_first, matches, poses.view, config)
    removed = torch.zeros_like(frame.fault)
    if config.max_components is not None and _full(state, config):
        coming = (current.valid & (current.mean[..., 2] > config.near_plane) & ~matched).sum(1)
        position = poses.to_first[1]
        room = make_room(mixture, {}, mixture.components, coming, position, config.max_components)
        mixture, removed = room.mixture, room.dropped
    append(
        mixture, current, poses.to_first, poses.view, matched, counts, near_plane=config.near_plane,
        paper=config.view_baseline is None,
    )  # fmt: skip
    result = regress_frame(mixture, poses.to_camera, frame, state.smoothed, config, counts)
    of_step = {
        "components": counts[ends.COMPONENTS], "segments": counts[ends.SEGMENTS], "matched": counts[ends.MATCHED],
        "pairs": counts[ends.PAIRS], "new": counts[ends.NEW], "dropped": counts[ends.DROPPED] + removed,
        "unmeasured": counts[ends.UNMEASURED],
        "single_view": (mixture.valid & (mixture.views == 0)).sum(1),
    }  # fmt: skip
    updated = state.with_tensors({
        **mixture.tensors(), "T_world_first": poses.first, "started": poses.started, "frames": poses.frames,
        "skipped": poses.skipped, "smoothed": result.memory,
    })  # fmt: skip
    maps = {"disagreement": result.disagreement, "measured": result.measured, "features": result.features}
    maps |= {"depth": frame.depth, "valid": frame.valid}
    out = step_output(frame, maps, None, of_step)
    return updated, out


def _full(state: UfMStarState, config: UfMStarConfig) -> bool:
    """True if the mixture may not grow."""
    return config.max_components is not None and state.mean.shape[1] >= config.max_components

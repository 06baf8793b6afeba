"""A step on a GPU without synchronisation: 11 compiled kernels, and with torch's operations some 90 launches.

The mixture has a fixed number of slots. The device counts the components that a frame adds, and copies the counts to
the host after the frame's last change of the mixture. The host reads them at the next frame, so that it waits only if
it is more than a frame ahead of the device. If slots ran short, the host then doubles them and appends the components
without a slot, before anything else: the next frame matches the same components as if the mixture had grown in time,
and only the map of the frame before was regressed without them. Growth starts before the slots are full, so that this
is rare.

Frames with anchors or a subset of pixels, ``config.disagreement == "overlap"`` and ``config.overlap_weighted`` run as
``step.step`` with the GPU's kernels. The mixture then grows one frame ahead, to slots for all that a frame can segment,
so that the host reads only the count of the frame before.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ufmstar_torch.config import UfMStarConfig
from ufmstar_torch.frames.frame import FrameInput
from ufmstar_torch.frames.output import FrameStatistics, StepOutput
from ufmstar_torch.gaussians.mixture import GaussianMixture
from ufmstar_torch.gaussians.state import UfMStarState
from ufmstar_torch.kernels.triton import append as ends
from ufmstar_torch.kernels.triton.append import append, cameras
from ufmstar_torch.kernels.triton.correspond import candidates, match_bits
from ufmstar_torch.kernels.triton.fuse import fuse_bits
from ufmstar_torch.kernels.triton.regress import regress_frame
from ufmstar_torch.kernels.triton.segment import Floor, fit
from ufmstar_torch.steps.fuse import make_room
from ufmstar_torch.steps.segment import max_gaussians
from ufmstar_torch.steps.segment_input import SegmentInput
from ufmstar_torch.steps.step import Kernels, StepObserver, step

_ROOM = 4 / 3  # slots for each needed slot, below which the mixture grows


@dataclass(frozen=True)
class Rest:
    """Gaussians of a frame for which the mixture had no slot.

    Attributes:
        current: C_i in the camera frame, [B, C].
        to_first: R and t into the mixture's frame.
        view: [B, 4], see ``append.Cameras``.
        left: [B, C] bool, the Gaussians without a slot.
    """

    current: GaussianMixture
    to_first: tuple[Tensor, Tensor]
    view: Tensor
    left: Tensor


@dataclass(frozen=True)
class Waiting:
    """A frame whose counts the host has not read yet.

    Attributes:
        needed: [B] integers on the host, slots for all components; valid after ``copied``.
        copied: event at the end of the copy; None on the CPU.
        rest: the Gaussians without a slot; None if the mixture has slots for all.
    """

    needed: Tensor
    copied: torch.cuda.Event | None
    rest: Rest | None

    @classmethod
    def after(cls, needed: Tensor, rest: Rest | None = None) -> Waiting:
        """Queue the copy of the counts [B]."""
        if needed.device.type != "cuda":
            return cls(needed.cpu(), None, rest)
        on_host = torch.empty(needed.shape, dtype=needed.dtype, pin_memory=True)
        on_host.copy_(needed, non_blocking=True)
        copied = torch.cuda.Event()
        copied.record(torch.cuda.current_stream(needed.device))
        return cls(on_host, copied, rest)

    def slots(self) -> int:
        """The slots that the fullest stream needs; waits for the copy."""
        if self.copied is not None:
            self.copied.synchronize()
        return int(self.needed.max())


class DeviceStep:
    """:class:`ufmstar_torch.steps.step.Step` with deferred growth of the mixture.

    The pending components belong to the state that was returned last. Call :meth:`settled` before this state is saved,
    copied or moved. A call with another state discards them.

    Args:
        kernels: for the configurations that :func:`device_step` does not support.
    """

    def __init__(self, kernels: Kernels) -> None:
        self._kernels = kernels
        self._waiting: Waiting | None = None
        self._last_mean: Tensor | None = None
        self._lost: Tensor | None = None

    def __call__(
        self,
        state: UfMStarState,
        frame: FrameInput,
        config: UfMStarConfig,
        *,
        pixels: Tensor | None = None,
        smooth: bool = True,
        observer: StepObserver | None = None,
    ) -> tuple[UfMStarState, StepOutput]:
        plain = config.disagreement == "w2" and config.anchors is None
        if config.overlap_weighted or not plain or pixels is not None or observer is not None:
            state = self._with_room(state, config, ahead=max_gaussians(SegmentInput.of_frame(frame, config)))
            updated, out = step(
                state, frame, config, pixels=pixels, smooth=smooth, observer=observer, kernels=self._kernels, grow=False
            )
            waiting = None if _full(state.mixture.capacity, config) else Waiting.after(out.statistics.components)
        else:
            state = self._with_room(state, config)
            updated, out, waiting = device_step(state, frame, config, smooth=smooth)
        if self._lost is not None:
            dropped = out.statistics.dropped + self._lost
            out = replace(out, statistics=replace(out.statistics, dropped=dropped))
        self._waiting, self._last_mean, self._lost = waiting, updated.mean, None
        return self.settled(updated, config) if config.merges_on(frame.depth.device.type) else updated, out

    def settled(self, state: UfMStarState, config: UfMStarConfig) -> UfMStarState:
        """Append the pending components to the state; synchronises with the device."""
        state = self._with_room(state, config, ahead=0)
        self._waiting, self._last_mean = None, state.mean
        return state

    def _with_room(self, state: UfMStarState, config: UfMStarConfig, ahead: int | None = None) -> UfMStarState:
        """The state with the pending components appended, and with slots for the next frame.

        The components stay pending, so that a step that raises loses nothing. Components without a slot because of
        ``config.max_components`` count as dropped by the next frame.

        Args:
            state: the step's argument.
            config: of UfM*.
            ahead: number of free slots afterwards, up to the limit; None = a third of the slots in use.
        """
        if state.mean is not self._last_mean:
            self._waiting = self._lost = None
        mixture, waiting = state.mixture, self._waiting
        if waiting is None:
            if not ahead or _full(mixture.capacity, config):
                return state
            needed = int(mixture.components.max())  # another state: the only read from the device
        else:
            needed = waiting.slots()
        wanted = int(needed * _ROOM) if ahead is None else needed + ahead
        grown = mixture.grown(wanted, config.max_components)
        if waiting is not None and waiting.rest is not None and needed > mixture.capacity:
            rest = waiting.rest
            lost, _ = append(
                grown, rest.current, rest.to_first, rest.view, rest.left, state.frames, near_plane=config.near_plane,
                paper=config.view_baseline is None, again=True, last=False,
            )  # fmt: skip
            self._lost = lost.sum(1)
        return state.with_tensors(grown.tensors())


def device_step(
    state: UfMStarState, frame: FrameInput, config: UfMStarConfig, *, smooth: bool = True
) -> tuple[UfMStarState, StepOutput, Waiting | None]:
    """One image through steps 2 to 5 with the slots that the state has; see :func:`ufmstar_torch.steps.step.step`.

    Returns:
        The new state, the output, and the counts with the pending components; None where the mixture cannot grow.
    """
    b = frame.depth.shape[0]
    stored = state.covariance.dtype
    eps = 8 * torch.finfo(stored).eps
    inputs = SegmentInput.of_frame(frame, config)
    current, _ = fit(inputs, floor=Floor(config.near_plane, eps))
    poses = cameras(state, frame)
    camera = frame.intrinsics.contiguous()
    previous, new = candidates(state.mixture, poses.to_camera, current, camera, frame.size, config)
    counts = torch.zeros(ends.COUNTS, b, dtype=torch.int64, device=frame.depth.device)
    bits, matched = match_bits(previous, new, config, counts[ends.PAIRS])
    matches = bits, new.index, previous.position, new.count
    mixture = fuse_bits(state.mixture, current, poses.to_first, matches, poses.view, config)
    full, removed = _full(mixture.capacity, config), torch.zeros_like(frame.fault)
    if full and config.max_components is not None:
        coming = (current.valid & (current.mean[..., 2] > config.near_plane) & ~matched).sum(1)
        position = poses.to_first[1]
        room = make_room(mixture, {}, mixture.components, coming, position, config.max_components)
        mixture, removed = room.mixture, room.dropped
    left, needed = append(
        mixture, current, poses.to_first, poses.view, matched, counts, near_plane=config.near_plane,
        paper=config.view_baseline is None, again=False, last=full,
    )  # fmt: skip
    waiting = None if full else Waiting.after(needed, Rest(current, poses.to_first, poses.view, left))
    result = regress_frame(mixture, poses.to_camera, frame, state.smoothed, config, counts, smooth=smooth)
    statistics = FrameStatistics(
        components=counts[ends.COMPONENTS],
        segments=counts[ends.SEGMENTS],
        matched=counts[ends.MATCHED],
        pairs=counts[ends.PAIRS],
        new=counts[ends.NEW],
        dropped=counts[ends.DROPPED] + removed,
        valid_pixels=counts[ends.VALID],
        beyond=frame.beyond,
        out_of_range=frame.out_of_range,
        unmeasured=counts[ends.UNMEASURED],
        single_view=(mixture.valid & (mixture.views == 0)).sum(1),
        fault=frame.fault,
        rotation_deviation=frame.rotation_deviation,
    )
    updated = state.with_tensors({
        **mixture.tensors(), "T_world_first": poses.first, "started": poses.started, "frames": poses.frames,
        "skipped": poses.skipped, "smoothed": result.memory,
    })  # fmt: skip
    out = StepOutput(result.disagreement, result.features, result.measured, None, current, statistics)
    return updated, out, waiting


def _full(capacity: int, config: UfMStarConfig) -> bool:
    """True if a mixture of so many slots may not grow."""
    return config.max_components is not None and capacity >= config.max_components

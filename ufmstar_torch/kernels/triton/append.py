"""Two parts of a step on a GPU: relative camera poses, and the components that a frame adds."""

from __future__ import annotations

from dataclasses import dataclass

import torch
import triton
import triton.language as tl
from torch import Tensor

from ufmstar_torch.frames.frame import FrameInput
from ufmstar_torch.gaussians.mixture import GaussianMixture
from ufmstar_torch.gaussians.state import UfMStarState
from ufmstar_torch.kernels.triton.launch import launch, power_of_two
from ufmstar_torch.kernels.triton.matrices import exact, load_symmetric, moved, store_symmetric, turned

# Rows of a frame's counts [7, B] int64.
COMPONENTS, SEGMENTS, MATCHED, PAIRS, NEW, DROPPED, UNMEASURED = range(7)
COUNTS = 7


@dataclass(frozen=True)
class Cameras:
    """Cameras and counters of B streams after a frame.

    Attributes:
        first: [B, 4, 4] float64 pose of the first camera.
        to_camera: R [B, 3, 3] and t [B, 3] float64 from the first camera's frame to the present one's.
        to_first: R and t of the inverse.
        view: [B, 4] float64 t of ``to_first``, which is the camera's centre, and the index of the network.
        started, frames, skipped: [B] of the new state.
    """

    first: Tensor
    to_camera: tuple[Tensor, Tensor]
    to_first: tuple[Tensor, Tensor]
    view: Tensor
    started: Tensor
    frames: Tensor
    skipped: Tensor


def cameras(state: UfMStarState, frame: FrameInput) -> Cameras:
    """Compute poses relative to the first camera in one launch. A faulty stream only counts a skipped frame."""
    b = frame.depth.shape[0]
    first = torch.empty_like(state.T_world_first)
    motion = first.new_empty(2, b, 3, 3)
    shift = first.new_empty(2, b, 3)
    counters = state.frames.new_empty(2, b)
    started = torch.empty_like(state.started)
    view = first.new_empty(b, 4)
    member = first.new_zeros(b) if frame.member is None else frame.member.double().contiguous()
    launch(
        _cameras, (b,), state.T_world_first, frame.T_world_cam.contiguous(), frame.fault, state.started, state.frames,
        state.skipped, member, first, motion[0], shift[0], motion[1], shift[1], view, started, counters[0],
        counters[1], warps=1,
    )  # fmt: skip
    return Cameras(first, (motion[0], shift[0]), (motion[1], shift[1]), view, started, counters[0], counters[1])


def append(
    mixture: GaussianMixture,
    current: GaussianMixture,
    to_first: tuple[Tensor, Tensor],
    view: Tensor,
    matched: Tensor,
    counts: Tensor,
    *,
    near_plane: float,
    paper: bool,
) -> None:
    """Append the unmatched Gaussians of a frame to ``mixture``, in place, and count them. Those without a slot are
    dropped.

    Args:
        mixture: [B, K], in memory that only this step uses.
        current: C_i in the camera frame, [B, C].
        to_first: R and t to the mixture's frame.
        view: [B, 4], see :class:`Cameras`.
        matched: [B, C] bool, the Gaussians that matched, which are not appended.
        counts: [8, B] int64, written.
        near_plane: nearer Gaussians are dropped [m].
        paper: whether the first view has a weight in m (``fuse.first_weight``).
    """
    b, c = current.weight.shape
    channels = mixture.features.shape[2]
    launch(
        _append, (b,), current.mean, current.covariance, current.weight, current.features, *to_first,
        view.contiguous(), matched,
        *mixture.tensors().values(), counts, c, mixture.capacity, b,
        near_plane=near_plane, paper=paper, channels=channels, padded=power_of_two(channels), chunk=128,
    )  # fmt: skip


@triton.jit
def _relative(a, b, R, t):
    """R and t from camera a to camera b, from poses [4, 4] in memory (``camera.relative_pose``)."""
    for i in tl.static_range(3):
        x, y, z = tl.load(b + i), tl.load(b + 4 + i), tl.load(b + 8 + i)
        for j in tl.static_range(3):
            tl.store(R + 3 * i + j, x * tl.load(a + j) + y * tl.load(a + 4 + j) + z * tl.load(a + 8 + j))
        dx, dy, dz = tl.load(a + 3) - tl.load(b + 3), tl.load(a + 7) - tl.load(b + 7), tl.load(a + 11) - tl.load(b + 11)
        tl.store(t + i, x * dx + y * dy + z * dz)


@triton.jit
def _cameras(
    T_first, T, fault, started, frames, skipped, member, first, R_cam, t_cam, R_first, t_first, view, started_o,
    frames_o, skipped_o,
):  # fmt: skip
    b = tl.program_id(0).to(tl.int64)
    usable = tl.load(fault + b) == 0
    was_started = tl.load(started + b) != 0
    pose = T + 16 * b
    base = T_first + 16 * b
    if usable & (was_started == 0):
        base = pose
    entry = tl.arange(0, 16)
    tl.store(first + 16 * b + entry, tl.load(base + entry))
    _relative(base, pose, R_cam + 9 * b, t_cam + 3 * b)
    _relative(pose, base, R_first + 9 * b, t_first + 3 * b)
    for i in tl.static_range(3):
        tl.store(view + 4 * b + i, tl.load(t_first + 3 * b + i))
    tl.store(view + 4 * b + 3, tl.load(member + b))
    tl.store(started_o + b, was_started | usable)
    tl.store(frames_o + b, tl.load(frames + b) + usable.to(tl.int64))
    tl.store(skipped_o + b, tl.load(skipped + b) + 1 - usable.to(tl.int64))


@triton.jit
def _append(
    mean_c, covariance_c, weight_c, features_c, R, t, view, matches,
    mean, covariance, weight, disagreement, compared, views, reference, features, counts,
    capacity_c, capacity_k, streams,
    near_plane: tl.constexpr, paper: tl.constexpr, channels: tl.constexpr,
    padded: tl.constexpr, chunk: tl.constexpr,
):  # fmt: skip
    b = tl.program_id(0).to(tl.int64)
    R, t = R + 9 * b, t + 3 * b
    lane = tl.arange(0, chunk)
    f = tl.arange(0, padded)
    n = 0
    for first in range(0, capacity_k, chunk):
        k = first + lane
        n += tl.sum((tl.load(weight + b * capacity_k + k, mask=k < capacity_k, other=0.0) > 0).to(tl.int32), 0)
    segments, matched, dropped, added = 0, 0, 0, 0
    for first in range(0, capacity_c, chunk):
        inside = first + lane < capacity_c
        c = b * capacity_c + first + lane
        pi = tl.load(weight_c + c, mask=inside, other=0.0)
        valid = inside & (pi > 0)
        x = tl.load(mean_c + 3 * c, mask=valid, other=0.0)
        y = tl.load(mean_c + 3 * c + 1, mask=valid, other=0.0)
        z = tl.load(mean_c + 3 * c + 2, mask=valid, other=0.0)
        matching = tl.load(matches + c, mask=inside, other=0) != 0
        new = valid & (z > exact(near_plane, z)) & ~matching
        dropped += tl.sum((valid & (z <= exact(near_plane, z))).to(tl.int32), 0)
        matched += tl.sum((valid & matching).to(tl.int32), 0)
        segments += tl.sum(valid.to(tl.int32), 0)
        slot = n + tl.cumsum(new.to(tl.int32), 0) - 1
        has_slot = new & (slot < capacity_k)
        k = b * capacity_k + slot
        x, y, z = moved(R, t, x, y, z)
        xx, xy, xz, yy, yz, zz = load_symmetric(covariance_c + 9 * c, valid)
        xx, xy, xz, yy, yz, zz = turned(R, xx, xy, xz, yy, yz, zz)
        tl.store(mean + 3 * k, x, mask=has_slot)
        tl.store(mean + 3 * k + 1, y, mask=has_slot)
        tl.store(mean + 3 * k + 2, z, mask=has_slot)
        store_symmetric(covariance + 9 * k, xx, xy, xz, yy, yz, zz, has_slot)
        tl.store(weight + k, pi, mask=has_slot)
        tl.store(disagreement + k, pi * 0.0, mask=has_slot)
        tl.store(compared + k, pi if paper else pi * 0.0, mask=has_slot)
        tl.store(views + k, pi * 0.0, mask=has_slot)
        for i in tl.static_range(4):
            tl.store(reference + 5 * k + i, pi * 0.0 + tl.load(view + 4 * b + i), mask=has_slot)
        tl.store(reference + 5 * k + 4, pi * 0.0, mask=has_slot)
        if channels > 0:
            stored = has_slot[:, None] & (f < channels)[None, :]
            value = tl.load(features_c + c[:, None] * channels + f[None, :], mask=stored, other=0.0)
            tl.store(features + k[:, None] * channels + f[None, :], value, mask=stored)
        dropped += tl.sum((new & ~has_slot).to(tl.int32), 0)
        added += tl.sum(has_slot.to(tl.int32), 0)
        n += tl.sum(has_slot.to(tl.int32), 0)
    tl.store(counts + b, n)
    tl.store(counts + streams + b, segments)
    tl.store(counts + 2 * streams + b, matched)
    tl.store(counts + 4 * streams + b, added)
    tl.store(counts + 5 * streams + b, dropped)

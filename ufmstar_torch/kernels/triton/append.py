"""The ends of a step on a GPU: where the cameras are, and the components that a frame adds.

What finds no slot stays in a mask beside the frame's Gaussians, so that a later launch can append it: the number of
slots is known to the host one frame late (``kernels.step_device``).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
import triton
import triton.language as tl
from torch import Tensor

from ufmstar_torch.frame import FrameInput
from ufmstar_torch.kernels.triton.launch import launch, power_of_two
from ufmstar_torch.kernels.triton.matrices import exact, load_symmetric, moved, store_symmetric, turned
from ufmstar_torch.mixture import GaussianMixture
from ufmstar_torch.state import UfMStarState

# Rows of a frame's counts [8, B] int64.
COMPONENTS, SEGMENTS, MATCHED, PAIRS, NEW, DROPPED, VALID, UNMEASURED = range(8)
COUNTS = 8


@dataclass(frozen=True)
class Cameras:
    """Cameras and counters of B streams after a frame.

    Attributes:
        first: [B, 4, 4] float64 pose of the first camera.
        to_camera: R [B, 3, 3] and t [B, 3] float64 from the first camera's frame into the present one's.
        to_first: the way back.
        started, frames, skipped: [B] of the new state.
    """

    first: Tensor
    to_camera: tuple[Tensor, Tensor]
    to_first: tuple[Tensor, Tensor]
    started: Tensor
    frames: Tensor
    skipped: Tensor


def cameras(state: UfMStarState, frame: FrameInput) -> Cameras:
    """Poses relative to the first camera's, in one launch; a stream at fault keeps its counters and its first pose."""
    b = frame.depth.shape[0]
    first = torch.empty_like(state.T_world_first)
    motion = first.new_empty(2, b, 3, 3)
    shift = first.new_empty(2, b, 3)
    counters = state.frames.new_empty(2, b)
    started = torch.empty_like(state.started)
    launch(
        _cameras, (b,), state.T_world_first, frame.T_world_cam.contiguous(), frame.fault, state.started, state.frames,
        state.skipped, first, motion[0], shift[0], motion[1], shift[1], started, counters[0], counters[1], warps=1,
    )  # fmt: skip
    return Cameras(first, (motion[0], shift[0]), (motion[1], shift[1]), started, counters[0], counters[1])


def append(
    mixture: GaussianMixture,
    current: GaussianMixture,
    to_first: tuple[Tensor, Tensor],
    chosen: Tensor,
    counts: Tensor,
    *,
    near_plane: float,
    again: bool,
    last: bool,
) -> tuple[Tensor, Tensor]:
    """Add Gaussians of a frame to ``mixture``, in place, and count what happened.

    Args:
        mixture: [B, K], of this step's own memory.
        current: C_i in the camera frame, [B, C].
        to_first: R and t into the mixture's frame.
        chosen: [B, C] bool: with ``again`` what is to be added, else what matched and is not.
        counts: [8, B] int64, written without ``again``.
        near_plane: what is nearer is not remembered [m].
        again: whether the Gaussians found no slot before.
        last: whether the mixture cannot grow: what finds no slot is dropped.

    Returns:
        Mask [B, C] of the Gaussians that found no slot and wait; the number of slots that would hold all [B] int32.
    """
    b, c = current.weight.shape
    left = torch.empty(b, c, dtype=torch.bool, device=counts.device)
    needed = torch.empty(b, dtype=torch.int32, device=counts.device)
    channels = mixture.features.shape[2]
    launch(
        _append, (b,), current.mean, current.covariance, current.weight, current.features, *to_first, chosen,
        *mixture.tensors().values(), counts, left, needed, c, mixture.capacity, b,
        near_plane=near_plane, again=again, last=last, channels=channels, padded=power_of_two(channels), chunk=128,
    )  # fmt: skip
    return left, needed


@triton.jit
def _relative(a, b, R, t):
    """The motion of points of camera a into camera b, poses [4, 4] in memory (``camera.relative_pose``)."""
    for i in tl.static_range(3):
        x, y, z = tl.load(b + i), tl.load(b + 4 + i), tl.load(b + 8 + i)
        for j in tl.static_range(3):
            tl.store(R + 3 * i + j, x * tl.load(a + j) + y * tl.load(a + 4 + j) + z * tl.load(a + 8 + j))
        dx, dy, dz = tl.load(a + 3) - tl.load(b + 3), tl.load(a + 7) - tl.load(b + 7), tl.load(a + 11) - tl.load(b + 11)
        tl.store(t + i, x * dx + y * dy + z * dz)


@triton.jit
def _cameras(
    T_first, T_now, fault, started, frames, skipped, first, R_cam, t_cam, R_first, t_first, started_o, frames_o,
    skipped_o,
):  # fmt: skip
    b = tl.program_id(0).to(tl.int64)
    fine = tl.load(fault + b) == 0
    before = tl.load(started + b) != 0
    now = T_now + 16 * b
    base = T_first + 16 * b
    if fine & (before == 0):
        base = now
    entry = tl.arange(0, 16)
    tl.store(first + 16 * b + entry, tl.load(base + entry))
    _relative(base, now, R_cam + 9 * b, t_cam + 3 * b)
    _relative(now, base, R_first + 9 * b, t_first + 3 * b)
    tl.store(started_o + b, before | fine)
    tl.store(frames_o + b, tl.load(frames + b) + fine.to(tl.int64))
    tl.store(skipped_o + b, tl.load(skipped + b) + 1 - fine.to(tl.int64))


@triton.jit
def _append(
    mean_c, covariance_c, weight_c, features_c, R, t, chosen,
    mean, covariance, weight, disagreement, count, features, counts, left, needed, many_c, many_k, streams,
    near_plane: tl.constexpr, again: tl.constexpr, last: tl.constexpr, channels: tl.constexpr, padded: tl.constexpr,
    chunk: tl.constexpr,
):  # fmt: skip
    b = tl.program_id(0).to(tl.int64)
    R, t = R + 9 * b, t + 3 * b
    lane = tl.arange(0, chunk)
    f = tl.arange(0, padded)
    n = 0
    for first in range(0, many_k, chunk):
        k = first + lane
        n += tl.sum((tl.load(weight + b * many_k + k, mask=k < many_k, other=0.0) > 0).to(tl.int32), 0)
    segments, matched, dropped, added, waiting = 0, 0, 0, 0, 0
    for first in range(0, many_c, chunk):
        there = first + lane < many_c
        c = b * many_c + first + lane
        pi = tl.load(weight_c + c, mask=there, other=0.0)
        valid = there & (pi > 0)
        x = tl.load(mean_c + 3 * c, mask=valid, other=0.0)
        y = tl.load(mean_c + 3 * c + 1, mask=valid, other=0.0)
        z = tl.load(mean_c + 3 * c + 2, mask=valid, other=0.0)
        flag = tl.load(chosen + c, mask=there, other=0) != 0
        if again:
            new = valid & flag
        else:
            new = valid & (z > exact(near_plane, z)) & ~flag
            dropped += tl.sum((valid & (z <= exact(near_plane, z))).to(tl.int32), 0)
            matched += tl.sum((valid & flag).to(tl.int32), 0)
        segments += tl.sum(valid.to(tl.int32), 0)
        slot = n + tl.cumsum(new.to(tl.int32), 0) - 1
        fits = new & (slot < many_k)
        k = b * many_k + slot
        x, y, z = moved(R, t, x, y, z)
        xx, xy, xz, yy, yz, zz = load_symmetric(covariance_c + 9 * c, 1, valid)
        xx, xy, xz, yy, yz, zz = turned(R, xx, xy, xz, yy, yz, zz)
        tl.store(mean + 3 * k, x, mask=fits)
        tl.store(mean + 3 * k + 1, y, mask=fits)
        tl.store(mean + 3 * k + 2, z, mask=fits)
        store_symmetric(covariance + 9 * k, xx, xy, xz, yy, yz, zz, fits)
        tl.store(weight + k, pi, mask=fits)
        tl.store(disagreement + k, pi * 0.0, mask=fits)
        tl.store(count + k, (lane * 0 + 1).to(tl.int64), mask=fits)
        if channels > 0:
            wanted = fits[:, None] & (f < channels)[None, :]
            value = tl.load(features_c + c[:, None] * channels + f[None, :], mask=wanted, other=0.0)
            tl.store(features + k[:, None] * channels + f[None, :], value, mask=wanted)
        over = new & ~fits
        if last:
            dropped += tl.sum(over.to(tl.int32), 0)
            added -= tl.sum(over.to(tl.int32), 0)
            over = over & (lane < 0)
        tl.store(left + c, over, mask=there)
        n += tl.sum(fits.to(tl.int32), 0)
        added += tl.sum(new.to(tl.int32), 0)
        waiting += tl.sum(over.to(tl.int32), 0)
    tl.store(needed + b, n + waiting)
    if not again:
        tl.store(counts + b, n)
        tl.store(counts + streams + b, segments)
        tl.store(counts + 2 * streams + b, matched)
        tl.store(counts + 4 * streams + b, added)
        tl.store(counts + 5 * streams + b, dropped)

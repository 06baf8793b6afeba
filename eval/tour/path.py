"""``tour_path``: a hand-held camera that walks a way through a tour."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ufmstar_torch.eval.tour.route import SPACING
from ufmstar_torch.eval.tour.shapes import rotation
from ufmstar_torch.eval.tour.style import style_of
from ufmstar_torch.eval.tour.tour import Tour
from ufmstar_torch.runtime.kinds import check_kinds

Array = NDArray[np.float64]

_STEP, _TURN = 0.16, np.radians(8.0)  # approximate motion per frame: translation [m] or rotation [rad]
_SLOWEST, _FASTEST = 0.5, 1.3  # limits of the pace as shares of that motion; with more frames, the way is repeated
# Shares of a way after which the camera has seen its last room, is back at its start, and has repeated the first views.
_ENOUGH_TO_SEE, _ENOUGH_TO_RETURN, _ONCE_MORE = 0.6, 0.95, 1.12
_LOOKAHEAD, _SMOOTH = 0.7, 0.4  # distance of the point that the camera looks at, and smoothing of its direction [m]
# Pace of a drive per frame as shares of the room's width, from the slowest to the fastest, and its largest yaw, pitch
# and roll about the axis [rad].
_PACE, _STEERING = (0.02, 0.06), np.radians(3.0)
SWAY = 0.04  # largest sway of the hand on each axis [m]
_GLANCE, _PITCH, _ROLL = np.radians(22.0), np.radians(4.0), np.radians(1.2)


@check_kinds
def tour_path(tour: Tour, frames: int, seed: int | None = None, *, pan: bool = False) -> Tensor:
    """[N, 4, 4] float64 camera-to-world poses [m] of a camera that walks through the rooms and returns.

    Without ``seed``, the camera starts in the first room, walks to the farthest room that the frames allow and back,
    and repeats the start. (If the last room has another style, the camera always goes there, and returns only if the
    frames allow.) With ``seed``, it starts anywhere on the longest way, in either direction. In a corridor or a street
    it drives along the axis at a pace that the seed determines. With ``pan``, it stays at the start and turns; the sway
    of the hand is its only baseline. Raises ValueError: no frame, or a negative seed.
    """
    if frames < 1:
        raise ValueError(f"frames must be at least 1, got {frames}")
    if seed is not None and seed < 0:
        raise ValueError(f"seed must be None or at least 0, got {seed}")
    rng = np.random.default_rng([tour.seed, 101] if seed is None else [tour.seed, 102, seed])
    if style_of(tour.room_styles[0]).length is not None:
        poses = _drive(tour, frames, rng)
    elif seed is None:
        way, share = _way_within(tour, frames)
        poses = _poses(tour, way, _samples(way, frames, share), rng)
    else:
        way = tour.ways[-1] if rng.random() < 0.5 else tour.ways[-1][::-1].copy()
        way = np.roll(way, -int(rng.integers(len(way))), axis=0)
        poses = _poses(tour, way, _samples(way, frames, min(1.0, frames / _effort(way)[-1])), rng)
    if pan:
        sway = np.stack([_waves(_STEP * np.arange(frames, dtype=np.float64), rng, 0.35, 1.1) for _ in range(3)], 1)
        poses[:, :3, 3] = poses[0, :3, 3] + 0.7 * SWAY * sway
        poses[:, :3, :3] = np.stack([rotation(1, i * _TURN / 2) @ poses[0, :3, :3] for i in range(frames)])
    return torch.from_numpy(poses)


def _drive(tour: Tour, frames: int, rng: np.random.Generator) -> Array:
    """Poses along the axis of a long room, in either direction, with a vehicle's small motions."""
    way, width = tour.ways[0], float(tour.rooms[0, 1, 0] - tour.rooms[0, 0, 0])
    backwards = bool(rng.random() < 0.5)
    pace = min(float(rng.uniform(*_PACE)) * width, SPACING * (len(way) - 1) / frames)
    start = float(rng.uniform(0, SPACING * (len(way) - 1) - pace * frames))
    metres = start + pace * np.arange(frames)
    widths = np.asarray(metres / width, np.float64)
    x, yaw, pitch, roll = (_waves(widths, rng, 0.1, 0.4) for _ in range(4))
    poses = np.tile(np.eye(4), (frames, 1, 1))
    for i in range(frames):
        heading = np.pi * backwards + _STEERING * yaw[i]
        turned = rotation(1, heading) @ rotation(0, _STEERING * (pitch[i] / 3 - 1))
        poses[i, :3, :3] = turned @ rotation(2, _STEERING / 3 * roll[i])
        z = way[-1, 1] - metres[i] if backwards else way[0, 1] + metres[i]
        poses[i, :3, 3] = way[0, 0] + SWAY * x[i], -tour.camera_height, z
    return poses


def _way_within(tour: Tour, frames: int) -> tuple[Array, float]:
    """The farthest way within a number of frames, and the share of it to walk."""
    shares = [_FASTEST * frames / float(_effort(way)[-1]) for way in tour.ways]
    if len(set(tour.room_styles)) > 1:  # a tour must reach a last room of another style at any pace
        k = len(tour.ways) - (1 if shares[-1] >= _ONCE_MORE else 2)
        return tour.ways[k], min(_ONCE_MORE, max(shares[k], _ENOUGH_TO_SEE))
    k = max((k for k, share in enumerate(shares) if share >= _ENOUGH_TO_RETURN), default=0)
    return tour.ways[k], min(_ONCE_MORE, shares[k])


def _effort(way: Array) -> Array:
    """[M + 1] number of frames up to each sample of the closed way at the usual pace."""
    yaw = _gaze(way)
    turned = np.abs(np.diff(np.concatenate([yaw, [_next(yaw)]])))
    return np.concatenate([[0.0], np.cumsum(np.hypot(SPACING / _STEP, turned / _TURN))])


def _next(yaw: Array) -> float:
    """The first yaw, continued after the last one without a jump."""
    return float(yaw[-1] + (yaw[0] - yaw[-1] + np.pi) % (2 * np.pi) - np.pi)


def _samples(way: Array, frames: int, share: float) -> Array:
    """[frames] positions along the way [samples], evenly by effort; several rounds if the frames allow."""
    effort = _effort(way)
    rounds = max(1, int(frames * _SLOWEST // effort[-1])) if share >= 1 else 1
    effort_done = rounds * share * effort[-1] * np.arange(frames) / frames
    whole, rest = np.divmod(effort_done, effort[-1])
    return whole * len(way) + np.interp(rest, effort, np.arange(len(way) + 1))


def _gaze(way: Array) -> Array:
    """[M] yaw towards a point ahead on the way, smoothed and continuous [rad]."""
    ahead = np.roll(way, -int(_LOOKAHEAD / SPACING), axis=0) - way
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True) + 0.1
    frequency = np.fft.rfftfreq(len(way), SPACING)
    kernel = np.exp(-2 * (np.pi * frequency * _SMOOTH) ** 2)[:, None]
    smooth = np.fft.irfft(np.fft.rfft(ahead, axis=0) * kernel, n=len(way), axis=0)
    return np.unwrap(np.arctan2(smooth[:, 0], smooth[:, 1]))


def _poses(tour: Tour, way: Array, s: Array, rng: np.random.Generator) -> Array:
    yaw = _gaze(way)
    turns = _next(yaw) - yaw[0]
    samples = np.arange(len(way) + 1)
    rounds, rest = np.divmod(s, len(way))
    x, z = (np.interp(rest, samples, np.append(way[:, k], way[0, k])) for k in (0, 1))
    heading = np.interp(rest, samples, np.append(yaw, yaw[0] + turns)) + rounds * turns
    metres = s * SPACING
    hand = [_waves(metres, rng, 0.35, 1.1) for _ in range(5)]
    glance = _waves(metres, rng, 0.06, 0.14)
    height = tour.camera_height - SWAY * 0.6 * hand[2]
    poses = np.tile(np.eye(4), (len(s), 1, 1))
    for i in range(len(s)):
        direction = heading[i] + _GLANCE * glance[i] + 0.015 * hand[3][i]
        pitch = np.radians(6.0) + _PITCH * hand[4][i] * 0.7
        poses[i, :3, :3] = rotation(1, direction) @ rotation(0, -pitch) @ rotation(2, _ROLL * hand[3][i])
        poses[i, :3, 3] = x[i] + SWAY * 0.7 * hand[0][i], -height[i], z[i] + SWAY * 0.7 * hand[1][i]
    return poses


def _waves(metres: Array, rng: np.random.Generator, slow: float, fast: float) -> Array:
    """A smooth motion within -1 to 1: three waves of random frequency [1/m] and phase."""
    frequency, phase = rng.uniform(slow, fast, 3), rng.uniform(0, 2 * np.pi, 3)
    return np.sin(2 * np.pi * frequency * metres[:, None] + phase).mean(1)

"""Frames for the active-learning example: a pool to pick labels from, and a held-back part of the same place.

Of a tour, the two are walks along the same way with another start, direction, sway and glances; of a
recording, its first 60 % and its last 35 %, so that no neighbour of a labelled frame is judged.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from urllib.parse import parse_qsl

import numpy as np
import torch
from torch import Tensor

from ufmstar_torch.eval.sequences import Frame, FrameSequence
from ufmstar_torch.eval.sequences.ground_truth import truth_at
from ufmstar_torch.eval.sequences.images import image_tensor
from ufmstar_torch.eval.sequences.open import open_sequence
from ufmstar_torch.eval.tour import Tour, make_tour, render, tour_path
from ufmstar_torch.eval.tour.box_room import intrinsics
from ufmstar_torch.models import Preprocess

TOUR = "tour:"
# Rooms by the style of a tour's; the shipped networks were trained in homes and saw no hall.
ROOMS = {"home": "seen", "hall": "unseen"}
_POOL_PATH, _HELD_BACK_PATH = 0, 1
_SENSOR = 1_000_003  # a sensor's noise differs between the walks
_HELD_BACK_STRIDE = 5  # frames of the walk; views that are judged need no overlap
_POOL_END, _HELD_BACK_START = 0.6, 0.65  # shares of a recording


@dataclass(frozen=True, eq=False)
class View:
    """A posed frame as the network sees it.

    Attributes:
        name: of the frame, unique in its environment.
        image: [3, h, w] float32, the network's input.
        depth: [h, w] float32 ground truth [m], 0 = none: the label, if it is asked for.
        T_world_cam: [4, 4] float64 [m].
        intrinsics: [3, 3] float64 of the network's input [px].
        room: "seen", "unseen", or "" where nobody knows.
    """

    name: str
    image: Tensor
    depth: Tensor
    T_world_cam: Tensor
    intrinsics: Tensor
    room: str = ""


@dataclass(frozen=True, eq=False)
class Environment:
    """One place.

    Attributes:
        name: of the sequence.
        pool: consecutive views, of which some may be labelled.
        held_back: views that are only judged.
    """

    name: str
    pool: tuple[View, ...]
    held_back: tuple[View, ...]


def open_environment(
    sequence: str,
    index: int,
    *,
    frames: int,
    stride: int,
    held_back: int,
    size: tuple[int, int],
    preprocess: Preprocess,
) -> Environment:
    """The environment of the repetition ``index`` (from 0).

    Args:
        sequence: ``tour:SEED?style=STYLE``, whose repetitions are the tours SEED, SEED + 1, ...; or what
            ``open_sequence`` takes, whose repetitions have the same frames.
        index: which repetition.
        frames: of the pool, at most (fewer in a shorter recording).
        stride: every how many steps of the walk one is taken.
        held_back: frames that are judged, at most.
        size: (height, width) that a tour is rendered at [px].
        preprocess: the network's.

    Raises:
        ValueError: a malformed name, or frames without image or depth.
        FileNotFoundError: no such recording.
    """
    if not sequence.startswith(TOUR):
        return _recording(open_sequence(sequence), frames, stride, held_back, preprocess)
    seed, style = parse_tour(sequence)
    tour = make_tour(seed + index, style)
    pool = _walk(tour, size, _POOL_PATH, frames * stride, stride)
    judged = _walk(tour, size, _HELD_BACK_PATH, held_back * _HELD_BACK_STRIDE, _HELD_BACK_STRIDE)

    def rooms(walk: list[Frame]) -> list[str]:
        return [ROOMS[tour.style_at(torch.from_numpy(frame.T_world_cam[:3, 3]))] for frame in walk]

    return Environment(
        f"tour-{seed + index}",
        _views("pool", pool, rooms(pool), preprocess),
        _views("held_back", judged, rooms(judged), preprocess),
    )


def _walk(tour: Tour, size: tuple[int, int], path: int, steps: int, every: int) -> list[Frame]:
    """Every so many steps of a walk, rendered; what ``tour_sequence`` does, without making the rooms again."""
    K = intrinsics(*size)
    poses = tour_path(tour, steps, path)
    frames = []
    for i in range(0, steps, every):
        view = render(tour, poses[i], torch.from_numpy(K), *size, frame_seed=_SENSOR * (1 + path) + i)
        frames.append(Frame(i, f"{i:06d}", view.image.numpy(), view.depth.float().numpy(), poses[i].numpy(), K))
    return frames


def parse_tour(name: str) -> tuple[int, str]:
    """Seed and style of ``tour:SEED?style=STYLE`` (style: ``mixed`` where none is given).

    Raises:
        ValueError: another form.
    """
    number, _, query = name.removeprefix(TOUR).partition("?")
    options = {"style": "mixed", **dict(parse_qsl(query, strict_parsing=bool(query)))}
    if not number.isdecimal() or set(options) != {"style"}:
        raise ValueError(f"a tour is named tour:SEED or tour:SEED?style=STYLE, got {name!r}")
    return int(number), options["style"]


def _recording(
    sequence: FrameSequence, frames: int, stride: int, held_back: int, preprocess: Preprocess
) -> Environment:
    total = len(sequence)
    pool = range(0, int(total * _POOL_END), stride)[:frames]
    judged = np.linspace(int(total * _HELD_BACK_START), total - 1, held_back).round().astype(int)
    parts = {"pool": list(pool), "held_back": sorted(set(judged.tolist()))}
    views = {
        name: _views(name, [sequence[i] for i in part], [""] * len(part), preprocess) for name, part in parts.items()
    }
    return Environment(sequence.name, **views)


def _views(part: str, frames: Iterable[Frame], rooms: list[str], preprocess: Preprocess) -> tuple[View, ...]:
    result = []
    for frame, room in zip(frames, rooms, strict=True):
        if frame.image is None or frame.depth is None:
            raise ValueError(f"frame {frame.name} has no {'image' if frame.image is None else 'depth'}: it needs both")
        image = image_tensor(frame)
        x, K = preprocess(image, torch.from_numpy(frame.intrinsics)[None])
        truth = truth_at(frame, K[0].numpy(), (x.shape[-2], x.shape[-1]))
        assert truth is not None
        pose = torch.from_numpy(frame.T_world_cam)
        result.append(View(f"{part}/{frame.name}", x[0], torch.from_numpy(truth), pose, K[0], room))
    return tuple(result)

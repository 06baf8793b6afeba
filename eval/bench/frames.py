"""The benchmark's frames: image, pose and a predicted depth map, of a rendered tour or of a recording."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import islice
from typing import NamedTuple

import torch
from torch import Tensor, nn

from ufmstar_torch.eval.bench.settings import TOUR
from ufmstar_torch.eval.sequences.frame import Frame, FrameError, FrameSequence
from ufmstar_torch.eval.sequences.images import image_tensor
from ufmstar_torch.eval.tour.open import open_sequence
from ufmstar_torch.models import Preprocess
from ufmstar_torch.models.network import DepthNetwork
from ufmstar_torch.prediction import DepthPrediction, infer

_ERROR = 0.03  # [1] standard deviation of the relative error of the depth that stands for a network's
_GRID = 4  # nodes per side of that error, between which it is interpolated


class BenchFrame(NamedTuple):
    """One frame of one stream.

    Attributes:
        image: [1, 3, H, W] uint8.
        pose: [1, 4, 4] float64 camera-to-world [m].
        intrinsics: [1, 3, 3] of the image [px].
        network_input: [1, 3, h, w].
        map_intrinsics: [1, 3, 3] of the network's input and of the depth map [px].
        prediction: [1, h, w] depth [m], and variances if the network predicts any.
    """

    image: Tensor
    pose: Tensor
    intrinsics: Tensor
    network_input: Tensor
    map_intrinsics: Tensor
    prediction: DepthPrediction


def read_frames(
    name: str, count: int, *, network: DepthNetwork | None, size: int, device: torch.device
) -> list[BenchFrame]:
    """The first ``count`` frames of a sequence that can be read.

    Args:
        name: of the sequence, see ``open_sequence``; the default tour is rendered at ``size`` x ``size``.
        count: of the frames.
        network: predicts the depth; None = the sequence's depth with smooth errors of 3 %, cropped to the centre and
            resized to ``size`` x ``size`` pixels.
        size: see above [px].
        device: of the results.

    Raises:
        ValueError: too few frames, or frames without depth and no network.
    """
    sequence = open_sequence(f"{TOUR}?frames={count}&size={size}x{size}" if name == TOUR else name)
    frames = list(islice(_readable(sequence), count))
    if len(frames) < count:
        raise ValueError(f"{name} has {len(frames)} frames that can be read, --history and --frames need {count}")
    if network is not None:
        return [_predicted(frame, network, device) for frame in frames]
    if any(frame.depth is None for frame in frames):
        raise ValueError(f"{name} has frames without a depth map: predict depth with --model and --weights")
    generator = torch.Generator().manual_seed(0)
    return [_with_errors(frame, size, generator, device) for frame in frames]


def _readable(sequence: FrameSequence) -> Iterator[Frame]:
    unreadable: list[FrameError] = []
    yield from sequence.readable(unreadable.append)


def _predicted(frame: Frame, network: DepthNetwork, device: torch.device) -> BenchFrame:
    image, pose, K = _inputs(frame, device)
    x, map_intrinsics = network.preprocess(image, K)
    with torch.inference_mode():
        prediction = infer(network, x, map_intrinsics)
    return BenchFrame(image, pose, K, x, map_intrinsics, prediction)


def _with_errors(frame: Frame, size: int, generator: torch.Generator, device: torch.device) -> BenchFrame:
    image, pose, K = _inputs(frame, device)
    square = Preprocess(resize_height=size, crop=(size, size))
    x, _ = square(image, K)
    depth, depth_K = (
        torch.from_numpy(frame.depth)[None],
        frame.intrinsics if frame.depth_intrinsics is None else frame.depth_intrinsics,
    )
    map_intrinsics = square.apply_intrinsics(torch.from_numpy(depth_K)[None], *depth.shape[-2:])
    error = _ERROR * torch.randn(1, 1, _GRID, _GRID, generator=generator)
    smooth = nn.functional.interpolate(error, (size, size), mode="bicubic", align_corners=True)[0]
    flickering = (square.apply_depth(depth) * (1 + smooth)).to(device)
    return BenchFrame(image, pose, K, x, map_intrinsics.to(device), DepthPrediction(flickering))


def _inputs(frame: Frame, device: torch.device) -> tuple[Tensor, Tensor, Tensor]:
    """Image, pose and intrinsics."""
    pose, K = torch.from_numpy(frame.T_world_cam)[None], torch.from_numpy(frame.intrinsics)[None]
    return image_tensor(frame).to(device), pose.to(device), K.to(device)

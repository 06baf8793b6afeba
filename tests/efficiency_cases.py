"""A short tour and networks that predict its depth, for the tests of the cost of uncertainty."""

from __future__ import annotations

import functools

import numpy as np
import torch
from tiny_networks import Linear

from ufmstar_torch.eval.sequences import open_sequence
from ufmstar_torch.eval.sequences.frame import Entry, FrameSequence, make_sequence
from ufmstar_torch.models.heads import UncertaintyNetwork, with_head
from ufmstar_torch.models.network import Backbone
from ufmstar_torch.models.preprocess import Preprocess

SIZE = (64, 96)


def network(
    head: str = "aleatoric", offset: float = 0.2, dropout: float = 0.0, backbone: type[Linear] = Linear
) -> UncertaintyNetwork:
    """A network: depth = 5 m times the red channel of the image + ``offset``."""
    torch.manual_seed(0)
    inside: Backbone = backbone(weights=(5.0, 0.0), offset=offset, dropout=dropout)
    inside.preprocess = Preprocess(size=SIZE)
    return with_head(inside, head).eval()


@functools.cache
def room_sequence(frames: int = 8) -> FrameSequence:
    """Views of a room. The red channel of the image is the depth [5 m]."""
    height, width = SIZE
    rendered = open_sequence(f"tour:1?frames=150&size={height}x{width}&sensor=0")
    tour = [rendered[index] for index in range(frames)]

    def image(depth: np.ndarray) -> np.ndarray:
        red = np.zeros((*SIZE, 3), np.uint8)
        red[..., 0] = np.clip(51 * depth, 1, 255)
        return red

    entries = [Entry(frame.name, frame.T_world_cam, functools.partial(image, frame.depth)) for frame in tour]
    return make_sequence("room", "rendered", entries, tour[0].intrinsics, image_size=SIZE)

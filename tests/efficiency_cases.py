"""A rendered room and networks that see its depth, for the tests of what uncertainty costs."""

from __future__ import annotations

import numpy as np
import torch
from tiny_networks import Linear

from ufmstar_torch.eval.methods.method import Method
from ufmstar_torch.eval.methods.row import Row
from ufmstar_torch.eval.sequences.frame import Entry, FrameSequence, make_sequence
from ufmstar_torch.eval.tour import box_room as synthetic
from ufmstar_torch.models.heads import UncertaintyNetwork, with_head
from ufmstar_torch.models.network import Backbone
from ufmstar_torch.models.preprocess import Preprocess

SIZE = (96, 128)


def rows_of(*names: str) -> list[Row]:
    return [Row(Method.parse(name)) for name in names]


def network(
    head: str = "aleatoric", offset: float = 0.2, dropout: float = 0.0, backbone: type[Linear] = Linear
) -> UncertaintyNetwork:
    """Depth is what :func:`room_sequence` hides in the image's red, plus ``offset``."""
    torch.manual_seed(0)
    inside: Backbone = backbone(weights=(5.0, 0.0), offset=offset, dropout=dropout)
    inside.preprocess = Preprocess(size=SIZE)
    return with_head(inside, head).eval()


def room_sequence(frames: int = 8) -> FrameSequence:
    """Views of a room whose depth [5 m] is the red of the image."""
    room, K = synthetic.BoxRoom.furnished(10, 0), synthetic.intrinsics(*SIZE)

    def entry(n: int, T: np.ndarray) -> Entry:
        depth = synthetic.render(room, T, K, *SIZE)
        image = np.zeros((*SIZE, 3), np.uint8)
        image[..., 0] = np.clip(51 * depth, 1, 255)
        return Entry(f"{n:03d}", T, lambda: image)

    entries = [entry(n, T) for n, T in enumerate(synthetic.walk(frames, 100))]
    return make_sequence("room", "rendered", entries, K, image_size=SIZE)

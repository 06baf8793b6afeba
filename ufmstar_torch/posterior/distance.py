"""Geodesic distance of every node from the nearest evidence, along the links of the grid."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import pad


def distance(source: Tensor, right: Tensor, down: Tensor, cols: int, limit: float) -> Tensor:
    """Relax every node over its four neighbours until no distance changes.

    Args:
        source: [B, n] bool, True at nodes with evidence.
        right, down: [B, n] positive lengths of the links to the next node in the row, in the column; infinite where
            there is none.
        cols: nodes in a row.
        limit: upper limit of the distances.

    Returns:
        [B, n] distances.
    """
    b, n = source.shape
    across, along = right.view(b, -1, cols)[..., :-1], down.view(b, -1, cols)[:, :-1]
    length = torch.where(source, 0.0, right.new_tensor(limit)).view(b, n // cols, cols)
    for _ in range(n):
        candidates = [
            length,
            pad(length[..., 1:] + across, (0, 1), value=limit),
            pad(length[..., :-1] + across, (1, 0), value=limit),
            pad(length[:, 1:] + along, (0, 0, 0, 1), value=limit),
            pad(length[:, :-1] + along, (0, 0, 1, 0), value=limit),
        ]
        shorter = torch.stack(candidates).amin(0)
        if length.device.type != "meta" and torch.equal(shorter, length):
            break
        length = shorter
    return length.flatten(1)

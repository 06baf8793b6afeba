"""Geodesic distance of every node from the nearest evidence, along the links of the grid."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import pad


def distance(source: Tensor, right: Tensor, down: Tensor, cols: int, limit: float) -> Tensor:
    """Every node takes the shortest way by a neighbour, until nothing gets shorter.

    Args:
        source: [B, n] bool.
        right, down: [B, n] positive lengths of the links to the next node in the row, in the column; infinite where
            there is none.
        cols: nodes in a row.
        limit: longest way that counts.

    Returns:
        [B, n] at most ``limit``.
    """
    b, n = source.shape
    across, along = right.view(b, -1, cols)[..., :-1], down.view(b, -1, cols)[:, :-1]
    way = torch.where(source, 0.0, right.new_tensor(limit)).view(b, n // cols, cols)
    for _ in range(n):
        ways = [
            way,
            pad(way[..., 1:] + across, (0, 1), value=limit),
            pad(way[..., :-1] + across, (1, 0), value=limit),
            pad(way[:, 1:] + along, (0, 0, 0, 1), value=limit),
            pad(way[:, :-1] + along, (0, 0, 1, 0), value=limit),
        ]
        shorter = torch.stack(ways).amin(0)
        if way.device.type != "meta" and torch.equal(shorter, way):
            break
        way = shorter
    return way.flatten(1)

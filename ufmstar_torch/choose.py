"""Chooses images to label or to train on by a score of every image, as ``UfMStar.mean_uncertainty`` computes it."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor


def choose(
    scores: Tensor | Sequence[float],
    count: int | None = None,
    *,
    poses: Tensor | None = None,
    distance: float = 1.0,
    sequences: Sequence[object] | None = None,
) -> list[int]:
    """The images with the highest scores, best first; of equal ones the earlier. NaN or -inf = no score: never
    chosen.

    With ``poses`` the choice is diverse, a greedy farthest-point choice weighted by the scores: the next image is the
    one with the largest s_i min(1, min_j d_ij) over the chosen j, where d_ij = |t_i - t_j| / distance + the angle
    between the viewing directions [rad]. Beyond d = 1 two views share little, and the score alone decides.

    Args:
        scores: [N], with ``poses`` not negative.
        count: None = all that have a score.
        poses: [N, 4, 4] camera-to-world [m], finite where there is a score.
        distance: to what the camera sees, its median depth, say [m].
        sequences: which sequence each image is of; views of different ones are as far as can be. None = one.

    Raises:
        ValueError: shapes that disagree, a negative score or distance with poses, a pose that is not finite, or a count
            that is no whole number or out of range.
    """
    score = torch.as_tensor(scores, dtype=torch.float64)
    if score.dim() != 1:
        raise ValueError(f"scores must be [N], got {tuple(score.shape)}")
    left = torch.where(score.isnan(), -torch.inf, score)
    scored = left > -torch.inf
    scored_count = int(scored.sum())
    if count is not None and not (isinstance(count, int) and 0 <= count <= len(score)):
        raise ValueError(f"count must lie in 0 to the number of images {len(score)}, got {count}")
    count = scored_count if count is None else min(count, scored_count)
    if poses is None:
        order: list[int] = left.argsort(descending=True, stable=True)[:count].tolist()
        return order
    if poses.shape != (len(score), 4, 4) or (sequences is not None and len(sequences) != len(score)):
        raise ValueError(f"poses must be [{len(score)}, 4, 4], one of each score, and sequences as many")
    if bool((score < 0).any()) or not distance > 0:
        raise ValueError(f"a diverse choice needs scores of at least 0 and a positive distance, got {distance}")
    if not bool(poses[scored].isfinite().all()):
        raise ValueError("poses must be finite where there is a score")
    position, direction = poses[:, :3, 3].double(), poses[:, :3, 2].double()
    names = {name: number for number, name in enumerate(dict.fromkeys(sequences or ()))}
    sequence = torch.tensor([names[name] for name in sequences]) if sequences is not None else torch.zeros(len(score))
    nearest, chosen = torch.ones_like(score), list[int]()
    for _ in range(count):
        best = int(torch.where(left.isfinite(), left * nearest, left).argmax())
        chosen.append(best)
        cosine = (direction * direction[best]).sum(-1)
        d = (position - position[best]).norm(dim=-1) / distance + cosine.clamp(-1, 1).acos()
        nearest = torch.where(sequence == sequence[best], torch.minimum(nearest, d), nearest)
        left[best] = -math.inf
    return chosen

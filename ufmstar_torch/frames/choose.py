"""Choice of images to label or to train on by their scores, for example ``UfMStar.mean_uncertainty``."""

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
    """Indices of the images with the highest scores, best first; among equal scores, the earlier image. An image with
    the score NaN or -inf is never chosen.

    With ``poses``, the choice is a greedy farthest-point choice weighted by the scores: the next image maximises
    s_i min(1, min_j d_ij) over the chosen j, where d_ij = |t_i - t_j| / distance + the angle between the viewing
    directions [rad]. Beyond d = 1 two views share little, and only the score counts.

    Args:
        scores: [N], with ``poses`` not negative.
        count: None = all images with a score.
        poses: [N, 4, 4] camera-to-world [m], finite where there is a score.
        distance: typical distance of the scene, for example its median depth [m].
        sequences: the sequence of each image; d is infinite between sequences. None = one sequence.

    Raises:
        ValueError: shapes that disagree, a negative score or distance with poses, a pose that is not finite, or a count
            that is no whole number or out of range.
    """
    score = torch.as_tensor(scores, dtype=torch.float64)
    if score.dim() != 1:
        raise ValueError(f"scores must be [N], got {tuple(score.shape)}")
    remaining = torch.where(score.isnan(), -torch.inf, score)
    scored = remaining > -torch.inf
    scored_count = int(scored.sum())
    if count is not None and not (isinstance(count, int) and 0 <= count <= len(score)):
        raise ValueError(f"count must lie in 0 to the number of images {len(score)}, got {count}")
    count = scored_count if count is None else min(count, scored_count)
    if poses is None:
        order: list[int] = remaining.argsort(descending=True, stable=True)[:count].tolist()
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
        best = int(torch.where(remaining.isfinite(), remaining * nearest, remaining).argmax())
        chosen.append(best)
        cosine = (direction * direction[best]).sum(-1)
        d = (position - position[best]).norm(dim=-1) / distance + cosine.clamp(-1, 1).acos()
        nearest = torch.where(sequence == sequence[best], torch.minimum(nearest, d), nearest)
        remaining[best] = -math.inf
    return chosen

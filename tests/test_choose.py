"""Image selection: an image's mean uncertainty, and the order of the choice."""

from __future__ import annotations

import math

import torch

import scenes
from ufmstar_torch import UfMStar, UfMStarConfig
from ufmstar_torch.frames.choose import choose

DEPTHS, POSES, K = scenes.sequence(4, 48, 64, 0.05)


# ---- what an image's mean says ----


def test_parts_have_their_own_statistics():
    ufm, dense = (UfMStar(UfMStarConfig(unmeasured="nan", ema_alpha=1.0)) for _ in range(2))
    for depth, pose in zip(DEPTHS, POSES, strict=True):
        d = torch.tensor(depth)[None]
        frame = d, torch.tensor(pose), torch.tensor(K), 0.01 * d**2, 0.02 * d
        out, mean = dense(*frame), ufm.mean_uncertainty(*frame, fraction=1.0)
    maps = {"total": out.variance, "disagreement": out.disagreement, "aleatoric": frame[3], "epistemic": frame[4]}
    for name, values in (maps | {"depth": d}).items():
        part, pixels = getattr(mean, name), values[out.valid & ~values.isnan()].double()
        assert int(part.pixels) == len(pixels)
        expected = pixels.mean(), pixels.var(), pixels.median(), pixels.max()
        actual = part.mean, part.variance, part.median, part.maximum
        torch.testing.assert_close(torch.cat(actual).double(), torch.stack(expected), rtol=1e-4, atol=0)
    assert mean.anchored is None


# ---- the order of choice ----


def along(positions, angle=0.0):
    poses = torch.eye(4, dtype=torch.float64).repeat(len(positions), 1, 1)
    poses[:, 0, 3] = torch.tensor(positions)
    poses[-1, :3, 2] = torch.tensor([math.sin(angle), 0, math.cos(angle)])
    return poses


def test_the_best_come_first():
    assert choose([1.0, 3.0, math.nan, 3.0, 2.0]) == [1, 3, 4, 0]
    assert choose([1.0, 3.0, math.nan, 3.0, 2.0], 2) == [1, 3]
    assert choose([]) == []
    assert choose([math.nan, -math.inf, 1.0], 3) == [2], "a score of -inf counts as missing"


def test_a_diverse_choice_leaves_out_neighbours():
    scores = [1.0, 0.9, 0.8, 0.5]
    poses = along([0.0, 0.1, 0.2, 3.0])
    assert choose(scores, poses=poses) == [0, 3, 2, 1], ".8 / 5 is less than .5, and more than .9 / 10"
    assert choose(scores, 2, poses=poses, distance=0.1) == [0, 1], "near surfaces are out of view 10 cm to the side"
    assert choose(scores, 2, poses=poses, sequences=["a", "b", "b", "b"]) == [0, 1], "another sequence is elsewhere"
    turned = along([0.0, 0.0, 0.0, 0.0], angle=1.0)
    assert choose(scores, poses=turned)[:2] == [0, 3], "the same place, another direction"
    assert choose([1.0, math.nan, 0.8, 0.5], poses=poses) == [0, 3, 2]
    assert choose([1.0, math.nan], poses=along([0.0, math.nan])) == [0], "a pose without a score does not count"

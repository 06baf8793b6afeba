"""UfM in every mode of the paper, each against the loops written from its description."""

from __future__ import annotations

import numpy as np
import oracle_ufm
import pytest
import torch

import scenes
from ufmstar_torch.eval.methods.ufm import UfM, UfMConfig
from ufmstar_torch.networks_in_turn import combine
from ufmstar_torch.prediction import DepthPrediction

pytestmark = pytest.mark.numerics

H, W, FRAMES, MEMBERS = 15, 20, 16, 3
DEPTHS, POSES, K = scenes.sequence(FRAMES, H, W, 0.0)


def drawn(i, member):
    """A member's depth and A of image i, as an ensemble or a stochastic network would vary them: [H, W]."""
    rng = np.random.default_rng([i, member])
    return DEPTHS[i] * (1 + 0.03 * rng.standard_normal((H, W))), np.exp(rng.normal(-4, 1, (H, W)))


def alone(depth, a=None, e=None):
    return DepthPrediction(*(None if x is None else torch.tensor(x)[None] for x in (depth, a, e)))


def in_turn(i):
    return alone(*drawn(i, i % MEMBERS))


def one_sample(i):
    return alone(*drawn(i, 100 + i))


def aleatoric(i):
    return alone(*drawn(i, 0))


def evidential(i):
    return alone(*drawn(i, 0), drawn(i, 7)[1])


def depth_only(i):
    return alone(drawn(i, 0)[0])


def full(i):
    return combine([alone(*drawn(i, member)) for member in range(MEMBERS)])


MODES = [aleatoric, evidential, in_turn, one_sample, depth_only, full]


@pytest.mark.parametrize("cap", [None, 420], ids=["all", "pruned"])
@pytest.mark.parametrize("mode", MODES, ids=lambda mode: mode.__name__)
def test_agrees_with_the_loops(mode, cap):
    ufm, oracle, pruned = UfM(UfMConfig(max_points=cap), dtype=torch.float64), oracle_ufm.UfM(cap), 0
    for i in range(FRAMES):
        text = mode(i)
        parts = [x for x in (text.aleatoric_variance, text.epistemic_variance) if x is not None]
        s2 = sum(part[0].numpy() for part in parts) if parts else np.zeros((H, W))
        depth = text.depth[0].numpy()
        want = oracle.step(depth, s2, np.isfinite(depth) & (depth > 0), POSES[i], K)
        out = ufm(text.depth, torch.tensor(POSES[i]), torch.tensor(K), text.aleatoric_variance, text.epistemic_variance)
        np.testing.assert_allclose(out.variance[0].numpy(), want, rtol=0, atol=1e-9)
        assert out.statistics.points.tolist() == [len(oracle.points)]
        pruned += int(out.statistics.dropped)
    assert (pruned > 0) == (cap is not None)
    assert int(ufm.clouds()[0].count.max()) > 2, "points must have been seen again"

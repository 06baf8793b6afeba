"""Both tiers of the anchored variance against loops in NumPy."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from oracle_anchors import AnchoredOracle
from walks import HEIGHT, SPGF, WIDTH, oracle_settings

import scenes
from ufmstar_torch import UfMStar, UfMStarConfig
from ufmstar_torch.anchors.evidence import inliers
from ufmstar_torch.anchors.given import AnchorInput, Anchors
from ufmstar_torch.kernels import anchors_cpu

pytestmark = pytest.mark.numerics

ANCHORED = UfMStarConfig(segment=SPGF, regression="exact", anchored=True, anchor_shrinkage=3.0, anchor_half_life=4.0)


def taken(truth, rng, count):
    """(u, v, depth, variance): a third of them far off, positions between pixels, on pixels with a depth."""
    result = []
    while len(result) < count:
        v, u = int(rng.integers(0, HEIGHT)), int(rng.integers(0, WIDTH))
        g = truth[v, u] * (rng.uniform(0.3, 3) if rng.random() < 0.3 else rng.normal(1, 0.02))
        if np.isfinite(g) and g > 0:
            result.append(
                (u + rng.uniform(-0.4, 0.4), v + rng.uniform(-0.4, 0.4), g, (rng.uniform(0.01, 0.3) * g) ** 2)
            )
    return result


def as_anchors(rows):
    u, v, depth, variance = (torch.tensor(column, dtype=torch.float64)[None] for column in zip(*rows, strict=True))
    return Anchors(torch.stack([u, v], dim=-1), depth, variance)


@pytest.fixture(scope="module")
def expected():
    """Inputs and the oracle's answers of seven frames of a network that is 30 % too near, the third without anchors."""
    depths, poses, K = scenes.sequence(7, HEIGHT, WIDTH, 0.04)
    rng = np.random.default_rng(5)
    judge = AnchoredOracle(oracle_settings(SPGF), kappa=3.0, half_life=4.0)
    frames = []
    for i, (truth, T) in enumerate(zip(depths, poses, strict=True)):
        # On the left the network says that it is wrong, and more than it is: B has nothing to add there.
        own = np.where(np.arange(WIDTH) < WIDTH / 3, 4.0, 0.01)
        depth, aleatoric = truth / 1.3, own * (0.5 + rng.random(truth.shape))
        anchors = [] if i == 2 else taken(truth, rng, 3 if i == 0 else 40)
        frames.append((depth, T, aleatoric, anchors, judge.step_anchored(depth, T, K, anchors, aleatoric)))
    return K, frames, judge


@pytest.mark.parametrize("backend", ["torch", "numba"])
def test_a_sequence_agrees_with_the_oracle(expected, backend):
    K, frames, judge = expected
    ours = UfMStar(ANCHORED.replace(backend=backend), dtype=torch.float64)
    rejected = 0
    for depth, T, aleatoric, anchors, (V, B, bias) in frames:
        output = ours(
            torch.tensor(depth)[None],
            torch.tensor(T),
            torch.tensor(K),
            torch.tensor(aleatoric)[None],
            anchors=as_anchors(anchors) if anchors else None,
        )
        for name, value in (("variance", V), ("anchored", B), ("bias", bias)):
            mine = getattr(output, name)[0].numpy()
            np.testing.assert_allclose(mine, value, rtol=1e-7, atol=1e-10, err_msg=name)
        rejected += int(output.statistics.anchors[0] - output.statistics.anchors_used[0])
    assert rejected > 10, "outliers must be put to the test"
    np.testing.assert_allclose(ours.overall_evidence[0].numpy(), judge.total, rtol=1e-9)
    assert 0 < float((output.anchored[output.valid] > 0).double().mean()) < 1, "B is cut off at 0 in some places"


@pytest.mark.parametrize("seed", range(12))
def test_the_compiled_support_is_the_references_own(seed):
    """Clusters, equal positions, wrong tracks and invalid anchors, from none to hundreds."""
    generator = torch.Generator().manual_seed(seed)
    b, n = 2, (1, 2, 3, 4, 5, 9, 12, 40, 100, 300, 301, 500)[seed]

    def uniform(*shape: int) -> torch.Tensor:
        return torch.rand(b, *shape, generator=generator, dtype=torch.float64)

    pixel = (uniform(n, 2) * (200 if seed % 2 else 12)).round()
    predicted = 1 + 4 * uniform(n)
    wrong = uniform(n) < 0.3
    depth = predicted * (1.1 + 0.02 * uniform(n)) * torch.where(wrong, 1 + uniform(n), 1.0)
    variance = 1e-4 * depth.square() * (uniform(n) < 0.5)
    valid = uniform(n) < (0.9 if seed % 3 else 0.5)
    given = AnchorInput(pixel, pixel[..., 0].long(), predicted, depth, variance, 0 * depth, valid)
    expected = inliers(given)
    assert torch.equal(anchors_cpu.inliers(given), expected)
    if n >= 40:
        assert 0 < expected.sum() < valid.sum()

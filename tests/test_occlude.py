"""Components behind all that a frame sees: reference and kernel against the oracle, and what the rule leaves alone."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from random_gaussians import as_lists, mixture

import oracle
import scenes
from ufmstar_torch import SPGFConfig, UfMStar, UfMStarConfig
from ufmstar_torch.frame import FrameInput
from ufmstar_torch.kernels.occlude_cpu import visible
from ufmstar_torch.occlude import hidden, seen_depth

pytestmark = pytest.mark.numerics

SIZE = (40, 56)  # the blocks at the edges are not whole
K = torch.tensor(scenes.intrinsics(*SIZE))


def frame() -> FrameInput:
    """A near surface on the left, a far one on the right, holes, and a corner without depth."""
    depth = torch.full((1, *SIZE), 1.2, dtype=torch.float64)
    depth[:, :, 30:] = 2.5
    depth[:, 20:, :16] = 0.0
    depth[:, ::4, ::3] = 0.0
    return UfMStar(UfMStarConfig(), dtype=torch.float64)._checked(depth, torch.eye(4).double(), K, *[None] * 4)


@pytest.mark.parametrize("ratio", [1.0, 2.0])
def test_reference_and_kernel_agree_with_the_oracle(ratio):
    m = mixture(1, 300, 11, empty=3)
    m = m.replace(
        mean=1.6 * m.mean,
        covariance=m.covariance * 10 ** torch.linspace(-3, 0, 300, dtype=torch.float64)[:, None, None],
    )
    given = frame()
    seen = oracle.seen_depth(given.depth[0].numpy(), given.valid[0].numpy())
    assert np.array_equal(seen_depth(given.depth, given.valid)[0].numpy(), seen)
    assert np.isinf(seen).any()
    expected = [oracle.hidden(g, seen, K.numpy(), ratio, 0.5) for g in as_lists(m, 0)]
    config = UfMStarConfig(occlusion_depth=ratio, prior_weight=0.5)
    ours = hidden(m, given, config)[0]
    assert ours.tolist() == [*expected, False, False, False]
    assert 5 < sum(expected) < 280
    # The kernel looks only at what lies beyond the least depth seen: nearer, "hidden" is to project nowhere.
    expected = [one and g["mean"][2] > ratio * seen.min() for one, g in zip(expected, as_lists(m, 0), strict=True)]
    assert sum(expected) > 5
    arrays = [v[0].numpy().copy() for v in (m.weight, m.mean, m.covariance)]
    slots = np.arange(297)
    kept = visible(slots, *arrays, K.numpy(), given.depth[0].numpy(), ratio, 0.5)
    assert kept.tolist() == [k for k in slots if not expected[k]]
    assert (arrays[0] == 0).tolist() == [*expected, True, True, True]


@pytest.mark.parametrize("backend", ["numba", "torch"])
def test_what_lies_beyond_the_ratio_does_not_match_and_what_lies_within_does(backend):
    """A wall at 6 m; then one at 2 m before it."""
    pairs = {}
    for ratio in (None, 2.0, 4.0):
        config = UfMStarConfig(segment=SPGFConfig(min_pixels=100, min_rows=8), occlusion_depth=ratio, backend=backend)
        ufm = UfMStar(config, dtype=torch.float64)
        for depth in (6.0, 2.0):
            out = ufm(torch.full((1, *SIZE), depth, dtype=torch.float64), torch.eye(4).double(), K)
        pairs[ratio] = int(out.statistics.pairs)
        assert int(out.statistics.components) == (2 if ratio == 2.0 else 1) * int(out.statistics.segments)
    assert pairs[2.0] == 0 < pairs[4.0] == pairs[None]

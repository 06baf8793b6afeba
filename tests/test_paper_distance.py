"""The distance of ``UfMStarConfig.paper()`` from the paper's equations, which have no floors, pixel variance and near
plane."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from shared_data import require_shared
from walks import oracle_settings

import oracle
import scenes
from ufmstar_torch import UfMStar, UfMStarConfig
from ufmstar_torch.eval.sequences import open_sequence
from ufmstar_torch.eval.sequences.images import image_tensor
from ufmstar_torch.models.load import load_network

LIMIT = 1e-4  # [m^2]
# The search in the R-tree: boxes of 2 standard deviations (the paper states none), within .1 m, or .5 m.
LITERAL = {"near": 0.0, "pixel_variance": 0.0, "baseline": None, "neighbourhood": (2.0, 0.1, 0.5)}
RECORDINGS = {
    "fr1": "rgbd_dataset_freiburg1_xyz", "teddy": "rgbd_dataset_freiburg3_teddy", "hololens": "hololens_office",
    "tartanair": "tartanair_sample/P000",
}  # fmt: skip


def distance(frames):
    """Largest distance of M [m^2] over the frames (depth [H, W], pose, K), the largest M, and the components."""
    config = UfMStarConfig.paper()
    ufm, literal, gaps, largest = UfMStar(config, dtype=torch.float64), None, [], 0.0
    for depth, T, K in frames:
        if literal is None:
            segmentation = oracle_settings(config.segment.scaled_to(*depth.shape))
            assert segmentation.prune == "either"
            literal = oracle.Oracle(segmentation, **LITERAL)
        M = literal.step(depth, T, K)[1]
        out = ufm(*(torch.from_numpy(x)[None] for x in (depth, T, K)))
        found = out.disagreement[0].numpy()
        valid = np.isfinite(depth) & (depth > 0)
        assert np.isfinite(found[valid]).all(), "every pixel with a depth has a disagreement"
        gaps.append(np.abs(found - M)[valid].max())
        largest = max(largest, float(M[valid].max()))
    assert len(literal.mixture) == int(ufm.mixture.components)
    return max(gaps), largest, len(literal.mixture)


@pytest.mark.numerics
@pytest.mark.parametrize("seed", [200, pytest.param(31, marks=pytest.mark.slow)])
def test_the_distance_on_rendered_tours(seed):
    tour = open_sequence(f"tour:{seed}?frames=150&size=88x88&sensor=0")
    rng, frames = np.random.default_rng(seed), []
    for n in range(0, 15, 5):
        frame = tour[n]
        depth = scenes.flicker(frame.depth.astype(np.float64), 0.05, n)
        depth += rng.normal(0, 0.03, depth.shape)  # surfaces that a pixel resolves: thinner ones meet the floor
        frames.append((depth, frame.T_world_cam, frame.intrinsics))
    gap, largest, components = distance(frames)
    assert gap < LIMIT
    assert largest > 100 * LIMIT
    assert components > 3


@pytest.mark.parametrize(
    "name", ["fr1", *(pytest.param(name, marks=pytest.mark.slow) for name in list(RECORDINGS)[1:])]
)
def test_the_distance_on_recordings(name):
    sequence = open_sequence(require_shared(f"data/{RECORDINGS[name]}"))
    network = load_network("fastdepth", require_shared("weights/fastdepth_nyu.onnx"), threads=1)
    frames = []
    for n in (0, 6):
        frame = sequence[n]
        x, K = network.preprocess(image_tensor(frame), torch.from_numpy(frame.intrinsics)[None])
        K[0, :2, 2] -= 56  # the middle quarter of the map: the oracle is slow
        depth = network(x).depth[0, 56:168, 56:168].double().numpy()
        frames.append((depth, frame.T_world_cam, K[0].double().numpy()))
    gap, largest, components = distance(frames)
    assert gap < LIMIT
    assert largest > 100 * LIMIT
    assert components > 3


def test_paper_has_no_limit_but_the_datasets():
    """V for every pixel of depths beyond SPGF's 20 m, which are of outdoor data sets."""
    depth = torch.linspace(1, 400, 64).expand(1, 64, 64).contiguous()
    K = torch.tensor([[[60.0, 0, 31.5], [0, 60.0, 31.5], [0, 0, 1]]])
    out = UfMStar(UfMStarConfig.paper())(depth, torch.eye(4)[None], K)
    assert out.valid.all()
    assert out.variance.isfinite().all()
    assert int(out.statistics.beyond) == 0

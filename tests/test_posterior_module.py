"""The posterior inside ``UfMStar``: its state, its streams, and frames without anchors."""

from __future__ import annotations

import dataclasses

import numpy as np
import torch
from posterior_cases import MODEL, K, ratios, scene

from ufmstar_torch import AnchorConfig, UfMStar, UfMStarConfig
from ufmstar_torch.anchors import Anchors
from ufmstar_torch.posterior.running import views

CONFIG = UfMStarConfig(anchors=AnchorConfig(), posterior=MODEL)


def ufm_frames(n=3, streams=1):
    for seed in range(n):
        depth, _, _, pixel, g, variance = scene(seed)
        T = torch.eye(4, dtype=torch.float64)
        T[0, 3] = 0.05 * seed
        anchors = Anchors(*(torch.from_numpy(x)[None].repeat(streams, *[1] * x.ndim) for x in (pixel, g, variance)))
        yield torch.from_numpy(depth)[None].repeat(streams, 1, 1).float(), T, anchors


def memories(ufm):
    """The memory of each stream."""
    return [views(packed) for packed in ufm.posterior.numpy().copy()]


def test_before_the_first_anchor_it_is_plain_ufm_star_to_the_bit():
    plain, posterior = UfMStar(), UfMStar(CONFIG)
    for depth, T, _ in ufm_frames():
        a, b = plain(depth, T, K), posterior(depth, T, K)
        assert torch.equal(a.variance.nan_to_num(), b.variance.nan_to_num())
        assert torch.equal(torch.where(b.valid, depth, 0), b.depth.nan_to_num())
        assert torch.equal(a.variance.nan_to_num(), b.ufm_variance.nan_to_num())
        assert bool(b.statistics.calibration.isnan())
        assert bool(b.posterior_outlier.isnan().all())
        assert torch.equal(a.variance.nan_to_num(), b.posterior_inlier_variance.nan_to_num())
    assert a.posterior_outlier is a.quantiles is None


def test_a_frame_without_anchors_keeps_the_correction_learns_nothing_and_grows_less_certain():
    ufm = UfMStar(CONFIG)
    for depth, T, anchors in ufm_frames():
        ufm(depth, T, K, anchors=anchors)
    before, (learnt,) = ratios(ufm.posterior[0]), memories(ufm)
    outs = [ufm(depth, T, K) for _ in range(30)]
    (after,) = memories(ufm)
    assert ratios(ufm.posterior[0]) == before
    assert after.frames[0] == learnt.frames[0]
    assert (after.covariance.diagonal() > learnt.covariance.diagonal()).all()
    assert (after.covariance.diagonal() < 1.1 * np.array(MODEL.prior_variance)).all()
    ratio = (outs[0].depth / depth)[outs[0].valid]
    assert 1.1 < float(ratio.median()) < 2
    first, last = (out.variance.nanmedian() for out in (outs[0], outs[-1]))
    assert float(last) > 1.2 * float(first)


def test_poses_that_contradict_the_images_make_a_stream_forget():
    """The poses of the second of two streams contradict its images: its depth is the network's again, with the
    uncertainty of the start, and the estimate of the network's error remains."""
    ufm = UfMStar(CONFIG)
    for depth, T, anchors in ufm_frames(streams=2):
        ufm(depth, T, K, anchors=anchors)
    before = [ratios(packed) for packed in ufm.posterior]
    shared, none = torch.tensor([0.0, torch.inf]), torch.zeros(anchors.depth.shape, dtype=torch.bool)
    out = ufm(depth, T, K, anchors=dataclasses.replace(anchors, valid=none, shared=shared))
    remembered, forgotten = ((out.depth[i] / depth[i])[out.valid[i]] for i in range(2))
    assert 1.1 < float(remembered.median()) < 2
    torch.testing.assert_close(forgotten, torch.ones_like(forgotten))
    after = memories(ufm)
    assert [bool(memory.coefficients.any()) for memory in after] == [True, False]
    np.testing.assert_allclose(after[1].covariance.diagonal(), MODEL.prior_variance)
    assert [ratios(packed) for packed in ufm.posterior] == before
    assert bool((out.variance[1].nanmean().sqrt() > 0.5 * depth.mean()).all())


def test_state_saved_and_loaded_goes_on_to_the_bit():
    frames = list(ufm_frames(4))
    whole, first, second = (UfMStar(CONFIG) for _ in range(3))
    for depth, T, anchors in frames[:2]:
        whole(depth, T, K, anchors=anchors)
        first(depth, T, K, anchors=anchors)
    second.load_state_dict(first.state_dict())
    for depth, T, anchors in frames[2:]:
        a, b = ((out.depth, out.variance) for out in (m(depth, T, K, anchors=anchors) for m in (whole, second)))
        assert all(torch.equal(x.nan_to_num(), y.nan_to_num()) for x, y in zip(a, b, strict=True))
    second.reset([0])
    assert not bool(second.posterior.any())
    whole.reset(keep_evidence=True)
    assert bool(whole.posterior.any())


def test_errors_that_all_anchors_have_in_common_widen_every_pixel():
    """A factor common to all depths, and an error common to their inverses [1/m]."""
    depth, _, _, pixel, g, variance = scene(0)
    arguments = [torch.from_numpy(x)[None] for x in (pixel, g, variance)]
    outs = []
    for common in ({}, {"scale": torch.tensor([0.01])}, {"shared": torch.tensor([0.002])}):
        anchors = Anchors(*arguments, **common)
        outs.append(UfMStar(CONFIG)(torch.from_numpy(depth)[None], torch.eye(4)[None], K[None], anchors=anchors))
    plain, by_scale, by_pose = outs
    d = plain.depth
    torch.testing.assert_close(by_scale.variance - plain.variance, 0.01 * d**2, equal_nan=True)
    torch.testing.assert_close(by_pose.variance - plain.variance, 0.002 * d**4, equal_nan=True)

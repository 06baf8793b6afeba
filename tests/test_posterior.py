"""The posterior of a frame against the oracle and closed forms."""

from __future__ import annotations

import dataclasses

import numpy as np
import oracle_field
import oracle_posterior as oracle
import pytest
import torch
from backends import moved
from posterior_cases import MODEL, K, checked, ratios, relative, scene, updated

from ufmstar_torch import PosteriorConfig
from ufmstar_torch.anchors import Anchors
from ufmstar_torch.anchors.check import check_anchors
from ufmstar_torch.frames.frame import check_frame
from ufmstar_torch.kernels.compile_cpu import kernel
from ufmstar_torch.posterior import field
from ufmstar_torch.posterior.moments import divide, second_moments
from ufmstar_torch.posterior.running import FEATURES, SIZE, constants, views
from ufmstar_torch.posterior.scene import SIDE
from ufmstar_torch.posterior.update import update

solve, distance, divided = kernel(field.solve), kernel(field.distance), kernel(divide)


@pytest.mark.parametrize(("rows", "cols"), [(5, 9), (3, 1), (1, 4), (30, 28)])
def test_field_and_distance_against_dense_matrices_and_dijkstra(rows, cols):
    assert FEATURES < field.RIGHT
    assert SIDE < field.WINDOW
    rng, logs = np.random.default_rng(0), np.random.default_rng(1).normal(0, 0.1, (rows, cols))
    n = rows * cols
    right, down, across, along = np.zeros((4, n))
    across[:], along[:] = np.inf, np.inf
    A = np.diag(diagonal := rng.uniform(0.1, 9, n))
    for i, j, variance, length in oracle_field.links(logs):
        links, lengths = (right, across) if j == i + 1 and cols > 1 else (down, along)
        links[i], lengths[i] = 0.01 / variance, length
        A[[i, j], [i, j]] += links[i]
        A[[i, j], [j, i]] -= links[i]
    Y = rng.standard_normal((n, field.RIGHT))
    solved, variance = solve(diagonal, right, down, Y, cols)
    np.testing.assert_allclose(solved, np.linalg.solve(A, Y), rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(variance, np.linalg.inv(A).diagonal(), rtol=1e-10)
    source = rng.random(n) < 0.05
    expected = oracle_field.distances(logs, np.nonzero(source)[0])
    np.testing.assert_allclose(distance(source, across, along, cols, oracle_field.REACH), expected, rtol=1e-13)


def streams_of(seeds, dtype, size=(36, 48)):
    """Frame, anchors and V of several streams. The last anchors of the first stream are invalid; the last stream has
    none."""
    scenes = [scene(seed, size) for seed in seeds]
    depth, claimed = (torch.from_numpy(np.stack([s[i] for s in scenes])).to(dtype) for i in (0, 2))
    b = len(seeds)
    frame = check_frame(depth, torch.eye(4).repeat(b, 1, 1), K.repeat(b, 1, 1), None, None, None,
                        rotation_tolerance=0.01)  # fmt: skip
    valid = torch.ones(b, 60, dtype=torch.bool)
    valid[0, 50:] = valid[-1] = False
    stacked = (torch.from_numpy(np.stack([s[i] for s in scenes])).to(dtype) for i in (3, 4, 5))
    claimed[:, size[0] // 2, size[1] // 2] = torch.nan
    return frame, check_anchors(Anchors(*stacked, valid), frame, None), claimed


def of_stream(frame, anchors, claimed, i):
    """Depth (0 = not valid), V, and the valid anchors' pixel, depth and variance of stream i, for the oracle."""
    used = anchors.valid[i].numpy()
    rows = (x[i].double().numpy()[used] for x in (anchors.pixel, anchors.depth, anchors.variance))
    depth = torch.where(frame.valid, frame.depth, 0)[i]
    return depth.double().numpy(), claimed[i].double().numpy(), *rows


@pytest.mark.parametrize(("dtype", "rtol"), [(torch.float64, 1e-7), (torch.float32, 1e-4)])
def test_streams_of_one_batch_equal_the_oracle_s(dtype, rtol):
    """Some anchors are invalid, and V is NaN at a valid pixel."""
    packed, states = torch.zeros(3, SIZE, dtype=torch.float64), [oracle_field.start() for _ in range(3)]
    for seeds in ((0, 1, 2), (3, 0, 1), (1, 2, 0), (2, 3, 1)):  # in the fourth frame a half of the image is held out
        frame, anchors, claimed = streams_of(seeds, dtype, (12, 16))
        packed, out = update(packed, frame, anchors, claimed, MODEL)
        for i in range(2):  # the last stream has no anchors
            states[i], *expected = oracle.update(states[i], *of_stream(frame, anchors, claimed, i))
            for name, value in zip(("depth", "variance", "inlier", "outlier"), expected, strict=True):
                assert getattr(out, name).dtype == dtype
                np.testing.assert_allclose(getattr(out, name)[i], value, rtol=rtol, err_msg=name)
            assert float(out.calibration[i]) == pytest.approx(oracle_field.ratio(states[i], "calibration"), rel=rtol)
            assert float(out.unseen[i]) == pytest.approx(oracle_field.ratio(states[i], "unseen"), rel=rtol)
            memory = views(packed[i].numpy())
            np.testing.assert_allclose(memory.intervals, states[i]["intervals"], rtol=100 * rtol, atol=rtol)
            np.testing.assert_allclose(memory.coefficients, states[i]["b"], rtol=100 * rtol, atol=rtol)
            np.testing.assert_allclose(memory.covariance, states[i]["C"], rtol=100 * rtol, atol=rtol)
            assert ratios(packed[i]) == pytest.approx(
                {name: oracle_field.ratio(states[i], name) for name in oracle_field.START}, rtol
            )
        assert not bool(packed[2].any())


def test_a_frame_without_anchors_equals_one_with_invalid_anchors():
    packed = torch.zeros(3, SIZE, dtype=torch.float64)
    for seeds in ((0, 1, 2), (3, 0, 4)):
        frame, anchors, claimed = streams_of(seeds, torch.float64)
        packed, _ = update(packed, frame, anchors, claimed, MODEL)
    invalid = dataclasses.replace(anchors, valid=torch.zeros_like(anchors.valid))
    (a, first), (b, second) = (update(packed, frame, none, claimed, MODEL) for none in (None, invalid))
    assert torch.equal(a, b)
    for name, value in vars(first).items():
        torch.testing.assert_close(value[:2], vars(second)[name][:2], rtol=0, atol=0, equal_nan=True)


def test_on_device_meta_the_results_have_shapes():
    frame, anchors, claimed = streams_of((0, 1, 2), torch.float32)
    arguments = torch.zeros(3, SIZE, dtype=torch.float64), frame, anchors, claimed
    (expected, real), (packed, out) = (update(*moved(arguments, device), MODEL) for device in ("cpu", "meta"))
    for value, same in zip((packed, *vars(out).values()), (expected, *vars(real).values()), strict=True):
        assert value.is_meta
        assert (value.shape, value.dtype) == (same.shape, same.dtype)


def test_far_from_evidence_the_slopes_are_the_stream_s_mean():
    """Ten frames show a network of right shape; then anchors in the left quarter show errors that fall to the right.
    At the right border, the correction is nearer to the network's shape than to the line through these anchors."""
    depth, everywhere = (
        np.full((36, 48), 2.0),
        np.stack([x.ravel() for x in np.mgrid[1:48:3, 1:36:3]], -1).astype(float),
    )
    left, none = everywhere[everywhere[:, 0] < 12], np.zeros(len(everywhere))
    frames = [(everywhere, none)] * 10 + [(left, 0.5 - left[:, 0] / 48)]
    outs = []
    for config in (MODEL, type("Extrapolated", (PosteriorConfig,), {"slope_reach": 1e9})()):
        packed = None
        for pixel, y in frames:
            packed, out = updated(depth, (pixel, 2 * np.exp(y), np.full(len(y), 1e-4)), packed=packed, config=config)
        outs.append(out)
    near, far = (np.log([o.depth[0, :, column].mean() / 2 for o in outs]) for column in (6, 47))
    assert near[0] == pytest.approx(near[1], abs=0.02)
    assert far[1] < -0.1
    assert far[0] > far[1] / 2


def test_without_anchors_the_slopes_of_the_correction_revert_and_its_scale_remains():
    """A desk whose far half is twice as far as predicted, then a room without anchors: its shape is the network's."""
    rows, cols = (x.ravel() for x in np.mgrid[0:56:4, 0:56:4])
    desk = np.tile(np.linspace(0.5, 1.0, 56), (56, 1))
    g = 1.5 * desk[rows, cols] ** 2
    packed, _ = updated(desk, (np.stack([cols, rows], -1).astype(float), g, (0.01 * g) ** 2))
    b = [views(packed[0].numpy()).coefficients.copy()]
    room = np.tile(np.linspace(2.0, 6.0, 56), (56, 1))
    frame, anchors = checked(room, np.zeros((1, 2)), np.ones(1), np.ones(1))
    for _ in range(10):
        packed, out = update(packed, frame, dataclasses.replace(anchors, valid=torch.zeros_like(anchors.valid)),
                             torch.zeros(1, 56, 56), MODEL)  # fmt: skip
        b.append(views(packed[0].numpy()).coefficients.copy())
    shift = np.log(room).mean() - np.log(desk).mean()
    assert b[1][0] == pytest.approx(b[0][0] + b[0][1] * shift, rel=1e-2)
    kept, mean_slopes = 1 - MODEL.reversion, b[0][1:] / (1 + MODEL.slope_weight)  # after one frame with anchors
    of_mean = 10 * MODEL.reversion * kept**9 * mean_slopes * [0, 1, 1]  # u and v revert to the mean, which reverts, too
    np.testing.assert_allclose(b[-1][1:], b[0][1:] * kept**10 + of_mean, rtol=1e-9)
    assert np.abs(b[0][1:]).max() > 0.1
    logs = out.depth[0].log()
    assert float(logs.std()) == pytest.approx(float(np.log(room).std()), rel=0.1)


def test_anchors_correct_a_wrong_scale_and_the_variance_covers_what_is_left():
    packed = None
    for seed in range(4):
        depth, factor, claimed, *anchors = scene(seed, n=120)
        packed, out = updated(depth, anchors, claimed, packed)
    seen, truth = depth > 0, depth * factor
    error = (out.depth[0].numpy() - truth)[seen]
    assert np.sqrt((error**2).mean()) < 0.25 * np.sqrt(((depth - truth)[seen] ** 2).mean())
    assert 0.02 < (error**2 / out.variance[0].numpy()[seen]).mean() < 1.5  # conservative with few anchors


def test_the_variance_grows_in_proportion_to_the_distance_from_evidence():
    """A flat wall with anchors at its left edge: the variance grows at the learnt rate over the image's width."""
    depth = np.full((28, 56), 2.0)
    pixel = np.stack([np.tile([1.0, 3.0], 14), np.repeat(np.arange(0.0, 28, 2), 2)], -1)
    _, out = updated(depth, (pixel, np.full(28, 2.2), np.full(28, 1e-4)))
    by_column = relative(out).mean(0)
    assert float(by_column[50] - by_column[30]) > 0.9 * float(out.unseen) * 20 / 56


def test_errors_that_grow_over_more_than_a_disc_are_learnt_and_cover_a_side_without_anchors():
    """The network's scale is a wave across the image, which moves from frame to frame. Discs are smaller than it: the
    anchors around them show their scale."""
    shape, (v, u) = (36, 48), np.mgrid[1:36:3, 1:48:3].reshape(2, -1)
    depth, claimed = np.full(shape, 2.0), torch.full((1, *shape), 0.04, dtype=torch.float64)
    packed, z = torch.zeros(1, SIZE, dtype=torch.float64), []
    for k in range(32):
        factor = np.exp(0.3 * np.sin(2 * np.pi * (np.arange(48) / 48 + 0.3 * k)))
        used = u < (48 if k < 24 else 16)
        g = (depth * factor)[v[used], u[used]]
        learnt, out = update(packed, *checked(depth, np.stack([u, v], -1)[used].astype(float), g, (0.01 * g) ** 2),
                             claimed, MODEL)  # fmt: skip
        packed = learnt if k < 24 else packed
        z.append(((depth * factor - out.depth[0].numpy()) / out.variance[0].sqrt().numpy())[:, 32:])
    assert np.sqrt(np.mean(np.square(z[24:]))) < 2  # 3.1 with discs alone


def test_an_error_that_held_out_anchors_show_makes_what_is_unseen_less_certain():
    """Two surfaces with one predicted depth and different error factors: the growth rate becomes a multiple of its
    prior."""
    depth, packed = np.full((56, 56), 2.0), None
    rows, cols = (x.ravel() for x in np.mgrid[2:56:4, 2:56:4])
    pixel = np.stack([cols, rows], -1).astype(float)
    for jump, least, most in ((0.0, 0.0, 0.2), (1.5, 0.5, 9.0)):
        g = 2 * np.exp(np.where((cols // 14 + rows // 14) % 2, jump, 0.0))
        for _ in range(12):
            packed, out = updated(depth, (pixel, g, np.full(len(g), 1e-4)), packed=packed)
        assert least <= float(out.unseen) < most


def test_outliers_do_not_widen_what_is_stated_of_the_other_pixels():
    """A twentieth of the anchors is off by a factor of 2.5: ``outlier`` states it, and ``inlier`` narrows again."""
    packed = None
    for seed in range(12):
        depth, factor, claimed, pixel, g, _ = scene(seed, n=150)
        packed, out = updated(depth, (pixel, g, (0.05 * g) ** 2), claimed, packed)
    seen = depth > 0
    error = np.log(out.depth[0].numpy() / (depth * factor))[seen]
    assert ratios(packed[0])["inlier"] < 0.3
    assert 0.22 < np.sqrt((error**2 / (out.inlier / out.depth.square())[0].numpy()[seen]).mean()) < 1


def test_where_the_field_jumps_the_depth_is_less_certain_than_on_either_side():
    """A wall as predicted, and one whose right half is three times as far: the true edge may be one cell off the edge
    of f."""
    depth = np.full((56, 56), 2.0)
    rows, cols = (x.ravel() for x in np.mgrid[2:56:4, 2:56:4])
    for factor, least, most in ((1.0, 0.95, 1.05), (3.0, 1.5, 50.0)):
        packed, g = None, 2 * np.where(cols < 28, 1, factor)
        for _ in range(10):
            packed, out = updated(depth, (np.stack([cols, rows], -1) + 0.0, g, np.full(len(g), 1e-4)), packed=packed)
        relative_variance = (out.inlier / out.depth.square())[0, 8:-8]
        assert least < float(relative_variance[:, 24:32].mean() / relative_variance[:, 8:16].mean()) < most


def test_a_region_whose_anchors_disagree_is_less_certain_than_one_whose_anchors_agree():
    """The anchors of the right half have independent errors of 20 %, those of the left half the stated errors."""
    depth, rng, packed = np.full((56, 56), 2.0), np.random.default_rng(0), None
    rows, cols = (x.ravel() for x in np.mgrid[1:56:3, 1:56:3])
    for _ in range(8):
        g = 2 * np.exp(np.where(cols < 28, 0.02, 0.2) * rng.normal(size=len(cols)))
        packed, out = updated(depth, (np.stack([cols, rows], -1) + 0.0, g, (0.02 * g) ** 2), packed=packed)
    relative_variance = (out.inlier / out.depth.square())[0]
    assert float(relative_variance[:, 34:].mean()) > 4 * float(relative_variance[:, :22].mean())
    assert float(out.outlier[0, :, 34:].mean()) > 4 * float(out.outlier[0, :, :22].mean())


def wall(error):
    """The statistics after twelve frames of a flat wall; the anchor in each cell is off by a factor e^error [28,
    28]."""
    depth, packed = np.full((56, 56), 2.0), None
    rows, cols = (x.ravel() for x in np.mgrid[0:56:2, 0:56:2])
    for frame in range(12):
        g = 2 * np.exp(error(np.random.default_rng(frame))[rows // 2, cols // 2])
        packed, out = updated(depth, (np.stack([cols, rows], -1) + 0.5, g, np.full(len(g), 1e-4)), packed=packed)
    return ratios(packed[0]), out


def test_errors_that_neighbouring_anchors_do_not_share_are_not_taken_for_the_networks():
    """The same factors: constant in patches of a quarter of the image, or shuffled over the anchors."""
    patches = np.kron(np.random.default_rng(4).normal(0, 0.3, (4, 4)), np.ones((7, 7)))
    shared, _ = wall(lambda rng: patches)
    independent, _ = wall(lambda rng: rng.permutation(patches.ravel()).reshape(28, 28))
    assert shared["amplitude"] > 5 * independent["amplitude"]
    assert shared["unseen"] > 2 * independent["unseen"]


@pytest.mark.parametrize("p", [0.0, 0.5])
def test_extreme_errors_and_probabilities_stay_finite(p):
    """After six frames of a wall as predicted, a tenth of the anchors are off by a factor of 90."""
    model = type("Extreme", (PosteriorConfig,), {"wrong": p, "misscaled": p})()
    packed = torch.zeros(1, SIZE, dtype=torch.float64)
    depth, rng = np.full((56, 56), 2.0), np.random.default_rng(0)
    rows, cols = (x.ravel() for x in np.mgrid[0:56:2, 0:56:2])
    for share in (0, 0, 0, 0, 0, 0, 0.1):
        g = 2 * np.exp(4.5 * (rng.random(len(rows)) < share))
        frame = checked(depth, np.stack([cols, rows], -1) + 0.5, g, (1e-3 * g) ** 2)
        packed, out = update(packed, *frame, torch.zeros(1, 56, 56, dtype=torch.float64), model)
    for value in (packed, out.depth, out.variance, out.inlier, out.outlier):
        assert bool(value.isfinite().all())
    assert bool(((out.outlier >= 0) & (out.outlier <= 1)).all())


def test_more_regions_on_another_surface_make_it_more_probable():
    def spots(share):
        def error(rng):
            return np.kron(rng.random((14, 14)) < share, np.ones((2, 2)))

        return wall(error)

    (few, calm), (many, rough) = spots(0.0), spots(0.15)
    assert few["wrong"] < MODEL.wrong < many["wrong"]
    assert rough.outlier.mean() > 2 * calm.outlier.mean()


def test_the_variance_is_the_second_moment_about_the_posterior_depth():
    """Against samples of the true depth: d e^n, or with probability p another surface, d e^(n - o); errors beyond a
    factor of ``farthest`` do not count."""
    rng, size = np.random.default_rng(0), 1_000_000
    for offset, p, wide in ((-0.4, 0.03, 0.2), (0.3, 0.3, 0.2), (0.3, 0.1, 2.0), (-2.5, 0.2, 1.0)):
        within = []
        for mean, variance in ((0.0, 0.3), (-np.clip(offset, -np.log(MODEL.farthest), np.log(MODEL.farthest)), wide)):
            n = rng.normal(mean, variance**0.5, size)
            within.append(((np.exp(n[np.abs(n) < np.log(MODEL.farthest)]) - 1) ** 2).mean())
        total, inlier = second_moments(constants(MODEL), 0.3, p, offset, wide)
        assert inlier == pytest.approx(within[0], rel=0.03)
        assert total == pytest.approx((1 - p) * within[0] + p * within[1], rel=0.03)


def test_one_anchor_that_is_off_by_a_factor_of_twenty_does_not_decide():
    """A single anchor changes the depth by a factor of 3 at most; among sixty anchors it does not change its
    surface."""
    depth, pixel = np.full((36, 48), 2.0), np.stack([x.ravel() for x in np.mgrid[4:48:6, 4:36:6]], -1).astype(float)
    alone = updated(depth, (pixel[:1], np.array([0.1]), np.array([1e-6])))[1]
    assert float(alone.depth.median()) > 2 / 3
    assert float(relative(alone).median()) > 0.3
    g = np.full(len(pixel), 2.4)
    g[20] = 0.1
    among = updated(depth, (pixel, g, np.full(len(g), 1e-4)))[1].depth[0]
    np.testing.assert_allclose(among.median(), 2.4, rtol=0.1)
    assert float(among.min()) > 1.0


def test_a_wide_distribution_is_divided_without_a_change_of_its_variance():
    inlier, p = np.array([1.0, 1, 1, 1, 1, 1, 1, 4]), np.full(8, 0.05)
    total = (1 - p) * inlier + p * 40
    limited, share = inlier.copy(), p.copy()
    divided(total, limited, share)
    assert limited.max() < 2
    np.testing.assert_allclose(share[:-1], p[:-1])
    assert share[-1] > 2 * p[-1]
    np.testing.assert_allclose((1 - share) * limited + share * 40, total)


def test_another_surface_is_more_probable_and_less_certain_away_from_evidence():
    """Agreeing anchors make another surface improbable near them. Away from them its probability is the stream's, and
    more where the variance exceeds the usual one of the image."""
    depth = np.full((28, 56), 2.0)
    pixel = np.stack([np.tile([1.0, 3.0], 14), np.repeat(np.arange(0.0, 28, 2), 2)], -1)
    _, out = updated(depth, (pixel, np.full(28, 2.2), np.full(28, 1e-4)))
    p = out.outlier[0].mean(0)
    assert MODEL.wrong / 10 < float(p[1]) < MODEL.wrong  # the anchors agree
    assert bool((p.diff() > -1e-12).all())
    assert float(p[20]) == pytest.approx(MODEL.wrong, rel=0.3)
    assert 1.5 * MODEL.wrong < float(p.max()) < 2.5 * MODEL.wrong  # the scale of the depth is nearly certain
    beyond = ((out.variance - out.inlier) / out.depth.square())[0].mean(0)
    assert float(beyond[54]) > 2 * float(beyond[20]) > 4 * float(beyond[1])
    assert bool((out.inlier < out.variance).all())  # another surface adds to the total variance only


def test_contradictory_anchors_and_depth_that_a_few_pull_away_are_less_certain():
    """A wall where all anchors agree, where every fourth is off by a factor of 3, and with a cluster of anchors three
    times nearer or farther."""
    depth, pixel = np.full((36, 48), 2.0), np.stack([x.ravel() for x in np.mgrid[2:48:4, 2:36:4]], -1).astype(float)
    corner = (pixel[:, 0] > 30) & (pixel[:, 1] > 20)
    factors = {"alike": 1.0, "mixed": np.where(np.arange(len(pixel)) % 4, 1, 3.0),
               "nearer": np.where(corner, 1 / 3, 1), "farther": np.where(corner, 3.0, 1)}  # fmt: skip
    result = {}
    for name, factor in factors.items():
        _, out = updated(depth, (pixel, 2.0 * factor * np.ones(len(pixel)), np.full(len(pixel), 1e-3)))
        result[name] = relative(out)[24:34, 34:46].mean()
    assert result["mixed"] > 2 * result["alike"]
    assert min(result["nearer"], result["farther"]) > 10 * result["alike"]


def test_far_from_evidence_the_variance_is_larger_and_never_below_what_ufm_star_claims():
    depth, _, _, pixel, g, variance = scene(0, n=120)
    near = pixel[:, 0] < 12
    anchors = pixel[near], g[near], variance[near]
    packed, _ = updated(depth, anchors)
    after = [updated(depth, anchors, np.full((36, 48), v), packed)[1] for v in (0.0, 0.01, 5.0)]
    none, small, large = (out.variance[0] for out in after)
    assert float(relative(after[0])[8:, 44:].mean() / relative(after[0])[8:, :10].mean()) > 2
    torch.testing.assert_close(small, none, equal_nan=True)  # less than the uncertainty that the anchors leave
    assert float((large - none)[:, 44:].mean()) > 0.1
    assert bool((large >= none)[np.nonzero(depth)].all())


def test_before_the_first_anchor_of_a_source_the_deviation_is_about_the_depth():
    """With only invalid anchors, the depth is the network's and two standard deviations reach the camera. The mixture
    has the heavier tail: a network that is 8 times too near is far more probable in it than in the normal
    distribution."""
    depth, _, _, *anchors = scene(0)
    frame, invalid = checked(depth, *anchors)
    invalid = dataclasses.replace(invalid, valid=torch.zeros_like(invalid.valid))
    packed, out = update(torch.zeros(1, SIZE, dtype=torch.float64), frame, invalid, torch.zeros(1, 36, 48), MODEL)
    assert not bool(packed.any())
    torch.testing.assert_close(out.depth[0][frame.valid[0]], frame.depth[frame.valid])
    total, inlier = (relative(out, name)[frame.valid[0]].sqrt() for name in ("variance", "inlier"))
    assert 0.7 < float(total.min()) < float(total.max()) < 1.2
    assert 0.7 < float(inlier.median()) < float(total.median())
    p = out.outlier[frame.valid]
    tail = ((total.square() - (1 - p) * inlier.square()) / p).sqrt()
    mixture = (1 - p) * density(7.0, inlier) + p * density(7.0, tail)
    assert float((mixture / density(7.0, total)).median()) > 1e6


def density(x, sigma):
    return torch.exp(-((x / sigma) ** 2) / 2) / sigma

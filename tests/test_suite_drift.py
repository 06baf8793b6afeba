"""Drift: a random walk of the poses with the requested variance, the same for every row."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from scipy.stats import kstest
from tiny_suite import row

from ufmstar_torch.eval.engine.anchors import anchor_sources
from ufmstar_torch.eval.engine.estimators import Estimator, output_of
from ufmstar_torch.eval.engine.judge import references
from ufmstar_torch.eval.engine.maps import own_depth
from ufmstar_torch.eval.engine.rows import RowRunner
from ufmstar_torch.eval.methods.perturb import Drift, perturbed
from ufmstar_torch.eval.methods.setting import Setting, default_of, setting_from
from ufmstar_torch.eval.sequences.frame import Frame
from ufmstar_torch.frames.prediction import DepthPrediction

NAME = "UfM*-DepthOnly"
BOTH = Setting(rotation_drift=0.5, translation_drift=0.02, seed=3)


def walk(frames=24):
    """[N, 4, 4] poses of a camera that turns and moves, with no two equal steps."""
    poses = np.tile(np.eye(4), (frames, 1, 1))
    t = np.arange(frames)
    turned = np.stack([0.1 * np.sin(0.5 * t), 0.08 * t, 0.05 * np.cos(0.3 * t)], axis=-1)
    poses[:, :3, :3] = Rotation.from_rotvec(turned).as_matrix()
    poses[:, :3, 3] = np.stack([5 + 0.1 * t, 0.3 * np.sin(t), -2 + 0.02 * t**1.5], axis=-1)
    return poses


WALK = walk()
EVERY = range(len(WALK))


def drifted(setting, indices=EVERY):
    drift = Drift(setting)
    return np.stack([drift.of(WALK[i], i) for i in indices])


def steps(poses):
    """[N - 1, 4, 4] each pose relative to the previous one."""
    return np.linalg.solve(poses[:-1], poses[1:])


def noise(setting, indices=EVERY):
    """Return the error of each step: rotation vectors [rad] and translations [m] about and along the camera's axes."""
    indices = list(indices)
    wrong = np.linalg.solve(steps(WALK[indices]), steps(drifted(setting, indices)))
    return Rotation.from_matrix(wrong[:, :3, :3]).as_rotvec(), wrong[:, :3, 3]


# ---- the walk ----


@pytest.mark.parametrize("first", [0, 9])
def test_the_first_pose_is_exact_and_all_are_poses(first):
    result = drifted(BOTH, range(first, len(WALK)))
    np.testing.assert_array_equal(result[0], WALK[first])
    R = result[:, :3, :3]
    np.testing.assert_allclose(R @ R.transpose(0, 2, 1), np.tile(np.eye(3), (len(R), 1, 1)), atol=1e-12)
    assert (np.linalg.det(R) > 0).all()
    np.testing.assert_allclose(result[:, 3], np.tile([0, 0, 0, 1.0], (len(R), 1)), atol=1e-14)


def test_a_step_has_the_noise_that_was_asked_for():
    result = [noise(Setting(rotation_drift=2.0, translation_drift=0.05, seed=seed)) for seed in range(12)]
    turned, moved = (np.concatenate(parts) for parts in zip(*result, strict=True))
    for values, deviation in ((turned, math.radians(2)), (moved, 0.05)):
        assert kstest(values.ravel() / deviation, "norm").pvalue > 0.01
    together = np.corrcoef(np.hstack([turned, moved]).T) - np.eye(6)
    assert np.abs(together).max() < 0.2, "axes are independent"
    assert np.abs(np.corrcoef(moved[:-1, 0], moved[1:, 0])[0, 1]) < 0.2, "steps are independent"


def test_translation_drift_leaves_orientations_and_rotation_drift_moves_the_path():
    moved, turned = drifted(Setting(translation_drift=0.05)), drifted(Setting(rotation_drift=1.0))
    np.testing.assert_allclose(moved[:, :3, :3], WALK[:, :3, :3], atol=1e-13)
    # The translation in the camera's frame is exact; the path in the world bends.
    np.testing.assert_allclose(steps(turned)[:, :3, 3], steps(WALK)[:, :3, 3], atol=1e-12)
    assert np.abs(turned[-1, :3, 3] - WALK[-1, :3, 3]).max() > 0.01


def test_drift_is_of_the_seed_and_only_its_size_of_the_setting():
    np.testing.assert_array_equal(drifted(BOTH), drifted(BOTH))
    assert np.abs(noise(BOTH)[1] - noise(Setting(translation_drift=0.02, seed=4))[1]).min() > 1e-6
    weak, strong = noise(Setting(rotation_drift=0.1)), noise(Setting(rotation_drift=1.0))
    np.testing.assert_allclose(strong[0], 10 * weak[0], atol=1e-12)
    np.testing.assert_allclose(noise(Setting(translation_drift=0.3, seed=3))[1], 15 * noise(BOTH)[1], atol=1e-12)
    # Independent of the noise of single poses, and not shifted with it.
    single = [perturbed(np.eye(4), Setting(translation_noise=1.0, seed=3), i)[:3, 3] for i in range(1, len(WALK))]
    assert np.abs(np.array(single) - noise(Setting(translation_drift=1.0, seed=3))[1]).min() > 1e-4


def test_frames_left_out_drift_all_the_same():
    """A step over three frames has the sum of their increments, with 3 times the variance, from the same walk."""
    every = [noise(Setting(translation_drift=0.01)), noise(Setting(rotation_drift=0.3))]
    third = [
        noise(Setting(translation_drift=0.01), range(0, 24, 3)),
        noise(Setting(rotation_drift=0.3), range(0, 24, 3)),
    ]
    for which, (one, three) in enumerate(zip(every, third, strict=True)):
        values = one[1 - which][:21].reshape(7, 3, 3).sum(1)
        np.testing.assert_allclose(three[1 - which], values, atol=1e-12)


def test_frames_must_come_in_order():
    drift = Drift(BOTH)
    drift.of(WALK[3], 3)
    for index in (3, 2):
        with pytest.raises(ValueError, match=f"must come in order, got index {index} after 3"):
            drift.of(WALK[index], index)


# ---- settings and rows ----


@pytest.mark.parametrize("name", ["rotation_drift", "translation_drift"])
def test_a_setting_of_drift(name):
    setting = setting_from({name: 0.1, "seed": 2})
    assert setting.to_dict() == {name: 0.1, "seed": 2}
    assert setting_from(json.loads(json.dumps(setting.to_dict()))) == setting
    assert len({setting.slug, Setting(**{name: 0.2, "seed": 2}).slug, Setting(**{name: 0.1}).slug, ""}) == 4
    assert default_of(name) == 0
    assert setting.pose_noise != Setting(**{name: 0.1}).pose_noise
    assert Setting(seed=2, anchors="truth").pose_noise == ()


class Poses(Estimator):
    """An estimator that records its input poses."""

    def __init__(self):
        super().__init__()
        self.given = []

    def update(self, predicted, T_world_cam, anchors=None):
        self.given.append(T_world_cam.numpy())
        depth = predicted.depth
        return output_of(depth, None, depth > 0)


def test_a_row_sees_drift_and_noise_on_top_of_it():
    setting = Setting(rotation_drift=0.5, translation_drift=0.02, translation_noise=0.1, seed=3)
    poses = Poses()
    runner = RowRunner("drift", own_depth(), poses, setting=setting)
    one = DepthPrediction(torch.ones(1, 2, 2), intrinsics=torch.eye(3, dtype=torch.float64)[None])
    for i in range(0, 20, 4):
        frame = Frame(i, str(i), None, None, WALK[i], np.eye(3))
        result = runner.update(frame, one, None)
    expected = [perturbed(T, setting, i) for T, i in zip(drifted(BOTH, range(0, 20, 4)), range(0, 20, 4), strict=True)]
    np.testing.assert_allclose(np.stack(poses.given), np.stack(expected), atol=1e-12)
    np.testing.assert_array_equal(result.T_world_cam, poses.given[-1])


def test_rows_of_one_drift_share_a_tracker_and_a_reference():
    sharing = [
        row(NAME, anchors="corners", rotation_drift=0.1),
        row(NAME, anchors="corners", rotation_drift=0.1, posterior=True),
    ]
    others = [
        row(NAME, anchors="corners", **{name: 0.1, "seed": seed})
        for name in ("translation_drift", "rotation_noise")
        for seed in (0, 1)
    ]
    alone = [row(NAME), row(NAME, anchors="corners"), row(NAME, anchors="corners", skip=1)]
    sources = anchor_sources([*sharing, *others, *alone])
    assert alone[0] not in sources
    assert sources[sharing[0]] is sources[sharing[1]]
    assert len({id(source) for source in sources.values()}) == 7
    plain, drift = (row("UfM-Ensemble-100K", **values) for values in ({}, {"rotation_drift": 0.1}))
    rows = [plain, drift, row("UfM*-Ensemble", rotation_drift=0.1), row("UfM*-Ensemble", anchors="truth", seed=7)]
    assert references(rows[2], rows) == [drift]
    assert references(rows[3], rows) == [plain]

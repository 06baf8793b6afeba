"""The time offset of poses: from errors of a window in closed form, and from images whose poses are late."""

from __future__ import annotations

import logging
from itertools import islice

import numpy as np
import oracle_bundle
import pytest
import torch
from landmark_runs import long_walk, true_depth, walk
from scipy.spatial.transform import Rotation
from shared_data import require_shared

from ufmstar_torch.anchors.dense import DenseEvidence
from ufmstar_torch.anchors.streams import StreamLandmarks
from ufmstar_torch.anchors.time_offset import TimeOffset
from ufmstar_torch.eval.sequences.open import open_sequence

RECORDINGS = "rgbd_dataset_freiburg1_xyz", "rgbd_dataset_freiburg3_teddy", "hololens_office", "tartanair_sample/P000"


def path(times):
    """Poses [n, 4, 4] of a camera that speeds up, slows down and turns, at times in images."""
    T = np.tile(np.eye(4), (len(times), 1, 1))
    T[:, :3, 3] = np.stack([np.sin(times / 4), np.cos(times / 5), times / 20], 1)
    T[:, :3, :3] = Rotation.from_rotvec(np.stack([np.sin(times / 6), times / 30, 0 * times], 1)).as_matrix()
    return T


def moved(poses, error):
    return np.stack([oracle_bundle.moved(p, e) for p, e in zip(poses, error.reshape(-1, 6), strict=True)])


def errors_shown(truth, poses, precision):
    """Posterior mean and covariance of the errors of ``poses``; images show all but a common error."""
    n = len(truth)
    turn = (poses[:, :3, :3].swapaxes(1, 2) @ truth[:, :3, :3]).reshape(n, 3, 3)
    d = np.concatenate([Rotation.from_matrix(turn).as_rotvec(), truth[:, :3, 3] - poses[:, :3, 3]], 1).ravel()
    A = 1e5 * np.kron(np.eye(n) - 1 / n, np.eye(6))
    C = np.linalg.inv(A + np.diag(precision))
    return C @ A @ d, C


def learnt(lag, noise=0.0, frames=60, seed=0):
    """The estimates after every image, for a late trajectory."""
    rng, offset, lags = np.random.default_rng(seed), TimeOffset(), []
    every = path(np.arange(frames) - lag)
    every = moved(every, noise * rng.normal(size=6 * frames))
    for k in range(3, frames):
        window = slice(max(k - 9, 0), k + 1)
        poses = every[window]
        precision = np.full(6 * len(poses), 1e4)
        start = moved(poses, offset.shift(poses).ravel())
        offset.learn(poses, precision, *errors_shown(path(np.arange(frames))[window], start, precision))
        lags.append(offset.lag)
    return offset, np.array(lags)


@pytest.mark.parametrize("lag", [-1.5, -0.7, 0.0, 0.4, 1.0, 2.0])
def test_a_late_or_early_trajectory_is_found(lag):
    _, lags = learnt(lag)
    assert abs(lags[-1] - lag) < 0.05 + 0.2 * abs(lag), "an insignificant offset is not used"


@pytest.mark.parametrize("seed", range(5))
def test_noise_is_no_offset(seed):
    _, lags = learnt(0.0, noise=0.05, seed=seed)
    assert np.abs(lags).max() < 0.4
    assert np.median(np.abs(lags)) < 0.1


def test_the_shift_leads_to_the_poses_at_the_images_times():
    offset = TimeOffset()
    times = np.arange(8.0)
    for offset.lag in (1.0, -1.0):
        poses = path(times - offset.lag)
        off = np.abs(moved(poses, offset.shift(poses).ravel()) - path(times)).max((1, 2))
        extrapolated = off[-1] if offset.lag > 0 else off[0]
        np.testing.assert_allclose(np.delete(off, -1 if offset.lag > 0 else 0), 0, atol=1e-12)
        assert extrapolated < 0.5 * np.abs(poses - path(times)).max()


def test_a_steady_motion_shows_nothing():
    offset, T = TimeOffset(), np.tile(np.eye(4), (8, 1, 1))
    T[:, 0, 3] = 0.1 * np.arange(8)
    late = T.copy()
    late[:, 0, 3] -= 0.1
    precision = np.full(48, 1e2)
    offset.learn(late, precision, *errors_shown(T, late, precision))
    assert offset.lag == 0


@pytest.mark.parametrize("scale", [0.0, 1e150, 1e300])
def test_absurd_poses_and_errors_leave_a_finite_estimate(scale):
    rng, offset = np.random.default_rng(0), TimeOffset()
    offset.lag = 0.5
    with np.errstate(all="ignore"):
        T = scale * rng.normal(size=(5, 4, 4))
        offset.learn(T, np.ones(30), scale * rng.normal(size=30), scale * np.eye(30))
    assert np.isfinite([offset.lag, *(value.item() for value in offset.state().values())]).all()


def test_depths_of_late_poses_are_right_and_the_offset_is_named(caplog):
    frames = long_walk(1)
    source, late = StreamLandmarks("dense"), [frames[0], *frames[:-1]]
    errors, lags = [], []
    with caplog.at_level(logging.WARNING, "ufmstar_torch"):
        for i, (frame, earlier) in enumerate(zip(frames, late, strict=True)):
            image = torch.from_numpy(frame.image.copy()).permute(2, 0, 1)[None]
            source.update(image, torch.from_numpy(earlier.T_world_cam)[None], torch.from_numpy(frame.intrinsics)[None])
            landmarks = source.last[0]
            lags.append(landmarks.lag)
            if i >= 40:
                errors.extend(np.abs(np.log(landmarks.depth / true_depth(frame, landmarks.pixel))))
    assert 0.4 < lags[-1] < 1.2
    assert len(errors) > 1000
    assert np.median(errors) < 0.1
    assert sum("images late" in record.message for record in caplog.records) == 1


def test_the_estimate_is_saved_with_the_state():
    frames, source = walk(), DenseEvidence()
    for frame, earlier in zip(frames, [frames[0], *frames[:-1]], strict=True):
        source.update(frame.image, earlier.T_world_cam, frame.intrinsics)
    other = DenseEvidence()
    other.load_state(source.state())
    assert other.state()["corners_lag"].item() == source.state()["corners_lag"].item()
    source.reset()
    assert source.state()["corners_lag_information"].item() == 0


@pytest.mark.parametrize(
    "name", [*RECORDINGS[:2], *(pytest.param(name, marks=pytest.mark.slow) for name in RECORDINGS[2:])]
)
def test_recordings_have_no_offset_until_their_poses_are_late(name):
    frames = list(islice(open_sequence(require_shared(f"data/{name}")).readable(lambda error: None), 31))
    K = frames[0].intrinsics
    for late in (0, 1):
        source = DenseEvidence()
        for frame, earlier in zip(frames[late:], frames, strict=False):
            lag = source.update(frame.image, earlier.T_world_cam, K).lag
        print(f"{name}, {late} late: {lag:.2f}")
        assert abs(lag) < 0.2 if late == 0 else 0.3 < lag < 1

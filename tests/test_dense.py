"""Dense anchors on rendered rooms, where every depth is known."""

from __future__ import annotations

import importlib
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ufmstar_torch.anchors.dense import DenseConfig, DenseEvidence
from ufmstar_torch.eval.sequences.open import open_sequence


@pytest.fixture(scope="module")
def tour():
    return list(open_sequence("tour:5?frames=14&size=120x160"))


def true_depth(frame, pixel):
    u, v = np.rint(pixel).astype(int).T
    return frame.depth[v, u]


def test_depths_of_a_rendered_room_are_right_and_as_uncertain_as_stated(tour):
    evidence, errors, surprises, counts = DenseEvidence(), [], [], []
    for frame in tour:
        result = evidence.update(frame.image, frame.T_world_cam, frame.intrinsics)
        z = true_depth(frame, result.pixel)
        errors.extend(np.abs(result.depth - z) / z)
        surprises.extend((1 / result.depth - 1 / z) * result.depth**2 / np.sqrt(result.variance))
        counts.append(len(z))
    assert counts[:2] == [0, 0], "two keyframes must agree"
    assert np.median(counts[6:]) >= 60
    assert np.median(errors) < 0.07
    assert 0.5 < 1.4826 * np.median(np.abs(surprises)) < 2


def test_a_standing_camera_has_no_anchors(tour):
    frame, evidence = tour[3], DenseEvidence()
    for _ in range(6):
        assert len(evidence.update(frame.image, frame.T_world_cam, frame.intrinsics).depth) == 0


def test_a_saved_state_continues_to_the_last_bit(tour):
    one, other = DenseEvidence(), DenseEvidence()
    for frame in tour[:7]:
        one.update(frame.image, frame.T_world_cam, frame.intrinsics)
    other.load_state(one.state())
    for frame in tour[7:]:
        a, b = (e.update(frame.image, frame.T_world_cam, frame.intrinsics) for e in (one, other))
        for name in ("pixel", "depth", "variance", "confirmed"):
            np.testing.assert_array_equal(getattr(a, name), getattr(b, name))
    with pytest.raises(ValueError, match="50 keyframes, got 20"):
        other.load_state(DenseEvidence(DenseConfig(keyframes=20)).state())


def run(evidence, frames, poses=None, images=None):
    poses = [f.T_world_cam for f in frames] if poses is None else poses
    images = [f.image for f in frames] if images is None else images
    return [evidence.update(i, T, f.intrinsics) for i, T, f in zip(images, poses, frames, strict=True)]


def test_landmarks_are_confirmed_and_those_confirmed_err_less(tour):
    there_and_back = [*tour, *tour[::-1], *tour]
    result = run(DenseEvidence(), there_and_back)
    z = [true_depth(frame, f.pixel) for frame, f in zip(there_and_back, result, strict=True)]
    error = np.concatenate([np.abs(f.depth / g - 1) for f, g in zip(result, z, strict=True)])
    times = np.concatenate([f.confirmed for f in result])
    assert (times >= 2).sum() > 200
    assert np.quantile(error[times >= 2], 0.9) < np.quantile(error[times == 0], 0.9)


def test_a_turning_camera_has_no_anchors(tour):
    frame = tour[3]
    gray = np.tile(frame.image[:, :, 0], (1, 3))
    evidence = DenseEvidence()
    for step in range(8):  # as a camera with a long focal length sees a turn: the image moves sideways
        T = np.eye(4)
        T[:3, :3] = Rotation.from_rotvec([0, np.arctan(6 * step / 1000), 0]).as_matrix()
        K = np.array([[1000.0, 0, 79.5], [0, 1000, 59.5], [0, 0, 1]])
        shown = np.ascontiguousarray(gray[:, 40 + 6 * step : 200 + 6 * step])
        assert len(evidence.update(shown, T, K).depth) == 0


def test_poses_that_contradict_the_images_give_few_anchors(tour):
    rng = np.random.default_rng(0)
    wrong = []
    for frame in tour:
        T = frame.T_world_cam.copy()
        T[:3, :3] = T[:3, :3] @ Rotation.from_rotvec(rng.normal(0, np.deg2rad(4), 3)).as_matrix()
        wrong.append(T)
    right, noisy = (sum(len(f.depth) for f in run(DenseEvidence(), tour, T)) for T in (None, wrong))
    assert right > 400
    assert noisy < 0.1 * right


def test_after_a_jump_of_the_poses_landmarks_from_before_are_not_believed(tour):
    """As a loop closure does: from one frame on, all poses are 15 cm and 4 degrees beside those before."""
    frames, jump = [*tour, *tour[::-1], *tour], np.eye(4)
    jump[:3, :3], jump[:3, 3] = Rotation.from_rotvec([0, 0, np.deg2rad(4)]).as_matrix(), [0.1, -0.1, 0.05]
    poses = [jump @ f.T_world_cam if i >= 14 else f.T_world_cam for i, f in enumerate(frames)]
    counts, wrong = [], []
    for frame, result in zip(frames[14:], run(DenseEvidence(), frames, poses)[14:], strict=True):
        z = true_depth(frame, result.pixel)
        wrong.extend(np.abs(1 / result.depth - 1 / z) * result.depth**2 / np.sqrt(result.variance) > 5)
        counts.append(len(z))
    assert np.mean(wrong) < 0.1
    assert np.median(counts[-14:]) > 40, "evidence comes back"


@pytest.fixture(scope="module")
def long_tours():
    names = ["tour:71?style=mixed&frames=60&size=240x320", "tour:72?frames=60&size=240x320"]
    return [list(open_sequence(name)) for name in names]


@pytest.mark.slow
@pytest.mark.parametrize("how", ["exact", "noise", "drift", "late", "focal", "centre", "lens", "image", "blur"])
def test_on_worse_recordings_errors_are_as_large_as_stated(long_tours, how, monkeypatch):
    monkeypatch.syspath_prepend(str(Path(__file__).resolve().parents[1] / "docs"))
    script = importlib.import_module("measure_evidence")
    middle, outliers = [], []
    for tour in long_tours:
        sizes = []
        for frame, result, _ in script.measured(tour, DenseEvidence(), script.DISTURBANCES[how]):
            z = true_depth(frame, result.pixel)
            sizes.extend(np.abs(1 / result.depth - 1 / z) * result.depth**2 / np.sqrt(result.variance))
        assert len(sizes) > 90 * len(tour)
        middle.append(np.median(sizes) / 0.674)
        outliers.append(np.mean(np.array(sizes) > 5))
    assert 0.8 < np.mean(middle) < 1.25
    assert np.mean(outliers) < 0.05


def test_a_thing_that_moves_by_itself_gives_hardly_any_anchors(tour):
    frames, rng = [*tour, *tour[::-1]], np.random.default_rng(1)
    thing, images, where = rng.integers(0, 255, (10, 13, 1)).repeat(3, 2).repeat(4, 0).repeat(4, 1), [], []
    for i, frame in enumerate(frames):
        v, u = int(40 + 20 * np.sin(1.3 * i)), int(54 + 30 * np.cos(0.9 * i))
        image = frame.image.copy()
        image[v : v + 40, u : u + 52] = thing
        images.append(image)
        where.append((u, v))
    on_it, beside = 0, 0
    for (u, v), result in zip(where, run(DenseEvidence(), frames, images=images), strict=True):
        # Windows reach 4 px: at its rim lie points of the background.
        inside = ((result.pixel >= [u + 4, v + 4]) & (result.pixel < [u + 48, v + 36])).all(1)
        on_it, beside = on_it + inside.sum(), beside + (~inside).sum()
    assert beside > 500
    assert on_it < 0.02 * beside, "it covers a tenth of the image and has more contrast than the rest"


def test_memory_is_fixed_and_reset_forgets(tour):
    evidence = DenseEvidence(DenseConfig(keyframes=5, landmarks=150))
    first, sizes = [], set()
    for frame in tour:
        first.append(evidence.update(frame.image, frame.T_world_cam, frame.intrinsics))
        sizes.add(tuple((name, tuple(value.shape)) for name, value in evidence.state().items()))
    assert len(sizes) == 1
    evidence.reset()
    for a, b in zip(first, run(evidence, tour), strict=True):
        np.testing.assert_array_equal(a.depth, b.depth)


@pytest.mark.parametrize(
    ("change", "error", "told"),
    [
        ({"image": np.zeros((120, 160, 3))}, ValueError, "image must be uint8"),
        ({"image": None}, TypeError, "image must be a NumPy array"),
        ({"image": np.zeros((60, 80, 3), dtype=np.uint8)}, ValueError, r"call reset\(\) first"),
        ({"T_world_cam": np.full((4, 4), np.nan)}, ValueError, "T_world_cam must be a finite 4x4"),
        ({"K": np.zeros((3, 3))}, ValueError, "K must be a finite 3x3"),
        ({"K": np.diag([200.0, 200, 1])}, ValueError, r"call reset\(\) first"),
    ],
)
def test_wrong_input_leaves_everything_as_it_was(tour, change, error, told):
    one, other = DenseEvidence(), DenseEvidence()
    for frame in tour[:7]:
        arguments = {"image": frame.image, "T_world_cam": frame.T_world_cam, "K": frame.intrinsics}
        expected = one.update(**arguments)
        if frame.index > 0:
            with pytest.raises(error, match=told):
                other.update(**{**arguments, **change})
        np.testing.assert_array_equal(other.update(**arguments).depth, expected.depth)


@pytest.mark.parametrize("value", [0, 255])
def test_blank_and_noisy_images_give_no_anchors(tour, value):
    rng = np.random.default_rng(0)
    blank = [np.full((120, 160, 3), value, np.uint8) for _ in tour]
    assert sum(len(f.depth) for f in run(DenseEvidence(), tour, images=blank)) == 0
    noise = [rng.integers(0, 255, (120, 160, 3)).astype(np.uint8) for _ in tour]
    assert sum(len(f.depth) for f in run(DenseEvidence(), tour, images=noise)) < 10


def test_config_refuses_the_impossible():
    for values in ({"width": 10}, {"keyframes": 1}, {"start_depth": 0.0}, {"memory": 1.0}, {"least_score": 2}):
        with pytest.raises(ValueError, match="DenseConfig"):
            DenseConfig(**values)
    assert DenseConfig.from_dict(DenseConfig(width=160).to_dict()) == DenseConfig(width=160)

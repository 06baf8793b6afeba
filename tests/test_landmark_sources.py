"""Tracked corners and dense evidence on rendered rooms, where every depth is known."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
import torch
from landmark_runs import long_walk, run, surprise, true_depth, walk
from scipy.ndimage import gaussian_filter, map_coordinates
from scipy.spatial.transform import Rotation

from ufmstar_torch.anchors import landmark_source
from ufmstar_torch.anchors.dense import DenseConfig, DenseEvidence
from ufmstar_torch.anchors.kernels.dense import free_pixels
from ufmstar_torch.anchors.kernels.windows import LEAST_CONTRAST
from ufmstar_torch.anchors.streams import StreamLandmarks
from ufmstar_torch.anchors.tracker import LandmarkTracker, TrackerConfig
from ufmstar_torch.eval.methods.perturb import Drift, perturbed
from ufmstar_torch.eval.methods.setting import Setting
from ufmstar_torch.eval.sequences.open import open_sequence

SMALL = {
    "corners": lambda: LandmarkTracker(TrackerConfig(max_points=40, window=4)),
    "dense": lambda: DenseEvidence(DenseConfig(keyframes=5, landmarks=150, corners=40)),
}


@pytest.fixture(scope="module")
def tour():
    return walk()


@pytest.fixture(params=SMALL)
def kind(request):
    return request.param


def test_depths_are_right_and_as_uncertain_as_stated(tour, kind):
    results = run(landmark_source(kind), tour)
    counts = [len(r.depth) for r in results]
    assert counts[0] == 0, "one view has no parallax"
    assert counts[1] >= 10, "the second view shows depths"
    assert np.median(counts[6:]) >= {"corners": 20, "dense": 60}[kind]
    errors = np.concatenate([np.abs(r.depth / true_depth(f, r.pixel) - 1) for f, r in zip(tour, results, strict=True)])
    assert np.median(errors) < 0.06
    sizes = np.concatenate([surprise(f, r) for f, r in zip(tour, results, strict=True)])
    assert 0.4 < 1.4826 * np.median(sizes) < 2


def test_the_first_depths_need_no_good_guess_of_the_scene(tour):
    for guess in (0.4, 10.0):
        first, second = run(DenseEvidence(DenseConfig(start_depth=guess)), tour[:3])[1:]
        assert len(first.depth) >= 10 or len(second.depth) >= 60
        errors = np.abs(second.depth / true_depth(tour[2], second.pixel) - 1)
        assert np.median(errors) < 0.06


def test_a_standing_and_a_turning_camera_have_no_anchors(tour, kind):
    frame, gray = tour[3], np.tile(tour[3].image[:, :, 0], (1, 3))
    assert sum(len(r.depth) for r in run(landmark_source(kind), [frame] * 6)) == 0
    source, K = landmark_source(kind), np.array([[1000.0, 0, 119.5], [0, 1000, 89.5], [0, 0, 1]])
    for step in range(8):  # like a turn seen with a long focal length: the image moves sideways
        T = np.eye(4)
        T[:3, :3] = Rotation.from_rotvec([0, np.arctan(6 * step / 1000), 0]).as_matrix()
        image = np.ascontiguousarray(gray[:, 40 + 6 * step : 280 + 6 * step])
        assert len(source.update(image, T, K).depth) == 0
    if kind == "corners":
        assert source.update(image, T, K).tracked > 20, "there were corners to track"


DEFECTS = {
    "reversed": lambda poses, images: (poses[::-1], images),
    "standing": lambda poses, images: (poses, [np.bitwise_xor(images[0], i % 2 + 1) for i in range(len(images))]),
}


@pytest.mark.parametrize("defect", DEFECTS)
def test_images_that_contradict_the_poses_give_no_depth_and_a_warning(tour, kind, defect, caplog):
    poses, images = DEFECTS[defect]([f.T_world_cam for f in tour], [f.image for f in tour])
    streams, K = StreamLandmarks(kind), torch.from_numpy(tour[0].intrinsics)
    for T, image in zip(poses, images, strict=True):
        anchors = streams.update(torch.from_numpy(image).permute(2, 0, 1)[None], torch.from_numpy(T), K)
    assert streams.last[0].contradicted
    assert anchors.valid.sum() == 0
    assert anchors.pose_error > 0.01 * 240
    assert sum("poses contradict the images" in record.message for record in caplog.records) == 1, "once per stream"
    assert streams.last[0].none.startswith("poses contradict the images")


def test_an_image_that_is_repeated_changes_nothing(tour, kind, caplog):
    images = [frame.image for frame in tour]
    twice, once = landmark_source(kind), landmark_source(kind)
    for i, frame in enumerate(tour[:6]):
        for source in (twice, once):
            last = source.update(frame.image, frame.T_world_cam, frame.intrinsics)
        again = twice.update(frame.image, tour[i + 1].T_world_cam, frame.intrinsics)
        assert len(again.depth) == 0
        assert "again" in again.none
    assert len(last.depth) > 0
    for name, value in once.state().items():
        torch.testing.assert_close(twice.state()[name], value, rtol=0, atol=0)
    streams, K = StreamLandmarks(kind), torch.from_numpy(tour[0].intrinsics)
    for frame in tour:
        image = torch.from_numpy(images[0]).permute(2, 0, 1)[None]
        assert not streams.update(image, torch.from_numpy(frame.T_world_cam), K).valid.any()
    assert sum("the image is the one before again" in record.message for record in caplog.records) == 1


def test_a_late_trajectory_gives_no_depth_or_one_as_uncertain_as_it_is_wrong(tour, kind):
    poses = [f.T_world_cam for f in tour]
    results = run(landmark_source(kind), tour, [*poses[:3], *poses[:-3]])
    assert sum(len(r.depth) for r in results if r.contradicted) == 0
    sizes = np.concatenate([surprise(f, r) for f, r in zip(tour, results, strict=True)])
    assert np.median(sizes) < 2.5 * 0.6745


def test_nothing_is_searched_where_errors_of_the_refined_poses_exceed_the_limit(tour):
    usual, strict = (run(DenseEvidence(DenseConfig(corner_sigma=s)), tour) for s in (0.1, 1e-4))
    assert len(strict[1].depth) == len(usual[1].depth) > 0, "two poses are not refined"
    assert sum(len(r.depth) for r in strict[5:]) < 0.3 * sum(len(r.depth) for r in usual[5:])


def test_one_blurred_image_is_no_contradiction_to_report_and_nothing_learnt_is_forgotten(tour, kind, caplog):
    streams, K = StreamLandmarks(kind), torch.from_numpy(tour[0].intrinsics)
    contradicted = 0
    for i, frame in enumerate(tour):
        image = frame.image if i != 5 else np.roll(frame.image, 10, axis=0)
        streams.update(torch.from_numpy(image).permute(2, 0, 1)[None], torch.from_numpy(frame.T_world_cam), K)
        contradicted += streams.last[0].contradicted
        assert np.isfinite(streams.last[0].shared)
    assert contradicted > 0, "its depths are not used"
    assert "contradict the images" not in caplog.text


def test_a_saved_state_continues_and_a_reset_forgets_everything(tour, kind):
    source, other, first, sizes = SMALL[kind](), SMALL[kind](), [], set()
    for i, frame in enumerate(tour):
        if i == 7:
            state = source.state()
            saved = {name: value.clone() for name, value in state.items()}
        first.append(source.update(frame.image, frame.T_world_cam, frame.intrinsics))
        sizes.add(tuple((name, tuple(value.shape)) for name, value in source.state().items()))
    assert len(sizes) == 1, "memory is fixed"
    assert all(torch.equal(state[name], value) for name, value in saved.items())
    other.load_state(state)
    source.reset()
    for results, expected in ((run(other, tour[7:]), first[7:]), (run(source, tour), first)):
        for a, b in zip(results, expected, strict=True):
            for name in ("pixel", "depth", "variance"):
                np.testing.assert_array_equal(getattr(a, name), getattr(b, name))
    with pytest.raises(ValueError, match=r"must (have shape|be a tensor)"):
        landmark_source(kind).load_state(state)


@pytest.mark.parametrize(
    ("argument", "value", "error"),
    [
        ("image", np.zeros((180, 240, 3)), ValueError),
        ("image", None, TypeError),
        ("image", np.zeros((90, 120, 3), dtype=np.uint8), ValueError),
        ("T_world_cam", np.full((4, 4), np.nan), ValueError),
        ("K", np.zeros((3, 3)), ValueError),
        ("K", np.diag([200.0, 200, 1]), ValueError),
    ],
)
def test_wrong_input_leaves_a_source_as_it_was(tour, kind, argument, value, error):
    one, other = SMALL[kind](), SMALL[kind]()
    for frame in tour[:6]:
        arguments = {"image": frame.image, "T_world_cam": frame.T_world_cam, "K": frame.intrinsics}
        expected = one.update(**arguments)
        if frame.index > 0:
            with pytest.raises(error, match=argument):
                other.update(**{**arguments, argument: value})
        np.testing.assert_array_equal(other.update(**arguments).depth, expected.depth)


@pytest.mark.slow
def test_stated_variances_are_those_of_the_errors(kind):
    sizes, errors, counts = [], [], []
    for frames in map(long_walk, range(2)):
        for frame, result in zip(frames, run(landmark_source(kind), frames), strict=True):
            sizes.extend(surprise(frame, result))
            errors.extend(np.abs(result.depth / true_depth(frame, result.pixel) - 1))
            counts.append(len(result.depth))
    assert 0.8 < np.median(sizes) / 0.674 < 1.25
    assert np.mean(np.array(sizes) > 5) < {"corners": 0.12, "dense": 0.05}[kind]
    assert np.median(errors) < {"corners": 0.06, "dense": 0.015}[kind]
    assert np.mean(counts) > {"corners": 80, "dense": 180}[kind]


def wrong_focal_length(frames, seed):
    return [replace(f, intrinsics=f.intrinsics * np.array([[1.01, 1, 1], [1, 1.01, 1], [1, 1, 1]])) for f in frames]


def noisy(frames, seed):
    setting = Setting(rotation_noise=0.1, translation_noise=0.003, seed=seed)
    return [replace(f, T_world_cam=perturbed(f.T_world_cam, setting, f.index)) for f in frames]


def drifting(frames, seed):
    walked = Drift(Setting(rotation_drift=0.05, translation_drift=0.002, seed=seed))
    return [replace(f, T_world_cam=walked.of(f.T_world_cam, f.index)) for f in frames]


@pytest.mark.slow
@pytest.mark.parametrize(("disturbed", "seeds"), [(noisy, 3), (drifting, 3), (wrong_focal_length, 1)])
def test_on_worse_recordings_errors_are_as_large_as_stated(disturbed, seeds):
    # A single drift gives .9 to 1.8, and rounding changes it by .2; hence the mean over several.
    middle, outliers = [], []
    for frames, seed in itertools.product(map(long_walk, range(2)), range(seeds)):
        results = run(DenseEvidence(), disturbed(frames, seed))
        sizes = np.concatenate([surprise(frame, result) for frame, result in zip(frames, results, strict=True)])
        assert len(sizes) > 90 * len(frames)
        middle.append(np.median(sizes) / 0.674)
        outliers.append(np.mean(sizes > 5))
    assert 0.8 < np.mean(middle) < 1.25
    assert np.mean(outliers) < 0.05


def test_a_thing_that_moves_by_itself_gives_hardly_any_anchors(tour):
    frames, rng = [*tour, *tour[::-1]], np.random.default_rng(1)
    thing, images, where = rng.integers(0, 255, (15, 19, 1)).repeat(3, 2).repeat(4, 0).repeat(4, 1), [], []
    for i, frame in enumerate(frames):
        v, u = int(60 + 30 * np.sin(1.3 * i)), int(81 + 45 * np.cos(0.9 * i))
        image = frame.image.copy()
        image[v : v + 60, u : u + 76] = thing
        images.append(image)
        where.append((u, v))
    on_square, elsewhere = 0, 0
    for (u, v), result in zip(where, run(DenseEvidence(), frames, images=images), strict=True):
        # Windows extend 4 px: pixels at the square's border show the background.
        inside = ((result.pixel >= [u + 4, v + 4]) & (result.pixel < [u + 72, v + 56])).all(1)
        on_square, elsewhere = on_square + inside.sum(), elsewhere + (~inside).sum()
    assert elsewhere > 500
    assert on_square < 0.02 * elsewhere, "the square covers a tenth of the image and has more contrast than the rest"


@pytest.mark.parametrize("value", [0, 255])
def test_blank_and_noisy_images_give_no_anchors(tour, value):
    rng = np.random.default_rng(0)
    blank = [np.full((180, 240, 3), value, np.uint8) for _ in tour]
    assert sum(len(f.depth) for f in run(DenseEvidence(), tour, images=blank)) == 0
    noise = [rng.integers(0, 255, (180, 240, 3)).astype(np.uint8) for _ in tour]
    assert sum(len(f.depth) for f in run(DenseEvidence(), tour, images=noise)) < 10


def test_video_without_noise_leaves_finite_estimates_and_anchors():
    frames = list(open_sequence("tour:5?frames=14&size=120x160&sensor=0"))
    evidence, counts = DenseEvidence(), []
    for frame in [*frames, *frames[::-1]] * 3:
        counts.append(len(evidence.update(frame.image, frame.T_world_cam, frame.intrinsics).depth))
        assert all(np.isfinite(value.numpy()).all() for value in evidence.state().values())
    assert np.median(counts[-14:]) > 20


@pytest.mark.parametrize("name", ["pose_left", "pose_variance", "camera_covariance", "landmark_point", "pose", "depth"])
def test_a_state_that_is_not_finite_is_refused(tour, name):
    evidence = DenseEvidence()
    run(evidence, tour[:4])
    before = evidence.state()
    with pytest.raises(ValueError, match=f"{name}.*must be finite"):
        evidence.load_state(before | {name: before[name] * np.nan})
    assert all(torch.equal(value, before[key]) for key, value in evidence.state().items())


def test_images_of_another_size_are_refused_by_a_source_and_restart_that_of_a_stream_however_small():
    """An undone frame is undone together with its image size, so a frame of another size can follow."""
    K, sizes = np.eye(3), [(1, 1), (2, 1), (1, 2), (8, 8)]
    for first, other in itertools.permutations(sizes, 2):
        streams = StreamLandmarks("dense")
        image = {size: torch.zeros(1, 3, *size, dtype=torch.uint8) for size in sizes}
        pose, camera = torch.eye(4, dtype=torch.float64), torch.from_numpy(K)
        for _ in range(3):
            streams.update(image[first], pose, camera)
        arrays = [image[size][0].permute(1, 2, 0).numpy() for size in (first, other)]
        evidence = DenseEvidence()
        evidence.update(arrays[0], np.eye(4), K)
        with pytest.raises(ValueError, match="of the size and camera of the images before"):
            evidence.update(arrays[1], np.eye(4), K)
        streams.update(image[other], pose, camera)
        assert streams.restarts == 1
        streams.undo()
        streams.update(image[first], pose, camera)
        assert streams.restarts == 1
        streams.reset()
        streams.update(image[first], pose, camera)
        streams.undo()
        streams.update(image[other], pose, camera)


def test_surfaces_without_fine_texture_are_measured_by_wider_windows():
    """A plane whose contrast is below the minimum in 8 px windows, and above it in 16 px windows."""
    texture = gaussian_filter(np.random.default_rng(0).standard_normal((700, 900)), 9)
    texture, K = 127 + 3.5 * texture / texture.std(), np.array([[200.0, 0, 159.5], [0, 200, 119.5], [0, 0, 1]])
    v, u = np.mgrid[:240, :320]
    evidence, found, fine = DenseEvidence(), [], 0
    for step in range(12):
        T = np.eye(4)
        T[0, 3] = 0.06 * step
        where = [v + 150, u + 150 + 200 * T[0, 3] / 2]
        image = np.rint(map_coordinates(texture, where, order=1)).astype(np.uint8)
        found.append(evidence.update(image, T, K))
        pixel = free_pixels(image, 10, np.zeros((0, 2)))
        patch = np.stack([image[y - 4 : y + 4, x - 4 : x + 4].std() for x, y in pixel.astype(int)])
        fine += int((patch > LEAST_CONTRAST).sum())
    depth, sigma = (np.concatenate(x) for x in zip(*((f.depth, np.sqrt(f.variance)) for f in found[4:]), strict=True))
    assert len(depth) > 2 * fine, "most of these windows have too little contrast"
    assert np.median(np.abs(depth / 2 - 1)) < 0.03
    assert np.mean(np.abs(depth - 2) < 3 * sigma) > 0.95


def test_the_second_image_shows_the_far_wall_too_and_not_the_near_thing_alone():
    """A textured plate at 1 m before a wall at 6 m, and a step of 2 cm: the wall moves by a pixel."""
    rng, K = np.random.default_rng(0), np.array([[300.0, 0, 159.5], [0, 300, 119.5], [0, 0, 1]])
    texture = [gaussian_filter(rng.uniform(0, 255, (400, 500)), 1.2) for _ in range(2)]
    texture = [(128 + 40 * (x - x.mean()) / x.std()).clip(0, 255) for x in texture]
    v, u = np.mgrid[:240, :320].astype(float)

    def view(x):
        wall, plate = (
            map_coordinates(t, [v + 50, u + 50 + 300 * x / z], order=1)
            for t, z in zip(texture, (6.0, 1.0), strict=True)
        )
        left = u + 300 * x
        return np.where((left > 60) & (left < 260), plate, wall).astype(np.uint8)

    evidence = DenseEvidence(DenseConfig(start_depth=1.0))
    for x in (0.0, 0.02):
        T = np.eye(4)
        T[0, 3] = x
        result = evidence.update(view(x), T, K)
    far = (result.pixel[:, 0] < 45) | (result.pixel[:, 0] > 275)
    assert (~far).sum() > 50
    assert far.sum() > 50, "the wall has as many measurements as the plate"
    inverse = 1 / result.depth[far]
    sigma = np.sqrt(result.variance[far]) * inverse**2
    assert np.median(np.abs(inverse - 1 / 6) / sigma) < 2, "by as much as stated"
    assert np.median(result.depth[far]) > 2.5

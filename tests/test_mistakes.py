"""Plausible mistakes in a user's input: each is reported, and correct input causes no warning."""

from __future__ import annotations

import re
from dataclasses import replace
from functools import cache
from itertools import islice

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from shared_data import require_shared

import scenes
from ufmstar_torch import AnchorConfig, DepthPrediction, SPGFConfig, UfMStar, UfMStarConfig, UncertainDepth
from ufmstar_torch.anchors import Anchors, landmarks
from ufmstar_torch.anchors.pose_check import PoseCheck
from ufmstar_torch.anchors.pose_fit import CornerTrack
from ufmstar_torch.eval.check.depth_image_fit import depth_image_fit, image_at_map, part_of_image
from ufmstar_torch.eval.check.image_fit import depth_fit, image_fit, track_corners
from ufmstar_torch.eval.sequences import open_sequence
from ufmstar_torch.eval.sequences.frame import check_intrinsics
from ufmstar_torch.eval.sequences.ground_truth import resample_nearest
from ufmstar_torch.models import load_network

H, W = 48, 64
K = scenes.intrinsics(H, W)
CONFIG = UfMStarConfig(segment=SPGFConfig(min_pixels=20, min_rows=1))
WALK = [scenes.camera_pose([0.1 * i, 0.02 * i, -0.04 * i], 0.05 * i) for i in range(14)]


def scaled(T, factor):
    """The pose with its position in another unit."""
    out = T.copy()
    out[:3, 3] *= factor
    return out


def warnings_on_walk(caplog, change=lambda T: T, config=CONFIG, anchors=None, frames=WALK):
    """Warnings during a walk in front of rendered boxes, with two streams; the second has correct poses."""
    caplog.clear()
    ufm = UfMStar(config)
    for T in frames:
        depth = torch.tensor(scenes.render(T, K, H, W))[None].repeat(2, 1, 1)
        poses = torch.tensor(np.stack([change(T), T]))
        options = {} if config.anchors is None else {"anchors": anchors}
        out = ufm(depth, poses, torch.tensor(K), **options)
    return caplog.messages, out.statistics


def on_surfaces(change=lambda pixel, depth: (pixel, depth)):
    """For every pose of the walk, 40 anchors on the rendered surfaces, after a change of their pixels and depths."""
    rng, walk = np.random.default_rng(0), []
    for T in WALK:
        v, u = (rng.integers(0, size, (2, 40)) for size in (H, W))
        pixel, depth = change(np.stack([u, v], -1).astype(float), scenes.render(T, K, H, W)[v, u])
        walk.append(Anchors(*(torch.tensor(value) for value in (pixel, depth, 1e-4 * depth**2))))
    return walk


WRONG_ANCHORS = {
    "normalised": (lambda p, d: (p / (W, H), d), "all 40 anchors lie within 1 px of the image's corner: are their pix"),
    "rows before columns": (lambda p, d: (p[..., ::-1].copy(), d), r"and none with rows and columns exchanged"),
    "of a larger image": (lambda p, d: (4 * p, d), r"outside the 64 x 48 image: are their pixels those of an image of"),
    "of another scale": (lambda p, d: (p, 5 * d), r"in 8 frames the anchors' median depth was 5 times the predicted"),
    "in millimetres": (lambda p, d: (p, 1000 * d), "40 of 40 anchors are off from the predicted depth by more than"),
}


@pytest.mark.parametrize("mistake", WRONG_ANCHORS)
def test_anchors_in_wrong_pixels_or_units_are_named_once_a_stream(caplog, mistake):
    change, words = WRONG_ANCHORS[mistake]
    ufm, right = (UfMStar(CONFIG.replace(anchors=AnchorConfig())) for _ in range(2))
    for T, anchors in zip(WALK, on_surfaces(), strict=True):
        right(torch.tensor(scenes.render(T, K, H, W)).repeat(2, 1, 1), T, K, anchors=anchors)
    assert not caplog.messages
    for T, anchors in zip(WALK, on_surfaces(change), strict=True):
        ufm(torch.tensor(scenes.render(T, K, H, W)).repeat(2, 1, 1), T, K, anchors=anchors)
    assert sorted(text[:8] for text in caplog.messages if re.search(words, text)) == ["stream 0", "stream 1"]


VIDEO = "tour:7?size=120x160&frames=40"
# By name: pose and K of image i from the frames, and the warning.
WRONG_VIDEO = {
    "right": (lambda i, f: (f[i].T_world_cam, f[i].intrinsics), ""),
    "world-to-camera": (
        lambda i, f: (np.linalg.inv(f[i].T_world_cam), f[i].intrinsics), "the poses look world-to-camera",
    ),
    "OpenGL axes": (
        lambda i, f: (f[i].T_world_cam @ np.diag([1.0, -1, -1, 1]), f[i].intrinsics), "with OpenGL axes",
    ),
    "late": (lambda i, f: (f[max(i - 2, 0)].T_world_cam, f[i].intrinsics), "the trajectory looks 2 frames late"),
    "K of another image": (
        lambda i, f: (f[i].T_world_cam, f[i].intrinsics * [[0.7], [0.7], [1.0]]), "for images 0.71 times as large",
    ),
}  # fmt: skip


@cache
def video():
    return list(open_sequence(VIDEO))


@pytest.mark.parametrize("mistake", WRONG_VIDEO)
def test_cameras_that_contradict_the_first_images_are_named_without_anchors(caplog, mistake):
    change, words = WRONG_VIDEO[mistake]
    model = UncertainDepth(lambda image: 2 + image[:, 0], CONFIG, check_poses=30)
    for i, frame in enumerate(video()):
        T, intrinsics = change(i, video())
        model(np.stack([frame.image] * 2), T, intrinsics)
    found = [text for text in caplog.messages if "disagree with the images" in text]
    assert len(found) == bool(words), caplog.messages
    assert all(words in text for text in found)


def test_images_are_compared_with_poses_at_the_beginning_alone(monkeypatch):
    added = []
    monkeypatch.setattr(CornerTrack, "add", lambda self, index, gray: added.append(index) or True)
    for model, indices in (
        (UncertainDepth(lambda image: 2 + image[:, 0], CONFIG, check_poses=4), [1, 3]),  # judged after 2 and 4
        (UncertainDepth(lambda image: 2 + image[:, 0], CONFIG, check_poses=0), []),
        (UncertainDepth(lambda image: 3 + image[:, 0], CONFIG, preprocess=None), []),  # normalised images
        (UncertainDepth(lambda image: 2 + image[:, 0], CONFIG, anchors="corners", posterior=True), []),
    ):
        added.clear()
        for frame in video()[:5]:
            image = frame.image if model.preprocess else torch.tensor(frame.image).permute(2, 0, 1) / 64.0 - 2
            model(image, frame.T_world_cam, frame.intrinsics)
        assert added == indices
    model = UncertainDepth(lambda image: 2 + image[:, 0], CONFIG)
    for frame in (*video()[:3], None, *video()[:2]):
        model.reset() if frame is None else model(frame.image, frame.T_world_cam, frame.intrinsics)
    assert added == [1, 2, 1]
    with pytest.raises(ValueError, match="check_poses must be a number of images of at least 0, got -1"):
        UncertainDepth(lambda image: image[:, 0], check_poses=-1)


@pytest.mark.parametrize("lost", [np.nan, 0.0])
def test_images_without_a_pose_are_not_compared(caplog, lost):
    """Tracking was lost, and poses are NaN or 0; later images are compared."""
    model = UncertainDepth(lambda image: 2 + image[:, 0], CONFIG.replace(on_bad_frame="skip"), check_poses=30)
    for i, frame in enumerate(video()):
        model(frame.image, np.linalg.inv(frame.T_world_cam) if i > 2 else np.full((4, 4), lost), frame.intrinsics)
    assert len([text for text in caplog.messages if "the poses look world-to-camera" in text]) == 1


def test_opencv_that_cannot_be_loaded_ends_the_comparison(monkeypatch):
    """As without libGL: an ImportError that is no ModuleNotFoundError."""

    def failing():
        raise ImportError("libGL.so.1: cannot open shared object file")

    monkeypatch.setattr(landmarks, "opencv", failing)
    model, frame = UncertainDepth(lambda image: 2 + image[:, 0], CONFIG), video()[0]
    assert model(frame.image, frame.T_world_cam, frame.intrinsics).depth.isfinite().all()


def test_a_reset_of_other_streams_keeps_the_first_ones_images(monkeypatch):
    added = []
    monkeypatch.setattr(CornerTrack, "add", lambda self, index, gray: added.append(index) or True)
    model = UncertainDepth(lambda image: 2 + image[:, 0], CONFIG)
    for frame, streams in zip(video(), ([1], [0], torch.tensor([False, True]), [1]), strict=False):
        model(np.stack([frame.image] * 2), frame.T_world_cam, frame.intrinsics)
        model.reset(streams)
    assert added == [1, 1]


def test_floats_up_to_255_are_named(caplog):
    class Network(torch.nn.Module):
        def forward(self, image):
            return DepthPrediction(2 + image[:, 0] / 255)

    model, frame = UncertainDepth(Network(), CONFIG), video()[0]
    model(torch.tensor(frame.image).permute(2, 0, 1).float(), frame.T_world_cam, frame.intrinsics)
    assert [text for text in caplog.messages if "the first image has floats up to 2" in text]


@pytest.mark.parametrize("factor", [100, 1000])
def test_views_that_never_meet_are_named_once_a_stream(caplog, factor):
    messages, statistics = warnings_on_walk(caplog, lambda T: scaled(T, factor))
    assert len(messages) == 1
    assert re.match(r"stream 0: after 8 frames \d+ of \d+ Gaussians were seen in one view alone", messages[0])
    assert "millimetres" in messages[0]
    assert int(statistics.single_view[0]) > 0.9 * int(statistics.components[0])
    assert int(statistics.single_view[1]) < 0.7 * int(statistics.components[1])


def test_right_input_is_not_warned_of(caplog):
    assert warnings_on_walk(caplog)[0] == []
    assert warnings_on_walk(caplog, frames=WALK[:1] * 14)[0] == [], "a camera that stands still"


def test_moving_frames_without_anchors_are_named(caplog):
    config = CONFIG.replace(anchors=AnchorConfig())
    messages, _ = warnings_on_walk(caplog, config=config)
    assert [re.match(r"stream (\d): 0 anchors were used in 10 frames of a moving camera", m)[1] for m in messages] == [
        "0",
        "1",
    ]
    assert warnings_on_walk(caplog, config=config, frames=WALK[:1] * 14)[0] == []
    rng, n = np.random.default_rng(0), 40
    pixel = torch.tensor(np.stack([rng.uniform(0, W - 1, (2, n)), rng.uniform(0, H - 1, (2, n))], -1))
    far = Anchors(pixel, torch.full((2, n), 2.0).double(), torch.full((2, n), 1e-2).double())
    assert warnings_on_walk(caplog, config=config, anchors=far)[0] == []


def turned_K(factor):
    """K for an image ``factor`` times as large."""
    return K * [[factor], [factor], [1]]


SWAPPED = np.array([[K[0, 0], 0, K[1, 2]], [0, K[1, 1], K[0, 2]], [0, 0, 1]])
STEPS = 18
# By name: a function from frame i's correct depth [H, W] and pose to wrong depth, pose, K and options; and the warning.
SPOILT = {
    "cx and cy swapped": (lambda i, d, T: (d, T, SWAPPED, {}), "0.38 of the width and 0.67 .* are cx and cy swapped"),
    "K of a smaller image": (lambda i, d, T: (d, T, turned_K(0.35), {}), "or are these the intrinsics of an image of"),
    "no principal point": (lambda i, d, T: (d, T, np.diag([K[0, 0], K[1, 1], 1.0]), {}), "point lies at 0.01"),
    "negative depth": (lambda i, d, T: (-d, T, K, {}), "none of 8 frames has a pixel with a positive and finite depth"),
    "nothing valid": (lambda i, d, T: (d, T, K, {"valid": d < 0}), "none of 8 frames .* where valid is True"),
    "logarithm of a variance": (
        lambda i, d, T: (d, T, K, {"aleatoric": np.log(d / np.median(d))}),
        r"pixels are left out: of 3072 pixels 0 lie beyond .* and \d+ outside .*logarithms",
    ),
    "pixels beyond an unstated range": (lambda i, d, T: (np.where(d > 2, 25.0, d), T, K, {}), "does the network state"),
    "variance in square millimetres": (
        lambda i, d, T: (d, T, K, {"epistemic": 1e6 * (0.1 * d) ** 2}), "that epistemic states is over 10 times the de"
    ),
    "a pose that is not updated": (
        lambda i, d, T: (d, WALK[0], K, {}), r"the pose was the same in \d+ frames, in which the depth changed by"
    ),
    "a depth map that is not updated": (
        lambda i, d, T: (np.full_like(d, 2.0), T, K, {}), "depth map was the same in 9 frames of a moving camera"
    ),
    "another recording": (
        lambda i, d, T: (d, rigid(T[:3, :3], T[:3, 3] + [30.0 * (i > 10), 0, 0]), K, {}), "the camera jumped by 30.1 m"
    ),
    "a second recording from the same origin": (
        lambda i, d, T: (d, WALK[(i % 12)], K, {}), "the pose is exactly the first one again, 11 poses later"
    ),
    "two cameras in turn": (
        lambda i, d, T: (d, rigid(T[:3, :3], T[:3, 3] + [1.5 * (i % 2), 0, 0]), K, {}), "go back and forth between two"
    ),
    "an ensemble of copies": (lambda i, d, T: (d, T, K, {"epistemic": 0 * d}), "copies of one network"),
    "another camera": (
        lambda i, d, T: (d, T, K @ np.diag([1 + 0.5 * (i % 2), 1, 1]), {}),
        "the focal length changed from frame to frame .*every camera is a stream of its own",
    ),
    "inverted valid": (
        lambda i, d, T: (d, T, K, {"valid": torch.arange(H * W).reshape(H, W) % W < 5}),
        r"only 7.8% of the pixels are used: is valid inverted\? True = use",
    ),
    "a network that saturates": (
        lambda i, d, T: (np.minimum(d, 2.5), T, K, {}),
        r"the depth of \d\d% of the pixels is 2.5 m in every frame: if the network cannot predict more",
    ),
}  # fmt: skip


@pytest.mark.parametrize("mistake", SPOILT)
def test_what_frames_show_is_named_once(caplog, mistake):
    change, words = SPOILT[mistake]
    walk = [scenes.camera_pose([0.1 * i, 0.02 * i, -0.04 * i], 0.05 * i) for i in range(STEPS)]
    ufm = UfMStar(CONFIG)
    for i, T in enumerate(walk):
        depth, pose, camera, options = change(i, scenes.render(T, K, H, W), T)
        ufm(depth[None], pose, camera, **{name: value[None] for name, value in options.items()})
    assert len([text for text in caplog.messages if re.search(words, text)]) == 1, caplog.messages


def test_frames_of_one_video_given_as_a_batch_are_named(caplog):
    walk = [scenes.camera_pose([0.05 * i, 0.01 * i, -0.02 * i], 0.02 * i) for i in range(16)]
    rig = [[scenes.camera_pose([0.05 * i, 0.3 * camera, 0], 0.02 * i) for camera in range(4)] for i in range(8)]
    for batches, named in (([walk[i : i + 4] for i in range(0, 16, 4)], 1), (rig, 0)):
        caplog.clear()
        ufm = UfMStar(CONFIG)
        for poses in batches:
            ufm(torch.tensor(np.stack([scenes.render(T, K, H, W) for T in poses])), torch.tensor(np.stack(poses)), K)
        found = [text for text in caplog.messages if "4 streams of a batch look like successive frames" in text]
        assert len(found) == named


def test_a_stream_that_is_reset_may_begin_elsewhere(caplog):
    ufm, far = UfMStar(CONFIG), [rigid(T[:3, :3], T[:3, 3] + 50) for T in WALK]
    for poses in (WALK, far):
        for T in poses:
            ufm(scenes.render(WALK[0], K, H, W)[None] + 0.01 * T[0, 3], T, K)
        ufm.reset([0])
    assert not [text for text in caplog.messages if "jumped" in text]


# ---- what tracked corners show: each mistake on recordings and rendered tours ----

RECORDINGS = ("rgbd_dataset_freiburg1_xyz", "rgbd_dataset_freiburg3_teddy", "hololens_office", "tartanair_sample/P000")
TOURS = tuple(f"tour:{seed}?frames=50&size=120x160" for seed in (41, 42, 43, 44, 45, 46))
OPENGL = np.diag([1.0, -1, -1, 1])


def posed(sequence, change):
    entries = (replace(entry, T_world_cam=change(entry.T_world_cam)) for entry in sequence.entries)
    return replace(sequence, entries=tuple(entries))


def late(sequence, frames):
    T = [entry.T_world_cam for entry in sequence.entries]
    delayed = (replace(e, T_world_cam=T[max(i - frames, 0)]) for i, e in enumerate(sequence.entries))
    return replace(sequence, entries=tuple(delayed))


def of_size(sequence, factor):
    """Intrinsics for images ``factor`` times as large. Raises ValueError as opening such a sequence does."""
    K = sequence.intrinsics * np.array([[factor], [factor], [1]])
    check_intrinsics("intrinsics", K, sequence.image_size)
    entries = tuple(replace(entry, intrinsics=None) for entry in sequence.entries)
    return replace(sequence, entries=entries, intrinsics=K)


def same(x):
    return x


# By name: a function that spoils the sequence, one that spoils its depth, and part of the reported problem.
MISTAKES = {
    "world-to-camera poses": (lambda s: posed(s, np.linalg.inv), same, "poses look|images belong together under no"),
    "OpenGL axes": (lambda s: posed(s, lambda T: T @ OPENGL), same, "poses look|images belong together under no"),
    "poses in millimetres": (lambda s: posed(s, lambda T: scaled(T, 1000)), same, "not in metres"),
    "poses 20 times too large": (lambda s: posed(s, lambda T: scaled(T, 20)), same, "not in metres"),
    "K of images 1.5 times as large": (lambda s: of_size(s, 1.5), same, "given for images 1.[2-8] times"),
    "K of images .7 times as large": (lambda s: of_size(s, 0.7), same, "given for images 0.[5-8]"),
    "K of images twice as large": (lambda s: of_size(s, 2), same, "another image size"),
    "K of 224 px for 640": (lambda s: of_size(s, 0.35), same, "another image size"),
    "K normalised": (lambda s: of_size(s, 1 / s.image_size[1]), same, "another image size"),
    "trajectory 1 frame late": (lambda s: late(s, 1), same, "1 frame late"),
    "trajectory 2 frames late": (lambda s: late(s, 2), same, "2 frames late"),
    "trajectory 3 frames late": (lambda s: late(s, 3), same, "3 frames late"),
    "depth in millimetres": (same, lambda d: 1000 * d, "not in metres"),
    "inverse depth": (same, lambda d: 1 / np.maximum(d, 1e-3) * (d > 0), "is it inverse depth"),
}
# The lowest number of six tours in which the mistake is found; on some tours the motion is so even that poses of
# another frame fit as well.
LATE = {"trajectory 1 frame late": 2, "trajectory 2 frames late": 3, "trajectory 3 frames late": 4}


@cache
def followed(name):
    """A sequence, corners in it, and its depth at them."""
    sequence = open_sequence(name if name.startswith("tour:") else require_shared(f"data/{name}"))
    corners = track_corners(sequence)
    depth = {}
    for one in corners:
        u, v = np.rint(one.start).astype(int).T
        depth[one.first, len(u)] = sequence[one.first].depth[v, u]
    return sequence, corners, depth


def problems(name, change=same, spoil=same):
    """The problem reported for a sequence with changed poses or intrinsics and changed depth."""
    sequence, corners, depth = followed(name)
    try:
        sequence = change(sequence)
    except ValueError as error:
        return str(error)
    fit = image_fit(sequence, corners)
    if fit.problem:
        return fit.problem
    depths = depth_fit(sequence, corners, lambda index, pixel: spoil(depth[index, len(pixel)]))
    return "" if depths is None else depths.problem


@pytest.mark.parametrize("name", [*RECORDINGS, "tour:7?size=120x160", "tour:9?style=hall&size=120x160"])
def test_a_network_on_right_input_is_not_warned_of(caplog, name):
    path = name if name.startswith("tour:") else require_shared(f"data/{name}")
    model = UncertainDepth(load_network("fastdepth", require_shared("weights/fastdepth_nyu.onnx")))
    for frame in islice(open_sequence(path), 20):
        model(frame.image, frame.T_world_cam, frame.intrinsics)
    assert not caplog.messages


@pytest.mark.parametrize("name", RECORDINGS)
def test_right_input_raises_no_alarm(name):
    assert problems(name) == ""


@pytest.mark.parametrize("mistake", MISTAKES)
def test_each_mistake_is_named(mistake):
    change, spoil, words = MISTAKES[mistake]
    assert re.search(words, problems(RECORDINGS[0], change, spoil))


def rigid(R, t):
    """[4, 4] pose from a rotation and a position."""
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = R, t
    return out


def noisy(T, rng, degrees):
    """The pose rotated about a random axis."""
    turn = Rotation.from_rotvec(np.radians(degrees) * rng.normal(size=3)).as_matrix()
    return rigid(T[:3, :3] @ turn, T[:3, 3])


def wxyz(T):
    """The pose after its quaternion is read in the wrong order."""
    return rigid(Rotation.from_quat(np.roll(Rotation.from_matrix(T[:3, :3]).as_quat(), 1)).as_matrix(), T[:3, 3])


CORRUPTED = {
    "shuffled": lambda poses, rng: rng.permutation(poses),
    "of the other direction": lambda poses, rng: poses[::-1],
    "turned by 3 degrees": lambda poses, rng: [noisy(T, rng, 3) for T in poses],
    "quaternions of another order": lambda poses, rng: [wxyz(T) for T in poses],
    "transposed rotations": lambda poses, rng: [rigid(T[:3, :3].T, T[:3, 3]) for T in poses],
}


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(1, 4))])
@pytest.mark.parametrize("kind", CORRUPTED)
def test_corrupted_poses_are_named(kind, seed):
    def change(sequence):
        poses = np.array([entry.T_world_cam for entry in sequence.entries])
        poses = CORRUPTED[kind](poses, np.random.default_rng(seed))
        spoilt = (replace(e, T_world_cam=np.array(T)) for e, T in zip(sequence.entries, poses, strict=True))
        return replace(sequence, entries=tuple(spoilt))

    for name in RECORDINGS:
        problem = problems(name, change)
        assert "poses disagree with the images" in problem, name
        for still in re.findall(r"but by ([\d.]+) px under", problem):
            assert float(still) <= max(1, 0.005 * followed(name)[0].image_size[1]), "a misfit is no remedy"


@pytest.mark.slow
def test_in_how_many_clips_each_mistake_is_named():
    """The table of docs/results/mistakes.md (``-s`` prints it)."""
    for mistake, (change, spoil, words) in {"none": (same, same, "."), **MISTAKES}.items():
        found = [sum(bool(re.search(words, problems(n, change, spoil))) for n in part) for part in (RECORDINGS, TOURS)]
        print(f"| {mistake} | {found[0]} of {len(RECORDINGS)} | {found[1]} of {len(TOURS)} |")
        if mistake == "none":
            assert found == [0, 0]
        else:
            assert found[0] == len(RECORDINGS), mistake
            assert found[1] >= LATE.get(mistake, len(TOURS)), mistake


@pytest.mark.slow
def test_in_how_many_clips_the_first_images_show_each_mistake(caplog):
    """As ``UncertainDepth`` compares them, image by image; ``-s`` prints the table of docs/results/mistakes.md."""
    cameras = [name for name in MISTAKES if re.search("world-to|OpenGL|1.5|[.]7|late", name)]
    for mistake in ("none", *cameras):
        change, _, words = MISTAKES.get(mistake, (same, same, "."))
        found = [0, 0]
        for name in (*RECORDINGS, *TOURS):
            caplog.clear()
            check, sequence = PoseCheck(40, CONFIG.rotation_tolerance), change(followed(name)[0])
            for frame in islice(sequence, 40):
                image = torch.from_numpy(frame.image).permute(2, 0, 1)[None]
                check.compare(image, torch.from_numpy(frame.T_world_cam), torch.from_numpy(frame.intrinsics))
            found[name in TOURS] += any(re.search(words, text) for text in caplog.messages)
        print(f"| {mistake} | {found[0]} of {len(RECORDINGS)} | {found[1]} of {len(TOURS)} |")
        if mistake == "none":
            assert found == [0, 0]
        else:
            assert found[0] == len(RECORDINGS), mistake
            assert found[1] >= LATE.get(mistake, len(TOURS)), mistake


@pytest.mark.slow
def test_in_how_many_clips_maps_of_the_middle_are_named():
    """FastDepth's maps, as they are and the middle 3/4 of them enlarged; ``-s`` prints the fits."""
    network = load_network("fastdepth", require_shared("weights/fastdepth_nyu.onnx"))
    named = {"right": 0, "middle": 0}
    for name in (*RECORDINGS, *TOURS):
        sequence, shown = followed(name)[0], {"right": [], "middle": []}
        for i in np.unique(np.linspace(0, len(sequence) - 1, 12).astype(int)):
            frame = sequence[int(i)]
            x, K_map = network.preprocess(frame.image, frame.intrinsics)
            depth, K_map = network(x).depth[0].numpy(), K_map.numpy()
            image = image_at_map(frame.image, frame.intrinsics, K_map, depth.shape)
            K_middle = K_map.copy()
            K_middle[:2, :2] *= 4 / 3
            shown["right"].append((image, depth))
            shown["middle"].append((image, resample_nearest(depth, K_map, K_middle, depth.shape)))
        for kind, frames in shown.items():
            problem = part_of_image(frames)
            print(name, kind, depth_image_fit(frames), problem)
            named[kind] += "only the middle of the image" in problem
            assert kind == "middle" or not problem, name
    print(f"named: {named['middle']} of {len(RECORDINGS) + len(TOURS)}")
    assert named["middle"] >= 6

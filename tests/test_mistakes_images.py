"""Plausible mistakes in poses, intrinsics and depth that the images show, on recordings and rendered tours."""

from __future__ import annotations

import re
from dataclasses import replace
from functools import cache
from itertools import islice

import numpy as np
import pytest
import torch
from changed_poses import rigid, scaled
from scipy.spatial.transform import Rotation
from shared_data import require_shared

from ufmstar_torch import DepthPrediction, SPGFConfig, UfMStarConfig, UncertainDepth
from ufmstar_torch.anchors import landmarks, pose_fit
from ufmstar_torch.anchors.pose_check import PoseCheck
from ufmstar_torch.anchors.pose_fit import UNCHANGED, CornerTrack
from ufmstar_torch.eval.check.depth_image_fit import depth_image_fit, image_at_map, part_of_image
from ufmstar_torch.eval.check.image_fit import depth_fit, image_fit, track_corners
from ufmstar_torch.eval.sequences import open_sequence
from ufmstar_torch.eval.sequences.frame import check_intrinsics, in_memory
from ufmstar_torch.eval.sequences.ground_truth import resample_nearest
from ufmstar_torch.models import load_network

CONFIG = UfMStarConfig(segment=SPGFConfig(min_pixels=20, min_rows=1))
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
    with pytest.raises(ValueError, match="check_poses must be a whole number of at least 0, got -1"):
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
# Those of poses and intrinsics that a few frames can show.
CAMERAS = [name for name in MISTAKES if re.search("world-to|OpenGL|1.5|[.]7|late", name)]
# The lowest number of six tours in which the mistake is found; on some tours the motion is so even that poses of
# another frame fit as well.
LATE = {"trajectory 1 frame late": 2, "trajectory 2 frames late": 3, "trajectory 3 frames late": 4}


@cache
def followed(name):
    """A sequence, corners in it, and its depth at them."""
    sequence = in_memory(open_sequence(name if name.startswith("tour:") else require_shared(f"data/{name}")))
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


SLOW = [pytest.param(name, marks=pytest.mark.slow) for name in (*RECORDINGS[1:3], "tour:9?style=hall&size=120x160")]


@pytest.mark.parametrize("name", [RECORDINGS[0], RECORDINGS[3], VIDEO, *SLOW])
def test_a_network_on_right_input_is_not_warned_of(caplog, name):
    frames = video() if name == VIDEO else open_sequence(name if "tour:" in name else require_shared(f"data/{name}"))
    model = UncertainDepth(load_network("fastdepth", require_shared("weights/fastdepth_nyu.onnx")))
    for frame in islice(frames, 20):
        model(frame.image, frame.T_world_cam, frame.intrinsics)
    assert not caplog.messages


@pytest.mark.parametrize("name", RECORDINGS)
def test_four_frames_do_not_show_another_camera_or_delay(name):
    sequence = open_sequence(require_shared(f"data/{name}"))
    for start in range(0, len(sequence) - 4, 4):
        fit = image_fit(sequence, track_corners(sequence, range(start, start + 4)))
        assert fit is None or fit.reading == UNCHANGED
    wrong = posed(sequence, np.linalg.inv)  # another convention is found all the same, where the camera moves enough
    fits = [image_fit(wrong, track_corners(wrong, range(start, start + 4))) for start in range(0, len(wrong) - 4, 4)]
    assert any(fit is not None and fit.reading.poses == "world-to-camera" for fit in fits)


@pytest.mark.parametrize("name", RECORDINGS)
def test_right_input_raises_no_alarm(name):
    assert problems(name) == ""


@pytest.mark.parametrize("mistake", MISTAKES)
def test_each_mistake_is_named(mistake):
    change, spoil, words = MISTAKES[mistake]
    assert re.search(words, problems(RECORDINGS[0], change, spoil))


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


def print_row(mistake, found):
    """Print in how many recordings and tours a mistake was found, which must be all; none where there is no mistake."""
    print(f"| {mistake} | {found[0]} of {len(RECORDINGS)} | {found[1]} of {len(TOURS)} |")
    if mistake == "none":
        assert found == [0, 0]
    else:
        assert found[0] == len(RECORDINGS), mistake
        assert found[1] >= LATE.get(mistake, len(TOURS)), mistake


@pytest.mark.slow
@pytest.mark.parametrize("mistake", ["none", *MISTAKES])
def test_in_how_many_clips_a_mistake_is_named(mistake):
    """The table of docs/results/mistakes.md (``-s`` prints it)."""
    change, spoil, words = MISTAKES.get(mistake, (same, same, "."))
    found = [sum(bool(re.search(words, problems(n, change, spoil))) for n in part) for part in (RECORDINGS, TOURS)]
    print_row(mistake, found)


def remembered(function):
    """The function, its results kept by the values of its arguments."""
    results = {}

    def call(*arguments):
        key = tuple(hash(value.tobytes()) if isinstance(value, np.ndarray) else value for value in arguments)
        if key not in results:
            results[key] = function(*arguments)
        return results[key]

    return call


# Corners are the same under every mistake in poses and intrinsics.
FOLLOW = {name: remembered(getattr(pose_fit, name)) for name in ("find", "follow")}


@pytest.mark.slow
@pytest.mark.parametrize("mistake", ["none", *CAMERAS])
def test_in_how_many_clips_the_first_images_show_a_mistake(mistake, caplog, monkeypatch):
    """As ``UncertainDepth`` compares them, image by image; ``-s`` prints the table of docs/results/mistakes.md."""
    for function in FOLLOW.items():
        monkeypatch.setattr(pose_fit, *function)
    change, _, words = MISTAKES.get(mistake, (same, same, "."))
    found = [0, 0]
    for name in (*RECORDINGS, *TOURS):
        caplog.clear()
        check, sequence = PoseCheck(40, CONFIG.rotation_tolerance), change(followed(name)[0])
        for frame in islice(sequence, 40):
            image = torch.from_numpy(frame.image).permute(2, 0, 1)[None]
            check.compare(image, torch.from_numpy(frame.T_world_cam), torch.from_numpy(frame.intrinsics))
        found[name in TOURS] += any(re.search(words, text) for text in caplog.messages)
    print_row(mistake, found)


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

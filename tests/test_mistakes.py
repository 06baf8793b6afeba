"""Plausible mistakes in a user's input: each is reported, and correct input causes no warning."""

from __future__ import annotations

import re

import numpy as np
import pytest
import torch
from changed_poses import rigid, scaled

import scenes
from ufmstar_torch import AnchorConfig, SPGFConfig, UfMStar, UfMStarConfig
from ufmstar_torch.anchors import Anchors

H, W = 48, 64
K = scenes.intrinsics(H, W)
CONFIG = UfMStarConfig(segment=SPGFConfig(min_pixels=20, min_rows=1))
WALK = [scenes.camera_pose([0.1 * i, 0.02 * i, -0.04 * i], 0.05 * i) for i in range(14)]


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


@pytest.mark.parametrize(("right", "named"), [(0, True), (3, True), (5, False)])
def test_depth_counts_as_inverse_if_most_frames_show_it(caplog, right, named):
    """A network may misjudge the surfaces of one view, and so those of the frames after it."""
    ufm = UfMStar(CONFIG.replace(anchors=AnchorConfig()))
    for i, (T, anchors) in enumerate(zip(WALK, on_surfaces(), strict=True)):
        depth = torch.tensor(scenes.render(T, K, H, W)).repeat(2, 1, 1)
        ufm(depth if i < right else 4 / depth, T, K, anchors=anchors)
    assert any("is it inverse depth?" in text for text in caplog.messages) == named, caplog.messages


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

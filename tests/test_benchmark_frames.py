"""The benchmark's frames: the rendered room, and recorded sequences."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch
from layouts import write_tum

from ufmstar_torch import UfMStarConfig
from ufmstar_torch.eval.bench.frames import (
    RecordedSequence,
    RenderedRoom,
)
from ufmstar_torch.eval.bench.growth import measure_long_run
from ufmstar_torch.eval.bench.step import build_up
from ufmstar_torch.eval.tour import box_room as synthetic
from ufmstar_torch.models import FastDepth, FastDepthWidths


def scene(size=96, boxes=25):
    return synthetic.BoxRoom.furnished(boxes, seed=3), synthetic.intrinsics(size, size), size


def points_in_world(depth, T, K):
    v, u = np.mgrid[0 : depth.shape[0], 0 : depth.shape[1]]
    rays = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones_like(depth)], axis=-1)
    return (rays * depth[..., None]) @ T[:3, :3].T + T[:3, 3]


def surface_distance(points, box):
    """Distance [m] of points [..., 3] from the surface of a box [2, 3]."""
    outside = np.maximum(np.maximum(box[0] - points, points - box[1]), 0)
    inside = np.minimum(points - box[0], box[1] - points).min(-1)
    return np.where((outside > 0).any(-1), np.linalg.norm(outside, axis=-1), inside)


def test_every_pixel_lies_on_a_surface():
    room, K, size = scene()
    for T in synthetic.walk(4, period=4):
        points = points_in_world(synthetic.render(room, T, K, size, size), T, K)
        distances = [surface_distance(points, box) for box in (room.walls, *room.boxes)]
        assert np.min(distances, axis=0).max() < 1e-9


def test_nothing_stands_in_front_of_a_pixel():
    room, K, size = scene(48)
    for T in synthetic.walk(3, period=7):
        points, origin = points_in_world(synthetic.render(room, T, K, size, size), T, K), T[:3, 3]
        for share in np.linspace(0, 0.995, 60):
            between = origin + share * (points - origin)
            inside = ((room.boxes[:, None, None, 0] < between) & (between < room.boxes[:, None, None, 1])).all(-1)
            assert not inside.any()


def test_depth_warped_into_the_next_frame_agrees():
    """Where both frames see a surface, its point has the depth that the other frame measured there."""
    room, K, size = scene(160)
    first, second = list(synthetic.walk(2, period=100))
    a, b = (synthetic.render(room, T, K, size, size) for T in (first, second))
    x, y, z = ((points_in_world(a, first, K) - second[:3, 3]) @ second[:3, :3]).transpose(2, 0, 1)
    u, v = (np.rint(K[0, 0] * x / z + K[0, 2]).astype(int), np.rint(K[1, 1] * y / z + K[1, 2]).astype(int))
    seen = (u >= 0) & (u < size) & (v >= 0) & (v < size)
    error = np.abs(b[v[seen], u[seen]] - z[seen])
    assert seen.mean() > 0.8
    assert np.median(error) < 0.01  # the rounding to a pixel on slanted surfaces
    assert (error < 0.05).mean() > 0.93, "the rest is hidden in one of the two"


def test_the_window_of_a_box_loses_no_pixel():
    room, K, size = scene(64)
    for T in synthetic.walk(5, period=5):
        brute = np.min(
            [synthetic.render(synthetic.BoxRoom(room.walls, box[None]), T, K, size, size) for box in room.boxes], axis=0
        )
        np.testing.assert_array_equal(synthetic.render(room, T, K, size, size), brute)


def test_a_wall_straight_ahead():
    room = synthetic.BoxRoom(np.array([[-2.0, -1, -3], [2, 1, 5]]), np.zeros((0, 2, 3)))
    T = synthetic.look((0, 0, 1), yaw=0)
    np.testing.assert_allclose(synthetic.render(room, T, synthetic.intrinsics(9, 9, 10), 9, 9), 4.0)
    sideways = synthetic.look((0, 0, 1), yaw=np.pi / 2)  # right: the wall at x = 2
    np.testing.assert_allclose(synthetic.render(room, sideways, synthetic.intrinsics(9, 9, 10), 9, 9), 2.0)
    down = synthetic.look((0, 0, 1), yaw=0, pitch=np.pi / 2)  # y points down: the floor at y = 1
    np.testing.assert_allclose(synthetic.render(room, down, synthetic.intrinsics(9, 9, 10), 9, 9), 1.0)


def test_poses_are_rotations_and_come_round_again():
    poses = np.array(list(synthetic.walk(11, period=10)))
    eye = np.broadcast_to(np.eye(3), (11, 3, 3))
    np.testing.assert_allclose(poses[:, :3, :3] @ poses[:, :3, :3].transpose(0, 2, 1), eye, atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(poses[:, :3, :3]), 1)
    assert np.trace(poses[0, :3, :3].T @ poses[10, :3, :3]) > 1 + 2 * np.cos(np.radians(60))
    assert np.abs(poses[0] - poses[10]).max() > 1e-3, "but no view comes back exactly"


def test_flicker_has_the_size_it_says_and_is_smooth():
    depth, rng = np.full((60, 80), 2.0), np.random.default_rng(0)
    errors = np.array([synthetic.flicker(depth, 0.05, rng) / depth - 1 for _ in range(400)])
    assert errors.std(axis=0).mean() == pytest.approx(0.05, rel=0.1)
    assert np.abs(np.diff(errors, axis=1)).max() < 0.1 * np.abs(errors).max()
    assert depth.max() == 2.0, "the argument is left alone"


@pytest.mark.parametrize("position", [(9, 0, 0), (0, 3, 0)])
def test_a_camera_outside_the_room(position):
    room, K, size = scene(8)
    with pytest.raises(ValueError, match="inside the room"):
        synthetic.render(room, synthetic.look(position, 0), K, size, size)


def test_the_walk_stays_free_of_the_boxes():
    boxes = synthetic.BoxRoom.furnished(1000).boxes
    positions = np.array([T[:3, 3] for T in synthetic.walk(1000, period=37)])
    gap = np.maximum(boxes[:, 0] - positions[:, None], positions[:, None] - boxes[:, 1]).max(-1)
    assert gap.min() > 0.3


def test_impossible_rooms_and_walks():
    with pytest.raises(ValueError, match="boxes"):
        synthetic.BoxRoom.furnished(-1)
    with pytest.raises(ValueError, match="period"):
        list(synthetic.walk(3, period=0))


def test_frames_are_the_same_for_the_same_seed():
    a, b, c = (list(RenderedRoom(seed=s).frames(32, 3)) for s in (1, 1, 2))
    assert torch.equal(a[2].depth, b[2].depth)
    assert not torch.equal(a[2].depth, c[2].depth)
    assert a[0].depth.shape == (1, 32, 32)
    assert a[0].depth.dtype == torch.float32
    assert a[0].T_world_cam.dtype == torch.float64


def test_a_recorded_sequence_gives_square_frames(tmp_path):
    path, truth = write_tum(tmp_path, frames=4)  # 64 x 48 pixels
    source = RecordedSequence(path)
    assert source.available == 4
    frames = list(source.frames(48, 3))
    assert [tuple(f.depth.shape) for f in frames] == [(1, 48, 48)] * 3
    expected = truth.K - np.array([[0, 0, 8], [0, 0, 0], [0, 0, 0]])
    np.testing.assert_allclose(frames[0].intrinsics, expected)
    np.testing.assert_allclose(frames[0].depth[0], truth.depths[0][:, 8:56], atol=2e-4)
    np.testing.assert_allclose(frames[2].T_world_cam, truth.T_world_cam[2], atol=1e-6)
    assert str(tmp_path) not in json.dumps(source.describe()), "a report does not tell where files lie"


def test_a_network_predicts_the_depth_of_a_sequence(tmp_path):
    path, truth = write_tum(tmp_path, frames=2)
    network = FastDepth(FastDepthWidths((8,) * 14, (8,) * 5)).eval()
    frame = next(iter(RecordedSequence(path, network).frames(48, 1)))
    assert frame.depth.shape == (1, 48, 48)
    # 250 px high, centre of 304 x 228, then 48 (by way of the network's 224)
    fx, fy = truth.K[0, 0] * 333 / 64 * 48 / 304, truth.K[1, 1] * 250 / 48 * 48 / 228
    np.testing.assert_allclose(torch.diagonal(frame.intrinsics), [fx, fy, 1])


def test_a_sequence_that_is_too_short(tmp_path):
    path, _ = write_tum(tmp_path, frames=5)
    source = RecordedSequence(path)
    with pytest.raises(ValueError, match="there are 5"):
        build_up(source, UfMStarConfig(), size=48, in_view=5, history=9, rounds=5)
    assert build_up(source, UfMStarConfig(), size=48, in_view=10**6, history=9, rounds=3)[2] == 2
    with pytest.raises(ValueError, match="there are 5"):
        measure_long_run(source, UfMStarConfig(), size=48, frames=40, window=10)

"""Anchors of a depth camera: thinning, edges, variances; ``ufmstar run --anchors sensor`` fills holes."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from unittest.mock import patch

import numpy as np
import pytest
import torch
from layouts import write_generic
from runs import job_of, read_summary, records

from ufmstar_torch import AnchorConfig, PosteriorConfig, UfMStarConfig, cli
from ufmstar_torch.anchors import Landmarks, sensor_landmarks
from ufmstar_torch.anchors.sensor import SensorMemory, completed
from ufmstar_torch.eval.engine.anchors import landmarks_of, sensor_of
from ufmstar_torch.eval.engine.judge import UFM
from ufmstar_torch.eval.engine.maps import MapSource
from ufmstar_torch.eval.engine.stream import frame_results
from ufmstar_torch.eval.run.run import run
from ufmstar_torch.eval.run.writers import read_frame
from ufmstar_torch.eval.sequences.frame import in_memory
from ufmstar_torch.eval.sequences.open import open_sequence
from ufmstar_torch.gaussians.camera import resize_intrinsics

K = np.array([[200.0, 0, 159.5], [0, 200, 119.5], [0, 0, 1]])
CELL = np.array([320, 240]) / 28


def plane(height=240, width=320, z=2.0):
    return np.full((height, width), z, np.float32)


def test_each_cell_has_one_anchor_near_its_centre():
    found = sensor_landmarks(plane(), K, K)
    assert len(found.depth) == 28 * 28
    cell = np.floor((found.pixel + 0.5) / CELL)
    assert len(np.unique(cell, axis=0)) == 28 * 28
    assert np.abs((found.pixel + 0.5) / CELL - cell - 0.5).max() < 0.3
    assert set(found.depth) == {2.0}


@pytest.mark.parametrize(("kind", "sigma"), [("stereo", 0.001 + 0.003 * 9), ("tof", 0.01 + 0.01 * 3)])
def test_the_variance_is_that_of_the_kind_of_sensor(kind, sigma):
    np.testing.assert_allclose(sensor_landmarks(plane(z=3.0), K, K, kind).variance, sigma**2, rtol=1e-12)
    with pytest.raises(ValueError, match="kind must be one of stereo, tof, got 'lidar'"):
        sensor_landmarks(plane(), K, K, "lidar")
    with pytest.raises(ValueError, match=r"depth must be a map \[H, W\]"):
        sensor_landmarks(plane()[..., None], K, K)


def test_no_anchor_lies_in_a_hole_or_at_an_edge():
    depth = plane()
    depth[:, 160:] = 3.0
    depth[50:130, 20:90] = 0
    depth[200, 200], depth[201, 250] = np.nan, np.inf
    pixel = sensor_landmarks(depth, K, K).pixel.astype(int)
    z = depth[pixel[:, 1], pixel[:, 0]]
    assert np.isin(z, (2.0, 3.0)).all()
    assert (np.abs(pixel[:, 0] - 159.5) > 2).all()
    assert {2.0, 3.0} == set(z.tolist())
    assert len(sensor_landmarks(0 * plane(), K, K).depth) == 0


def test_anchors_of_another_camera_are_at_the_pixels_of_the_image():
    """A phone's depth of 256x192 for images of 1920x1440; the slanted wall has the depth 2 + .001 u of the image."""
    size, small = (1440, 1920), (192, 256)
    K_image = np.array([[1500.0, 0, 950], [0, 1500, 700], [0, 0, 1]])
    K_depth = resize_intrinsics(torch.from_numpy(K_image), size, small).numpy()
    u = (np.arange(256) + 0.5) * 7.5 - 0.5
    depth = np.tile(2 + 0.001 * u, (192, 1)).astype(np.float32)
    found = sensor_landmarks(depth, K_depth, K_image, "tof")
    np.testing.assert_allclose(found.depth, 2 + 0.001 * found.pixel[:, 0], rtol=1e-6)
    assert found.pixel.max(axis=0) == pytest.approx([1900, 1425], abs=30)


def test_landmarks_of_the_images_complete_it():
    """Three of six are added. One is on a pixel that the sensor measured, one is next to such a pixel, and one is
    uncertain and nearer than the surface beside the hole.

    Where landmarks and sensor agree, depths stay. The stated common errors stay."""
    depth = plane()
    depth[:, 200:] = 0
    pixel = np.array([[50.0, 50], [201, 60], [250, 70], [250, 100], [250, 130], [250, 160]])
    others = Landmarks(
        pixel, np.array([2.0, 4, 4, 1.5, 1.5, 1.7]), np.array([0.1, 0.1, 0.1, 0.1, 0.005, 0.1]), 6, shared=1e-4,
        scale=1e-5,
    )  # fmt: skip
    sensor = sensor_landmarks(depth, K, K)
    found = completed(sensor, others, depth)
    n = len(sensor.depth)
    np.testing.assert_array_equal(found.pixel[n:], [[250, 70], [250, 130], [250, 160]])
    np.testing.assert_allclose(found.depth[n:], [4, 1.5, 1.7])
    assert (found.variance[n:] <= others.variance[[2, 4, 5]] * (1 + 1e-9)).all()
    assert (found.shared, found.scale, found.tracked) == (1e-4, 1e-5, n + 6)
    none = replace(others, pixel=np.zeros((0, 2)), depth=np.zeros(0), variance=np.zeros(0), shared=np.inf)
    alone = completed(sensor, none, depth)
    np.testing.assert_array_equal(alone.depth, sensor.depth)
    assert (alone.shared, alone.scale, alone.motion) == (0, 0, None), "wrong poses do not concern the sensor"


def with_common_error(rng, wrong=0.0):
    """A plane of 2 m that the sensor measures at the left, a wall of 6 m at the right that it does not, and landmarks
    of the images whose inverse depths share an error; of those on the plane, the share ``wrong`` has the depth 1 m."""
    depth = plane()
    depth[:, 160:] = 0
    on_plane = np.arange(400) < 200
    pixel = np.stack([rng.uniform(5, 150, 400) + 160 * ~on_plane, rng.uniform(5, 235, 400)], axis=-1)
    u, v = 2 * (pixel.T + 0.5) / [[320], [240]] - 1
    truth = np.where(on_plane, 2.0, 6.0)
    rho = (1 / truth + 0.02 + 0.005 * u - 0.01 * v + rng.normal(0, 0.005, 400)) / (1 - 0.01)
    rho[on_plane & (rng.uniform(size=400) < wrong)] = 1
    variance = (0.005**2 + 0.02**2 + 0.01**2 * rho**2) / rho**4
    others = Landmarks(pixel, 1 / rho, variance, 400, shared=0.02**2, scale=0.01**2)
    return depth, others, on_plane


@pytest.mark.parametrize("wrong", [0.0, 0.2])
def test_the_sensor_corrects_the_common_errors_of_the_images(wrong):
    depth, others, on_plane = with_common_error(np.random.default_rng(1), wrong)
    sensor = sensor_landmarks(depth, K, K)
    found = completed(sensor, others, depth)
    before = others.depth[~on_plane]
    far = slice(len(found.depth) - len(before), None)
    assert np.median(np.abs(before / 6 - 1)) > 0.08
    assert np.median(np.abs(found.depth[far] / 6 - 1)) < 0.03
    z = (found.depth[far] - 6) / np.sqrt(found.variance[far])
    assert 0.3 < np.sqrt(np.mean(z**2)) < 1.5
    assert (found.variance[far] < others.variance[~on_plane]).all()


def test_poses_without_a_known_error_correct_nothing():
    depth, others, _ = with_common_error(np.random.default_rng(2))
    sensor = sensor_landmarks(depth, K, K)
    for unchanged in (replace(others, shared=np.inf), replace(others, pixel=others.pixel + np.array([160.0, 0]))):
        found = completed(sensor, unchanged, depth)
        assert set(found.depth[len(sensor.depth) :]) <= set(others.depth)
        assert found.shared == unchanged.shared


# ---- depths of earlier frames


def seen_from(x=0.0, z=0.0):
    """A camera-to-world pose of a camera that has moved and not turned."""
    T = np.eye(4)
    T[:3, 3] = x, 0, z
    return T


AT_THE_ORIGIN = seen_from()


def extended(memory, depth, T=AT_THE_ORIGIN):
    """The anchors that the memory adds to those of the depth."""
    sensor = sensor_landmarks(depth, K, K)
    found, n = memory.extended(sensor, depth, T, K), len(sensor.depth)
    np.testing.assert_array_equal(found.depth[:n], sensor.depth)
    return found.pixel[n:], found.depth[n:], found.variance[n:]


def test_a_hole_has_the_depths_of_earlier_frames():
    """Half a metre nearer to a wall of 3 m, whose middle is missing now."""
    memory, depth = SensorMemory(), plane(z=2.5)
    assert len(extended(memory, plane(z=3.0))[1]) == 0
    depth[60:180, 80:240] = 0
    pixel, z, variance = extended(memory, depth, seen_from(z=0.5))
    np.testing.assert_allclose(z, 2.5)
    np.testing.assert_allclose(variance, (0.001 + 0.003 * 9) ** 2 + 0.025**2)
    assert ((pixel > [80, 60]) & (pixel < [239, 179])).all()
    cell = np.floor((pixel + 0.5) / CELL)
    assert len(np.unique(cell, axis=0)) == len(cell) > 100


def test_points_where_the_sensor_measures_anew_are_deleted():
    """A thing of 1 m leaves: it does not come back in a later hole."""
    memory, hole = SensorMemory(), plane(z=3.0)
    near = plane(z=3.0)
    near[60:180, 80:240] = 1.0
    extended(memory, near)
    extended(memory, plane(z=3.0))
    hole[60:180, 80:240] = 0
    _, z, _ = extended(memory, hole)
    assert len(z) > 100
    assert set(z.round(6)) == {3.0}


def test_points_that_contradict_the_sensor_are_deleted():
    """The poses begin anew: the wall is at 2 m, where a wall of 3 m was."""
    memory, hole = SensorMemory(), plane(z=2.0)
    hole[60:180, 80:240] = 0
    extended(memory, plane(z=3.0))
    assert len(extended(memory, hole)[1]) == 0
    assert len(extended(memory, plane(z=2.0), np.full((4, 4), np.nan))[1]) == 0
    extended(memory, plane(z=2.0))
    assert len(extended(memory, hole)[1]) > 100


def test_the_memory_has_a_fixed_size():
    memory = SensorMemory()
    for i in range(9):
        extended(memory, plane(z=3.0), seen_from(x=10 * i))
    assert memory.bytes == 4096 * 4 * 8


def loops(points, depth, T):
    """{cell: depth} of the points [m] that :class:`SensorMemory` adds to a depth map of 320 x 240, the newest last."""
    inside, nearest, cells = [], np.where(depth > 0, 1 / np.where(depth > 0, depth, 1), 0), {}
    for point in points:
        x, y, z = T[:3, :3].T @ (point - T[:3, 3])
        u, v = round(200 * x / z + 159.5), round(200 * y / z + 119.5)
        if z > 0 and 0 <= u < 320 and 0 <= v < 240:
            inside.append((u, v, z))
    measured = np.array([abs(np.log(z / depth[v, u])) for u, v, z in inside if depth[v, u] > 0])
    if (measured > np.log(1.1)).sum() > len(measured) / 2:
        return {}
    for u, v, z in inside:
        nearest[v, u] = max(nearest[v, u], 1 / z)
    for u, v, z in inside:
        hole = not (depth[max(v - 2, 0) : v + 3, max(u - 2, 0) : u + 3] > 0).any()
        if hole and z <= 1.1 / nearest[max(v - 5, 0) : v + 6, max(u - 5, 0) : u + 6].max():
            cells[28 * v // 240, 28 * u // 320] = z
    return cells


def test_the_points_are_those_of_the_loops():
    rng = np.random.default_rng(3)
    memory, depth, points = SensorMemory(), plane(z=3.0), []
    depth[40:200, 60:140], depth[80:220, 180:300] = 1.5, 2.2
    for i in range(4):
        T, left = seen_from(x=0.02 * i), depth.copy()
        for row, column in rng.integers(0, 240, (6, 2)):
            left[max(row - 20, 0) : row + 20, max(column - 20, 0) : column + 60] = 0
        expected = loops(points, left, T)
        pixel, z, _ = extended(memory, left, T)
        column, row = np.rint(pixel.T).astype(int)
        assert dict(zip(zip(28 * row // 240, 28 * column // 320, strict=True), z, strict=True)) == pytest.approx(
            expected
        )
        points = memory._point.copy()
        assert i == 0 or len(expected) > 20
    assert len(points) > 300


# ---- ufmstar run

TOUR = "tour:5?frames=10&size=120x160"
CONFIG = UfMStarConfig(on_bad_frame="skip", anchors=AnchorConfig(), posterior=PosteriorConfig())


@pytest.fixture(scope="module")
def tour():
    """Ten rendered frames, in memory."""
    return in_memory(open_sequence(TOUR))


def with_hole(load_depth, column):
    """The depth without 50 columns, a third of the image."""
    u = np.arange(160)
    return np.where((u >= column) & (u < column + 50), 0, load_depth())


def holed(tour, column=lambda _: 50):
    """The tour with a hole that begins at the ``column`` of each frame."""
    entries = enumerate(tour.entries)
    left = (replace(entry, load_depth=partial(with_hole, entry.load_depth, column(i))) for i, entry in entries)
    return replace(tour, entries=tuple(left))


def in_hole(truth, column=50):
    """True where the ground truth of half the size has a depth in such a hole."""
    u = 2 * np.arange(truth.shape[1])
    return (truth > 0) & (u >= column) & (u < column + 50)


def sensor_job(tour, whole, **options):
    """A network whose depth is 40 % too far, and too flat."""
    depths = [frame.depth for frame in whole]

    def too_far(frame):
        depth = depths[frame.index][::2, ::2]
        flat = 1.4 * np.sqrt(depth * np.median(depth[depth > 0]))
        return np.where(depth > 0, flat, 0).astype(np.float32), None, np.diag([0.5, 0.5, 1.0]) @ frame.intrinsics

    source = MapSource(too_far, {"maps": "too far and too flat"})
    return job_of(tour, source, config=CONFIG, landmarks="dense", sensor="stereo", **options)


@pytest.fixture(scope="module")
def finished(tour, tmp_path_factory):
    out = tmp_path_factory.mktemp("sensor") / "out"
    return out, run(sensor_job(holed(tour), tour), out)


def test_holes_are_filled_and_every_pixel_has_a_sigma(tour, finished):
    out, _ = finished
    squares, z_scores = np.zeros(2), []
    for frame in tour:
        stored, truth = read_frame(out / "frames" / f"{frame.name}.npz"), frame.depth[::2, ::2]
        hole = in_hole(truth) & stored["valid"]
        assert np.isfinite(stored["variance"][stored["valid"]]).all()
        if frame.index == 0:  # without an earlier view, the images show nothing
            continue
        error = stored["depth"][hole] - truth[hole]
        squares += np.square(error).sum(), np.square(stored["network_depth"][hole] - truth[hole]).sum()
        z_scores.append(error / np.sqrt(stored["variance"][hole]))
    assert np.sqrt(squares[0] / squares[1]) < 1 / 3
    assert 0.1 < np.sqrt(np.mean(np.square(np.concatenate(z_scores)))) < 2


def test_holes_that_move_have_the_depths_of_earlier_frames_without_images(tour):
    """The hole covers other columns in every frame, and the images show nothing."""
    moving = holed(tour, lambda i: 37 * i % 110)
    (row, _), squares, counts = sensor_job(moving, tour).row(), np.zeros(2), []
    with patch.object(row.anchors, "tracked", return_value=None):
        for result in frame_results(moving, range(len(moving)), [row]):
            found, truth, column = result.rows[UFM], tour[result.index].depth[::2, ::2], 37 * result.index % 110
            hole = in_hole(truth, column) & found.valid.numpy()
            u = found.landmarks.pixel[:, 0]
            counts.append(np.count_nonzero((u > column) & (u < column + 49)))
            if result.index > 0:
                before = found.prediction.depth[0].numpy()[hole]
                squares += [np.square(x - truth[hole]).sum() for x in (found.depth.numpy()[hole], before)]
    assert counts[0] == 0
    assert min(counts[2:]) > 50
    assert np.sqrt(squares[0] / squares[1]) < 0.2


def test_depth_that_served_as_anchors_is_not_judged(finished):
    out, summary = finished
    assert summary["metrics"] is None
    assert summary["metrics_reason"] == "the recording's depth serves as anchors"
    assert summary["ufm"]["metrics"] is None
    assert not any(record["ground_truth"] for record in records(out))
    assert summary["anchors"]["used_per_frame"] > 300
    assert summary["source"]["sensor"] == "stereo"


def test_frames_without_depth_or_images_have_what_is_there(tour, tmp_path):
    """The first frame has no depth, the second no image; the third has a depth map that cannot be read."""
    entries = list(holed(tour).entries[:3])
    entries[0] = replace(entries[0], load_depth=None)
    entries[1] = replace(entries[1], load_image=None)
    sequence = replace(tour, entries=tuple(entries))
    run(sensor_job(sequence, tour), tmp_path / "out")
    found = [record["anchors"]["found"] for record in records(tmp_path / "out")]
    assert found[0] == 0
    assert min(found[1:]) > 300


# ---- the option


def test_the_kind_of_sensor_is_that_of_the_layout(tour):
    assert sensor_of("sensor", tour) == "stereo"
    assert sensor_of("sensor", replace(tour, layout="stray")) == "tof"
    assert sensor_of("sensor:tof", tour) == "tof"
    for other in (True, "corners", "dense", "sensor.csv", False, None):
        assert sensor_of(other, tour) is None
    with pytest.raises(ValueError, match="the kind of sensor must be one of stereo, tof"):
        sensor_of("sensor:lidar", tour)
    bare = tour.changed(lambda entry: replace(entry, load_depth=None))
    with pytest.raises(ValueError, match="has no depth maps"):
        sensor_of("sensor", bare)


def test_the_command(tmp_path, capfd):
    path, truth = write_generic(tmp_path / "data")
    maps = tmp_path / "maps"
    maps.mkdir()
    for i, depth in enumerate(truth.depths):
        np.save(maps / f"{i + 7}.npy", 1.3 * depth)
    words = ["run", str(path), "--no-video", "--no-sheet", "--out", str(tmp_path / "out")]
    assert cli.main([*words, "--depth", str(maps), "--anchors", "sensor"]) == 0
    summary = read_summary(tmp_path / "out")
    assert (summary["settings"]["anchors"], summary["metrics"]) == ("sensor", None)
    depth = read_frame(tmp_path / "out" / "frames" / "12.npz")["depth"]
    assert np.median(np.abs(depth / truth.depths[5] - 1)) < 0.02
    capfd.readouterr()
    assert cli.main([*words, "--overwrite", "--depth", "self", "--anchors", "sensor"]) == 2
    assert "--anchors sensor goes with the depth of a network" in capfd.readouterr().err
    assert cli.main([*words, "--overwrite", "--depth", str(maps), "--anchors", "sensor:x"]) == 2
    assert "the kind of sensor must be one of" in capfd.readouterr().err
    with pytest.raises(ValueError, match="is the depth of a recording, for `ufmstar run` and `rank`"):
        landmarks_of("sensor:tof", None)

"""COLMAP, transforms.json, EuRoC, ARKit: the read data equals the written data; lenses; truncated and hostile files."""

from __future__ import annotations

import json
import pickle
import shutil
from itertools import pairwise

import layouts
import layouts_calibrated as written
import numpy as np
import pytest
from runs import read_summary

from ufmstar_torch import cli
from ufmstar_torch.eval.engine.anchors import landmarks_of
from ufmstar_torch.eval.engine.maps import own_depth
from ufmstar_torch.eval.run.scale import network_scale, require_metric
from ufmstar_torch.eval.sequences import open_sequence
from ufmstar_torch.eval.sequences.colmap import read_landmarks
from ufmstar_torch.eval.sequences.intrinsics import scale_intrinsics
from ufmstar_torch.eval.sequences.lens import Lens, parse_distortion
from ufmstar_torch.eval.sequences.options import Options
from ufmstar_torch.eval.suite.work_items import WorkItem

RADIAL, FISHEYE = (-0.28, 0.07, 0.0002, 1.8e-05), (-0.05, 0.01, -0.002, 0.0005)


def colmap_text(root, **how):
    return written.write_colmap(root, text=True, **how)


WRITERS = {
    "colmap": written.write_colmap,
    "colmap-text": colmap_text,
    "transforms": written.write_transforms,
    "transforms-per-frame": lambda root: written.write_transforms(root, per_frame=True),
    "euroc": written.write_euroc,
    "stray": written.write_stray,
    "stray-per-frame": lambda root: written.write_stray(root, per_frame=True),
    "arkitscenes": written.write_arkitscenes,
}


OTHERS = {
    "tum": layouts.write_tum,
    "tartanair": layouts.write_tartanair,
    "tartanair-below": lambda root: (layouts.write_tartanair(root)[0].parent, layouts.write_tartanair(root / "o")[1]),
    "generic": layouts.write_generic,
}


@pytest.mark.parametrize("kind", [*WRITERS, *OTHERS])
def test_what_is_read_is_what_was_written(tmp_path, kind):
    path, truth, *_ = (WRITERS | OTHERS)[kind](tmp_path)
    distortion = {"distortion": "none"} if kind == "tum" else {}
    sequence = pickle.loads(pickle.dumps(open_sequence(path, **distortion)))
    assert sequence.layout == kind.split("-")[0]
    assert sequence.metric == (sequence.layout != "colmap")
    assert (len(sequence), sequence.image_size, sequence.skipped) == (6, layouts.SIZE, ())
    for i, frame in enumerate(sequence):
        np.testing.assert_allclose(frame.T_world_cam, truth.T_world_cam[i], atol=1e-9)
        np.testing.assert_array_equal(frame.image, truth.images[i])
        np.testing.assert_allclose(frame.intrinsics, truth.K, atol=1e-9)
        assert (frame.image.dtype, frame.T_world_cam.dtype) == (np.uint8, np.float64)
        if sequence.layout == "euroc":
            assert frame.depth is None
            assert frame.timestamp == pytest.approx(1403715273.262142976 + 0.05 * i, abs=1e-6)
        elif sequence.layout == "stray":
            assert frame.timestamp == pytest.approx(100 + i / 60)
            assert not frame.depth[0].any()
            np.testing.assert_allclose(frame.depth[1:], truth.depths[i][2::2, ::2], atol=5e-4 + 1e-6)
            np.testing.assert_allclose(
                frame.depth_intrinsics, scale_intrinsics(truth.K, (48, 64), (24, 32)), atol=1e-12
            )
        else:
            np.testing.assert_allclose(frame.depth, truth.depths[i], atol=5e-4 + 1e-6)


def distorted(x, y, coefficients, fisheye):
    """The lens's equations, in NumPy only."""
    if fisheye:
        r = np.hypot(x, y)
        angle = np.arctan(r)
        ratio = angle * (1 + sum(k * angle ** (2 * i + 2) for i, k in enumerate(coefficients))) / np.maximum(r, 1e-12)
        return x * ratio, y * ratio
    k1, k2, p1, p2 = coefficients
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2 * r2
    return (x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y)


@pytest.mark.parametrize(("coefficients", "fisheye"), [(RADIAL, False), (FISHEYE, True)])
def test_a_lens_is_undone(tmp_path, coefficients, fisheye):
    """An image that encodes its pixel positions as depth and as colour: each undistorted pixel equals the position that
    the lens's equations give for its ray."""
    path, _, _ = written.write_colmap(
        tmp_path, 1, model="OPENCV_FISHEYE" if fisheye else "OPENCV", coefficients=coefficients
    )
    column, row = np.meshgrid(np.arange(64.0), np.arange(48.0))
    layouts.write_image(path / "images" / "0.png", np.stack([3 * column, 4 * row, 0 * row], -1).astype(np.uint8))
    layouts.write_depth_png(path / "depth" / "0.png", 1 + column + row, 100)
    frame = open_sequence(path, truth_scale=0.01)[0]
    assert frame.depth_intrinsics is None
    K = frame.intrinsics
    np.testing.assert_allclose(K[:2, 2], written.K[:2, 2], atol=1e-9)
    x, y = (column - K[0, 2]) / K[0, 0], (row - K[1, 2]) / K[1, 1]
    x, y = distorted(x, y, coefficients, fisheye)
    u, v = written.K[0, 0] * x + written.K[0, 2], written.K[1, 1] * y + written.K[1, 2]
    assert np.hypot(u - column, v - row).max() > 1, "the lens moves pixels"
    assert u.min() > -0.5, "no pixel lies outside the lens's image"
    assert max(u.min() - 0, v.min() - 0, 63 - u.max(), 47 - v.max()) < 3, "most of the image remains"
    np.testing.assert_allclose(frame.image[..., 0], 3 * u.clip(0, 63), atol=1.01)
    np.testing.assert_allclose(frame.image[..., 1], 4 * v.clip(0, 47), atol=1.01)
    np.testing.assert_allclose(frame.depth, 1 + u.clip(0, 63) + v.clip(0, 47), atol=1.02)
    np.testing.assert_array_equal(frame.depth, np.rint(frame.depth)), "copied, never mixed"


@pytest.mark.parametrize(
    ("write", "how", "lens"),
    [
        (written.write_colmap, {"model": "SIMPLE_RADIAL", "coefficients": (-0.2,)}, ((-0.2, 0.0, 0.0, 0.0), False)),
        (colmap_text, {"model": "OPENCV", "coefficients": RADIAL}, (RADIAL, False)),
        (written.write_transforms, {"k1": -0.28, "k2": 0.07, "p1": 0.0002, "p2": 1.8e-05}, ((*RADIAL, 0.0), False)),
        (
            written.write_transforms,
            {"k1": -0.05, "k2": 0.01, "k3": -0.002, "k4": 0.0005, "camera_model": "OPENCV_FISHEYE"},
            (FISHEYE, True),
        ),
        (written.write_euroc, {"coefficients": RADIAL}, (RADIAL, False)),
        (written.write_euroc, {"coefficients": FISHEYE, "model": "equidistant"}, (FISHEYE, True)),
    ],
)
def test_every_layout_passes_its_lens_on(tmp_path, write, how, lens):
    path, truth, *_ = write(tmp_path, **how)
    fx, fy, cx, cy = written.focal_and_centre(0)
    expected = Lens((fy if how.get("model") == "SIMPLE_RADIAL" else fx, fy, cx, cy), layouts.SIZE, *lens)
    frame = open_sequence(path)[0]
    np.testing.assert_allclose(frame.intrinsics, expected.K, rtol=1e-9, atol=1e-12)
    assert abs(frame.intrinsics[0, 0] / truth.K[0, 0] - 1) > 0.01
    assert (frame.image != truth.images[0]).mean() > 0.1
    plain = open_sequence(path, intrinsics=truth.K)[0]  # the user's K is that of a pinhole camera
    np.testing.assert_array_equal(plain.image, truth.images[0])


def test_distortion_of_any_layout_and_tum_s_own(tmp_path):
    path, truth = layouts.write_generic(tmp_path)
    K = truth.K
    lens = Lens((K[0, 0], K[1, 1], K[0, 2], K[1, 2]), layouts.SIZE, (0.2, -0.3, 0.0, 0.0))
    sequence = open_sequence(path, distortion=(0.2, -0.3, 0, 0))
    np.testing.assert_allclose(sequence.intrinsics, lens.K, atol=1e-12)
    assert (sequence[0].image != truth.images[0]).any()
    assert (sequence[0].depth != open_sequence(path)[0].depth).any(), "depth was registered to the distorted image"
    for bad in ((0.1,), ("fisheye", 1, 2), "k1", (0.1, np.nan, 0, 0)):
        with pytest.raises(ValueError, match="distortion"):
            open_sequence(path, distortion=bad)
    with pytest.raises(ValueError, match=r"fold the image's border|shrink the image"):
        open_sequence(path, distortion=(-9.0, 0, 0, 0))[0]
    tum, _ = layouts.write_tum(tmp_path)
    K = open_sequence(tum, distortion="none").intrinsics
    published = Lens((K[0, 0], K[1, 1], K[0, 2], K[1, 2]), layouts.SIZE, (0.2312, -0.7849, -0.0033, -0.0001, 0.9172))
    np.testing.assert_allclose(open_sequence(tum).intrinsics, published.K, atol=1e-12)
    np.testing.assert_allclose(open_sequence(tum, intrinsics=K).intrinsics, K, atol=1e-12)
    assert parse_distortion(["fisheye", "1", "2", "3", "4"]) == ((1, 2, 3, 4), True)


def test_pose_scale_and_max_truth(tmp_path):
    path, truth, _ = written.write_colmap(tmp_path)
    sequence = open_sequence(path, pose_scale=2.5, max_truth=1.5)
    assert sequence.metric
    assert sequence.pose_scale == 2.5
    np.testing.assert_allclose(sequence[3].T_world_cam[:3, 3], 2.5 * truth.T_world_cam[3][:3, 3], atol=1e-12)
    np.testing.assert_allclose(sequence[3].T_world_cam[:3, :3], truth.T_world_cam[3][:3, :3], atol=1e-12)
    depth = open_sequence(path)[3].depth
    assert (depth > 1.5).any()
    np.testing.assert_array_equal(sequence[3].depth, np.where(depth <= 1.5, depth, 0))
    for name, value in (("pose_scale", 0), ("pose_scale", np.inf), ("max_truth", -1)):
        with pytest.raises(ValueError, match=f"{name} must lie in"):
            open_sequence(path, **{name: value})


@pytest.mark.parametrize("text", [False, True])
def test_colmap_landmarks_and_what_makes_it_metric(tmp_path, text):
    path, truth, points = written.write_colmap(tmp_path, text=text)
    seen = read_landmarks(path)
    assert seen.keys() == set("012345")
    np.testing.assert_allclose(seen["3"], points[36:48])
    (path / "images" / "2.png").unlink()
    for content, metric in (('{"scale_from": "length"}', True), ('{"scale_from": null}', False), ("[", False)):
        (path / "poses.json").write_text(content)
        sequence = open_sequence(path)
        assert sequence.metric == metric
    assert [(frame.name, frame.reason) for frame in sequence.skipped] == [("2", "missing image file")]
    lines = [f"{i} {layouts.quaternion_line(T)}" for i, T in enumerate(truth.T_world_cam)]
    (path / "slam.txt").write_text("\n".join(lines))
    assert open_sequence(path, trajectory="slam.txt").metric, "the trajectory's unit"
    same = open_sequence(path / "sparse" / "0")  # the model's folder: images are two levels above
    np.testing.assert_array_equal(same[0].image, truth.images[0])


def test_a_scale_that_is_not_known_is_refused_or_the_network_s_own(tmp_path):
    path, truth, points = written.write_colmap(tmp_path, unit=2.5)
    sequence, source = open_sequence(path), own_depth()
    with pytest.raises(
        ValueError, match=r"--pose-scale M .* `ufmstar poses --length A B METRES` .* --scale-from network"
    ):
        require_metric(sequence)
    with pytest.raises(ValueError, match="the unit of its poses is not known"):
        WorkItem("d", "walk", str(path), Options(layout="colmap")).open()
    scale = network_scale(sequence, source, range(6))
    assert scale.metres == pytest.approx(2.5, rel=2e-3)  # depth in whole millimetres, at the nearest pixel
    assert scale.spread < 2e-3
    assert scale.frames == 6
    metric = open_sequence(path, pose_scale=scale.metres)
    np.testing.assert_allclose(metric[4].T_world_cam, truth.T_world_cam[4], rtol=3e-3, atol=1e-12)
    np.savez(path / "landmarks.npz", points=points, sigma=np.full(len(points), 0.01))
    landmarks = landmarks_of("landmarks.npz", metric.folder, metric.pose_scale)
    np.testing.assert_allclose(landmarks.points_world, metric.pose_scale * points)
    np.testing.assert_allclose(landmarks.sigma, metric.pose_scale * 0.01)
    with pytest.raises(ValueError, match="for COLMAP models whose scale is not known"):
        network_scale(metric, source, range(6))
    with pytest.raises(ValueError, match="2 frames see 10 landmarks"):
        network_scale(sequence, source, range(2))


def test_run_with_a_network_s_scale_says_so(tmp_path, capfd):
    path, truth, _ = written.write_colmap(tmp_path, unit=2.5)
    words = ["run", str(path), "--depth", "self", "--no-video", "--no-sheet", "--out", str(tmp_path / "out")]
    assert cli.main(words) == 2
    assert "--scale-from network" in capfd.readouterr().err
    assert cli.main([*words, "--scale-from", "network"]) == 0
    summary = read_summary(tmp_path / "out")
    assert summary["scale_from"] == "network"
    assert summary["scale"]["metres_per_unit"] == pytest.approx(2.5, rel=2e-3)
    assert summary["scale"]["spread"] < 2e-3
    line = json.loads((tmp_path / "out" / "frames.jsonl").read_text().splitlines()[3])
    np.testing.assert_allclose(line["T_world_cam"], truth.T_world_cam[3], atol=5e-3)


@pytest.mark.parametrize("key", ["aabb_scale", "applied_scale"])
def test_transforms_from_structure_from_motion_have_no_scale(tmp_path, key):
    path, _ = written.write_transforms(tmp_path, **{key: 0.3})
    assert not open_sequence(path).metric
    assert not open_sequence(path / "transforms.json").metric


# ---- truncated and hostile files ----


def edited(path, change):
    content = json.loads((path / "transforms.json").read_text())
    change(content)
    (path / "transforms.json").write_text(json.dumps(content))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda c: c.update(frames=3), "a list 'frames'"),
        (lambda c: c["frames"][1].update(file_path=7), "file_path must be text"),
        (lambda c: c["frames"][1].update(transform_matrix=[[1, 2], [3]]), "must be 4x4 numbers"),
        (lambda c: c.update(fl_x="wide"), "fl_x must be a number"),
        (lambda c: c.update(camera_model="EQUIRECTANGULAR"), "camera_model must be one of"),
        (lambda c: c.update(w=1000), "the camera has 1000x48 pixels, an image 64x48"),
        (lambda c: [c.pop("fl_x"), c.pop("fl_y")], "expected fl_x"),
    ],
)
def test_hostile_transforms(tmp_path, change, message):
    path, _ = written.write_transforms(tmp_path)
    edited(path, change)
    with pytest.raises(ValueError, match=message):
        open_sequence(path)


def test_transforms_of_other_programs(tmp_path):
    """NeRF's synthetic scenes: no file extension, one field of view; a pose with NaN is skipped; images of half the
    size."""
    path, truth = written.write_transforms(tmp_path)

    def change(content):
        for frame in content["frames"]:
            frame["file_path"] = frame["file_path"].removesuffix(".png")
        for key in ("fl_x", "fl_y", "cx", "cy", "w", "h"):
            del content[key]
        content["camera_angle_x"] = 2 * np.arctan(0.5 * 64 / 50)
        content["frames"][2]["transform_matrix"][0][3] = float("nan")

    edited(path, change)
    sequence = open_sequence(path)
    assert [frame.name for frame in sequence.skipped] == ["2"]
    np.testing.assert_allclose(sequence.intrinsics, [[50, 0, 31.5], [0, 50, 23.5], [0, 0, 1]], atol=1e-12)
    np.testing.assert_array_equal(sequence[0].image, truth.images[0])
    edited(path, lambda c: c.update(fl_x=100, cx=64, cy=48, w=128, h=96))
    np.testing.assert_allclose(open_sequence(path).intrinsics, [[50, 0, 31.5], [0, 50, 23.5], [0, 0, 1]], atol=1e-12)


def test_euroc_without_truth_and_with_a_trajectory(tmp_path):
    path, truth = written.write_euroc(tmp_path)
    shutil.rmtree(path / "mav0" / "state_groundtruth_estimate0")
    with pytest.raises(ValueError, match="pass trajectory"):
        open_sequence(path)
    times = [1403715273.262142976 + 0.05 * i for i in range(6)]
    lines = [f"{t:.9f} {layouts.quaternion_line(T)}" for t, T in zip(times, truth.T_world_cam, strict=True)]
    (path / "slam.txt").write_text("\n".join(lines))
    for folder in (path, path / "mav0" / "cam0"):
        trajectory = path / "slam.txt"
        np.testing.assert_allclose(
            open_sequence(folder, trajectory=trajectory)[4].T_world_cam, truth.T_world_cam[4], atol=1e-9
        )


def test_aliases_of_aliases_are_refused_before_they_are_expanded(tmp_path):
    """Nine levels of nine aliases expand 500 bytes to 400 million words."""
    path, _ = written.write_euroc(tmp_path)
    file = path / "mav0" / "cam0" / "sensor.yaml"
    levels = "".join(f"{b}: &{b} [{', '.join([f'*{a}'] * 9)}]\n" for a, b in pairwise("abcdefghij"))
    lines = [line for line in file.read_text().splitlines() if not line.startswith(("%", "distortion_model"))]
    file.write_text("\n".join(["a: &a [x]", levels + "distortion_model: *j", *lines]))
    with pytest.raises(ValueError, match=r"sensor\.yaml: expected a sensor's YAML of names and values without aliases"):
        open_sequence(path)


def test_hostile_arkit_folders(tmp_path):
    path, truth = written.write_stray(tmp_path)
    good = (path / "odometry.csv").read_text()
    lines = good.splitlines()
    for text, message in (
        (good.replace(" qw", " q"), "must name the column 'qw'"),
        ("\n".join([lines[0], lines[1] + ", 1"]), "odometry.csv:2: expected 9 numbers as in the first line, got 10"),
        (good.replace("000003", "3.5"), "odometry.csv:5: the frame must be a number from 0 on, got 3.5"),
        (good.replace("000003", "inf"), "odometry.csv:5: the frame must be a number from 0 on, got inf"),
        (good.replace("\n100.0,", "\nnan,"), "odometry.csv:2: the timestamp must be finite"),
        (lines[0], "has no usable frame"),
    ):
        (path / "odometry.csv").write_text(text)
        with pytest.raises(ValueError, match=message):
            open_sequence(path)
    camera = (path / "camera_matrix.csv").read_text()
    for text in (camera.replace("\n", ", "), camera.replace("1\n", "nan\n")):
        (path / "camera_matrix.csv").write_text(text)
        with pytest.raises(ValueError, match=r"camera_matrix\.csv"):
            open_sequence(path)
    (path / "camera_matrix.csv").write_text(camera)
    (path / "odometry.csv").write_text(good.replace("000005", "000077"))
    layouts.truncate(path / "depth" / "000001.png")
    layouts.write_image(path / "confidence" / "000002.png", np.ones((3, 3), np.uint8))
    sequence, errors = open_sequence(path), []
    assert [frame.index for frame in sequence.readable(errors.append)] == [0, 3, 4]
    assert [(skipped.name, skipped.reason) for skipped in sequence.skipped] == [
        ("000077", "beyond the end of the video")
    ]
    assert [error.path.parent.name for error in errors] == ["depth", "confidence"]
    layouts.truncate(path / "rgb.mp4", 0.01)
    with pytest.raises(ValueError, match=r"rgb\.mp4"):
        open_sequence(path)

    path, truth = written.write_arkitscenes(tmp_path)
    cameras = sorted((path / "41048190_frames" / "lowres_wide_intrinsics").iterdir())
    cameras[0].rename(cameras[0].with_name("41048190_3377.182.pincam"))  # rounded otherwise
    cameras[1].unlink()
    sequence = open_sequence(path / "41048190_frames")
    assert [skipped.reason for skipped in sequence.skipped] == ["no camera at its time"]
    np.testing.assert_allclose(sequence[0].T_world_cam, truth.T_world_cam[0], atol=1e-9)
    for content in ("64 48 50 -50 31 23", "0.5 48 50 50 31 23"):
        cameras[2].write_text(content)
        with pytest.raises(ValueError, match="expected width height fx fy cx cy"):
            open_sequence(path)

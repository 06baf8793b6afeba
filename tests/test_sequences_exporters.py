"""Recordings as other programs and systems write them: Windows' paths, macOS's sidecars, several models, 16 bits."""

from __future__ import annotations

import json
import shutil
import subprocess

import layouts
import layouts_calibrated as written
import numpy as np
import pytest
from imageio_ffmpeg import get_ffmpeg_exe
from layouts_more import rigid
from recordings import LAYOUTS

from ufmstar_torch import cli
from ufmstar_torch.eval.run.scale import network_scale
from ufmstar_torch.eval.sequences import find_sequences, open_sequence
from ufmstar_torch.eval.sequences.colmap import read_landmarks
from ufmstar_torch.eval.sequences.intrinsics import read_intrinsics
from ufmstar_torch.eval.sequences.paths import listed_file
from ufmstar_torch.eval.sequences.video import Video

RNG = np.random.default_rng(0)


# ---- macOS's sidecars, Windows' paths


@pytest.mark.parametrize("layout", LAYOUTS)
def test_files_whose_names_begin_with_a_dot_are_no_frames(tmp_path, layout):
    """Such as those that macOS adds, and unfinished downloads."""
    path = LAYOUTS[layout](tmp_path)
    before = open_sequence(path)
    for file in [file for file in tmp_path.rglob("*") if file.is_file()]:
        for prefix in ("._", "."):
            (file.parent / f"{prefix}{file.name}").write_bytes(b"\x00\x05\x16\x07" + bytes(100))
    after = open_sequence(path)
    assert (after.names, after.skipped, after.layout) == (before.names, before.skipped, layout)
    np.testing.assert_array_equal(after[-1].image, before[-1].image)
    if after.depth_size is not None:
        np.testing.assert_array_equal(after[-1].depth, before[-1].depth)
    assert [found.layout for found in find_sequences(tmp_path)] == [layout]


@pytest.mark.parametrize("layout", [name for name in LAYOUTS if name not in ("sens", "bag", "nyu")])
def test_names_in_another_case_are_found(tmp_path, layout):
    """As of files that were copied from Windows or a camera's card: IMG_0.JPG, where a list names IMG_0.jpg."""
    path = LAYOUTS[layout](tmp_path)
    before = open_sequence(path)
    names, frame = before.names, before[0]
    for file in [file for file in tmp_path.rglob("*") if file.suffix in (".png", ".jpg", ".npy", ".txt")]:
        if file.parent.name in (
            "images",
            "rgb",
            "data",
            "color",
            "pose",
            "depth",
            "confidence",
            "depth_left",
            "seq-01",
        ):
            name = file.stem + file.suffix.upper() if "pose" not in file.name else file.name
            file.rename(file.with_name(name))
    after = open_sequence(path)
    assert after.names == names
    np.testing.assert_array_equal(after[0].image, frame.image)
    np.testing.assert_array_equal(after[0].T_world_cam, frame.T_world_cam)
    assert (after[0].depth is None) == (frame.depth is None)


def test_folders_and_files_of_a_generic_recording_may_have_any_case(tmp_path):
    path, scene = layouts.write_generic(tmp_path)
    for name, other in (("images", "Images"), ("depth", "DEPTH"), ("poses.txt", "Poses.TXT"), ("K.txt", "k.txt")):
        (path / name).rename(path / other)
    sequence = open_sequence(path)
    np.testing.assert_allclose(sequence[0].intrinsics, scene.K)
    assert sequence[5].depth is not None
    (path / "poses.TXT").write_text("")  # two names that differ in case alone
    with pytest.raises(ValueError, match="no known layout"):
        open_sequence(path)


@pytest.mark.parametrize(
    ("file", "remedy"),
    [
        ("keyframes/corrected_cameras/1.json", "ns-process-data polycam"),
        ("walk_0.mcap.zstd", "decompress it"),
        ("scan.r3d", "export it there as a folder with EXR and JPG"),
        ("rgbd/0.depth", "export it from Record3D with EXR and JPG"),
        ("EXR_RGBD/metadata.json", "ns-process-data record3d"),
        ("oxts/data/0000000000.txt", "take the odometry benchmark"),
        ("image_2/000000.png", "--trajectory poses/NN.txt"),
        ("results/frame000000.jpg", "--truth-scale 0.000152597"),
        ("pose_intrinsic_imu.json", "its COLMAP model"),
        ("camera_params_0000.json", "OpenGL axes"),
        ("seq-01/frame-000000.pose.txt", r"open one of the 1 recordings below it, such as seq-01 \(7scenes\)"),
        ("a.xyz", "expected images .*found a.xyz"),
    ],
)
def test_an_export_that_no_reader_opens_gets_a_line_with_the_remedy(tmp_path, file, remedy):
    (tmp_path / file).parent.mkdir(parents=True, exist_ok=True)
    (tmp_path / file).write_text("")
    with pytest.raises(ValueError, match=remedy) as error:
        open_sequence(tmp_path)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("layout", "file", "change"),
    [
        ("tum", "rgb.txt", lambda text: text.replace("# color images", "timestamp filename")),
        ("tum", "rgb.txt", lambda text: text.replace(" ", ",").replace("#", "timestamp,filename #")),
        ("euroc", "mav0/cam0/data.csv", lambda text: text.replace("#", "")),
        ("euroc", "mav0/state_groundtruth_estimate0/data.csv", lambda text: text.replace("#", "")),
        ("generic", "K.txt", lambda text: "a b c\n" + text),
        ("arkitscenes", "*/*.traj", lambda text: "time rx ry rz tx ty tz\n" + text),
        ("tartanair", "pose_left.txt", lambda text: "tx ty tz qx qy qz qw\n" + text),
    ],
)
def test_a_table_may_begin_with_the_names_of_its_columns(tmp_path, layout, file, change):
    """Without a #, as tables of pandas."""
    path = LAYOUTS[layout](tmp_path)
    before = open_sequence(path)
    (table,) = path.glob(file)
    table.write_text(change(table.read_text()))
    after = open_sequence(path)
    assert after.names == before.names
    for old, new in zip(before, after, strict=True):
        np.testing.assert_array_equal(new.T_world_cam, old.T_world_cam)
        np.testing.assert_array_equal(new.intrinsics, old.intrinsics)


def test_eth3d(tmp_path):
    """SLAM: TUM's files and calibration.txt; multi-view: a COLMAP model in dslr_calibration_undistorted/."""
    slam, scene = layouts.write_tum(tmp_path, folder="cables_1")
    (slam / "calibration.txt").write_text("50 51 31.5 23.5\n")
    np.testing.assert_array_equal(open_sequence(slam)[0].intrinsics, [[50, 0, 31.5], [0, 51, 23.5], [0, 0, 1]])
    views, scene, _ = written.write_colmap(tmp_path, text=True)
    (views / "sparse" / "0").rename(views / "dslr_calibration_undistorted")
    np.testing.assert_allclose(open_sequence(views)[0].T_world_cam, scene.T_world_cam[0], atol=1e-12)


def test_a_folder_of_depth_without_depth_maps_is_logged(tmp_path, caplog):
    path, *_ = layouts.write_generic(tmp_path)
    for file in (path / "depth").iterdir():
        file.rename(file.with_suffix(".jpg"))
    assert open_sequence(path)[0].depth is None
    assert "depth holds no depth map (.png, " in caplog.text


def backslashes(file, old):
    text = file.read_text()
    assert old in text
    file.write_text(text.replace(old, old.replace("/", "\\" * (2 if file.suffix == ".json" else 1))))


@pytest.mark.parametrize("layout", ["transforms", "tum", "colmap"])
def test_paths_with_backslashes(tmp_path, layout):
    if layout == "transforms":
        path, _ = written.write_transforms(tmp_path)
        backslashes(path / "transforms.json", "images/")
        backslashes(path / "transforms.json", "depth/")
    elif layout == "tum":
        path, _ = layouts.write_tum(tmp_path)
        backslashes(path / "rgb.txt", "rgb/")
        backslashes(path / "depth.txt", "depth/")
    else:
        path, *_ = written.write_colmap(tmp_path, text=True)
        for name in ("images", "depth"):
            (path / name).rename(path / f"{name}0")
            (path / name).mkdir()
            (path / f"{name}0").rename(path / name / "left")
        file = path / "sparse" / "0" / "images.txt"
        file.write_text(file.read_text().replace(".png", ".png").replace(" 0.png", " left\\0.png"))
        lines = [line.split(" ") for line in file.read_text().splitlines()]
        file.write_text(
            "\n".join(
                " ".join([*w[:-1], "left\\" + w[-1].removeprefix("left\\")]) if w[-1].endswith("png") else " ".join(w)
                for w in lines
            )
        )
        shutil.rmtree(path / "depth")
    sequence = open_sequence(path)
    assert (sequence.layout, sequence.skipped) == (layout, ())
    assert all(frame.image is not None for frame in sequence)
    assert layout == "colmap" or not sequence.without_depth


def test_a_missing_image_is_named(tmp_path):
    path, _ = written.write_transforms(tmp_path)
    shutil.rmtree(path / "images")
    with pytest.raises(ValueError, match=r"6 x missing image file; first .*walk/images/0\.png"):
        open_sequence(path)


# ---- transforms.json


def change_transforms(path, **values):
    file = path / "transforms.json"
    file.write_text(json.dumps({**json.loads(file.read_text()), **values}))


@pytest.mark.parametrize("unit", [float("nan"), 0, -1, float("inf"), 2, "x"])
def test_the_unit_of_depth_in_transforms_is_checked(tmp_path, unit):
    path, _ = written.write_transforms(tmp_path)
    change_transforms(path, depth_unit_scale_factor=unit)
    with pytest.raises(ValueError, match="depth_unit_scale_factor must be"):
        open_sequence(path)


@pytest.mark.parametrize("key", ["fl_x", "cx", "w", "k1"])
def test_numbers_of_transforms_that_are_nan_are_named(tmp_path, key):
    path, _ = written.write_transforms(tmp_path)
    change_transforms(path, **{key: float("nan")})
    with pytest.raises(ValueError, match=f"{key} must be a number, got nan"):
        open_sequence(path)


def without_depth(path):
    content = json.loads((path / "transforms.json").read_text())
    for frame in content["frames"]:
        del frame["depth_file_path"]
    (path / "transforms.json").write_text(json.dumps(content))


def test_poses_of_transforms_are_metric_only_with_depth(tmp_path, capfd):
    path, _ = written.write_transforms(tmp_path)
    assert open_sequence(path).metric
    (path / "sparse_pc.ply").write_bytes(b"ply")
    assert not open_sequence(path).metric
    (path / "sparse_pc.ply").unlink()
    without_depth(path)
    assert not open_sequence(path).metric
    assert cli.main(["data", "check", str(path)]) == 0
    assert "the unit of the poses: their file does not state it" in capfd.readouterr().out
    words = ["run", str(path), "--model", "onnx", "--weights", "no.onnx", "--out", str(tmp_path / "out")]
    assert cli.main(words) == 2
    assert "--pose-scale M" in capfd.readouterr().err
    assert open_sequence(path, pose_scale=1.0).metric
    assert cli.main(["data", "check", str(path), "--pose-scale", "1"]) == 0
    assert "the unit of the poses" not in capfd.readouterr().out


def test_depth_measures_the_unit_of_the_poses(tmp_path, capfd):
    """Old nerfstudio files from COLMAP with depth: poses in units of 2.5 m."""
    path, _ = written.write_transforms(tmp_path)
    content = json.loads((path / "transforms.json").read_text())
    for frame in content["frames"]:
        matrix = np.array(frame["transform_matrix"])
        matrix[:3, 3] /= 2.5
        frame["transform_matrix"] = matrix.tolist()
    (path / "transforms.json").write_text(json.dumps({**content, "aabb_scale": 16}))
    assert cli.main(["data", "check", str(path)]) == 1
    (remedy,) = [line for line in capfd.readouterr().out.splitlines() if "--pose-scale " in line and "remedy" in line]
    assert float(remedy.split()[-1]) == pytest.approx(2.5, rel=0.05)


def test_a_folder_with_the_parts_of_nerf_s_scenes(tmp_path, caplog):
    path, truth = written.write_transforms(tmp_path)
    (path / "transforms.json").rename(path / "transforms_train.json")
    shutil.copy(path / "transforms_train.json", path / "transforms_test.json")
    content = json.loads((path / "transforms_train.json").read_text())
    for frame in content["frames"]:
        frame["file_path"] = frame["file_path"].removesuffix(".png")
    (path / "transforms_train.json").write_text(json.dumps(content))
    sequence = open_sequence(path)
    assert (sequence.layout, sequence.name, len(sequence)) == ("transforms", "walk", 6)
    np.testing.assert_array_equal(sequence[3].image, truth.images[3])
    assert "transforms_train.json is read, not transforms_test.json" in caplog.text
    assert open_sequence(path / "transforms_test.json").name == "transforms_test"
    assert [found.layout for found in find_sequences(tmp_path)] == ["transforms"]


def test_an_offset_in_applied_transform_is_undone(tmp_path):
    path, truth = written.write_transforms(tmp_path)
    turned = np.array([[1.0, 0, 0, 5], [0, 0, 1, 6], [0, -1, 0, 7]])
    for matrix, shift in ((np.eye(4)[:3] + np.eye(4)[3] * [[1], [2], [3]], [1, 2, 3]), (turned, [0, 0, 0])):
        change_transforms(path, applied_transform=matrix.tolist())
        for frame, T in zip(open_sequence(path), truth.T_world_cam, strict=True):
            np.testing.assert_allclose(frame.T_world_cam[:3, 3], T[:3, 3] - shift, atol=1e-12)
    change_transforms(path, applied_transform=[[1, "x"]])
    with pytest.raises(ValueError, match="applied_transform must be 3x4 finite numbers"):
        open_sequence(path)


# ---- COLMAP


@pytest.mark.parametrize("text", [False, True])
def test_the_largest_of_several_models_is_read(tmp_path, caplog, text):
    path, truth, points = written.write_colmap(tmp_path, text=text, unit=2.0)
    other, *_ = written.write_colmap(tmp_path / "other", frames=2, text=text)
    (path / "sparse" / "0").rename(path / "sparse" / "10")
    (other / "sparse" / "0").rename(path / "sparse" / "0")
    (path / "sparse" / "unsorted").mkdir()
    sequence = open_sequence(path)
    assert len(sequence) == 6
    assert "the model 10 with 6 images is read, not 0 with 2; --reader model_index chooses another one" in caplog.text
    assert len(open_sequence(path, model_index=0)) == 2
    with pytest.raises(ValueError, match=r"model_index must be one of the models of .* \(0, 10\), got 3"):
        open_sequence(path, model_index=3)
    assert len(read_landmarks(path)) == 6
    assert len(read_landmarks(path, 0)) == 2
    with pytest.raises(ValueError, match="takes no model_index"):
        open_sequence(written.write_transforms(tmp_path / "t")[0], model_index=0)
    from ufmstar_torch.eval.engine.maps import own_depth

    chosen = open_sequence(path, model_index=10)
    assert network_scale(chosen, own_depth(), range(6), 10).metres == pytest.approx(2.0, rel=5e-3)
    assert (points.shape, len(truth.images)) == ((72, 3), 6)


def test_a_single_model_is_read_without_a_word(tmp_path, caplog):
    path, *_ = written.write_colmap(tmp_path)
    (path / "sparse" / "0").rename(path / "sparse" / "3")
    assert len(open_sequence(path)) == 6
    assert not caplog.records


# ---- videos


@pytest.mark.parametrize("suffix", ["mkv", "webm", "mp4", "avi"])
def test_a_video_of_a_variable_rate_has_its_frames_and_times(tmp_path, suffix):
    """The number of frames that Matroska states is the duration times a guessed rate; in mp4, frames are stored out of
    order here (H.264)."""
    times = [0, 0.1, 0.133, 0.233, 0.267, 0.4]
    for i in range(6):
        layouts.write_image(tmp_path / f"{i}.png", np.full((64, 96, 3), 40 * i + 20, np.uint8))
    stamps = "+".join(f"eq(N,{i})*{round(1000 * t)}" for i, t in enumerate(times))
    codec = {"webm": ["-c:v", "libvpx", "-auto-alt-ref", "0"], "avi": ["-c:v", "mjpeg"], "mp4": ["-bf", "2"]}
    command = [get_ffmpeg_exe(), "-v", "error", "-framerate", "1000", "-i", str(tmp_path / "%d.png")]
    command += ["-vf", f"settb=1/1000,setpts='{stamps}'", "-fps_mode", "passthrough", "-enc_time_base", "1/1000"]
    subprocess.run(
        [*command, *codec.get(suffix, ["-bf", "0"]), "-pix_fmt", "yuv420p", str(tmp_path / f"v.{suffix}")], check=True
    )
    video = Video(tmp_path / f"v.{suffix}")
    assert len(video) == 6
    np.testing.assert_allclose(video.times(), times, atol=2e-3)
    assert [round(video.read(i).mean() / 40 - 0.5) for i in range(6)] == [*range(6)]
    (tmp_path / "slam.txt").write_text("".join(f"{time} {i} 0 0 0 0 0 1\n" for i, time in enumerate(times)))
    named = {"intrinsics": (60.0, 60.0, 47.5, 31.5), "trajectory": "slam.txt"}
    entries = open_sequence(tmp_path / f"v.{suffix}", **named).entries
    np.testing.assert_allclose([entry.T_world_cam[0, 3] for entry in entries], range(6), atol=0.07)
    with pytest.raises(ValueError, match=r"pass trajectory.*`ufmstar poses` computes poses from images alone"):
        open_sequence(tmp_path / f"v.{suffix}", intrinsics=named["intrinsics"])


# ---- KITTI's calib.txt


def test_kitti_s_calibration(tmp_path):
    path, truth = layouts.write_generic(tmp_path)
    (path / "images").rename(path / "image_2")
    four = truth.K
    rows = [np.hstack([four, [[-shift * four[0, 0]], [0], [0]]]).ravel() for shift in (0, 0.54, -0.06, 0.48)]
    lines = [f"P{i}: {' '.join(f'{x:.12e}' for x in row)}" for i, row in enumerate(rows)] + ["Tr: 1 2 3"]
    (path / "calib.txt").write_text("\n".join(lines))
    assert open_sequence(path).image_size == (48, 64), "K.txt comes first"
    (path / "K.txt").unlink()
    np.testing.assert_allclose(open_sequence(path).intrinsics, truth.K, rtol=1e-11)
    for camera, shift in (("image_2", -0.06), ("image_0", 0), ("image_1", 0.54)):  # poses are those of camera 0
        (path / "image_2").rename(path / camera)
        T = open_sequence(path)[3].T_world_cam
        np.testing.assert_allclose(T, truth.T_world_cam[3] @ rigid(np.eye(3), [shift, 0, 0]), atol=1e-10)
        (path / camera).rename(path / "image_2")
    (path / "calib.txt").rename(tmp_path / "raw.txt")
    text = (tmp_path / "raw.txt").read_text().replace("P", "P_rect_0")
    (tmp_path / "raw.txt").write_text("calib_time: 09-Jan-2012 13:57:47\n" + text)
    np.testing.assert_allclose(open_sequence(path, intrinsics=str(tmp_path / "raw.txt")).intrinsics, truth.K)
    (tmp_path / "raw.txt").write_text(
        text.replace("P_rect_01: 4", "P_rect_01: 5").replace("P_rect_01: 5", "P_rect_01: 9", 1)
    )
    with pytest.raises(ValueError, match="the intrinsics of its cameras differ"):
        read_intrinsics(tmp_path / "raw.txt")
    (tmp_path / "raw.txt").write_text("P0: 1 2 3")
    with pytest.raises(ValueError, match=r"raw\.txt:1: expected 12 numbers"):
        read_intrinsics(tmp_path / "raw.txt")


@pytest.mark.parametrize(
    "listed",
    [
        "images\\{}", ".\\images\\{}", "C:\\walk\\images\\{}", "C:/Users/me/walk/images/{}", "/home/me/walk/images/{}",
        "../walk/images/{}", "..\\..\\elsewhere\\images\\{}", "file:///home/me/walk/images/{}",
        "\\\\server\\walk\\images\\{}",
    ],
)  # fmt: skip
def test_paths_of_other_computers_are_found_by_their_end(tmp_path, listed):
    images, names = tmp_path / "walk" / "images", ["a.png", "b.png"]
    images.mkdir(parents=True)
    for name in names:
        (images / name).write_bytes(b"")
        assert listed_file(tmp_path / "walk", listed.format(name)) == images / name


@pytest.mark.parametrize(
    "listed", ["{}/secret.png", "../secret.png", "../../secret.png", "..", "/", "file://{}/secret.png"]
)
def test_a_listed_path_never_leaves_the_recording(tmp_path, listed):
    (tmp_path / "secret.png").write_bytes(b"")
    walk = tmp_path / "walk"
    walk.mkdir()
    found = listed_file(walk, listed.format(tmp_path))
    assert not found.is_file()
    assert found.is_relative_to(walk)

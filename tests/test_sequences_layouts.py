"""Every dataset layout: the read data equals the rendered data, and defects are counted or named."""

from __future__ import annotations

import pickle
import shutil

import layouts
import layouts_more
import numpy as np
import pytest
from layouts import truncate, write_depth_png, write_image

from ufmstar_torch.eval.sequences import FrameError, open_sequence
from ufmstar_torch.eval.sequences.ground_truth import register_depth

K_TUM_FR3 = [[535.4, 0, 320.1], [0, 539.2, 247.6], [0, 0, 1]]


# ---- TUM RGB-D


def test_tum_intrinsics_follow_the_camera_or_the_user(tmp_path):
    path, truth = layouts.write_tum(tmp_path)
    renamed = path.rename(tmp_path / "desk")
    with pytest.raises(ValueError, match="pass intrinsics as fx fy cx cy"):
        open_sequence(renamed)
    np.testing.assert_array_equal(
        open_sequence(renamed, intrinsics=(50, 51, 32, 24)).intrinsics, [[50, 0, 32], [0, 51, 24], [0, 0, 1]]
    )
    listing = (renamed / "rgb.txt").read_text()
    (renamed / "rgb.txt").write_text("# file: 'rgbd_dataset_freiburg2_desk.bag'\n" + listing)
    np.testing.assert_allclose(open_sequence(renamed, distortion="none").intrinsics, truth.K, rtol=1e-12, atol=1e-12)
    # of the dataset's size
    path = renamed.rename(tmp_path / "rgbd_dataset_freiburg3_x")
    for file in (path / "rgb").iterdir():
        write_image(file, np.zeros((480, 640, 3), np.uint8))
    np.testing.assert_array_equal(open_sequence(path).intrinsics, K_TUM_FR3)


def test_tum_other_trajectory_and_bad_lines(tmp_path):
    path, truth = layouts.write_tum(tmp_path)
    moved = [line.split() for line in (path / "groundtruth.txt").read_text().splitlines()[1:]]
    slam = "\n".join(" ".join([w[0], str(float(w[1]) + 5), *w[2:]]) for w in moved)
    (tmp_path / "slam.txt").write_text(slam)
    sequence = open_sequence(path, trajectory=tmp_path / "slam.txt")
    np.testing.assert_allclose(sequence[0].T_world_cam[0, 3], truth.T_world_cam[0][0, 3] + 5, atol=1e-12)
    (path / "rgb.txt").write_text("# x\n10.0 rgb/a.png\nten rgb/b.png\n")
    with pytest.raises(ValueError, match=r"rgb\.txt:3: expected 'timestamp filename'"):
        open_sequence(path)


# ---- 7-Scenes


def test_seven_scenes_registers_depth_to_colour(tmp_path):
    path, of_color, _ = layouts.write_seven_scenes(tmp_path)
    sequence = open_sequence(path)
    assert (sequence.layout, sequence.depth_intrinsics) == ("7scenes", None)
    np.testing.assert_allclose(sequence.intrinsics, of_color.K, atol=1e-12)
    for i, frame in enumerate(sequence):
        np.testing.assert_allclose(frame.T_world_cam, of_color.T_world_cam[i], atol=1e-9)
        np.testing.assert_array_equal(frame.image, of_color.images[i])
        valid = frame.depth > 0
        error = np.abs(frame.depth - of_color.depths[i])[valid] / of_color.depths[i][valid]
        # forward warping moves a sample by up to half a pixel; the other differences lie on the wall next to the pillar
        assert np.median(error) < 0.002
        assert np.mean(error > 0.05) < 0.03
        assert 0.65 < valid.mean() < 0.9  # the colour camera sees further to all sides: (525 / 585)^2 = 0.8


@pytest.mark.parametrize("name", ["intrinsics.K.txt", "camera-intrinsics.txt"])
def test_the_camera_in_the_folder_wins_over_the_one_of_the_layout(tmp_path, name):
    path, _, of_depth = layouts.write_seven_scenes(tmp_path)
    np.savetxt(path / name, of_depth.K)  # one registered camera, as in other recordings with these file names
    sequence = open_sequence(path)
    np.testing.assert_allclose(sequence.intrinsics, of_depth.K, atol=1e-12)
    for i, frame in enumerate(sequence):
        np.testing.assert_allclose(frame.T_world_cam, of_depth.T_world_cam[i], atol=1e-9)
        np.testing.assert_allclose(frame.depth, of_depth.depths[i], atol=1e-3)
    chosen = open_sequence(path, intrinsics=[100, 101, 32, 24])
    np.testing.assert_array_equal(chosen.intrinsics[[0, 1], [0, 1]], [100, 101])


@pytest.mark.parametrize("write", [layouts.write_tum, layouts.write_tartanair])
def test_intrinsics_in_the_folder_of_a_layout_with_a_default_camera(tmp_path, write):
    path = write(tmp_path)[0]
    np.savetxt(path / "K.txt", [[100, 0, 32], [0, 101, 24], [0, 0, 1]])
    np.testing.assert_array_equal(open_sequence(path).intrinsics[[0, 1], [0, 1]], [100, 101])


def test_register_depth_closed_form():
    K = np.array([[10.0, 0, 2], [0, 10.0, 1], [0, 0, 1]])
    T = np.eye(4)
    T[0, 3] = 0.1
    depth = np.zeros((3, 5), np.float32)
    depth[1, 1] = 1.0  # moves by fx 0.1 / 1 = 1 px
    depth[1, 0] = 0.5  # by 2 px to the same pixel, and is nearer
    depth[0, 4] = 1.0  # leaves the image
    out = register_depth(depth, K, K, T, (3, 5))
    expected = np.zeros((3, 5), np.float32)
    expected[1, 2] = 0.5
    np.testing.assert_array_equal(out, expected)
    np.testing.assert_array_equal(register_depth(np.zeros((3, 5)), K, K, T, (2, 2)), np.zeros((2, 2)))


# ---- depth maps with a camera of their own


OWN_DEPTH = {
    "scannet": layouts.write_scannet,
    "sens": lambda root, frames: layouts_more.write_sens(root / "a.sens", frames),
}


@pytest.mark.parametrize("layout", OWN_DEPTH)
def test_depth_has_a_camera_of_its_own(tmp_path, layout):
    path, of_color, of_depth = OWN_DEPTH[layout](tmp_path, frames=11)
    sequence = open_sequence(path)
    assert (sequence.layout, sequence.depth_size) == (layout, layouts.SIZE)
    assert sequence.image_size == of_color.images[0].shape[:2]
    assert [int(name.split("-")[-1]) for name in sequence.names] == list(range(11))  # 10 after 9
    np.testing.assert_allclose(sequence.intrinsics, of_color.K, rtol=1e-6)
    for i, frame in enumerate(sequence):
        np.testing.assert_allclose(frame.depth_intrinsics, of_depth.K, rtol=1e-6)  # float32 in .sens
        np.testing.assert_allclose(frame.depth, of_depth.depths[i], atol=5e-4 + 1e-6)
        np.testing.assert_allclose(frame.T_world_cam, of_depth.T_world_cam[i], atol=1e-6)
        # JPEG smooths the cells and adds noise
        difference = np.abs(frame.image.astype(int) - of_color.images[i]).mean()
        other = np.abs(frame.image.astype(int) - of_color.images[(i + 5) % 11]).mean()
        assert difference < 0.5 * other
    of_lens = open_sequence(path, distortion=(0.2, -0.3, 0, 0))[5]  # the colour camera's
    assert (of_lens.image != sequence[5].image).any()
    np.testing.assert_array_equal(of_lens.depth, sequence[5].depth)
    np.testing.assert_array_equal(of_lens.depth_intrinsics, sequence[5].depth_intrinsics)


def test_scannet_resized_export_keeps_the_original_intrinsics_file(tmp_path):
    path, of_color, of_depth = layouts.write_scannet(tmp_path)
    for name, K in (("color", (1170, 1171, 648, 484)), ("depth", (578, 578, 320, 240))):
        fx, fy, cx, cy = K
        np.savetxt(path / "intrinsic" / f"intrinsic_{name}.txt", [[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    sequence = open_sequence(path)
    np.testing.assert_allclose(sequence.intrinsics, of_color.K, atol=1e-12)
    np.testing.assert_allclose(sequence.depth_intrinsics, of_depth.K, atol=1e-12)


# ---- TartanAir


def test_tartanair_several_trajectories(tmp_path):
    path, _ = layouts.write_tartanair(tmp_path)
    shutil.copytree(path, path.parent / "P001")
    with pytest.raises(ValueError, match=r"\['P000', 'P001'\]: open one of them"):
        open_sequence(path.parent)


# ---- all of them: broken files, detection


def lose(path, *names):
    for name in names:
        (path / name).unlink()


def spoil_tum(path):
    lose(path, "rgb/10.033333.png", "depth/10.071667.png")
    text = (path / "groundtruth.txt").read_text().splitlines()
    text[4] = "10.100000 nan nan nan 0 0 0 1"
    (path / "groundtruth.txt").write_text("\n".join(text))


def spoil_seven_scenes(path):
    lose(path, "frame-000001.color.png", "frame-000002.pose.txt", "frame-000003.depth.png")
    np.savetxt(path / "frame-000004.pose.txt", np.full((4, 4), np.nan))


def spoil_scannet(path):
    (path / "pose" / "1.txt").write_text("-inf -inf -inf -inf\n" * 4)
    lose(path, "pose/2.txt", "depth/3.png")


def spoil_tartanair(path):
    lose(path, "image_left/000002_left.png", "depth_left/000004_left_depth.npy")


SPOILED = {
    "tum": (spoil_tum, {"10.033333": "missing image file", "10.100000": "non-finite pose"}, "10.066667"),
    "7scenes": (
        spoil_seven_scenes,
        {"000001": "missing image file", "000002": "missing pose file", "000004": "non-finite pose"},
        "000003",
    ),
    "scannet": (spoil_scannet, {"1": "non-finite pose", "2": "missing pose file"}, "3"),
    "tartanair": (spoil_tartanair, {"000002": "missing image file"}, "000004"),
}


@pytest.mark.parametrize("layout", SPOILED)
def test_lost_frames_are_counted_and_shift_no_other(tmp_path, layout):
    spoil, lost, without_depth = SPOILED[layout]
    path = LAYOUTS[layout][0](tmp_path)[0]
    whole = {entry.name: entry.T_world_cam for entry in open_sequence(path).entries}
    spoil(path)
    sequence = open_sequence(path)
    skipped = {frame.name.removeprefix("frame-").removesuffix("_left"): frame.reason for frame in sequence.skipped}
    assert skipped == lost
    assert len(sequence) == 6 - len(lost)
    assert [name for name in sequence.without_depth if without_depth in name] == list(sequence.without_depth)
    assert sequence.names_on_disk == tuple(whole)
    for entry in sequence.entries:
        np.testing.assert_array_equal(entry.T_world_cam, whole[entry.name])


def test_a_seven_scenes_pixel_without_a_measurement_has_no_depth(tmp_path):
    path, _, _ = layouts.write_seven_scenes(tmp_path)
    values = np.full(layouts.SIZE, 1500.0)
    values[:, :20], values[:, 20:40] = 65535, 0
    write_depth_png(path / "frame-000000.depth.png", values, 1)
    same = {"intrinsics": (60, 60, 32, 24), "depth_intrinsics": (60, 60, 32, 24), "T_color_depth": np.eye(4)}
    frame = open_sequence(path, **same)[0]
    assert (frame.depth > 0).mean(axis=0).tolist() == [0] * 40 + [1] * 24
    assert (open_sequence(path)[0].depth <= 1.501).all()


def test_an_image_beyond_tartanairs_poses_is_refused(tmp_path):
    path, truth = layouts.write_tartanair(tmp_path)
    write_image(path / "image_left" / "000009_left.png", truth.images[0])
    with pytest.raises(ValueError, match="expected a name NNNNNN_left below the 6 poses"):
        open_sequence(path)


# Writer, and the files of the third frame.
LAYOUTS = {
    "tum": (layouts.write_tum, "rgb/10.066667.png", "depth/10.071667.png"),
    "7scenes": (layouts.write_seven_scenes, "frame-000002.color.png", "frame-000002.depth.png"),
    "scannet": (layouts.write_scannet, "color/2.jpg", "depth/2.png"),
    "tartanair": (layouts.write_tartanair, "image_left/000002_left.png", "depth_left/000002_left_depth.npy"),
    "generic": (layouts.write_generic, "images/9.png", "depth/9.png"),
}


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("kind", ["image", "depth"])
def test_truncated_files_are_found_when_decoding(tmp_path, layout, kind):
    write, image, depth = LAYOUTS[layout]
    path = write(tmp_path)[0]
    file = path / (image if kind == "image" else depth)
    truncate(file)
    sequence = open_sequence(path)
    assert len(sequence) == 6
    with pytest.raises(FrameError) as caught:
        sequence[2]
    assert caught.value.path.name == file.name
    errors = []
    readable = list(sequence.readable(errors.append))
    assert [frame.index for frame in readable] == [0, 1, 3, 4, 5]
    assert [error.path for error in errors] == [caught.value.path]
    with pytest.raises(FrameError):
        list(sequence)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_maps_of_another_size_are_refused(tmp_path, layout):
    write, *names = LAYOUTS[layout]
    path = write(tmp_path)[0]
    image, depth = (path / name for name in names)
    content = image.read_bytes()
    write_image(image, np.zeros((30, 40, 3), np.uint8))
    with pytest.raises(FrameError, match="the image is 40x30, the sequence's are"):
        open_sequence(path)[2]
    image.write_bytes(content)
    if depth.suffix == ".npy":
        np.save(depth, np.ones((30, 40), np.float32))
    else:
        write_depth_png(depth, np.ones((30, 40)), 1000)
    if layout != "7scenes":
        with pytest.raises(FrameError, match="the depth map is 40x30, the sequence's are 64x48"):
            open_sequence(path)[2]


def test_unknown_and_ambiguous_layouts(tmp_path):
    path, _ = layouts.write_tum(tmp_path)
    empty = tmp_path / "empty"
    empty.mkdir()
    with pytest.raises(
        ValueError, match=r"no known layout: expected images .*, K\.txt; or the files of tum, .*kitti360.* \(docs/data"
    ):
        open_sequence(empty)
    with pytest.raises(ValueError, match=r"has not the layout 'tartanair': looked for pose_left\.txt"):
        open_sequence(path, "tartanair")
    with pytest.raises(ValueError, match="layout must be one of auto, tum"):
        open_sequence(path, "kitti")
    with pytest.raises(FileNotFoundError, match="no such file or folder"):
        open_sequence(tmp_path / "absent")
    scannet, _, _ = layouts.write_scannet(tmp_path)
    shutil.copytree(path, scannet, dirs_exist_ok=True)
    with pytest.raises(ValueError, match="fits the layouts tum, scannet: pass layout"):
        open_sequence(scannet)
    assert open_sequence(scannet, "scannet").layout == "scannet"
    with pytest.raises(ValueError, match="layout 'scannet' takes no fps"):
        open_sequence(scannet, "scannet", fps=30)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_no_frames_at_all(tmp_path, layout):
    path = LAYOUTS[layout][0](tmp_path)[0]
    for file in path.rglob("*"):
        if file.suffix in (".png", ".jpg"):
            file.unlink()
    with pytest.raises(ValueError, match=r"no usable frame|holds no image"):
        open_sequence(path)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"truth_scale": 1000}, "truth_scale is in metres per unit"),
        ({"truth_scale": 0}, "truth_scale is in metres per unit"),
        ({"fps": 0}, r"fps must lie in \(0\.0, inf"),
        ({"max_pose_gap": -1}, r"max_pose_gap must lie in \[0\.0, inf"),
        ({"max_time_difference": float("nan")}, "max_time_difference must be a number, got nan"),
        ({"images": "rgb"}, "layout 'tum' takes no images"),
        ({"topics": ["/image"]}, "layout 'tum' takes no topics: topics is an option of bag$"),
        ({"drive": 3}, "layout 'tum' takes no drive: drive is an option of kitti360$"),
        ({"intrinsics": (500, 500, 320, 240)}, r"do not fit images of 64x48: were they given for another"),
        ({"intrinsics": (500, 500, 320)}, "expected a 3x3 matrix or fx fy cx cy"),
        ({"intrinsics": np.diag([1.0, -1, 1])}, "positive focal lengths"),
        ({"intrinsics": np.diag([1e300, 1e300, 1])}, "values within 1e\\+07 px"),
        ({"intrinsics": np.array([[50.0, 0, 32], [0, 50, 24], [0, 1, 1]])}, "must have rows"),
    ],
)
def test_options_out_of_range(tmp_path, options, message):
    path, _ = layouts.write_tum(tmp_path)
    with pytest.raises(ValueError, match=message):
        open_sequence(path, **options)


def test_a_pose_farther_than_a_million_kilometres_is_skipped_and_named(tmp_path):
    path = layouts.write_scannet(tmp_path, frames=3)[0]
    far = np.eye(4)
    far[0, 3] = 1e300
    np.savetxt(path / "pose" / "1.txt", far)
    skipped = open_sequence(path).skipped
    assert [(frame.name, frame.reason) for frame in skipped] == [("1", "pose farther than 1e+09 m from the origin")]


@pytest.mark.parametrize("layout", LAYOUTS)
def test_frames_are_copies_and_sequences_can_be_sent_to_workers(tmp_path, layout):
    sequence = open_sequence(LAYOUTS[layout][0](tmp_path)[0])
    frame = sequence[0]
    frame.T_world_cam[:] = 0
    frame.intrinsics[:] = 0
    again = pickle.loads(pickle.dumps(sequence))[-6]
    assert again.index == 0
    np.testing.assert_array_equal(again.T_world_cam[3], [0, 0, 0, 1])
    assert again.intrinsics[2, 2] == 1
    with pytest.raises(IndexError):
        sequence[6]
    error = pickle.loads(pickle.dumps(FrameError("a/b.png", "truncated")))
    assert (str(error), error.path.name, error.reason) == ("a/b.png: truncated", "b.png", "truncated")

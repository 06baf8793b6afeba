"""The generic reader: any images or video, trajectory, intrinsics and depth."""

from __future__ import annotations

import pickle
import subprocess

import layouts
import numpy as np
import pytest
from imageio_ffmpeg import get_ffmpeg_exe
from layouts import quaternion_line, truncate, write_depth_png, write_image, write_video

from ufmstar_torch.eval.sequences import FrameError, open_sequence
from ufmstar_torch.eval.sequences.attach import pair_by_name
from ufmstar_torch.eval.sequences.video import Video

K = layouts.resized(500, 500, 320, 240, (480, 640))


def tum_trajectory(path, T_world_cam, times):
    lines = [f"{t:.9f} {quaternion_line(T)}" for t, T in zip(times, T_world_cam, strict=True)]
    path.write_text("\n".join(lines))


def test_a_link_without_its_file_keeps_its_place_and_is_an_error_of_its_frame(tmp_path):
    path, truth = layouts.write_generic(tmp_path)
    (path / "images" / "7.png").unlink()
    (path / "images" / "7.png").symlink_to("nowhere.png")
    sequence = open_sequence(path)
    assert sequence.names[0] == "7"
    np.testing.assert_array_equal(sequence[1].image, truth.images[1])
    with pytest.raises(FrameError, match="cannot be decoded"):
        sequence[0]


@pytest.mark.parametrize("form", ["rows", "line", "4x4", "numbers"])
def test_intrinsics_in_every_form(tmp_path, form):
    path, truth = layouts.write_generic(tmp_path)
    four = [truth.K[0, 0], truth.K[1, 1], truth.K[0, 2], truth.K[1, 2]]
    padded = np.eye(4)
    padded[:3, :3] = truth.K
    intrinsics = None
    if form == "line":
        np.savetxt(path / "K.txt", [four])
    elif form == "4x4":
        np.savetxt(path / "K.txt", padded)
    elif form == "numbers":
        (path / "K.txt").unlink()
        intrinsics = four
    np.testing.assert_allclose(open_sequence(path, intrinsics=intrinsics).intrinsics, truth.K, atol=1e-12)


def test_missing_or_doubled_pieces_are_named(tmp_path):
    path, _ = layouts.write_generic(tmp_path)
    (path / "K.txt").rename(path / "k0.txt")
    with pytest.raises(ValueError, match=r"looked for K\.txt.*: pass intrinsics"):
        open_sequence(path)
    (path / "k0.txt").rename(path / "K.txt")
    (path / "trajectory.txt").write_text("0 0 0 0 0 0 0 1")
    with pytest.raises(ValueError, match=r"several .*found \['poses\.txt', 'trajectory\.txt'\]\): pass trajectory"):
        open_sequence(path)
    assert len(open_sequence(path, trajectory="poses.txt")) == 6
    with pytest.raises(FileNotFoundError, match=r"orb\.txt"):
        open_sequence(path, trajectory="orb.txt")
    (path / "rgb").mkdir()
    with pytest.raises(ValueError, match="pass images"):
        open_sequence(path, trajectory="poses.txt")
    assert len(open_sequence(path, trajectory="poses.txt", images="images")) == 6


def timed_images(tmp_path, names, truth):
    for name, image in zip(names, truth.images, strict=True):
        write_image(tmp_path / "rgb" / f"{name}.png", image)


@pytest.mark.parametrize(
    ("names", "times"),
    [
        (["1.50", "1.60", "1.70"], [1.5, 1.6, 1.7]),
        (["12", "13", "14"], [12, 13, 14]),
        (
            ["1403636579763555584", "1403636579813555456", "1403636579863555584"],
            np.arange(3) * 0.05 + 1403636579.7635555,
        ),
        (["1403636579763555", "1403636579813555", "1403636579863555"], np.arange(3) * 0.05 + 1403636579.763555),
    ],
)
def test_names_as_timestamps(tmp_path, names, times):
    truth = layouts.truth(K, 3)
    timed_images(tmp_path, names, truth)
    tum_trajectory(tmp_path / "CameraTrajectory.txt", truth.T_world_cam, times)
    sequence = open_sequence(tmp_path, intrinsics=K)
    assert sequence.layout == "generic"
    for i, frame in enumerate(sequence):
        np.testing.assert_allclose(frame.T_world_cam, truth.T_world_cam[i], atol=1e-6)
        assert frame.timestamp == pytest.approx(times[i], abs=1e-6)
    assert sequence.without_depth == tuple(names)


def test_times_from_rgb_txt_fps_and_offset(tmp_path):
    truth = layouts.truth(K, 3)
    timed_images(tmp_path, ["a", "b", "c"], truth)
    tum_trajectory(tmp_path / "trajectory.txt", truth.T_world_cam, [5.0, 5.05, 5.1])
    with pytest.raises(ValueError, match=r"'a' is no timestamp, .* pass fps"):
        open_sequence(tmp_path, intrinsics=K)
    sequence = open_sequence(tmp_path, intrinsics=K, fps=20, time_offset=5)
    np.testing.assert_allclose(sequence[2].T_world_cam, truth.T_world_cam[2], atol=1e-9)
    with pytest.raises(
        ValueError, match=r"images lie at 0\.000 to 0\.100 s, the trajectory's 3 poses at 5\.000 to 5\.100"
    ):
        open_sequence(tmp_path, intrinsics=K, fps=20)
    (tmp_path / "rgb.txt").write_text("5.1 rgb/c.png\n5.0 rgb/a.png\n9.0 rgb/b.png\n")
    sequence = open_sequence(tmp_path, intrinsics=K)
    assert [frame.reason for frame in sequence.skipped] == ["no pose within 0.1 s around the image"]
    assert sequence.names == ("a", "c")
    (tmp_path / "rgb.txt").write_text("5.1 rgb/c.png\n")
    with pytest.raises(ValueError, match=r"rgb\.txt has no timestamp for 2 images: \['a\.png', 'b\.png'\]"):
        open_sequence(tmp_path, intrinsics=K)


def test_sparse_depth_maps_pair_by_number(tmp_path):
    path, truth = layouts.write_generic(tmp_path)
    for file in (path / "depth").iterdir():
        file.unlink()
    (path / "depth").rmdir()
    write_depth_png(path / "maps" / "depth_0008.png", truth.depths[1], 4000, scale_text="0.00025")
    write_depth_png(path / "maps" / "depth_0012.png", truth.depths[5], 4000, scale_text="0.00025")
    assert open_sequence(path).without_depth == ("7", "8", "9", "10", "11", "12")
    sequence = open_sequence(path, truth="maps")
    assert sequence.without_depth == ("7", "9", "10", "11")
    np.testing.assert_allclose(sequence[1].depth, truth.depths[1], atol=2e-4)
    np.testing.assert_allclose(sequence[5].depth, truth.depths[5], atol=2e-4)
    for file in (path / "maps").iterdir():
        file.rename(file.with_name(file.name.replace("00", "99")))
    with pytest.raises(ValueError, match=r"no depth map \(.*\) is named like an image \(7"):
        open_sequence(path, truth="maps")


def test_depth_named_by_its_own_timestamps(tmp_path):
    truth = layouts.truth(K, 3)
    timed_images(tmp_path, ["1.500", "1.600", "1.700"], truth)
    tum_trajectory(tmp_path / "groundtruth.txt", truth.T_world_cam, [1.5, 1.6, 1.7])
    for name, depth in zip(["1.512", "1.619", "1.725"], truth.depths, strict=True):
        write_depth_png(tmp_path / "depth" / f"{name}.png", depth, 1000)
    sequence = open_sequence(tmp_path, intrinsics=K)
    assert sequence.without_depth == ("1.700",)  # 25 ms
    np.testing.assert_allclose(sequence[1].depth, truth.depths[1], atol=5e-4 + 1e-6)
    assert open_sequence(tmp_path, intrinsics=K, max_time_difference=0.03).without_depth == ()


def test_depth_of_another_size_scales_its_intrinsics(tmp_path):
    path, _ = layouts.write_generic(tmp_path)
    K_half = layouts.resized(500, 510, 310, 245, (480, 640), (24, 32))
    half = layouts.truth(K_half, 6, (24, 32))
    for i in range(6):
        write_depth_png(path / "depth" / f"{i + 7}.png", half.depths[i], 1000)
    sequence = open_sequence(path)
    np.testing.assert_allclose(sequence.depth_intrinsics, K_half, atol=1e-12)
    np.testing.assert_allclose(sequence[3].depth, half.depths[3], atol=5e-4 + 1e-6)
    for i in range(6):
        write_depth_png(path / "depth" / f"{i + 7}.png", np.ones((24, 24)), 1000)
    with pytest.raises(ValueError, match="not only a resize: pass intrinsics"):
        open_sequence(path)
    depth_camera = (20, 20, 12, 12)
    assert open_sequence(path, depth_intrinsics=depth_camera)[0].depth_intrinsics[0, 0] == 20


def test_video_with_kitti_rows(tmp_path):
    truth = layouts.truth(K, 8)
    write_video(tmp_path / "walk.mkv", truth.images)
    np.savetxt(tmp_path / "poses.txt", [T[:3].ravel() for T in truth.T_world_cam])
    for i, depth in enumerate(truth.depths):
        write_depth_png(tmp_path / "depth" / f"{i:04d}.png", depth, 1000)
    for path in (tmp_path / "walk.mkv", tmp_path):
        sequence = open_sequence(path, intrinsics=K)
        assert (len(sequence), sequence.image_size, sequence.without_depth) == (8, (48, 64), ())
        for i in (0, 5, 2, 7, 7, 6):  # backwards too
            frame = sequence[i]
            np.testing.assert_array_equal(frame.image, truth.images[i])
            np.testing.assert_allclose(frame.T_world_cam, truth.T_world_cam[i], atol=1e-12)
            np.testing.assert_allclose(frame.depth, truth.depths[i], atol=5e-4 + 1e-6)
    sequence = pickle.loads(pickle.dumps(open_sequence(tmp_path / "walk.mkv", intrinsics=K)))
    assert sequence.name == "walk"
    np.testing.assert_array_equal(sequence[3].image, truth.images[3])


def test_broken_and_turned_videos(tmp_path, capfd, caplog):
    rng = np.random.default_rng(0)
    images = [rng.integers(0, 255, (48, 64, 3), dtype=np.uint8) for _ in range(8)]
    write_video(tmp_path / "cut.avi", images)
    truncate(tmp_path / "cut.avi", 0.6)
    for content in (b"", b"no video at all" * 10):
        (tmp_path / "noise.mp4").write_bytes(content)
        with pytest.raises(ValueError, match=r"noise\.mp4: cannot be opened as a video"):
            Video(tmp_path / "noise.mp4")
    with pytest.raises(FileNotFoundError):
        Video(tmp_path / "absent.mp4")
    command = [get_ffmpeg_exe(), "-v", "error", "-display_rotation", "90", "-i", tmp_path / "cut.avi", "-c", "copy"]
    subprocess.run([*command, tmp_path / "turned.mov"], check=True, stderr=subprocess.DEVNULL)
    turned = Video(tmp_path / "turned.mov")
    assert turned.size == turned.read(0).shape[:2] == (64, 48)
    assert "turned.mov: its frames are turned by 270 degrees, as it states: K is of turned ones" in caplog.text
    video = Video(tmp_path / "cut.avi")
    assert 2 <= len(video) == len(video.times()) < 8
    np.testing.assert_array_equal(video.read(len(video) - 2), images[len(video) - 2])
    np.testing.assert_array_equal(video.read(1), images[1])
    with pytest.raises(FrameError, match=r"frame 7 cannot be read, decoding stops at frame [3456]"):
        video.read(7)
    np.testing.assert_array_equal(video.read(0), images[0])
    capfd.readouterr()  # FFmpeg complains on stderr


def test_pairing_rules(tmp_path):
    def pairs(names, files):
        return {name: file.name for name, file in pair_by_name(names, [tmp_path / f for f in files]).items()}

    assert pairs(["a", "b"], ["b.png", "c.png"]) == {"b": "b.png"}
    assert pairs(["frame-000012"], ["12_depth.png"]) == {"frame-000012": "12_depth.png"}
    assert pairs(["000001_left"], ["000001_left_depth.npy"]) == {"000001_left": "000001_left_depth.npy"}
    # decimals are not integers, and ambiguous names pair nothing
    assert pairs(["1.05"], ["1.5.png"]) == {}
    assert pairs(["1.05"], ["d_1.05.png"]) == {"1.05": "d_1.05.png"}
    assert pairs(["7"], ["a7.png", "b7.png"]) == {}
    assert pairs(["left_7", "right_7"], ["7.png"]) == {}
    assert pairs(["x", "y"], ["depth_x.png", "z.png"]) == {}

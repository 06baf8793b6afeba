"""KITTI-360: calibration, poses by frame number, the laser's depth; defects are counted or named."""

from __future__ import annotations

import shutil

import layouts
import layouts_more
import numpy as np
import pytest
from layouts_more import DRIVE, T_car_rect, write_kitti360

from ufmstar_torch.eval.check.check import check_sequence
from ufmstar_torch.eval.sequences import FrameError, find_sequences, open_sequence
from ufmstar_torch.eval.sequences.kitti360 import read_scan

NUMBERS = (3, 4, 6, 7, 8)
NAMES = tuple(f"{n:010d}" for n in NUMBERS)
POSES = f"data_poses/{DRIVE}/cam0_to_world.txt"
IMAGES = f"data_2d_raw/{DRIVE}/image_00/data_rect"
SCANS = f"data_3d_raw/{DRIVE}/velodyne_points/data"


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    root = tmp_path_factory.mktemp("KITTI-360")
    return root, write_kitti360(root)[1]


@pytest.fixture
def root(written, tmp_path):
    """A copy that the test may change."""
    return shutil.copytree(written[0], tmp_path / "KITTI-360")


def assert_truth(sequence, truth):
    assert sequence.names == NAMES
    np.testing.assert_allclose(sequence.intrinsics, truth.K, rtol=1e-9)
    for i, frame in enumerate(sequence):
        np.testing.assert_allclose(frame.T_world_cam, truth.T_world_cam[i], atol=1e-8)
        np.testing.assert_array_equal(frame.image, truth.images[i])


def test_a_drive(written):
    root, truth = written
    sequence = open_sequence(root / "data_2d_raw" / DRIVE)
    assert (sequence.layout, sequence.name, sequence.image_size) == ("kitti360", DRIVE, layouts_more.CAR_SIZE)
    assert_truth(sequence, truth)
    assert [(frame.name, frame.reason) for frame in sequence.skipped] == [
        ("0000000005", "no pose for this frame number")
    ]
    assert sequence[1].timestamp - sequence[0].timestamp == pytest.approx(0.1, abs=1e-6)


def test_the_laser_gives_the_cameras_depth(written):
    """Each point projects to its pixel with its depth: rectification, mounting and the head's rotation are undone."""
    root, truth = written
    sequence = open_sequence(root)
    assert sequence.without_depth == ()
    for i, frame in enumerate(sequence):
        expected = np.zeros_like(truth.depths[i])
        expected[::2, ::3] = truth.depths[i][::2, ::3]
        np.testing.assert_array_equal(frame.depth > 0, expected > 0)
        np.testing.assert_allclose(frame.depth, expected, rtol=1e-5)
    actual = check_sequence(sequence)  # a sixth of the pixels is enough to compare
    assert actual.ok
    assert actual.error < 0.02


def test_neighbouring_scans_can_be_added(written):
    root, truth = written
    alone, added = open_sequence(root)[3].depth, open_sequence(root, scans=1)[3].depth
    assert (added > 0).sum() > 1.5 * (alone > 0).sum()
    valid = added > 0
    error = np.abs(added - truth.depths[3])[valid] / truth.depths[3][valid]
    assert np.median(error) < 0.01  # half a pixel; the rest are points visible past an edge
    assert (added[alone > 0] <= alone[alone > 0] * (1 + 1e-6)).all()
    with pytest.raises(ValueError, match=r"scans must lie in \[0, inf"):
        open_sequence(root, scans=-1)


@pytest.mark.parametrize("folder", ["", f"data_2d_raw/{DRIVE}", f"data_2d_raw/{DRIVE}/image_00", IMAGES])
def test_every_way_to_name_a_drive(written, folder, monkeypatch):
    root, _ = written
    assert open_sequence(root / folder).names == NAMES
    monkeypatch.chdir(root / folder)
    assert open_sequence(".").name == DRIVE


def test_a_root_with_several_drives(root):
    other = "2013_05_28_drive_0010_sync"
    for folder in ("data_2d_raw", "data_poses"):
        shutil.copytree(root / folder / DRIVE, root / folder / other)
    with pytest.raises(
        ValueError, match=r"drive must name one of \['2013_05_28_drive_0007_sync', '2013_05_28_drive_00"
    ):
        open_sequence(root)
    assert open_sequence(root, drive=7).name == open_sequence(root, drive=DRIVE).name == DRIVE
    assert open_sequence(root, drive="10").name == other
    assert open_sequence(root, drive="10").without_depth == NAMES  # it has no scans
    with pytest.raises(ValueError, match="drive must name one of"):
        open_sequence(root, drive=1)
    with pytest.raises(ValueError, match="drive goes with the dataset's root"):
        open_sequence(root / "data_2d_raw" / DRIVE, drive=7)
    result = find_sequences(root.parent)
    assert [one.name for one in result] == [f"KITTI-360__data_2d_raw__{name}" for name in (DRIVE, other)]
    assert {one.layout for one in result} == {"kitti360"}


def test_the_right_camera(tmp_path):
    drive, truth = write_kitti360(tmp_path, camera="01")
    sequence = open_sequence(drive)
    assert sequence.name == f"{DRIVE}_image_01"
    assert_truth(sequence, truth)
    baseline = np.linalg.inv(T_car_rect("00")) @ T_car_rect("01")
    assert 0.5 < baseline[0, 3] < 0.7  # to the right
    np.testing.assert_allclose(sequence[2].depth[::2, ::3], truth.depths[2][::2, ::3], rtol=1e-5)


def test_fisheye_cameras_are_refused(root):
    fisheye = root / "data_2d_raw" / DRIVE / "image_02"
    layouts.write_image(fisheye / "data_rgb" / "0000000003.png", np.zeros((40, 40, 3), np.uint8))
    for path in (fisheye, fisheye / "data_rgb"):
        with pytest.raises(ValueError, match="image_00 and image_01 can be read; the others are fisheye"):
            open_sequence(path)


def test_poses_of_the_car_are_moved_to_the_camera(root):
    truth = open_sequence(root)
    (root / POSES).unlink()
    sequence = open_sequence(root)
    for one, other in zip(sequence.entries, truth.entries, strict=True):
        np.testing.assert_allclose(one.T_world_cam, other.T_world_cam, atol=1e-8)
    (root / POSES).with_name("poses.txt").unlink()
    with pytest.raises(FileNotFoundError, match=r"neither cam0_to_world\.txt nor poses\.txt: pass trajectory"):
        open_sequence(root)


def test_depth_maps_of_the_user(written, tmp_path):
    root, truth = written
    for i in (0, 3):
        layouts.write_depth_png(tmp_path / "maps" / f"{NAMES[i]}.png", truth.depths[i], 256)
    sequence = open_sequence(root, truth=tmp_path / "maps")
    assert sequence.without_depth == (NAMES[1], NAMES[2], NAMES[4])
    np.testing.assert_allclose(sequence[3].depth, truth.depths[3], atol=1 / 512 + 1e-5)
    with pytest.raises(ValueError, match="scans goes with depth from the laser"):
        open_sequence(root, truth=tmp_path / "maps", scans=1)
    (tmp_path / "other").mkdir()
    layouts.write_depth_png(tmp_path / "other" / "77.png", truth.depths[0], 256)
    with pytest.raises(ValueError, match=r"no depth map .* is named like an image"):
        open_sequence(root, truth=tmp_path / "other")


def test_missing_and_broken_files(root):
    (root / IMAGES / f"{NAMES[0]}.png").unlink()
    layouts.truncate(root / IMAGES / f"{NAMES[1]}.png")
    layouts.write_image(root / IMAGES / f"{NAMES[2]}.png", np.zeros((20, 75, 3), np.uint8))
    (root / SCANS / f"{NAMES[3]}.bin").unlink()
    torn = root / SCANS / f"{NAMES[4]}.bin"
    torn.write_bytes(torn.read_bytes()[:-5])
    text = (root / POSES).read_text().splitlines()
    sequence = open_sequence(root)
    assert sequence.names == NAMES[1:]  # no frame gets another frame's pose
    assert float(text[1].split()[4]) == pytest.approx(sequence.entries[0].T_world_cam[0, 3])
    assert sequence.without_depth == (NAMES[3],)
    errors = []
    assert [frame.name for frame in sequence.readable(errors.append)] == [NAMES[3]]
    assert [error.path.name for error in errors] == [f"{NAMES[1]}.png", NAMES[2], f"{NAMES[4]}.bin"]
    assert "the image is 75x20, the sequence's are 176x47" in str(errors[1])
    assert "size must be a multiple of 16 bytes" in str(errors[2])


@pytest.mark.parametrize(
    ("file", "old", "new", "error"),
    [
        ("perspective.txt", "P_rect_00", "P_rect_09", r"perspective\.txt: no line 'P_rect_00'"),
        ("perspective.txt", "S_rect_00: 1408", "S_rect_00: wide", r"perspective\.txt:5: expected 2 numbers"),
        ("calib_cam_to_velo.txt", " ", " nan ", r"calib_cam_to_velo\.txt: expected the 12 numbers"),
    ],
)
def test_a_malformed_calibration_is_named(root, file, old, new, error):
    path = root / "calibration" / file
    path.write_text(path.read_text().replace(old, new))
    with pytest.raises(ValueError, match=error):
        open_sequence(root)


def test_a_missing_calibration_is_named(root):
    (root / "calibration" / "calib_cam_to_velo.txt").unlink()
    assert open_sequence(root).without_depth == NAMES  # the laser's mounting is unknown
    (root / "calibration" / "perspective.txt").unlink()
    with pytest.raises(FileNotFoundError, match=r"calibration is missing: no file .*perspective\.txt"):
        open_sequence(root)


def test_a_trajectory_by_time_and_by_frame_number(written, tmp_path):
    root, truth = written
    times = [frame.timestamp for frame in open_sequence(root)]
    moved = [layouts_more.rigid(T[:3, :3], T[:3, 3] + 5) for T in truth.T_world_cam]
    by_time = [f"{t:.6f} {layouts.quaternion_line(T)}" for t, T in zip(times, moved, strict=True)]
    by_number = [f"{n} {layouts.quaternion_line(T)}" for n, T in zip(NUMBERS, moved, strict=True)]
    for lines, reason in ((by_time, "no pose within 0.1 s"), (by_number, "no pose within 0.1 s")):
        (tmp_path / "slam.txt").write_text("\n".join(lines))
        sequence = open_sequence(root, trajectory=tmp_path / "slam.txt")
        assert sequence.names == NAMES
        assert [frame.name for frame in sequence.skipped] == ["0000000005"]
        assert sequence.skipped[0].reason.startswith(reason)
        np.testing.assert_allclose(sequence[2].T_world_cam, moved[2], atol=1e-6)
        # The scan needs poses only for the motion during a rotation of the head, which a shift does not change.
        np.testing.assert_allclose(sequence[3].depth[::2, ::3], truth.depths[3][::2, ::3], rtol=1e-4)


def test_read_scan_leaves_the_car_and_what_is_not_finite_out(tmp_path):
    rows = [[1, 0.5, 0, 9], [10, 0, 0, 9], [np.nan, 10, 0, 9], [-3, 0, 0, 9]]
    (tmp_path / "a.bin").write_bytes(np.array(rows, "<f4").tobytes())
    np.testing.assert_array_equal(read_scan(tmp_path / "a.bin").T, [[10, 0, 0], [-3, 0, 0]])
    (tmp_path / "b.bin").write_bytes(b"")
    for name, reason in (("b.bin", "is no scan"), ("c.bin", "cannot be read")):
        with pytest.raises(FrameError, match=reason):
            read_scan(tmp_path / name)

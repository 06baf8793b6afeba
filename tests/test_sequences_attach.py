"""Trajectories of other programs on every layout: by time, frame number, or position, without silent shifts."""

from __future__ import annotations

import layouts
import numpy as np
import pytest
from layouts import quaternion_line

from ufmstar_torch.eval.sequences import Trajectory, interpolate_pose, open_sequence

FRAMES = 6
# Frame numbers in the file names of the layouts' writers.
NUMBERED = {
    "scannet": (layouts.write_scannet, range(FRAMES)),
    "7scenes": (layouts.write_seven_scenes, range(FRAMES)),
    "tartanair": (layouts.write_tartanair, range(FRAMES)),
    "generic": (layouts.write_generic, range(7, 7 + FRAMES)),
}
MOVED = [T + np.array([[0, 0, 0, 5.0], [0] * 4, [0] * 4, [0] * 4]) for T in layouts.walk(FRAMES)]


@pytest.fixture(scope="module", params=NUMBERED)
def numbered(request, tmp_path_factory):
    writer, numbers = NUMBERED[request.param]
    path = writer(tmp_path_factory.mktemp(request.param), frames=FRAMES)[0]
    options = {"trajectory": path / "slam.txt"}
    return path, list(numbers), options


def write(path, stamps, poses=MOVED, form="{:.6f}"):
    lines = [f"{form.format(t)} {quaternion_line(T)}" for t, T in zip(stamps, poses, strict=True)]
    path.write_text("\n".join(lines) + "\n")


def assert_moved(sequence, indices):
    assert len(sequence) == len(indices)
    for entry, i in zip(sequence.entries, indices, strict=True):
        np.testing.assert_allclose(entry.T_world_cam, MOVED[i], atol=1e-9)


def test_by_frame_number(numbered):
    path, numbers, options = numbered
    write(options["trajectory"], numbers, form="{}")
    assert_moved(open_sequence(path, **options), range(FRAMES))


def test_one_timestamp_off_skips_that_frame(numbered):
    path, numbers, options = numbered
    write(options["trajectory"], [*numbers[:2], 900, *numbers[3:]], form="{}")
    sequence = open_sequence(path, **options)
    assert_moved(sequence, [0, 1, 3, 4, 5])
    assert [frame.reason for frame in sequence.skipped] == ["no pose within 0.1 s around the image"]
    assert sequence.names_on_disk[2] == sequence.skipped[0].name


def test_by_time_with_frames_per_second(numbered):
    """Number / fps + offset; a generic sequence's images are counted from 0, whatever their names."""
    path, numbers, options = numbered
    counted = range(FRAMES) if open_sequence(path).layout == "generic" else numbers
    write(options["trajectory"], [100 + n / 30 for n in counted], form="{:.9f}")
    sequence = open_sequence(path, fps=30, time_offset=100, **options)
    assert_moved(sequence, range(FRAMES))
    assert sequence[1].timestamp == pytest.approx(100 + counted[1] / 30)
    write(options["trajectory"], [100 + (n + (0.5 if i == 4 else 0)) / 30 for i, n in enumerate(counted)])
    sequence = open_sequence(path, fps=30, time_offset=100, max_pose_gap=0.04, **options)
    assert_moved(sequence, [0, 1, 2, 3, 5])
    assert len(sequence.skipped) == 1


def test_kitti_rows_by_place_and_a_wrong_count(numbered):
    path, _, options = numbered
    np.savetxt(options["trajectory"], [T[:3].ravel() for T in MOVED])
    assert_moved(open_sequence(path, **options), range(FRAMES))
    np.savetxt(options["trajectory"], [T[:3].ravel() for T in MOVED[:-1]])
    with pytest.raises(ValueError, match="trajectory has 5 poses for 6 images: without timestamps, there must be one"):
        open_sequence(path, **options)


def test_orb_slam3_in_nanoseconds(tmp_path):
    """EuRoC's format: integer nanoseconds since 1970, for a recording with image times in seconds."""
    path, _ = layouts.write_tum(tmp_path)
    text = (path / "rgb.txt").read_text()
    names = [line.split()[1] for line in text.splitlines()[1:]]
    seconds = 1403636579.763555 + np.arange(FRAMES) / 30
    (path / "rgb.txt").write_text("\n".join(f"{t:.6f} {name}" for t, name in zip(seconds, names, strict=True)))
    write(tmp_path / "f_dataset.txt", seconds * 1e9, form="{:.6f}")
    sequence = open_sequence(path, trajectory=tmp_path / "f_dataset.txt")
    assert_moved(sequence, range(FRAMES))
    write(tmp_path / "f_dataset.txt", (seconds + 0.01) * 1e9, form="{:.6f}")  # interpolated
    sequence = open_sequence(path, trajectory=tmp_path / "f_dataset.txt")
    x = MOVED[1][0, 3] + (MOVED[2][0, 3] - MOVED[1][0, 3]) * 0.7
    assert sequence.entries[1].T_world_cam[0, 3] == pytest.approx(x, abs=1e-4)
    assert [frame.name for frame in sequence.skipped] == [sequence.names_on_disk[0]]


@pytest.mark.parametrize("unit", [1e9, 1e6, 1e3, 1.0])
def test_units_are_recognised_by_meeting_the_images(tmp_path, unit):
    path, _ = layouts.write_tum(tmp_path)  # at 10 s and later
    write(tmp_path / "slam.txt", (10 + np.arange(FRAMES) / 30) * unit, form="{:.9f}")
    assert_moved(open_sequence(path, trajectory=tmp_path / "slam.txt"), range(FRAMES))


@pytest.mark.parametrize("stamps", [np.arange(FRAMES) / 10, np.array([10e9])], ids=["another-time", "one-pose"])
def test_a_trajectory_at_another_time_stays_as_it_is(tmp_path, stamps):
    """0 to 0.5 s are not read as ms; a single pose has no spacing that could confirm a unit."""
    path, _ = layouts.write_tum(tmp_path)
    write(tmp_path / "slam.txt", stamps, MOVED[: len(stamps)])
    with pytest.raises(ValueError, match=rf"{len(stamps)} poses at {stamps[0]:.3f} to {stamps[-1]:.3f} s"):
        open_sequence(path, trajectory=tmp_path / "slam.txt")


def test_whole_seconds_of_a_video_are_seconds(tmp_path):
    """A pose each second and 10 images per second: times that equal some frame numbers are not frame numbers."""
    poses = layouts.walk(41)
    images = [np.full((48, 64, 3), i, np.uint8) for i in range(41)]
    layouts.write_video(tmp_path / "walk.mkv", images, fps=10)
    write(tmp_path / "slam.txt", range(5), [poses[10 * i] for i in range(5)], form="{}")
    K = layouts.resized(500, 500, 320, 240, (480, 640))
    sequence = open_sequence(tmp_path / "walk.mkv", trajectory=tmp_path / "slam.txt", intrinsics=K, max_pose_gap=1.0)
    assert len(sequence) == 41
    expected = interpolate_pose(Trajectory(np.arange(5.0), np.stack([poses[10 * i] for i in range(5)])), 1.5, 1.0)
    np.testing.assert_allclose(sequence.entries[15].T_world_cam, expected, atol=1e-9)

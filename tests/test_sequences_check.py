"""The check of a sequence reports common mistakes, and reports nothing for correct sequences."""

from __future__ import annotations

import dataclasses

import layouts
import numpy as np
import pytest
from shared_data import require_shared

from scenes import camera_pose
from ufmstar_torch.eval.check.check import check_sequence
from ufmstar_torch.eval.sequences import open_sequence
from ufmstar_torch.gaussians.conventions import OURS


def with_poses(sequence, convert):
    entries = tuple(dataclasses.replace(e, T_world_cam=convert(e.T_world_cam)) for e in sequence.entries)
    return dataclasses.replace(sequence, entries=entries)


@pytest.fixture(scope="module")
def walk(tmp_path_factory):
    """A rendered walk of 20 frames in the generic layout, 160x120."""
    return layouts.write_generic(tmp_path_factory.mktemp("data"), 20, size=(120, 160))[0]


def test_nonsense_poses_fit_no_reading(walk):
    rng = np.random.default_rng(0)

    def turned(T):
        return T @ camera_pose(rng.normal(0, 1, 3), *rng.normal(0, 0.4, 2))

    result = check_sequence(with_poses(open_sequence(walk), turned))
    assert not result.ok
    assert any("disagree" in problem or "no two frames overlap" in problem for problem in result.problems)


def test_a_camera_that_stands_still_leaves_it_undecided(walk):
    sequence = open_sequence(walk)
    still = dataclasses.replace(sequence, entries=(sequence.entries[3],) * 10)
    result = check_sequence(still)
    assert result.ok
    assert any("tell the depth's scale" in text for text in result.undecided)
    assert any("does not tell the poses from world-to-camera" in text for text in result.undecided)


@pytest.mark.parametrize("writer", ["write_tum", "write_seven_scenes", "write_scannet", "write_tartanair"])
def test_every_generated_layout_is_consistent(tmp_path, writer):
    path = getattr(layouts, writer)(tmp_path, frames=8)[0]
    result = check_sequence(open_sequence(path))
    assert result.ok
    assert result.error < 0.02
    assert result.poses == OURS


# ---- real recordings (shared material): depth warped with the poses agrees between frames ----

# folder, layout, frames, K (fx, fy, cx, cy)
RECORDINGS = {
    "rgbd_dataset_freiburg1_xyz": ("tum", 40, (517.3, 516.5, 318.6, 255.3)),
    "rgbd_dataset_freiburg3_teddy": ("tum", 50, (535.4, 539.2, 320.1, 247.6)),
    "hololens_office": ("generic", 100, (495.5677570, 495.4819626, 269.5028972, 169.1941121)),
    "tartanair_sample": ("tartanair", 30, (320, 320, 320, 240)),
}


@pytest.fixture(params=RECORDINGS)
def recording(request):
    return require_shared(f"data/{request.param}"), *RECORDINGS[request.param]


def warped_error(a, b):
    """Median relative difference between a's depth, transformed to b, and b's depth, in NumPy."""
    v, u = np.nonzero(a.depth > 0)
    z = a.depth[v, u].astype(np.float64)
    fx, fy, cx, cy = a.intrinsics[0, 0], a.intrinsics[1, 1], a.intrinsics[0, 2], a.intrinsics[1, 2]
    in_a = np.stack([(u - cx) / fx * z, (v - cy) / fy * z, z, np.ones_like(z)])
    x, y, z = (np.linalg.inv(b.T_world_cam) @ a.T_world_cam @ in_a)[:3]
    front = z > 0.01
    column, row = np.rint(fx * x[front] / z[front] + cx), np.rint(fy * y[front] / z[front] + cy)
    z = z[front]
    inside = (column >= 0) & (column < b.depth.shape[1]) & (row >= 0) & (row < b.depth.shape[0])
    present = b.depth[row[inside].astype(int), column[inside].astype(int)]
    valid = present > 0
    assert valid.sum() > 0.1 * len(v)
    return np.median(np.abs(z[inside][valid] - present[valid]) / present[valid])


def test_depth_agrees_five_frames_on(recording):
    """Proves pose convention, axes and depth scale; observed worst pair 4.3 % (fr1), medians .1 to 1.3 %."""
    path, layout, count, K = recording
    sequence = open_sequence(path)
    assert (sequence.layout, len(sequence)) == (layout, count)
    assert sequence.skipped == sequence.without_depth == ()
    fx, fy, cx, cy = K
    as_published = open_sequence(path, distortion="none") if layout == "tum" else sequence
    np.testing.assert_allclose(as_published.intrinsics, [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], rtol=1e-8)
    starts = np.linspace(0, count - 6, 10).astype(int)
    frames = {int(i): sequence[int(i)] for i in {*starts, *(starts + 5)}}
    errors = [warped_error(frames[int(i)], frames[int(i) + 5]) for i in starts]
    assert np.median(errors) < 0.02
    assert max(errors) < 0.05


def test_mocap_that_starts_late(tmp_path):
    """fr3/teddy with the first second of its ground truth cut off: those frames are counted."""
    source = require_shared("data/rgbd_dataset_freiburg3_teddy")
    late = tmp_path / "rgbd_dataset_freiburg3_teddy_late"
    late.mkdir()
    for name in ("rgb", "depth", "rgb.txt", "depth.txt"):
        (late / name).symlink_to(source / name)
    lines = (source / "groundtruth.txt").read_text().splitlines()
    start = float(lines[3].split()[0]) + 1
    late_lines = [line for line in lines if line.startswith("#") or float(line.split()[0]) >= start]
    (late / "groundtruth.txt").write_text("\n".join(late_lines))
    sequence = open_sequence(late)
    expected = [name for name in sequence.names_on_disk if float(name) < start - 1e-3]
    assert [frame.name for frame in sequence.skipped] == expected
    assert 5 < len(expected) < 45
    assert {frame.reason for frame in sequence.skipped} == {"no pose within 0.1 s around the image"}
    assert len(sequence) == 50 - len(expected)

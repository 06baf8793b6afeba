"""``ufmstar export``: other programs can read its files, and pixels beyond the limits are left out."""

from __future__ import annotations

import json

import layouts
import numpy as np
import pytest
from rerun_stand_in import stand_in
from scipy.spatial import cKDTree
from test_ply import parse

from ufmstar_torch import cli
from ufmstar_torch.eval.run.export import RunFrame, export_cloud
from ufmstar_torch.eval.run.writers import read_frame
from ufmstar_torch.eval.sequences import open_sequence, read_trajectory
from ufmstar_torch.eval.sequences.images import read_depth

__all__ = ["stand_in"]


def read_ply(path):
    head, body = path.read_bytes().split(b"end_header\n")
    kinds = {"float": "<f4", "double": "<f8", "uchar": "|u1"}
    names = [line.split()[1:] for line in head.decode().splitlines() if line.startswith("property")]
    return np.frombuffer(body, [(name, kinds[kind]) for kind, name in names])


def test_depth_is_gated(finished_run):
    out, _, truth = finished_run
    assert cli.main(["export", str(out), "--to", "depth", "--max-sigma", "0.05"]) == 0
    depth, sigma = (read_depth(out / "export" / kind / "9.png") for kind in ("depth", "sigma"))
    assert (depth[:20] == 0).all()
    np.testing.assert_array_equal(sigma > 0, depth > 0)
    np.testing.assert_allclose(sigma, 0.02 * depth, atol=1e-4)
    certain = 0.02 * truth.depths[2][20:] <= 0.0499
    assert 0 < certain.sum() < certain.size
    np.testing.assert_allclose(depth[20:][certain], truth.depths[2][20:][certain], atol=1e-3)
    assert (depth[20:][0.02 * truth.depths[2][20:] > 0.0501] == 0).all()
    assert cli.main(["export", str(out), "--to", "depth", "--max-relative-sigma", "0.01"]) == 0
    assert (read_depth(out / "export" / "depth" / "9.png") == 0).all()


def test_a_gate_states_what_it_keeps_and_warns_where_nothing_supports_sigma(finished_run, capsys):
    out, _, _ = finished_run
    words = ["export", str(out), "--to", "depth", "--max-sigma", "0.05"]
    assert cli.main(words) == 0
    printed = capsys.readouterr().out
    depths = np.stack([read_frame(file)["depth"] for file in sorted((out / "frames").iterdir())])
    usable, below = depths > 0, 0.02 * depths <= 0.05
    below[:, :20] = False  # sigma is 1 m there
    assert f"keep {below[usable].mean():.1%} of the pixels with a depth" in printed
    assert "warning: nothing supports this sigma, since the run has neither a posterior" in printed
    assert cli.main(["export", str(out), "--to", "depth"]) == 0
    assert "keep" not in capsys.readouterr().out, "no limit"
    summary = json.loads((out / "summary.json").read_text())
    for change, warned in (
        ({"posterior": {"calibration": 1.2}}, ""),
        ({"recalibrated": True}, ""),
        ({"posterior": {"calibration": 12.0}}, "since held-out anchors have a mean z^2 of 12 instead of 1"),
    ):
        (out / "summary.json").write_text(json.dumps(summary | change))
        assert cli.main(words) == 0
        printed = capsys.readouterr().out
        assert ("warning" in printed) == bool(warned)
        assert warned in printed
    (out / "summary.json").write_text(json.dumps(summary))


def test_the_trajectory(finished_run):
    out, _, truth = finished_run
    assert cli.main(["export", str(out), "--to", "tum"]) == 0
    trajectory = read_trajectory(out / "export" / "trajectory.txt")
    np.testing.assert_array_equal(trajectory.timestamps, range(7, 13))  # the numbers in the images' names
    np.testing.assert_allclose(trajectory.T_world_cam, truth.T_world_cam, atol=1e-7)


def test_the_cloud_lies_on_the_surfaces(finished_run):
    out, path, truth = finished_run
    words = ["--sequence", str(path), "--to", "cloud", "--max-relative-sigma", "0.021", "--voxel", "0.05"]
    assert cli.main(["export", str(out), *words]) == 0
    cloud = read_ply(out / "export" / "cloud.ply")
    points = np.stack([cloud[name] for name in "xyz"], -1).astype(float)
    assert 500 < len(points) < 6 * 28 * 64
    assert len(np.unique(np.floor(points / 0.05 + 1e-4), axis=0)) > 0.98 * len(points), "one point a voxel"
    # in the middle frame, no point is nearer than the surface, up to a voxel
    T = np.linalg.inv(truth.T_world_cam[3])
    x, y, z = (points @ T[:3, :3].T + T[:3, 3]).T
    u, v = (truth.K @ np.stack([x, y, z]))[:2] / z
    inside = (z > 0) & (u > 0) & (u < 63) & (v > 0) & (v < 47)
    surface = truth.depths[3][np.rint(v[inside]).astype(int), np.rint(u[inside]).astype(int)]
    assert np.median(np.abs(surface - z[inside])) < 0.02
    near = np.abs(surface / z[inside] - 1) < 0.01
    assert near.mean() > 0.6
    np.testing.assert_allclose(cloud["sigma"][inside][near], 0.02 * z[inside][near], rtol=0.3)
    colours = np.stack([cloud[name] for name in ("red", "green", "blue")], -1)[inside][near].astype(int)
    image = truth.images[3][np.rint(v[inside]).astype(int), np.rint(u[inside]).astype(int)][near]
    assert np.median(np.abs(colours - image)) < 12  # the colour darkens with the distance from each camera


def test_merging_weighs_by_the_inverse_variance(tmp_path):
    def frame(depth, sigma):
        maps = (np.float32([[depth]]), np.float32([[sigma]]))
        return RunFrame("0", 0, None, np.eye(4), np.eye(3), *maps)

    export_cloud(iter([frame(2.1, 0.1), frame(2.4, 0.2), frame(np.nan, np.nan)]), tmp_path, 1.0)
    (point,) = read_ply(tmp_path / "export" / "cloud.ply")
    w = np.array([100, 25])
    np.testing.assert_allclose(point["z"], (w * [2.1, 2.4]).sum() / w.sum(), rtol=1e-6)
    np.testing.assert_allclose(point["sigma"], np.sqrt(2 / w.sum()), rtol=1e-6)
    assert "red" not in point.dtype.names


def test_transforms_are_read_back(finished_run):
    out, path, truth = finished_run
    words = ["--sequence", str(path), "--max-sigma", "0.9"]
    assert cli.main(["export", str(out), "--to", "transforms", *words]) == 0
    again = open_sequence(out / "export" / "transforms")
    assert (again.layout, len(again), again.metric) == ("transforms", 6, True)
    for i, frame in enumerate(again):
        np.testing.assert_allclose(frame.T_world_cam, truth.T_world_cam[i], atol=1e-9)
        np.testing.assert_allclose(frame.intrinsics, truth.K, atol=1e-9)
        np.testing.assert_array_equal(frame.image, truth.images[i])
        assert frame.depth is None  # a prediction is no ground truth
        depth = read_depth(out / "export" / "transforms" / "depth" / f"{frame.name}.png")
        np.testing.assert_allclose(depth[20:], truth.depths[i][20:], atol=1.1e-3)
        assert not depth[:20].any()


FAR = np.array([458_074.6, 9_429_380.2, 162.9])  # UTM


@pytest.fixture(scope="module")
def far(tmp_path_factory):
    """The run of a walk 10^7 m from the origin, and the poses."""
    path, truth = layouts.write_generic(tmp_path_factory.mktemp("far"))
    poses = np.array(truth.T_world_cam)
    poses[:, :3, 3] += FAR
    np.savetxt(path / "poses.txt", poses[:, :3].reshape(6, 12), fmt="%.17g")
    out = tmp_path_factory.mktemp("run") / "out"
    words = ["run", str(path), "--depth", "self", "--no-video", "--no-sheet", "--out", str(out)]
    assert cli.main(words) == 0
    return out, poses, truth, path


def test_exports_far_from_the_origin_keep_millimetres(far, stand_in):
    out, poses, truth, recording = far
    for kind in ("tum", "cloud", "transforms", "mcap", "rrd"):
        images = ["--sequence", str(recording)] if kind in ("transforms", "mcap") else []
        assert cli.main(["export", str(out), "--to", kind, "--voxel", "0.001", *images]) == 0
    trajectory = read_trajectory(out / "export" / "trajectory.txt")
    np.testing.assert_allclose(trajectory.T_world_cam, poses, rtol=0, atol=3e-9)
    for folder in ("transforms", "bag"):
        again = open_sequence(out / "export" / folder)
        np.testing.assert_allclose([frame.T_world_cam for frame in again], poses, rtol=0, atol=1e-7)
    cloud = read_ply(out / "export" / "cloud.ply")
    v, u = np.indices(layouts.SIZE).reshape(2, -1)
    rays = np.linalg.inv(truth.K) @ np.stack([u, v, np.ones_like(u)])
    depths = [read_frame(out / "frames" / f"{i + 7}.npz")["depth"].ravel() for i in range(6)]
    surface = [(rays * z).T @ T[:3, :3].T + T[:3, 3] for T, z in zip(poses, depths, strict=True)]
    points = np.stack([cloud[name] for name in "xyz"], -1)
    assert len(points) > 3000
    distance, _ = cKDTree(np.concatenate(surface) - FAR).query(points - FAR)
    assert np.median(distance) < 1e-6, "most voxels have a single pixel"
    file = json.loads((out / "export" / "transforms" / "transforms.json").read_text())
    assert np.abs([frame["transform_matrix"] for frame in file["frames"]]).max() < 1000, "float32 keeps .06 mm"
    gaussians, comments = parse(out / "mixture.ply")
    (offset,) = [np.array(line.split()[2:5], float) for line in comments if line.startswith("comment offset")]
    near = np.stack([gaussians["vertex"][name] for name in "xyz"], -1)
    mixture = np.load(out / "mixture.npz")
    T = mixture["T_world_first"].reshape(4, 4)
    expected = mixture["mean"][0][mixture["weight"][0] > 0] @ T[:3, :3].T + (T[:3, 3] - offset)
    np.testing.assert_allclose(near, expected, rtol=0, atol=1e-4)
    logged = [made.named["translation"] for made in stand_in.logged("world/camera")]
    np.testing.assert_allclose(logged + offset, poses[:, :3, 3], rtol=0, atol=1e-9)
    assert np.abs(logged).max() < 1000
    (centres,) = [made.named["centers"] for made in stand_in.logged("world/gaussians")]
    np.testing.assert_allclose(centres, expected, rtol=0, atol=1e-6)
    assert stand_in.logged("offset")[0].words[0].startswith("offset 458000 9429000 0 m: add it")


REFUSED = [
    (("--max-sigma", "1e-9"), "within the limits of sigma: raise these, or run without --plain"),
    (("--voxel", "1e-7"), "left out (--voxel 1e-07)"),
    (("--voxel", "0"), "--voxel must be positive"),
    (("--sequence", "tour:1?frames=3&size=48x64"), "has none of the run's frames"),
    (("--fps", "3"), "--fps goes with --sequence"),
]


@pytest.mark.parametrize(("words", "said"), REFUSED)
def test_a_cloud_that_cannot_be_made_is_an_error(finished_run, words, said, capfd):
    assert cli.main(["export", str(finished_run[0]), "--to", "cloud", *words]) == 2
    assert said in capfd.readouterr().err


def test_a_run_without_a_frame_is_not_exported(tmp_path, capfd):
    line = {"name": "a", "state": "skipped", "reason": "no pose"}
    (tmp_path / "frames.jsonl").write_text(json.dumps(line) + "\n")
    assert cli.main(["export", str(tmp_path), "--to", "depth"]) == 2
    assert "has no finished frame" in capfd.readouterr().err

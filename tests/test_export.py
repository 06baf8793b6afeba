"""``ufmstar export``: other programs can read its files, and pixels beyond the limits are left out."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from dataclasses import replace

import layouts
import numpy as np
import pytest
from rerun_stand_in import Made, stand_in
from runs import own_depth_job
from scipy.spatial import cKDTree
from test_ply import parse

from ufmstar_torch import cli
from ufmstar_torch.eval.run.run import run
from ufmstar_torch.eval.run.writers import read_frame
from ufmstar_torch.eval.sequences import open_sequence, read_trajectory
from ufmstar_torch.eval.sequences.bag import Bag
from ufmstar_torch.eval.sequences.images import read_depth

__all__ = ["stand_in"]


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A run with exact depth; its variance is replaced by (2 % of the depth)^2, and above the horizon by 1 m^2."""
    path, truth = layouts.write_generic(tmp_path_factory.mktemp("data"))
    out = tmp_path_factory.mktemp("run") / "out"
    run(own_depth_job(path), out)
    for file in (out / "frames").iterdir():
        maps = read_frame(file)
        maps["variance"] = np.square(0.02 * maps["depth"])
        maps["variance"][:20] = 1
        np.savez(file, **maps)
    return out, path, truth


def read_ply(path):
    head, body = path.read_bytes().split(b"end_header\n")
    kinds = {"float": "<f4", "double": "<f8", "uchar": "|u1"}
    names = [line.split()[1:] for line in head.decode().splitlines() if line.startswith("property")]
    return np.frombuffer(body, [(name, kinds[kind]) for kind, name in names])


def test_depth_is_gated(finished):
    out, _, truth = finished
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


def test_a_gate_states_what_it_keeps_and_warns_where_nothing_supports_sigma(finished, capsys):
    out, _, _ = finished
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


def test_the_trajectory(finished):
    out, _, truth = finished
    assert cli.main(["export", str(out), "--to", "tum"]) == 0
    trajectory = read_trajectory(out / "export" / "trajectory.txt")
    np.testing.assert_array_equal(trajectory.timestamps, range(7, 13))  # the numbers in the images' names
    np.testing.assert_allclose(trajectory.T_world_cam, truth.T_world_cam, atol=1e-7)


def test_the_cloud_lies_on_the_surfaces(finished):
    out, path, truth = finished
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


@pytest.mark.parametrize("to", ["cloud", "transforms", "mcap", "rrd"])
def test_nothing_in_the_folder_names_code_or_a_recording(finished, tmp_path, to, capfd):
    """The summary names a plug-in, a huge tour and another folder; only the command line names the recording."""
    out, trap = tmp_path / "out", tmp_path / "trap"
    shutil.copytree(finished[0], out)
    (out / "evil.py").write_text(f"import os; os.mkdir({str(trap)!r})\nREADERS = {{}}\n")
    summary = json.loads((out / "summary.json").read_text())
    for sequence in ("tour:1?frames=1000000000", str(finished[1])):
        settings = {
            "sequence": sequence,
            "plugin": [str(out / "evil.py")],
            "images": "/etc",
            "trajectory": "/etc/passwd",
        }
        (out / "summary.json").write_text(json.dumps({**summary, "settings": settings}))
        code = cli.main(["export", str(out), "--to", to])
        said = "".join(capfd.readouterr())
        assert "--sequence SEQUENCE" in said or "rerun-sdk" in said
        assert code == 2 if to == "transforms" else code in (0, 1)
    assert not trap.exists()
    if to == "cloud":
        assert "red" not in read_ply(out / "export" / "cloud.ply").dtype.names


def test_another_recording_is_named(finished, capfd):
    words = ["export", str(finished[0]), "--to", "cloud"]
    assert cli.main([*words, "--sequence", "tour:1?frames=3&size=48x64"]) == 2
    assert "has none of the run's frames" in capfd.readouterr().err
    assert cli.main([*words, "--fps", "3"]) == 2
    assert "--fps goes with --sequence" in capfd.readouterr().err


SUMMARIES = {
    "no sequence.name": (lambda summary: summary.update(sequence={"layout": "generic"}), "(its sequence.name)"),
    "a list as sequence": (lambda summary: summary.update(sequence=[1]), "(its sequence.name)"),
    "another program": (lambda summary: summary.update(program="x"), "(its program)"),
    "a posterior of text": (lambda summary: summary.update(posterior="x"), "(its posterior)"),
    "a calibration of NaN": (lambda summary: summary.update(posterior={"calibration": float("nan")}), "calibration)"),
}


@pytest.mark.parametrize("damage", SUMMARIES)
def test_a_damaged_summary_is_named_by_field(finished, tmp_path, damage, capfd):
    change, said = SUMMARIES[damage]
    shutil.copytree(finished[0], tmp_path / "out")
    file = tmp_path / "out" / "summary.json"
    summary = json.loads(file.read_text())
    change(summary)
    file.write_text(json.dumps(summary))
    assert cli.main(["export", str(tmp_path / "out"), "--to", "cloud"]) == 2
    errors = capfd.readouterr().err
    assert f"{file} is not that of a run" in errors
    assert said in errors


DAMAGE = {
    "name": ({"name": 5}, "(its name)"),
    "name that is a path": ({"name": "../../x"}, "(its name)"),
    "state": ({"state": "begun"}, "(its state)"),
    "index": ({"index": -1}, "(its index)"),
    "a large index": ({"index": 1e300}, "(its index)"),
    "timestamp": ({"timestamp": [1]}, "(its timestamp)"),
    "intrinsics": ({"intrinsics": [1, 2, 3, None]}, "(its intrinsics)"),
    "reason": ({"state": "skipped", "reason": None}, "(its reason)"),
}


@pytest.mark.parametrize("damage", DAMAGE)
def test_a_damaged_record_is_named_by_line_and_field(finished, tmp_path, damage, capfd):
    changes, said = DAMAGE[damage]
    shutil.copytree(finished[0], tmp_path / "out")
    file = tmp_path / "out" / "frames.jsonl"
    first, second, *rest = file.read_text().splitlines()
    file.write_text("\n".join([first, json.dumps({**json.loads(second), **changes}), *rest]))
    for to in ("depth", "cloud", "tum"):
        assert cli.main(["export", str(tmp_path / "out"), "--to", to]) == 2
        assert f"frames.jsonl, line 2 is not the record of a frame {said}" in capfd.readouterr().err


ARRAYS = {
    "none": ({"variance": None}, "it has no array variance"),
    "half a posterior": (
        {"posterior_outlier": np.ones((48, 64), np.float32), "network_depth": None},
        "it has no array network_depth",
    ),
    "another size": ({"variance": np.ones((3, 3), np.float32)}, r"array variance is float32 [3, 3]"),
    "a pose": ({"T_world_cam": np.eye(3)}, "array T_world_cam is float64 [3, 3]"),
    "NaN": ({"T_world_cam": np.full((4, 4), np.nan)}, "its pose or intrinsics are not finite"),
    "a mask": ({"valid": np.ones((48, 64), np.float32)}, "array valid is float32"),
    "anchors": ({"anchors": np.ones((5, 3), np.float32)}, "array anchors is float32 [5, 3]"),
}


@pytest.mark.parametrize("damage", ARRAYS)
def test_a_damaged_frame_is_named_by_file_and_array(finished, tmp_path, damage, capfd):
    changes, said = ARRAYS[damage]
    shutil.copytree(finished[0], tmp_path / "out")
    file = tmp_path / "out" / "frames" / "9.npz"
    arrays = {name: value for name, value in {**read_frame(file), **changes}.items() if value is not None}
    np.savez(file, **arrays)
    assert cli.main(["export", str(tmp_path / "out"), "--to", "depth"]) == 2
    assert f"9.npz is no frame of `ufmstar run`: {said}" in capfd.readouterr().err


@pytest.mark.parametrize("link", ["export", "export/depth", "export/depth/9.png"])
def test_nothing_is_exported_through_a_link(finished, tmp_path, link, capfd):
    """A folder from an archive may contain links to the user's files."""
    out, victim = tmp_path / "out", tmp_path / "victim"
    shutil.copytree(finished[0], out, ignore=shutil.ignore_patterns("export"))
    victim.mkdir()
    (victim / "9.png").write_text("precious")
    (out / link).parent.mkdir(parents=True, exist_ok=True)
    (out / link).symlink_to(victim / "9.png" if link.endswith("png") else victim)
    assert cli.main(["export", str(out), "--to", "depth"]) == 2
    assert "is a symbolic link, through which nothing is written" in capfd.readouterr().err
    assert [(path.name, path.read_text()) for path in victim.iterdir()] == [("9.png", "precious")]


def test_merging_weighs_by_the_inverse_variance(tmp_path):
    from ufmstar_torch.eval.run.export import RunFrame, export_cloud

    def frame(depth, sigma):
        maps = (np.float32([[depth]]), np.float32([[sigma]]))
        return RunFrame("0", 0, None, np.eye(4), np.eye(3), *maps)

    export_cloud(iter([frame(2.1, 0.1), frame(2.4, 0.2), frame(np.nan, np.nan)]), tmp_path, 1.0)
    (point,) = read_ply(tmp_path / "export" / "cloud.ply")
    w = np.array([100, 25])
    np.testing.assert_allclose(point["z"], (w * [2.1, 2.4]).sum() / w.sum(), rtol=1e-6)
    np.testing.assert_allclose(point["sigma"], np.sqrt(2 / w.sum()), rtol=1e-6)
    assert "red" not in point.dtype.names


def test_transforms_are_read_back(finished):
    out, path, truth = finished
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


def test_an_empty_cloud_is_an_error(finished, tmp_path, capfd):
    words = ["export", str(finished[0]), "--to", "cloud"]
    assert cli.main([*words, "--max-sigma", "1e-9"]) == 2
    assert "within the limits of sigma: raise these, or run without --plain" in capfd.readouterr().err
    assert cli.main([*words, "--voxel", "1e-7"]) == 2
    assert "left out (--voxel 1e-07)" in capfd.readouterr().err


def test_the_size_of_a_voxel_is_positive(finished, capfd):
    assert cli.main(["export", str(finished[0]), "--to", "cloud", "--voxel", "0"]) == 2
    assert "--voxel must be positive" in capfd.readouterr().err


def test_a_bag_is_read_back(finished):
    out, path, truth = finished
    words = ["--sequence", str(path), "--max-sigma", "0.9"]
    for _ in range(2):  # the second replaces the first
        assert cli.main(["export", str(out), "--to", "mcap", *words]) == 0
    assert open_sequence(out / "export" / "bag")[0].depth is None  # a prediction is no ground truth
    again = open_sequence(out / "export" / "bag", topics=["/camera/depth"])
    assert (again.layout, len(again), again.skipped) == ("bag", 6, ())
    for i, frame in enumerate(again):
        assert frame.timestamp == 7 + i
        np.testing.assert_allclose(frame.T_world_cam, truth.T_world_cam[i], atol=1e-7)
        np.testing.assert_allclose(frame.intrinsics, truth.K, atol=1e-9)
        np.testing.assert_array_equal(frame.image, truth.images[i])
        assert frame.image.flags.writeable  # torch warns of others
        np.testing.assert_allclose(frame.depth[20:], truth.depths[i][20:], atol=1e-3)
        assert not frame.depth[:20].any()
    sigma = open_sequence(out / "export" / "bag", topics=["/camera/sigma"])
    np.testing.assert_allclose(sigma[2].depth[20:], 0.02 * truth.depths[2][20:], atol=1e-4)
    bag = Bag(out / "export" / "bag")
    _, cloud = next(bag.messages(["/camera/points"]))
    assert [field.name for field in cloud.fields] == ["x", "y", "z", "variance"]
    points = cloud.data.view("<f4").reshape(-1, 4)
    assert len(points) == cloud.width == 28 * 64
    x, y, z, variance = points.T
    u, v, _ = truth.K @ np.stack([x, y, z]) / z
    rows, columns = np.rint(v).astype(int), np.rint(u).astype(int)
    np.testing.assert_allclose(np.hypot(v - rows, u - columns), 0, atol=1e-4)
    np.testing.assert_allclose(z, truth.depths[0][rows, columns], atol=1e-3)
    np.testing.assert_allclose(variance, np.square(0.02 * z), rtol=1e-3)


def test_a_bag_without_the_recording_has_the_maps_own_pixels(finished, tmp_path):
    from ufmstar_torch.eval.run.export import gated_frames
    from ufmstar_torch.eval.run.export_bag import export_bag

    out, _, truth = finished
    export_bag(gated_frames(out, np.inf, np.inf), tmp_path)
    with pytest.raises(ValueError, match="has no topic of colour images, but /camera/camera_info"):
        open_sequence(tmp_path / "export" / "bag")
    _, info = next(Bag(tmp_path / "export" / "bag").messages(["/camera/camera_info"]))
    np.testing.assert_allclose(info.k.reshape(3, 3), truth.K, atol=1e-9)


def test_a_bag_that_cannot_be_written_leaves_the_one_before(finished, tmp_path):
    from ufmstar_torch.eval.run.export import gated_frames
    from ufmstar_torch.eval.run.export_bag import export_bag

    frames, folder = list(gated_frames(finished[0], np.inf, np.inf))[:2], tmp_path / "export" / "bag"
    for _ in range(2):
        export_bag(iter(frames), tmp_path)
    for seconds in (np.nan, np.inf, 1e12):
        with pytest.raises(ValueError, match=f"{frames[1].name}: a bag's times are within 0 to"):
            export_bag(iter([frames[0], replace(frames[1], timestamp=seconds)]), tmp_path)
    assert len(list(Bag(folder).messages(["/tf"]))) == 2
    assert [path.name for path in folder.parent.iterdir()] == ["bag"]
    (tmp_path / "linked").mkdir()
    (tmp_path / "linked" / "export").mkdir()
    (tmp_path / "linked" / "export" / "bag").symlink_to(folder)
    with pytest.raises(ValueError, match="bag is a symbolic link, through which nothing is written"):
        export_bag(iter(frames), tmp_path / "linked")
    (folder / "notes.txt").write_text("mine")
    with pytest.raises(ValueError, match="is no folder of an earlier export, or holds other files"):
        export_bag(iter(frames), tmp_path)
    assert (folder / "notes.txt").read_text() == "mine"


def test_a_rerun_recording(finished):
    """rerun's reader opens it: every entity of a frame exists six times, the Gaussians and the blueprint once."""
    pytest.importorskip("rerun")
    out, path, _ = finished
    assert cli.main(["export", str(out), "--sequence", str(path), "--to", "rrd", "--max-sigma", "0.9"]) == 0
    file = out / "export" / "run.rrd"
    text = printed(file)
    for entity in ("camera/image/rgb", "camera/maps/depth", "camera/maps/sigma", "camera/points", "gaussians"):
        assert f"/world/{entity}" in text
    assert "/metres/mean_sigma" in text
    assert "Blueprint" in text
    assert file.stat().st_size < 2e6
    assert [path.name for path in file.parent.iterdir() if path.name.startswith(".")] == []


def printed(file):
    words = [sys.executable, "-m", "rerun", "rrd", "print", "-v", str(file)]
    return subprocess.run(words, check=True, capture_output=True, text=True).stdout


def test_anchors_have_a_line_to_the_depth_of_their_pixel(stand_in, tmp_path):
    """The run stores the anchors of every frame. In the recording, each line's length is the difference of depth and
    anchor."""
    path, out = "tour:1?frames=8&size=96x128", tmp_path / "out"
    words = ["run", path, "--depth", "self", "--anchors", "corners", "--no-video", "--no-sheet"]
    assert cli.main([*words, "--out", str(out)]) == 0
    assert cli.main(["export", str(out), "--to", "rrd"]) == 0
    found = [read_frame(file) for file in sorted((out / "frames").iterdir())]
    points, lines = stand_in.logged("world/camera/anchors"), stand_in.logged("world/camera/residuals")
    assert len(points) == len(lines) == 8
    assert sum(len(maps["anchors"]) for maps in found) > 20
    for maps, point, line in zip(found, points, lines, strict=True):
        u, v, depth, sigma = maps["anchors"].T
        assert (sigma > 0).all()
        np.testing.assert_allclose(point.words[0][:, 2], depth, rtol=1e-6)
        at = maps["depth"][np.rint(v).astype(int).clip(0, 95), np.rint(u).astype(int).clip(0, 127)]
        ends = line.words[0]
        np.testing.assert_allclose(ends[:, 0, 2] - ends[:, 1, 2], (depth - at)[at > 0], atol=1e-6)
        np.testing.assert_allclose(ends[:, 0, :2] / ends[:, 0, 2:], ends[:, 1, :2] / ends[:, 1, 2:], atol=1e-6)


def test_a_recording_that_fails_leaves_the_one_before(stand_in, finished, monkeypatch):
    out, _, _ = finished
    export = out / "export"
    export.mkdir(exist_ok=True)
    (export / "run.rrd").write_bytes(b"before")
    monkeypatch.setattr(Made, "flush", lambda _: (_ for _ in ()).throw(RuntimeError("the writer ended")))
    assert cli.main(["export", str(out), "--to", "rrd"]) == 1
    assert (export / "run.rrd").read_bytes() == b"before"
    assert not list(export.glob(".rrd*"))


def test_a_run_without_a_frame_is_not_exported(tmp_path, capfd, finished):
    line = {"name": "a", "state": "skipped", "reason": "no pose"}
    (tmp_path / "frames.jsonl").write_text(json.dumps(line) + "\n")
    assert cli.main(["export", str(tmp_path), "--to", "depth"]) == 2
    assert "has no finished frame" in capfd.readouterr().err


def test_rerun_is_named_where_it_is_missing(finished, monkeypatch, capfd):
    monkeypatch.setitem(sys.modules, "rerun", None)
    assert cli.main(["export", str(finished[0]), "--to", "rrd"]) == 1
    assert "pip install 'ufmstar-torch[viz3d]'" in capfd.readouterr().err

"""Bags of ROS and recordings of rerun that ``ufmstar export`` writes."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from rerun_stand_in import Made, stand_in

from ufmstar_torch import cli
from ufmstar_torch.eval.run.export import gated_frames
from ufmstar_torch.eval.run.export_bag import export_bag
from ufmstar_torch.eval.run.writers import read_frame
from ufmstar_torch.eval.sequences import open_sequence
from ufmstar_torch.eval.sequences.bag import Bag

__all__ = ["stand_in"]


def test_a_bag_is_read_back(finished_run):
    out, path, truth = finished_run
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


def test_a_bag_without_the_recording_has_the_maps_own_pixels(finished_run, tmp_path):
    out, _, truth = finished_run
    export_bag(gated_frames(out, np.inf, np.inf), tmp_path)
    with pytest.raises(ValueError, match="has no topic of colour images, but /camera/camera_info"):
        open_sequence(tmp_path / "export" / "bag")
    _, info = next(Bag(tmp_path / "export" / "bag").messages(["/camera/camera_info"]))
    np.testing.assert_allclose(info.k.reshape(3, 3), truth.K, atol=1e-9)


def test_a_bag_that_cannot_be_written_leaves_the_one_before(finished_run, tmp_path):
    frames, folder = list(gated_frames(finished_run[0], np.inf, np.inf))[:2], tmp_path / "export" / "bag"
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


def test_a_rerun_recording(finished_run):
    """rerun's reader opens it: every entity of a frame exists six times, the Gaussians and the blueprint once."""
    pytest.importorskip("rerun")
    out, path, _ = finished_run
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


def test_a_recording_that_fails_leaves_the_one_before(stand_in, finished_run, monkeypatch):
    out, _, _ = finished_run
    export = out / "export"
    export.mkdir(exist_ok=True)
    (export / "run.rrd").write_bytes(b"before")
    monkeypatch.setattr(Made, "flush", lambda _: (_ for _ in ()).throw(RuntimeError("the writer ended")))
    assert cli.main(["export", str(out), "--to", "rrd"]) == 1
    assert (export / "run.rrd").read_bytes() == b"before"
    assert not list(export.glob(".rrd*"))


def test_rerun_is_named_where_it_is_missing(finished_run, monkeypatch, capfd):
    monkeypatch.setitem(sys.modules, "rerun", None)
    assert cli.main(["export", str(finished_run[0]), "--to", "rrd"]) == 1
    assert "pip install 'ufmstar-torch[viz3d]'" in capfd.readouterr().err
